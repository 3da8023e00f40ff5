"""Measures the smallest slide that this recording shows, by planting slides into it.

At random places where the vehicle is braked, the speed of a random wheel is lowered by a trapezoid.
The smallest size is that at which half of the planted slides are found, over all places: at high
speed and in hard braking only larger slides show, elsewhere smaller ones too. A planted slide
counts as found only if it would be reported: the interval of its measured size reaches the size
that is stated, and excludes 0.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, slope
from rollerrig.rig.identify.train_recorder.sliding import slides
from rollerrig.rig.identify.train_recorder.sliding.slides import Noise

# planted slides of each size
PLACES = 60

# share of the planted slides that are found at the smallest size
POWER = 0.5

# m/s. First, smallest and largest size that is tried, and the ratio to which the size is known.
_FIRST_M_S = 0.6
_LEAST_M_S = 0.02
_MOST_M_S = 20.0
_RATIO = 1.1

# m/s^2 and s. A slide is planted where the vehicle loses more speed, by so much on both sides.
_BRAKED_M_S2 = -0.8
_HALF_S = 0.3

# s. So much of the recording around a planted slide is judged.
_AROUND_S = 3.0

# share of its duration in which a planted slide grows, and in which it ends
_EDGE_SHARE = 0.25

# share of the fastest speed below which nothing is planted
_SLOWEST_SHARE = 0.15


class Place(NamedTuple):
    """Where a slide is planted: a part of a run, a wheel, and the first sample in the part."""

    part: Aligned
    noise: Noise
    wheel: int
    first: int


def shortest_s(a: Aligned) -> float:
    """Return the duration of a planted slide: the shortest that is judged, with its edges."""
    return limit.slide_s(a.step_s) / (1.0 - 2.0 * _EDGE_SHARE)


def places(aligned: list[Aligned], braked: list[np.ndarray], near: list[np.ndarray]) -> list[Place]:
    """Return random places for planted slides.

    `braked` are the flags (n,) where a run is braked, `near` those near its slides.
    """
    rng = np.random.default_rng(1)
    candidates = _candidates(aligned, braked, near, _BRAKED_M_S2)
    if not candidates:
        # a slow robot never brakes so hard
        candidates = _candidates(aligned, braked, near, 0.0)
    if not candidates:
        return []
    noises = {}
    found = []
    for place in rng.integers(0, len(candidates), PLACES):
        k, first = candidates[place]
        a = aligned[k]
        if k not in noises:
            noises[k] = slides.noise_of(a, slides.vehicle(a))
        around = round((_AROUND_S + shortest_s(a)) / a.step_s)
        start = max(first - around, 0)
        end = min(first + around, a.time_s.size)
        wheel = int(rng.integers(len(a.names)))
        found.append(Place(a.part(start, end), noises[k], wheel, first - start))
    return found


def _candidates(
    aligned: list[Aligned], braked: list[np.ndarray], near: list[np.ndarray], most_m_s2: float
) -> list[tuple[int, int]]:
    """Return recording and first sample of each place where the vehicle brakes harder than that."""
    candidates = []
    for k, a in enumerate(aligned):
        v = slides.vehicle(a)
        slowest_m_s = max(a.slowest_m_s, _SLOWEST_SHARE * a.run.fastest_m_s)
        # at the edges of a braking only the mean of some seconds is braked
        change_m_s2 = np.nan_to_num(slope(a.time_s, v, max(_HALF_S, 2.5 * a.step_s)))
        good = braked[k] & (change_m_s2 < most_m_s2)
        good &= ~near[k] & (np.nan_to_num(v) > slowest_m_s)
        count = max(round(shortest_s(a) / a.step_s), 3)
        running = np.concatenate([[0], np.cumsum(good)])
        is_whole = running[count:] - running[:-count] == count
        candidates += [(k, int(first)) for first in np.flatnonzero(is_whole)]
    return candidates


def with_slide(speed: np.ndarray, first: int, count: int, size_m_s: float) -> np.ndarray:
    """Return a speed (n,) with a slide of `count` samples from sample `first` on."""
    edge = max(round(_EDGE_SHARE * count), 1)
    shape = np.minimum(np.minimum(np.arange(1, count + 1), np.arange(count, 0, -1)) / edge, 1.0)
    lowered = speed.copy()
    part = slice(first, first + count)
    lowered[part] = np.maximum(lowered[part] - size_m_s * shape[: lowered[part].size], 0.0)
    return lowered


def is_found(place: Place, size_m_s: float, stated_m_s: float) -> bool:
    """Whether a planted slide would be reported (`slides.at_least`)."""
    a = place.part
    count = max(round(shortest_s(a) / a.step_s), 3)
    speed = a.speed.copy()
    speed[:, place.wheel] = with_slide(speed[:, place.wheel], place.first, count, size_m_s)
    planted = a._replace(speed=speed)
    seen = slides.flags(planted, slides.vehicle(planted), place.noise)
    part = slice(place.first, place.first + count)
    within = np.where(seen.slides_at[part], seen.size_m_s[part], 0.0)
    size = float(within[:, place.wheel].max())
    half = slides.half_interval_m_s(size, float(place.noise.scatter_m_s[place.wheel]))
    return size > half and size + half >= stated_m_s


def smallest_m_s(places_of: list[Place]) -> float:
    """Return the smallest size of a slide that these places show, m/s; infinite if they show none.

    The power grows with the size. So the size is bracketed by doubling, and then bisected.
    """
    if not places_of:
        return np.inf
    high_m_s = _FIRST_M_S
    while not _is_shown(places_of, high_m_s):
        high_m_s *= 2.0
        if high_m_s > _MOST_M_S:
            return np.inf
    low_m_s = 0.5 * high_m_s
    # the first size may be far above the smallest one
    is_first = high_m_s == _FIRST_M_S
    while is_first and low_m_s > _LEAST_M_S and _is_shown(places_of, low_m_s):
        high_m_s = low_m_s
        low_m_s *= 0.5
    while high_m_s > _RATIO * low_m_s:
        middle_m_s = float(np.sqrt(low_m_s * high_m_s))
        if _is_shown(places_of, middle_m_s):
            high_m_s = middle_m_s
        else:
            low_m_s = middle_m_s
    return high_m_s


def _is_shown(places_of: list[Place], size_m_s: float) -> bool:
    """Whether half of the slides of a size are found; it stops when that is certain."""
    needed = int(np.ceil(POWER * len(places_of)))
    allowed = len(places_of) - needed
    for place in places_of:
        if is_found(place, size_m_s, size_m_s):
            needed -= 1
        else:
            allowed -= 1
        if needed == 0 or allowed < 0:
            break
    return allowed >= 0
