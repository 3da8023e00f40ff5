"""A bus that is lost, a bus with a foreign SYNC producer, and a bus whose frames take time."""

import asyncio
import contextlib
import filecmp
import threading
import time

import numpy as np
import pytest
from bench_process import MAGNETS, SYNC, BenchProcess, SimpleUnit

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.bench import Bench
from rollerrig.realtime.bench.options import Options
from rollerrig.realtime.record import records, run_folder
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.events import Code

ANSWERS = 0x211


@contextlib.contextmanager
def foreign_bus():
    """A bus of another program: its address for python-can, and a function that closes it."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    def do(coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, loop).result(60)

    hub = Hub(time.monotonic_ns)
    port = do(hub.listen("socketcand", port=0))
    yield f"rollerrig:127.0.0.1:{port}/rig0", lambda: do(hub.close())
    do(hub.close())
    loop.call_soon_threadsafe(loop.stop)
    thread.join(5)
    loop.close()


@pytest.mark.conformance("Bad input", "a lost bus ends the run with status 2 and its record")
@pytest.mark.parametrize("pacing", [pytest.param("wall", marks=pytest.mark.nightly), "lockstep"])
def test_a_bus_that_is_lost_while_the_rig_runs_ends_the_run_with_status_2_and_keeps_its_record(
    pacing, tmp_path
):
    with foreign_bus() as (address, close):
        bench = BenchProcess(
            tmp_path / "run",
            "--pacing",
            pacing,
            "--wsp",
            "none",
            "--set",
            f"bus.interface={address}",
            "--set",
            "duration_max_s=3000",
            "--set",
            "adhesion.mu_cd=0.001",
            "--set",
            "stand_s=60",
        )
        bench.runs_for(1.0)
        close()
        bench.finish()
    assert bench.status == 2, bench.stderr
    assert "Traceback" not in bench.stderr
    assert "failed" in bench.result["error"]
    assert "check the interface" in bench.result["error"]
    summary = records.summary(bench.out)
    assert summary["ended"] == "error"
    failures = [event for event in summary["events"] if event["code"] == Code.RUN_FAILED]
    assert any("CAN bus" in event["fields"]["reason"] for event in failures)
    run = bench.record
    assert run.column("time_s")[-1] >= 1.0
    assert (bench.out / "can.log").stat().st_size > 1000


@pytest.mark.conformance("Bad input", "a stray SYNC is counted, told and holds up nothing")
def test_a_sync_of_the_unit_is_counted_and_reported_and_does_not_stop_a_lockstep_run(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--set", "duration_max_s=2"
    )
    sync = (SYNC, b"")
    magnets = (MAGNETS, b"\0")

    def answer(cycle):
        # two cycles of ten have a foreign SYNC, before the answer or after it
        if cycle % 10 == 3:
            return [sync, magnets]
        if cycle % 10 == 7:
            return [magnets, sync]
        return [magnets]

    unit = SimpleUnit(bench.address(), answer)
    bench.finish()
    unit.close()
    assert bench.status == 4, bench.stderr  # it does not stop in that time
    assert len(bench.record.table) >= 199
    assert bench.result["bus"]["stray_syncs"] == 40
    assert len(bench.reported(Code.SYNC_FOREIGN)) == 1


def test_a_failure_inside_the_bus_thread_is_an_event_and_the_run_continues(tmp_path):
    plan = scenario.load(
        "dry_stop", settings=("duration_max_s=0.5", "bus.interface=hub", "bus.socketcand_port=0")
    )
    rig = Bench(plan, Options("lockstep", "none", tmp_path / "run"), lambda progress: None)

    async def both():
        run = asyncio.ensure_future(rig.run())
        while rig.parts.bus is None and not run.done():
            await asyncio.sleep(0.001)
        # this member of the bus divides by zero at every SYNC
        rig.parts.hub.attach(lambda frame: 1 // (frame.can_id - SYNC), "clumsy")
        return await run

    result = asyncio.run(both())
    assert result["ended"] == "finished"
    assert result["loop"]["ticks"] == 500
    (error,) = [event for event in result["events"] if event["level"] == "error"]
    assert error["code"] == Code.BENCH_EXCEPTION
    assert "failed on frame 80h" in error["fields"]["message"]
    assert "ZeroDivisionError" in error["fields"]["exception"]


# --- the wire ---


def frames(folder):
    """(time in us, identifier) of every frame of a run, in the order of the log."""
    logged = []
    for line in (folder / run_folder.CAN_LOG).read_text().splitlines():
        stamp, _, body = line.split()
        time_us = round(1e6 * float(stamp.strip("()")))
        can_id = int(body.partition("#")[0], 16)
        logged.append((time_us, can_id))
    return logged


def run_on_wire(out, pacing, *more):
    bench = BenchProcess(
        out,
        "--pacing",
        pacing,
        "--set",
        "bus.interface=hub",
        "--set",
        "bus.arbitration=true",
        "--set",
        "duration_max_s=1.5",
        *more,
    )
    bench.finish()
    assert bench.status == 4, bench.stderr  # it does not stop in that time
    return bench


def check_wire(bench):
    """Check that frames do not overlap, and are in order of identifiers after SYNC."""
    log = frames(bench.out)
    first_sync = [can_id for _, can_id in log].index(SYNC)
    log_of_run = log[first_sync:]
    # frames from before the run, and services while simulated time stood still, did not wait
    ends_us = np.array([time_us for time_us, can_id in log_of_run if can_id < 0x580])
    # the shortest frame of the rig, SYNC, has 47 bits of 2 us; times are rounded to 1 us
    assert np.diff(ends_us).min() >= 93

    cycles = []
    for _, can_id in log_of_run:
        if can_id == SYNC:
            cycles.append([])
        is_process_data = 0x180 < can_id < 0x580 and can_id not in (0x1A0, ANSWERS)
        if is_process_data:
            cycles[-1].append(can_id)
    for identifiers in cycles[1:-1]:
        assert identifiers == sorted(identifiers)
    return log


def check_equal_channels(one, two):
    """Check that two runs recorded the same, except for the wall times of their ticks."""
    first = one.record
    second = two.record
    for name in first.table.column_names:
        if not name.startswith("tick_"):
            assert np.array_equal(first.column(name), second.column(name), equal_nan=True), name


@pytest.mark.conformance("CAN", "arbitration in simulated time: lockstep repeats bit for bit")
def test_in_lockstep_frames_wait_for_the_wire_and_the_run_repeats_bit_for_bit(tmp_path):
    one = run_on_wire(tmp_path / "one", "lockstep")
    two = run_on_wire(tmp_path / "two", "lockstep")
    check_wire(one)
    assert filecmp.cmp(one.out / "can.log", two.out / "can.log", shallow=False)
    check_equal_channels(one, two)

    # twelve frames of process data, one after another
    assert 2000 < one.result["bus"]["longest_wait_us"] < 4000
    assert 25.0 < one.result["bus"]["load_percent"] < 45.0


@pytest.mark.nightly
@pytest.mark.conformance("CAN", "arbitration by the clock")
def test_in_real_time_frames_wait_for_the_wire_and_no_answer_is_lost(tmp_path):
    bench = run_on_wire(tmp_path / "run", "wall")
    log = check_wire(bench)
    assert bench.result["bus"]["dropped"] == 0
    identifiers = [can_id for _, can_id in log]
    assert identifiers.count(ANSWERS) >= identifiers.count(SYNC) - 5


def test_a_valve_command_acts_later_where_its_frame_has_to_wait_for_a_slower_wire(tmp_path):
    def first_vent(out, *more):
        """The time of the first sample with a magnet command, in s."""
        bench = BenchProcess(
            out,
            "--pacing",
            "lockstep",
            "--wsp",
            "external",
            "--set",
            "duration_max_s=0.6",
            "--set",
            "bus.interface=hub",
            "--set",
            "loop.record_hz=1000",
            *more,
        )
        unit = SimpleUnit(bench.address(), lambda n: [(MAGNETS, b"\xff" if n > 20 else b"\0")])
        bench.finish()
        unit.close()
        assert bench.status == 4, bench.stderr  # it does not stop in that time
        run = bench.record
        first = np.flatnonzero(run.column("magnets_1"))[0]
        return run.column("time_s")[first]

    ideal = first_vent(tmp_path / "ideal")
    fast = first_vent(tmp_path / "fast", "--set", "bus.arbitration=true")
    slow = first_vent(
        tmp_path / "slow", "--set", "bus.arbitration=true", "--set", "bus.bitrate=250000"
    )
    assert 0.001 < fast - ideal < 0.006
    assert 0.001 < slow - fast < 0.006


@pytest.mark.nightly
@pytest.mark.conformance("CAN", "arbitration in simulated time: free pacing equals lockstep")
@pytest.mark.parametrize("bitrate", [500_000, pytest.param(250_000, marks=pytest.mark.nightly)])
def test_free_pacing_lets_the_answers_act_as_late_as_the_wire_of_lockstep_does(bitrate, tmp_path):
    def run(pacing):
        bench = BenchProcess(
            tmp_path / pacing,
            "--pacing",
            pacing,
            "--set",
            "bus.interface=hub",
            "--set",
            "bus.arbitration=true",
            "--set",
            f"bus.bitrate={bitrate}",
            "--set",
            "duration_max_s=6",
            "--set",
            "adhesion.mu_cd=0.03",
        )
        bench.finish()
        assert bench.status == 4, bench.stderr  # it does not stop in that time
        return bench

    free = run("free")
    lockstep = run("lockstep")
    assert free.result["wsp"]["vents"] > 3
    assert free.result["wsp"]["vents"] == lockstep.result["wsp"]["vents"]
    check_equal_channels(free, lockstep)


def test_a_wire_that_cannot_carry_the_answers_is_refused_where_there_is_no_bus(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "free",
        "--set",
        "bus.arbitration=true",
        "--set",
        "bus.bitrate=100000",
    )
    bench.finish()
    assert bench.status == 2
    assert "bitrate = 100000 bit/s" in bench.result["error"]
    assert "--pacing lockstep" in bench.result["error"]
