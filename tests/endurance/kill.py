"""`rollerrig bench kill`: processes of short runs are killed at random moments.

Three questions: what is lost, which processes are left over, and can the folder be read? Lost are
samples and frames, in s of the run, that the rings in shared memory had at that moment (or at the
end of a run that continued) and that the folder does not have. Left over is any process of the run
that still runs when all should have exited.
"""

import argparse
import os
import random
import signal
import time
from typing import Any

import process_tree
from rich.table import Table

from endurance import runs
from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records

KILLS = 100
# requirement: the most that a kill may cost
LOST_S = 1.0
# duration of a run, and the latest moment of a kill
_RUN_S = 4.0
_LATEST_S = 3.0
# seconds that processes have to exit
_EXIT_WITHIN_S = 120.0
GROUP = "group"
# which processes get SIGKILL (GROUP: the whole process group), or which signal the bench gets
HOW = (
    "bench",
    "recorder",
    "unit",
    GROUP,
    "recorder + bench",
    "recorder + unit + bench",
    "SIGTERM",
    "SIGHUP",
    "SIGINT",
)
PACINGS = ("wall", "lockstep")


def run(given: argparse.Namespace, say: Say) -> Result:
    """Kill runs one after another, in each way of `HOW` in turn, in both pacings."""
    source = random.Random(given.seed)
    count = given.count or KILLS
    kills = []
    for number in range(count):
        how = HOW[number % len(HOW)]
        pacing = PACINGS[number // len(HOW) % len(PACINGS)]
        if number % 10 == 0:
            say(f"{number} of {count} kills ...")
        found = killed(how, pacing, source.uniform(0.0, _LATEST_S))
        kills.append({"how": how, "pacing": pacing} | found)

    unreadable = [kill for kill in kills if kill["unreadable"]]
    return {
        "kills": kills,
        "targets": [
            target("lost by a kill, the most", max(kill["lost_s"] for kill in kills), LOST_S, "s"),
            target("processes left over", float(sum(kill["left"] for kill in kills)), 0.0),
            target("folders that cannot be read", float(len(unreadable)), 0.0),
            target("tracebacks", float(sum(kill["traceback"] for kill in kills)), 0.0),
        ],
        "notes": [
            f"{kill['how']}, {kill['pacing']}, at {kill['at_s']:.3f} s: {kill['unreadable']}"
            for kill in unreadable
        ],
    }


def killed(how: str, pacing: str, at_s: float) -> dict[str, Any]:
    """Kill one run when it has simulated `at_s` seconds; return what was lost and left."""
    with runs.started("--pacing", pacing, seconds=_RUN_S) as run:
        rows = run.wait_for(run.rows, "its first sample")

        def all_processes() -> dict[str, int] | None:
            found = run.processes()
            return found if len(found) == 1 + len(runs.ROLES) else None

        processes = run.wait_for(all_processes, "its unit")
        run.wait_for(lambda: runs.last_s(rows) >= at_s, f"{at_s:.3f} s")
        at_s = runs.last_s(rows)
        _kill(how, processes)
        run.process.wait(_EXIT_WITHIN_S)
        left = _still_running(list(processes.values()))

        # a run whose recorder is killed continues, and nobody records it
        known_s = at_s if how == "recorder" else runs.last_s(rows)
        lost_s, unreadable = _missing(run, known_s)
        return {
            "at_s": at_s,
            "lost_s": lost_s,
            "left": len(left),
            "unreadable": unreadable,
            "traceback": int("Traceback" in run.stderr()),
        }


def _kill(how: str, processes: dict[str, int]) -> None:
    """Kill processes in one of the ways of `HOW`; `processes`: their numbers by role."""
    if how == GROUP:
        os.killpg(processes["bench"], signal.SIGKILL)
    elif how.startswith("SIG"):
        os.kill(processes["bench"], getattr(signal, how))
    else:
        for role in how.split(" + "):
            os.kill(processes[role], signal.SIGKILL)


def _still_running(pids: list[int]) -> list[int]:
    """Wait until the processes have exited; return those that still run after a while."""
    end_s = time.monotonic() + _EXIT_WITHIN_S
    while True:
        left = [pid for pid in pids if process_tree.is_running(pid)]
        if not left or time.monotonic() >= end_s:
            return left
        time.sleep(0.02)


def _missing(run: runs.Run, known_s: float) -> tuple[float, str]:
    """Return the seconds that channels or can.log lack; why the folder is unreadable, or ""."""
    try:
        time_s = records.load(run.folder).column("time_s")
        stamps_us = [stamp_us for stamp_us, *_ in records.frames(run.folder)]
    except (RollerrigError, OSError, ValueError) as error:
        return known_s, str(error)
    last_row_s = float(time_s[-1]) if len(time_s) else 0.0
    last_frame_s = 1e-6 * max(stamps_us, default=0)
    return max(known_s - last_row_s, known_s - last_frame_s, 0.0), ""


def table(result: Result) -> Table:
    """Return the kills by what was killed."""
    rows = []
    for how in HOW:
        kills = [kill for kill in result["kills"] if kill["how"] == how]
        if not kills:
            continue
        lost_s = figures.quantiles([kill["lost_s"] for kill in kills])
        left = sum(kill["left"] for kill in kills)
        readable = sum(not kill["unreadable"] for kill in kills)
        rows.append((how, len(kills), lost_s["p50"], lost_s["max"], left, readable))
    heads = ("what", "kills", "lost, s, median", "most", "processes left", "readable")
    return figures.table("killed runs", heads, rows)
