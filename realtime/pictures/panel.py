"""Panels: pictures as data, so that a report and Rerun draw the same picture.

A panel holds series over one horizontal axis. A series is a line, or points with error bars.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.realtime.pictures.colours import Colour


class Series(NamedTuple):
    """Values `y` over `x`, each of shape (n,): points with error bars, or a line."""

    label: str
    colour: Colour
    x: np.ndarray
    y: np.ndarray
    error: np.ndarray | None
    """Half the length of the error bars, shape (n,); None for a line."""


class Panel(NamedTuple):
    """A title, the labels of both axes, and the series."""

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
