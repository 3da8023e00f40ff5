"""Compares the law of sand with stops that were measured: two stops are fitted, the others
predicted.

A four-car multiple unit brakes from 55 mph, with a demand of 0.9 m/s2, on a rail of 0.02. Sanders
of one or of two axles blow at a fixed rate, or at a rate that depends on speed. Each axle has the
adhesion of [1], as in the plant, of the sand that the axles in front of it have left, and uses as
much of it as its brake demands. The stop is the mean over the speed: no dynamics and no wheel slide
protection.

    [1] mu = mu_0 exp(gain (1 - exp(-D / D_0))), D the dose of sand in kg/m, D_0 its scale

Source of the distances: Rail Engineer, 12 February 2018, on the trials of RSSB project T1107 with a
Class 387; RAIB quotes them in its report on Talerddig. Assumptions: the position of the second
sander, the rates, and the largest rate of a variable one. Shares that are lost and used: the
defaults of [sanders].
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig import params
from rollerrig.rig.mechanisms.friction import dose_share

SPEED_M_S = 55.0 * 0.44704  # 55 mph
DEMAND_M_S2 = 0.9
MU_0 = 0.02
AXLES = 16
RESISTANCE_M_S2 = 0.02  # assumption: mean over the stop
# both rails together: a fixed rate of 2 kg/min, a variable one of 7.5 g/m and at most 4 kg/min
FIXED_KG_S = 2.0 * 2.0 / 60.0
VARIABLE_KG_S = 2.0 * 4.0 / 60.0
DOSE_KG_M = 2.0 * 0.0075
_DEFAULTS = {row.name: row.default for row in params.ROWS["sanders"]}


class Stop(NamedTuple):
    """One of the trials."""

    title: str
    axles: tuple[int, ...]  # that have sanders, from 1
    by_speed: bool  # the rate depends on the speed
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
    """Return how far the unit runs, by the law of sand [1]."""
    speed = np.linspace(0.25, SPEED_M_S, 200)
    rate_kg_s = np.full(speed.size, FIXED_KG_S)
    if stop.by_speed:
        rate_kg_s = np.minimum(VARIABLE_KG_S, DOSE_KG_M * speed)

    # at each speed: dose under the axle in kg/m, and mean adhesion of all axles
    dose = np.zeros(speed.size)
    adhesion = np.zeros(speed.size)
    demand = DEMAND_M_S2 / GRAVITY_M_S2
    for axle in range(1, AXLES + 1):
        if axle in stop.axles:
            dose = dose + rate_kg_s / speed * (1.0 - _DEFAULTS["lost_share"])
        share = np.array([dose_share(float(one), scale_kg_m) for one in dose])
        adhesion += np.minimum(MU_0 * np.exp(gain * share), demand) / AXLES
        dose = dose * (1.0 - _DEFAULTS["used_share"])
    deceleration_m_s2 = GRAVITY_M_S2 * adhesion + RESISTANCE_M_S2
    return float(np.trapezoid(speed / deceleration_m_s2, speed))


def study() -> dict[str, Any]:
    """Fit the law on two stops; return it, and all five stops as measured and by the law."""
    fitted_stops = [stop for stop in STOPS if stop.fitted]

    def relative_errors(x: np.ndarray) -> list[float]:
        gain = x[0]
        scale_kg_m = math.exp(x[1])
        return [distance_m(stop, gain, scale_kg_m) / stop.measured_m - 1.0 for stop in fitted_stops]

    solution = least_squares(
        relative_errors,
        (1.5, math.log(0.002)),
        bounds=((0.1, math.log(1e-5)), (5.0, math.log(1.0))),
    )
    gain = float(solution.x[0])
    scale_kg_m = math.exp(solution.x[1])

    stops = []
    for stop in STOPS:
        stops.append(
            {
                "stop": stop.title,
                "measured_m": stop.measured_m,
                "fitted": stop.fitted,
                "by_the_law_m": distance_m(stop, gain, scale_kg_m),
            }
        )
    return {"gain": gain, "dose_scale_kg_m": scale_kg_m, "stops": stops}
