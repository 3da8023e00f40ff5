"""By how much adhesion depends on load, speed, series, direction, temperature and pressure.

All points share one smooth curve of creepage, and each condition that varies multiplies it [K1].
Conditions change friction, which is the level at large creepage, more than the slope at small
creepage. So only the points at large creepage are used where these are enough.

The column of a condition has the noise of its sensor. Of the spread that no other column explains,
a part R is no noise. Noise makes an exponent smaller, and noise of the load, by which the force
was divided, adds -1 times its part:

    [K3] b = R beta, or b = R (1 + beta) - 1 where the load is the divisor             Fuller 1.1.6

Whether the adhesion was computed with the measured load is not known, so both belong to the
interval. A condition whose spread is mostly noise is not judged.

Errors of the factors allow for points whose scatter differs (White, Econometrica 48 (1980) 817-838)
and for errors that neighbours share. Source of [K3]: Fuller, Measurement Error Models (1987).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.number_text import rounded
from rollerrig.rig.identify.creep_curves import conditions, shape
from rollerrig.rig.identify.creep_curves.conditions import Condition, Prepared
from rollerrig.rig.identify.statistics.interval import Estimate

# A factor is reported if by chance any factor were as large in one of so many sets of data.
ALPHA = 0.001
# A smaller change over the range of the data is not reported.
LEAST_EFFECT = 0.01
# A factor is not judged if these points would not have shown a change of this size.
MOST_UNSEEN = 1.0
# Points at large creepage begin at this share of the largest creepage that all groups reach. They
# are enough if each group has so many of them.
LATE = 0.5
LEAST_LATE_POINTS = 10
# degrees of freedom below which no factor is judged
LEAST_FREEDOM = 5
# leverage of a point above which its residual does not show its error
MOST_LEVERAGE = 0.3
# share of sets of data in which the smallest size that is reported would have been shown
_POWER_DEVIATIONS = 0.84


class Effect(NamedTuple):
    """The effect of one condition: how adhesion changes from its low to its high value.

    Of series: from the first to the one that differs most. Of the direction: from braking to
    traction. Sizes are shares; -0.2 is 20 % less.
    """

    name: str
    judged: bool
    why_not: str
    size: float
    low: float  # 95 % interval
    high: float
    smallest: float  # change that these data would have shown
    is_reported: bool
    exponent: float  # of one column: beta [K1]
    series: dict[float, float]  # of series: the change of each against the first
    together_with: list[str]  # conditions that these data cannot distinguish from it


class Factors(NamedTuple):
    """The effects of all conditions, and the exponents of [K1]."""

    effects: list[Effect]
    conditions: tuple[Condition, ...]  # of all points, with the columns of the better form
    beta: np.ndarray
    names: list[str]  # of the conditions in the fit, one for each column of beta


def fit(all_points: Prepared) -> Factors:
    """Return the effects of the conditions on one shared curve."""
    prepared = all_points
    late = _at_large_creepage(prepared)
    if not late.all():
        prepared = prepared.chosen(late)
    together = conditions.going_together(prepared)
    fitted = [c for c in prepared.conditions if c.varies and c.name not in together]
    names = [c.name for c in fitted for _ in range(c.columns.shape[1])]
    # what the conditions change is no error that neighbours in the file share
    smooth = shape.fit(
        prepared.creepage,
        prepared.adhesion,
        np.zeros_like(prepared.group),
        prepared.columns([c.name for c in fitted]),
        prepared.file_order,
    )
    basis = np.column_stack([np.ones(prepared.creepage.size), smooth.groups[0].basis])
    freedom = prepared.creepage.size - basis.shape[1] - len(names)

    if freedom < LEAST_FREEDOM or not names:
        effects = [_not_judged(c, together, freedom, len(names)) for c in prepared.conditions]
        return Factors(effects, all_points.conditions, np.zeros(len(names)), names)

    estimate = _estimate(prepared, basis, fitted)
    in_other_form = []
    for place, c in enumerate(fitted):
        tried = fitted.copy()
        tried[place] = c.in_other_form()
        other = _estimate(prepared, basis, tried)
        if other.squares < estimate.squares:
            fitted, estimate = tried, other
            in_other_form.append(c.name)

    errors = estimate.errors * math.sqrt(smooth.inflation)
    effects = []
    for c in prepared.conditions:
        in_fit = next((f for f in fitted if f.name == c.name), None)
        if in_fit is None:
            effects.append(_not_judged(c, together, freedom, len(names)))
            continue
        places = [k for k, name in enumerate(names) if name == c.name]
        reliability = _reliability(in_fit, prepared, basis, fitted)
        if reliability < conditions.LEAST_RELIABILITY:
            effects.append(_unknown(c, _why_noise(in_fit)))
            continue
        partners = [name for name, others in together.items() if c.name in others]
        beta, beta_errors = _without_noise(
            in_fit, estimate.beta[places], errors[places], reliability
        )
        effect = _effect(in_fit, beta, beta_errors, freedom, partners, tests=len(names))
        if not effect.is_reported and effect.smallest > MOST_UNSEEN:
            why_not = f"not even a change by a factor of {1.0 + effect.smallest:.2g} would be seen"
            effect = _unknown(c, why_not)
        effects.append(effect)
    chosen = tuple(
        c.in_other_form() if c.name in in_other_form else c for c in all_points.conditions
    )
    return Factors(effects, chosen, estimate.beta, names)


class _Estimate(NamedTuple):
    """Exponents of [K1] (k,), their errors (k,), and the residual sum of squares."""

    beta: np.ndarray
    errors: np.ndarray
    squares: float


def _reliability(
    c: Condition, prepared: Prepared, basis: np.ndarray, fitted: list[Condition]
) -> float:
    """Return the part of the spread of a condition's column that is no noise [K3], 0 to 1.

    Only the spread that the curve and the other conditions do not explain counts.
    """
    if c.noise == 0.0:
        return 1.0
    others = [other.columns for other in fitted if other.name != c.name]
    explaining = np.column_stack([basis, *others])
    column = c.columns[:, 0]
    left = column - explaining @ np.linalg.lstsq(explaining, column, rcond=None)[0]
    freedom = max(column.size - explaining.shape[1], 1)
    variance = float(left @ left) / freedom
    return max(1.0 - c.noise**2 / max(variance, 1e-30), 0.0)


def _without_noise(
    c: Condition, beta: np.ndarray, errors: np.ndarray, reliability: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return exponents and their errors without the effect of noise in the column [K3]."""
    beta = beta / reliability
    errors = errors / reliability
    if c.name == conditions.LOAD:
        # half of what a noisy divisor adds, and the other half as an error
        half = 0.5 * (1.0 - reliability) / reliability
        beta = beta + half
        errors = np.hypot(errors, half)
    return beta, errors


def _why_noise(c: Condition) -> str:
    """Return why a condition whose spread is its noise is not judged."""
    scatter = f"{100.0 * c.noise:.2g} %"
    remedy = "measure at some set values"
    if c.name == conditions.TEMPERATURE:
        scatter = f"{conditions.TEMPERATURE_STEP_K * c.noise:.2g} K"
        remedy += ", or declare its noise (temperature_K in [accuracy])"
    if c.name == conditions.LOAD:
        remedy += ", or declare its noise (load_fraction in [accuracy])"
    if c.name == conditions.SPEED:
        remedy += ", or declare its noise (speed_m_s in [accuracy])"
    return (
        f"the {c.name} scatters by {scatter} from point to point, which is its whole spread, so it "
        f"may be the noise of its sensor: {remedy}"
    )


def _at_large_creepage(prepared: Prepared) -> np.ndarray:
    """Return which points are at large creepage (n,); all where these are too few."""
    numbers = np.unique(prepared.group)
    reached = min(prepared.creepage[prepared.group == number].max() for number in numbers)
    late = prepared.creepage >= LATE * reached
    counts = [int(late[prepared.group == number].sum()) for number in numbers]
    if min(counts) < LEAST_LATE_POINTS:
        return np.ones_like(late)
    return late


def _estimate(prepared: Prepared, basis: np.ndarray, fitted: list[Condition]) -> _Estimate:
    """Return the exponents of some conditions, with errors that are not shared by neighbours."""
    adhesion = prepared.adhesion
    columns = np.column_stack([c.columns for c in fitted])

    def curve_of(beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        factor = np.exp(np.clip(columns @ beta, -20.0, 20.0))
        scaled = basis * factor[:, None]
        coefficients = np.linalg.lstsq(scaled, adhesion, rcond=None)[0]
        return scaled, scaled @ coefficients

    def residual(beta: np.ndarray) -> np.ndarray:
        _, modelled = curve_of(beta)
        return adhesion - modelled

    solution = least_squares(residual, np.zeros(columns.shape[1]))
    beta = solution.x
    scaled, modelled = curve_of(beta)
    left = adhesion - modelled

    # the errors of a linear model in the neighbourhood of the solution
    jacobian = np.column_stack([columns * modelled[:, None], scaled])
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12)
    leverage = np.einsum("ij,jk,ik->i", jacobian, inverse, jacobian)
    squares = (left / np.maximum(1.0 - leverage, 0.1)) ** 2
    least = (shape.LEAST_SCATTER * np.max(np.abs(adhesion))) ** 2
    # a point that decides a coefficient alone has no residual: its error is that of all points
    freedom = max(adhesion.size - jacobian.shape[1], 1)
    usual = float(left @ left) / freedom
    squares = np.maximum(squares, np.where(leverage > MOST_LEVERAGE, max(usual, least), least))
    covariance = inverse @ (jacobian.T * squares) @ jacobian @ inverse
    k = columns.shape[1]
    errors = np.sqrt(np.maximum(np.diag(covariance)[:k], 0.0))
    return _Estimate(beta, errors, float(left @ left))


def _effect(
    c: Condition,
    beta: np.ndarray,
    errors: np.ndarray,
    freedom: int,
    partners: list[str],
    tests: int,
) -> Effect:
    """Return the effect of a condition from its coefficients and their errors.

    `tests` is the number of coefficients of all conditions, which share ALPHA.
    """
    if c.name == conditions.SERIES:
        span = 1.0
        k = int(np.argmax(np.abs(beta) / np.maximum(errors, 1e-12)))
        numbers = np.unique(c.values)[1:]
        series = {float(n): math.expm1(float(b)) for n, b in zip(numbers, beta, strict=True)}
    else:
        span = float(np.ptp(c.columns))
        k = 0
        series = {}
    estimate = Estimate(span * float(beta[k]), span * float(errors[k]), freedom)
    size = math.expm1(estimate.value)
    low, high = estimate.interval()
    # at this size four of five sets of data show the effect
    shown = estimate.smallest(ALPHA, tests) + _POWER_DEVIATIONS * estimate.error
    return Effect(
        name=c.name,
        judged=True,
        why_not="",
        size=size,
        low=math.expm1(low),
        high=math.expm1(high),
        smallest=max(math.expm1(min(shown, 20.0)), LEAST_EFFECT),
        is_reported=estimate.is_finding(ALPHA, tests) and abs(size) >= LEAST_EFFECT,
        exponent=float(beta[k]),
        series=series,
        together_with=partners,
    )


def _not_judged(
    c: Condition, together: dict[str, list[str]], freedom: int, coefficients: int
) -> Effect:
    if c.name in together:
        why_not = f"it changes together with {' and '.join(together[c.name])} in these data"
    elif not c.varies:
        why_not = _one_value(c)
    else:
        why_not = (
            f"{coefficients} factors leave {max(freedom, 0)} degrees of freedom; "
            f"at least {LEAST_FREEDOM} are needed"
        )
    return _unknown(c, why_not)


def _unknown(c: Condition, why_not: str) -> Effect:
    return Effect(
        name=c.name,
        judged=False,
        why_not=why_not,
        size=0.0,
        low=0.0,
        high=0.0,
        smallest=math.inf,
        is_reported=False,
        exponent=0.0,
        series={},
        together_with=[],
    )


def _one_value(c: Condition) -> str:
    if c.name == conditions.SERIES:
        return "there is one series"
    if c.name == conditions.DIRECTION:
        return f"all points are in {'braking' if np.median(c.values) > 0.0 else 'traction'}"
    return f"all points have the same {c.name}, {rounded(float(np.median(c.values)))} {c.unit}"
