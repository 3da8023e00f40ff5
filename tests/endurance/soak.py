"""What long runs take: memory of every process, disk, missed ticks, what is lost; in real time and in lockstep.

Memory is what a process has for itself (RssAnon), against simulated time. Growth is between the middle third of a run
and its last, medians of each: what is needed once, at the beginning, does not count, and what is needed at the end for
summary and recording is told beside. Lockstep simulates hours in less: its figures are judged.
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

SECONDS, PACINGS, ROLES = 480.0, ("wall", "lockstep"), ("bench", *runs.ROLES)
GROWTH_MB_H = 10.0
_LOOK_S = 0.5
_ANONYMOUS = re.compile(r"RssAnon:\s+(\d+) kB")


def run(given: argparse.Namespace, say: Say) -> Result:
    """Let the bench run for half of the seconds in each pacing."""
    found = {pacing: _soaked(pacing, given.seconds / len(PACINGS), say) for pacing in PACINGS}
    lockstep = found["lockstep"]["growth_MB_h"]
    lost = sum(one["dropped"] + one["lost"] for one in found.values())
    return found | {
        "targets": [
            *(
                target(f"growth of the {role} in lockstep", grown, GROWTH_MB_H, "MB/h")
                for role, grown in lockstep.items()
            ),
            target("frames, samples and events lost", lost, 0.0),
            target("runs with a traceback", sum(one["traceback"] for one in found.values()), 0.0),
        ],
        "notes": [
            "growth in a simulated hour; of a few minutes in real time it says little",
            "at the end: the most that it had while it wrote summary and recording",
        ],
    }


def _soaked(pacing: str, seconds: float, say: Say) -> Result:
    say(f"{seconds:g} s in {pacing} ...")
    with runs.started("--pacing", pacing) as run:
        rows = run.until(run.rows, "its first sample")
        members, seen, end_s = run.members(), [], time.monotonic() + seconds
        if set(members) != set(ROLES):
            raise RollerrigError(
                f"the run has no {' and no '.join(set(ROLES) - set(members))}: {run.words()[-300:]}"
            )
        while time.monotonic() < end_s and run.process.poll() is None:
            seen.append([runs.last_s(rows), *(_memory_MB(members[role]) for role in ROLES)])
            time.sleep(_LOOK_S)
        taken, simulated_s = np.array(seen), runs.last_s(rows)
        run.process.terminate()
        most = dict.fromkeys(ROLES, 0.0)
        while run.process.poll() is None:
            most = {role: max(most[role], _memory_MB(members[role])) for role in ROLES}
            time.sleep(0.02)
        return _judged(run, taken, simulated_s, most)


def _judged(run: runs.Run, taken: np.ndarray, simulated_s: float, most: dict[str, float]) -> Result:
    hours, events = simulated_s / 3600.0, records.events(run.folder)
    summary = records.summary(run.folder)
    thirds = np.array_split(taken, 3)
    middle, last = (np.median(one, axis=0) for one in thirds[1:])
    growth = 3600.0 * (last[1:] - middle[1:]) / (last[0] - middle[0])
    disk_MB = sum(path.stat().st_size for path in run.folder.iterdir()) / 1e6
    memory: dict[str, Any] = {
        "memory_MB": dict(zip(ROLES, map(float, last[1:]), strict=True)),
        "growth_MB_h": dict(zip(ROLES, map(float, growth), strict=True)),
        "at_end_MB": most,
    }
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
        "traceback": int("Traceback" in run.words()),
        "because": summary["invalid_because"],
    }


def _memory_MB(pid: int) -> float:
    try:
        found = _ANONYMOUS.search(Path(f"/proc/{pid}/status").read_text(encoding="utf-8"))
    except OSError:
        found = None
    return int(found[1]) / 1024.0 if found else 0.0


def table(result: Result) -> Table:
    """Both pacings side by side."""
    sides = [result[pacing] for pacing in PACINGS]
    rows: list[list[object]] = [["simulated, s", *(one["simulated_s"] for one in sides)]]
    rows += [
        [f"{role}: {text}", *(one[key][role] for one in sides)]
        for role in ROLES
        for text, key in (
            ("memory, MB", "memory_MB"),
            ("growth, MB/h", "growth_MB_h"),
            ("at the end, MB", "at_end_MB"),
        )
    ]
    rows += [
        [text, *(one[key] for one in sides)]
        for text, key in (
            ("disk, MB/h", "disk_MB_h"),
            ("events an hour", "events_h"),
            ("ticks", "ticks"),
            ("ticks missed", "missed"),
            ("vents", "vents"),
            ("frames", "frames"),
            ("frames that somebody did not get", "dropped"),
            ("rows, frames and events that were not recorded", "lost"),
        )
    ]
    return figures.table("long runs", ("what", *PACINGS), rows)
