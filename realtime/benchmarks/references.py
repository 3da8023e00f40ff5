"""Programs with which the loop is compared: `cyclictest`, and `rtla timerlat` if it is installed.

Sources: cyclictest of rt-tests; rtla-timerlat-hist(1) of the Linux kernel.
"""

import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.loop import loop

# of the output of cyclictest -q -h: bin in us and its count, largest latency, count beyond all bins
_BIN = re.compile(r"^(\d{6}) (\d+)", re.MULTILINE)
_MAX = re.compile(r"^# Max Latencies: (\d+)", re.MULTILINE)
_BEYOND = re.compile(r"^# Histogram Overflows: (\d+)", re.MULTILINE)

# the kernel's list of tracers; the second place is that of older kernels
_TRACERS = (
    Path("/sys/kernel/tracing/available_tracers"),
    Path("/sys/kernel/debug/tracing/available_tracers"),
)
# columns of the output of rtla timerlat hist that belong to the threads, not to the interrupts
_THREAD = "Thr-"
_LONGER_S = 30.0  # that a program may take beyond the measurement


class Latenesses(NamedTuple):
    """What one slice of a program adds to its punctuality."""

    histogram: np.ndarray  # counts, in bins of 1 us
    worst_ns: int
    missed: int  # ticks


def cyclictest(program: str, priority: int, interval_us: int, seconds: float) -> Latenesses:
    """Run cyclictest for some seconds, and return its latencies."""
    words = [program, "-m", "-q"]
    if priority:
        words += ["-p", str(priority)]
    words += ["-i", str(interval_us)]
    words += ["-h", str(loop.BINS)]
    words += ["-D", str(round(seconds))]
    return parse(_output(words, seconds).stdout, interval_us)


def parse(text: str, interval_us: int) -> Latenesses:
    """Return the latencies that cyclictest -q -h prints."""
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    for at, count in _BIN.findall(text):
        histogram[min(int(at), loop.BINS - 1)] += int(count)
    beyond = _BEYOND.search(text)
    if beyond:
        histogram[-1] += int(beyond[1])
    worst = _MAX.search(text)
    return _latenesses(histogram, int(worst[1]) if worst else 0, interval_us)


def timerlat_program() -> str | None:
    """Return the path of rtla if the kernel has its tracer, else None."""
    program = shutil.which("rtla")
    for path in _TRACERS:
        # only root may read the list, and only root may trace
        try:
            tracers = path.read_text().split()
        except OSError:
            continue
        return program if "timerlat" in tracers else None
    return None


def timerlat(program: str, priority: int, interval_us: int, seconds: float) -> Latenesses:
    """Run rtla timerlat on all cores for some seconds, and return the latencies of its threads.

    Raises RollerrigError with its last words if it fails.
    """
    words = [program, "timerlat", "hist", "-p", str(interval_us), "-d", f"{round(seconds)}s"]
    if priority:
        words += ["-P", f"f:{priority}"]
    words += ["-E", "9999"]  # the most bins that it has
    done = _output(words, seconds)
    if done.returncode:
        raise RollerrigError(f"rtla timerlat failed: {done.stderr.strip()[-300:]}")
    return parse_timerlat(done.stdout, interval_us)


def parse_timerlat(text: str, interval_us: int) -> Latenesses:
    """Return the latencies that rtla timerlat hist prints for its threads, of all cores."""
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    worst_us = 0
    threads: list[int] = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        first = words[0].rstrip(":")
        if first == "Index":
            threads = [at for at, word in enumerate(words) if word.startswith(_THREAD)]
            continue
        counts = [int(words[at]) for at in threads if at < len(words) and words[at].isdecimal()]
        if first.isdecimal():
            histogram[min(int(first), loop.BINS - 1)] += sum(counts)
        elif first == "over":
            histogram[-1] += sum(counts)
        elif first == "max":
            worst_us = max(counts, default=0)
    return _latenesses(histogram, worst_us, interval_us)


def _latenesses(histogram: np.ndarray, worst_us: int, interval_us: int) -> Latenesses:
    """Return the latencies with the ticks that they cost: as many as they have whole intervals."""
    missed = int((histogram * (np.arange(loop.BINS) // interval_us)).sum())
    return Latenesses(histogram, worst_ns=1000 * worst_us, missed=missed)


def _output(words: list[str], seconds: float) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        children.command(*words),
        capture_output=True,
        text=True,
        timeout=seconds + _LONGER_S,
        check=False,
    )
