"""`rollerrig bench repeat`: whether the sequence of every fault repeats to the byte on busy cores.

A packaged sequence shows each fault of the catalogue. It is played again and again in lockstep,
with the reference unit, while twice as many processes as there are cores compute. Each record is
compared with the first one: the frames of the bus, the rows of the harness, the channels, and the
events. `--count` is how often each sequence is played.
"""

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.table import Table

from rollerrig.configs import store
from rollerrig.configs.processes import children
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.sequence import Sequence

COUNT = 10
BUSY_FOR_EACH_CORE = 2
# files of a record that are compared byte for byte
_FILES = ("can.log", play.TRACE)
# channels of the wall time that ticks took
_WALL_TIMES = "tick_"
# events with a port of this machine
_OF_THE_MACHINE = (Code.BUS_PLACE, Code.BUS_PORT)


@contextlib.contextmanager
def busy_cores() -> Iterator[None]:
    """Keep every core busy with two processes."""
    command = children.command(sys.executable, "-c", "while True: pass")
    count = BUSY_FOR_EACH_CORE * (os.cpu_count() or 1)
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def differences(one: Path, other: Path) -> list[str]:
    """Return what differs between the records of two runs, as sentences; empty if nothing does."""
    found = []
    for name in _FILES:
        if not (one / name).exists() and not (other / name).exists():
            continue
        text = _different_lines(one / name, other / name)
        if text:
            found.append(text)

    first = records.load(one)
    second = records.load(other)
    for name in first.table.column_names:
        if name.startswith(_WALL_TIMES):
            continue
        if not np.array_equal(first.column(name), second.column(name), equal_nan=True):
            found.append(f"channel {name} differs")

    if _events(one) != _events(other):
        found.append("the events differ")
    return found


def _different_lines(one: Path, other: Path) -> str:
    """Return how many lines of two files differ, and the first of them; "" if none does."""
    lines = one.read_text(encoding="utf-8").splitlines()
    others = other.read_text(encoding="utf-8").splitlines()
    if lines == others:
        return ""
    different = [pair for pair in zip(lines, others, strict=False) if pair[0] != pair[1]]
    first = " and ".join(different[0]) if different else "the end of one of them"
    return (
        f"{one.name}: {len(lines)} and {len(others)} lines, {len(different)} of them differ, "
        f"first {first}"
    )


def _events(folder: Path) -> list[tuple[object, ...]]:
    """Return the events of a run, without those that name a port of this machine."""
    return [
        (event.time_s, event.code, event.fields)
        for event in records.events(folder)
        if event.code not in _OF_THE_MACHINE
    ]


def sequences() -> dict[str, str]:
    """Return the packaged sequence that shows each fault of the coach, by the fault's name."""
    shown: dict[str, str] = {}
    for name in store.names("sequences"):
        for step in sequence.load(name, catalogue.parse).steps:
            for text in step.faults:
                shown.setdefault(catalogue.parse(text, COACH).kind.name, name)
    return {name: shown[name] for name in catalogue.of(COACH)}


def run(given: argparse.Namespace, say: Say) -> Result:
    """Play the sequence of each fault `--count` times on busy cores."""
    count = given.count or COUNT
    rows = []
    shown = sequences()
    with busy_cores():
        for number, (fault, name) in enumerate(shown.items(), start=1):
            say(f"{number} of {len(shown)} faults: {name}, {count} times ...")
            rows.append({"fault": fault} | repeat(name, count))
    return {
        "rows": rows,
        "targets": [
            target("runs that differ from the first", sum(row["different"] for row in rows), 0.0),
            target("runs that failed", sum(row["failed"] for row in rows), 0.0),
        ],
        "notes": [f"{row['fault']}: {text}" for row in rows for text in row["notes"]],
    }


def repeat(name: str, count: int) -> Result:
    """Play one sequence `count` times; return how many runs failed or differ from the first."""
    plan: Sequence = sequence.load(name, catalogue.parse)
    notes: list[str] = []
    failed = 0
    different = 0
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="rollerrig-repeat-") as place:
        first: Path | None = None
        for number in range(count):
            folder = Path(place) / str(number)
            outcome = play.on_own_bench(plan, folder)
            if outcome.error:
                failed += 1
                notes.append(f"run {number}: {outcome.error}")
            elif first is None:
                first = folder
            else:
                found = differences(first, folder)
                different += bool(found)
                notes += [f"run {number}: {text}" for text in found]
    return {
        "sequence": name,
        "runs": count,
        "failed": failed,
        "different": different,
        "seconds": (time.monotonic() - begun_s) / count,
        "notes": notes,
    }


def table(result: Result) -> Table:
    """Return one row for each fault."""
    rows = [
        (
            row["fault"],
            row["sequence"],
            row["runs"],
            row["different"],
            row["failed"],
            row["seconds"],
        )
        for row in result["rows"]
    ]
    heads = ("fault", "sequence", "runs", "different", "failed", "s a run")
    return figures.table("sequences on busy cores, each compared with its first run", heads, rows)
