"""Decides by an interval whether an estimate is a finding.

    [I1] value +- t error, t the quantile of Student's distribution with so many degrees of freedom
    [I2] family-wise: the quantile at alpha / tests, so that alpha is the probability of a false
         alarm in any of the tests (Bonferroni)
    [I3] freedom = (sum e_k^2)^2 / sum (e_k^4 / freedom_k), of a sum of independent errors e_k

An estimate is a finding if and only if its interval [I2] excludes nothing: the value without an
effect, and all values that are too near to it to matter. The 95 % interval of a report is inside
of [I2] if alpha / tests is below 5 %. So no finding has a reported interval with nothing in it.

Source of [I3]: Welch, Biometrika 34 (1947) 28-35; Satterthwaite, Biometrics Bulletin 2 (1946)
110-114.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy.stats import t as student

# of the intervals that a report shows
REPORTED = 0.95


class Estimate(NamedTuple):
    """A value with its standard error, which is known from so many degrees of freedom."""

    value: float
    error: float
    freedom: float = math.inf

    def half_width(self, level: float = REPORTED) -> float:
        """Half the width of the interval [I1] at a level."""
        return float(student.ppf(0.5 + 0.5 * level, self.freedom)) * self.error

    def interval(self, level: float = REPORTED) -> tuple[float, float]:
        """The ends of the interval [I1] at a level."""
        half = self.half_width(level)
        return self.value - half, self.value + half

    def smallest(self, alpha: float, tests: int, least: float = 0.0) -> float:
        """The smallest distance from nothing that is a finding [I2]: its power is one half."""
        return least + self.half_width(1.0 - alpha / tests)

    def is_finding(
        self, alpha: float, tests: int, least: float = 0.0, nothing: float = 0.0
    ) -> bool:
        """Whether the interval [I2] excludes nothing, and all values nearer to it than `least`."""
        return abs(self.value - nothing) > self.smallest(alpha, tests, least)


def excludes(low: float, high: float, nothing: float = 0.0) -> bool:
    """Return whether an interval excludes a value; an interval that is unknown excludes nothing."""
    return low > nothing or high < nothing


def freedom_of_sum(parts: Sequence[tuple[float, float]]) -> float:
    """Return the degrees of freedom of a sum of errors (error, freedom) [I3]."""
    variance = sum(error**2 for error, _ in parts)
    uncertain = sum(error**4 / freedom for error, freedom in parts)
    return variance**2 / uncertain if uncertain > 0.0 else math.inf
