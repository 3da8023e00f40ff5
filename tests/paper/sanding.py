"""The sand's law against stops that were measured: fitted on two of them, the others predicted.

A four-car multiple unit brakes from 55 mph with 0.9 m/s2 asked for on a rail of 0.02, with sanders of one or of two
axles that blow at a fixed rate or by speed. Every axle has mu_0 exp(gain (1 - exp(-D / D_0))), as in the plant, of the
sand that the axles before have left, and uses of it what its brake asks for. The stop is their mean over the speed: no
dynamics, no protection.

Source of the distances: Rail Engineer, 12 February 2018, on the trials of RSSB project T1107 with a Class 387; RAIB
quotes them in its report on Talerddig. Where the second sander stood, the rates and the most that a variable one
gives: assumptions. Shares that are lost and used: defaults of [sanders].
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig import params
from rollerrig.rig.mechanisms.friction import dose_share

SPEED_M_S, ASKED_M_S2, MU_0, AXLES = 55.0 * 0.44704, 0.9, 0.02, 16
RESISTANCE_M_S2 = 0.02  # assumption: mean over the stop
FIXED_KG_S, VARIABLE_KG_S, DOSE_KG_M = 2.0 * 2.0 / 60.0, 2.0 * 4.0 / 60.0, 2.0 * 0.0075
_ROWS = {row.name: row.default for row in params.ROWS["sanders"]}


class Stop(NamedTuple):
    """One of the trials: axles with sanders, whether they blow by speed, the distance in m, whether it is fitted."""

    title: str
    axles: tuple[int, ...]
    by_speed: bool
    measured_m: float
    fitted: bool = False


STOPS = (
    Stop("no sand", (), False, 1200.0),  # "above 1,200 m"
    Stop("one sander, fixed rate", (3,), False, 800.0, fitted=True),
    Stop("two sanders, fixed rate", (3, 7), False, 650.0),
    Stop("one sander, by speed", (3,), True, 600.0),
    Stop("two sanders, by speed", (3, 7), True, 400.0, fitted=True),
)


def distance_m(stop: Stop, gain: float, scale_kg_m: float) -> float:
    """How far the unit runs by a law of sand."""
    speed = np.linspace(0.25, SPEED_M_S, 200)
    rate = (
        np.minimum(VARIABLE_KG_S, DOSE_KG_M * speed)
        if stop.by_speed
        else np.full(speed.size, FIXED_KG_S)
    )
    dose, adhesion = np.zeros(speed.size), np.zeros(speed.size)
    for axle in range(1, AXLES + 1):
        if axle in stop.axles:
            dose = dose + rate / speed * (1.0 - _ROWS["lost_share"])
        share = np.array([dose_share(float(one), scale_kg_m) for one in dose])
        adhesion += np.minimum(MU_0 * np.exp(gain * share), ASKED_M_S2 / GRAVITY_M_S2) / AXLES
        dose = dose * (1.0 - _ROWS["used_share"])
    return float(np.trapezoid(speed / (GRAVITY_M_S2 * adhesion + RESISTANCE_M_S2), speed))


def study() -> dict[str, Any]:
    """The fit on two stops, and all five as measured and by the law."""
    fitted = [stop for stop in STOPS if stop.fitted]
    found = least_squares(
        lambda x: [
            distance_m(stop, x[0], math.exp(x[1])) / stop.measured_m - 1.0 for stop in fitted
        ],
        (1.5, math.log(0.002)),
        bounds=((0.1, math.log(1e-5)), (5.0, math.log(1.0))),
    )
    gain, scale_kg_m = float(found.x[0]), math.exp(found.x[1])
    return {
        "gain": gain,
        "dose_scale_kg_m": scale_kg_m,
        "stops": [
            {
                "stop": stop.title,
                "measured_m": stop.measured_m,
                "fitted": stop.fitted,
                "by_the_law_m": distance_m(stop, gain, scale_kg_m),
            }
            for stop in STOPS
        ],
    }
