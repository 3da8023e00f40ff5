"""A harness on a real bench over a real bus: its commands take effect, and time waits for it."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import program
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.wsp_interface import own_bench
from rollerrig.wsp_interface.bus.sdo_client import RefusedError
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.harness import COLUMNS
from rollerrig.wsp_interface.harness_client import TimeOutError
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result

TCP_LISTEN = "0A"  # state in /proc/net/tcp

STOP = """title = "A stop from walking pace on soap"
criteria = "low_speed"

[start]
speed = "9 km/h"
adhesion = "soap"

[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
"""


def test_the_commands_of_a_harness_take_effect_on_the_rig(tmp_path):
    with own_bench.start(tmp_path / "run", initial_speed_km_h=36.0, adhesion="soap") as rig:
        assert rig.lockstep
        assert rig.vehicle_speed_m_s == pytest.approx(10.0, abs=0.01)
        rig.note("the driver looks out")

        # time passes only when the harness lets it
        before_s = rig.time_s
        time.sleep(0.3)
        rig.step()
        assert rig.time_s == pytest.approx(before_s + 0.01)

        rig.inject("speed_sensor_dropout axle=2 for=0.2")
        rig.wait(0.05)
        assert rig.axles("measured_speed")[1] == 0.0
        assert rig.axles("measured_speed")[0] > 10.0
        rig.wait(0.3)
        assert rig.axles("measured_speed")[1] > 10.0

        rig.inject("vent_magnet_stuck axle=3")
        rig.brake(bar=2.0)
        rig.until(lambda: rig.axles("cylinder_pressure")[0] > 1e5, timeout_s=5.0)
        assert rig.axles("cylinder_pressure")[2] < 0.2e5
        rig.lift("vent_magnet_stuck axle=3")
        rig.until(lambda: rig.axles("cylinder_pressure")[2] > 1e5, timeout_s=5.0)

        rig.friction(0.01, axles=[1])
        rig.brake(bar=3.8)
        rig.until(
            lambda: rig.axles("measured_speed")[0] < 0.9 * rig.axles("measured_speed")[1],
            timeout_s=5.0,
        )

        with pytest.raises(RefusedError, match="axle = 9 is out of range; allowed 1 to 4"):
            rig.inject("speed_sensor_dropout axle=9")
        with pytest.raises(RefusedError, match=r"did you mean 'speed_sensor_dropout'\?.*node_off"):
            rig.inject("Speed_sensor_dropout axle=1")
        with pytest.raises(RefusedError, match="'stuck' is not a fault"):
            rig.lift("stuck")
        with pytest.raises(ConfigError, match="did you mean 'cylinder_pressure'"):
            rig.axles("cylinder_presure")
        with pytest.raises(ConfigError, match="did you mean 'longest_lock'"):
            rig.read("longest_locks")
        with pytest.raises(ConfigError, match="did you mean 'vehicle_speed_m_s'"):
            _ = rig.values["vehicle_speed_ms"]
        with pytest.raises(
            TimeOutError,
            match=r"test_harness\.py, line \d+: rig\.until\(lambda: rig\.vehicle_speed_m_s > 50\.0.*"
            r"not come true in 0\.1 s; last values: <Harness at",
        ):
            rig.until(lambda: rig.vehicle_speed_m_s > 50.0, timeout_s=0.1)
        assert rig.columns == COLUMNS
        assert len(rig.trace[0]) == len(COLUMNS)

    events = own_bench.summary(tmp_path / "run")["events"]
    notes = [event["fields"] for event in events if event["code"] == Code.OPERATOR_NOTE]
    assert {"note": "the driver looks out"} in notes
    begun = [event["fields"] for event in events if event["code"] == Code.FAULT_BEGINS]
    assert any("speed_sensor_dropout axle=2" in fields["fault"] for fields in begun)


@pytest.mark.parametrize("pacing", ["lockstep", "wall"])
def test_a_harness_learns_the_vehicle_from_its_bench(tmp_path, pacing):
    scenario = "tram_emergency_magnetic"
    with own_bench.start(tmp_path / "run", scenario, pacing=pacing) as rig:
        assert rig.table.kind.axles == len(rig.axles("cylinder_pressure")) == 6
        assert rig.table.kind.magnetic_track_brake
        assert rig.read("track_brake_force") == (0.0,) * 6
        rig.friction(0.02)
        assert rig.commanded_friction() == pytest.approx(dict.fromkeys(range(1, 7), 0.02))


@pytest.fixture
def stop(tmp_path):
    """The sequence STOP."""
    path = tmp_path / "walk.toml"
    path.write_text(STOP, encoding="utf-8")
    return sequence.load(path, catalogue.parse)


@pytest.mark.nightly
def test_a_sequence_in_lockstep_repeats_bit_for_bit(stop, tmp_path):
    traces = []
    for name in ("first", "second"):
        outcome = play.on_own_bench(stop, tmp_path / name)
        assert outcome.result is Result.PASS, (outcome.error, outcome.verdicts)
        traces.append((tmp_path / name / play.TRACE).read_bytes())
    assert traces[0] == traces[1]
    assert traces[0].count(b"\n") > 100


def test_a_bench_that_vanishes_is_an_error_and_its_rows_are_kept(stop, tmp_path):
    folder = tmp_path / "run"

    @contextlib.contextmanager
    def killer(address):
        """Kill the bench as soon as its record grows."""
        ended = threading.Event()
        log = folder / "can.log"

        def watch():
            while not ended.wait(0.005):
                if log.is_file() and log.stat().st_size > 40_000:
                    os.kill(bench_of(address), signal.SIGKILL)
                    return

        thread = threading.Thread(target=watch)
        thread.start()
        yield
        ended.set()
        thread.join()

    outcome = play.on_own_bench(stop, folder, companions=(killer,))
    assert outcome.result is Result.ERROR
    assert "connection to the bench is lost" in outcome.error
    # 40 kB of frames are more than forty SYNC periods, each with its row; the last may be missing
    assert (folder / play.TRACE).read_text().count("\n") > 8


def bench_of(address):
    """Return the process that listens at an address."""
    port = int(address.rpartition("/")[0].rpartition(":")[2])
    inode = listening_inode(port)
    socket = f"socket:[{inode}]"
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):
            if os.readlink(link) == socket:
                return int(link.parts[2])
    raise AssertionError(f"no process listens on {port}")


def listening_inode(port):
    """Return the inode of the socket that listens on a port."""
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, local_address, _, state, _, _, _, _, _, inode, *_ = line.split()
        if local_address.endswith(f":{port:04X}") and state == TCP_LISTEN:
            return inode
    raise AssertionError(f"no socket listens on {port}")


@pytest.mark.nightly
def test_a_full_disk_is_an_error_and_no_pass(stop, tmp_path):
    # a limit on the size of files acts as a full disk: the bench and its recorder cannot write
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        outcome = play.on_own_bench(stop, tmp_path / "run")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert outcome.result is Result.ERROR
    assert outcome.error


def test_a_sequence_on_a_running_bench_reports_the_timing_that_the_bus_shows(tmp_path):
    log = tmp_path / "stderr"
    bench = program.start(
        [
            "run",
            "velim_a1",
            "--pacing",
            "lockstep",
            "--harness",
            "--out",
            str(tmp_path / "run"),
            "--set",
            "initial_speed_m_s=2.78",
            # the sequence checks the rig also for a second after standstill
            "--set",
            "stand_s=60",
            "--set",
            "bus.interface=hub",
            "--set",
            "bus.socketcand_port=0",
            "--set",
            "modbus.enabled=false",
        ],
        tmp_path / "stdout",
        log,
    )
    try:
        address = own_bench._address(bench, log, own_bench.Observer())
        status = cli.main(
            ["sequence", "low_speed_010", "--bus", address, "--out", str(tmp_path / "report")]
        )
    finally:
        bench.terminate()
        bench.wait(60.0)
    assert status == 0, (tmp_path / "report" / "report.json").read_text()
    page = (tmp_path / "report" / "report.html").read_text()
    assert "cycles of 10 ms seen, 0 lost" in page
    assert (
        "the bus does not show missed ticks and lateness: they are in the summary.json of the bench"
        in page
    )


def test_pytest_finds_the_fixture_by_entry_point_and_loads_little_for_it():
    text = Path(__file__).parents[2].joinpath("pyproject.toml").read_text()
    project = tomllib.loads(text)["project"]
    module = project["entry-points"]["pytest11"]["rollerrig"]
    same = (
        f"import {module} as plugin\n"
        "from rollerrig.wsp_interface.harness import rollerrig_bench\n"
        "assert plugin.rollerrig_bench is rollerrig_bench"
    )
    light = f"import sys, {module}; assert not {{'can', 'numpy', 'numba'}} & set(sys.modules)"
    for code in (same, light):
        assert subprocess.run([sys.executable, "-c", code]).returncode == 0
