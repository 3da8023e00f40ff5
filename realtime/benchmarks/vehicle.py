"""How fast the whole rig runs without deadlines, and how soon a run starts.

45 s of four sliding axles at the scenario's step, with the reference WSP, as `--pacing free` runs
them: one compiled call on one core. Then a real `rollerrig run` is started from nothing, and the
time until its first progress line in wall pacing is taken.
"""

import argparse
import time
from pathlib import Path

from rich.table import Table

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.endurance import runs
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.loop.tick import TICK
from rollerrig.rig.compiled import kernel_cache
from rollerrig.wsp_interface import signals

STOP_S, WITHIN_S, START_S = 45.0, 1.5, 2.0
_REPEATS = 3
# slippery enough to slide for longer than 45 s
_SLIPPERY = ("adhesion.mu_cd=0.025", "adhesion.mu_cr=0.1", "duration_max_s=100.0")
_SLIDING_M_S = 0.5


def run(given: argparse.Namespace, say: Say) -> Result:
    """Time the 45 s, and the start of a run."""
    compiled = kernel_cache.is_compiled()
    say("four axles for 45 s, free pacing ...")
    plan = scenario.load("velim_a1", settings=_SLIPPERY)
    _stop(plan, 1)
    runs = [_stop(plan, round(STOP_S * plan["loop"]["tick_hz"])) for _ in range(_REPEATS)]
    wall_s, cpu_s = (min(one[key] for one in runs) for key in ("wall_s", "cpu_s"))
    say(f"a run started from nothing, {_REPEATS + 1} times ...")
    # the first may have to compile what only a run calls
    start_s = min([_start() for _ in range(_REPEATS + 1)][1:])
    step_s, cache = plan["loop"]["step_s"], Path(kernel_cache.settings.CACHE_DIR)
    kept = [path for path in cache.rglob("*") if path.is_file()] if cache.name else []
    return {
        "simulated_s": STOP_S,
        "step_s": step_s,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "real_time_factor": STOP_S / wall_s,
        "step_us": 1e6 * cpu_s * step_s / STOP_S,
        "sliding_share": runs[0]["sliding_share"],
        "warm_start_s": start_s,
        "cache": {
            "folder": str(cache),
            "compiled": kernel_cache.is_compiled(),
            "compiled_before": compiled,
            "kernels": sum(path.suffix == ".nbi" for path in kept),
            "size_MB": sum(path.stat().st_size for path in kept) / 1e6,
        },
        "targets": [
            target("45 s of four sliding axles, processor time", cpu_s, WITHIN_S, "s"),
            target("warm start of a run", start_s, START_S, "s"),
        ],
        "notes": [
            f"the best of {_REPEATS}; where other programs want the cores too, cpu_s says what the run itself "
            "took"
        ],
    }


def _stop(plan: scenario.Scenario, ticks: int) -> dict[str, float]:
    """Run some ticks in one call and say how long it took and how much was slid."""
    stop, memory = free.remembered(plan)
    wall_s, cpu_s = time.perf_counter(), time.thread_time()
    stop.advance(ticks)
    cpu_s, wall_s = time.thread_time() - cpu_s, time.perf_counter() - wall_s
    done = stop.data.control[TICK]
    if done != ticks:
        raise RollerrigError(
            f"the rig stood after {done} of {ticks} ticks: nothing to time; the scenario of this "
            "benchmark must slide longer"
        )
    sliding = memory.written[:, signals.span("sliding")] > _SLIDING_M_S
    return {
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "sliding_share": float(sliding.mean()) if sliding.size else 0.0,
    }


def _start() -> float:
    """Seconds from starting the command to the first progress line of a run in wall pacing."""
    begun_s = time.perf_counter()
    with runs.started(seconds=60.0) as run:
        run.until(lambda: "t =" in run.words(), "its first line of progress")
        return time.perf_counter() - begun_s


def table(result: Result) -> Table:
    """The figures of the stop, the start and the compile cache."""
    return figures.table(
        "the vehicle without deadlines",
        ("what", "figure", "unit"),
        [
            (
                f"{result['simulated_s']:g} s of four axles, step {result['step_s']:g} s",
                result["wall_s"],
                "s",
            ),
            ("the same, processor time", result["cpu_s"], "s"),
            ("times real time", result["real_time_factor"], ""),
            ("one step", result["step_us"], "us"),
            ("share of samples that slide", result["sliding_share"], ""),
            ("warm start of a run", result["warm_start_s"], "s"),
            ("kernels in the compile cache", result["cache"]["kernels"], ""),
            ("size of the compile cache", result["cache"]["size_MB"], "MB"),
        ],
    )
