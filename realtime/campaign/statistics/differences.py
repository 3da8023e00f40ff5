"""Whether two samples of a figure differ: by how much, and whether that is more than chance.

[P1] Pairs: the same run in two campaigns. The differences of the pairs have a median with an
     interval by rank, as in `quantiles`. The Wilcoxon signed-rank test decides. Pairs without a
     difference count in its ranks (Pratt).
[P2] Two samples without pairs: the difference of their medians. Each median has an interval by rank
     that misses it with half of the allowed probability. The difference of their ends therefore
     holds with the whole confidence, whatever the laws, and also if the samples depend on one
     another. The Mann-Whitney test decides.
[P3] Several figures together: with many figures, one differs by chance. Their probabilities are
     corrected for every kind of dependence between the figures.

Sources: Wilcoxon 1945, Pratt 1959 [P1]; Mann and Whitney 1947 [P2]; Benjamini and Yekutieli 2001
[P3].
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from rollerrig.realtime.campaign.statistics import draws, quantiles

CONFIDENCE = 0.95
# a difference is statistically significant if chance alone makes it more rarely than this
SIGNIFICANT = 1.0 - CONFIDENCE


class Difference(NamedTuple):
    """The second sample less the first one, in the unit of the values.

    median: median of the differences of pairs, or difference of the medians.
    low, high: its interval, -inf and inf where there are too few values.
    p_value: probability that chance alone makes such a difference; None without a test.
    """

    median: float
    low: float
    high: float
    p_value: float | None


class Counts(NamedTuple):
    """Numbers of pairs in which the second value is larger, smaller and equal."""

    larger: int
    smaller: int
    equal: int

    @property
    def pairs(self) -> int:
        """The number of all pairs."""
        return sum(self)


def of_pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, Counts]:
    """Return the differences (n,) of pairs (n,), and which value of each pair is larger.

    inf is a value that is larger than any other; two of them are equal.
    """
    both_infinite = np.isinf(first) & (first == second)
    gaps = np.where(both_infinite, 0.0, second) - np.where(both_infinite, 0.0, first)
    counts = Counts(
        larger=int((gaps > 0.0).sum()),
        smaller=int((gaps < 0.0).sum()),
        equal=int((gaps == 0.0).sum()),
    )
    return gaps, counts


def paired(gaps: np.ndarray, confidence: float = CONFIDENCE) -> Difference:
    """Return the median of the differences (n,) of pairs, its interval and the test [P1]; n > 0."""
    interval = quantiles.interval(gaps, 0.5, confidence)
    return Difference(
        median=float(np.median(gaps)),
        low=interval.low,
        high=interval.high,
        p_value=_signed_rank(gaps),
    )


def _signed_rank(gaps: np.ndarray) -> float:
    """Return the probability of the Wilcoxon signed-rank test, two-sided."""
    if not gaps.any():
        return 1.0
    # the test reads ranks only, and it refuses infinite values
    finite = gaps[np.isfinite(gaps)]
    beyond_all = 2.0 * np.abs(finite).max(initial=1.0)
    ranked = np.clip(gaps, -beyond_all, beyond_all)
    return float(stats.wilcoxon(ranked, zero_method="pratt").pvalue)


def of_medians(
    first: draws.Draws, second: draws.Draws, confidence: float = CONFIDENCE
) -> Difference:
    """Return the difference of the medians of two samples, without a test [P2].

    Both samples have at least one value.
    """
    each = 0.5 * (1.0 + confidence)
    of_first = quantiles.interval(first, 0.5, each)
    of_second = quantiles.interval(second, 0.5, each)
    return Difference(
        median=_less(_median(second), _median(first)),
        low=_less(of_second.low, of_first.high),
        high=_less(of_second.high, of_first.low),
        p_value=None,
    )


def _median(ordered: draws.Draws) -> float:
    """Return the middle of a sample, as numpy defines it."""
    below = ordered.at((ordered.size + 1) // 2)
    above = ordered.at(ordered.size // 2 + 1)
    return below if below == above else 0.5 * (below + above)


def _less(value: float, other: float) -> float:
    """Return a difference; two values beyond all others do not differ."""
    return 0.0 if value == other else value - other


def unpaired(first: np.ndarray, second: np.ndarray, confidence: float = CONFIDENCE) -> Difference:
    """Return the difference of the medians of two samples (n,) and (m,), and the test [P2].

    Both samples have at least one value.
    """
    found = of_medians(draws.of(first), draws.of(second), confidence)
    test = stats.mannwhitneyu(second, first)
    return found._replace(p_value=float(test.pvalue))


def corrected(p_values: Sequence[float]) -> list[float]:
    """Return the probabilities of several figures, corrected for their number [P3]."""
    if not p_values:
        return []
    return [float(p) for p in stats.false_discovery_control(p_values, method="by")]


def is_significant(p_value: float | None) -> bool:
    """Return whether a difference is statistically significant; never without a test."""
    return p_value is not None and not math.isnan(p_value) and p_value < SIGNIFICANT
