"""Looks for an empirical formula for what no cause explains: one covariate, two coefficients.

The remainder is what the model with its causes leaves. The covariates along which it is most
significant are tried: the wheel angle with a wave, each other covariate with a polynomial of second
order. A wave along the rail is always tried too. A formula is accepted only if it improves runs
that were never fitted. Otherwise the report names the covariates of the remainder, and no formula.

    [N1] ln mu += a z + b z^2, z = (x - centre) / scale;  or
         ln mu += a cos(2 pi x / p) + b sin(2 pi x / p), p the period
    [N2] R += a z + b z^2 in N, x the vehicle's speed or time
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.causes import courses
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.causes.table import Shape
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting, gain, thresholds
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.gain import Gain
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import COVARIATES, Covariate

# periods in m that are tried for the wave along the rail
PERIODS_M = np.geomspace(4.0, 150.0, 400)
# every fifth sample is enough to find the period
SAMPLE_STRIDE = 5
# Word of a covariate -> (its number in a shape, the covariate). The number is its place in
# COVARIATES, counted from 1. A covariate without a word is not for empirical formulas.
_BY_WORD = {
    covariate.word: (number, covariate)
    for number, covariate in enumerate(COVARIATES, start=1)
    if covariate.word
}


class EmpiricalFormula(NamedTuple):
    """An empirical term that improves runs that were never fitted."""

    # its shape holds the number of the covariate, and either centre and scale or the period
    cause: Cause
    explanation: Explanation  # the base with this cause
    gain: Gain

    @property
    def covariate(self) -> Covariate:
        """The covariate x of [N1] or [N2]."""
        return COVARIATES[int(self.cause.shape["covariate"]) - 1]

    @property
    def is_on_vehicle(self) -> bool:
        """Whether it is a force on the vehicle [N2], not a factor of friction [N1]."""
        return "on_vehicle" in self.cause.shape


def find(
    design: Design,
    held_out: Design | None,
    base: Explanation,
    remainder: Sequence[ScoreTest],
    seed: int,
) -> EmpiricalFormula | None:
    """Return the best formula that improves the runs that were never fitted, or None."""
    if held_out is None:
        return None

    base_deviance = fitting.deviance(design, base)
    fits = []
    for shape in _shapes(design, base, remainder):
        cause = Cause("empirical", 0, shape, (0.0, 0.0))
        with_formula = base._replace(causes=(*base.causes, cause))
        fit = fitting.fit(design, with_formula, steps=6)
        if base_deviance - fit.deviance > thresholds.LEAST_RATIO_OF_FORMULA:
            fits.append(fit)

    # the best fit that also improves the other runs
    for fit in sorted(fits, key=lambda fit: fit.deviance):
        measured_gain = gain.measure(held_out, base, fit.explanation, seed)
        if measured_gain.claimed:
            return EmpiricalFormula(fit.explanation.causes[-1], fit.explanation, measured_gain)
    return None


def _shapes(design: Design, base: Explanation, remainder: Sequence[ScoreTest]) -> list[Shape]:
    """Return the shapes to try: of the most significant covariates, and a wave along the rail."""
    shapes: list[Shape] = []
    for test in sorted(remainder, key=lambda test: test.p_value):
        # a name is "along WORD", or "along vehicle WORD" for what the vehicle's filter leaves
        along = test.name.removeprefix("along ")
        word = along.removeprefix("vehicle ")
        if word not in _BY_WORD:
            continue
        number, covariate = _BY_WORD[word]
        if word == "wheel_angle":
            for waves_per_turn in (1, 2):
                shapes.append({"covariate": float(number), "period": 2.0 * np.pi / waves_per_turn})
            continue
        x = courses.covariate(design, covariate.name)
        shape = {"covariate": float(number), "centre": float(np.mean(x)), "scale": float(np.std(x))}
        if along.startswith("vehicle "):
            shape["on_vehicle"] = 1.0
        shapes.append(shape)

    shapes = shapes[: thresholds.MOST_COVARIATES_TRIED]
    number_of_place, _ = _BY_WORD["place"]
    shapes.append({"covariate": float(number_of_place), "period": _period_m(design, base)})
    return shapes


def _period_m(design: Design, base: Explanation) -> float:
    """Return the period in m of the strongest wave along the rail.

    It is a wave of the irregularity as the filter estimates it: a wave in friction looks like one.
    """
    _, _, irregularity, _, _ = sensitivity.innovations(design, inputs(design, base))
    use = slice(None, None, SAMPLE_STRIDE)
    # Fourier integrals at the periods; samples are not equidistant in place, so no FFT
    waves = np.exp(2j * np.pi * design.place_m[use][:, None] / PERIODS_M)
    strength = np.abs((irregularity[use] - irregularity.mean()) @ waves)
    return float(PERIODS_M[np.argmax(strength)])
