"""Compares the filtered irregularity of wheelsets at the same place: how much of it is the rail's.

The filter sees little of the irregularity where a wheel hardly slides, so a correlation of filtered
irregularities is smaller than that of the irregularities. Simulated stops on a rail that all
wheelsets share show by how much.

    [K1] c = sum m_a m_b / sum sqrt(sum m_a^2 sum m_b^2), sums over places and pairs of wheelsets
    [K2] share = c / c of simulated stops on a shared rail
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from rollerrig.rig.identify.data.preparation import Design

GRID_M = 1.0
# Longer waves are removed: they may be a patch, or a cause that depends on the place.
LONGEST_M = 40.0
# least places that two wheelsets must have in common
LEAST_PLACES = 60
# stops that are simulated on a shared rail
SIMULATED = 4


class RailShares(NamedTuple):
    """The share of the irregularity's variance that wheelsets have in common at the same place."""

    in_run: float  # the wheelsets of a run
    in_all: float  # the wheelsets of all runs; at most `in_run`


# Shares of a rail that shows nothing else, and the least ones: half of the variance is the rail's.
USUAL = RailShares(0.5, 0.5)


def common(design: Design, field: np.ndarray) -> RailShares:
    """Return the correlations [K1] of the filtered irregularity (n,), in runs and between them.

    A correlation is 0 where no two wheelsets pass the same places.
    """
    lowest_m = float(design.place_m.min())
    grid_m = np.arange(lowest_m, float(design.place_m.max()), GRID_M)
    rows = np.full((design.segments, grid_m.size), np.nan)
    for s in range(design.segments):
        at = design.span(s)
        place_m = design.place_m[at]
        inside = (grid_m >= place_m[0]) & (grid_m <= place_m[-1])
        values = np.interp(grid_m[inside], place_m, field[at])
        rows[s, inside] = values - uniform_filter1d(values, int(LONGEST_M / GRID_M))

    products = {True: 0.0, False: 0.0}
    sizes = {True: 0.0, False: 0.0}
    for first, second in combinations(range(design.segments), 2):
        both = np.isfinite(rows[first]) & np.isfinite(rows[second])
        if np.count_nonzero(both) < LEAST_PLACES:
            continue
        a = rows[first, both]
        b = rows[second, both]
        of_one_run = bool(design.run[first] == design.run[second])
        products[of_one_run] += float(a @ b)
        sizes[of_one_run] += float(np.sqrt((a @ a) * (b @ b)))
    return RailShares(
        in_run=products[True] / max(sizes[True], 1e-30),
        in_all=products[False] / max(sizes[False], 1e-30),
    )


def shares(measured: RailShares, on_shared_rail: list[RailShares]) -> RailShares:
    """Return the shares [K2], at least those of `USUAL` and at most 1."""
    of_run = float(np.mean([one.in_run for one in on_shared_rail]))
    of_all = float(np.mean([one.in_all for one in on_shared_rail]))
    in_all = measured.in_all / of_all if of_all > 0.0 else 0.0
    in_run = measured.in_run / of_run if of_run > 0.0 else 0.0
    in_all = float(np.clip(in_all, USUAL.in_all, 1.0))
    return RailShares(in_run=float(np.clip(in_run, max(in_all, USUAL.in_run), 1.0)), in_all=in_all)
