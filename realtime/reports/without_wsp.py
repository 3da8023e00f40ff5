"""The same stop without WSP, computed at full speed, to show what the protection was worth."""

from typing import NamedTuple

import numpy as np

from rollerrig.realtime.bench import free
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.wsp_interface import braking, signals


class StopWithoutWsp(NamedTuple):
    """The figures of a stop in which no unit acts on the valves.

    The distances are those of `wsp_interface.braking`, or those at the end, where the vehicle did
    not stop.
    """

    stopped: bool
    stop_distance_m: float
    braking_distance_m: float
    longest_lock_s: float  # of the wheelset that was locked longest


def simulate(plan: Scenario) -> StopWithoutWsp:
    """Run a scenario in free pacing without a WSP unit.

    Raises ConfigError where the scenario has a fault that needs a bus.
    """
    rows = free.simulate(plan, "none")
    last = rows[-1]
    position_m = rows[:, signals.column("position")]
    begin = braking.begin(rows[:, signals.column("brake_demand")]) or 0
    return StopWithoutWsp(
        stopped=bool(last[signals.column("vehicle_speed")] <= braking.STANDS_M_S),
        stop_distance_m=float(position_m[-1]),
        braking_distance_m=float(position_m[-1] - position_m[begin]),
        longest_lock_s=float(np.max(last[signals.span("longest_lock")])),
    )


def sentence(stop: StopWithoutWsp) -> str:
    """Return a line for the terminal."""
    distance = f"without WSP: {stop.braking_distance_m:,.0f} m"
    if not stop.stopped:
        distance += " and still moving"
    if stop.longest_lock_s == 0.0:
        return f"{distance}, no wheel locked"
    return f"{distance}, wheels locked for {stop.longest_lock_s:.0f} s"
