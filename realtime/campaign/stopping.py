"""Statistics of a campaign's stopping distance: quantiles with bounds, what drives the longest stops.

[S1] the k-th smallest of n independent draws lies above the q-quantile with a confidence of P(B(n, q) < k), whatever
     the distribution: the bound is the smallest such k that reaches CONFIDENCE; 95 % and 95 % take 59 runs at least
[S2] rank correlation of each input with the distance (Spearman); and of the longest tenth with the rest, as twice the
     difference of their mean ranks over n (rank-biserial): 1 where the longest stops have all the largest values

Source: Wilks 1941 [S1], Spearman 1904, Cureton 1956 [S2]. A coach that had not stopped when its time was up counts as
longer than any; a run that failed or is not valid for another reason counts nowhere, and the page says how many.
"""

import math
from typing import Any

import numpy as np
import pyarrow as pa
from scipy import stats

from rollerrig.realtime.campaign import campaign

CONFIDENCE, QUANTILES, TAIL, FEWEST = 0.95, (0.5, 0.9, 0.95, 0.99), 0.1, 8
_NOT_STOPPED = "the coach did not stop within"


def counted(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """Which runs count, bool (rows,), and the distances of these in m, inf for those that did not stop."""
    distance_m = table["stop_distance_m"].to_numpy().astype(float)
    reasons = zip(table["error"].to_pylist(), table["invalid_because"].to_pylist(), strict=True)
    rolls = np.array(
        [not error and (why or "").startswith(_NOT_STOPPED) for error, why in reasons], dtype=bool
    )
    distance_m[rolls] = np.inf
    return ~np.isnan(distance_m), distance_m[~np.isnan(distance_m)]


def rank(count: int, quantile: float) -> int:
    """The rank, from 1, of the draw that bounds a quantile from above [S1]; 0 where there are too few draws."""
    ranks = np.arange(1, count + 1)
    enough = ranks[stats.binom.cdf(ranks - 1, count, quantile) >= CONFIDENCE]
    return int(enough[0]) if enough.size else 0


def bounds(table: pa.Table) -> list[dict[str, Any]]:
    """For each of QUANTILES its estimate and its upper bound; None: too few runs, or beyond all that stopped."""
    sorted_m = np.sort(counted(table)[1])
    found = []
    for quantile in QUANTILES if sorted_m.size else ():
        at = rank(sorted_m.size, quantile)
        values = (
            sorted_m[math.ceil(quantile * sorted_m.size) - 1],
            sorted_m[at - 1] if at else math.inf,
        )
        needs = math.ceil(math.log(1.0 - CONFIDENCE) / math.log(quantile))
        found.append(
            {
                "quantile": quantile,
                "rank": at,
                "needs": needs,
                **{
                    name: float(value) if math.isfinite(value) else None
                    for name, value in zip(("estimate_m", "bound_m"), values, strict=True)
                },
            }
        )
    return found


def drivers(plan: campaign.Plan, table: pa.Table) -> list[tuple[str, float, float]]:
    """(input, rank correlation, of the tail alone) [S2], the strongest first, of all inputs that are numbers."""
    counts, distance_m = counted(table)
    order = stats.rankdata(distance_m)
    tail = order > (1.0 - TAIL) * order.size
    found = []
    for key in plan.axes:
        values = table[key].to_numpy()[counts]
        if (
            not np.issubdtype(values.dtype, np.number)
            or tail.all()
            or np.ptp(values) == 0.0
            or np.ptp(order) == 0.0
        ):
            continue
        ranks = stats.rankdata(values)
        found.append(
            (
                key,
                float(np.corrcoef(ranks, order)[0, 1]),
                float(2.0 * (ranks[tail].mean() - ranks[~tail].mean()) / ranks.size),
            )
        )
    return sorted(found, key=lambda row: -abs(row[1]))
