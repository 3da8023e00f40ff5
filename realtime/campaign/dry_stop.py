"""The dry stop: how far the same vehicle runs under the same brake demands on clean, dry rollers.

It is the plant itself, without bus, WSP, faults or changes of friction, so it holds what a computed stop leaves out:
filling, load transfer, rotating masses, resistance. Runs of the same vehicle and demands are computed once.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from rollerrig.configs import store
from rollerrig.realtime.bench import free, scenario, tick_data
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.tick import DONE
from rollerrig.wsp_interface import signals

_known: dict[str, float] = {}


def distance_m(resolved: Mapping[str, Any], demands: tuple[tuple[float, float], ...]) -> float:
    """Distance from the first brake demand to standstill; NaN where it does not come to that.

    `resolved`: a resolved scenario; `demands`: (time_s, pressure_Pa) in the order of time.
    """
    braked = [time_s for time_s, pressure_Pa in demands if pressure_Pa > 0.0]
    if not braked:
        return float("nan")
    given = {key: value for key, value in resolved.items() if key not in ("friction", "fault")}
    # dry.toml leaves out what the defaults say already, and those are the paper's law
    dry = given | {
        "adhesion": dict(store.load("adhesion", "dry")[0]["adhesion"]),
        "adhesion_set": "dry",
        "demand": [
            {"from_s": time_s, "pressure_Pa": pressure_Pa} for time_s, pressure_Pa in demands
        ],
        "stand_s": 0.0,
        "duration_max_s": 3600.0,
    }
    text = tomli_w.dumps(dry)
    if text not in _known:
        plan = scenario.read(dry, Path("dry.toml"))
        # its samples are lost on purpose: nobody reads them
        stop = free.Stop(plan, tick_data.build(plan, ring.Memory(1, len(signals.COLUMNS))), "none")
        data = stop.data
        stop.advance(round(braked[0] * plan["loop"]["tick_hz"]))
        from_m = float(data.state.position[0])
        while not data.control[DONE]:
            stop.advance()
        _known[text] = (
            float(data.state.position[0]) - from_m if data.state.standing[0] else float("nan")
        )
    return _known[text]
