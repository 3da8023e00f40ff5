"""When a braking begins and ends: the one definition of the stopping distance.

The braking lasts from the first brake demand to standstill. Its length is the stopping distance.
Measures of sequences, summaries, reports, campaigns and the desk use this definition. A sample
shows the demand of the tick before it, so a demand was given at the last sample that does not show
it yet.

    name                                   from                     to
    stopping distance                      first brake demand       standstill
    distance from the start                first sample of a run    standstill

In `summary.json` the stopping distance is `braking_distance_m`, and the distance from the start is
`stop_distance_m`. The measure of sequences for the stopping distance is `stop_distance`.
"""

import numpy as np

# a slower vehicle stands
STANDS_M_S = 0.01


def begin(demand_Pa: np.ndarray) -> int | None:
    """Return the index of the sample at which the first brake demand was given; None without any.

    `demand_Pa` has shape (n,); NaN is no demand.
    """
    demanded = np.flatnonzero(demand_Pa > 0.0)
    if not demanded.size:
        return None
    return max(int(demanded[0]) - 1, 0)


def standstill(speed_m_s: np.ndarray, since: int = 0) -> int | None:
    """Return the index of the first sample at standstill from index `since` on; None without any.

    `speed_m_s` has shape (n,).
    """
    standing = np.flatnonzero(speed_m_s[since:] <= STANDS_M_S)
    return since + int(standing[0]) if standing.size else None
