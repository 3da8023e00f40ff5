"""No process outlives a parent that is killed.

On a full disk only what could not be written is lost.
"""

import json
import os
import resource
import signal
import subprocess
import sys

import pytest
from bench_process import BenchProcess, until
from endurance import runs

from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

RECORDER = "rollerrig.realtime.telemetry.recorder"


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "rollerrig.realtime.cli", *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def killed(process, *words):
    """Kill a process once it has descendants whose commands have all of these words.

    All of them exit.
    """

    def descendants():
        assert process.poll() is None
        found = runs.descendants(process.pid)
        commands = list(found.values())
        complete = all(any(word in command for command in commands) for word in words)
        return found if complete else None

    there = until(descendants, f"processes with {words}")
    process.kill()
    process.wait()
    try:
        until(lambda: not any(map(runs.is_running, there)), f"the end of {there}", 60.0)
    finally:
        for pid in filter(runs.is_running, there):
            os.kill(pid, signal.SIGKILL)
    return there


def test_a_sequence_that_is_killed_takes_its_workers_benches_and_units_along_and_keeps_records(
    tmp_path,
):
    process = start(
        "sequence", "low_speed_010", "emergency_120", "--jobs", 2, "--out", tmp_path / "out"
    )
    until(lambda: list(tmp_path.glob("out/*/can.log")), "a run that has begun")
    there = killed(process, "spawn_main", " run ", " wsp ", RECORDER)
    assert len(there) >= 5
    begun = [folder for folder in (tmp_path / "out").iterdir() if (folder / "can.log").is_file()]
    assert begun
    for folder in begun:
        assert records.summary(folder)["ended"] in ("interrupted", "killed")
        assert not (folder / "channels.tail").exists()


@pytest.mark.parametrize("verb", ["explain", "campaign"])
def test_a_verb_with_workers_that_is_killed_takes_them_along(verb, tmp_path):
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
        ("no_such_program {port}", ("status 1", "no_such_program: No such file or directory")),
    ],
)
def test_a_unit_command_that_dies_is_told_at_once_with_its_status_and_last_words(
    command, words, tmp_path, capfd
):
    assert (
        cli.main(
            [
                "sequence",
                "low_speed_010",
                "--wsp",
                "external",
                "--unit",
                command,
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 1
    )
    printed = capfd.readouterr().err
    for word in ("--unit", command, *words):
        assert word in printed
    assert "rollerrig wsp" not in printed


def test_drives_that_wait_for_a_master_that_is_not_there_are_told_after_a_second(tmp_path):
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
    assert (event.time_s, event.level) == (1.0, "warning")
    assert event.fields["nodes"] == [1, 2, 3, 4]
    for word in ("nodes 1, 2, 3, 4", "6040h", "--set rig.drives=rig"):
        assert word in event.text


def test_a_run_that_has_not_begun_has_loaded_its_bus_by_nothing(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--wait", "0.5"
    ).finish()
    assert bench.status == 2
    assert records.summary(bench.out)["bus"]["load_percent"] == 0.0


# --- a full disk: a limit of the file size of the writing process, because rings in memory are files too ---


def full(pid, size=20_000):
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@pytest.mark.parametrize("pacing", ["wall", "lockstep"])
def test_a_disk_that_gets_full_is_an_event_and_status_2_and_what_was_recorded_is_kept(
    pacing, tmp_path
):
    bench = BenchProcess(tmp_path / "run", "--pacing", pacing, "--set", "duration_max_s=4")
    bench.runs_for(0.5)
    full(bench.child(RECORDER))
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


def test_a_summary_that_cannot_be_written_is_told_with_status_2(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", "duration_max_s=2")
    bench.runs_for(0.5)
    full(bench.process.pid, 2000)  # its messages, which go to a file here, fit
    bench.finish()
    assert bench.status == 2
    assert "Traceback" not in bench.stderr
    assert "summary is lost" in bench.result["error"]
    assert bench.record.column("time_s")[-1] > 1.9


@pytest.mark.parametrize("size", ["64k", "3m"])
def test_a_small_disk_is_told_with_status_2_from_the_start_or_when_it_is_full(size, tmp_path):
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
