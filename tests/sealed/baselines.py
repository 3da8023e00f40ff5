"""Three usual methods that find terms which a model lacks, for comparison with `explain`.

All of them start where `explain` starts: with the fitted base and the linearised replay. They
differ from it in the selection only. There x = -A^-1 b are the coefficients of all candidate
columns, and A^-1 is their covariance. None of them simulates data without a hidden effect.

- `bic`: forward selection by the Bayesian information criterion (Schwarz, Annals of Statistics 6,
  1978);
- `sparse`: sequentially thresholded least squares of all causes together (Brunton, Proctor, Kutz,
  PNAS 113, 2016); the threshold is in standard deviations of a coefficient;
- `least_squares`: bounded least squares of all parameters together, as tools for the identification
  of vehicle models do it; a cause is reported where its 95 % interval does not contain zero.
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

# causes that `bic` selects at most
MOST_CAUSES = 6
# standard deviations below which `sparse` drops a coefficient
THRESHOLD = 4.0
# standard deviations of the normal distribution that contain 95 %
NORMAL_95 = 1.96
# added to the diagonal of the scaled normal matrix, because columns may be nearly collinear
_RIDGE = 1e-6
# columns with less information than this are left out
_LEAST_INFORMATION = 1e-9


class _Stops:
    """The normal equations of all candidate columns, less what the base parameters absorb.

    A variant is one cause in one shape on one axle (0: on all axles); it has one or more columns.
    """

    def __init__(self, data: Dataset) -> None:
        design = prepare(data, data.group("tune"))
        base, *_ = fitting.fit(design, candidates.untuned(design))
        normal = fitting.normal_equations(design, base)[0]
        # of all n columns: information matrix (n, n), and gradient (n,)
        self.S, self.g = evidence.scores(normal)
        self.variants = [
            variant for variant in normal.matrix.variants if self._is_a_candidate(variant)
        ]
        self.samples = design.measured_rad_s.size

    def _is_a_candidate(self, variant: Variant) -> bool:
        if evidence.is_smooth_function(variant.cause) or variant.cause not in table.BY_NAME:
            return False
        return all(self.S[c, c] > _LEAST_INFORMATION for c in variant.columns)

    def solve(self, at: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return (coefficients, standard deviations) of some columns together."""
        S = self.S[np.ix_(at, at)]
        scale = 1.0 / np.sqrt(np.diag(self.S)[list(at)])
        scales = np.outer(scale, scale)
        inverse = np.linalg.pinv(S * scales + _RIDGE * np.eye(len(at))) * scales
        deviations = np.sqrt(np.maximum(np.diag(inverse), 0.0))
        return -inverse @ self.g[list(at)], deviations

    def won(self, at: Sequence[int]) -> float:
        """Return by how much some columns together lower -2 ln(likelihood)."""
        x, _ = self.solve(at)
        return float(-x @ self.g[list(at)])

    def one_each(self) -> list[Variant]:
        """Return the first shape of each cause, on each axle where the cause acts on one axle."""
        first: dict[tuple[str, int], Variant] = {}
        for variant in self.variants:
            if variant.axle == 0 or table.BY_NAME[variant.cause].single_axles_only:
                first.setdefault((variant.cause, variant.axle), variant)
        return list(first.values())


def _columns(variants: Sequence[Variant]) -> list[int]:
    return [column for variant in variants for column in variant.columns]


def bic(data: Dataset) -> dict[str, Any]:
    """Answer by forward selection: add the variant that lowers BIC most, until none lowers it."""
    began_s = time.monotonic()
    stops = _Stops(data)
    chosen: list[Variant] = []
    while len(chosen) < MOST_CAUSES:
        known = {variant.cause for variant in chosen}
        now = _columns(chosen)
        gains = []
        for k, variant in enumerate(stops.variants):
            if variant.cause in known:
                continue
            gain = (
                stops.won([*now, *variant.columns])
                - stops.won(now)
                - len(variant.columns) * np.log(stops.samples)
            )
            gains.append((gain, k))
        best, k = max(gains, default=(0.0, 0))
        if best <= 0.0:
            break
        chosen.append(stops.variants[k])
    return _answer(stops, chosen, began_s)


def sparse(data: Dataset) -> dict[str, Any]:
    """Answer by repeated least squares of one shape of each cause, without small coefficients."""
    began_s = time.monotonic()
    stops = _Stops(data)
    chosen = stops.one_each()
    for _ in range(len(chosen)):
        x, deviations = stops.solve(_columns(chosen))
        large = np.abs(x) > THRESHOLD * deviations
        remaining = _those_with(large, chosen)
        if len(remaining) == len(chosen):
            break
        chosen = remaining
    return _answer(stops, chosen, began_s)


def least_squares(data: Dataset) -> dict[str, Any]:
    """Answer by bounded least squares of one shape of each cause, and by 95 % intervals."""
    began_s = time.monotonic()
    stops = _Stops(data)
    chosen = stops.one_each()
    at = _columns(chosen)
    scale = 1.0 / np.sqrt(np.diag(stops.S)[at])
    S = stops.S[np.ix_(at, at)] * np.outer(scale, scale) + _RIDGE * np.eye(len(at))
    root = np.linalg.cholesky(S + 1e-9 * np.eye(len(at))).T
    bounds = np.array([_bounds(variant) for variant in chosen for _ in variant.columns]).T / scale
    solution = lsq_linear(root, -np.linalg.solve(root.T, stops.g[at] * scale), bounds)
    x = solution.x * scale
    _, deviations = stops.solve(at)
    significant = np.abs(x) > NORMAL_95 * deviations
    return _answer(stops, _those_with(significant, chosen), began_s)


def _those_with(marked: np.ndarray, variants: Sequence[Variant]) -> list[Variant]:
    """Return the variants of which a column is marked; `marked`: of all their columns, in order."""
    result = []
    first = 0
    for variant in variants:
        behind = first + len(variant.columns)
        if marked[first:behind].any():
            result.append(variant)
        first = behind
    return result


def _bounds(variant: Variant) -> tuple[float, float]:
    """Return the allowed range of the coefficients of a variant."""
    row = BY_NAME[variant.cause].parameters[0]
    # the sign of a coefficient depends on its phase; equal limits mean that none are given
    if table.BY_NAME[variant.cause].phase or row.low == row.high:
        return -row.high, row.high
    return row.low, row.high


def _answer(stops: _Stops, chosen: list[Variant], began_s: float) -> dict[str, Any]:
    """Return the selected variants as an answer; the cause that fits best comes first."""
    at = _columns(chosen)
    if at:
        x, deviations = stops.solve(at)
    else:
        x, deviations = np.zeros(0), np.zeros(0)

    causes: dict[str, dict[str, Any]] = {}
    for variant in sorted(chosen, key=lambda variant: -stops.won(variant.columns)):
        if variant.cause in causes:
            # one cause on two axles is one cause: with the interval of the first, in the last place
            causes[variant.cause] = causes.pop(variant.cause)
            continue
        first = at.index(variant.columns[0])
        low = float(x[first] - NORMAL_95 * deviations[first])
        high = float(x[first] + NORMAL_95 * deviations[first])
        parameter = BY_NAME[variant.cause].parameters[0].name
        causes[variant.cause] = {
            "name": variant.cause,
            "confusable_with": [],
            "parameters": {parameter: {"ci95": [low, high]}},
        }
    return {
        "verdict": "explained" if causes else "consistent",
        "causes": list(causes.values()),
        "gain": None,
        "elapsed_s": time.monotonic() - began_s,
    }


TOOLS: dict[str, Callable[[Dataset], dict[str, Any]]] = {
    "bic": bic,
    "sparse": sparse,
    "least_squares": least_squares,
}
