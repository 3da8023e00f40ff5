"""Fits Polach's five parameters to a measured creep curve, and asks whether friction falls.

Adhesion against creepage at a known speed and load gives friction at rest and at large sliding, its
decay, and the two factors of the contaminated patch. A second fit without falling friction shows
what the decay is worth; the scatter of neighbouring points shows what no smooth curve can reach.

    [C1] mu = mu_c + (mu_c / A - mu_c) exp(-gamma s), s = creepage x speed       Polach 2005
    [C2] f = mu `polach.shape`(eps; k_A, k_S); A, k_A and k_S within 0 .. 1

Intervals: bootstrap of points in blocks along creepage (neighbours share their errors). Source:
Polach, Wear 258 (2005) 992-1000, which also recommends the "dry" and "wet" sets. Doubt: k_A and k_S
also take up what is wrong with the patch (lateral radius, elasticity). Polach wants k_S <= k_A; the
fit without falling friction may break that (it is shown), a third one keeps it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.contact.patch import Patch
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Curve, Dataset
from rollerrig.rig.identify.paper.tuning import Interval, rms
from rollerrig.rig.mechanisms.table import TABLE

NAMES = ("mu_0", "A", "gamma_s_m", "k_a", "k_s")
LOW = np.array([0.02, 0.05, 0.0, 0.01, 0.001])
HIGH = np.array([1.5, 1.0, 5.0, 1.0, 1.0])
STARTS = ((0.3, 0.4, 0.6, 0.4, 0.1), (0.4, 0.4, 0.2, 0.8, 0.4), (0.25, 0.6, 1.0, 0.1, 0.8))
# mu_0, A, gamma, k_A, k_S that Polach recommends
RECOMMENDED = {"dry": (0.55, 0.40, 0.60, 1.00, 0.40), "wet": (0.30, 0.40, 0.20, 0.30, 0.10)}
REPLICATES = 200
BLOCKS = 25


class Fitted(NamedTuple):
    """Values with intervals, errors, and the same without falling friction."""

    values: dict[str, Interval]
    rms: float
    rms_no_fall: float
    rms_no_fall_ordered: float  # with k_S <= k_A
    values_no_fall: dict[str, float]
    floor: float
    means: dict[str, float]  # mean error of the recommended sets
    correlation: (
        np.ndarray
    )  # (5, 5) of the replicates; 0 for a parameter that stands at a bound in all of them


def model(x: np.ndarray, curve: Curve, patch: Patch) -> np.ndarray:
    """Adhesion [C1] [C2] at the points of a curve, shape (n,); x in the order of NAMES."""
    mu_0, A, gamma, k_a, k_s = x
    creepage = np.abs(curve.creepage)
    unit = patch.eps1 * curve.load_N ** (-1.0 / 3.0)
    mu = mu_0 * (A + (1.0 - A) * np.exp(-gamma * creepage * curve.speed_m_s))
    eps = unit * creepage / mu
    shape = 2.0 / np.pi * (k_a * eps / (1.0 + (k_a * eps) ** 2) + np.arctan(k_s * eps))
    return np.sign(curve.creepage) * mu * shape


def fit(data: Dataset, seed: int = 0) -> Fitted:
    """Fit a creep-curve dataset. Raises ConfigError where there is none."""
    if data.curve is None:
        raise ConfigError(
            f"{data.folder / 'dataset.toml'}: kind is '{data.kind}'; a creep_curve is wanted here"
        )
    curve, patch = data.curve, patch_of(data)
    x, residual = _best(curve, patch, np.ones(5, dtype=bool))
    x_flat, residual_flat = _best(curve, patch, np.array([True, False, False, True, True]))
    # k_S <= k_A binds, so both are one
    _, residual_ordered = _best(curve, patch, np.array([True, False, False, True, False]))
    spread = _bootstrap(curve, patch, x, seed)
    low, high = np.percentile(spread, (2.5, 97.5), axis=0)
    values = {
        name: Interval(*(float(v) for v in (x[i], low[i], high[i]))) for i, name in enumerate(NAMES)
    }
    scaled = (spread - spread.mean(axis=0)) / np.maximum(spread.std(axis=0), 1e-12)
    return Fitted(
        values=values,
        rms=rms(residual),
        rms_no_fall=rms(residual_flat),
        rms_no_fall_ordered=rms(residual_ordered),
        values_no_fall={name: float(x_flat[i]) for i, name in enumerate(NAMES)},
        floor=_floor(curve),
        means={
            name: float(np.mean(model(np.array(at), curve, patch) - curve.adhesion))
            for name, at in RECOMMENDED.items()
        },
        correlation=scaled.T @ scaled / len(scaled),
    )


def _best(
    curve: Curve, patch: Patch, free: np.ndarray, starts: tuple[tuple[float, ...], ...] = STARTS
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and residuals of least squares; without A friction does not fall, without k_S k_S = k_A."""

    def filled(part: np.ndarray) -> np.ndarray:
        x = np.array((0.0, 1.0, 0.0, 0.0, 0.0))
        x[free] = part
        if not free[4]:
            x[4] = x[3]
        return x

    found = [
        least_squares(
            lambda part: model(filled(part), curve, patch) - curve.adhesion,
            np.clip(np.array(start)[free], LOW[free], HIGH[free]),
            bounds=(LOW[free], HIGH[free]),
            x_scale=HIGH[free],
        )
        for start in starts
    ]
    best = min(found, key=lambda one: one.cost)
    return filled(best.x), best.fun


def _bootstrap(curve: Curve, patch: Patch, x: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    blocks = np.array_split(
        np.argsort(np.abs(curve.creepage)), min(BLOCKS, curve.creepage.size // 2)
    )
    out = np.empty((REPLICATES, 5))
    for i in range(REPLICATES):
        at = np.concatenate([blocks[k] for k in rng.integers(len(blocks), size=len(blocks))])
        out[i] = _best(
            Curve(*(part[at] for part in curve)), patch, np.ones(5, dtype=bool), (tuple(x),)
        )[0]
    return out


def _floor(curve: Curve) -> float:
    """Scatter about a line through each point's neighbours in creepage: a curve reaches no less."""
    order = np.argsort(np.abs(curve.creepage))
    f, e = curve.adhesion[order], np.abs(curve.creepage[order])
    half, off = 4, []
    for i in range(half, f.size - half):
        near = np.r_[i - half : i, i + 1 : i + half + 1]
        line = np.polyfit(e[near] - e[i], f[near], 1)
        off.append((f[i] - line[1]) / np.sqrt(1.0 + 1.0 / near.size))
    return float(np.sqrt(np.mean(np.square(off)))) if off else float("nan")


def falls(found: Fitted, points: int) -> bool:
    """Whether falling friction is supported: two parameters more earn more than they cost (BIC)."""
    return bool(points * np.log(found.rms_no_fall**2 / found.rms**2) > 2.0 * np.log(points))


def as_json(data: Dataset, found: Fitted) -> dict[str, Any]:
    """The content of report.json for a creep curve: only whether friction falls with sliding is asked."""
    assert data.curve is not None
    n = data.curve.creepage.size
    ratio = 2.0 * n * math.log(found.rms_no_fall / found.rms)
    cause: dict[str, Any] = {
        "name": "falling_friction",
        "axles": None,
        "parameters": {
            k: {"value": v.value, "ci95": [v.low, v.high], "unit": ""}
            for k, v in found.values.items()
        },
        "evidence": {
            "delta_bic": ratio - 2.0 * math.log(n),
            "heldout_gain": None,
            "detectability": None,
        },
        "confusable_with": [],
        "separating_test": "",
    }
    return {
        "verdict": "explained" if falls(found, n) else "consistent",
        "dataset": data.name,
        "misfit": {
            "metric": "adhesion_rmse",
            "before": found.rms_no_fall,
            "noise_floor": found.floor,
            "p_value": math.exp(-0.5 * ratio),
            "worst_against": ["sliding"],
        },
        "causes": [cause] if falls(found, n) else [],
        "gain": None,
        "unknown": None,
        "screened": [
            {
                "name": row.name,
                "delta_bic": 0.0,
                "rejected_because": "a creep curve at one speed, without time, place or axles, cannot show it",
            }
            for row in TABLE
            if row.name != "falling_friction"
        ],
        "notes": [
            f"{n} points at one speed; scatter {found.floor:.4f}: beyond falling friction (rms "
            f"{found.rms_no_fall:.4f} to {found.rms:.4f}) little can be told",
            "no points were held out: no gain is claimed",
        ],
    }


def story(report: dict[str, Any]) -> list[str]:
    """The short story of a creep curve."""
    first = (
        "Falling friction is supported."
        if report["causes"]
        else "Friction that falls with sliding is not supported by these points."
    )
    return [first, *(f"Note: {note}." for note in report["notes"])]
