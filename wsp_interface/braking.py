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
# share of the vehicle's speed by which a wheelset slides deeply
DEEP_SLIP = 0.5


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


def longest_stretch_s(time_s: np.ndarray, is_true: np.ndarray) -> float:
    """Return the longest time without a break for which a condition, shape (n,), holds."""
    changes = np.diff(np.concatenate(([0], is_true.astype(np.int8), [0])))
    begins = np.flatnonzero(changes == 1)
    if not begins.size:
        return 0.0
    ends = np.flatnonzero(changes == -1) - 1
    return float((time_s[ends] - time_s[begins]).max())


def is_deep(sliding_m_s: np.ndarray, speed_m_s: np.ndarray, above_m_s: float) -> np.ndarray:
    """Return where a wheelset slides deeply while the vehicle is faster than `above_m_s`.

    The arrays have the shape (n,); the sliding may be (axles, n).
    """
    return (sliding_m_s > DEEP_SLIP * speed_m_s) & (speed_m_s > above_m_s)
