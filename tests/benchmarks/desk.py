"""`rollerrig bench desk`: what the desk costs the real-time loop.

The same stop runs alternately without a desk and with a desk that ten browsers look at, in wall
pacing, each in a separate bench process with the reference WSP unit. The browsers are the clients
of `browser.py`: they load the page, hold its websocket and request new rows, but draw nothing,
because the load of a real browser on the machine is not the desk's. One of them is stopped
(SIGSTOP) with open connections. The figures come from the summaries of the benches.
"""

import argparse
import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from benchmarks import harness
from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.benchmarks.figures import Result, Say, target

# duration of all runs together, where --seconds does not give it
SECONDS = 120.0
BROWSERS = 10
_SLICE_S = 20.0
_BROWSER = Path(__file__).with_name("browser.py")


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run both alternately for the requested seconds."""
    rounds = max(1, round(given.seconds / (2.0 * _SLICE_S)))
    seconds = max(2.0, given.seconds / (2.0 * rounds))
    alone: list[Result] = []
    watched: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="rollerrig-desk-") as place:
        folder = Path(place)
        for number in range(rounds):
            say(
                f"{seconds:g} s without a desk, {seconds:g} s with {BROWSERS} browsers "
                f"({number + 1} of {rounds}) ..."
            )
            alone.append(harness.alone(folder / f"alone-{number}", seconds))
            with _desk(folder):
                watched.append(harness.alone(folder / f"watched-{number}", seconds))

    without_desk = harness.total(alone)
    with_desk = harness.total(watched)
    ratio = {}
    for name in ("p50", "p99"):
        # below a microsecond the ratio has no meaning
        least_us = max(without_desk["lateness_us"][name], 1.0)
        ratio[name] = with_desk["lateness_us"][name] / least_us
    return {
        "without": without_desk,
        "with": with_desk,
        "ratio": ratio,
        "targets": [
            target(
                "missed ticks per thousand that a desk adds",
                with_desk["missed_per_mille"] - without_desk["missed_per_mille"],
                0.0,
            )
        ],
        "notes": [
            f"lateness with a desk over lateness without: p50 {ratio['p50']:.2f}, "
            f"p99 {ratio['p99']:.2f}",
            "if other programs use the cores, ticks are missed in both; compare the two columns",
        ],
    }


@contextlib.contextmanager
def _desk(folder: Path) -> Iterator[None]:
    """Run a desk with its browsers, of which the last one is stopped."""
    desk = _started(
        "-m", "rollerrig.realtime.cli", "desk", "--port", "0", "--folder", str(folder), "--json"
    )
    browsers = []
    try:
        address = json.loads(_first_line(desk))["address"]
        for _ in range(BROWSERS):
            # -P: the other files of that folder must not hide modules that the browser imports
            browsers.append(_started("-P", str(_BROWSER), address))
        for browser in browsers:
            _first_line(browser)
        browsers[-1].send_signal(signal.SIGSTOP)
        yield
    finally:
        for process in (*browsers, desk):
            process.kill()
            process.communicate()


def _started(*words: str) -> subprocess.Popen[str]:
    """Start Python with these words; it ends with this process."""
    return subprocess.Popen(
        children.command(sys.executable, *words),
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def _first_line(process: subprocess.Popen[str]) -> str:
    """Return the first line of a process. Raises RollerrigError where it exits without one."""
    assert process.stdout
    line = process.stdout.readline()
    if not line:
        error = process.communicate()[1].strip()[-300:]
        raise RollerrigError(f"the desk or a browser has exited: {error}")
    return line


def table(result: Result) -> Table:
    """Return both runs side by side; a lateness is the worst of the rounds."""
    return harness.side_by_side(
        result, "the loop with and without a desk", f"with a desk, {BROWSERS} browsers"
    )
