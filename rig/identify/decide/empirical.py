"""A formula for what no mechanism explains: one covariate, two coefficients, marked as empirical.

The covariates along which the remainder is smooth are tried with a polynomial of second order, those
of place and wheel angle with a wave as well. A formula is kept only when it makes runs better that
were never fitted; otherwise the report says against what the remainder shows, and no more.

    [N1] ln mu += a z + b z^2, z = (x - centre) / scale;  or a cos(2 pi x / p) + b sin(2 pi x / p)
    [N2] R += a z + b z^2 in N, x the vehicle's speed or time
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.causes import courses
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting, gain
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.gain import Gain
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import COVARIATES, Covariate

MOST_TRIED = 3
LEAST = 20.0  # likelihood that two coefficients (and a period) must earn
PERIODS_M = np.geomspace(4.0, 150.0, 400)
_WORDS = {c.word: (code, c) for code, c in enumerate(COVARIATES, start=1) if c.word}


class EmpiricalFormula(NamedTuple):
    """An empirical term: its cause, the explanation with it, its words, its worth."""

    cause: Cause
    explanation: Explanation
    text: str
    against: tuple[str, ...]
    gain: Gain


def find(
    design: Design,
    held: Design | None,
    base: Explanation,
    remainder: Sequence[ScoreTest],
    seed: int,
) -> EmpiricalFormula | None:
    """The best formula that holds on runs never fitted, or None."""
    if held is None:
        return None
    value = fitting.deviance(design, base)
    tried = []
    for shape in _shapes(design, base, remainder):
        explanation, better, _ = fitting.fit(
            design,
            base._replace(causes=(*base.causes, Cause("empirical", 0, shape, (0.0, 0.0)))),
            6,
        )
        if value - better > LEAST:
            tried.append((better, explanation))
    for _, explanation in sorted(tried, key=lambda pair: pair[0]):
        won = gain.measure(held, base, explanation, seed)
        if won.claimed:
            cause = explanation.causes[-1]
            return EmpiricalFormula(cause, explanation, text(cause), (_of(cause).word,), won)
    return None


def _shapes(
    design: Design, base: Explanation, remainder: Sequence[ScoreTest]
) -> list[dict[str, float]]:
    names = [f.name.removeprefix("along ") for f in sorted(remainder, key=lambda f: f.p_value)]
    found = []
    for name in names:
        on_vehicle = name.startswith("vehicle ")
        name = name.removeprefix("vehicle ")
        if name not in _WORDS:
            continue
        code, known = _WORDS[name]
        if name == "wheel_angle":
            found += [{"covariate": float(code), "period": 2.0 * np.pi / k} for k in (1, 2)]
            continue
        x = courses.covariate(design, known.name)
        shape = {"covariate": float(code), "centre": float(np.mean(x)), "scale": float(np.std(x))}
        found.append({**shape, "on_vehicle": 1.0} if on_vehicle else shape)
    found = found[:MOST_TRIED]
    found.append({"covariate": float(_WORDS["place"][0]), "period": _period(design, base)})
    return found


def _period(design: Design, base: Explanation) -> float:
    """Period in m of the strongest wave of the filtered irregularity along the rail."""
    _, _, field, _, _ = sensitivity.innovations(design, inputs(design, base))
    x = design.place_m
    use = slice(None, None, 5)
    wave = np.exp(2j * np.pi * x[use][:, None] / PERIODS_M)
    return float(PERIODS_M[np.argmax(np.abs((field[use] - field.mean()) @ wave))])


def _of(cause: Cause) -> Covariate:
    return COVARIATES[int(cause.shape["covariate"]) - 1]


def text(cause: Cause) -> str:
    """The formula in words and numbers."""
    (_, _, name, unit), (a, b) = _of(cause), cause.values
    left, number = ("R", "N") if "on_vehicle" in cause.shape else ("ln mu", "")
    if "period" in cause.shape:
        turn = f"2 pi {name} / {cause.shape['period']:.4g} {unit}"
        return f"{left} += {a:+.3g} cos({turn}) {b:+.3g} sin({turn})"
    z = f"z = ({name} - {cause.shape['centre']:.4g} {unit}) / {cause.shape['scale']:.4g} {unit}"
    return f"{left} += {a:+.3g} {number} z {b:+.3g} {number} z^2, {z}".replace("  ", " ")
