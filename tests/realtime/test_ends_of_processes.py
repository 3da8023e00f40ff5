"""No process outlives a parent that is killed, and a full disk costs only the unwritten data."""

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import process_tree
import program
import pytest
from bench_process import BenchProcess, until

from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

RECORDER = "rollerrig.realtime.telemetry.recorder"


def start(*arguments):
    nowhere = Path(os.devnull)
    return program.start(list(map(str, arguments)), nowhere, nowhere)


def killed(process, *words):
    """Kill a process once the commands of its descendants contain all of these words.

    Checks that all descendants exit, and returns them.
    """

    def descendants():
        assert process.poll() is None
        commands_by_pid = process_tree.descendants(process.pid)
        all_commands = "\n".join(commands_by_pid.values())
        complete = all(word in all_commands for word in words)
        return commands_by_pid if complete else None

    running = until(descendants, f"processes with {words}")
    process.kill()
    process.wait()
    try:
        until(lambda: not any(map(process_tree.is_running, running)), f"the end of {running}", 60.0)
    finally:
        for pid in filter(process_tree.is_running, running):
            os.kill(pid, signal.SIGKILL)
    return running


@pytest.mark.nightly
def test_workers_benches_and_units_of_a_killed_sequence_exit_and_their_records_are_kept(tmp_path):
    process = start(
        "sequence", "low_speed_010", "emergency_120", "--jobs", 2, "--out", tmp_path / "out"
    )
    until(lambda: list(tmp_path.glob("out/*/can.log")), "a run that has begun")
    descendants = killed(process, "spawn_main", " run ", " wsp ", RECORDER)
    assert len(descendants) >= 5
    begun = [folder for folder in (tmp_path / "out").iterdir() if (folder / "can.log").is_file()]
    assert begun
    for folder in begun:
        assert records.summary(folder)["ended"] in ("interrupted", "killed")
        assert not (folder / "channels.tail").exists()


@pytest.mark.parametrize("verb", [pytest.param("explain", marks=pytest.mark.nightly), "campaign"])
def test_the_workers_of_a_killed_verb_exit(verb, tmp_path):
    if verb == "explain":
        process = start("explain", "open_rail_cleaning", "--out", tmp_path / "out")
    else:
        process = start("campaign", "low_adhesion", "--workers", 2, "--out", tmp_path / "out")
    killed(process, "spawn_main")


def test_a_run_that_is_killed_while_its_unit_is_frozen_leaves_no_process(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "wall",
        "--set",
        "duration_max_s=60",
        "--fault",
        "wsp_frozen at=0.5",
    )
    bench.runs_for(0.8)
    killed(bench.process, " wsp ", RECORDER)
    assert records.summary(bench.out)["ended"] == "killed"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("sh -c 'echo no such port >&2; exit 3'", ("status 3", "no such port")),
        pytest.param(
            "no_such_program {port}",
            ("status 1", "no_such_program: No such file or directory"),
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_a_unit_command_that_exits_is_reported_immediately_with_its_status_and_last_output(
    command, words, tmp_path, capfd
):
    arguments = ["sequence", "low_speed_010", "--wsp", "external", "--unit", command]
    status = cli.main([*arguments, "--out", str(tmp_path / "out")])
    assert status == 1
    printed = capfd.readouterr().err
    for word in ("--unit", command, *words):
        assert word in printed
    assert "rollerrig wsp" not in printed


def test_drives_that_wait_for_a_missing_master_are_reported_after_a_second(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--wsp",
        "none",
        "--set",
        "rig.drives=bus",
        "--set",
        "duration_max_s=1.5",
    ).finish()
    (event,) = bench.reported(Code.DRIVES_WITHOUT_MASTER)
    assert event.time_s == 1.0
    assert event.level == "warning"
    assert event.fields["nodes"] == [1, 2, 3, 4]
    for word in ("nodes 1, 2, 3, 4", "6040h", "--set rig.drives=rig"):
        assert word in event.text


def test_a_run_that_has_not_begun_reports_a_bus_load_of_zero(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--wait", "0.5"
    ).finish()
    assert bench.status == 2
    assert records.summary(bench.out)["bus"]["load_percent"] == 0.0


# --- a full disk ---


def limit_file_size(pid, size=20_000):
    """Let a process write no file beyond this size: for it, the disk is full.

    The limit is set on a running process only, because rings in memory are files too.
    """
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@pytest.mark.parametrize("pacing", [pytest.param("wall", marks=pytest.mark.nightly), "lockstep"])
def test_a_disk_that_gets_full_is_an_event_and_status_2_and_the_record_is_kept(pacing, tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", pacing, "--set", "duration_max_s=4")
    bench.runs_for(0.5)
    limit_file_size(bench.child(RECORDER))
    bench.finish()
    assert bench.status == 2
    assert "Traceback" not in bench.stderr
    for word in (str(bench.out), "cannot be written: File too large", "--out", "is kept"):
        assert word in bench.result["error"]
    assert bench.record.column("time_s")[-1] >= 0.5
    assert (bench.out / "can.log").stat().st_size > 1000
    summary = records.summary(bench.out)
    assert summary["loop"]["ticks"] == 4000
    (ended,) = [event for event in summary["events"] if event["code"] == Code.RECORDER_ENDED]
    assert ended["level"] == "error"
    assert "cannot be written" in ended["fields"]["reason"]


def test_a_summary_that_cannot_be_written_is_reported_with_status_2(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", "duration_max_s=2")
    bench.runs_for(0.5)
    # the messages of the bench, which go to a file in this test, are shorter than that
    limit_file_size(bench.process.pid, 2000)
    bench.finish()
    assert bench.status == 2
    assert "Traceback" not in bench.stderr
    assert "summary is lost" in bench.result["error"]
    assert bench.record.column("time_s")[-1] > 1.9


@pytest.mark.nightly
@pytest.mark.parametrize("size", ["64k", "3m"])
def test_a_small_disk_is_reported_with_status_2_at_the_start_or_when_it_is_full(size, tmp_path):
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", place]
    if subprocess.run(mount, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no file system may be mounted here")
    try:
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "rollerrig.realtime.cli",
                "run",
                "velim_a1",
                "--pacing",
                "lockstep",
                "--out",
                str(place / "run"),
                "--json",
                "--set",
                "bus.interface=hub",
                "--set",
                "bus.socketcand_port=0",
            ],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=100.0,
        )
        assert done.returncode == 2
        assert "Traceback" not in done.stderr
        assert "No space left on device" in json.loads(done.stdout)["error"]
        if size == "3m":
            assert len(records.load(place / "run").table) > 50
    finally:
        subprocess.run(["umount", place], check=True)
