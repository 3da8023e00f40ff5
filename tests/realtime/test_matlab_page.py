"""The page for MATLAB: its names, addresses and lines, sent or read by other programs."""

import re
import socket
import struct
from pathlib import Path

import numpy as np
import pytest
from bench_process import BenchProcess

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.modbus import map as register_map
from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals

PAGE = (Path(__file__).parents[2] / "docs/matlab.md").read_text(encoding="utf-8")
CODE = "\n".join(re.findall(r"```matlab\n(.*?)```", PAGE, re.DOTALL))


@pytest.fixture(scope="module")
def loaded(stop_on_leaves, tmp_path_factory):
    """The exported run as scipy loads it, with structures as objects."""
    from scipy.io import loadmat

    file = tmp_path_factory.mktemp("mat") / "a1.mat"
    assert cli.main(["export", str(stop_on_leaves.out), "--format", "mat", "--out", str(file)]) == 0
    return loadmat(file, struct_as_record=False, squeeze_me=True)


def test_every_variable_of_the_page_is_in_the_exported_file(loaded):
    named = set(re.findall(r"\bs\.(\w+(?:\.\w+)?)", CODE))
    assert {"time_s", "vehicle_speed_m_s", "units.cylinder_pressure_1_Pa", "events.text"} <= named
    for name in named:
        variable, _, field = name.partition(".")
        assert variable in loaded, name
        if field:
            assert hasattr(loaded[variable], field), name
    assert loaded["units"].cylinder_pressure_1_Pa == "Pa"


def test_the_variables_hold_the_channels_of_the_run(loaded, stop_on_leaves):
    run = records.load(stop_on_leaves.out)
    for name in ("time_s", "vehicle_speed_m_s", "sliding_1_m_s"):
        assert loaded[name].tolist() == run.column(name).tolist()
    texts = np.atleast_1d(loaded["events"].text).tolist()
    assert texts == [event.text for event in run.events]


def test_the_addresses_of_the_page_are_those_of_the_map_plus_one():
    calls = re.findall(r'(?:read|write)\(plc, "(\w+)", (\d+),.*?% (?:register|bit) (\d+)', CODE)
    assert len(calls) == 4
    for _, address, written in calls:
        assert int(address) == int(written) + 1
    rows = {row.address: row for row in register_map.words(signals.table(COACH))}
    assert (rows[1].name, rows[1].scale) == ("speed_set_point", 0.01)
    assert (rows[2].kind, rows[2].unit) == ("I16", "Pa")
    assert (rows[202].kind, rows[202].scale, rows[202].unit) == ("I16", 0.01, "m_s")
    assert next(row.address for row in register_map.BITS if row.name == "run") == 0


def test_the_lines_of_the_page_join_the_bus_and_its_pattern_reads_the_frames(tmp_path):
    lines = re.findall(r'write\(bus, "(<.*?>)"\)', CODE)
    pattern = re.search(r"regexp\(text, '(.*?)', 'tokens'\)", CODE)[1]
    bench = BenchProcess(
        tmp_path / "run",
        *("--pacing", "lockstep", "--wsp", "external", "--answer-wait", "1"),
        *("--set", "bus.socketcand_port=0", "--set", "duration_max_s=0.1"),
    )
    host, port = bench.address().removeprefix("socketcand://").split("/")[0].rsplit(":", 1)
    text = ""
    with socket.create_connection((host, int(port)), timeout=60.0) as bus:
        for line in lines:
            bus.sendall(line.encode())
        while "< frame 190 " not in text:
            received = bus.recv(4096).decode()
            assert received, text
            text += received
        frames = re.findall(pattern, text)
    speeds = [data for identifier, _, data in frames if identifier == "190"][-1]
    assert all(count > 0 for count in struct.unpack("<4h", bytes.fromhex(speeds)))
    bench.process.wait(60.0)
