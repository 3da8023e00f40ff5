"""Finds short drops of a wheel's speed in hard braking, by what the same wheel does around them.

At the peak of its adhesion a tyre creeps by a few percent of the speed, so sliding must be larger
than that to show against the vehicle. But creepage follows the deceleration, and changes as slowly.
A wheel that loses speed and takes it up again while the vehicle is braked has slid:

    [W1] excess(t) = s(t) - max(q before t, q after t)

s is the sliding against the reference, or without one against the other wheels, and q its lower
quartile in DROP_WINDOW_S. It is the top hat of morphology, with quartiles for minima because of the
noise. What the deceleration of the vehicle does in the same time is subtracted: creepage that
follows it is no slide.

On a rough road wheels are faster as often as they are slower. So a drop must be larger than nearly
all rises of the wheel. Source of the top hat: Serra, Image Analysis and Mathematical Morphology
(1982), chapter XII.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import percentile_filter

from rollerrig.rig.identify.statistics import robust_line
from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, slope
from rollerrig.rig.identify.train_recorder.sampling import stretches

# percentile of the sliding before and after a drop
_LOWER_QUARTILE = 25.0

# percentile of the rises of a wheel that a drop must exceed, by this factor
_MOST_RISES = 99.5
_RISE_FACTOR = 1.5

# share of a drop's threshold above which the drop begins and ends
_EDGE_SHARE = 0.5

# s. The deceleration is that of so much on both sides.
_HALF_S = 0.3


# Of so many other wheels the median is compared with; of fewer the fastest one.
_LEAST_FOR_MEDIAN = 3


class Excess(NamedTuple):
    """Sliding beyond that before and after [W1], and the least one that counts, m/s, (n, m)."""

    excess_m_s: np.ndarray
    smallest_m_s: np.ndarray


def can_be_seen(a: Aligned) -> bool:
    """Whether the rate is high enough for drops, and there is a speed to compare with."""
    is_fast = a.step_s <= limit.DROP_STEP_S
    return is_fast and (a.has_reference or len(a.names) > 1)


def _sliding(a: Aligned) -> np.ndarray:
    """Return by how much each wheel is below the reference or the other wheels, m/s, (n, m)."""
    if a.has_reference:
        return np.asarray(a.reference[:, None] - a.speed)
    columns = []
    for j in range(len(a.names)):
        others = np.delete(a.speed, j, axis=1)
        is_few = others.shape[1] < _LEAST_FOR_MEDIAN
        base = np.max(others, axis=1) if is_few else sampling.median(others.T)
        columns.append(base - a.speed[:, j])
    return np.column_stack(columns)


def excess(a: Aligned, v: np.ndarray, least_m_s: np.ndarray) -> Excess:
    """Return the excess of each speed [W1]; `least_m_s` (m,) are the least drops that count."""
    change_m_s2 = np.nan_to_num(slope(a.time_s, v, _HALF_S))
    creepage_m_s = limit.SLIDE_SHARE_M_S2 * np.abs(change_m_s2) * np.nan_to_num(v)
    by_creepage = np.maximum(_beyond(creepage_m_s, a.step_s), 0.0)
    columns = []
    for column in _sliding(a).T:
        known = np.isfinite(column)
        beyond = np.full(column.size, -np.inf)
        if np.count_nonzero(known) > 1:
            beyond = np.where(known, _beyond(_filled(column), a.step_s), -np.inf)
        # a driven wheel that stops slipping for a moment becomes no slower than the vehicle
        columns.append(np.minimum(beyond, np.where(known, column, -np.inf)))
    smallest = least_m_s[None, :] + by_creepage[:, None]
    return Excess(np.column_stack(columns), smallest)


def _filled(values: np.ndarray) -> np.ndarray:
    """Return values (n,) with straight lines in place of NaN."""
    at = np.arange(values.size)
    known = np.isfinite(values)
    return np.interp(at, at[known], values[known])


def _beyond(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return by how much values (n,) exceed their lower quartiles before and after [W1]."""
    count = max(round(limit.DROP_WINDOW_S / step_s), 3) | 1
    half = count // 2
    before = percentile_filter(values, _LOWER_QUARTILE, size=count, origin=half, mode="nearest")
    after = percentile_filter(values, _LOWER_QUARTILE, size=count, origin=-half, mode="nearest")
    return np.asarray(values - np.maximum(before, after))


def least(a: Aligned, v: np.ndarray, smallest_m_s: np.ndarray) -> np.ndarray:
    """Return the least drop of each speed that counts in a run, m/s, (m,).

    `smallest_m_s` (m,) is what noise and rounding of a sample allow.
    """
    moves = np.nan_to_num(v) > a.slowest_m_s
    found = []
    for column, by_sample in zip(_sliding(a).T, smallest_m_s, strict=True):
        known = moves & np.isfinite(column)
        if not known.any():
            found.append(float(by_sample))
            continue
        filled = _filled(column)
        deviation = robust_line.deviation(_beyond(filled, a.step_s)[known])
        rises = _beyond(-filled, a.step_s)[known]
        by_rises = _RISE_FACTOR * float(np.percentile(rises, _MOST_RISES))
        found.append(max(float(by_sample), limit.SLIDE_DEVIATIONS * deviation, by_rises))
    return np.array(found)


def flags(of: Excess, is_braked: np.ndarray, shortest: int) -> np.ndarray:
    """Return where each speed drops for `shortest` samples or more, flags (n, m).

    A drop begins and ends at half of what counts. `is_braked` (n,) is where the vehicle is braked.
    """
    found = np.zeros(of.excess_m_s.shape, bool)
    for j in range(found.shape[1]):
        is_above = of.excess_m_s[:, j] > of.smallest_m_s[:, j]
        begun = of.excess_m_s[:, j] > _EDGE_SHARE * of.smallest_m_s[:, j]
        for stretch in stretches(begun & is_braked):
            part = slice(stretch.first, stretch.last + 1)
            is_long = stretch.last - stretch.first + 1 >= shortest
            if is_long and is_above[part].any():
                found[part, j] = True
    return found
