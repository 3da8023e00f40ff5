"""Quantiles beyond the sample: a generalised Pareto law above a threshold.

[T1] Above a high threshold u, the excess x - u of almost every law follows a generalised Pareto
     law with a shape xi and a scale sigma. The share of draws above u is zeta.
[T2] The value that a share p of all draws exceeds is
     x = u + sigma / xi * ((zeta / p) ** xi - 1), and u + sigma * log(zeta / p) at xi = 0.
[T3] The likelihood of (zeta, xi, sigma) is a binomial one for the number of excesses, times that
     of their sizes. The estimate maximises it.
[T4] The profile likelihood of x: the largest likelihood of all (zeta, xi, sigma) that give x by
     [T2]. The signed root of twice its distance from the maximum is about normal, so an end of
     the interval is where it equals a quantile of the normal law.

The law [T1] is a limit. How well it holds depends on the true law and on the threshold, and no
sample can prove it. Below a shape of -0.5 the theory of [T4] does not hold: the law then ends in a
step, at about the largest draw. `fit` refuses such a sample.

Sources: Pickands 1975 [T1]; Coles 2001, chapters 2.6 and 4.3 [T2, T3, T4].
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from rollerrig.realtime.campaign.statistics import draws

SHARE = 0.1  # of the draws that are above the threshold, if the caller requires no other
FEWEST = 50  # excesses: fewer give no interval that keeps its level
LEAST_SHAPE = -0.5  # below it the likelihood is not regular
MOST_SHAPE = 1.0  # above it not even the mean exists
# shapes that are computed as 0, the exponential law
_NO_SHAPE = 1e-6
# the ends of an interval are searched up to this many widenings of the first step
_WIDENINGS = 60


class NoTailError(ValueError):
    """A sample has no tail that this law describes; the text states why, for users."""


class Tail(NamedTuple):
    """A generalised Pareto law that was fitted to the largest draws of a sample.

    threshold, shape, scale: u, xi and sigma of [T1].
    excesses: (k,), x - u of the draws above the threshold.
    draws: number of all draws.
    """

    threshold: float
    shape: float
    scale: float
    excesses: np.ndarray
    draws: int

    @property
    def share(self) -> float:
        """The share of the draws above the threshold."""
        return self.excesses.size / self.draws


class Extrapolated(NamedTuple):
    """A value that a share of all draws exceeds.

    exceeded: the share p of [T2].
    low, high: ends of the two-sided interval with the required confidence.
    bound: one-sided upper bound with the same confidence.
    """

    exceeded: float
    estimate: float
    low: float
    high: float
    bound: float


def fit(values: np.ndarray | draws.Draws, share: float = SHARE) -> Tail:
    """Return the law of the largest draws [T3]; `values` (n,) are independent draws.

    `share` of the draws are above the threshold; fewer if fewer of the largest draws are kept.
    Raises NoTailError.
    """
    ordered = draws.of(values)
    largest = ordered.largest
    excess_count = max(min(int(share * ordered.size), largest.size - 1), 0)
    if excess_count < FEWEST:
        raise NoTailError(
            f"{ordered.size} runs have {excess_count} in their tail of {100 * share:g} %; "
            f"at least {FEWEST} are needed, so {math.ceil(FEWEST / share)} runs"
        )
    if not np.isfinite(largest[-1]):
        raise NoTailError(
            "some runs have no finite value (they did not stop), so the law of the longest is "
            "unknown; raise duration_max_s until all runs stop"
        )
    threshold = largest[-excess_count - 1]
    excesses = largest[-excess_count:] - threshold
    if not excesses[0] > 0.0 or np.unique(excesses).size < FEWEST:
        raise NoTailError(
            "many of the longest runs have the same value, so the law of the tail is not "
            "continuous; vary inputs that change the value"
        )

    mean = float(excesses.mean())
    unit_excesses = excesses / mean
    least = optimize.minimize(
        lambda place: _cost_of_sizes(unit_excesses, place[0], place[1]),
        (0.0, 0.0),
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-9, "maxiter": 2000},
    )
    shape, log_scale = least.x
    if shape < LEAST_SHAPE:
        raise NoTailError(
            f"the longest runs end in a step (shape {shape:.2f}, allowed from {LEAST_SHAPE:g}), as "
            "where an input is limited by low and high; use the bounds by rank, or distributions "
            "without an end"
        )
    scale = math.exp(log_scale) * mean
    return Tail(float(threshold), float(shape), scale, excesses, ordered.size)


def _cost_of_sizes(excesses: np.ndarray, shape: float, log_scale: float) -> float:
    """Return the negative logarithm of the likelihood of sizes [T3]; inf where it is 0."""
    if not -1.0 < shape <= MOST_SHAPE:
        return math.inf
    in_scales = excesses * math.exp(-log_scale)
    if abs(shape) < _NO_SHAPE:
        return excesses.size * log_scale + float(in_scales.sum())
    # the largest one decides whether the law has ended before it
    if 1.0 + shape * in_scales[-1] <= 0.0:
        return math.inf
    logs = float(np.log1p(shape * in_scales).sum())
    return excesses.size * log_scale + (1.0 + 1.0 / shape) * logs


def _cost_of_number(share: float, number: int, count: int) -> float:
    """Return the negative logarithm of the binomial likelihood [T3], without its constant."""
    if not 0.0 < share < 1.0:
        return math.inf
    return -number * math.log(share) - (count - number) * math.log1p(-share)


def exceeded(tail: Tail, share: float, confidence: float = 0.95) -> Extrapolated:
    """Return the value that a share of all draws exceeds, with its interval [T2, T4].

    Raises ValueError unless the share is below that of the threshold.
    """
    if not 0.0 < share < tail.share:
        raise ValueError(f"share {share:g}: must be above 0 and below {tail.share:g}")
    estimate = excess(tail, share)
    profile = _profile(tail, share, estimate)
    two_sided = stats.norm.ppf(0.5 + 0.5 * confidence)
    one_sided = stats.norm.ppf(confidence)
    return Extrapolated(
        exceeded=share,
        estimate=tail.threshold + estimate,
        low=tail.threshold + _end(profile, estimate, -two_sided),
        high=tail.threshold + _end(profile, estimate, two_sided),
        bound=tail.threshold + _end(profile, estimate, one_sided),
    )


def excess(tail: Tail, share: float) -> float:
    """Return x - u of the value that a share of all draws exceeds [T2]."""
    return _excess_at(tail.share / share, tail.shape, tail.scale)


def _excess_at(ratio: float, shape: float, scale: float) -> float:
    """Return x - u of [T2]; `ratio` is zeta / p."""
    if abs(shape) < _NO_SHAPE:
        return scale * math.log(ratio)
    return scale * math.expm1(shape * math.log(ratio)) / shape


def _log_ratio(excess: float, shape: float, scale: float) -> float:
    """Return log(zeta / p) of [T2] for an excess; inf where the law has ended before it."""
    in_scales = excess / scale
    if abs(shape) < _NO_SHAPE:
        return in_scales
    if 1.0 + shape * in_scales <= 0.0:
        return math.inf
    return math.log1p(shape * in_scales) / shape


def _profile(tail: Tail, share: float, estimate: float) -> Callable[[float], float]:
    """Return the signed root of [T4] as a function of the excess x - u."""
    unit = float(tail.excesses.mean())
    excesses = tail.excesses / unit
    number = excesses.size
    place = np.array([tail.shape, math.log(tail.scale / unit)])
    best = _cost_of_sizes(excesses, *place) + _cost_of_number(tail.share, number, tail.draws)
    # the search at one excess begins where the search at the one before has ended
    begins = {estimate: place}
    roots: dict[float, float] = {}

    def cost(place: np.ndarray, excess: float) -> float:
        shape, log_scale = place
        if not -1.0 < shape <= MOST_SHAPE or abs(log_scale) > 50.0:
            return math.inf
        log_ratio = _log_ratio(excess / unit, shape, math.exp(log_scale))
        if not log_ratio < -math.log(share):
            return math.inf
        of_number = _cost_of_number(share * math.exp(log_ratio), number, tail.draws)
        return of_number + _cost_of_sizes(excesses, shape, log_scale)

    def signed_root(excess: float) -> float:
        if excess in roots:
            return roots[excess]
        nearest = min(begins, key=lambda known: abs(known - excess))
        begin = _possible(cost, begins[nearest], excess)
        found = optimize.minimize(
            cost,
            begin,
            args=(excess,),
            method="Nelder-Mead",
            options={
                "xatol": 1e-3,
                "fatol": 1e-4,
                "maxiter": 800,
                "initial_simplex": begin + np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]]),
            },
        )
        begins[excess] = found.x
        distance = math.sqrt(max(2.0 * (found.fun - best), 0.0))
        roots[excess] = math.copysign(distance, excess - estimate)
        return roots[excess]

    return signed_root


def _possible(
    cost: Callable[[np.ndarray, float], float], place: np.ndarray, excess: float
) -> np.ndarray:
    """Return a place near another one at which an excess is possible."""
    raised = place.copy()
    for _ in range(_WIDENINGS):
        if math.isfinite(cost(raised, excess)):
            break
        # a longer tail reaches further
        raised = raised + np.array([0.02, 0.02])
    return raised


def _end(signed_root: Callable[[float], float], estimate: float, level: float) -> float:
    """Return the excess at which the signed root equals a level [T4]."""
    step = 0.05 * estimate
    inner = estimate
    outer = estimate
    for _ in range(_WIDENINGS):
        outer = max(outer + math.copysign(step, level), 1e-9 * estimate)
        reached = signed_root(outer)
        if reached * math.copysign(1.0, level) >= abs(level):
            break
        inner = outer
        step *= 1.6
    else:
        return math.inf if level > 0.0 else 0.0
    found = optimize.brentq(
        lambda excess: signed_root(excess) - level, inner, outer, rtol=1e-3, xtol=1e-12 * estimate
    )
    return float(found)


class Stability(NamedTuple):
    """The fit above another threshold: its share of the draws, shape, and one value [T2]."""

    share: float
    shape: float
    estimate: float


def stability(values: np.ndarray | draws.Draws, exceeded_share: float) -> list[Stability]:
    """Return the fits above several thresholds; their values agree if the law [T1] holds.

    Thresholds at which there is no fit are left out, and so are those below the draws that are
    kept.
    """
    ordered = draws.of(values)
    kept_share = (ordered.largest.size - 1) / ordered.size
    middle = min(SHARE, kept_share)
    found = []
    for share in (2.0 * middle, middle, 0.5 * middle):
        if share > kept_share:
            continue
        try:
            tail = fit(ordered, share)
        except NoTailError:
            continue
        estimate = tail.threshold + excess(tail, exceeded_share)
        found.append(Stability(share, tail.shape, estimate))
    return found
