"""In lockstep unit and harness send in turns: the frames of the bus repeat to the byte."""

import contextlib
import os
import signal
import threading
import time

from bench_process import MAGNETS, BenchProcess, SimpleUnit, until
from benchmarks import repeat

from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.sdo_client import SdoClient
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.harness_client import Harness
from rollerrig.wsp_interface.rig_objects import END, HARNESS, JOINED, REFERENCE_SPEED_ID, SAND_ID

CYCLES = 40
# what the harness does in some cycles
ACTIONS = {
    5: lambda rig: rig.brake(bar=3.8),
    10: lambda rig: rig.inject("frame_lost can_id=0x211 for=0.03"),
    20: lambda rig: rig.inject("wsp_frozen for=0.05"),
    30: lambda rig: rig.friction(0.05),
}
PAUSE_S = 0.03
# the bench would wait longer than a test may take
LONG_WAIT = ("--answer-wait", "3000")


def bench_with_harness(out, *arguments):
    """A bench that waits for a harness; a coach on soap."""
    return BenchProcess(
        out,
        "--pacing",
        "lockstep",
        "--harness",
        "--set",
        "adhesion=soap",
        "--set",
        "initial_speed_m_s=10",
        *arguments,
    )


def play(out, slow):
    """Play the actions on a bench; before each of them, and before its cycle, call slow."""
    bench = bench_with_harness(out)
    # as a sequence does: the bench reports that it waits for the harness when its unit is there
    until(lambda: bench.reported(Code.UNIT_READY), "the unit")
    with Harness(buses.open_client(bench.address(), 60.0)) as rig:
        unit = bench.child("wsp")
        for cycle in range(CYCLES):
            action = ACTIONS.get(cycle)
            with slow(unit) if action else contextlib.nullcontext():
                rig.step()
                if action:
                    action(rig)
    bench.finish()
    assert bench.status in (0, 4), bench.stderr  # the coach has not stopped
    return bench.out


@contextlib.contextmanager
def slow_unit(unit):
    """Stop the unit for a while, so that the frames of the harness arrive before its answer."""
    os.kill(unit, signal.SIGSTOP)
    go_on = threading.Timer(PAUSE_S, os.kill, (unit, signal.SIGCONT))
    go_on.start()
    yield
    go_on.join()


@contextlib.contextmanager
def slow_harness(_):
    """Let the harness wait, so that the answer of the unit arrives before its frames."""
    time.sleep(PAUSE_S)
    yield


def test_a_sequence_gives_the_same_frames_whether_its_unit_or_its_harness_is_slower(tmp_path):
    one = play(tmp_path / "unit", slow_unit)
    other = play(tmp_path / "harness", slow_harness)
    assert not repeat.differences(one, other)


def test_the_frames_that_a_unit_sends_up_to_its_answer_are_in_the_order_of_arbitration(tmp_path):
    sand = (SAND_ID, b"\0")
    reference_speed = (REFERENCE_SPEED_ID, b"\0\0")
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--set", "duration_max_s=0.5"
    )
    unit = SimpleUnit(bench.address(), lambda n: [sand, reference_speed, (MAGNETS, b"\0")])
    bench.finish()
    unit.close()
    assert bench.status in (0, 4), bench.stderr

    sent = {SAND_ID, REFERENCE_SPEED_ID, MAGNETS}
    heard = [can_id for _, can_id, *_ in records.frames(bench.out) if can_id in sent]
    assert heard[: 3 * 40] == [REFERENCE_SPEED_ID, MAGNETS, SAND_ID] * 40


def test_a_unit_that_floods_the_bus_before_its_answer_loses_no_frame(tmp_path):
    flood = 3000

    def answer(n):
        frames = [(0x300, b"\0")] * flood if n == 5 else []
        return [*frames, (MAGNETS, b"\0")]

    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--set", "duration_max_s=0.2"
    )
    unit = SimpleUnit(bench.address(), answer)
    bench.finish()
    unit.close()
    assert bench.status in (0, 4), bench.stderr
    heard = [can_id for _, can_id, *_ in records.frames(bench.out) if can_id == 0x300]
    assert len(heard) == flood


def test_other_programs_are_served_while_the_bench_waits_for_the_harness(tmp_path):
    bench = bench_with_harness(tmp_path / "run")
    with Harness(buses.open_client(bench.address(), 60.0)) as rig:
        rig.step()
        with buses.open_client(bench.address()) as bus:
            tool = SdoClient(bus.send, bus.recv, lambda message: None)
            assert tool.read(signals.BRAKE_NODE, 0x1000, 0)
        rig.step()
    bench.finish()
    assert bench.status in (0, 4), bench.stderr


def test_a_harness_that_has_ended_the_run_has_time_to_leave_it(tmp_path):
    bench = bench_with_harness(tmp_path / "run")
    rig = Harness(buses.open_client(bench.address(), 60.0)).join()
    rig.step()
    sdo = SdoClient(rig.bus.send, rig.bus.recv, lambda message: None)
    sdo.write(signals.BENCH_NODE, HARNESS, END, b"\1")
    time.sleep(0.3)
    sdo.write(signals.BENCH_NODE, HARNESS, JOINED, b"\0")
    rig.bus.shutdown()
    bench.finish()
    assert bench.reported(Code.HARNESS_LEFT)


# -- a partner that is gone


def test_a_run_ends_when_the_connection_of_an_outside_unit_closes(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", *LONG_WAIT)
    unit = SimpleUnit(bench.address(), lambda n: [(MAGNETS, b"\0")] if n < 20 else None)
    unit.thread.join()
    unit.close()
    bench.finish()
    assert bench.status == 4
    assert "the WSP unit has closed its connection" in bench.stderr


def test_a_run_ends_when_the_connection_of_its_harness_closes(tmp_path):
    bench = bench_with_harness(tmp_path / "run", *LONG_WAIT)
    rig = Harness(buses.open_client(bench.address(), 60.0)).join()
    rig.step()
    rig.bus.shutdown()  # without leaving
    bench.finish()
    assert bench.status == 4
    assert "the harness has closed its connection" in bench.stderr
