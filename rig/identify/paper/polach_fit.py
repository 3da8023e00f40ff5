"""Fits Polach's parameters to a measured creep curve; decides whether friction falls with sliding.

Adhesion against creepage at a known speed and load shows friction at rest and at large sliding, its
decay, and the two factors of the contaminated patch. A second fit without falling friction shows
what the decay is worth. The scatter of neighbouring points shows the error that no smooth curve can
go below.

    [C1] mu = mu_c + (mu_c / A - mu_c) exp(-gamma s), s = creepage x speed       Polach 2005
    [C2] f = mu `polach.shape`(eps; k_A, k_S); A, k_A and k_S within 0 .. 1

Intervals: bootstrap of points in blocks along creepage, because neighbours share their errors.
Source: Polach, Wear 258 (2005) 992-1000, which also recommends the "dry" and "wet" sets.
Limits: k_A and k_S also absorb errors of the patch (lateral radius, elasticity). Polach requires
k_S <= k_A. The fit without falling friction may break this condition; a third fit keeps it.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.contact.patch import Patch
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Curve, Dataset
from rollerrig.rig.identify.paper.tuning import Interval, rms


class Parameters(NamedTuple):
    """Polach's parameters, or a value for each of them."""

    mu_0: float  # friction at rest
    A: float  # friction at infinite sliding over mu_0
    gamma_s_m: float  # decay of friction with sliding
    k_a: float  # reduction of the slope in the area of adhesion
    k_s: float  # reduction of the slope in the area of sliding


NAMES = Parameters._fields
LOW = np.array(Parameters(mu_0=0.02, A=0.05, gamma_s_m=0.0, k_a=0.01, k_s=0.001))
HIGH = np.array(Parameters(mu_0=3.0, A=1.0, gamma_s_m=5.0, k_a=1.0, k_s=1.0))

# a parameter within this share of the range between its bounds is at a bound
AT_BOUND = 1e-3

# several starts, because the sum of squares has several minima
STARTS = (
    Parameters(0.3, 0.4, 0.6, 0.4, 0.1),
    Parameters(0.4, 0.4, 0.2, 0.8, 0.4),
    Parameters(0.25, 0.6, 1.0, 0.1, 0.8),
)

# recommended by Polach
RECOMMENDED = {
    "dry": Parameters(mu_0=0.55, A=0.40, gamma_s_m=0.60, k_a=1.00, k_s=0.40),
    "wet": Parameters(mu_0=0.30, A=0.40, gamma_s_m=0.20, k_a=0.30, k_s=0.10),
}

# which parameters are free in the three fits; without A friction does not fall, without k_s k_s =
# k_a
_ALL_FREE = np.array(Parameters(True, True, True, True, True))
_WITHOUT_FALL = np.array(Parameters(True, False, False, True, True))
_WITHOUT_FALL_ORDERED = np.array(Parameters(True, False, False, True, False))

# of the bootstrap
REPLICATES = 200
BLOCKS = 25

# neighbours on each side of a point that show its scatter
_NEIGHBOURS = 4


class PolachFit(NamedTuple):
    """Parameters with intervals, errors, and the same without falling friction."""

    values: dict[str, Interval]
    rms: float
    rms_without_fall: float
    rms_without_fall_ordered: float  # with k_S <= k_A
    values_without_fall: dict[str, float]
    scatter_floor: float
    mean_error_of_recommended: dict[str, float]  # by name of the set

    # (5, 5), of the replicates; 0 for a parameter that is at a bound in all of them
    correlation: np.ndarray


def model(
    x: np.ndarray, curve: Curve, patch: Patch, factor: np.ndarray | float = 1.0
) -> np.ndarray:
    """Return the adhesion [C1] [C2] at the points of a curve (n,); x is in the order of NAMES.

    `factor` multiplies the friction of each point.
    """
    mu_0, A, gamma, k_a, k_s = x
    creepage = np.abs(curve.creepage)
    unit = patch.eps1 * curve.load_N ** (-1.0 / 3.0)
    mu = factor * mu_0 * (A + (1.0 - A) * np.exp(-gamma * creepage * curve.speed_m_s))
    eps = unit * creepage / mu
    shape = 2.0 / np.pi * (k_a * eps / (1.0 + (k_a * eps) ** 2) + np.arctan(k_s * eps))
    return np.sign(curve.creepage) * mu * shape


def fit(data: Dataset, seed: int = 0) -> PolachFit:
    """Fit a creep-curve dataset. Raises ConfigError for a dataset of another kind."""
    if data.curve is None:
        raise ConfigError(
            f"{data.folder / 'dataset.toml'}: kind is '{data.kind}'; a creep_curve is required here"
        )
    curve = data.curve
    patch = patch_of(data)
    x, residual = _best(curve, patch, _ALL_FREE, STARTS)
    x_without_fall, residual_without_fall = _best(curve, patch, _WITHOUT_FALL, STARTS)
    # the condition k_S <= k_A binds, so both are one parameter
    _, residual_ordered = _best(curve, patch, _WITHOUT_FALL_ORDERED, STARTS)

    replicates = _bootstrap(curve, patch, x, seed)
    low, high = np.percentile(replicates, (2.5, 97.5), axis=0)
    values = {
        name: Interval(float(x[i]), float(low[i]), float(high[i])) for i, name in enumerate(NAMES)
    }
    deviation = np.maximum(replicates.std(axis=0), 1e-12)
    scaled = (replicates - replicates.mean(axis=0)) / deviation
    mean_error = {
        name: float(np.mean(model(np.array(recommended), curve, patch) - curve.adhesion))
        for name, recommended in RECOMMENDED.items()
    }
    return PolachFit(
        values=values,
        rms=rms(residual),
        rms_without_fall=rms(residual_without_fall),
        rms_without_fall_ordered=rms(residual_ordered),
        values_without_fall={name: float(x_without_fall[i]) for i, name in enumerate(NAMES)},
        scatter_floor=_scatter_floor(curve),
        mean_error_of_recommended=mean_error,
        correlation=scaled.T @ scaled / len(scaled),
    )


def _best(
    curve: Curve, patch: Patch, free: np.ndarray, starts: tuple[Parameters, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters (5,) and residuals (n,) of the best least-squares fit of all starts."""

    def with_fixed(part: np.ndarray) -> np.ndarray:
        x = np.array(Parameters(mu_0=0.0, A=1.0, gamma_s_m=0.0, k_a=0.0, k_s=0.0))
        x[free] = part
        if not Parameters(*free).k_s:
            x[NAMES.index("k_s")] = x[NAMES.index("k_a")]
        return x

    def residual(part: np.ndarray) -> np.ndarray:
        return model(with_fixed(part), curve, patch) - curve.adhesion

    fits = [
        least_squares(
            residual,
            np.clip(np.array(start)[free], LOW[free], HIGH[free]),
            bounds=(LOW[free], HIGH[free]),
            x_scale=HIGH[free],
        )
        for start in starts
    ]
    best = min(fits, key=lambda solution: solution.cost)
    return with_fixed(best.x), best.fun


def _bootstrap(curve: Curve, patch: Patch, x: np.ndarray, seed: int) -> np.ndarray:
    """Return parameters (REPLICATES, 5) of curves that are made of drawn blocks of points."""
    rng = np.random.default_rng(seed)
    by_creepage = np.argsort(np.abs(curve.creepage))
    blocks = np.array_split(by_creepage, min(BLOCKS, curve.creepage.size // 2))
    out = np.empty((REPLICATES, len(NAMES)))
    for i in range(REPLICATES):
        drawn = rng.integers(len(blocks), size=len(blocks))
        points = np.concatenate([blocks[k] for k in drawn])
        replicate = curve.chosen(points)
        out[i], _ = _best(replicate, patch, _ALL_FREE, (Parameters(*x),))
    return out


def _scatter_floor(curve: Curve) -> float:
    """Return the scatter about lines through each point's neighbours.

    No smooth curve has less error.

    The result is NaN for fewer points than neighbours.
    """
    order = np.argsort(np.abs(curve.creepage))
    adhesion = curve.adhesion[order]
    creepage = np.abs(curve.creepage[order])
    offsets = []
    for i in range(_NEIGHBOURS, adhesion.size - _NEIGHBOURS):
        near = np.r_[i - _NEIGHBOURS : i, i + 1 : i + _NEIGHBOURS + 1]
        at_point = _line_at_zero(creepage[near] - creepage[i], adhesion[near])
        # the line has an error, too
        offsets.append((adhesion[i] - at_point) / np.sqrt(1.0 + 1.0 / near.size))
    return float(np.sqrt(np.mean(np.square(offsets)))) if offsets else float("nan")


def _line_at_zero(x: np.ndarray, y: np.ndarray) -> float:
    """Return the best straight line at x = 0; the mean of y where all x are equal."""
    centred = x - x.mean()
    spread = float(centred @ centred)
    if spread == 0.0:
        return float(y.mean())
    slope = float(centred @ y) / spread
    return float(y.mean() - slope * x.mean())


def bound_of(name: str, value: float) -> str:
    """Return "low" or "high" where the value of a parameter is at its bound, else ""."""
    i = NAMES.index(name)
    margin = AT_BOUND * (HIGH[i] - LOW[i])
    if value < LOW[i] + margin:
        return "low"
    if value > HIGH[i] - margin:
        return "high"
    return ""
