"""Finds an offset of one of four speeds, also where low speed occurs once.

    [F1] q = v_1 - v_2 - v_3 + v_4 = k V + c + d A, V the median of the four, A its change

A curve, a slope and creepage change the two speeds of a side, or of an axle, by the same amount.
They cancel in q, whether the wheels are in order by axle or by side. An offset c of one speed stays
in q. A delay d of one speed is fitted beside it. Samples in braking are left out.

The wheels of one vehicle have similar radii. So the speed with the offset is the one whose
correction makes the four ratios most alike.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.statistics import resampling, robust_line
from rollerrig.rig.identify.statistics.interval import Estimate
from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, slope

# m/s. Standard error of an offset that no amount of data removes: curves do not cancel
# fully. Chosen.
_SYSTEMATIC_M_S = 0.01

# signs of the four speeds in [F1]
_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])

# stretches of the recording that are left out one after the other for the error, and at least
_STRETCHES = 12
_LEAST_STRETCHES = 6

# share of the spread of the ratios with the second best correction that the best one leaves.
# Chosen.
_BEST_SHARE = 0.5


class WheelOffset(NamedTuple):
    """An offset of a speed with its standard error, m/s."""

    name: str
    offset_m_s: float
    error_m_s: float
    blocks: int


class _Blocks(NamedTuple):
    """Means over blocks: speeds (n, 4), their median and its change (n,)."""

    speed: np.ndarray
    middle: np.ndarray
    change_m_s2: np.ndarray


def offset(group: list[Aligned]) -> WheelOffset | None:
    """Return the offset of one of four speeds of a vehicle; None if none is significant."""
    names = group[0].names
    if len(names) != _SIGNS.size or any(a.names != names for a in group):
        return None
    blocks = _blocks(group)
    stretches = min(_STRETCHES, blocks.middle.size // 2)
    if stretches < _LEAST_STRETCHES:
        return None
    low, high = np.quantile(blocks.middle, (0.05, 0.95))
    slow_blocks = np.count_nonzero(blocks.middle < np.sqrt(low * high))
    if high < limit.OFFSET_RANGE * low or slow_blocks < limit.OFFSET_BLOCKS:
        return None

    q = blocks.speed @ _SIGNS
    columns = np.column_stack([blocks.middle, blocks.change_m_s2, np.ones(q.size)])
    without = columns[:, :2]
    weight = np.ones(q.size)
    fit = robust_line.fit(columns, q, weight)
    size_m_s = float(fit[-1])
    by_stretches = resampling.jackknife_errors(columns, q, weight, stretches)[-1]
    if by_stretches == 0.0:
        return None
    error_m_s = float(np.hypot(by_stretches, _SYSTEMATIC_M_S))
    estimate = Estimate(size_m_s, error_m_s, resampling.STRETCHES - 1)

    left = np.mean(np.abs(q - columns @ fit))
    left_without = np.mean(np.abs(q - without @ robust_line.fit(without, q, weight)))
    is_significant = estimate.is_finding(limit.ALPHA, _SIGNS.size, limit.LEAST_OFFSET_M_S)
    if not is_significant or left > limit.OFFSET_SCATTER * left_without:
        return None
    wheel = _wheel(blocks, size_m_s)
    if wheel is None:
        return None
    return WheelOffset(names[wheel], float(_SIGNS[wheel]) * size_m_s, error_m_s, q.size)


def _blocks(group: list[Aligned]) -> _Blocks:
    """Return the means over blocks in which the vehicle moves and is not braked."""
    speeds = []
    middles = []
    changes = []
    for a in group:
        middle = sampling.median(a.speed.T)
        change_m_s2 = slope(a.time_s, middle, max(1.0, 2.5 * a.step_s))
        good = np.isfinite(a.speed).all(axis=1) & (middle > a.slowest_m_s)
        good &= np.nan_to_num(change_m_s2, nan=-np.inf) > -limit.QUIET_M_S2
        number_of_block = a.blocks()
        for k in np.unique(number_of_block[good]):
            part = good & (number_of_block == k)
            if a.is_filled(part):
                speeds.append(a.speed[part].mean(axis=0))
                middles.append(float(middle[part].mean()))
                changes.append(float(change_m_s2[part].mean()))
    return _Blocks(np.reshape(speeds, (-1, _SIGNS.size)), np.array(middles), np.array(changes))


def _wheel(blocks: _Blocks, size_m_s: float) -> int | None:
    """Return the speed whose correction makes the ratios most alike; None if two do nearly."""
    spreads = []
    for wheel, sign in enumerate(_SIGNS):
        corrected = blocks.speed.copy()
        corrected[:, wheel] -= sign * size_m_s
        ratios = corrected.sum(axis=0) / blocks.middle.sum()
        spreads.append(float(np.abs(ratios - np.median(ratios)).sum()))
    best, second = np.argsort(spreads)[:2]
    return int(best) if spreads[best] < _BEST_SHARE * spreads[second] else None
