"""Creep curves by laws that share nothing with the code under test, with known truth.

The laws are the magic formula of tyres (Pacejka), an exponential that saturates, a hyperbola (as
Popovici's fit of twin-disc curves), and a sand law that rises throughout. Noise is white, grows
with adhesion, is shared by neighbours, or is rounding.

The forms of `FORMS` are those in which curves are measured: braking and traction with different
ranges and levels, few points, few creepages with repetitions, a sweep up and down, a temperature
that rises with sliding, loads that scatter about their levels. All their curves are magic formulas
with noise of 1 to 10 %.
"""

import math
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
    form: str = ""  # one of FORMS


class Points(NamedTuple):
    """The columns of curve.csv, each (n,)."""

    creepage: np.ndarray
    adhesion: np.ndarray
    speed_m_s: np.ndarray
    wheel_load_N: np.ndarray
    series: np.ndarray
    temperature_K: np.ndarray | None = None


# truths without any fall, and with nothing else to report
NOTHING = (
    Truth("rising"),
    Truth("saturating"),
    Truth("two equal loads"),
    Truth("two equal series"),
)
# each of two loads sweeps over the same creepages, one after the other
BLOCKS = (
    Truth("two equal loads in blocks"),
    *(
        Truth(
            f"load in blocks, {percent} %",
            load_exponent=math.log1p(-0.01 * percent) / math.log(1.5),
        )
        for percent in (5, 10, 15)
    ),
)
LOAD = Truth("load", load_exponent=-0.2)
SERIES = Truth("series", series_change=-0.2)
FALLING = Truth("falling", fall=0.25)

FORMS = (
    "plain",
    "two directions",
    "few points",
    "few creepages",
    "few creepages, two directions",
    "sweep up and down",
    "heated by sliding",
    "loads that scatter",
)
# without a fall, in each form
LEVEL_FORMS = tuple(Truth(form, form=form) for form in FORMS)
# with a fall by 10 to 50 % of the maximum, in the forms that do not change the curve
FALLING_FORMS = tuple(
    Truth(f"falling, {form}", fall=1.0, form=form) for form in ("plain", "few points")
)


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
    in_blocks = "blocks" in truth.name
    if in_blocks:
        share = np.tile(np.sort(share[: points // 2]), 2)
        load = np.repeat((40e3, 60e3), points // 2)
    if "series" in truth.name:
        series = rng.choice((1.0, 2.0), points)
    level = limit * (load / load.max()) ** truth.load_exponent
    level = level * (1.0 + truth.series_change * (series == 2.0))
    exact = level * _law(kind, share, sharpness)
    # friction falls linearly from a third of the range on
    exact = exact * (1.0 - truth.fall * np.clip((share - 0.3) / 0.7, 0.0, 1.0))

    deviation = rng.uniform(0.005, 0.04) * limit
    adhesion = exact + deviation * _noise(
        noise, rng, np.arange(points) if in_blocks else share, exact / limit
    )
    creepage = largest * share
    if noise == "rounded":
        creepage = np.maximum(np.round(creepage, 3), 0.001)
        adhesion = np.round(adhesion, 2)
    return Points(creepage, adhesion, np.full(points, 10.0), load, series)


def _noise(
    kind: str, rng: np.random.Generator, order: np.ndarray, relative: np.ndarray
) -> np.ndarray:
    """Return noise of deviation about 1 (n,); `order` (n,) sorts points as they were measured."""
    white = rng.standard_normal(order.size)
    if kind == "growing":
        return white * (0.3 + relative)
    if kind == "shared":
        # the points follow one another as in a slow sweep
        along = np.argsort(order)
        value = 0.0
        out = np.empty_like(white)
        for place in along:
            value = 0.6 * value + 0.8 * white[place]
            out[place] = value
        return out
    return white


def _magic_formula(slip: np.ndarray, parameters: tuple[float, float, float, float]) -> np.ndarray:
    """Return Pacejka's D sin(C arctan(B s - E (B s - arctan(B s))))."""
    b, c, d, e = parameters
    return d * np.sin(c * np.arctan(b * slip - e * (b * slip - np.arctan(b * slip))))


def _tyre(
    rng: np.random.Generator, falls: bool, largest: float
) -> tuple[float, float, float, float]:
    """Return B, C, D, E of a tyre that falls by 10 to 50 % up to the largest slip, or never."""
    limit = rng.uniform(0.2, 1.5)
    while falls:
        found = (
            rng.uniform(8.0, 20.0) / largest,
            rng.uniform(1.3, 1.7),
            limit,
            rng.uniform(-1.0, 0.6),
        )
        if 0.1 < _fall_of(found, np.linspace(0.0, largest, 2000)) < 0.5:
            return found
    return (
        rng.uniform(3.0, 15.0) / largest,
        rng.uniform(0.8, 1.0),
        limit,
        rng.uniform(-2.0, 0.9),
    )


def _fall_of(parameters: tuple[float, float, float, float], slip: np.ndarray) -> float:
    adhesion = _magic_formula(slip, parameters)
    return float(1.0 - adhesion[-1] / adhesion.max())


def tyre_curve(truth: Truth, seed: int) -> tuple[Points, float]:
    """Return a magic formula in the form of a truth, and by what share of its maximum it falls."""
    rng = np.random.default_rng([seed, len(truth.name)])
    points = int(rng.integers(60, 300))
    if truth.form == "few points":
        points = int(rng.integers(13, 31))
    largest = rng.uniform(0.02, 1.0)
    parameters = _tyre(rng, truth.fall > 0.0, largest)
    limit = parameters[2]

    slip = np.sort(rng.uniform(0.002, 1.0, points) ** rng.uniform(0.7, 1.6)) * largest
    if "few creepages" in truth.form:
        places = np.linspace(largest / 8.0, largest, int(rng.integers(5, 9)))
        slip = np.repeat(places, int(rng.integers(2, 12)))
    sign = np.ones(slip.size)
    level = np.ones(slip.size)
    if "two directions" in truth.form:
        sign = rng.choice((-1.0, 1.0), slip.size)
        level = np.where(sign < 0.0, rng.uniform(0.85, 1.15), 1.0)
        slip = np.where(sign == rng.choice((-1.0, 1.0)), slip * rng.uniform(0.5, 0.9), slip)
    load = np.full(slip.size, 50e3)
    if truth.form == "loads that scatter":
        load = 1e3 * rng.choice((1.0, 2.0, 3.0), slip.size)
        load = load * (1.0 + 0.05 * rng.standard_normal(slip.size))
    temperature = None
    if truth.form == "heated by sliding":
        temperature = 300.0 + 30.0 * slip / largest + 3.0 * rng.standard_normal(slip.size)

    exact = level * _magic_formula(slip, parameters)
    if truth.form == "sweep up and down":
        # the force lags behind the slip, and adhesion is lower on the way back
        upwards = slip[::2]
        downwards = slip[1::2][::-1]
        lag = rng.uniform(0.01, 0.06) * largest
        slip = np.concatenate([upwards, downwards])
        exact = np.concatenate(
            [
                _magic_formula(np.maximum(upwards - lag, 0.0), parameters),
                _magic_formula(downwards + lag, parameters) * rng.uniform(0.94, 1.0),
            ]
        )
    adhesion = exact + rng.uniform(0.01, 0.1) * limit * rng.standard_normal(slip.size)
    measured = Points(
        creepage=sign * slip,
        adhesion=sign * adhesion,
        speed_m_s=np.full(slip.size, 10.0),
        wheel_load_N=load,
        series=np.zeros(slip.size),
        temperature_K=temperature,
    )
    grid = np.linspace(slip.min(), slip.max(), 2000)
    return measured, _fall_of(parameters, grid)
