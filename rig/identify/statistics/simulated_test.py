"""Tests a statistic against simulations in which nothing is there.

    [P1] p = (1 + larger) / (1 + simulations), or larger / simulations where the test stops early

It stops early as soon as so many simulations are as large by chance. `scipy.stats.monte_carlo_test`
has [P1] without this stop.

Source: Besag and Clifford, Biometrika 78 (1991) 301-304.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Tested(NamedTuple):
    """The p-value of a statistic, and the simulated statistics."""

    p_value: float
    simulated: np.ndarray

    def critical(self, alpha: float) -> float:
        """The statistic that simulations exceed with probability alpha."""
        return float(np.quantile(self.simulated, 1.0 - alpha))


def p_value(
    statistic: float, simulate: Callable[[], float], most: int, least: int, enough: int
) -> Tested:
    """Return the p-value of a statistic [P1], from `least` to `most` simulations.

    The test stops early after `enough` simulations that are as large.
    """
    simulated: list[float] = []
    larger = 0
    is_stopped = False
    while len(simulated) < most and not is_stopped:
        simulated.append(simulate())
        larger += simulated[-1] >= statistic
        is_stopped = larger >= enough and len(simulated) >= least
    count = len(simulated)
    p = larger / count if is_stopped else (1 + larger) / (1 + count)
    return Tested(p, np.array(simulated))
