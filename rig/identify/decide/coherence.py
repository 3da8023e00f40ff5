"""Checks whether a fitted cause shows the same everywhere, as its mechanism demands.

A search has freedom that a mechanism does not have: a window of time may begin anywhere in each
run, a place is one place for all runs, and a torque is felt by the wheel and by the vehicle. A
cause that used this freedom fits the data and is another effect. So after the fit:

- sand follows a trigger: its starts are at about the same time after the brake acts, after the
  first slide, or at the same speed, and it does not last a few seconds in one run and long in
  another;
- a patch is at the same place in all runs: edges that are moved in each run alone win little;
- a torque is the same in the filters of the wheels and in that of the vehicle;
- a force is there while the brake is released, or whatever the torque is: brakes within their
  calibration that vary in common ([Y4] of `causes.discrepancy`) do not explain it as well. A
  variation in each run by itself has many free values, so its best fit wins by chance what a cause
  cannot win. Its evidence is that of all its values together.

    [C1] z^2 = (x_w - x_v)^2 / (1 / S_w + 1 / S_v), x = -g / S of a coefficient in the filters of
         the wheels (w) and in that of the vehicle (v), less what the base absorbs there
    [O1] evidence = deviance + ln det(S P), S the information on the values of a variation less
         what the rest of the model absorbs, P the variances that they are expected to have
Source of [O1]: Laplace's approximation of the marginal likelihood; Kass and Raftery, Journal of the
American Statistical Association 90 (1995), section 4.1.
"""

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.causes import discrepancy
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data.preparation import CommonBrake, Design
from rollerrig.rig.identify.decide import evidence, fitting, shapes, stopping, thresholds
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import TORQUE, VEHICLE
from rollerrig.rig.mechanisms.table import BY_NAME

FORMS = tuple(form for form in CommonBrake if form is not CommonBrake.NONE)
# the brake acts where the torque is above this share of the largest of the run
_ACTING_SHARE = 0.1


class Contradiction(Enum):
    """What a cause should show and does not."""

    NO_TRIGGER = "no trigger"  # sand that follows nothing
    OTHER_PLACES = "other places"  # a patch that is elsewhere in each run
    OTHER_FORCE = "other force"  # a torque that wheels and vehicle feel differently


class Window(NamedTuple):
    """Where a window acts in one run, in s or m from the beginning of the run."""

    run: str
    start: float
    end: float


class Contradicted(NamedTuple):
    """A fitted cause that does not show what its mechanism demands."""

    cause: Cause
    likelihood_ratio: float
    what: Contradiction
    windows: tuple[Window, ...]  # where it acts in each run, for sand and patches


def of_window(
    design: Design, explanation: Explanation, at: int, likelihood_ratio: float
) -> Contradicted | None:
    """Return sand or a patch, cause number `at` of a fitted explanation, if it is contradicted.

    None: nothing contradicts it, or the cause acts in no window. `likelihood_ratio` is what it won.
    """
    cause = explanation.causes[at]
    if cause.name == "sanding" and not _follows_a_trigger(design, cause):
        what = Contradiction.NO_TRIGGER
        return Contradicted(cause, likelihood_ratio, what, tuple(sand_windows(design, cause)))
    if cause.name == "contaminated_patch":
        apart = shapes.patch_by_run(design, explanation, at)
        if not _is_one_place(design, explanation, apart, at):
            windows = patch_windows(design, apart.causes[at])
            return Contradicted(cause, likelihood_ratio, Contradiction.OTHER_PLACES, windows)
    return None


def of_forces(design: Design, explanation: Explanation) -> int | None:
    """Return the number of the first torque that wheels and vehicle feel differently, or None.

    All causes must be in the explanation: what is missing would look like such a difference.
    """
    for at, cause in enumerate(explanation.causes):
        if BY_NAME[cause.name].acts_on != TORQUE:
            continue
        square, share = disagreement(design, explanation, at)
        if square > thresholds.MOST_DISAGREEMENT and share > thresholds.OTHER_FORCE_SHARE:
            return at
    return None


# --- sand ---


def sand_windows(design: Design, cause: Cause) -> list[Window]:
    """Return when sand acts in each run that has it, in s."""
    windows = []
    for run in design.names:
        start_s = cause.shape.get(f"start_s {run}")
        if start_s is not None:
            duration_s = cause.shape[f"duration_s {run}"]
            windows.append(Window(run, start_s, start_s + duration_s))
    return windows


def _follows_a_trigger(design: Design, cause: Cause) -> bool:
    """Return whether the starts of sand have the same distance to a trigger in all runs."""
    windows = sand_windows(design, cause)
    durations_s = [window.end - window.start for window in windows]
    if max(durations_s) > thresholds.SAND_DURATION_RATIO * min(durations_s):
        return False

    after_brake_s = []
    after_slide_s = []
    speed_m_s = []
    for window in windows:
        run = design.names.index(window.run)
        of_first = design.span(design.axles * run)
        time_s = design.time_s[of_first]
        begin = int(np.searchsorted(time_s, window.start))
        after_brake_s.append(window.start - _brake_acts_s(design, run))
        after_slide_s.append(window.start - _first_slide_s(design, run))
        speed_m_s.append(design.speed_m_s[of_first][min(begin, time_s.size - 1)])

    tolerance_s = thresholds.SAND_ONSET_TOLERANCE_S
    for delays_s in (after_brake_s, after_slide_s):
        # sand comes after its trigger; the edge of a window is known to a bin
        if min(delays_s) > -thresholds.SAND_EDGE_S and np.ptp(delays_s) < tolerance_s:
            return True
    is_braked = min(after_brake_s) > -thresholds.SAND_EDGE_S
    return is_braked and bool(np.ptp(speed_m_s) < thresholds.SAND_ONSET_TOLERANCE_M_S)


def _brake_acts_s(design: Design, run: int) -> float:
    """Return when the brake of the first wheelset begins to act in a run, in s."""
    at = design.span(design.axles * run)
    torque_Nm = design.torque_Nm[at]
    acts = torque_Nm > _ACTING_SHARE * torque_Nm.max()
    return float(design.time_s[at][int(np.argmax(acts))])


def _first_slide_s(design: Design, run: int) -> float:
    """Return when a wheelset slides for the first time in a run, in s; infinite: never."""
    first_s = np.inf
    for axle in range(design.axles):
        at = design.span(design.axles * run + axle)
        slides = design.sliding_m_s[at] > thresholds.SAND_SLIDE_M_S
        if slides.any():
            first_s = min(first_s, float(design.time_s[at][int(np.argmax(slides))]))
    return first_s


# --- a patch ---


def patch_windows(design: Design, cause: Cause) -> tuple[Window, ...]:
    """Return where a patch with edges of each run (`shapes.patch_by_run`) is, in m."""
    windows = []
    for run in design.names:
        start_m = cause.shape[f"start_m {run}"]
        windows.append(Window(run, start_m, start_m + cause.shape[f"length_m {run}"]))
    return tuple(windows)


def _is_one_place(design: Design, explanation: Explanation, apart: Explanation, at: int) -> bool:
    """Return whether `apart`, with the edges of the patch moved in each run alone, wins little."""
    won = fitting.deviance(design, _without(explanation, at)) - fitting.deviance(
        design, explanation
    )
    gained = fitting.deviance(design, explanation) - fitting.deviance(design, apart)
    least = thresholds.PRICE_OF_COEFFICIENT * 2 * (design.mass_kg.size - 1)
    return gained < max(least, thresholds.PATCH_APART_SHARE * won)


def _without(explanation: Explanation, at: int) -> Explanation:
    causes = (*explanation.causes[:at], *explanation.causes[at + 1 :])
    return explanation._replace(causes=causes)


# --- a torque ---


def disagreement(design: Design, explanation: Explanation, at: int) -> tuple[float, float]:
    """Return how differently wheels and vehicle feel a torque: z^2 [C1], and the share of its size.

    Both are 0 if wheels or vehicle feel nothing. The explanation is fitted, so its coefficient is
    the compromise of both.
    """
    normal, linear, responses = fitting.normal_equations(design, explanation, search=False)
    variant = normal.matrix.variant_of(explanation.causes[at])
    if variant is None:
        return 0.0, 0.0

    A = np.zeros_like(normal.A)
    b = np.zeros_like(normal.b)
    z = np.clip(
        linear.vehicle_nu / np.sqrt(linear.vehicle_variance),
        -thresholds.OUTLIER_DEVIATIONS,
        thresholds.OUTLIER_DEVIATIONS,
    )
    for run, response in enumerate(responses[design.segments :]):
        used, places, whitened = response
        innovation = z[design.vehicle_span(run)].astype(whitened.dtype)
        sensitivity.add_squares(whitened.T @ whitened, used, places, A)
        b[used] += (whitened.T @ innovation)[places]
    of_wheels = normal._replace(A=normal.A - A, b=normal.b - b)
    # the tolerances hold in both; they are in the normal equations of all filters together
    priors = np.array([column.prior for column in normal.matrix.columns])
    with_prior = priors > 0.0
    A[with_prior, with_prior] += 1.0 / priors[with_prior] ** 2
    for c in np.flatnonzero(with_prior):
        label = normal.matrix.columns[c].label
        b[c] += explanation.base.get(label, 0.0) / priors[c] ** 2
    of_vehicle = normal._replace(A=A, b=b)

    column = variant.columns[0]
    estimates = []
    variances = []
    for one in (of_wheels, of_vehicle):
        scores = evidence.scores(one)
        information = scores.S[column, column]
        if information <= 0.0 or not np.isfinite(information):
            return 0.0, 0.0
        estimates.append(-scores.g[column] / information)
        variances.append(1.0 / information)
    difference = abs(estimates[0] - estimates[1])
    value = explanation.causes[at].values[0]
    largest = max(abs(value + estimate) for estimate in estimates)
    return float(difference**2 / sum(variances)), float(difference / max(largest, 1e-30))


# --- brakes that vary in common, the rival of causes of force ---


class Variation(NamedTuple):
    """Brakes that vary in common, as fitted in place of causes of force."""

    share: float  # of the torque, exceeded in 5 % of the time
    evidence: float  # [O1]


def is_force(name: str) -> bool:
    """Return whether a cause is a torque or a force on the vehicle."""
    return BY_NAME[name].acts_on in (TORQUE, VEHICLE)


def on_vehicle(remainder: Sequence[ScoreTest] | None) -> list[ScoreTest]:
    """Return the clear remainders that are a force on the vehicle."""
    return [
        test
        for test in remainder or ()
        if test.name in (stopping.TIME, stopping.SPEED)
        and evidence.is_significant(test, thresholds.CLEAR_REMAINDER)
    ]


def varying_brake(
    design: Design,
    base: Explanation,
    explanation: Explanation,
    causes: Sequence[Cause],
    left: Sequence[ScoreTest],
) -> Variation | None:
    """Return brakes that vary in common and explain the runs nearly as well as all causes of force.

    `left` are the remainders of `on_vehicle`, which the variation must explain too. The causes are
    in the fitted `explanation`. None: the best variation is not within the calibration, or is not
    near enough.
    """
    by_causes = fitting.deviance(design, explanation._replace(causes=tuple(causes)))
    # the remainder could win as much as its largest test, less the price of its coefficients
    remaining = [
        test.statistic - thresholds.PRICE_OF_COEFFICIENT * len(test.estimate) for test in left
    ]
    by_causes -= max([0.0, *remaining])

    others = tuple(cause for cause in causes if not is_force(cause.name))
    start = explanation._replace(base=base.base, causes=others)
    most = thresholds.IMMATERIAL_DEVIATIONS * design.calibration
    best = min((_fitted(design, start, form) for form in FORMS), key=lambda one: one.evidence)
    # a share that is not a number is not within the calibration
    is_within = best.share <= most
    is_near = best.evidence <= by_causes + thresholds.CLEARLY_LESS_RATIO
    return best if is_within and is_near else None


def _fitted(design: Design, start: Explanation, form: CommonBrake) -> Variation:
    """Return the best variation of one form; `start` is the model without causes of force."""
    with_brake = design._replace(common_brake=form)
    fit = fitting.fit(with_brake, start, thresholds.STEPS_OF_COMMON_BRAKE)
    return Variation(
        share=discrepancy.common_share(with_brake, fit.explanation.base),
        evidence=fit.deviance + of_all_values(with_brake, fit.explanation),
    )


def of_all_values(design: Design, explanation: Explanation) -> float:
    """Return ln det(S P) of [O1] around a fitted explanation."""
    normal, _, _ = fitting.normal_equations(design, explanation, search=False)
    columns = normal.matrix.columns
    labels = {mode.label for mode in discrepancy.common_modes(design)}
    fitted = fitting.base_columns(normal.matrix)
    for cause in explanation.causes:
        variant = normal.matrix.variant_of(cause)
        if variant is not None:
            fitted += variant.columns
    of_modes = [c for c in fitted if columns[c].label in labels]
    others = [c for c in fitted if columns[c].label not in labels]

    _, inverse = fitting.solve(normal.A[np.ix_(others, others)], normal.b[others])
    coupling = normal.A[np.ix_(others, of_modes)]
    information = normal.A[np.ix_(of_modes, of_modes)] - coupling.T @ inverse @ coupling
    priors = np.array([columns[c].prior for c in of_modes])
    _, logarithm = np.linalg.slogdet(information * np.outer(priors, priors))
    return float(logarithm)
