"""Compares causes of force with their rival: brakes that all vary in the same way.

Brakes within their calibration may vary in common, which no base contains ([Y4] of
`causes.discrepancy`). Such a variation imitates weak forces. But a gradient acts while the brake is
released, and in all runs alike; a resistance grows with speed, whatever the torque is. The
likelihood shows this difference. A variation in each run by itself has many free values, so its
best fit wins by chance what a cause cannot win. Its evidence is that of all its values together:

    [O1] evidence = deviance + ln det(S P), S the information on the values of the variation less
         what the rest of the model absorbs, P the variances that they are expected to have
Source: Laplace's approximation of the marginal likelihood; Kass and Raftery, Journal of the
American Statistical Association 90 (1995), section 4.1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.causes import discrepancy, table
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.preparation import CommonBrake, Design
from rollerrig.rig.identify.decide import evidence, fitting, stopping, thresholds
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.mechanisms.mechanism import TORQUE, VEHICLE

FORMS = tuple(form for form in CommonBrake if form is not CommonBrake.NONE)


class Variation(NamedTuple):
    """Brakes that vary in common, as fitted in place of causes of force."""

    share: float  # of the torque, exceeded in 5 % of the time
    evidence: float  # [O1]


def is_force(name: str) -> bool:
    """Return whether a cause is a torque or a force on the vehicle."""
    return table.BY_NAME[name].mechanism.acts_on in (TORQUE, VEHICLE)


def on_vehicle(remainder: Sequence[ScoreTest] | None) -> list[ScoreTest]:
    """Return the clear remainders that are a force on the vehicle."""
    return [
        test
        for test in remainder or ()
        if test.name in (stopping.TIME, stopping.SPEED)
        and evidence.is_significant(test, thresholds.CLEAR_REMAINDER)
    ]


def rival(
    design: Design,
    base: Explanation,
    explanation: Explanation,
    causes: Sequence[IdentifiedCause],
    left: Sequence[ScoreTest],
) -> Variation | None:
    """Return brakes that vary in common and explain the runs nearly as well as all causes of force.

    `left` are the remainders of `on_vehicle`, which the variation must explain too. The causes are
    in the fitted `explanation`. None: the best variation is not within the calibration, or is not
    near enough.
    """
    fitted = tuple(found.cause for found in causes)
    by_causes = fitting.deviance(design, explanation._replace(causes=fitted))
    # the remainder could win as much as its largest test, less the price of its coefficients
    remaining = [
        test.statistic - thresholds.PRICE_OF_COEFFICIENT * len(test.estimate) for test in left
    ]
    by_causes -= max([0.0, *remaining])

    others = tuple(found.cause for found in causes if not is_force(found.cause.name))
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
