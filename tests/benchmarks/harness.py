"""`rollerrig bench harness`: what a scripted sequence costs the real-time loop.

The same stop runs alternately without and with a harness, in wall pacing, each in a separate bench
process with the reference WSP unit. The harness joins, brakes, and receives the frames of every
cycle. The figures come from the summaries of the benches.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.table import Table

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.wsp_interface import own_bench

SCENARIO = "velim_a1"
BRAKE_BAR = 3.8
_SLICE_S = 10.0
# exit status of a run that is valid, and of one that did not stop in its time
_COMPLETE = (0, 4)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run both alternately for the requested seconds."""
    rounds = max(1, round(given.seconds / (2.0 * _SLICE_S)))
    seconds = max(2.0, given.seconds / (2.0 * rounds))
    without: list[Result] = []
    joined: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="rollerrig-harness-") as place:
        for number in range(rounds):
            say(
                f"{seconds:g} s without a harness, {seconds:g} s with one "
                f"({number + 1} of {rounds}) ..."
            )
            folder = Path(place) / f"alone-{number}"
            without.append(alone(folder, seconds, "modbus.enabled=false"))

            folder = Path(place) / f"joined-{number}"
            with own_bench.start(folder, SCENARIO, pacing="wall") as harness:
                harness.brake(bar=BRAKE_BAR)
                harness.wait(seconds)
            joined.append(_loop(folder))

    without_harness = total(without)
    with_harness = total(joined)
    return {
        "without": without_harness,
        "with": with_harness,
        "targets": [
            target(
                "missed ticks per thousand that a sequence adds",
                with_harness["missed_per_mille"] - without_harness["missed_per_mille"],
                0.0,
            )
        ],
        "notes": [
            "if other programs use the cores, ticks are missed in both; compare the two columns"
        ],
    }


def alone(folder: Path, seconds: float, setting: str = "modbus.port=0") -> Result:
    """Run for some seconds in a separate process, without a harness; return the loop's figures."""
    settings = (
        f"duration_max_s={seconds}",
        "bus.interface=hub",
        "bus.socketcand_port=0",
        setting,
    )
    words = [sys.executable, "-m", "rollerrig.realtime.cli"]
    words += ["run", SCENARIO, "--out", str(folder), "--json"]
    for one in settings:
        words += ["--set", one]
    process = subprocess.run(
        children.command(*words),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    if process.returncode not in _COMPLETE:
        raise RollerrigError(f"the run has failed: {process.stderr.strip().splitlines()[-1:]}")
    return _loop(folder)


def _loop(folder: Path) -> Result:
    """Return `loop` of the summary of a run."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return dict(summary["loop"])


def total(runs: list[Result]) -> Result:
    """Return the figures of all rounds together; a lateness is the worst of them."""
    ticks = sum(run["ticks"] for run in runs)
    missed = sum(run["missed"] for run in runs)
    worst_us = {
        name: max(run["lateness_us"][name] for run in runs) for name in runs[0]["lateness_us"]
    }
    return {
        "ticks": ticks,
        "missed": missed,
        "missed_per_mille": 1000.0 * missed / ticks,
        "lateness_us": worst_us,
    }


def table(result: Result) -> Table:
    """Return both runs side by side; a lateness is the worst of the rounds."""
    return side_by_side(result, "the loop with and without a sequence", "with a harness")


def side_by_side(result: Result, title: str, head: str) -> Table:
    """Return a table of the loop's figures `without` and `with` a load; `head` names the load."""
    sides = (result["without"], result["with"])
    rows: list[tuple[object, ...]] = [
        ("ticks", *(side["ticks"] for side in sides)),
        ("ticks missed", *(side["missed"] for side in sides)),
    ]
    for name in sides[0]["lateness_us"]:
        rows.append((f"lateness {name}, us", *(side["lateness_us"][name] for side in sides)))
    return figures.table(title, ("what", "without", head), rows)
