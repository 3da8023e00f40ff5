"""`rollerrig bench loop`: how punctual the real-time loop is, compared with `cyclictest`.

They run in short alternating slices at the same priority: at the same time they would delay each
other, because at equal priority neither interrupts the other. The loop carries bus, recorder and
WSP unit, as in any run; cyclictest has the machine to itself. Where the machine has rtla, its
timerlat runs as well, as a second reference.

Latency of cyclictest is the time of waking minus the absolute deadline. Our lateness is the time at
which the tick begins minus its deadline: on a separate core the loop wakes early and waits.
"""

import argparse
import shutil
from typing import Any

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures, references, wall
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.loop import loop
from rollerrig.realtime.loop.tick import MISSED, TICK, WORST_NS
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

# requirement: a quantile of our lateness over that of cyclictest
WITHIN = 1.2
_SLICE_S = 60.0
INSTALL = "install rt-tests (Debian, Ubuntu: apt-get install rt-tests) for the comparison"


class Punctuality:
    """Latenesses of one program over all its slices."""

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
        """Return the figures for JSON."""
        return {
            "samples": int(self.histogram.sum()),
            "missed": self.missed,
            "interruptions": self.interruptions,
            "lateness_us": loop.percentiles(self.histogram, self.worst_ns),
        }


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run cyclictest and the loop alternately until the loop has run for the requested seconds."""
    settings = tuple(given.set)
    program = shutil.which("cyclictest")
    tracer = references.timerlat_program()
    rates = scenario.load(wall.SCENARIO, settings=settings)["loop"]
    tick_hz = rates["tick_hz"]
    slices = max(1, round(given.seconds / _SLICE_S))
    slice_s = given.seconds / slices
    # cyclictest runs before and after each slice of the loop, and takes whole seconds
    cyclictest_s = max(1.0, round(given.seconds / (slices + 1)))
    ours = Punctuality()
    theirs = Punctuality()
    of_kernel = Punctuality()
    interval_us = 1_000_000 // tick_hz

    def run_references() -> None:
        if program:
            say(f"cyclictest, {cyclictest_s:g} s ...")
            theirs.add(
                *references.cyclictest(program, rates["priority"], interval_us, cyclictest_s)
            )
        if tracer:
            say(f"rtla timerlat, {cyclictest_s:g} s ...")
            of_kernel.add(
                *references.timerlat(tracer, rates["priority"], interval_us, cyclictest_s)
            )

    refused: list[str] = []
    for number in range(slices):
        run_references()
        say(f"the loop, slice {number + 1} of {slices} ...")
        left_s = slice_s
        # the coach may stop before the slice is over, and then brakes again
        while left_s >= 1.0:
            ran_s, refused = _stop(left_s, settings, tick_hz, given.live, ours)
            left_s -= ran_s
    run_references()

    result = compared(ours, theirs if program else None)
    return result | {
        "tick_hz": tick_hz,
        "priority": rates["priority"],
        "live": given.live,
        "loop": ours.plain(),
        "cyclictest": theirs.plain() if program else None,
        "timerlat": of_kernel.plain() if tracer else None,
        "refused": refused,
        "notes": result["notes"] + refused,
    }


def _stop(
    most_s: float, settings: tuple[str, ...], tick_hz: int, live: bool, ours: Punctuality
) -> tuple[float, list[str]]:
    """Run the loop for a stop of at most `most_s`, and add its latenesses to `ours`.

    Returns the simulated seconds, and the events that report a refused priority.
    """
    every_tick = (*settings, f"loop.record_hz={tick_hz}")
    with wall.held(most_s, settings=every_tick, live=live) as measured:
        record = records.load(measured.folder)
        control = measured.parts.data.control
        late_us = wakes(
            record.column("tick_lateness_us"),
            record.column("tick_duration_us"),
            interval_us=1e6 / tick_hz,
        )
        # what is beyond the last bin counts in it
        bins = np.minimum(late_us.astype(np.int64), loop.BINS - 1)
        ours.add(
            np.bincount(bins, minlength=loop.BINS),
            int(control[WORST_NS]),
            int(control[MISSED]),
        )
        for name, count in measured.parts.real_time.interruptions.items():
            ours.interruptions[name] += count
        refused = [event.text for event in measured.parts.events if event.code == Code.LOOP_REFUSED]
        return int(control[TICK]) / tick_hz, refused


def wakes(lateness_us: np.ndarray, duration_us: np.ndarray, interval_us: float) -> np.ndarray:
    """Return the lateness of those ticks before which the loop slept.

    Both arrays, shape (n,), have one sample per tick: the lateness of that tick, and the duration
    of the tick before. If the tick before took too long, the loop did not sleep, and the lateness
    of the next tick does not count.
    """
    slept = np.ones(len(lateness_us), dtype=bool)
    slept[1:] = lateness_us[:-1] + duration_us[1:] < interval_us
    return lateness_us[slept]


def compared(ours: Punctuality, theirs: Punctuality | None) -> Result:
    """Return the ratios of the quantiles, the targets, and notes.

    `theirs` is None without cyclictest. Missed ticks count against the loop only as far as
    cyclictest would not have missed them.
    """
    if theirs is None or not theirs.histogram.sum():
        reason = (
            "cyclictest is not installed"
            if theirs is None
            else "cyclictest got no real-time priority"
        )
        return {
            "ratio": None,
            "targets": [],
            "notes": [f"{reason}; {INSTALL}; these are our own figures only"],
        }

    interruptions = ", ".join(
        f"{name.replace('_', ' ')} {count}" for name, count in ours.interruptions.items()
    )
    our_us = ours.plain()["lateness_us"]
    their_us = theirs.plain()["lateness_us"]
    # below a microsecond the ratio has no meaning
    ratio = {name: our_us[name] / max(their_us[name], 1.0) for name in our_us}

    # what cyclictest would have missed in as many ticks, plus two standard deviations of so few
    expected = WITHIN * theirs.missed * ours.histogram.sum() / theirs.histogram.sum()
    missed_limit = float(expected + 2.0 * np.sqrt(expected)) if expected else 0.0
    targets = [
        target(f"lateness {name} over cyclictest's", ratio[name], WITHIN)
        for name in ("p99", "p999")
    ]
    targets.append(
        target("missed ticks, by what cyclictest missed", float(ours.missed), missed_limit)
    )
    return {
        "ratio": ratio,
        "notes": [
            "measured alternately, in slices: at the same time they would delay each other",
            f"the loop's thread: {interruptions}",
        ],
        "targets": targets,
    }


def table(result: Result) -> Table:
    """Return the lateness of both programs, and the ratios."""
    rows = [_row(name, result[name] or {}) for name in ("loop", "cyclictest")]
    if result["timerlat"]:
        rows.append(_row("rtla timerlat", result["timerlat"]))
    if result["ratio"]:
        rows.append(_row("ratio", {"lateness_us": result["ratio"]}))
    title = f"lateness in us, {result['tick_hz']} Hz, SCHED_FIFO {result['priority']}"
    if result["live"]:
        title += ", live view"
    return figures.table(title, ("", "wakes", *figures.QUANTILES, "missed"), rows)


def _row(name: str, program: dict[str, Any]) -> tuple[object, ...]:
    """Return a row of the table; `program` is as `Punctuality.plain`, or a part of it."""
    lateness_us = program.get("lateness_us", {})
    quantiles = [lateness_us.get(quantile) for quantile in figures.QUANTILES]
    return (name, program.get("samples"), *quantiles, program.get("missed"))
