"""Creep curves by laws that share nothing with the code under test, with known truth.

The laws are the magic formula of tyres (Pacejka), an exponential that saturates, a hyperbola (as
Popovici's fit of twin-disc curves), and a sand law that rises throughout. Noise is white, grows
with adhesion, is shared by neighbours, or is rounding.
"""

from typing import NamedTuple

import numpy as np

LAWS = ("magic", "exponential", "hyperbola", "sand")
NOISES = ("white", "growing", "shared", "rounded")


class Truth(NamedTuple):
    """What a curve hides."""

    name: str
    fall: float = 0.0  # share of the maximum that is lost at the largest creepage
    load_exponent: float = 0.0
    series_change: float = 0.0


class Points(NamedTuple):
    """The columns of curve.csv, each (n,)."""

    creepage: np.ndarray
    adhesion: np.ndarray
    speed_m_s: np.ndarray
    wheel_load_N: np.ndarray
    series: np.ndarray


# truths without any fall, and with nothing else to report
NOTHING = (
    Truth("rising"),
    Truth("saturating"),
    Truth("two equal loads"),
    Truth("two equal series"),
)
LOAD = Truth("load", load_exponent=-0.2)
SERIES = Truth("series", series_change=-0.2)
FALLING = Truth("falling", fall=0.25)


def _law(kind: str, share: np.ndarray, sharpness: float) -> np.ndarray:
    """Return adhesion over its limit at creepages as shares of the largest."""
    if kind == "magic":
        return np.sin(0.98 * np.arctan(sharpness * share))
    if kind == "exponential":
        return 1.0 - np.exp(-sharpness * share)
    if kind == "hyperbola":
        return sharpness * share / (1.0 + sharpness * share)
    return 0.05 + 0.95 * share**0.8


def curve(truth: Truth, seed: int, points: int = 150) -> Points:
    """Return a curve with this truth; law, range, noise and places differ from seed to seed."""
    rng = np.random.default_rng(seed)
    kind = "sand" if truth.name == "rising" and seed % 2 else LAWS[seed % 3]
    noise = NOISES[(seed // 3) % 4]
    largest = rng.uniform(0.05, 0.5)
    limit = rng.uniform(0.1, 1.2)
    sharpness = rng.uniform(2.0, 4.0) if truth.name == "rising" else rng.uniform(8.0, 20.0)

    share = rng.uniform(0.01, 1.0, points) ** rng.uniform(0.7, 1.8)
    load = np.full(points, 50e3)
    series = np.zeros(points)
    if "load" in truth.name:
        load = rng.choice((30e3, 60e3, 90e3), points)
    if "series" in truth.name:
        series = rng.choice((1.0, 2.0), points)
    level = limit * (load / load.max()) ** truth.load_exponent
    level = level * (1.0 + truth.series_change * (series == 2.0))
    exact = level * _law(kind, share, sharpness)
    # friction falls linearly from a third of the range on
    exact = exact * (1.0 - truth.fall * np.clip((share - 0.3) / 0.7, 0.0, 1.0))

    deviation = rng.uniform(0.005, 0.04) * limit
    adhesion = exact + deviation * _noise(noise, rng, share, exact / limit)
    creepage = largest * share
    if noise == "rounded":
        creepage = np.maximum(np.round(creepage, 3), 0.001)
        adhesion = np.round(adhesion, 2)
    return Points(creepage, adhesion, np.full(points, 10.0), load, series)


def _noise(
    kind: str, rng: np.random.Generator, share: np.ndarray, relative: np.ndarray
) -> np.ndarray:
    """Return noise of deviation about 1 (n,)."""
    white = rng.standard_normal(share.size)
    if kind == "growing":
        return white * (0.3 + relative)
    if kind == "shared":
        # the points follow one another as in a slow sweep
        along = np.argsort(share)
        value = 0.0
        out = np.empty_like(white)
        for place in along:
            value = 0.6 * value + 0.8 * white[place]
            out[place] = value
        return out
    return white
