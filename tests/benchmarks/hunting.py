"""`rollerrig bench hunting`: the critical speed of the coach in 3D, by a sweep over the speed.

The sweep runs on dry and on soapy rail. All wheelsets start half a millimetre off the middle of the
track, and the lateral oscillation is observed for four seconds: it decays below the critical speed
and grows above it. Dampers, bump stops and traction rods are assumed curves (`[multibody]`), so
this speed depends on them as much as on the paper; `--set multibody.laying=0.025` or
`multibody.yaw_damper_N_s_m=0` changes it.
"""

import argparse
import math

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say
from rollerrig.rig import params
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.multibody import coach, stability

SPEEDS_M_S = tuple(float(speed) for speed in np.arange(20.0, 141.0, 10.0))
# sets of [adhesion]
RAILS = ("dry", "soap")
# the critical speed is found to this
_TOLERANCE_M_S = 0.5
# the sweep's step: the critical speed is so much below the first unstable speed at most
_STEP_M_S = 10.0


def run(given: argparse.Namespace, say: Say) -> Result:
    """Return the growth rate in 1/s at each speed, and the critical speed in m/s (None: none)."""
    growth: dict[str, list[float]] = {}
    critical: dict[str, float | None] = {}
    notes = []
    for rail in RAILS:
        model, law = _coach_on(rail, given.set)
        growth[rail] = []
        for speed in SPEEDS_M_S:
            rate = stability.growth(model, law, speed)
            growth[rail].append(rate)
            say(f"{rail}: {speed:5.0f} m/s ({3.6 * speed:.0f} km/h)  growth {rate:.3f} 1/s")
        critical[rail] = _critical_speed(model, law, growth[rail])
        notes.append(_note(rail, critical[rail]))

    notes.append("dampers, bump stops and traction rods are assumed curves, and so is this speed")
    return {
        "speeds_m_s": list(SPEEDS_M_S),
        "growth_1_s": growth,
        "critical_speed_m_s": critical,
        "notes": notes,
    }


def _coach_on(rail: str, settings: list[str]) -> tuple[coach.Coach, params.Law]:
    """Return the coach on a straight track, and the adhesion law of a rail."""
    plan = scenario.load("velim_a1", settings=("rig=plain_track", f"adhesion={rail}", *settings))
    sections = params.check(plan.resolved, "velim_a1")
    contact = sections["contact"]
    model = coach.build(sections, math.inf, MODELS[contact["model"]], contact["fastsim_cells"])
    return model, params.law_of(sections["adhesion"])


def _critical_speed(model: coach.Coach, law: params.Law, growth_1_s: list[float]) -> float | None:
    """Return the lowest speed in m/s at which an oscillation grows; None: it grows nowhere."""
    for speed, rate in zip(SPEEDS_M_S, growth_1_s, strict=True):
        if rate > 0.0:
            between = np.array([max(speed - _STEP_M_S, 1.0), speed])
            return stability.critical_speed(model, law, between, _TOLERANCE_M_S)
    return None


def _note(rail: str, speed: float | None) -> str:
    if speed is None:
        return f"{rail}: no hunting up to {SPEEDS_M_S[-1]:.0f} m/s"
    return f"{rail}: hunting from {speed:.1f} m/s ({3.6 * speed:.0f} km/h) on"


def table(result: Result) -> Table:
    """Return the sweep: how fast a lateral oscillation grows (above 0) or decays."""
    rows = []
    for i, speed in enumerate(result["speeds_m_s"]):
        growth = [result["growth_1_s"][rail][i] for rail in RAILS]
        rows.append((speed, 3.6 * speed, *growth))
    return figures.table(
        "growth of a lateral oscillation of the coach, 1/s", ("m/s", "km/h", *RAILS), rows
    )
