"""How punctual the real-time loop is, against `cyclictest` at the same priority in the same minute.

Both are run in short slices by turns, because at the same time they would hold each other up: at equal priority
neither interrupts the other. The loop carries bus, recorder and WSP unit as in any run; cyclictest has the machine to
itself. Source: cyclictest of rt-tests, whose latency is now minus the absolute deadline, as is our lateness.
"""

import argparse
import re
import shutil
import subprocess
from typing import Any

import numpy as np
from rich.table import Table

from rollerrig.configs.processes import children
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures, wall
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.loop import loop
from rollerrig.realtime.loop.tick import MISSED, TICK, WORST_NS
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

WITHIN = 1.2
_SLICE_S = 60.0
INSTALL = "install rt-tests (Debian, Ubuntu: apt-get install rt-tests) for the comparison"
_BIN = re.compile(r"^(\d{6}) (\d+)", re.MULTILINE)
_MAX = re.compile(r"^# Max Latencies: (\d+)", re.MULTILINE)
_BEYOND = re.compile(r"^# Histogram Overflows: (\d+)", re.MULTILINE)


class Punctuality:
    """Latenesses of one program over all its slices: a histogram of 1 us bins, and the worst."""

    def __init__(self) -> None:
        self.histogram = np.zeros(loop.BINS, dtype=np.int64)
        self.worst_ns = 0
        self.missed = 0
        self.interruptions = dict.fromkeys(loop.INTERRUPTIONS, 0)

    def add(self, histogram: np.ndarray, worst_ns: int, missed: int) -> None:
        self.histogram += histogram
        self.worst_ns = max(self.worst_ns, worst_ns)
        self.missed += missed

    def plain(self) -> Result:
        return {
            "samples": int(self.histogram.sum()),
            "missed": self.missed,
            "interruptions": self.interruptions,
            "lateness_us": loop.percentiles(self.histogram, self.worst_ns),
        }


def run(given: argparse.Namespace, say: Say) -> Result:
    """Alternate cyclictest and the loop until the loop has run for the seconds asked for."""
    settings, other = tuple(given.set), shutil.which("cyclictest")
    rates = scenario.load(wall.SCENARIO, settings=settings)["loop"]
    ours, theirs = Punctuality(), Punctuality()
    slices = max(1, round(given.seconds / _SLICE_S))
    slice_s = given.seconds / slices
    # it comes before and after each slice of the loop; it takes whole seconds
    other_s = max(1.0, round(given.seconds / (slices + 1)))

    def compare() -> None:
        if other:
            say(f"cyclictest, {other_s:g} s ...")
            theirs.add(
                *cyclictest(other, rates["priority"], 1_000_000 // rates["tick_hz"], other_s)
            )

    refused: list[str] = []
    for at in range(slices):
        compare()
        say(f"the loop, slice {at + 1} of {slices} ...")
        left_s = slice_s
        while left_s >= 1.0:  # the coach stops before a slice ends, and brakes again
            ran_s, refused = _stop(left_s, settings, rates["tick_hz"], given.live, ours)
            left_s -= ran_s
    compare()
    result = compared(ours, theirs if other else None)
    return result | {
        "tick_hz": rates["tick_hz"],
        "priority": rates["priority"],
        "live": given.live,
        "loop": ours.plain(),
        "cyclictest": theirs.plain() if other else None,
        "refused": refused,
        "notes": result["notes"] + refused,
    }


def _stop(
    most_s: float, settings: tuple[str, ...], tick_hz: int, live: bool, ours: Punctuality
) -> tuple[float, list[str]]:
    """Run the loop for a stop and add its punctuality; how long it took, and what of its priority was refused."""
    with wall.held(
        most_s, settings=(*settings, f"loop.record_hz={tick_hz}"), live=live
    ) as measured:
        run, control = records.load(measured.folder), measured.parts.data.control
        woken_us = wakes(
            run.column("tick_lateness_us"), run.column("tick_duration_us"), 1e6 / tick_hz
        )
        ours.add(
            np.bincount(np.minimum(woken_us.astype(np.int64), loop.BINS - 1), minlength=loop.BINS),
            int(control[WORST_NS]),
            int(control[MISSED]),
        )
        for name, count in measured.parts.interruptions.items():
            ours.interruptions[name] += count
        return int(control[TICK]) / tick_hz, [
            one.text for one in measured.parts.events if one.code == Code.LOOP_REFUSED
        ]


def wakes(lateness_us: np.ndarray, duration_us: np.ndarray, interval_us: float) -> np.ndarray:
    """Lateness of the ticks that the loop slept for, of samples of every tick, shape (n,).

    A sample has its own tick's lateness and the duration of the tick before.
    """
    slept = np.ones(len(lateness_us), dtype=bool)
    slept[1:] = lateness_us[:-1] + duration_us[1:] < interval_us
    return lateness_us[slept]


def cyclictest(
    program: str, priority: int, interval_us: int, seconds: float
) -> tuple[np.ndarray, int, int]:
    """Run cyclictest: histogram in us, worst in ns, and the deadlines that it missed."""
    done = subprocess.run(
        children.command(
            program,
            "-m",
            *(["-p", str(priority)] if priority else []),
            "-i",
            str(interval_us),
            "-q",
            "-h",
            str(loop.BINS),
            "-D",
            str(round(seconds)),
        ),
        capture_output=True,
        text=True,
        timeout=seconds + 30.0,
        check=False,
    )
    return parse(done.stdout, interval_us)


def parse(text: str, interval_us: int) -> tuple[np.ndarray, int, int]:
    """What cyclictest -q -h prints: histogram in us, worst in ns, deadlines that latencies cost."""
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    for at, count in _BIN.findall(text):
        histogram[min(int(at), loop.BINS - 1)] += int(count)
    beyond, worst = _BEYOND.search(text), _MAX.search(text)
    histogram[-1] += int(beyond[1]) if beyond else 0
    missed = int((histogram * (np.arange(loop.BINS) // interval_us)).sum())
    return histogram, 1000 * int(worst[1]) if worst else 0, missed


def compared(ours: Punctuality, theirs: Punctuality | None) -> Result:
    """Ratios of the quantiles, targets, and whether missed ticks are the machine's own."""
    notes = [
        "by turns, in slices: at the same time they would hold each other up",
        "the loop's thread: "
        + ", ".join(
            f"{name.replace('_', ' ')} {count}" for name, count in ours.interruptions.items()
        ),
    ]
    if theirs is None or not theirs.histogram.sum():
        why = "cyclictest is not here" if theirs is None else "cyclictest was refused its priority"
        return {"ratio": None, "targets": [], "notes": [f"{why}; {INSTALL}; our own figures only"]}
    mine, his = ours.plain()["lateness_us"], theirs.plain()["lateness_us"]
    ratio = {name: mine[name] / max(his[name], 1.0) for name in mine}
    # as many as cyclictest would have missed in as many ticks, and what chance adds to so few stalls
    expected = WITHIN * theirs.missed * ours.histogram.sum() / theirs.histogram.sum()
    return {
        "ratio": ratio,
        "notes": notes,
        "targets": [
            *(
                target(f"lateness {name} over cyclictest's", ratio[name], WITHIN)
                for name in ("p99", "p999")
            ),
            target(
                "missed ticks, by what cyclictest missed",
                float(ours.missed),
                float(expected + 2.0 * np.sqrt(expected)) if expected else 0.0,
            ),
        ],
    }


def table(result: Result) -> Table:
    """Both programs' lateness, and the ratios."""

    def row(name: str, one: dict[str, Any]) -> tuple[object, ...]:
        return (
            name,
            one.get("samples"),
            *map(one.get("lateness_us", {}).get, figures.QUANTILES),
            one.get("missed"),
        )

    rows = [row(name, result[name] or {}) for name in ("loop", "cyclictest")]
    if result["ratio"]:
        rows.append(row("ratio", {"lateness_us": result["ratio"]}))
    title = f"lateness in us, {result['tick_hz']} Hz, SCHED_FIFO {result['priority']}" + (
        ", live view" if result["live"] else ""
    )
    return figures.table(title, ("", "wakes", *figures.QUANTILES, "missed"), rows)
