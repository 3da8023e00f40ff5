"""Correction factors of a guaranteed deceleration: dry rails by confidence level, and wet rails.

[C1] A_safe(V, level) = Kdry_rst(V, level) * (Kwet_rst(V) + M_NVAVADH * (1 - Kwet_rst(V)))
     * A_brake_emergency(V). V is a step of speed, and A_brake_emergency the nominal deceleration.
[C2] Kdry_rst(V, level) is the ratio of the deceleration on dry rails to the nominal one that a stop
     reaches with the probability of the level: 1 - 10**-level for the levels 1 to 9, and 0.5 for
     level 0. So it is the quantile at 10**-level of the ratios.
[C3] Kwet_rst(V) is the ratio of the mean decelerations on wet and on dry rails. Its interval is
     exp(log(ratio) -+ q * sqrt(v_wet + v_dry)), where v = s**2 / (n * mean**2) for each sample.

A quantile that the runs reach has the bounds of `quantiles`. A rarer one is extrapolated by `tail`.
Stops in strata reach rare levels themselves, with the bounds of `strata`. All three work on the
negative ratios, whose largest ones are the weakest brakes.

Sources: from memory, to be checked: UNISIG SUBSET-026, 3.13.2.2.9 and 3.13.6 [C1]; the levels of
M_NVEBCL, SUBSET-026 chapter 7 [C2]; [C3] is a choice of this project (delta method).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from rollerrig.realtime.campaign.statistics import draws, quantiles, strata, tail

LEVELS = tuple(range(10))  # M_NVEBCL
BY_RANK = "rank"  # the runs reach the level
BY_TAIL = "generalised Pareto"
BY_STRATA = "strata"
NO_METHOD = "none"


class Correction(NamedTuple):
    """Kdry_rst of one step and level.

    estimate: NaN if there is none; then `reason` states why.
    low, high: two-sided interval. bound: one-sided lower bound, the safe value.
    method: BY_RANK, BY_TAIL, BY_STRATA or NO_METHOD.
    error: standard error of the probability of a weaker brake than the estimate; NaN if unknown.
    """

    level: int
    estimate: float
    low: float
    high: float
    bound: float
    method: str
    reason: str = ""
    error: float = math.nan


class Ratio(NamedTuple):
    """Kwet_rst of one step, with its two-sided interval."""

    estimate: float
    low: float
    high: float


def failing_share(level: int) -> float:
    """Return the share of the stops that a level allows to be weaker [C2]."""
    return 0.5 if level == 0 else 10.0**-level


def corrections(
    ratios: np.ndarray | draws.Draws | strata.Sample,
    confidence: float = 0.95,
    levels: Sequence[int] = LEVELS,
) -> list[Correction]:
    """Return Kdry_rst for each level from the ratios (n,) of one step [C2]; n > 0.

    Draws and strata are those of the negative ratios, because the weakest brakes are their largest
    values.
    """
    if isinstance(ratios, strata.Sample):
        return [_in_strata(ratios, level, confidence) for level in levels]
    weakness = ratios if isinstance(ratios, draws.Draws) else draws.of(-ratios)
    law: tail.Tail | None = None
    reason = ""
    try:
        law = tail.fit(weakness)
    except tail.NoTailError as error:
        reason = str(error)
    return [_correction(weakness, law, reason, level, confidence) for level in levels]


def _correction(
    weakness: draws.Draws, law: tail.Tail | None, reason: str, level: int, confidence: float
) -> Correction:
    """Return Kdry_rst for one level; `weakness` are the negative ratios."""
    share = failing_share(level)
    interval = quantiles.interval(weakness, 1.0 - share, confidence)
    bound = quantiles.upper_bound(weakness, 1.0 - share, confidence)
    if math.isfinite(interval.high) and math.isfinite(bound.bound):
        return Correction(
            level,
            estimate=-bound.estimate,
            low=-interval.high,
            high=-interval.low,
            bound=-bound.bound,
            method=BY_RANK,
        )
    if law is None or share >= law.share:
        nothing = (math.nan,) * 4
        text = reason or f"too few runs: {bound.needs} are needed"
        return Correction(level, *nothing, method=NO_METHOD, reason=text)
    value = tail.exceeded(law, share, confidence)
    # a brake does not accelerate the train
    return Correction(
        level,
        estimate=max(-value.estimate, 0.0),
        low=max(-value.high, 0.0),
        high=max(-value.low, 0.0),
        bound=max(-value.bound, 0.0),
        method=BY_TAIL,
    )


def _in_strata(weakness: strata.Sample, level: int, confidence: float) -> Correction:
    """Return Kdry_rst for one level from the strata of negative ratios."""
    found = weakness.bounded(failing_share(level), confidence)
    if not math.isfinite(found.estimate):
        nothing = (math.nan,) * 4
        reason = "runs without a deceleration are more probable than this level"
        return Correction(level, *nothing, method=NO_METHOD, reason=reason)
    reason = "" if math.isfinite(found.bound) else "too few runs for a bound at this level"
    return Correction(
        level,
        # a brake does not accelerate the train
        estimate=max(-found.estimate, 0.0),
        low=max(-found.high, 0.0) if math.isfinite(found.high) else math.nan,
        high=max(-found.low, 0.0) if math.isfinite(found.low) else math.nan,
        bound=max(-found.bound, 0.0) if math.isfinite(found.bound) else math.nan,
        method=BY_STRATA,
        reason=reason,
        error=found.error,
    )


def wet_ratio(wet: draws.Moments, dry: draws.Moments, confidence: float = 0.95) -> Ratio:
    """Return Kwet_rst from the decelerations on wet and on dry rails [C3]; NaN if there is none.

    The two samples are independent of one another. Their means are above 0.
    """
    if wet.number < 2 or dry.number < 2 or not wet.mean > 0.0 or not dry.mean > 0.0:
        return Ratio(math.nan, math.nan, math.nan)
    ratio = wet.mean / dry.mean
    variance = 0.0
    for sample in (wet, dry):
        variance += sample.variance / (sample.number * sample.mean**2)
    reach = float(stats.norm.ppf(0.5 + 0.5 * confidence)) * math.sqrt(variance)
    return Ratio(ratio, ratio * math.exp(-reach), ratio * math.exp(reach))


def safe_deceleration(
    nominal_m_s2: float, dry: float, wet: float, available_adhesion: float
) -> float:
    """Return A_safe in m/s2 [C1]; `available_adhesion` is M_NVAVADH, from 0 to 1."""
    return nominal_m_s2 * dry * (wet + available_adhesion * (1.0 - wet))
