"""A library of sequences that is stopped ends immediately, with a report and without processes."""

import json
import os
import signal

import process_tree
import pytest
from bench_process import until
from short_sequences import WALKING_PACE

from rollerrig.realtime.desk.programs import Program
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

LONG = """title = "A coach that rolls for an hour"
criteria = "none"
[start]
speed = "200 km/h"
adhesion = "dry"
[[step]]
for = "3000 s"
"""
# size of a can.log after the harness has joined, in bytes
A_FEW_CYCLES = 50_000
LONG_NAMES = ("b_long", "c_long", "d_long", "e_long", "f_long")


def interrupt_as_the_desk_does(program):
    """Interrupt the program, but not its workers and benches."""
    program.stop()


def interrupt_as_a_terminal_does(program):
    """Interrupt the program with all its workers, benches and units, as Ctrl-C does."""
    os.killpg(program.pid, signal.SIGINT)


def terminate(program):
    os.kill(program.pid, signal.SIGTERM)


@pytest.mark.parametrize(
    ("interrupt", "jobs", "name"),
    [
        pytest.param(interrupt_as_the_desk_does, 2, "SIGINT", marks=pytest.mark.nightly),
        pytest.param(interrupt_as_a_terminal_does, 2, "SIGINT", marks=pytest.mark.nightly),
        (terminate, 1, "SIGTERM"),
    ],
)
def test_an_interrupted_library_plays_nothing_more_reports_what_was_played_and_leaves_no_process(
    interrupt, jobs, name, tmp_path
):
    library = tmp_path / "library"
    library.mkdir()
    (library / "a_short.toml").write_text(WALKING_PACE)
    for long_name in LONG_NAMES:
        (library / f"{long_name}.toml").write_text(LONG)
    out = tmp_path / "out"
    words = ["sequence", str(library), "--out", str(out), "--jobs", str(jobs)]
    program = Program([*words, "--wsp", "none"], tmp_path)

    def playing():
        """The folders of the runs that play, as soon as the short sequence has been played."""
        assert program.status is None, program.lines
        is_played = any("a_short" in line for line in program.lines)
        logs = [log for log in out.glob("*_long/can.log") if log.stat().st_size > A_FEW_CYCLES]
        return [log.parent for log in logs] if is_played and len(logs) == jobs else None

    begun = until(playing, "sequences that play")
    processes = [program.pid, *process_tree.descendants(program.pid)]
    assert len(processes) >= 1 + jobs
    interrupt(program)
    until(lambda: program.status is not None, "the end of the program")
    until(
        lambda: not any(map(process_tree.is_running, processes)), "the end of all processes", 60.0
    )

    assert program.status == 4, program.lines
    assert not any("Traceback" in line for line in program.lines)
    result = program.result
    assert result["interrupted"] == name
    assert result["result"] == "error"
    assert result["sequences"]["a_short"] == "pass"
    begun_names = {folder.name for folder in begun}
    assert set(result["not_played"]) == set(LONG_NAMES) - begun_names
    # nothing that was queued has begun
    assert {folder.name for folder in out.iterdir() if folder.is_dir()} == {"a_short", *begun_names}

    report = json.loads((out / "report.json").read_text())
    by_name = {one["name"]: one for one in report["sequences"]}
    assert by_name["a_short"]["result"] == "pass"
    for folder in begun:
        assert "interrupted at " in by_name[folder.name]["error"]
        assert (folder / "harness.csv").stat().st_size > 1000
        # the bench has completed its record
        run = records.load(folder)
        assert run.summary["ended"] == "interrupted"
        assert run.summary["valid"] is False
        assert any(event.code == Code.RUN_INTERRUPTED for event in run.events)
    for not_played in result["not_played"]:
        assert "the sequences were interrupted" in by_name[not_played]["error"]
    assert "a_short" in (out / "report.html").read_text()
