"""Statistics of the stopping distances of a campaign: quantiles with bounds, and their drivers.

The stopping distance is that of `wsp_interface.braking`: from the first brake demand to standstill.

[S1] The k-th smallest of n independent draws lies above the q-quantile with a confidence of
     P(B(n, q) < k), whatever the distribution. The bound is the smallest such k that reaches
     CONFIDENCE; 95 % of the stops with 95 % confidence need at least 59 runs.
[S2] Rank correlation of each input with the distance (Spearman). For the longest tenth against the
     rest: twice the difference of their mean ranks over n (rank-biserial). It is 1 if the longest
     stops have all the largest values.

Source: Wilks 1941 [S1], Spearman 1904, Cureton 1956 [S2]. A coach that did not stop within its time
counts as longer than any other. A run that failed does not count, and the page reports how many.
"""

import math
from typing import Any

import numpy as np
import pyarrow as pa
from scipy import stats

from rollerrig.realtime.campaign import campaign

CONFIDENCE = 0.95  # of the upper bounds
QUANTILES = (0.5, 0.9, 0.95, 0.99)
TAIL = 0.1  # share of the runs that are the longest stops
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


def rank(count: int, quantile: float) -> int:
    """Return the rank, from 1, of the draw that bounds a quantile from above [S1].

    0 if there are too few draws.
    """
    ranks = np.arange(1, count + 1)
    enough = ranks[stats.binom.cdf(ranks - 1, count, quantile) >= CONFIDENCE]
    return int(enough[0]) if enough.size else 0


def bounds(table: pa.Table) -> list[dict[str, Any]]:
    """Return estimate and upper bound for each of QUANTILES.

    None instead of a number: there are too few runs, or the value is beyond all runs that stopped.
    Empty if no run counts.
    """
    _, distance_m = counted(table)
    if not distance_m.size:
        return []
    sorted_m = np.sort(distance_m)
    found = []
    for quantile in QUANTILES:
        bound_rank = rank(sorted_m.size, quantile)
        estimate_m = sorted_m[math.ceil(quantile * sorted_m.size) - 1]
        bound_m = sorted_m[bound_rank - 1] if bound_rank else math.inf
        found.append(
            {
                "quantile": quantile,
                "rank": bound_rank,
                "needs": math.ceil(math.log(1.0 - CONFIDENCE) / math.log(quantile)),
                "estimate_m": _finite(estimate_m),
                "bound_m": _finite(bound_m),
            }
        )
    return found


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
