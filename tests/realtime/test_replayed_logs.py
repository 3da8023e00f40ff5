"""What a unit has sent in a log is sent again: the run is the same, whatever form the log has."""

import json
import sys
from pathlib import Path

import can
import numpy as np
import pyarrow.parquet as pq
import pytest
from bench_process import BenchProcess

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.wsp import node, replay

SHORT = ("--pacing", "lockstep", "--set", "duration_max_s=6", "--set", "adhesion.mu_cd=0.05")
FRAMES = node.frames_of_group(COACH, 1)


def run(out, *arguments):
    bench = BenchProcess(out, *SHORT, *arguments)
    bench.finish()
    assert bench.status in (0, 4), bench.stderr  # cut short by duration_max_s
    return bench


def channels(bench):
    table = pq.read_table(bench.out / "channels.parquet")
    return {name: table[name].to_numpy() for name in table.column_names}


def commands(bench):
    """Return the bytes of the magnets in the log of a run."""
    lines = (bench.out / "can.log").read_text().splitlines()
    return [line.split("211#")[1] for line in lines if " 211#" in line]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run whose unit holds and vents."""
    bench = run(tmp_path_factory.mktemp("recorded") / "run", "--wsp", "reference")
    assert len(set(commands(bench))) > 2
    return bench


def log_as(suffix, recorded, folder):
    """Write the log of a run in another form of python-can."""
    path = folder / f"log{suffix}"
    with can.LogReader(recorded.out / "can.log") as messages, can.Logger(path) as written:
        for message in messages:
            message.channel = 1
            written(message)
    return path


@pytest.mark.parametrize(
    "suffix",
    [
        ".log",
        *(pytest.param(suffix, marks=pytest.mark.nightly) for suffix in replay.SUFFIXES[1:]),
    ],
)
def test_a_replayed_unit_makes_the_same_run_to_the_bit(suffix, recorded, tmp_path):
    path = log_as(suffix, recorded, tmp_path)
    rollerrig = Path(sys.executable).parent / "rollerrig"
    unit = f"{rollerrig} wsp --replay {path} --bus {{address}} --lockstep 0.01"
    again = run(tmp_path / "run", "--unit", unit)
    before, after = channels(recorded), channels(again)
    assert np.max(np.abs(before["sliding_1_m_s"])) > 0.5
    for name, values in before.items():
        assert np.array_equal(values, after[name], equal_nan=True), name
    played = json.loads((again.out / "summary.json").read_text())["unit_played"]
    assert "--replay" in json.dumps(played)


@pytest.mark.nightly
def test_a_replayed_unit_sends_the_same_commands_in_real_time(recorded, tmp_path):
    """Their delays depend on the machine, so only their order is compared."""
    rollerrig = Path(sys.executable).parent / "rollerrig"
    unit = f"{rollerrig} wsp --replay {recorded.out / 'can.log'} --bus {{address}}"
    again = BenchProcess(
        tmp_path / "run",
        "--set",
        "duration_max_s=6",
        "--set",
        "adhesion.mu_cd=0.05",
        "--unit",
        unit,
    ).finish()
    assert again.status in (0, 4), again.stderr

    before, after = commands(recorded), commands(again)
    # the bench may end within a cycle
    shared = min(len(before), len(after))
    assert shared >= 595
    assert before[:shared] == after[:shared]


@pytest.mark.parametrize("suffix", replay.SUFFIXES)
def test_every_form_of_a_log_has_the_same_frames_in_the_same_cycles(suffix, recorded, tmp_path):
    expected = replay.read(recorded.out / "can.log", FRAMES)
    found = replay.read(log_as(suffix, recorded, tmp_path), FRAMES)
    assert len(found.cycles) == len(expected.cycles) >= 600
    for cycle, wanted in zip(found.cycles, expected.cycles, strict=True):
        assert [frame[:2] for frame in cycle] == [frame[:2] for frame in wanted]
        for frame, other in zip(cycle, wanted, strict=True):
            assert frame.delay_s == pytest.approx(other.delay_s, abs=2e-3)
    assert [frame[:2] for frame in found.boot] == [frame[:2] for frame in expected.boot]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("log.csv", "", "candump, BLF, ASC and TRC"),
        ("log.blf", "no BLF", "cannot be read as a log"),
        ("log.log", "(0.000000) rig0 720#05\n", "has no SYNC"),
        ("log.log", "(0.000000) rig0 080#\n", "no command of a unit"),
        ("log.log", "(0.0) rig0 080#\n(0.01) rig0 231#00\n", "--group"),
    ],
)
def test_a_log_that_cannot_be_replayed_is_refused_with_a_remedy(name, text, message, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        replay.read(path, FRAMES)
