"""Lockstep runs repeat to the byte, even if cores are busy or the bench is paused repeatedly."""

import contextlib
import functools
import os
import signal
import threading
import time

import pytest
from bench_process import MAGNETS, BenchProcess, SimpleUnit
from benchmarks import repeat

# faults one after another: no speeds, lost speeds, late speeds, a frozen unit, late answers, and a
# unit that is frozen while there are no speeds
FAULTS = (
    "node_off node=16 at=0.3 for=0.6",
    "frame_lost can_id=0x190 every=2 at=1.2 for=0.5",
    "frame_delayed can_id=0x190 delay_s=0.033 at=2 for=0.5",
    "wsp_frozen at=3.4 for=0.7",
    "frame_delayed can_id=0x211 delay_s=0.05 at=2.7 for=0.5",
    "wsp_frozen at=4.6 for=0.7",
    "node_off node=16 at=4.8 for=0.6",
)
# a wire that is never silent
BABBLE = "node_babbling node=17 can_id=0x101 rate_Hz=4000 at=0.6 for=0.3"


def with_faults():
    """The arguments of a run with these faults."""
    words = ["--set", "duration_max_s=6"]
    for fault in FAULTS:
        words += ["--fault", fault]
    return tuple(words)


CASES = {
    "plain": ("--set", "duration_max_s=6"),
    "faults": with_faults(),
    "wire": ("--set", "duration_max_s=1.5", "--set", "bus.arbitration=true", "--fault", BABBLE),
}


def stop_and_go(bench, rest_s=0.2, go_s=0.05):
    """Pause the bench repeatedly, from its first frames to its exit; return how often."""
    log = bench.out / "can.log"

    def has_frames():
        return log.exists() and log.stat().st_size > 0

    while bench.process.poll() is None and not has_frames():
        time.sleep(0.01)

    count = 0
    while bench.process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(bench.process.pid, signal.SIGSTOP)
            time.sleep(rest_s)
            os.killpg(bench.process.pid, signal.SIGCONT)
            count += 1
        time.sleep(go_s)
    return count


def run(out, arguments, disturb=lambda bench: None):
    bench = BenchProcess(out, "--pacing", "lockstep", "--set", "adhesion.mu_cd=0.05", *arguments)
    thread = threading.Thread(target=disturb, args=(bench,))
    thread.start()
    bench.finish()
    thread.join()
    assert bench.status in (0, 4), bench.stderr  # cut short by duration_max_s: perhaps not valid
    return bench


def check_same(one, other):
    """Check that two runs have the same frames, channels and events."""
    assert not repeat.differences(one.out, other.out)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A function that returns the undisturbed run of a case; each is made once."""
    return functools.cache(lambda case: run(tmp_path_factory.mktemp("alone") / case, CASES[case]))


@pytest.mark.parametrize(
    "case",
    [
        "wire",
        pytest.param("plain", marks=pytest.mark.nightly),
        pytest.param("faults", marks=pytest.mark.nightly),
    ],
)
def test_a_run_in_lockstep_whose_bench_is_paused_repeatedly_is_the_same_to_the_byte(
    case, undisturbed, tmp_path
):
    counts = []
    # the case with a wire is short
    go_s = 0.02 if case == "wire" else 0.05

    def disturb(bench):
        counts.append(stop_and_go(bench, go_s=go_s))

    disturbed = run(tmp_path / "run", CASES[case], disturb)
    check_same(undisturbed(case), disturbed)
    assert counts[0] > 3


@pytest.mark.nightly
@pytest.mark.parametrize("case", ["plain", "faults"])
def test_a_run_in_lockstep_on_busy_cores_is_the_same_to_the_byte(case, undisturbed, tmp_path):
    with repeat.busy_cores():
        disturbed = run(tmp_path / "run", CASES[case])
    check_same(undisturbed(case), disturbed)


@pytest.mark.nightly
def test_the_bench_waits_for_a_unit_that_is_only_slow(undisturbed, tmp_path):
    def stop_the_unit(bench):
        bench.runs_for(0.5)
        unit = bench.child("wsp")
        os.kill(unit, signal.SIGSTOP)
        time.sleep(2.5)
        os.kill(unit, signal.SIGCONT)

    # the process of the unit exists, so the bench waits six times as long
    disturbed = run(tmp_path / "run", (*CASES["plain"], "--answer-wait", "1"), stop_the_unit)
    check_same(undisturbed("plain"), disturbed)


def test_an_outside_unit_may_owe_its_answer_for_the_configured_time(tmp_path):
    def answer(n):
        time.sleep(2.0 if n == 20 else 0.0)
        return [(MAGNETS, b"\0")]

    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--set", "duration_max_s=0.5"
    )
    unit = SimpleUnit(bench.address(), answer)
    bench.finish()
    unit.close()
    assert bench.status in (0, 4), bench.stderr  # cut short by duration_max_s: perhaps not valid
    assert bench.result["loop"]["ticks"] == 500
