"""Breaks the lines of a picture where the data have a gap: a line across it would be invented."""

import numpy as np


def with_breaks(x: np.ndarray, longest: float, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return x and columns, (n,) each, with a NaN in every column at each gap of x.

    longest: the largest distance of two neighbours in x, which ascend, that are connected.
    """
    at = np.flatnonzero(np.diff(x) > longest) + 1
    middle = 0.5 * (x[at - 1] + x[at])
    return np.insert(x, at, middle), *(np.insert(column, at, np.nan) for column in columns)
