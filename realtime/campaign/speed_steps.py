"""The deceleration of a stop by steps of speed, as brake models of trains state it.

[V1] In the step from v_low to v_high the deceleration is (v1**2 - v2**2) / (2 * (s2 - s1)). 1 is
     the first sample at or below v_high at which the brake force has built up; 2 is the first
     sample at or below v_low. The lowest step ends at standstill.

[V2] The build-up is no part of a deceleration: a brake model has a time for it. The brake force
     counts as built up `build_up_s` (t_b) after the first brake demand. The time of the model is
     t_b - (v_0 - v_b) / a: a brake that begins so much later, at once with the deceleration a, has
     the same speed v_b at t_b. v_0 is the speed at the demand, a that of the highest step.
"""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.wsp_interface import braking

KM_H = 3.6
# the channels of a run that `decelerations` needs
CHANNELS = ("time_s", "brake_demand_Pa", "vehicle_speed_m_s", "position_m")
# column of the time of [V2]
BUILD_UP = "build_up_time_s"
# the part of a step that a stop must have, so that its deceleration stands for the step
LEAST_PART = 0.5
# keys of [etcs] in a plan
ROWS = (
    table.Row("speeds_km_h", (), 0.0, 500.0, "ends of the steps, rising"),
    table.number("build_up_s", 4.0, 0.0, 60.0, "until the brake force has built up"),
    table.Row("nominal_m_s2", (), 0.01, 10.0, "deceleration of each step; default: a run"),
)


class Steps(NamedTuple):
    """The steps of speed of a plan.

    speeds_km_h: ends of the steps, rising, one more than the steps.
    build_up_s: time from the first brake demand until the brake force has built up.
    nominal_m_s2: nominal deceleration of each step; empty: that of the scenario without variation.
    """

    speeds_km_h: tuple[float, ...]
    build_up_s: float
    nominal_m_s2: tuple[float, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns of the steps, from the lowest speed up."""
        return tuple(f"deceleration_{low:03.0f}_{high:03.0f}_m_s2" for low, high in self.pairs_km_h)

    @property
    def pairs_km_h(self) -> tuple[tuple[float, float], ...]:
        """The lower and the upper end of each step."""
        return tuple(itertools.pairwise(self.speeds_km_h))


def read(given: Any, where: str) -> Steps:
    """Return the steps of the table [etcs]. Raises ConfigError with the place `where`."""
    found = table.read(ROWS, given, where)
    speeds_km_h = found["speeds_km_h"]
    rises = all(low < high for low, high in itertools.pairwise(speeds_km_h))
    if len(speeds_km_h) < 2 or not rises or any(speed % 1.0 for speed in speeds_km_h):
        raise ConfigError(
            f"{where}: speeds_km_h = {list(speeds_km_h)}: must be at least two rising whole "
            "numbers, such as [0, 40, 80, 120]"
        )
    nominal_m_s2 = found["nominal_m_s2"]
    if nominal_m_s2 and len(nominal_m_s2) != len(speeds_km_h) - 1:
        raise ConfigError(
            f"{where}: nominal_m_s2 has {len(nominal_m_s2)} numbers; give one for each of the "
            f"{len(speeds_km_h) - 1} steps, or none"
        )
    return Steps(speeds_km_h, found["build_up_s"], nominal_m_s2)


def decelerations(channels: Mapping[str, np.ndarray], steps: Steps) -> dict[str, float | None]:
    """Return the deceleration of each step in m/s2, by the names of its column [V1].

    None: the stop began too low for the step, or has no brake demand. 0: it did not leave the step
    before its end, as a vehicle that does not stop.
    """
    begin = braking.begin(channels["brake_demand_Pa"])
    if begin is None:
        return dict.fromkeys(steps.columns)
    time_s = channels["time_s"]
    built_up = int(np.searchsorted(time_s, time_s[begin] + steps.build_up_s))
    found: dict[str, float | None] = {}
    for column, (low_km_h, high_km_h) in zip(steps.columns, steps.pairs_km_h, strict=True):
        found[column] = _deceleration(
            channels["vehicle_speed_m_s"],
            channels["position_m"],
            built_up,
            max(low_km_h / KM_H, braking.STANDS_M_S),
            high_km_h / KM_H,
        )
    return found


def build_up_time_s(
    channels: Mapping[str, np.ndarray], steps: Steps, found: Mapping[str, float | None]
) -> float | None:
    """Return the time of the build-up in s from the decelerations of a stop [V2].

    None: the brake had not built up before standstill, or no step has a deceleration.
    """
    known = [value for column in steps.columns if (value := found[column])]
    begin = braking.begin(channels["brake_demand_Pa"])
    if begin is None or not known:
        return None
    time_s = channels["time_s"]
    speed_m_s = channels["vehicle_speed_m_s"]
    built_up = int(np.searchsorted(time_s, time_s[begin] + steps.build_up_s))
    if built_up >= speed_m_s.size or speed_m_s[built_up] <= braking.STANDS_M_S:
        return None
    lost_m_s = float(speed_m_s[begin] - speed_m_s[built_up])
    return float(time_s[built_up] - time_s[begin]) - lost_m_s / known[-1]


def figures(channels: Mapping[str, np.ndarray], steps: Steps) -> dict[str, float | None]:
    """Return the deceleration of each step [V1] and the time of the build-up [V2] of a stop."""
    found = decelerations(channels, steps)
    return found | {BUILD_UP: build_up_time_s(channels, steps, found)}


def _deceleration(
    speed_m_s: np.ndarray, position_m: np.ndarray, built_up: int, low_m_s: float, high_m_s: float
) -> float | None:
    """Return the deceleration of one step [V1]; see `decelerations` for None and 0."""
    if built_up >= speed_m_s.size:
        # the vehicle stood before its brake had built up
        return None if speed_m_s[-1] <= low_m_s else 0.0
    entered = np.flatnonzero(speed_m_s[built_up:] <= high_m_s)
    if not entered.size:
        return 0.0
    first = built_up + int(entered[0])
    if speed_m_s[first] - low_m_s < LEAST_PART * (high_m_s - low_m_s):
        return None
    left = np.flatnonzero(speed_m_s[first:] <= low_m_s)
    if not left.size:
        return 0.0
    last = first + int(left[0])
    distance_m = float(position_m[last] - position_m[first])
    return float(speed_m_s[first] ** 2 - speed_m_s[last] ** 2) / (2.0 * distance_m)
