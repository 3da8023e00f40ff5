"""Statistics of the stopping distances of a campaign: quantiles with bounds, and their drivers.

The stopping distance is that of `wsp_interface.braking`: from the first brake demand to standstill.

[S1] Quantiles have the bounds of `statistics.quantiles`: 95 % of the stops with 95 % confidence
     need at least 59 runs.
[S2] Rank correlation of each input with the distance (Spearman). For the longest tenth against the
     rest: twice the difference of their mean ranks over n (rank-biserial). It is 1 if the longest
     stops have all the largest values.
[S3] Beyond the quantiles that the runs bound, `statistics.tail` extrapolates the law of the longest
     tenth. Only independent draws have such a law.

Source: Wilks 1941 [S1]; Spearman 1904, Cureton 1956 [S2]. A coach that did not stop within its time
counts as longer than any other. A run that failed does not count, and the page reports how many.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy import stats

from rollerrig.realtime.campaign import campaign, design
from rollerrig.realtime.campaign.statistics import draws, quantiles, strata, tail
from rollerrig.realtime.campaign.statistics import drivers as drivers_of

CONFIDENCE = quantiles.CONFIDENCE  # of the upper bounds
QUANTILES = (0.5, 0.9, 0.95, 0.99)
# of a stratified design, whose strata reach them
RARE_QUANTILES = (*QUANTILES, 0.999, 1.0 - 1e-4, 1.0 - 1e-5, 1.0 - 1e-6)
TAIL = 0.1  # share of the runs that are the longest stops
EXCEEDED = (1e-3, 1e-4, 1e-5)  # shares of the runs, for extrapolation
FEWEST = 8  # runs: the page shows no statistics of fewer


def counted(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """Return which runs count, bool (rows,), and their distances in m.

    The distance of a run that did not stop is inf.
    """
    distance_m = table["braking_distance_m"].to_numpy().astype(float)
    distance_m[_did_not_stop(table)] = np.inf
    counts = ~np.isnan(distance_m)
    return counts, distance_m[counts]


def _did_not_stop(table: pa.Table) -> np.ndarray:
    """Return which runs reached the end of their time while the coach rolled, bool (rows,).

    A run that derailed, or whose unit failed, has ended in another way. A run that has no result
    has none of the fields.
    """
    columns = [table[name].to_pylist() for name in ("valid", "stopped", "ended")]
    rows = zip(*columns, strict=True)
    return np.array([row == (False, False, "finished") for row in rows], dtype=bool)


def distances(table: pa.Table) -> draws.Draws:
    """Return the order statistics of the stopping distances in m of the runs that count."""
    return draws.of(counted(table)[1])


def bounds(distance_m: draws.Draws | strata.Sample) -> list[dict[str, Any]]:
    """Return estimate and upper bound for each of QUANTILES, or RARE_QUANTILES of strata.

    None instead of a number: there are too few runs, or the value is beyond all runs that stopped.
    Empty if no run counts. Strata have no rank; instead they have the standard error of the
    probability of a longer stop.
    """
    if not distance_m.size:
        return []
    if isinstance(distance_m, strata.Sample):
        return [_in_strata(distance_m, quantile) for quantile in RARE_QUANTILES]
    found = []
    for quantile in QUANTILES:
        bound = quantiles.upper_bound(distance_m, quantile, CONFIDENCE)
        found.append(
            {
                "quantile": quantile,
                "rank": bound.rank,
                "needs": bound.needs,
                "confidence": bound.confidence,
                "estimate_m": _finite(bound.estimate),
                "bound_m": _finite(bound.bound),
            }
        )
    return found


def _in_strata(distance_m: strata.Sample, quantile: float) -> dict[str, Any]:
    found = distance_m.bounded(1.0 - quantile, CONFIDENCE)
    return {
        "quantile": quantile,
        "rank": None,
        "needs": None,
        "confidence": CONFIDENCE,
        "estimate_m": _finite(found.estimate),
        "bound_m": _finite(found.bound),
        "probability_error": _finite(found.error),
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def drivers(plan: campaign.Plan, table: pa.Table) -> list[tuple[str, float, float]]:
    """Return (input, rank correlation, correlation of the tail) [S2] of all numeric inputs.

    The input with the strongest rank correlation is the first.
    """
    counts, distance_m = counted(table)
    order = stats.rankdata(distance_m)
    in_tail = order > (1.0 - TAIL) * order.size
    # without any rest, or with equal distances only, there is no correlation
    if in_tail.all() or np.ptp(order) == 0.0:
        return []

    found = []
    for key in plan.axes:
        values = table[key].to_numpy()[counts]
        if not np.issubdtype(values.dtype, np.number) or np.ptp(values) == 0.0:
            continue
        ranks = stats.rankdata(values)
        correlation = float(np.corrcoef(ranks, order)[0, 1])
        lead = ranks[in_tail].mean() - ranks[~in_tail].mean()
        found.append((key, correlation, float(2.0 * lead / ranks.size)))
    return sorted(found, key=lambda driver: -abs(driver[1]))


class Extrapolation(NamedTuple):
    """The law of the longest runs [S3], or why there is none.

    law: None if there is none; then `reason` states why.
    values: one per share of EXCEEDED.
    stability: the value at the least share, above several thresholds.
    """

    law: tail.Tail | None
    reason: str
    values: list[tail.Extrapolated]
    stability: list[tail.Stability]


def extrapolation(plan: campaign.Plan, distance_m: draws.Draws | strata.Sample) -> Extrapolation:
    """Return the stopping distances that few runs exceed [S3]."""
    name = plan.head["design"]
    if isinstance(distance_m, strata.Sample):
        reason = "the strata of this design reach rare stops, and the table above has them"
        return Extrapolation(None, reason, [], [])
    if name != design.INDEPENDENT:
        reason = (
            f"a {name} design is no sample of independent draws; "
            f'set design = "{design.INDEPENDENT}"'
        )
        return Extrapolation(None, reason, [], [])
    try:
        law = tail.fit(distance_m)
    except tail.NoTailError as error:
        return Extrapolation(None, str(error), [], [])
    values = [tail.exceeded(law, share, CONFIDENCE) for share in EXCEEDED]
    return Extrapolation(law, "", values, tail.stability(distance_m, EXCEEDED[-1]))


def extrapolated(plan: campaign.Plan, distance_m: draws.Draws | strata.Sample) -> dict[str, Any]:
    """Return the extrapolation [S3] as numbers for programs; None instead of a missing number."""
    found = extrapolation(plan, distance_m)
    if found.law is None:
        return {"reason": found.reason, "values": []}
    return {
        "reason": None,
        "threshold_m": found.law.threshold,
        "shape": found.law.shape,
        "scale_m": found.law.scale,
        "excesses": int(found.law.excesses.size),
        "values": [
            {
                "exceeded": value.exceeded,
                "estimate_m": value.estimate,
                "low_m": value.low,
                "high_m": _finite(value.high),
                "bound_m": _finite(value.bound),
            }
            for value in found.values
        ],
    }


def sobol_indices(plan: campaign.Plan, table: pa.Table) -> dict[str, drivers_of.Indices]:
    """Return the Sobol indices of the distance for each input of a saltelli design.

    Empty for another design, and if too few blocks have a distance in all their runs.
    """
    if plan.head["design"] != design.SALTELLI:
        return {}
    distance_m = table.sort_by("run")["braking_distance_m"].to_numpy().astype(float)
    found = drivers_of.sobol_indices(distance_m, len(plan.axes), plan.head["seed"])
    return dict(zip(plan.axes, found, strict=True)) if found else {}
