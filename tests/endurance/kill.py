"""Processes of short runs are killed at random moments: what is lost, what is left over, is the folder readable.

Lost is what the rings in shared memory had at that moment (or at the end of a run that went on) and the folder has not:
samples and frames, in s of the run. Left over is any process of the run that lives when all should have ended.
"""

import argparse
import os
import random
import signal
import time
from typing import Any

from rich.table import Table

from endurance import runs
from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records

KILLS, LOST_S = 100, 1.0
_RUN_S, _LATEST_S, _PATIENCE_S = 4.0, 3.0, 120.0


# whom it hits, or which signal the bench
HOW = (
    "bench",
    "recorder",
    "unit",
    "group",
    "recorder + bench",
    "recorder + unit + bench",
    "SIGTERM",
    "SIGHUP",
    "SIGINT",
)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Kill runs one after another, each way in turn, in both pacings."""
    source, kills = random.Random(given.seed), []
    for at in range(given.count or KILLS):
        how, pacing = HOW[at % len(HOW)], ("wall", "lockstep")[at // len(HOW) % 2]
        if at % 10 == 0:
            say(f"{at} of {given.count or KILLS} kills ...")
        kills.append(
            {"how": how, "pacing": pacing} | killed(how, pacing, source.uniform(0.0, _LATEST_S))
        )
    return {
        "kills": kills,
        "targets": [
            target("lost by a kill, the most", max(one["lost_s"] for one in kills), LOST_S, "s"),
            target("processes left over", float(sum(one["left"] for one in kills)), 0.0),
            target(
                "folders that cannot be read",
                float(sum(bool(one["unreadable"]) for one in kills)),
                0.0,
            ),
            target("tracebacks", float(sum(one["traceback"] for one in kills)), 0.0),
        ],
        "notes": [
            f"{one['how']}, {one['pacing']}, at {one['at_s']:.3f} s: {one['unreadable']}"
            for one in kills
            if one["unreadable"]
        ],
    }


def killed(how: str, pacing: str, at_s: float) -> dict[str, Any]:
    """One run that is killed when it has simulated so many seconds."""
    with runs.started("--pacing", pacing, seconds=_RUN_S) as run:
        rows = run.until(run.rows, "its first sample")
        members = run.until(
            lambda: found if len(found := run.members()) == 1 + len(runs.ROLES) else None,
            "its unit",
        )
        run.until(lambda: runs.last_s(rows) >= at_s or None, f"{at_s:.3f} s")
        at_s = runs.last_s(rows)
        by = getattr(signal, how, signal.SIGKILL)
        if how == "group":
            os.killpg(run.process.pid, by)
        for role in (
            ("bench",) if by != signal.SIGKILL else how.split(" + ") if how != "group" else ()
        ):
            os.kill(members[role], by)
        run.process.wait(_PATIENCE_S)
        end_s = time.monotonic() + _PATIENCE_S
        while (left := list(filter(runs.alive, members.values()))) and time.monotonic() < end_s:
            time.sleep(0.02)
        # a run whose recorder is killed goes on, and nobody records it
        lost_s, unreadable = _missing(run, at_s if how == "recorder" else runs.last_s(rows))
        return {
            "at_s": at_s,
            "lost_s": lost_s,
            "left": len(left),
            "unreadable": unreadable,
            "traceback": int("Traceback" in run.words()),
        }


def _missing(run: runs.Run, known_s: float) -> tuple[float, str]:
    """Seconds that channels or can.log lack, and what is wrong with the folder."""
    try:
        time_s = records.load(run.folder).column("time_s")
        heard_s = 1e-6 * max((stamp_us for stamp_us, *_ in records.frames(run.folder)), default=0)
    except (RollerrigError, OSError, ValueError) as error:
        return known_s, str(error)
    return max(known_s - float(time_s[-1] if len(time_s) else 0.0), known_s - heard_s, 0.0), ""


def table(result: Result) -> Table:
    """The kills by what was killed."""
    by_what = {how: [one for one in result["kills"] if one["how"] == how] for how in HOW}
    heads = "what", "kills", "lost, s, median", "most", "processes left", "readable"
    return figures.table(
        "killed runs",
        heads,
        [
            (
                how,
                len(these),
                *(
                    figures.quantiles([one["lost_s"] for one in these])[share]
                    for share in ("p50", "max")
                ),
                sum(one["left"] for one in these),
                sum(not one["unreadable"] for one in these),
            )
            for how, these in by_what.items()
            if these
        ],
    )
