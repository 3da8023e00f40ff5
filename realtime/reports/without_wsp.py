"""The same stop without WSP, computed at full speed, to show what the protection was worth."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rollerrig.realtime.bench.bench import Bench
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import braking

# the folder of this stop, inside the folder of the run with WSP
FOLDER = "without_wsp"


class StopWithoutWsp(NamedTuple):
    """The figures of a stop in which no unit acts on the valves.

    The distances are those of `wsp_interface.braking`, or those at the end, where the vehicle did
    not stop.
    """

    stopped: bool
    stop_distance_m: float
    braking_distance_m: float
    longest_lock_s: float  # of the wheelset that was locked longest
    folder: str


def options_in(run_folder: Path, seed: int) -> Options:
    """Return the options of this stop, which is recorded inside a run's folder."""
    return Options(pacing="free", unit="none", out=run_folder / FOLDER, seed=seed)


def record(
    plan: Scenario, options: Options, on_progress: Callable[[Progress], None]
) -> StopWithoutWsp:
    """Run a scenario in free pacing without a WSP unit, record it, and return its figures.

    Raises ConfigError where the scenario has a fault that needs a bus.
    """
    summary = asyncio.run(Bench(plan, options, on_progress).run())
    run = records.load(options.out)
    position_m = run.column("position_m")
    begin = braking.begin(run.column("brake_demand_Pa")) or 0
    moved_m = float(position_m[-1])
    return StopWithoutWsp(
        stopped=summary["stopped"],
        stop_distance_m=moved_m,
        braking_distance_m=moved_m - float(position_m[begin]),
        longest_lock_s=max(axle["longest_lock_s"] for axle in summary["axles"]),
        folder=str(options.out),
    )


def sentence(stop: StopWithoutWsp) -> str:
    """Return a line for the terminal."""
    distance = f"without WSP: {stop.braking_distance_m:,.0f} m"
    if not stop.stopped:
        distance += " and still moving"
    if stop.longest_lock_s == 0.0:
        return f"{distance}, no wheel locked"
    return f"{distance}, wheels locked for {stop.longest_lock_s:.0f} s"
