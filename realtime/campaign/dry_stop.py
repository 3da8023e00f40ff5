"""The dry stop: how far the same vehicle runs under the same brake demands on clean, dry rollers.

It is the plant itself, without bus, WSP, faults or changes of friction, so it holds what a computed
stop leaves out: filling, load transfer, rotating masses, resistance. Runs of the same vehicle and
demands are computed once.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rollerrig.configs import store
from rollerrig.realtime.bench import bench, scenario
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import DONE, TICK
from rollerrig.wsp_interface import signals

_BATCH = 1000
_known: dict[str, float] = {}


def distance_m(resolved: Mapping[str, Any], demands: tuple[tuple[float, float], ...]) -> float:
    """Distance from the first brake demand to standstill; NaN where it does not come to that.

    `resolved`: a resolved scenario; `demands`: (time_s, pressure_Pa) in the order of time.
    """
    braked = [time_s for time_s, pressure_Pa in demands if pressure_Pa > 0.0]
    if not braked:
        return float("nan")
    text = tomli_w.dumps(_dry(resolved, demands))
    if text not in _known:
        _known[text] = _run(text, braked[0])
    return _known[text]


def _dry(resolved: Mapping[str, Any], demands: tuple[tuple[float, float], ...]) -> dict[str, Any]:
    given = {key: value for key, value in resolved.items() if key not in ("friction", "fault")}
    dry, _ = store.load("adhesion", "dry")
    # dry.toml leaves out what the defaults say already, and those are the paper's law
    given["adhesion"] = dict(dry["adhesion"])
    given["adhesion_set"] = "dry"
    given["demand"] = [{"from_s": time_s, "pressure_Pa": pressure_Pa}
                       for time_s, pressure_Pa in demands]
    return given | {"stand_s": 0.0, "duration_max_s": 3600.0}


def _run(text: str, begin_s: float) -> float:
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "dry.toml"
        path.write_text(text, encoding="utf-8")
        plan = scenario.load(str(path))
    # its rows are lost on purpose: nobody reads them
    ring = rings.Ring(rings.place("dry"), np.float64, 64, len(signals.COLUMNS))
    try:
        machine = bench.build_machine(plan, ring)
        begin = round(begin_s * plan["loop"]["tick_hz"])
        tick.batch(machine, begin)
        from_m = float(machine.state.position[0])
        while not machine.control[DONE] and machine.control[TICK] < machine.end_tick:
            tick.batch(machine, _BATCH)
        stands = machine.state.standing[0] != 0.0
        return float(machine.state.position[0]) - from_m if stands else float("nan")
    finally:
        ring.close()
        ring.unlink()
