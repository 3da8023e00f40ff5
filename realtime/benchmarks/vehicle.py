"""`rollerrig bench vehicle`: how fast the rig runs without deadlines, and how soon a run starts.

First, 45 s of four sliding axles run at the step of the scenario with the reference WSP, as
`--pacing free` runs them: in one compiled call on one core. Then `rollerrig run` is started as a
separate process, and the time until its first progress line in wall pacing is measured.
"""

import argparse
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from rich.table import Table

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.loop.tick import TICK
from rollerrig.rig.compiled import kernel_cache

SCENARIO = "velim_a1"
STOP_S = 45.0
# requirements: processor time of STOP_S, and time to the first progress line
WITHIN_S = 1.5
START_S = 2.0
_REPEATS = 3
# so slippery that the axles slide for longer than STOP_S
_SLIPPERY = ("adhesion.mu_cd=0.025", "adhesion.mu_cr=0.1", "duration_max_s=100.0")
# a wheel that slides faster than this counts as sliding
_SLIDING_M_S = 0.5
# a start that takes longer has failed
_START_WITHIN_S = 300.0
# an interrupted run that takes longer to stop is killed
_STOP_WITHIN_S = 60.0


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure the 45 s, and the start of a run."""
    compiled_before = kernel_cache.is_compiled()
    say(f"four axles for {STOP_S:g} s, free pacing ...")
    plan = scenario.load(SCENARIO, settings=_SLIPPERY)
    _stop(plan, 1)  # compiles what is not compiled
    ticks = round(STOP_S * plan["loop"]["tick_hz"])
    stops = [_stop(plan, ticks) for _ in range(_REPEATS)]
    wall_s = min(stop["wall_s"] for stop in stops)
    cpu_s = min(stop["cpu_s"] for stop in stops)

    say(f"a run started as a process, {_REPEATS + 1} times ...")
    starts_s = [_start() for _ in range(_REPEATS + 1)]
    # the first may have to compile what only a run calls
    start_s = min(starts_s[1:])

    step_s = plan["loop"]["step_s"]
    return {
        "simulated_s": STOP_S,
        "step_s": step_s,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "real_time_factor": STOP_S / wall_s,
        "step_us": 1e6 * cpu_s * step_s / STOP_S,
        "sliding_share": stops[0]["sliding_share"],
        "warm_start_s": start_s,
        "cache": _cache() | {"compiled_before": compiled_before},
        "targets": [
            target(
                f"{STOP_S:g} s of four sliding axles, processor time",
                cpu_s,
                WITHIN_S,
                "s",
            ),
            target("warm start of a run", start_s, START_S, "s"),
        ],
        "notes": [
            f"the best of {_REPEATS}; if other programs use the cores, compare the processor time, "
            "which is that of the run alone"
        ],
    }


def _stop(plan: scenario.Scenario, ticks: int) -> dict[str, float]:
    """Run some ticks in one call; return their times, and the share of samples that slide."""
    stop, memory = free.remembered(plan)
    began_s = time.perf_counter()
    cpu_began_s = time.thread_time()
    stop.advance(ticks)
    cpu_s = time.thread_time() - cpu_began_s
    wall_s = time.perf_counter() - began_s

    done = stop.data.control[TICK]
    if done != ticks:
        raise RollerrigError(
            f"the rig stopped after {done} of {ticks} ticks, so there is nothing to time; "
            "the scenario of this benchmark must slide longer"
        )
    sliding = memory.written[:, plan.table.span("sliding")] > _SLIDING_M_S
    share = float(sliding.mean()) if sliding.size else 0.0
    return {"wall_s": wall_s, "cpu_s": cpu_s, "sliding_share": share}


def _start() -> float:
    """Return the seconds from the start of the command to its first progress line."""
    with tempfile.TemporaryDirectory(prefix="rollerrig-start-") as place:
        log = Path(place) / "stderr"
        command = [
            *children.module("rollerrig.realtime.cli", "run", SCENARIO),
            *("--pacing", "wall", "--out", str(Path(place) / "run")),
            *("--set", "bus.interface=hub"),
            *("--set", "bus.socketcand_port=0"),
            *("--set", "modbus.port=0"),
        ]
        began_s = time.perf_counter()
        with log.open("wb") as stderr:
            process = subprocess.Popen(
                children.command(*command),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
            )
        try:
            _wait_for_progress(process, log)
            return time.perf_counter() - began_s
        finally:
            # the run stops its recorder and its unit itself
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_STOP_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_for_progress(process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait for the first progress line, which shows the simulated time. Raises RollerrigError."""
    end_s = time.monotonic() + _START_WITHIN_S
    while "t =" not in (text := log.read_text(encoding="utf-8", errors="replace")):
        if time.monotonic() > end_s or process.poll() is not None:
            raise RollerrigError(
                f"the run has not come to its first line of progress; its last words: {text[-300:]}"
            )
        time.sleep(0.02)


def _cache() -> Result:
    """Return the folder of compiled kernels, and what is in it."""
    folder = kernel_cache.folder()
    # without a writable home there is no such folder
    kernels, size_MB = kernels_in(folder) if folder else (0, 0.0)
    return {
        "folder": str(folder or ""),
        "compiled": kernel_cache.is_compiled(),
        "kernels": kernels,
        "size_MB": size_MB,
    }


def kernels_in(folder: Path) -> tuple[int, float]:
    """Return how many compiled kernels a folder has, and the size of all its files in MB."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    kernels = sum(path.suffix == ".nbi" for path in files)
    return kernels, sum(path.stat().st_size for path in files) / 1e6


def table(result: Result) -> Table:
    """Return the figures of the stop, of the start and of the compile cache."""
    stop = f"{result['simulated_s']:g} s of four axles, step {result['step_s']:g} s"
    return figures.table(
        "the vehicle without deadlines",
        ("what", "figure", "unit"),
        [
            (stop, result["wall_s"], "s"),
            ("the same, processor time", result["cpu_s"], "s"),
            ("times real time", result["real_time_factor"], ""),
            ("one step", result["step_us"], "us"),
            ("share of samples that slide", result["sliding_share"], ""),
            ("warm start of a run", result["warm_start_s"], "s"),
            ("kernels in the compile cache", result["cache"]["kernels"], ""),
            ("size of the compile cache", result["cache"]["size_MB"], "MB"),
        ],
    )
