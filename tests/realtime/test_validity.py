"""Summary, exit status, last line and later commands show that a run is not valid."""

import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import bench_process
import numpy as np
import program
import pytest
import short_campaign
from bench_process import HEARTBEAT, MAGNETS, BenchProcess, SimpleUnit
from process_tree import is_running
from short_sequences import WALKING_PACE

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.realtime.record import records, summary, validity
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, make
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result

COLUMNS = signals.table(COACH).columns

# a short stop, as words of the command line, without and with its verb and scenario
SHORT_OPTIONS = ("--wsp", "none", "--pacing", "free", "--set", "initial_speed_m_s=3")
SHORT = ("run", "dry_stop", *SHORT_OPTIONS)
# sets a time limit within which the coach cannot stop
NO_TIME_TO_STOP = ("--set", "duration_max_s=0.3")

LOST = make(1.0, Code.UNIT_LOST, node=32, silent_s=0.2)


def not_valid(bench, *parts):
    """Check that the run is not valid and that one reason contains all parts; return its summary.

    The exit status is 4, and summary.json and the printed result have the same reasons.
    """
    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr

    recorded = records.summary(bench.out)
    assert recorded["valid"] is False
    assert bench.result["valid"] is False

    reasons = recorded["invalid_because"]
    assert reasons == bench.result["invalid_because"]

    def has_all_parts(reason):
        return all(part in reason for part in parts)

    assert any(map(has_all_parts, reasons)), reasons
    return recorded


# --- the reasons ---


@pytest.fixture(scope="module")
def stops(tmp_path_factory):
    """A run in which the coach stops."""
    folder = tmp_path_factory.mktemp("stops") / "good"
    return bench_process.run(folder, *SHORT_OPTIONS, scenario="dry_stop")


@pytest.fixture(scope="module")
def rolls(tmp_path_factory):
    """A run in which the coach does not stop."""
    folder = tmp_path_factory.mktemp("rolls") / "bad"
    return bench_process.run(folder, *SHORT_OPTIONS, *NO_TIME_TO_STOP, scenario="dry_stop")


def test_a_run_that_stops_is_valid(stops):
    assert stops.status == 0, stops.stderr
    assert stops.result["valid"] is True
    assert stops.result["invalid_because"] == []


def test_a_run_that_does_not_stop_is_not_valid(rolls):
    not_valid(
        rolls,
        "did not stop within 0.3 s (duration_max_s)",
        f"at {rolls.result['final_speed_m_s']:.2f} m/s",
    )


def test_the_last_line_of_a_run_that_is_not_valid_names_the_reasons_in_red(tmp_path):
    words = (*SHORT, *NO_TIME_TO_STOP, "--out", tmp_path / "run")
    done = program.rollerrig(*words, FORCE_COLOR="1", COLUMNS="200")
    assert done.status == 4, done.messages

    last_line = done.printed.splitlines()[-1]
    assert "not valid: the coach did not stop within 0.3 s" in last_line
    bold_red = "\x1b[1;31m"
    assert bold_red in last_line


def test_a_units_process_that_exits_in_real_time_makes_the_run_not_valid(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", "initial_speed_m_s=3")
    bench.runs_for(0.3)
    os.kill(bench.child("wsp"), signal.SIGKILL)
    bench.finish()

    recorded = not_valid(bench, "the reference WSP unit was killed (signal 9, SIGKILL)", ", at ")
    assert recorded["stopped"]
    reasons = recorded["invalid_because"]
    assert any("was lost 1 time (no heartbeat)" in reason for reason in reasons)


def flickering(n):
    """Return the answers of a unit that is silent for half a second at every fiftieth SYNC."""
    if n % 50 == 25:
        time.sleep(0.5)
    return [(MAGNETS, b"\0"), (HEARTBEAT, b"\5")]


def test_a_unit_that_is_lost_repeatedly_makes_the_run_not_valid_and_the_losses_are_counted(
    tmp_path,
):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "wall", "--wsp", "external", "--set", "initial_speed_m_s=3"
    )
    unit = SimpleUnit(bench.address(), flickering)
    bench.finish()
    unit.close()

    losses = len(bench.reported(Code.UNIT_LOST))
    assert losses > 1
    not_valid(bench, f"the WSP unit was lost {losses} times (no heartbeat), first at ")


@pytest.mark.nightly
def test_a_unit_that_keeps_its_heartbeat_but_commands_no_valve_makes_the_run_not_valid(tmp_path):
    def answer(n):
        return [(MAGNETS, b"\0")] if n <= 150 else []

    bench = BenchProcess(
        tmp_path / "run", "--pacing", "wall", "--wsp", "external", "--set", "initial_speed_m_s=5"
    )
    unit = SimpleUnit(bench.address(), answer)
    bench.finish()
    unit.close()

    (silent,) = bench.reported(Code.UNIT_SILENT, node=32)
    assert silent.fields["syncs"] == 50
    not_valid(bench, "the WSP unit was silent 1 time", f"first at {silent.time_s:.2f} s")


SILENT = make(1.0, Code.UNIT_SILENT, node=32, syncs=50, silent_s=0.5)


def test_a_silence_does_not_count_if_a_fault_causes_it_or_it_begins_after_standstill():
    assert validity.silences([SILENT], None) == [1.0]
    assert validity.silences([SILENT], 0.6) == [1.0]
    assert validity.silences([SILENT], 0.4) == []
    for fault, excused in (
        ("wsp_frozen", True),
        ("frame_lost can_id=0x190", True),
        ("node_off node=16", True),
        ("power_dip", True),
        ("node_off node=2", False),
        ("cylinder_leak axle=1", False),
    ):
        fields = catalogue.parse(fault, COACH).event_fields
        begins = make(0.5, Code.FAULT_BEGINS, **fields)
        assert (validity.silences([begins, SILENT], None) == []) == excused, fault


def test_a_fault_of_one_unit_excuses_no_other_unit():
    fields = catalogue.parse("wsp_frozen", COACH).event_fields | {"units": [64]}
    begins = make(0.5, Code.FAULT_BEGINS, **fields)
    assert validity.silences([begins, SILENT], None) == [1.0]
    assert validity.losses([begins, LOST]) == [1.0]
    for event in (SILENT, LOST):
        of_the_other = event._replace(fields=event.fields | {"node": 64})
        assert validity.silences([begins, of_the_other], None) == []
        assert validity.losses([begins, of_the_other]) == []


def test_a_run_stays_valid_if_one_of_its_faults_freezes_the_unit(tmp_path):
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
    fields = catalogue.parse(fault, COACH).event_fields
    begins = make(0.5, Code.FAULT_BEGINS, **fields)
    lifted = make(0.9, Code.FAULT_LIFTED, **fields, frames_met=None)

    losses_soon_after = validity.losses([begins, lifted, LOST])
    if reaches:
        assert losses_soon_after == []
    else:
        assert losses_soon_after == [LOST.time_s]

    # no fault excuses a loss long after it or before it
    late = LOST._replace(time_s=2.5)
    assert validity.losses([begins, lifted, late]) == [2.5]
    assert validity.losses([LOST, begins]) == [1.0]


def test_a_unit_that_is_lost_and_comes_back_while_the_rig_is_held_is_no_loss_of_the_run():
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
    columns = dict.fromkeys(COLUMNS, np.zeros(3))
    columns["vehicle_speed_m_s"] = np.full(3, 20.0)

    recorded = summary.of(columns, {"ended": ended}, {}, [event])

    assert recorded["valid"] is False
    assert len(recorded["invalid_because"]) == 1
    assert reason in recorded["invalid_because"][0]


@pytest.mark.parametrize(
    ("events", "valid"),
    [
        ([(1.0, Code.EMERGENCY_STOP_SET)], False),
        ([(1.0, Code.EMERGENCY_STOP_SET), (1.5, Code.EMERGENCY_STOP_RESET)], False),
        # before the start, and not reset
        ([(0.0, Code.EMERGENCY_STOP_SET)], False),
        ([(0.0, Code.EMERGENCY_STOP_SET), (0.0, Code.EMERGENCY_STOP_RESET)], True),
        # the coach has stopped at 2 s
        ([(2.5, Code.EMERGENCY_STOP_SET)], True),
    ],
)
def test_an_emergency_stop_makes_a_run_not_valid_unless_the_coach_stands_or_is_still_held(
    events, valid
):
    columns = dict.fromkeys(COLUMNS, np.zeros(4))
    columns["time_s"] = np.arange(4.0)
    columns["vehicle_speed_m_s"] = np.array([20.0, 10.0, 0.0, 0.0])

    made = [make(time_s, code) for time_s, code in events]
    recorded = summary.of(columns, {}, {}, made)

    assert recorded["valid"] is valid
    if not valid:
        (reason,) = recorded["invalid_because"]
        assert "emergency stop was set over Modbus while the coach rolled" in reason


# --- interrupted ---


@pytest.mark.parametrize(
    ("name", "pacing"),
    [
        ("SIGTERM", "wall"),
        ("SIGHUP", "lockstep"),
        pytest.param("SIGINT", "wall", marks=pytest.mark.nightly),
        pytest.param("SIGINT", "lockstep", marks=pytest.mark.nightly),
        pytest.param("SIGTERM", "lockstep", marks=pytest.mark.nightly),
        pytest.param("SIGHUP", "wall", marks=pytest.mark.nightly),
    ],
)
def test_a_run_that_a_signal_stops_completes_its_record_and_leaves_no_process(
    name, pacing, tmp_path
):
    bench = BenchProcess(tmp_path / "run", "--pacing", pacing)
    bench.runs_for(0.5)
    unit = bench.child("wsp")
    recorder = bench.child("rollerrig.realtime.telemetry.recorder")
    bench.process.send_signal(getattr(signal, name))
    bench.finish()

    recorded = not_valid(bench, f"the run is interrupted by {name}, at ")
    assert recorded["ended"] == "interrupted"
    assert bench.record.column("time_s")[-1] >= 0.5
    assert not (bench.out / "channels.tail").exists()
    assert (bench.out / "run.rrd").stat().st_size > 10_000
    assert not is_running(unit)
    assert not is_running(recorder)


@pytest.mark.nightly
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


@pytest.mark.nightly
def test_a_run_under_nohup_goes_on_when_its_terminal_closes(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "wall",
        "--wsp",
        "none",
        "--set",
        "initial_speed_m_s=2",
        ignored=(signal.SIGHUP,),
    )
    bench.runs_for(0.3)
    bench.process.send_signal(signal.SIGHUP)
    bench.finish()
    assert bench.status == 0, bench.stderr
    assert bench.result["valid"] is True


# --- commands that read runs ---


@pytest.fixture
def folders(stops, rolls):
    """The folders of a run in which the coach stops, and of a run in which it does not."""
    return str(stops.out), str(rolls.out)


def test_compare_gives_no_figures_of_a_run_that_is_not_valid_and_warns(folders, capsys):
    good, bad = folders
    assert cli.main(["compare", good, bad, "--json"]) == 4
    printed = json.loads(capsys.readouterr().out)
    assert printed["passed"] is False
    assert {figure["values"][1] for figure in printed["figures"]} == {None}
    assert printed["figures"][0]["values"][0] is not None
    (warning,) = printed["warnings"]
    assert f"{bad} is not valid: the coach did not stop within 0.3 s" in warning

    # the invalid run equals the other run until it finishes, but the comparison must not pass
    assert cli.main(["compare", good, bad, "--tolerance", "m_s=0.1"]) == 4
    assert f"warning: {bad} is not valid" in capsys.readouterr().out


def test_compare_shows_why_a_run_that_failed_before_its_first_sample_has_no_figures(
    stops, tmp_path, capsys
):
    words = ("--pacing", "lockstep", "--wsp", "external", "--wait", "0.5")
    failed = bench_process.run(tmp_path / "failed", *words)
    assert not len(failed.record.table)
    for pair in ((stops.out, failed.out), (failed.out, stops.out)):
        assert cli.main(["compare", *map(str, pair), "--json"]) == 4
        (warning,) = json.loads(capsys.readouterr().out)["warnings"]
        assert f"{failed.out} is not valid: the run ended with an error: no WSP unit" in warning


def test_view_warns_of_a_run_that_is_not_valid(folders, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    _, bad = folders
    cli.main(["view", bad, "--size", "x"])
    # the terminal may wrap the message
    printed = " ".join(capsys.readouterr().out.split())
    assert "is not valid: the coach did not stop" in printed


def test_explain_refuses_a_run_that_is_not_valid(folders, tmp_path, capsys):
    _, bad = folders
    assert cli.main(["explain", *folders, "--out", str(tmp_path / "report")]) == 2
    message = capsys.readouterr().err
    assert f"{bad} is not valid: the coach did not stop" in message
    assert "leave it out" in message


# a campaign of one run per maximum duration, some of which are too short
PLAN = """title = "runs, of which some do not stop"
scenario = "{scenario}"
[vary]
duration_max_s = [{durations}]
"""
SCENARIO = "initial_speed_m_s = 3.0\n[[demand]]\npressure_Pa = 3.8e5\n"


@pytest.mark.parametrize(
    ("durations_s", "bad_runs"),
    [
        ([0.3, 60.0, 0.4, 50.0], [0, 2]),
        pytest.param([0.3, 0.4], [0, 1], marks=pytest.mark.nightly),
        pytest.param([50.0, 60.0], [], marks=pytest.mark.nightly),
    ],
)
def test_a_campaign_counts_runs_that_are_not_valid_separately(
    durations_s, bad_runs, tmp_path, capsys
):
    scenario = tmp_path / "short.toml"
    scenario.write_text(SCENARIO)
    plan = tmp_path / "plan.toml"
    durations = ", ".join(map(str, durations_s))
    plan.write_text(PLAN.format(scenario=scenario, durations=durations))
    short_campaign.run_here(plan, tmp_path / "out")
    words = ["campaign", str(plan), "--out", str(tmp_path / "out")]
    runs = len(durations_s)
    bad = len(bad_runs)

    status = cli.main([*words, "--json"])
    if bad_runs:
        assert status == 4
    else:
        assert status == 0

    printed = json.loads(capsys.readouterr().out)
    assert printed["runs"] == runs
    assert printed["not_valid"] == bad
    assert len(printed["worst"]) == runs - bad
    for case in printed["worst"]:
        assert case["stop_distance_m"] is not None
    assert [run["run"] for run in printed["not_valid_runs"]] == bad_runs
    for run in printed["not_valid_runs"]:
        assert "did not stop within 0." in run["because"]

    cli.main(words)
    assert f"{runs} runs, {bad} not valid" in capsys.readouterr().out
    page = Path(printed["report"]).read_text()
    assert f"Not valid: {bad} of {runs} runs" in page
    assert page.count("did not stop within") == bad


@pytest.fixture
def walk(tmp_path):
    (tmp_path / "walk.toml").write_text(WALKING_PACE)
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
    """Return a function that makes the companion with these answers for a bus address."""
    return functools.partial(Companion, answer)


def stops_answering(n):
    """Return the answers of a unit that is silent from the 60th SYNC on."""
    if n < 60:
        return [(MAGNETS, b"\0")]
    return None


@pytest.mark.nightly
def test_a_sequence_whose_run_is_not_valid_is_an_error_and_neither_passed_nor_failed(
    walk, tmp_path
):
    outcome = play.on_own_bench(
        walk,
        tmp_path / "run",
        "wall",
        wsp="external",
        companions=(companion(stops_answering),),
    )
    assert outcome.result is Result.ERROR
    assert "the run is not valid: the WSP unit was lost 1 time" in outcome.error


@pytest.mark.nightly
def test_a_run_that_a_harness_finishes_on_purpose_is_valid(walk, tmp_path):
    outcome = play.on_own_bench(walk, tmp_path / "run", wsp="none")
    assert outcome.result is Result.PASS, (outcome.error, outcome.verdicts)
    assert outcome.summary["valid"] is True


# a test as a user writes it; {here} is the name of this module
USER_TEST = """
from rollerrig.wsp_interface.fixture import rollerrig_bench
from {here} import companion, stops_answering

def test_of_a_unit_that_dies(rollerrig_bench):
    rig = rollerrig_bench(
        "dry_stop",
        initial_speed_m_s=3.0,
        wsp="external",
        pacing="wall",
        companions=(companion(stops_answering),),
    )
    rig.wait(1.5)
"""


@pytest.mark.nightly
def test_the_fixture_finishes_a_test_with_an_error_if_the_run_was_not_valid(tmp_path):
    here = Path(__file__)
    (tmp_path / "test_user.py").write_text(USER_TEST.format(here=here.stem))
    path = os.pathsep.join([str(here.parent), str(here.parents[1])])
    done = subprocess.run(
        # the user's session does not know the marks of this file, which his test imports
        [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            "-W",
            "ignore",
            "-q",
            "test_user.py",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path, "PYTEST_ADDOPTS": ""},
    )
    assert "1 passed, 1 error" in done.stdout, done.stdout
    assert "the run is not valid: the WSP unit was lost 1 time" in done.stdout


# --- the priority of the unit ---


class Scheduling(NamedTuple):
    """How the operating system schedules the reference unit of a run."""

    policy: int
    priority: int
    refused: bool  # whether the unit logs that its requested priority was refused
    memory_is_locked: bool
    memory_refused: bool  # whether the unit logs that locked memory was refused
    cores: set[int]


def scheduling_of_the_unit(pacing, parent, loop_core):
    """Run a bench with this pacing and this core of the loop; return how its unit is scheduled."""
    bench = BenchProcess(
        parent / pacing,
        "--pacing",
        pacing,
        "--set",
        "initial_speed_m_s=20",
        "--set",
        f"loop.cpu={loop_core}",
    )
    bench.runs_for(0.3)
    pid = bench.child("wsp")
    policy = os.sched_getscheduler(pid)
    priority = os.sched_getparam(pid).sched_priority
    cores = os.sched_getaffinity(pid)
    locked_kB = re.search(r"VmLck:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    bench.interrupt()
    bench.finish()
    log = (bench.out / "wsp.log").read_text()
    return Scheduling(
        policy,
        priority,
        refused="SCHED_FIFO" in log,
        memory_is_locked=int(locked_kB.group(1)) > 0,
        memory_refused="locked memory was refused" in log,
        cores=cores,
    )


def test_the_reference_unit_is_as_punctual_as_it_may_in_real_time_only(tmp_path):
    cores = os.sched_getaffinity(0)
    loop_core = min(cores)
    wall = scheduling_of_the_unit("wall", tmp_path, loop_core)
    # a unit that hangs in a computation must not stop the loop
    if wall.policy == os.SCHED_FIFO:
        assert not wall.refused
        assert 0 < wall.priority < 80
    else:
        assert wall.refused
    assert wall.memory_is_locked != wall.memory_refused
    assert wall.cores == (cores - {loop_core} or cores)

    lockstep = scheduling_of_the_unit("lockstep", tmp_path, loop_core)
    assert lockstep == Scheduling(
        os.SCHED_OTHER,
        0,
        refused=False,
        memory_is_locked=False,
        memory_refused=False,
        cores=cores,
    )


# runs a program without CAP_SYS_NICE and with a limit of 0 for real-time priorities
WITHOUT_RIGHTS = (
    sys.executable,
    "-c",
    "import ctypes, os, resource, sys\n"
    "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
    "ctypes.CDLL(None).prctl(24, 23, 0, 0, 0)\n"  # PR_CAPBSET_DROP, CAP_SYS_NICE
    "os.execv(sys.argv[1], sys.argv[1:])",
)


@pytest.mark.nightly
def test_a_unit_that_is_refused_its_priority_reports_it_and_runs(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--wsp",
        "external",
        "--set",
        "initial_speed_m_s=3",
    )
    # the unit has no right to any priority, no matter which user runs this test
    rollerrig = (sys.executable, "-m", "rollerrig.realtime.cli")
    unit = subprocess.Popen(
        [*WITHOUT_RIGHTS, *rollerrig, "wsp", "--bus", bench.address(), "--priority", "60"],
        stdout=subprocess.PIPE,
        text=True,
    )
    bench.finish()
    printed, _ = unit.communicate(timeout=60)
    assert bench.status == 0, bench.stderr
    assert "SCHED_FIFO priority 60 was refused" in printed


# in the table of docs/runs.md, by the code of the event
WORDS = {
    Code.COACH_DERAILED: "the coach derailed",
    Code.UNIT_ENDED: "the process of the unit exited",
    Code.UNIT_FAILED: "the unit failed",
    Code.RECORDER_ENDED: "the recorder lost samples, frames or events, or exited",
    Code.RUN_INTERRUPTED: "SIGINT, SIGTERM or SIGHUP interrupted the run",
    Code.BENCH_KILLED: "its bench was killed",
    Code.UNIT_LOST: "the unit was lost",
    Code.UNIT_SILENT: "the unit was [silent]",
    Code.UNIT_NO_COMMAND: "a unit gave [no valid command]",
    Code.MAGNETS_FOREIGN: "another program than the unit set its magnets",
    Code.NMT_FOREIGN: "another program stopped or reset a unit",
    Code.LOOP_STALLED: "the bench stood still for 1 s or longer",
    Code.UNIT_TWO_SENDERS: "two programs sent the commands of one unit",
    Code.EMERGENCY_STOP_SET: "the emergency stop was set over Modbus",
}


def test_the_page_of_runs_has_every_event_that_makes_a_run_not_valid():
    page = (Path(__file__).parents[2] / "docs/runs.md").read_text(encoding="utf-8")
    section = page.partition("## When a run is not valid")[2].partition("\n## ")[0]
    reasons = [line.split(" | ")[0] for line in section.splitlines() if line.startswith("| ")]
    # events that explain another one, or that end its effect, are no reasons
    explaining = {
        *(Code.FAULT_BEGINS, Code.FAULT_LIFTED, Code.FAULT_NEVER_BEGAN),
        *(Code.UNIT_BACK, Code.UNIT_ANSWERS, Code.EMERGENCY_STOP_RESET),
        Code.RUN_ENDED_BY_HARNESS,
    }
    assert set(validity._RELEVANT) == set(WORDS) | explaining
    for code, words in WORDS.items():
        assert any(words in reason for reason in reasons), code
