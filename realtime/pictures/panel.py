"""A picture as data, so that a page and Rerun draw the same: series of points with bars, or lines, over one axis."""

from typing import NamedTuple

import numpy as np

from rollerrig.realtime.pictures.colours import Colour


class Series(NamedTuple):
    """Values over an axis, shape (n,); `bar`: half length of their error bars, None where they are a line."""

    label: str
    colour: Colour
    at: np.ndarray
    mean: np.ndarray
    bar: np.ndarray | None


class Panel(NamedTuple):
    """Series with what stands along both axes."""

    title: str
    along: str
    upwards: str
    series: tuple[Series, ...]
