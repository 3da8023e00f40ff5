"""Quantiles and probabilities with one-sided bounds that hold for every law.

[Q1] The k-th smallest of n independent draws is above the q-quantile with the confidence
     P(B(n, q) <= k - 1), whatever the law. B is a binomial number. The bound is the smallest k
     that reaches the required confidence. With k = n and q = 0.95 it needs 59 draws.
[Q2] x of n draws are beyond a limit. The upper bound of the probability is the
     confidence-quantile of a beta law with the parameters x + 1 and n - x.
[Q3] A two-sided interval is between two such draws. Each of its ends misses the quantile with at
     most half of the allowed probability.

The rank in [Q1] is a whole number. Therefore the confidence that a bound reaches is above the
required one, and `UpperBound.confidence` states it.

Sources: Wilks 1941 [Q1, Q3]; Clopper and Pearson 1934 [Q2].
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import stats

from rollerrig.realtime.campaign.statistics import draws

CONFIDENCE = 0.95  # of a one-sided bound, if the caller requires no other


class UpperBound(NamedTuple):
    """A quantile and a value that it does not exceed, with a confidence.

    quantile: share of the law below the value.
    estimate: the order statistic of the sample at this share.
    rank: place of the bound in the sorted sample, from 1; 0 if there are too few draws.
    bound: value at that rank; inf if there are too few draws.
    confidence: the confidence that this rank reaches; 0 without a bound.
    needs: the fewest draws that give a bound.
    """

    quantile: float
    estimate: float
    rank: int
    bound: float
    confidence: float
    needs: int


def rank(count: int, quantile: float, confidence: float = CONFIDENCE) -> int:
    """Return the rank, from 1, of the draw that bounds a quantile from above [Q1].

    0 if there are too few draws.
    """
    found = int(stats.binom.ppf(confidence, count, quantile)) + 1
    return found if found <= count else 0


def reached(count: int, quantile: float, bound_rank: int) -> float:
    """Return the confidence that the draw of a rank is above the quantile [Q1]."""
    return float(stats.binom.cdf(bound_rank - 1, count, quantile))


def fewest(quantile: float, confidence: float = CONFIDENCE) -> int:
    """Return the fewest draws whose largest one bounds a quantile from above [Q1]."""
    return math.ceil(math.log(1.0 - confidence) / math.log(quantile))


def upper_bound(
    values: np.ndarray | draws.Draws, quantile: float, confidence: float = CONFIDENCE
) -> UpperBound:
    """Return the estimate of a quantile, and its upper bound [Q1].

    `values` (n,) are independent draws, n > 0; inf is larger than any other.
    """
    ordered = draws.of(values)
    bound_rank = rank(ordered.size, quantile, confidence)
    estimate = ordered.at(max(math.ceil(quantile * ordered.size), 1))
    return UpperBound(
        quantile=quantile,
        estimate=estimate,
        rank=bound_rank,
        bound=ordered.above(bound_rank) if bound_rank else math.inf,
        confidence=reached(ordered.size, quantile, bound_rank) if bound_rank else 0.0,
        needs=fewest(quantile, confidence),
    )


class Interval(NamedTuple):
    """A two-sided interval of a quantile, -inf and inf where there are too few draws.

    confidence: the confidence that its ranks reach.
    """

    low: float
    high: float
    confidence: float


def interval(
    values: np.ndarray | draws.Draws, quantile: float, confidence: float = CONFIDENCE
) -> Interval:
    """Return the two-sided interval of a quantile [Q3]; `values` (n,) as in `upper_bound`."""
    ordered = draws.of(values)
    missed = 0.5 * (1.0 - confidence)
    # the draw of rank k is above the quantile with the probability P(B <= k - 1)
    low_rank = int(stats.binom.ppf(missed, ordered.size, quantile))
    high_rank = rank(ordered.size, quantile, 1.0 - missed)
    low_misses = reached(ordered.size, quantile, low_rank) if low_rank else 0.0
    high_reaches = reached(ordered.size, quantile, high_rank) if high_rank else 1.0
    return Interval(
        low=ordered.below(low_rank) if low_rank else -math.inf,
        high=ordered.above(high_rank) if high_rank else math.inf,
        confidence=high_reaches - low_misses,
    )


def probability_bound(beyond: int, count: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper bound of a probability of which `beyond` of `count` draws are cases [Q2]."""
    if beyond >= count:
        return 1.0
    return float(stats.beta.ppf(confidence, beyond + 1, count - beyond))
