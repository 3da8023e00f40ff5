"""A run that is not valid is reported in its summary, in red, by the status and to later
readers.
"""

import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import bench_process
import numpy as np
import pytest
from bench_process import HEARTBEAT, MAGNETS, BenchProcess, SimpleUnit

from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.realtime.record import records, summary, validity
from rollerrig.wsp_interface.events import Code, make
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result
from rollerrig.wsp_interface.signals import COLUMNS

SHORT = ("run", "dry_stop", "--wsp", "none", "--pacing", "free", "--set", "initial_speed_m_s=3")
LOST = make(1.0, Code.UNIT_LOST, node=32, silent_s=0.2)


def not_valid(bench, *parts):
    """The run ended with status 4; its one reason has all parts, in summary.json too."""
    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr
    recorded = records.summary(bench.out)
    reasons = recorded["invalid_because"]
    assert recorded["valid"] is bench.result["valid"] is False
    assert reasons == bench.result["invalid_because"]
    assert any(all(part in reason for part in parts) for reason in reasons), reasons
    return recorded


def gone(pid):
    try:
        with open(f"/proc/{pid}/status") as file:
            return "\nState:\tZ" in file.read()
    except OSError:
        return True


# --- the reasons ---


def test_a_run_that_stops_is_valid_and_one_that_does_not_is_not(tmp_path):
    stops = bench_process.run(tmp_path / "stops", *SHORT[2:], scenario="dry_stop")
    assert stops.status == 0, stops.stderr
    assert (stops.result["valid"], stops.result["invalid_because"]) == (True, [])
    rolls = bench_process.run(
        tmp_path / "rolls", *SHORT[2:], "--set", "duration_max_s=0.3", scenario="dry_stop"
    )
    not_valid(
        rolls,
        "did not stop within 0.3 s (duration_max_s)",
        f"at {rolls.result['final_speed_m_s']:.2f} m/s",
    )


def test_the_last_line_of_a_run_that_is_not_valid_names_the_reasons_in_red(tmp_path):
    words = (
        sys.executable,
        "-m",
        "rollerrig.realtime.cli",
        *SHORT,
        "--set",
        "duration_max_s=0.3",
        "--out",
    )
    done = subprocess.run(
        [*words, tmp_path / "run"],
        capture_output=True,
        text=True,
        env=os.environ | {"FORCE_COLOR": "1", "COLUMNS": "200"},
    )
    assert done.returncode == 4, done.stderr
    last = done.stdout.splitlines()[-1]
    assert "not valid: the coach did not stop within 0.3 s" in last
    assert "\x1b[1;31m" in last


def test_a_units_process_that_ends_in_real_time_makes_the_run_not_valid(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", "initial_speed_m_s=4")
    bench.runs_for(0.3)
    os.kill(bench.child("wsp"), signal.SIGKILL)
    bench.finish()
    recorded = not_valid(bench, "the reference WSP unit exited with status -9", ", at ")
    assert recorded["stopped"]
    reasons = recorded["invalid_because"]
    assert any("was lost 1 time (no heartbeat)" in reason for reason in reasons)


def flickering(n):
    """The answers of a unit that is silent for half a second now and then."""
    if n % 100 == 50:
        time.sleep(0.5)
    return [(MAGNETS, b"\0"), (HEARTBEAT, b"\5")]


def test_a_unit_that_is_lost_again_and_again_makes_the_run_not_valid_and_the_times_are_counted(
    tmp_path,
):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "wall", "--wsp", "external", "--set", "initial_speed_m_s=4"
    )
    unit = SimpleUnit(bench.address(), flickering)
    bench.finish()
    unit.close()
    times = len(bench.reported(Code.UNIT_LOST))
    assert times > 1
    not_valid(bench, f"the WSP unit was lost {times} times (no heartbeat), first at ")


def test_a_unit_that_a_fault_of_the_run_has_frozen_does_not_make_it_not_valid(tmp_path):
    bench = bench_process.run(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--set",
        "initial_speed_m_s=4",
        "--fault",
        "wsp_frozen at=0.5 for=0.6",
    )
    assert bench.reported(Code.UNIT_LOST)
    assert bench.status == 0, bench.stderr
    assert bench.result["valid"] is True


@pytest.mark.parametrize(
    ("fault", "reaches"),
    [
        ("wsp_frozen", True),
        ("node_babbling node=16", True),
        ("error_frame node=1", True),
        ("frame_lost can_id=0x720", True),
        ("frame_delayed can_id=0x080", True),
        ("heartbeat_late node=32", True),
        ("heartbeat_late node=17", False),
        ("frame_lost can_id=0x181", False),
        ("cylinder_leak axle=1", False),
        ("node_off node=2", False),
    ],
)
def test_a_lost_unit_is_excused_by_a_fault_that_reaches_it_and_by_no_other(fault, reaches):
    fields = catalogue.parse(fault).event_fields
    begins = make(0.5, Code.FAULT_BEGINS, **fields)
    lifted = make(0.9, Code.FAULT_LIFTED, **fields, frames_met=None)
    late = LOST._replace(time_s=2.5)
    assert validity.losses([begins, lifted, LOST]) == ([] if reaches else [1.0])
    assert validity.losses([begins, lifted, late]) == [2.5]
    assert validity.losses([LOST, begins]) == [1.0]


def test_a_unit_that_a_held_rig_loses_and_finds_again_is_no_loss_of_the_run():
    lost = LOST._replace(time_s=0.0)
    back = make(0.0, Code.UNIT_BACK, node=32, state="OPERATIONAL")
    assert validity.losses([lost, back]) == []
    assert validity.losses([lost, back, lost]) == [0.0]


@pytest.mark.parametrize(
    ("ended", "event", "reason"),
    [
        (
            "killed",
            make(1.0, Code.BENCH_KILLED),
            "the bench was killed, at 1.00 s",
        ),
        (
            "derailed",
            make(1.0, Code.COACH_DERAILED, side="left", axle=3, distance_m=12.0),
            "left its rail after 12.0 m, at 1.00 s",
        ),
        (
            "error",
            make(1.0, Code.RUN_FAILED, reason="CAN bus failed"),
            "ended with an error: CAN bus failed",
        ),
        ("terminated", make(1.0, Code.UNIT_READY), "ends early: terminated"),
        (
            "stopped over Modbus",
            make(1.0, Code.RUN_STOPPED),
            "while the coach rolled, at 20.00 m/s",
        ),
    ],
)
def test_how_a_run_ended_is_a_reason(ended, event, reason):
    columns = dict.fromkeys(COLUMNS, np.zeros(3)) | {"vehicle_speed_m_s": np.full(3, 20.0)}
    found = summary.of(columns, {"ended": ended}, {}, [event])
    assert found["valid"] is False
    assert reason in found["invalid_because"][0]
    assert len(found["invalid_because"]) == 1


# --- interrupted ---


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("pacing", ["wall", "lockstep"])
def test_a_signal_ends_a_run_with_its_record_and_without_its_children(name, pacing, tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", pacing)
    bench.runs_for(0.5)
    children = bench.child("wsp"), bench.child("rollerrig.realtime.telemetry.recorder")
    bench.process.send_signal(getattr(signal, name))
    bench.finish()
    recorded = not_valid(bench, f"the run is interrupted by {name}, at ")
    assert recorded["ended"] == "interrupted"
    assert bench.record.column("time_s")[-1] >= 0.5
    assert not (bench.out / "channels.tail").exists()
    assert (bench.out / "run.rrd").stat().st_size > 10_000
    assert all(gone(pid) for pid in children)


def test_a_second_ctrl_c_while_the_record_is_closed_loses_nothing(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall")
    bench.runs_for(1.0)
    bench.interrupt()
    bench_process.until(
        lambda: bench.reported(Code.RUN_INTERRUPTED, signal="SIGINT"), "the first signal"
    )
    for _ in range(3):
        bench.interrupt()
        time.sleep(0.02)
    bench.finish()
    not_valid(bench, "the run is interrupted by SIGINT")
    assert not (bench.out / "channels.tail").exists()
    assert bench.record.column("time_s")[-1] >= 1.0


def test_a_run_under_nohup_goes_on_when_its_terminal_closes(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "wall",
        "--wsp",
        "none",
        "--set",
        "initial_speed_m_s=3",
        before=functools.partial(signal.signal, signal.SIGHUP, signal.SIG_IGN),
    )
    bench.runs_for(0.3)
    bench.process.send_signal(signal.SIGHUP)
    bench.finish()
    assert bench.status == 0, bench.stderr
    assert bench.result["valid"] is True


# --- commands that read runs ---


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A run that stops, and one that does not."""
    place = tmp_path_factory.mktemp("read")
    assert cli.main([*SHORT, "--out", str(place / "good")]) == 0
    assert cli.main([*SHORT, "--set", "duration_max_s=0.3", "--out", str(place / "bad")]) == 4
    return str(place / "good"), str(place / "bad")


def test_compare_gives_no_figures_of_a_run_that_is_not_valid_and_warns(folders, capsys):
    good, bad = folders
    assert cli.main(["compare", good, bad, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {figure["values"][1] for figure in printed["figures"]} == {None}
    assert printed["figures"][0]["values"][0] is not None
    (warning,) = printed["warnings"]
    assert f"{bad} is not valid: the coach did not stop within 0.3 s" in warning
    # it equals the other run up to its end, but that is no reason to pass
    assert cli.main(["compare", good, bad, "--tolerance", "m_s=0.1"]) == 4
    assert f"warning: {bad} is not valid" in capsys.readouterr().out


def test_view_warns_of_a_run_that_is_not_valid(folders, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    cli.main(["view", folders[1], "--size", "x"])
    assert "is not valid: the coach did not stop" in " ".join(capsys.readouterr().out.split())


def test_explain_refuses_a_run_that_is_not_valid(folders, tmp_path, capsys):
    assert cli.main(["explain", *folders, "--out", str(tmp_path / "report")]) == 2
    said = capsys.readouterr().err
    assert f"{folders[1]} is not valid: the coach did not stop" in said
    assert "leave it out" in said


PLAN = """title = "runs, of which some do not stop"
scenario = "{scenario}"
[vary]
duration_max_s = [{durations}]
"""
SCENARIO = "initial_speed_m_s = 3.0\n[[demand]]\npressure_Pa = 3.8e5\n"


@pytest.mark.parametrize(
    ("durations", "bad"), [("0.3, 60.0, 0.4, 50.0", 2), ("0.3, 0.4", 2), ("50.0, 60.0", 0)]
)
def test_a_campaign_counts_runs_that_are_not_valid_apart(durations, bad, tmp_path, capsys):
    (tmp_path / "short.toml").write_text(SCENARIO)
    (tmp_path / "plan.toml").write_text(
        PLAN.format(scenario=tmp_path / "short.toml", durations=durations)
    )
    words = [
        "campaign",
        str(tmp_path / "plan.toml"),
        "--workers",
        "1",
        "--out",
        str(tmp_path / "out"),
    ]
    assert cli.main([*words, "--json"]) == (4 if bad else 0)
    printed = json.loads(capsys.readouterr().out)
    count = len(durations.split(","))
    worst, not_valid_runs = printed["worst"], printed["not_valid_runs"]
    assert (printed["runs"], printed["not_valid"], len(worst)) == (count, bad, count - bad)
    assert all(case["stop_distance_m"] is not None for case in worst)
    if count > 2:
        assert [one["run"] for one in not_valid_runs] == [0, 2][:bad]
    assert all("did not stop within 0." in one["because"] for one in not_valid_runs)
    cli.main(words)
    assert f"{count} runs, {bad} not valid" in capsys.readouterr().out
    page = Path(printed["report"]).read_text()
    assert f"Not valid: {bad} of {count} runs" in page
    assert page.count("did not stop within") == bad


WALK = """title = "A stop from walking pace"
criteria = "none"
[start]
speed = "9 km/h"
adhesion = "dry"
[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
"""


@pytest.fixture
def walk(tmp_path):
    (tmp_path / "walk.toml").write_text(WALK)
    return sequence.load(tmp_path / "walk.toml", catalogue.parse)


class Companion:
    """A simple unit on the bus of a bench, while a block of code runs."""

    def __init__(self, answer, address):
        self.answer = answer
        self.address = address

    def __enter__(self):
        self.unit = SimpleUnit(self.address, self.answer)

    def __exit__(self, *_):
        self.unit.close()


def companion(answer):
    return functools.partial(Companion, answer)


def test_a_sequence_whose_run_is_not_valid_is_an_error_and_neither_passed_nor_failed(
    walk, tmp_path
):
    dies = companion(lambda n: [(MAGNETS, b"\0")] if n < 60 else None)
    outcome = play.on_own_bench(walk, tmp_path / "run", "wall", wsp="external", companions=(dies,))
    assert outcome.result is Result.ERROR
    assert "the run is not valid: the WSP unit was lost 1 time" in outcome.error


def test_a_run_that_a_harness_ends_on_purpose_is_valid(walk, tmp_path):
    outcome = play.on_own_bench(walk, tmp_path / "run", wsp="none")
    assert outcome.result is Result.PASS, (outcome.error, outcome.verdicts)
    assert outcome.summary["valid"] is True


OWN_TEST = """
import contextlib
from rollerrig.wsp_interface.fixture import rollerrig_bench
from {here} import companion, MAGNETS

def test_of_a_unit_that_dies(rollerrig_bench):
    dies = companion(lambda n: [(MAGNETS, bytes(1))] if n < 60 else None)
    rig = rollerrig_bench("dry_stop", initial_speed_m_s=3.0, wsp="external", pacing="wall", companions=(dies,))
    rig.wait(1.5)
"""


def test_the_fixture_ends_a_test_with_an_error_where_the_run_was_not_valid(tmp_path):
    (tmp_path / "test_own.py").write_text(OWN_TEST.format(here=Path(__file__).stem))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", "test_own.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent), "PYTEST_ADDOPTS": ""},
    )
    assert "1 passed, 1 error" in done.stdout, done.stdout
    assert "the run is not valid: the WSP unit was lost 1 time" in done.stdout


# --- the priority of the unit ---


def policy(pacing, place):
    bench = BenchProcess(place / pacing, "--pacing", pacing, "--set", "initial_speed_m_s=4")
    bench.runs_for(0.3)
    pid = bench.child("wsp")
    found = os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority
    bench.interrupt()
    refused = "was refused" in (bench.finish().out / "wsp.log").read_text()
    return found, refused


def test_the_reference_unit_asks_for_a_priority_below_the_loops_in_real_time_only(tmp_path):
    (wall, priority), refused = policy("wall", tmp_path)
    assert refused is (wall != os.SCHED_FIFO)
    assert refused or 0 < priority < 80
    assert policy("lockstep", tmp_path) == ((os.SCHED_OTHER, 0), False)


def test_a_unit_that_is_refused_its_priority_says_so_and_runs(tmp_path):
    hub = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--wsp",
        "external",
        "--set",
        "initial_speed_m_s=3",
    )
    # without the right to any priority, whichever user runs this test
    unit = subprocess.Popen(
        [
            *WITHOUT_RIGHTS,
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "wsp",
            "--bus",
            hub.address(),
            "--priority",
            "60",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    hub.finish()
    said, _ = unit.communicate(timeout=60)
    assert hub.status == 0, hub.stderr
    assert "SCHED_FIFO priority 60 was refused" in said


# removes CAP_SYS_NICE for good, and the limit of real-time priorities
WITHOUT_RIGHTS = (
    sys.executable,
    "-c",
    "import ctypes, os, resource, sys\n"
    "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
    "ctypes.CDLL(None).prctl(24, 23, 0, 0, 0)\n"  # PR_CAPBSET_DROP, CAP_SYS_NICE
    "os.execv(sys.argv[1], sys.argv[1:])",
)
