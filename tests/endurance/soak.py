"""`rollerrig bench soak`: what long runs take, in real time and in lockstep.

Measured are the memory of every process, disk, missed ticks, and what is lost. Memory is what a
process has for itself (RssAnon), against simulated time. Growth is the difference of the medians of
the middle and the last third of a run: what is needed once, at the beginning, does not count. What
is needed at the end, for summary and recording, is reported separately. Lockstep simulates hours in
a shorter time, so its figures are judged.
"""

import argparse
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from endurance import runs
from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records

# of both pacings together, where --seconds does not give it
SECONDS = 480.0
PACINGS = ("wall", "lockstep")
ROLES = ("bench", *runs.ROLES)
# requirement: growth of a process in a simulated hour
GROWTH_MB_H = 10.0
# seconds between two looks at the memory; while the run stops, between two of those
_LOOK_EVERY_S = 0.5
_LOOK_AT_END_EVERY_S = 0.02
_ANONYMOUS = re.compile(r"RssAnon:\s+(\d+) kB")


def run(given: argparse.Namespace, say: Say) -> Result:
    """Let the bench run for half of the seconds in each pacing."""
    seconds = given.seconds / len(PACINGS)
    found: Result = {pacing: _soaked(pacing, seconds, say) for pacing in PACINGS}
    growth_MB_h = found["lockstep"]["growth_MB_h"]
    lost = sum(found[pacing]["dropped"] + found[pacing]["lost"] for pacing in PACINGS)
    tracebacks = sum(found[pacing]["traceback"] for pacing in PACINGS)
    targets = [
        target(f"growth of the {role} in lockstep", grown, GROWTH_MB_H, "MB/h")
        for role, grown in growth_MB_h.items()
    ]
    targets.append(target("frames, samples and events lost", lost, 0.0))
    targets.append(target("runs with a traceback", tracebacks, 0.0))
    return found | {
        "targets": targets,
        "notes": [
            "growth per simulated hour; from a few minutes in real time it means little",
            "at the end: the largest memory while summary and recording were written",
        ],
    }


def _soaked(pacing: str, seconds: float, say: Say) -> Result:
    """Return the figures of a run in a pacing that is stopped after some seconds of wall time."""
    say(f"{seconds:g} s in {pacing} ...")
    with runs.started("--pacing", pacing) as run:
        rows = run.wait_for(run.rows, "its first sample")
        processes = run.processes()
        end_s = time.monotonic() + seconds
        missing = set(ROLES) - set(processes)
        if missing:
            raise RollerrigError(
                f"the run has no {' and no '.join(missing)}: {run.stderr()[-300:]}"
            )

        samples = []
        while time.monotonic() < end_s and run.process.poll() is None:
            memory_MB = [_memory_MB(processes[role]) for role in ROLES]
            samples.append([runs.last_s(rows), *memory_MB])
            time.sleep(_LOOK_EVERY_S)
        simulated_s = runs.last_s(rows)

        run.process.terminate()
        at_end_MB = dict.fromkeys(ROLES, 0.0)
        while run.process.poll() is None:
            for role in ROLES:
                at_end_MB[role] = max(at_end_MB[role], _memory_MB(processes[role]))
            time.sleep(_LOOK_AT_END_EVERY_S)
        return _judged(run, np.array(samples), simulated_s, at_end_MB)


def _judged(
    run: runs.Run, samples: np.ndarray, simulated_s: float, at_end_MB: dict[str, float]
) -> Result:
    """Return the figures of a run that has stopped.

    `samples`: simulated time in s and memory in MB of each role, shape (n, 1 + roles).
    """
    _, middle_third, last_third = np.array_split(samples, 3)
    middle = np.median(middle_third, axis=0)
    last = np.median(last_third, axis=0)
    growth_MB_h = 3600.0 * (last[1:] - middle[1:]) / (last[0] - middle[0])
    memory: dict[str, Any] = {
        "memory_MB": dict(zip(ROLES, map(float, last[1:]), strict=True)),
        "growth_MB_h": dict(zip(ROLES, map(float, growth_MB_h), strict=True)),
        "at_end_MB": at_end_MB,
    }

    hours = simulated_s / 3600.0
    events = records.events(run.folder)
    summary = records.summary(run.folder)
    disk_MB = sum(path.stat().st_size for path in run.folder.iterdir()) / 1e6
    return memory | {
        "simulated_s": simulated_s,
        "events_h": len(events) / hours,
        "disk_MB_h": disk_MB / hours,
        "missed": summary["loop"]["missed"],
        "ticks": summary["loop"]["ticks"],
        "frames": summary["bus"]["frames"],
        "dropped": summary["bus"]["dropped"],
        "lost": summary["recorder"]["lost"],
        "vents": summary["wsp"]["vents"],
        "traceback": int("Traceback" in run.stderr()),
        "because": summary["invalid_because"],
    }


def _memory_MB(pid: int) -> float:
    """Return the anonymous memory of a process; 0 of one that has exited."""
    try:
        found = _ANONYMOUS.search(Path(f"/proc/{pid}/status").read_text(encoding="utf-8"))
    except OSError:
        return 0.0
    return int(found[1]) / 1024.0 if found else 0.0


def table(result: Result) -> Table:
    """Return both pacings side by side."""
    sides = [result[pacing] for pacing in PACINGS]
    rows: list[list[object]] = [["simulated, s", *(side["simulated_s"] for side in sides)]]
    for role in ROLES:
        for text, key in (
            ("memory, MB", "memory_MB"),
            ("growth, MB/h", "growth_MB_h"),
            ("at the end, MB", "at_end_MB"),
        ):
            rows.append([f"{role}: {text}", *(side[key][role] for side in sides)])
    for text, key in (
        ("disk, MB/h", "disk_MB_h"),
        ("events per hour", "events_h"),
        ("ticks", "ticks"),
        ("ticks missed", "missed"),
        ("vents", "vents"),
        ("frames", "frames"),
        ("frames that a client did not get", "dropped"),
        ("rows, frames and events that were not recorded", "lost"),
    ):
        rows.append([text, *(side[key] for side in sides)])
    return figures.table("long runs", ("what", *PACINGS), rows)
