"""Fits an explanation to a design: base parameters, causes, irregularity of the rail.

The fit is Gauss-Newton on the whitened innovations, whose derivatives come from the linearised
filter. Between the steps Newton's method finds the strength and length of the irregularity on the
exact likelihood. A cause thus earns likelihood only by making what is left unexplained smaller.

    [T1] -2 ln L = sum innovation^2 / variance + ln variance + sum (x / prior)^2,
         the first sum over wheels and vehicles
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import wheelsets_of
from rollerrig.rig.identify.causes import columns, discrepancy, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.causes.columns import BASE, SensitivityMatrix, Variant
from rollerrig.rig.identify.causes.courses import acts_on
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import thresholds
from rollerrig.rig.identify.decide.thresholds import OUTLIER_DEVIATIONS
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.identify.replay.sensitivity import Innovations, LinearisedReplay

# step of a finite difference: of a base parameter, and of a coefficient as a share of itself
_STEP = 1e-3

# largest absolute values of base parameters (logarithms, shares) by the beginnings of their labels
_BASE_BOUNDS = {
    "ln_tau": 2.0,
    "ln_mu": 2.5,
    "torque_gain": 0.1,
    "load_gain": 0.1,
    "mass": 0.1,
    discrepancy.BRAKE: 0.03,
    discrepancy.LATE_WINDOW: 0.5,
    discrepancy.LATE_PULSE: 0.1,
}
_OTHER_BOUND = 1.0

# steps of Gauss-Newton before which the irregularity of the rail is fitted
_NOISE_STEPS = (1, 3, 5)
# a fit may stop early only after this step
_LEAST_STEP = 3
# a step of Gauss-Newton is shortened by this factor until it improves, at most so often
_SHORTER = 0.35
_MOST_SHORTENED = 5.0

# Of the logarithms of the irregularity's standard deviation and length: differences of the
# likelihood, longest step of Newton's method, and the step after which no other one is made.
_DIFFERENCES = np.array([0.06, 0.15])
_LONGEST_STEP = np.array([0.5, 1.0])
_NEAR_IRREGULARITY = np.array([0.2, 0.4])
_NEWTON_STEPS = 3

# bounds of the irregularity of the rail: standard deviation, then length in m
_IRREGULARITY_BOUNDS = (1e-3, 0.5)
_SHORTEST_IRREGULARITY_M = 1.0


class Response(NamedTuple):
    """How whitened innovations respond to columns: of one segment's wheel, or one run's vehicle."""

    columns: np.ndarray  # (used,) numbers of the columns that act there
    places: np.ndarray  # (used,) their places in `whitened`: columns may share a course
    whitened: np.ndarray  # (samples, courses)


class NormalEquations(NamedTuple):
    """The normal equations A x = -b of all columns, with the priors in A and b."""

    A: np.ndarray  # (columns, columns)
    b: np.ndarray  # (columns,)
    matrix: SensitivityMatrix  # describes the columns


class Fit(NamedTuple):
    """A fitted explanation."""

    explanation: Explanation
    deviance: float  # -2 ln L
    covariance: np.ndarray  # of the causes' coefficients, one cause after the other


# --- likelihood ---


def deviance(design: Design, explanation: Explanation) -> float:
    """Return -2 ln L without constants [T1]."""
    return _replayed(design, explanation).deviance


class _Replayed(NamedTuple):
    """An explanation with its innovations and its deviance [T1]."""

    explanation: Explanation
    innovations: Innovations
    deviance: float


def _replayed(design: Design, explanation: Explanation) -> _Replayed:
    """Return an explanation, replayed."""
    found = sensitivity.innovations(design, inputs(design, explanation))
    of_wheels = np.sum(deviance_terms(found.nu, found.variance))
    of_vehicles = np.sum(deviance_terms(found.vehicle_nu, found.vehicle_variance))
    value = float(of_wheels + of_vehicles) + prior_deviance(design, explanation)
    return _Replayed(explanation, found, value)


def deviance_terms(innovation: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return what each sample adds to [T1]. The squares of outliers are bounded."""
    square = np.minimum(innovation * innovation / variance, OUTLIER_DEVIATIONS**2)
    return square + np.log(variance)


def prior_deviance(design: Design, explanation: Explanation) -> float:
    """Return what the declared tolerances and the torque of the released brakes add to [T1]."""
    tolerance = max(design.calibration, 1e-4)
    cost = 0.0
    for label, value in explanation.base.items():
        if label.startswith(("torque_gain", "load_gain", "mass")):
            # the gain of a torque is the sum of that of all wheelsets and that of the wheelset
            weight = 2.0 if label.startswith("torque") else 1.0
            cost += (value / tolerance) ** 2 * weight
    for label, prior in discrepancy.priors(design).items():
        cost += (explanation.base.get(label, 0.0) / prior) ** 2

    offsets_Nm = np.zeros(design.segments)
    for cause in explanation.causes:
        if cause.name == "torque_offset" and not cause.shape:
            offsets_Nm += cause.values[0] * acts_on(design, cause.axle)
    was_released = np.isfinite(design.released_Nm)
    deviation_Nm = np.hypot(design.released_sd_Nm[was_released], thresholds.RELEASED_TORQUE_NM)
    off = (design.released_Nm + offsets_Nm)[was_released] / deviation_Nm
    return cost + float(np.sum(off * off))


# --- normal equations ---


def normal_equations(
    design: Design,
    explanation: Explanation,
    search: bool = True,
    replayed: Innovations | None = None,
) -> tuple[NormalEquations, LinearisedReplay, list[Response]]:
    """Return the normal equations around an explanation, its linearised replay, and the responses.

    The columns are the base and the explanation's causes, and with `search` all possible causes and
    smooth functions. `replayed` are the innovations of the explanation, if they are known.
    """
    replay_inputs = inputs(design, explanation)
    matrix, linear = columns.build(design, replay_inputs, explanation.causes, search, replayed)
    exact = _finite_differences(design, explanation, matrix, linear, search)
    responses = _responses(design, matrix, linear, exact)

    z = _bounded(linear.nu / np.sqrt(linear.variance))
    vehicle_z = _bounded(linear.vehicle_nu / np.sqrt(linear.vehicle_variance))
    innovations = [z[design.span(s)] for s in range(design.segments)]
    innovations += [vehicle_z[design.vehicle_span(run)] for run in range(design.mass_kg.size)]

    A = np.zeros((len(matrix.columns), len(matrix.columns)))
    b = np.zeros(len(matrix.columns))
    # where the replay is unstable they are not finite, which `fit` and `goodness` check
    with np.errstate(over="ignore", invalid="ignore"):
        for response, innovation in zip(responses, innovations, strict=True):
            used, places, Z = response
            sensitivity.add_squares(Z.T @ Z, used, places, A)
            b[used] += (Z.T @ innovation.astype(Z.dtype))[places]
    _add_priors(design, explanation, matrix, A, b)
    return NormalEquations(A, b, matrix), linear, responses


def _bounded(z: np.ndarray) -> np.ndarray:
    """Return normalised innovations with outliers bounded."""
    return np.clip(z, -OUTLIER_DEVIATIONS, OUTLIER_DEVIATIONS)


def _responses(
    design: Design,
    matrix: SensitivityMatrix,
    linear: LinearisedReplay,
    exact: dict[int, np.ndarray],
) -> list[Response]:
    """Return the responses of each wheel, then of each vehicle.

    Exact responses (`exact`, by course) replace linearised ones.
    """
    responses = [_wheel_response(design, matrix, linear, exact, s) for s in range(design.segments)]
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        live = np.flatnonzero(matrix.vehicle[:, at].any(axis=1))
        changes = np.ascontiguousarray(matrix.vehicle[live, at].T)
        whitened = np.empty_like(changes)
        sensitivity.vehicle_response(
            changes,
            linear.vehicle_variance[at],
            design.speed_noise_m_s,
            design.step_s,
            np.zeros(live.size),
            whitened,
        )
        responses.append(
            Response(
                columns=matrix.on_vehicle[live],
                places=np.arange(live.size),
                whitened=whitened,
            )
        )
    return responses


def _wheel_response(
    design: Design,
    matrix: SensitivityMatrix,
    linear: LinearisedReplay,
    exact: dict[int, np.ndarray],
    segment: int,
) -> Response:
    """Return the whitened response of the wheel of one segment."""
    at = design.span(segment)

    # the courses that are not zero here: written ones, bins, and those of finite steps
    live = np.flatnonzero(matrix.wheel[:, at].any(axis=1))
    numbers = np.unique(matrix.bins[:, at])
    courses = np.concatenate([live, numbers[numbers >= 0], [*matrix.stepped]]).astype(int)
    linearised = len(courses) - len(matrix.stepped)

    # change of the wheel's acceleration by each course; a bin has its change where its number is
    changes = np.zeros((at.stop - at.start, linearised), matrix.wheel.dtype)
    changes[:, : live.size] = matrix.wheel[live, at].T
    for number in matrix.bins[:, at]:
        inside = np.flatnonzero(number >= 0)
        place = np.searchsorted(courses[:linearised], number[inside])
        changes[inside, place] = matrix.in_bins[at][inside]

    Z = np.empty((len(changes), courses.size), changes.dtype)
    sensitivity.response(
        changes,
        linear.variance[at],
        linear.coefficients[at],
        np.zeros(linearised),
        np.zeros(linearised),
        Z,
    )
    # courses of finite steps that were not replayed: the explanation has the cause in another shape
    Z[:, linearised:] = 0.0

    # place of each course in Z, -1: not there; the last element is for columns without a course
    places = np.full(matrix.course.max() + 2, -1)
    places[courses] = np.arange(courses.size)
    for course in exact.keys() & courses.tolist():
        Z[:, places[course]] = exact[course][at] / np.sqrt(linear.variance[at])

    used = np.flatnonzero(matrix.acts[:, segment] & (places[matrix.course] >= 0))
    return Response(columns=used, places=places[matrix.course[used]], whitened=Z)


def wheel_responses(design: Design, responses: list[Response], wanted: Sequence[int]) -> np.ndarray:
    """Return the whitened responses of the wheels to some columns, shape (n, wanted)."""
    out = np.zeros((design.measured_rad_s.size, len(wanted)))
    for segment, response in enumerate(responses[: design.segments]):
        place_of = dict(zip(response.columns, response.places, strict=True))
        for k, column in enumerate(wanted):
            if column in place_of:
                out[design.span(segment), k] = response.whitened[:, place_of[column]]
    return out


class _Move(NamedTuple):
    """A finite step: the explanation after it, and its size in the unit of the coefficient."""

    explanation: Explanation
    step: float


def _finite_differences(
    design: Design,
    explanation: Explanation,
    matrix: SensitivityMatrix,
    linear: LinearisedReplay,
    search: bool,
) -> dict[int, np.ndarray]:
    """Return responses of the wheels (n,) by their courses, where linearising is not enough.

    A cause with a finite step has no derivative at size 0 that the noise of a filter would not
    spoil. Once such a cause is in the explanation, the linearised filter is not good enough for the
    other coefficients either: all that are fitted get a finite difference.
    """
    if any(_is_stepped(cause) and cause.values[0] > 0.0 for cause in explanation.causes):
        moves = _moves_of_all(explanation, matrix, search)
    else:
        moves = _moves_of_stepped(explanation, matrix)
    if not moves:
        return {}

    replays = sensitivity.replays(
        design, [inputs(design, move.explanation) for move in moves.values()]
    )
    differences = {}
    for (course, move), (innovation, *_) in zip(moves.items(), replays, strict=True):
        differences[course] = (innovation - linear.nu) / move.step
    return differences


def _is_stepped(cause: Cause) -> bool:
    """Return whether a cause has no derivative at size 0."""
    return table.BY_NAME[cause.name].finite_step > 0.0


def _moves_of_stepped(explanation: Explanation, matrix: SensitivityMatrix) -> dict[int, _Move]:
    """Return the first step of each variant that has no derivative at size 0, by its course."""
    moves = {}
    for course, variant in matrix.stepped.items():
        step = table.BY_NAME[variant.cause].finite_step
        cause = Cause(variant.cause, variant.axle, variant.shape, (step,))
        moves[course] = _Move(explanation._replace(causes=(*explanation.causes, cause)), step)
    return moves


def _moves_of_all(
    explanation: Explanation, matrix: SensitivityMatrix, search: bool
) -> dict[int, _Move]:
    """Return a small step of each coefficient that is fitted, by its course.

    In a search it is a step of the stepped cause only. Columns that share a course and no wheelset
    are moved in one replay.
    """
    moves: dict[int, _Move] = {}
    if not search:
        segments = matrix.acts.shape[1]
        covered = np.zeros((matrix.course.max() + 1, segments), dtype=bool)
        for c in base_columns(matrix):
            course = matrix.course[c]
            acts = matrix.acts[c]
            if course >= 0 and not np.any(covered[course] & acts):
                covered[course] |= acts
                moved = moves[course].explanation if course in moves else explanation
                label = matrix.columns[c].label
                base = moved.base | {label: moved.base.get(label, 0.0) + _STEP}
                moves[course] = _Move(moved._replace(base=base), _STEP)

    for at, cause in enumerate(explanation.causes):
        variant = matrix.variant_of(cause)
        if variant is None or (search and not _is_stepped(cause)):
            continue
        for k, c in enumerate(variant.columns):
            course = matrix.course[c]
            if course < 0:
                continue
            _, high = bounds(cause)[k]
            step = _STEP * max(abs(cause.values[k]), high * _STEP)
            values = (*cause.values[:k], cause.values[k] + step, *cause.values[k + 1 :])
            moved = explanation.with_cause(at, cause._replace(values=values))
            moves[course] = _Move(moved, step)
    return moves


def _add_priors(
    design: Design,
    explanation: Explanation,
    matrix: SensitivityMatrix,
    A: np.ndarray,
    b: np.ndarray,
) -> None:
    """Add tolerances and the torque of released brakes to the normal equations, in place."""
    for c, column in enumerate(matrix.columns):
        if column.prior > 0.0:
            A[c, c] += 1.0 / column.prior**2
            b[c] += explanation.base.get(column.label, 0.0) / column.prior**2

    axles = design.axles
    offsets = [
        cause for cause in explanation.causes if cause.name == "torque_offset" and not cause.shape
    ]
    for s in range(design.segments):
        if not np.isfinite(design.released_Nm[s]):
            continue
        axle = int(design.axle[s]) + 1
        variance = design.released_sd_Nm[s] ** 2 + thresholds.RELEASED_TORQUE_NM**2
        here = [cause for cause in offsets if axle in wheelsets_of(cause.axle, axles)]
        offset_Nm = sum(cause.values[0] for cause in here)
        acting = [v.columns[0] for v in matrix.variants if _is_plain_offset(v, axle, axles)]
        for c in acting:
            b[c] += (design.released_Nm[s] + offset_Nm) / variance
            for other in acting:
                A[c, other] += 1.0 / variance


def _is_plain_offset(variant: Variant, axle: int, axles: int) -> bool:
    """Return whether a variant is an offset of the torque that also acts on a released brake.

    `axle` is a wheelset, counted from 1, of a vehicle with this number of `axles`.
    """
    if variant.cause != "torque_offset" or variant.shape:
        return False
    return axle in wheelsets_of(variant.axle, axles)


def base_columns(matrix: SensitivityMatrix) -> list[int]:
    """Return the numbers of the columns of the base."""
    return [c for c, column in enumerate(matrix.columns) if column.cause == BASE]


def solve(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (-A^-1 b, A^-1), by way of scaled columns.

    Raises ConfigError if the matrix is not positive definite.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30))
    try:
        factor = cho_factor(A * scale * scale[:, None] + 1e-10 * np.eye(len(b)))
    except LinAlgError:
        raise ConfigError(
            "the fit cannot be solved: the effect of a change on the replay grows without bound. This "
            "happens if adhesion falls steeply under wheels that slide at low speed. Let the "
            "recordings end at a higher speed (for example 6 m/s), or leave out the run in question"
        ) from None
    inverse = cho_solve(factor, np.eye(len(b))) * scale * scale[:, None]
    return -inverse @ b, inverse


# --- fit ---


def fit(
    design: Design,
    explanation: Explanation,
    steps: int = 9,
    noise: bool = True,
    tolerance: float = 0.05,
    free: tuple[str, ...] = (),
) -> Fit:
    """Return the best explanation with the same causes, by at most `steps` steps of Gauss-Newton.

    With `noise` the irregularity of the rail is fitted too. The fit stops early if a step improves
    the deviance by less than `tolerance`. With `free` only those base parameters are fitted whose
    labels begin so, and of the causes only those with a finite step.
    """
    best = _replayed(design, explanation)
    covariance = np.zeros((0, 0))
    for step in range(steps):
        if noise and step in _NOISE_STEPS and step + 1 < steps:
            best = _fit_noise(design, best)
        explanation = best.explanation

        normal, _, _ = normal_equations(design, explanation, False, best.innovations)
        matrix = normal.matrix
        fitted_base = [
            c for c in base_columns(matrix) if not free or matrix.columns[c].label.startswith(free)
        ]
        fitted_causes = tuple(c for c in explanation.causes if not free or _is_stepped(c))
        at = [*fitted_base]
        for cause in fitted_causes:
            variant = matrix.variant_of(cause)
            if variant is not None:
                at += variant.columns

        A = normal.A[np.ix_(at, at)]
        if not np.all(np.isfinite(A)):
            break
        try:
            change, covariance = solve(A, normal.b[at])
        except ConfigError:
            if not fitted_causes:
                raise
            # one cause that cannot be fitted further does not make the data useless
            break
        before = best.deviance
        labels = [matrix.columns[c].label for c in fitted_base]
        best = _step(design, best, labels, fitted_causes, change)
        if before - best.deviance < tolerance and step > _LEAST_STEP:
            break

    explanation = best.explanation
    size = sum(len(cause.values) for cause in explanation.causes)
    first_of_causes = len(covariance) - size
    if first_of_causes < 0:
        return Fit(explanation, best.deviance, np.full((size, size), np.inf))
    return Fit(explanation, best.deviance, covariance[first_of_causes:, first_of_causes:])


def _step(
    design: Design,
    before: _Replayed,
    labels: list[str],
    fitted_causes: tuple[Cause, ...],
    change: np.ndarray,
) -> _Replayed:
    """Return the explanation after a step, shortened until it improves.

    `change` holds the changes of the base parameters with these labels, then of the causes'
    coefficients.
    """
    explanation = before.explanation
    of_base = change[: len(labels)]
    for share in _SHORTER ** np.arange(_MOST_SHORTENED):
        base = dict(explanation.base)
        for label, x in zip(labels, of_base, strict=True):
            bound = _base_bound(label)
            base[label] = float(np.clip(base.get(label, 0.0) + share * x, -bound, bound))

        tried = explanation._replace(base=base)
        at = len(labels)
        for cause in fitted_causes:
            end = at + len(cause.values)
            moved = cause._replace(values=tuple(cause.values + share * change[at:end]))
            tried = tried.with_cause(explanation.causes.index(cause), within_bounds(moved))
            at = end

        better = _replayed(design, tried)
        if better.deviance < before.deviance:
            return better
    return before


def _base_bound(label: str) -> float:
    """Return the largest absolute value of a base parameter."""
    for beginning, bound in _BASE_BOUNDS.items():
        if label.startswith(beginning):
            return bound
    return _OTHER_BOUND


def within_bounds(cause: Cause) -> Cause:
    """Return the cause with its coefficients inside the bounds of the table of mechanisms."""
    values = []
    for value, (low, high) in zip(cause.values, bounds(cause), strict=True):
        values.append(float(np.clip(value, low, high)))
    return cause._replace(values=tuple(values))


def bounds(cause: Cause) -> list[tuple[float, float]]:
    """Return the bounds (low, high) of a cause's coefficients, from the table of mechanisms."""
    search = table.BY_NAME[cause.name]
    mechanism = search.mechanism
    limits = []
    for k in range(len(cause.values)):
        row = mechanism.parameters[min(k, mechanism.free - 1)]
        # an amplitude with a phase is fitted as cosine and sine, of either sign
        low = -row.high if search.phase else row.low
        limits.append((low, row.high))
    return limits


def _fit_noise(design: Design, before: _Replayed) -> _Replayed:
    """Return the explanation with the most likely irregularity. All else remains fixed.

    Each step of Newton's method takes the derivatives from differences of the likelihood. What an
    irregularity does not change, inputs and vehicles, is not computed again.
    """
    explanation = before.explanation
    replay_inputs = inputs(design, explanation)
    of_vehicles = np.sum(
        deviance_terms(before.innovations.vehicle_nu, before.innovations.vehicle_variance)
    )
    of_priors = prior_deviance(design, explanation)
    lengths_m = (_SHORTEST_IRREGULARITY_M, thresholds.LONGEST_IRREGULARITY_M)
    low, high = np.log([_IRREGULARITY_BOUNDS, lengths_m]).T

    def at(x: np.ndarray) -> _Replayed:
        """Return the replay with the logarithms of strength and length in `x`."""
        changed = explanation._replace(sigma=float(np.exp(x[0])), length_m=float(np.exp(x[1])))
        p = replay_inputs.parameters.copy()
        p[:, parameters.IRREGULARITY] = changed.sigma
        p[:, parameters.IRREGULARITY_LENGTH] = changed.length_m
        wheels = sensitivity.replay_wheels(design, replay_inputs._replace(parameters=p))
        nu, variance, field = wheels
        found = before.innovations._replace(nu=nu, variance=variance, field=field)
        of_wheels = np.sum(deviance_terms(found.nu, found.variance))
        return _Replayed(changed, found, float(of_wheels + of_vehicles) + of_priors)

    best = before
    x = np.log([explanation.sigma, explanation.length_m])
    for _ in range(_NEWTON_STEPS):
        change = _newton_step(lambda x: at(x).deviance, x, best.deviance, low, high)
        tried = at(x + change)
        if not tried.deviance < best.deviance:
            break
        best = tried
        x = x + change
        if np.all(np.abs(change) < _NEAR_IRREGULARITY):
            break
    return best


def _newton_step(
    function: Callable[[np.ndarray], float],
    x: np.ndarray,
    value: float,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """Return the step (2,) to the least of a function by its differences, within bounds.

    `value` is the function at `x`. Where it is not convex the step goes down the slope.
    """
    # differences toward the middle of the bounds
    towards = np.where(x + _DIFFERENCES <= high, 1.0, -1.0)
    h = _DIFFERENCES * towards
    first = np.array([h[0], 0.0])
    second = np.array([0.0, h[1]])
    plus = np.array([function(x + first), function(x + second)])
    minus = np.array([function(x - first), function(x - second)])
    gradient = (plus - minus) / (2.0 * h)
    curvature = (plus + minus - 2.0 * value) / (h * h)
    mixed = (function(x + first + second) - plus.sum() + value) / (h[0] * h[1])
    hessian = np.array([[curvature[0], mixed], [mixed, curvature[1]]])
    if not np.all(np.isfinite(hessian)):
        return np.zeros(2)
    if np.all(np.linalg.eigvalsh(hessian) > 0.0):
        change = -np.linalg.solve(hessian, gradient)
    else:
        change = -np.sign(gradient) * _LONGEST_STEP
    change *= min(1.0, float(np.min(_LONGEST_STEP / np.maximum(np.abs(change), 1e-12))))
    return np.clip(x + change, low, high) - x
