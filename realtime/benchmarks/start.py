"""`rollerrig bench start`: processor time and wall time of the first start of a command, and of the
next ones.

A cold start has an empty cache, so it compiles its kernels, as the first start on a new machine
does. A warm start is the same command with the cache of the cold start. Each start is a separate
process. Its processor time is user plus system time of the process with all its children. Other
programs on the machine affect it less than wall time.

With `--beside FOLDER` an older checkout does the same starts alternately, with the Python and the
packages of this version. The bytecode of both versions exists before the first start.
"""

import argparse
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.benchmarks import figures, older_checkout
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.benchmarks.vehicle import kernels_in
from rollerrig.rig.compiled import kernel_cache

# default number of starts of each command and version; a cold start takes minutes
COLD_STARTS = 1
WARM_STARTS = 3
# requirements: figures of this version over those of the older checkout
COLD_FREE_RUN = 0.25
COLD_EXPLAIN = 0.5
WARM = 1.0


class Task(NamedTuple):
    """A command whose starts are measured."""

    name: str
    words: tuple[str, ...]
    accepted: tuple[int, ...]  # exit statuses of a command that has done its work


# a stop of 0.3 s passes, or it is not valid, because the vehicle has not stopped
_STOP_STATUSES = (0, 4)
_STOP = ("run", "velim_a1", "--set", "duration_max_s=0.3")
# a bus in the process of the bench, and free ports
_BENCH = (
    *("--set", "bus.interface=hub"),
    *("--set", "bus.socketcand_port=0"),
    *("--set", "modbus.port=0"),
)
FREE_RUN = Task("free run", (*_STOP, "--pacing", "free"), _STOP_STATUSES)
EXPLAIN = Task("explain", ("explain", "open_none"), (0,))
TASKS = (
    FREE_RUN,
    Task("lockstep run", (*_STOP, *_BENCH, "--pacing", "lockstep"), _STOP_STATUSES),
    Task("real-time run", (*_STOP, *_BENCH, "--pacing", "wall"), _STOP_STATUSES),
    EXPLAIN,
)


class Version(NamedTuple):
    """A version of rollerrig: its name in tables, the folder of its caches, and the environment
    variables of its commands.
    """

    name: str
    folder: str
    variables: dict[str, str]


THIS = "this version"
OLDER = "--beside"


class Start(NamedTuple):
    """The times of one start."""

    cpu_s: float
    wall_s: float


class Starts(NamedTuple):
    """All starts of a command with one version, and what the last cold start left in its cache."""

    cold: list[Start]
    warm: list[Start]
    kernels: int
    size_MB: float


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure the starts of all tasks."""
    if given.runs is not None and given.runs < 1:
        raise ConfigError(f"--runs {given.runs} is out of range; allowed are 1 and more")
    older_checkout.check(given.beside)
    versions = [Version(THIS, "this", {})]
    _write_bytecode(kernel_cache.ROOT)
    if given.beside is not None:
        versions.append(Version(OLDER, "older", older_checkout.variables(given.beside)))
        _write_bytecode(given.beside)

    cold_starts = given.runs or COLD_STARTS
    warm_starts = given.runs or WARM_STARTS
    tasks = [_measure(task, versions, cold_starts, warm_starts, say) for task in TASKS]
    return {"tasks": tasks, "targets": _targets(tasks), "notes": _notes(tasks)}


def _measure(
    task: Task, versions: list[Version], cold_starts: int, warm_starts: int, say: Say
) -> Result:
    """Return the figures of a task: of each version, and the ratios of this one to the older."""
    starts = {version.name: Starts([], [], kernels=0, size_MB=0.0) for version in versions}
    with tempfile.TemporaryDirectory(prefix="rollerrig-start-") as place:
        caches: dict[str, Path] = {}
        for number in range(1, cold_starts + 1):
            for version in versions:
                cache = Path(place) / version.folder / str(number)
                cache.mkdir(parents=True)
                say(f"{task.name}, cold start {number} of {cold_starts}, {version.name} ...")
                starts[version.name].cold.append(_start(task, version, cache, say))
                caches[version.name] = cache
        for version in versions:
            kernels, size_MB = _kept(task, version, caches[version.name])
            found = starts[version.name]
            starts[version.name] = found._replace(kernels=kernels, size_MB=size_MB)
        for number in range(1, warm_starts + 1):
            for version in versions:
                say(f"{task.name}, warm start {number} of {warm_starts}, {version.name} ...")
                starts[version.name].warm.append(_start(task, version, caches[version.name], say))
    return _figures(task, starts)


def _kept(task: Task, version: Version, cache: Path) -> tuple[int, float]:
    """Return the number of kernels in a cache, and their size in MB.

    Raises RollerrigError if there are none.
    """
    kernels, size_MB = kernels_in(cache / "rollerrig")
    if not kernels:
        raise RollerrigError(
            f"{task.name}, {version.name}: no compiled kernels are kept below "
            f"{tempfile.gettempdir()}, so each start would compile; set TMPDIR to a folder to "
            "which no other user may write"
        )
    return kernels, size_MB


def _start(task: Task, version: Version, cache: Path, say: Say) -> Start:
    """Return the times of a command with a folder of caches. Raises RollerrigError if it fails."""
    environment = os.environ | version.variables | {"XDG_CACHE_HOME": str(cache)}
    # the kernels would be there
    environment.pop("NUMBA_CACHE_DIR", None)
    with tempfile.TemporaryDirectory(prefix="rollerrig-start-") as place:
        words = [*task.words, "--out", str(Path(place) / "out")]
        command = children.command(*children.module("rollerrig.realtime.cli", *words))
        status, error, start = timed(command, environment)
    if status not in task.accepted:
        raise RollerrigError(
            f"{task.name}, {version.name}: exit status {status}; "
            f"its last words: {error.strip()[-300:]}"
        )
    say(f"    processor time {start.cpu_s:.1f} s, wall time {start.wall_s:.1f} s")
    return start


def timed(command: list[str], environment: dict[str, str]) -> tuple[int, str, Start]:
    """Run a command; return its exit status, its standard error, and its times."""
    begun_s = time.perf_counter()
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
    )
    assert process.stderr is not None
    try:
        with process.stderr:
            error = process.stderr.read()
        # the resources of the process and of all children that it has waited for
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    finally:
        if process.returncode is None:
            # the command stops its processes itself
            process.send_signal(signal.SIGINT)
            process.wait()
    wall_s = time.perf_counter() - begun_s
    return process.returncode, error, Start(used.ru_utime + used.ru_stime, wall_s)


def _write_bytecode(folder: Path) -> None:
    """Write the bytecode of a version, so that the first start does not do that."""
    rooms = [str(path.parent) for path in folder.glob("*/__init__.py")]
    # in a folder that is not writable, each start computes the bytecode
    subprocess.run([children.interpreter(), "-m", "compileall", "-qq", *rooms], check=False)


def _figures(task: Task, starts: dict[str, Starts]) -> Result:
    """Return the figures of the versions; with two of them also the ratios of their medians."""
    result: Result = {"task": task.name, "command": " ".join(("rollerrig", *task.words))}
    result["versions"] = {name: _medians(found) for name, found in starts.items()}
    if OLDER in starts:
        this = result["versions"][THIS]
        older = result["versions"][OLDER]
        result["ratios"] = {key: this[key] / older[key] for key in COLUMNS}
        fastest_s = min(start.cpu_s for start in starts[THIS].warm)
        slowest_older_s = max(start.cpu_s for start in starts[OLDER].warm)
        result["fastest_warm_over_slowest_older"] = fastest_s / slowest_older_s
    return result


def _medians(found: Starts) -> Result:
    """Return the figures of a version: sizes, medians of the times, and all starts."""
    cold = Start(*np.median(found.cold, axis=0).tolist())
    warm = Start(*np.median(found.warm, axis=0).tolist())
    return {
        "kernels": found.kernels,
        "size_MB": found.size_MB,
        "cold_cpu_s": cold.cpu_s,
        "cold_wall_s": cold.wall_s,
        "warm_cpu_s": warm.cpu_s,
        "warm_wall_s": warm.wall_s,
        "cold_starts": [start._asdict() for start in found.cold],
        "warm_starts": [start._asdict() for start in found.warm],
    }


def _targets(tasks: list[Result]) -> list[Result]:
    """Return the targets; without an older checkout there are none."""
    limits = {FREE_RUN.name: COLD_FREE_RUN, EXPLAIN.name: COLD_EXPLAIN}
    targets = []
    for task in tasks:
        if "ratios" not in task:
            continue
        name = task["task"]
        if name in limits:
            ratio = task["ratios"]["cold_cpu_s"]
            targets.append(
                target(f"cold start, {name}: processor time over --beside", ratio, limits[name])
            )
        targets.append(
            target(
                f"warm start, {name}: processor time of the fastest over the slowest of --beside",
                task["fastest_warm_over_slowest_older"],
                WARM,
            )
        )
    return targets


def _notes(tasks: list[Result]) -> list[str]:
    counts = {}
    for kind in ("cold", "warm"):
        counts[kind] = len(tasks[0]["versions"][THIS][f"{kind}_starts"])
    notes = [
        f"medians of {counts['cold']} cold and {counts['warm']} warm starts; processor time is user "
        "plus system time of the command with all its children"
    ]
    notes += [f"{task['task']}: {task['command']}" for task in tasks]
    if "ratios" in tasks[0]:
        notes.append(
            "a version counts as slower when each of its warm starts takes more processor time than "
            "each of the other; with three starts each, versions of the same speed do so once in 20"
        )
    return notes


# the figures of a row, and their heads
COLUMNS = {
    "kernels": "kernels",
    "size_MB": "cache, MB",
    "cold_cpu_s": "cold: processor, s",
    "cold_wall_s": "cold: wall, s",
    "warm_cpu_s": "warm: processor, s",
    "warm_wall_s": "warm: wall, s",
}


def table(result: Result) -> Table:
    """Return the figures of all tasks."""
    rows = []
    for task in result["tasks"]:
        name = task["task"]
        for version, found in task["versions"].items():
            shown_name = name if version == THIS else f"{name}, {version}"
            rows.append([shown_name, *(found[key] for key in COLUMNS)])
        if "ratios" in task:
            rows.append([f"{name}, ratio", *(task["ratios"][key] for key in COLUMNS)])
    return figures.table("starts of commands", ("command", *COLUMNS.values()), rows)
