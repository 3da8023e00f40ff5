"""Fits an explanation to a design: base within its tolerances, causes, irregularity of the rail.

Gauss-Newton on the whitened innovations, whose derivatives come from the linearised filter; the
strength and length of the irregularity are found by scipy on the exact likelihood, between the
steps, so that a cause earns likelihood only by shrinking what is left unexplained.

    [T1] -2 ln L = sum nu^2 / S + ln S over wheels and vehicles + sum (x / prior)^2
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import minimize

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.causes import columns, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.causes.columns import BASE, SensitivityMatrix
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.identify.replay.sensitivity import LinearisedReplay

MEMORY, MEMORY_STEP_M = "adhesion_memory", 2.0
LONGEST_M = 16.0  # irregularity of the rail is short: what lasts longer is to be explained, not to be called noise
_STEP = 1e-3  # of a difference
_RELEASED_NM = 30.0  # deviation of the offset of a released brake's torque, N m
_BASE_BOUNDS = {"ln_tau": 2.0, "ln_mu": 2.5, "torque_gain": 0.1, "load_gain": 0.1, "mass": 0.1}


# columns that act on a segment (then on a run's vehicle), their places in the whitened answers (n, courses), and these
Answers = list[tuple[np.ndarray, np.ndarray, np.ndarray]]


class NormalEquations(NamedTuple):
    """Normal equations of all columns: A x = -b, with priors in A; and the book."""

    A: np.ndarray
    b: np.ndarray
    matrix: SensitivityMatrix


def deviance(design: Design, explanation: Explanation) -> float:
    """-2 ln L without constants [T1]."""
    nu, S, _, vnu, vS = sensitivity.innovations(design, inputs(design, explanation))
    return float(np.sum(deviance_terms(nu, S)) + np.sum(deviance_terms(vnu, vS))) + prior_deviance(
        design, explanation
    )


def deviance_terms(nu: np.ndarray, S: np.ndarray) -> np.ndarray:
    """What each sample adds to [T1], outliers bounded."""
    return np.minimum(nu * nu / S, 36.0) + np.log(S)


def prior_deviance(design: Design, explanation: Explanation) -> float:
    """What the declared tolerances and the released brake say."""
    tolerance = max(design.calibration, 1e-4)
    cost = sum(
        (value / tolerance) ** 2 * (2.0 if label.startswith("torque") else 1.0)
        for label, value in explanation.base.items()
        if label.startswith(("torque_gain", "load_gain", "mass"))
    )
    offsets = np.zeros(design.segments)
    for cause in explanation.causes:
        if cause.name == "torque_offset" and not cause.shape:
            offsets += cause.values[0] * ((design.axle == cause.axle - 1) | (cause.axle == 0))
    seen = np.isfinite(design.released_Nm)
    off = (design.released_Nm + offsets)[seen] / np.hypot(design.released_sd_Nm[seen], _RELEASED_NM)
    return cost + float(np.sum(off * off))


def normal_equations(
    design: Design, explanation: Explanation, search: bool = True
) -> tuple[NormalEquations, LinearisedReplay, Answers]:
    """Normal equations around an explanation, its replay, the whitened answers."""
    i = inputs(design, explanation)
    matrix, linear = columns.build(design, i, explanation.causes, search)
    answers = _answers(
        design, matrix, linear, _by_differences(design, explanation, matrix, linear, search)
    )
    z = np.clip(linear.nu / np.sqrt(linear.variance), -6.0, 6.0)
    vz = np.clip(linear.vehicle_nu / np.sqrt(linear.vehicle_variance), -6.0, 6.0)
    A, b = np.zeros((len(matrix.columns), len(matrix.columns))), np.zeros(len(matrix.columns))
    innovations = [z[design.span(s)] for s in range(design.segments)] + [
        vz[design.vehicle_span(run)] for run in range(design.mass_kg.size)
    ]
    for (used, places, Z), own in zip(answers, innovations, strict=True):
        A[np.ix_(used, used)] += (Z.T @ Z)[np.ix_(places, places)]
        b[used] += (Z.T @ own.astype(Z.dtype))[places]
    _priors(design, explanation, matrix, A, b)
    return NormalEquations(A, b, matrix), linear, answers


def _answers(
    design: Design,
    matrix: SensitivityMatrix,
    linear: LinearisedReplay,
    exact: dict[int, np.ndarray],
) -> Answers:
    answers = []
    for s in range(design.segments):
        at = design.span(s)
        live = np.flatnonzero(matrix.wheel[:, at].any(axis=1))
        numbers = np.unique(matrix.bins[:, at])
        own = np.concatenate([live, numbers[numbers >= 0], [*matrix.memory]]).astype(int)
        kept = len(own) - len(matrix.memory)
        changes = np.zeros((at.stop - at.start, kept), matrix.wheel.dtype)
        changes[:, : live.size] = matrix.wheel[live, at].T
        for number in matrix.bins[:, at]:
            held = np.flatnonzero(number >= 0)
            changes[held, np.searchsorted(own[:kept], number[held])] = matrix.in_bins[at][held]
        Z = np.empty((len(changes), own.size), changes.dtype)
        sensitivity.response(changes, linear.variance[at], linear.coefficients[at], Z)
        Z[:, kept:] = 0.0  # another shape of memory than the one that is taken
        places = np.full(matrix.course.max() + 2, -1)  # in Z of each course; the last for none
        places[own] = np.arange(own.size)
        for course in exact.keys() & own.tolist():
            Z[:, places[course]] = exact[course][at] / np.sqrt(linear.variance[at])
        used = np.flatnonzero(matrix.acts[:, s] & (places[matrix.course] >= 0))
        answers.append((used, places[matrix.course[used]], Z))
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        live = np.flatnonzero(matrix.vehicle[:, at].any(axis=1))
        changes = np.ascontiguousarray(matrix.vehicle[live, at].T)
        V = np.empty_like(changes)
        sensitivity.vehicle_response(
            changes, linear.vehicle_variance[at], design.speed_noise_m_s, design.step_s, V
        )
        answers.append((matrix.on_vehicle[live], np.arange(live.size), V))
    return answers


def wheel_answers(design: Design, answers: Answers, wanted: Sequence[int]) -> np.ndarray:
    """Whitened answers of the wheels to some columns, shape (n, wanted)."""
    out = np.zeros((design.measured_rad_s.size, len(wanted)))
    for s, (used, places, Z) in enumerate(answers[: design.segments]):
        place = dict(zip(used, places, strict=True))
        for k, c in enumerate(wanted):
            if c in place:
                out[design.span(s), k] = Z[:, place[c]]
    return out


def _by_differences(
    design: Design,
    explanation: Explanation,
    matrix: SensitivityMatrix,
    linear: LinearisedReplay,
    search: bool,
) -> dict[int, np.ndarray]:
    """Answers of the wheels by their courses: to a memory, and beside one to all that is fitted.

    No derivative exists at length 0 that a filter's noise would not spoil: a finite step. Beside a memory the
    linearised filter is not good enough. Columns that share a course and no wheelset are moved together.
    """
    moves = {
        course: (
            explanation._replace(
                causes=(*explanation.causes, Cause(MEMORY, 0, shape, (MEMORY_STEP_M,)))
            ),
            MEMORY_STEP_M,
        )
        for course, shape in matrix.memory.items()
    }
    if any(cause.name == MEMORY and cause.values[0] > 0.0 for cause in explanation.causes):
        moves, covered = {}, np.zeros((matrix.course.max() + 1, design.segments), dtype=bool)
        for c in [] if search else base_columns(matrix):
            course, label, acts = matrix.course[c], matrix.columns[c].label, matrix.acts[c]
            if course >= 0 and not np.any(covered[course] & acts):
                covered[course] |= acts
                moved, _ = moves.get(course, (explanation, 0.0))
                moves[course] = (
                    moved._replace(base=moved.base | {label: moved.base.get(label, 0.0) + _STEP}),
                    _STEP,
                )
        for at, cause in enumerate(explanation.causes):
            for k, c in enumerate(same.columns if (same := matrix.variant_of(cause)) else ()):
                step = _STEP * max(abs(cause.values[k]), bounds(cause)[k][1] * _STEP)
                values = (*cause.values[:k], cause.values[k] + step, *cause.values[k + 1 :])
                if matrix.course[c] >= 0 and (not search or cause.name == MEMORY):
                    moves[matrix.course[c]] = (
                        explanation.with_cause(at, cause._replace(values=values)),
                        step,
                    )
    if not moves:
        return {}
    found = sensitivity.replays(design, [inputs(design, moved) for moved, _ in moves.values()])
    return {
        course: (nu - linear.nu) / step
        for (course, (_, step)), (nu, *_) in zip(moves.items(), found, strict=True)
    }


def _priors(
    design: Design,
    explanation: Explanation,
    matrix: SensitivityMatrix,
    A: np.ndarray,
    b: np.ndarray,
) -> None:
    for c, column in enumerate(matrix.columns):
        if column.prior > 0.0:
            A[c, c] += 1.0 / column.prior**2
            b[c] += explanation.base.get(column.label, 0.0) / column.prior**2
    present = {
        (cause.name, cause.axle): cause.values[0]
        for cause in explanation.causes
        if cause.values and not cause.shape
    }
    offset = sum(v for (name, axle), v in present.items() if name == "torque_offset" and axle == 0)
    for s in range(design.segments):
        if not np.isfinite(design.released_Nm[s]):
            continue
        sd2 = design.released_sd_Nm[s] ** 2 + _RELEASED_NM**2
        own = offset + present.get(("torque_offset", int(design.axle[s]) + 1), 0.0)
        acts = [
            v.columns[0]
            for v in matrix.variants
            if v.cause == "torque_offset" and not v.shape and v.axle in (0, int(design.axle[s]) + 1)
        ]
        for c in acts:
            b[c] += (design.released_Nm[s] + own) / sd2
            for other in acts:
                A[c, other] += 1.0 / sd2


def base_columns(matrix: SensitivityMatrix) -> list[int]:
    """Columns of the base."""
    return [c for c, column in enumerate(matrix.columns) if column.cause == BASE]


def solve(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(-A^-1 b, A^-1), scaled columns first. Raises ConfigError where the data let no column be told from another."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30))
    try:
        factor = cho_factor(A * scale * scale[:, None] + 1e-10 * np.eye(len(b)))
    except LinAlgError:
        raise ConfigError(
            "the fit cannot be solved: what a change does to the replay grows beyond bounds, as where "
            "adhesion falls steeply under wheels that slide at low speed; let the recordings end at a "
            "higher speed (6 m/s, say), or leave the run out that does so"
        ) from None
    inverse = cho_solve(factor, np.eye(len(b))) * scale * scale[:, None]
    return -inverse @ b, inverse


def fit(
    design: Design,
    explanation: Explanation,
    steps: int = 9,
    noise: bool = True,
    tolerance: float = 0.05,
    free: tuple[str, ...] = (),
) -> tuple[Explanation, float, np.ndarray]:
    """Best explanation of the same causes: (explanation, deviance, covariance of cause values).

    With `free` only the base parameters whose labels begin so are fitted, and a memory.
    """
    value, covariance = deviance(design, explanation), np.zeros((0, 0))
    for step in range(steps):
        if noise and step in (1, 3, 5) and step + 1 < steps:
            explanation, value = fit_noise(design, explanation, value)
        found, _, _ = normal_equations(design, explanation, False)
        own = [
            c
            for c in base_columns(found.matrix)
            if not free or found.matrix.columns[c].label.startswith(free)
        ]
        causes = tuple(c for c in explanation.causes if not free or c.name == MEMORY)
        at = own + [
            c for cause in causes if (same := found.matrix.variant_of(cause)) for c in same.columns
        ]
        if not np.all(np.isfinite(found.A[np.ix_(at, at)])):
            break
        try:
            change, covariance = solve(found.A[np.ix_(at, at)], found.b[at])
        except ConfigError:
            if not causes:
                raise
            break  # as far as it went: one cause that cannot be fitted further does not make the data useless
        before, labels = value, [found.matrix.columns[c].label for c in own]
        explanation, value = _search(design, explanation, labels, causes, change, value)
        if before - value < tolerance and step > 3:
            break
    size = sum(len(cause.values) for cause in explanation.causes)
    at_cause = len(covariance) - size
    return (
        explanation,
        value,
        covariance[at_cause:, at_cause:] if at_cause >= 0 else np.full((size, size), np.inf),
    )


def _search(
    design: Design,
    explanation: Explanation,
    labels: list[str],
    fitted: tuple[Cause, ...],
    change: np.ndarray,
    value: float,
) -> tuple[Explanation, float]:
    """The step of base and fitted causes, shortened until it improves."""
    for share in 0.35 ** np.arange(5.0):
        base = dict(explanation.base)
        for label, x in zip(labels, change[: len(labels)], strict=True):
            bound = next((b for k, b in _BASE_BOUNDS.items() if label.startswith(k)), 1.0)
            base[label] = float(np.clip(base.get(label, 0.0) + share * x, -bound, bound))
        tried, at = explanation._replace(base=base), len(labels)
        for cause in fitted:
            moved = cause._replace(
                values=tuple(cause.values + share * change[at : at + len(cause.values)])
            )
            tried, at = (
                tried.with_cause(explanation.causes.index(cause), within_bounds(moved)),
                at + len(cause.values),
            )
        better = deviance(design, tried)
        if better < value:
            return tried, better
    return explanation, value


def within_bounds(cause: Cause) -> Cause:
    """The cause with its coefficients inside the bounds of the table of mechanisms."""
    return cause._replace(
        values=tuple(
            float(np.clip(value, *ends))
            for value, ends in zip(cause.values, bounds(cause), strict=True)
        )
    )


def bounds(cause: Cause) -> list[tuple[float, float]]:
    """Bounds of the coefficients of a cause, of the table of mechanisms."""
    search, m = table.BY_NAME[cause.name], table.BY_NAME[cause.name].mechanism
    rows = [m.parameters[min(k, m.free - 1)] for k in range(len(cause.values))]
    return [(-row.high if search.phase else row.low, row.high) for row in rows]


def fit_noise(design: Design, explanation: Explanation, value: float) -> tuple[Explanation, float]:
    """Strength and length of the irregularity of greatest likelihood, the rest kept."""

    def rough(x: np.ndarray) -> Explanation:
        return explanation._replace(sigma=float(np.exp(x[0])), length_m=float(np.exp(x[1])))

    x0 = np.log([explanation.sigma, explanation.length_m])
    simplex = x0 + np.array([[0.0, 0.0], [-0.15, 0.0], [0.0, -0.3]])
    best = minimize(
        lambda x: deviance(design, rough(x)),
        x0,
        method="Nelder-Mead",
        bounds=np.log([(1e-3, 0.5), (1.0, LONGEST_M)]),
        options={"maxfev": 18, "initial_simplex": simplex, "fatol": 0.3},
    )
    return (rough(best.x), float(best.fun)) if best.fun < value else (explanation, value)
