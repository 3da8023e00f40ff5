"""The speed above which the wheelsets hunt.

A wheelset that is displaced to the side oscillates about the middle of the track on its conical
wheels. Yaw and creep damp the oscillation at low speed and feed it at high speed. At the critical
speed a small oscillation neither grows nor decays.
"""

import math

import numpy as np

from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.multibody import stop
from rollerrig.rig.multibody.coach import Coach
from rollerrig.rig.multibody.coordinates import BEFORE_WHEELSETS, PER_BODY, WHEELSETS, Y

_QUARTERS = 4
# the displacement is looked at so many times in a quarter
_SAMPLES = 50
# a lateral displacement beyond this has no limit
_LARGEST_M = 0.02
_SMALLEST_M = 1e-12


def growth(
    coach: Coach, law: Law, speed_m_s: float, shift_m: float = 5e-4, duration_s: float = 4.0
) -> float:
    """Return the rate in 1/s at which a small lateral oscillation grows, negative where it decays.

    All wheelsets begin shift_m off the middle. The rate is that of the largest lateral displacement
    of any wheelset from the second to the last quarter of the time; or the rate from the beginning,
    if it is larger: it counts for an oscillation that has grown to its limit. Returns inf without a
    limit.
    """
    state = stop.rolling(coach, speed_m_s)
    for wheelset in WHEELSETS:
        state.q[PER_BODY * wheelset + Y] = shift_m
    quarter_s = duration_s / _QUARTERS
    largest_m = []
    for _ in range(_QUARTERS):
        peak_m = 0.0
        for _ in range(_SAMPLES):
            stop.advance(state, coach, law, quarter_s / _SAMPLES)
            lateral_m = state.q[BEFORE_WHEELSETS + Y :: PER_BODY]
            peak_m = max(peak_m, float(np.abs(lateral_m).max()))
        largest_m.append(max(peak_m, _SMALLEST_M))
        if not np.isfinite(peak_m) or peak_m > _LARGEST_M:
            return math.inf
    return max(
        math.log(largest_m[3] / largest_m[1]) / (2.0 * quarter_s),
        math.log(largest_m[3] / shift_m) / duration_s,
    )


def critical_speed(
    coach: Coach, law: Law, speeds_m_s: np.ndarray | None = None, tolerance_m_s: float = 0.5
) -> float:
    """Return the speed in m/s above which the coach hunts; inf where it never hunts.

    It is found by a sweep over the speeds and a bisection. `law` is the adhesion under the wheels;
    on dry rails (k = 1) a coach hunts first.
    """
    speeds = np.arange(40.0, 141.0, 10.0) if speeds_m_s is None else speeds_m_s
    stable = 0.0
    for speed in speeds:
        grows = growth(coach, law, float(speed)) > 0.0
        if not grows:
            stable = float(speed)
            continue
        low = stable
        high = float(speed)
        while high - low > tolerance_m_s:
            middle = 0.5 * (low + high)
            if growth(coach, law, middle) > 0.0:
                high = middle
            else:
                low = middle
        return high
    return math.inf
