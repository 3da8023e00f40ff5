"""Finds out whether the sizes of several runs are one size, or those of two groups of runs.

    [G1] Q = sum ((x_i - mean) / e_i)^2, chi-square with n - 1 degrees of freedom if all are equal
    [G2] the two groups have the least sum of squares within them
    [G3] the gap between both groups is wider than each of them

Without [G3] the sizes differ, and no two groups show. Source of [G1]: Cochran, Biometrics 10 (1954)
101-129.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from rollerrig.rig.identify.statistics.interval import Estimate

# Fewer sizes show no groups: of two it is open which one is apart.
LEAST_SIZES = 3


class Groups(NamedTuple):
    """Two groups, by the places of their sizes: the smaller one, and the others."""

    apart: tuple[int, ...]
    others: tuple[int, ...]
    difference: Estimate  # mean of `apart` less that of the others


def p_value(sizes: np.ndarray, errors: np.ndarray) -> float:
    """Return the probability that equal sizes differ as much by chance [G1]."""
    weights = 1.0 / errors**2
    mean = np.sum(weights * sizes) / weights.sum()
    return float(chi2.sf(np.sum(weights * (sizes - mean) ** 2), sizes.size - 1))


def find(sizes: np.ndarray, errors: np.ndarray, alpha: float, tests: int) -> Groups | None:
    """Return the two groups of sizes (n,) with standard errors (n,); None if there are none.

    Sizes that are NaN belong to no group. `tests` quantities share the probability `alpha` of a
    false alarm.
    """
    known = np.flatnonzero(np.isfinite(sizes) & np.isfinite(errors))
    if known.size < LEAST_SIZES or p_value(sizes[known], errors[known]) > alpha / tests:
        return None
    order = known[np.argsort(sizes[known], kind="stable")]
    splits = [(order[:k], order[k:]) for k in range(1, order.size)]
    low, high = min(splits, key=lambda split: sum(_squares(sizes[p], errors[p]) for p in split))

    gap = sizes[high].min() - sizes[low].max()
    if gap <= max(np.ptp(sizes[low]), np.ptp(sizes[high])):
        return None
    apart, others = low, high
    if (high.size, int(known[0]) in high) < (low.size, int(known[0]) in low):
        apart, others = high, low
    difference = _difference(sizes, errors, apart, others)
    if not difference.is_finding(alpha, tests):
        return None
    return Groups(tuple(sorted(apart.tolist())), tuple(sorted(others.tolist())), difference)


def _squares(sizes: np.ndarray, errors: np.ndarray) -> float:
    """Return the sum of squares of sizes about their mean, in units of their errors."""
    weights = 1.0 / errors**2
    mean = np.sum(weights * sizes) / weights.sum()
    return float(np.sum(weights * (sizes - mean) ** 2))


def _difference(
    sizes: np.ndarray, errors: np.ndarray, apart: np.ndarray, others: np.ndarray
) -> Estimate:
    """Return the difference of two groups. Sizes that scatter more than their errors widen it."""
    means = []
    variance = 0.0
    squares = 0.0
    for places in (apart, others):
        weights = 1.0 / errors[places] ** 2
        means.append(float(np.sum(weights * sizes[places]) / weights.sum()))
        variance += float(1.0 / weights.sum())
        squares += _squares(sizes[places], errors[places])
    freedom = apart.size + others.size - 2
    excess = squares / freedom
    if excess <= 1.0:
        return Estimate(means[0] - means[1], math.sqrt(variance))
    return Estimate(means[0] - means[1], math.sqrt(variance * excess), freedom)
