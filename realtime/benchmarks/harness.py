"""What a scripted sequence costs the real-time loop: the same stop with and without a harness.

The two run by turns in wall pacing, each as a bench process of its own with the reference WSP unit;
one is left alone, the other has a harness joined that brakes and takes every cycle's frames. The
figures are those of the benches' own summaries.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.table import Table

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, Target
from rollerrig.wsp_interface import own_bench

SCENARIO, BRAKE_BAR, _SLICE_S = "velim_a1", 3.8, 10.0


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run both by turns for the seconds asked for."""
    rounds = max(1, round(given.seconds / (2.0 * _SLICE_S)))
    seconds = max(2.0, given.seconds / (2.0 * rounds))
    alone, joined = [], []
    with tempfile.TemporaryDirectory(prefix="rollerrig-harness-") as place:
        for at in range(rounds):
            say(f"{seconds:g} s without a harness, {seconds:g} s with one ({at + 1} of {rounds}) ...")
            alone.append(_alone(Path(place) / f"alone-{at}", seconds))
            joined.append(_joined(Path(place) / f"joined-{at}", seconds))
    without, with_one = _sum(alone), _sum(joined)
    return {
        "without": without, "with": with_one,
        "targets": [Target("ticks missed in a thousand that a sequence adds",
                           with_one["missed_per_mille"] - without["missed_per_mille"], 0.0).plain()],
        "notes": ["where other programs want the cores, both miss ticks: compare the two columns"],
    }


def _alone(folder: Path, seconds: float) -> Result:
    done = subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli", "run", SCENARIO, "--out", str(folder),
         "--json", "--set", f"duration_max_s={seconds}", "--set", "bus.socketcand_port=0",
         "--set", "modbus.enabled=false"], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode not in (0, 1, 3):
        raise RollerrigError(f"the run did not go: {done.stderr.strip().splitlines()[-1:]}")
    return _loop(folder)


def _joined(folder: Path, seconds: float) -> Result:
    with own_bench.start(folder, SCENARIO, pacing="wall") as bench:
        bench.harness.brake(bar=BRAKE_BAR)
        bench.harness.wait(seconds)
    return _loop(folder)


def _loop(folder: Path) -> Result:
    content: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return dict(content["loop"])


def _sum(runs: list[Result]) -> Result:
    ticks, missed = (sum(one[key] for one in runs) for key in ("ticks", "missed"))
    worst = {name: max(one["lateness_us"][name] for one in runs) for name in runs[0]["lateness_us"]}
    return {"ticks": ticks, "missed": missed, "missed_per_mille": 1000.0 * missed / ticks,
            "lateness_us": worst}


def table(result: Result) -> Table:
    """Both side by side; a lateness is the worst of the rounds."""
    sides = result["without"], result["with"]
    rows: list[tuple[object, ...]] = [
        ("ticks", *(one["ticks"] for one in sides)), ("ticks missed", *(one["missed"] for one in sides))]
    rows += [(f"lateness {name}, us", *(one["lateness_us"][name] for one in sides))
             for name in sides[0]["lateness_us"]]
    return figures.table("the loop under a sequence", ("what", "without", "with a harness"), rows)
