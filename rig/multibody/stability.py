"""The speed above which the wheelsets hunt.

A wheelset that is set off to the side swings about the track's middle on its conical wheels; yaw and creep damp the
swing at low speed and feed it at high speed. The critical speed is where a small swing neither grows nor dies.
"""

import math

import numpy as np

from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.multibody import stop
from rollerrig.rig.multibody.coach import Coach


def growth(
    coach: Coach, law: Law, speed_m_s: float, shift_m: float = 5e-4, duration_s: float = 4.0
) -> float:
    """How a small lateral swing grows: rate in 1/s, negative where it dies away.

    All wheelsets begin shift_m off the middle; the rate is that of the largest lateral displacement of any wheelset
    from the second to the last quarter of the time, or from the beginning, for a swing that has grown to its limit.
    """
    state = stop.rolling(coach, speed_m_s)
    for wheelset in range(3, 7):
        state.q[6 * wheelset + 1] = shift_m
    quarter = duration_s / 4.0
    largest = []
    for _ in range(4):
        peak = 0.0
        for _ in range(50):
            stop.advance(state, coach, law, quarter / 50.0)
            peak = max(peak, float(np.abs(state.q[19::6]).max()))
        largest.append(max(peak, 1e-12))
        if not np.isfinite(peak) or peak > 0.02:
            return math.inf
    return max(
        math.log(largest[3] / largest[1]) / (2.0 * quarter),
        math.log(largest[3] / shift_m) / duration_s,
    )


def critical_speed(
    coach: Coach, law: Law, speeds_m_s: np.ndarray | None = None, tolerance_m_s: float = 0.5
) -> float:
    """Speed in m/s above which the coach hunts: a sweep and bisection.

    Returns inf where it does not hunt at any of the speeds. `law` is the adhesion under the wheels;
    dry rails (k = 1) hunt first.
    """
    speeds = np.arange(40.0, 141.0, 10.0) if speeds_m_s is None else speeds_m_s
    stable = 0.0
    for speed in speeds:
        if growth(coach, law, float(speed)) > 0.0:
            low, high = stable, float(speed)
            while high - low > tolerance_m_s:
                middle = 0.5 * (low + high)
                if growth(coach, law, middle) > 0.0:
                    high = middle
                else:
                    low = middle
            return high
        stable = float(speed)
    return math.inf
