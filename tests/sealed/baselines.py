"""What others would do with the same stops: three usual ways to find terms that a model lacks.

All of them begin where `explain` does, with the fitted base and the linearised replay, so that they differ in the
choice alone: there x = -A^-1 b are the coefficients, A their inverse covariance. None of them simulates clean sets.

- `bic`: forward selection by the Bayesian information criterion (Schwarz, Annals of Statistics 6, 1978);
- `sparse`: sequentially thresholded least squares of all causes at once (Brunton, Proctor, Kutz, PNAS 113, 2016),
  the threshold in deviations of a coefficient;
- `least_squares`: bounded least squares of all parameters at once, as tools that identify vehicle models offer;
  a parameter is named where its 95 % interval does not hold zero.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from rollerrig.rig.identify.causes import candidates, table
from rollerrig.rig.identify.causes.columns import Variant
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import evidence, fitting
from rollerrig.rig.mechanisms.table import BY_NAME

MOST, THRESHOLD, NORMAL_95 = 6, 4.0, 1.96
# what stands for a cause and its shape where all are fitted at once: the first that is tried
_RIDGE = 1e-6


class _Stops:
    """The normal equations of all causes that have columns, less what the base takes up."""

    def __init__(self, data: Dataset) -> None:
        design = prepare(data, data.group("tune"))
        base, *_ = fitting.fit(design, candidates.start(design))
        normal = fitting.normal_equations(design, base)[0]
        self.S, self.g = evidence.scores(normal)
        self.variants = [
            v
            for v in normal.matrix.variants
            if not evidence.is_smooth_function(v.cause)
            and v.cause in table.OF
            and all(self.S[c, c] > 1e-9 for c in v.columns)
        ]
        self.samples = design.measured_rad_s.size

    def solve(self, at: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """(coefficients, deviations) of some columns together."""
        S, scale = self.S[np.ix_(at, at)], 1.0 / np.sqrt(np.diag(self.S)[list(at)])
        inverse = np.linalg.pinv(S * np.outer(scale, scale) + _RIDGE * np.eye(len(at))) * np.outer(
            scale, scale
        )
        return -inverse @ self.g[list(at)], np.sqrt(np.maximum(np.diag(inverse), 0.0))

    def won(self, at: Sequence[int]) -> float:
        """Likelihood (-2 ln) that some columns win together."""
        x, _ = self.solve(at)
        return float(-x @ self.g[list(at)])

    def one_each(self) -> list[Variant]:
        """The first shape of each cause, on all axles where it is looked for there."""
        found: dict[tuple[str, int], Variant] = {}
        for v in self.variants:
            if v.axle == 0 or table.OF[v.cause].each_axle:
                found.setdefault((v.cause, v.axle), v)
        return list(found.values())


def bic(data: Dataset) -> dict[str, Any]:
    """Forward selection: the variant that lowers BIC most, until none does."""
    began, stops = time.monotonic(), _Stops(data)
    chosen: list[Variant] = []
    while len(chosen) < MOST:
        known, now = {v.cause for v in chosen}, [c for v in chosen for c in v.columns]
        least = [
            (
                stops.won([*now, *v.columns])
                - stops.won(now)
                - len(v.columns) * np.log(stops.samples),
                k,
            )
            for k, v in enumerate(stops.variants)
            if v.cause not in known
        ]
        best, k = max(least, default=(0.0, 0))
        if best <= 0.0:
            break
        chosen.append(stops.variants[k])
    return _answer(stops, chosen, began)


def sparse(data: Dataset) -> dict[str, Any]:
    """Least squares of one shape of each cause, small coefficients left out again and again."""
    began, stops = time.monotonic(), _Stops(data)
    chosen = stops.one_each()
    for _ in range(len(chosen)):
        x, sd = stops.solve([c for v in chosen for c in v.columns])
        large = np.abs(x) > THRESHOLD * sd
        at, kept = 0, []
        for v in chosen:
            kept += [v] if large[at : at + len(v.columns)].any() else []
            at += len(v.columns)
        if len(kept) == len(chosen):
            break
        chosen = kept
    return _answer(stops, chosen, began)


def least_squares(data: Dataset) -> dict[str, Any]:
    """Bounded least squares of one shape of each cause; those beyond their own interval of 95 %."""
    began, stops = time.monotonic(), _Stops(data)
    chosen = stops.one_each()
    at = [c for v in chosen for c in v.columns]
    scale = 1.0 / np.sqrt(np.diag(stops.S)[at])
    S = stops.S[np.ix_(at, at)] * np.outer(scale, scale) + _RIDGE * np.eye(len(at))
    root = np.linalg.cholesky(S + 1e-9 * np.eye(len(at))).T
    bounds = np.array([_bounds(v) for v in chosen for _ in v.columns]).T / scale
    found = lsq_linear(root, -np.linalg.solve(root.T, stops.g[at] * scale), bounds)
    x, sd = found.x * scale, stops.solve(at)[1]
    named, place = [], 0
    for v in chosen:
        own = slice(place, place + len(v.columns))
        named += [v] if np.any(np.abs(x[own]) > NORMAL_95 * sd[own]) else []
        place += len(v.columns)
    return _answer(stops, named, began)


def _bounds(v: Variant) -> tuple[float, float]:
    row = BY_NAME[v.cause].parameters[0]
    return (
        (-row.high, row.high)
        if table.OF[v.cause].phase or row.low == row.high
        else (row.low, row.high)
    )


def _answer(stops: _Stops, chosen: list[Variant], began_s: float) -> dict[str, Any]:
    """What was chosen, the cause that wins most first, in the form of an answer."""
    at = [c for v in chosen for c in v.columns]
    x, sd = stops.solve(at) if at else (np.zeros(0), np.zeros(0))
    order = sorted(chosen, key=lambda v: -stops.won(v.columns))
    causes = []
    for v in order:
        first = at.index(v.columns[0])
        low, high = (float(x[first] + side * NORMAL_95 * sd[first]) for side in (-1.0, 1.0))
        causes.append(
            {
                "name": v.cause,
                "confusable_with": [],
                "parameters": {BY_NAME[v.cause].parameters[0].name: {"ci95": [low, high]}},
            }
        )
    return {
        "verdict": "explained" if causes else "consistent",
        "causes": _once(causes),
        "gain": None,
        "elapsed_s": time.monotonic() - began_s,
    }


def _once(causes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each name once, as it stands first: a cause on two axles is one cause."""
    return list({cause["name"]: cause for cause in reversed(causes)}.values())[::-1]


TOOLS: dict[str, Callable[[Dataset], dict[str, Any]]] = {
    "bic": bic,
    "sparse": sparse,
    "least_squares": least_squares,
}
