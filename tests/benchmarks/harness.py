"""What a scripted sequence costs the real-time loop: the same stop with and without a harness.

The two run by turns in wall pacing, each as a bench process of its own with the reference WSP unit; one is left alone,
the other has a harness joined that brakes and takes every cycle's frames. The figures are the benches' own summaries'.
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

SCENARIO, BRAKE_BAR, _SLICE_S = "velim_a1", 3.8, 10.0


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run both by turns for the seconds asked for."""
    rounds = max(1, round(given.seconds / (2.0 * _SLICE_S)))
    seconds = max(2.0, given.seconds / (2.0 * rounds))
    without_one, joined = [], []
    with tempfile.TemporaryDirectory(prefix="rollerrig-harness-") as place:
        for at in range(rounds):
            say(
                f"{seconds:g} s without a harness, {seconds:g} s with one ({at + 1} of {rounds}) ..."
            )
            without_one.append(alone(Path(place) / f"alone-{at}", seconds, "modbus.enabled=false"))
            folder = Path(place) / f"joined-{at}"
            with own_bench.start(folder, SCENARIO, pacing="wall") as harness:
                harness.brake(bar=BRAKE_BAR)
                harness.wait(seconds)
            joined.append(_loop(folder))
    without, with_one = total(without_one), total(joined)
    return {
        "without": without,
        "with": with_one,
        "targets": [
            target(
                "ticks missed in a thousand that a sequence adds",
                with_one["missed_per_mille"] - without["missed_per_mille"],
                0.0,
            )
        ],
        "notes": ["where other programs want the cores, both miss ticks: compare the two columns"],
    }


def alone(folder: Path, seconds: float, setting: str = "modbus.port=0") -> Result:
    """What the loop did in a run of some seconds that is left alone, in a process of its own."""
    done = subprocess.run(
        children.command(
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "run",
            SCENARIO,
            "--out",
            str(folder),
            "--json",
            "--set",
            f"duration_max_s={seconds}",
            "--set",
            "bus.interface=hub",
            "--set",
            "bus.socketcand_port=0",
            "--set",
            setting,
        ),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    if done.returncode not in (0, 4):  # it need not stop
        raise RollerrigError(f"the run did not go: {done.stderr.strip().splitlines()[-1:]}")
    return _loop(folder)


def _loop(folder: Path) -> Result:
    return dict(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["loop"])


def total(runs: list[Result]) -> Result:
    """All rounds together; a lateness is the worst of them."""
    ticks, missed = (sum(one[key] for one in runs) for key in ("ticks", "missed"))
    worst = {name: max(one["lateness_us"][name] for one in runs) for name in runs[0]["lateness_us"]}
    return {
        "ticks": ticks,
        "missed": missed,
        "missed_per_mille": 1000.0 * missed / ticks,
        "lateness_us": worst,
    }


def table(result: Result) -> Table:
    """Both side by side; a lateness is the worst of the rounds."""
    return side_by_side(result, "the loop under a sequence", "with a harness")


def side_by_side(result: Result, title: str, beside: str) -> Table:
    """What the loop did without and with something beside it."""
    sides = result["without"], result["with"]
    rows: list[tuple[object, ...]] = [
        (what, *(one[key] for one in sides))
        for what, key in (("ticks", "ticks"), ("ticks missed", "missed"))
    ]
    rows += [
        (f"lateness {name}, us", *(one["lateness_us"][name] for one in sides))
        for name in sides[0]["lateness_us"]
    ]
    return figures.table(title, ("what", "without", beside), rows)
