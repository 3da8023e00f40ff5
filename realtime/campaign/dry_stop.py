"""The dry stop: the distance of a vehicle under the same brake demands on clean, dry rollers.

The plant itself computes it, without bus, WSP, faults or changes of friction. It therefore includes
what a formula leaves out: filling of the cylinders, load transfer, rotating masses, resistance.
A stop with the same vehicle and demands is computed once.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from rollerrig.configs import store
from rollerrig.realtime.bench import free, scenario, tick_data
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.tick import DONE

# distances in m by the text of the scenario
_computed: dict[str, float] = {}


def distance_m(resolved: Mapping[str, Any], demands: tuple[tuple[float, float], ...]) -> float:
    """Return the distance from the first brake demand to standstill.

    NaN if there is no demand, or no standstill. `resolved` is a resolved scenario, `demands` are
    (time_s, pressure_Pa) in the order of time.
    """
    brake_times_s = [time_s for time_s, pressure_Pa in demands if pressure_Pa > 0.0]
    if not brake_times_s:
        return float("nan")
    dry = dry_scenario(resolved, demands)
    text = tomli_w.dumps(dry)
    if text not in _computed:
        _computed[text] = _compute(dry, brake_times_s[0])
    return _computed[text]


def dry_scenario(
    resolved: Mapping[str, Any], demands: tuple[tuple[float, float], ...]
) -> dict[str, Any]:
    """Return the scenario on dry rollers, with these demands until standstill."""
    dry = {key: value for key, value in resolved.items() if key not in ("friction", "fault")}
    # dry.toml leaves out the values that are equal to the defaults, which are those of the paper
    dry["adhesion"] = dict(store.load("adhesion", "dry")[0]["adhesion"])
    dry["adhesion_set"] = "dry"
    dry["demand"] = [
        {"from_s": time_s, "pressure_Pa": pressure_Pa} for time_s, pressure_Pa in demands
    ]
    dry["stand_s"] = 0.0
    dry["duration_max_s"] = 3600.0
    return dry


def _compute(dry: dict[str, Any], braked_from_s: float) -> float:
    """Return the distance from a time to standstill in m; NaN without a standstill."""
    plan = scenario.read(dry, Path("dry.toml"))
    # nobody reads the samples, so the memory holds only one of them
    memory = ring.Memory(1, plan.table)
    stop = free.Stop(plan, tick_data.build(plan, memory), "none")
    control = stop.data.control
    state = stop.data.state

    stop.advance(round(braked_from_s * plan["loop"]["tick_hz"]))
    from_m = float(state.position[0])
    while not control[DONE]:
        stop.advance()
    if not state.standing[0]:
        return float("nan")
    return float(state.position[0]) - from_m
