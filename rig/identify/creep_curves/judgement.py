"""Judges a measured creep curve: does friction fall, what does it depend on, does the law fit.

The order: conditions of the points, a smooth curve without a law and its scatter, falls of that
curve [H2], factors of the conditions [K1], then Polach's law [L1] with the falls and factors that
were found. Each check reports whether it could judge, why not, and the smallest size that these
data would have shown.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.creep_curves import conditions, factors, laws, shape
from rollerrig.rig.identify.creep_curves.conditions import Prepared
from rollerrig.rig.identify.creep_curves.factors import Effect, Factors
from rollerrig.rig.identify.creep_curves.laws import Law
from rollerrig.rig.identify.creep_curves.shape import Fall, Group, Shape
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.statistics import interval

FALLING_FRICTION = "falling_friction"

# A fall is reported if its interval excludes 0,
# if it is at least this share of the maximum,
LEAST_FALL = 0.01
# and if so many points are beyond the maximum.
LEAST_POINTS_BEYOND = 3
# A fall is not judged if these points would not have shown one of this share of the maximum.
MOST_UNSEEN_FALL = 0.5
# different creepages and degrees of freedom below which no fall is judged
LEAST_CREEPAGES = 4
LEAST_FREEDOM = 5


class Shown(NamedTuple):
    """What the points show without a law."""

    prepared: Prepared
    smooth: Shape
    fall: Fall
    fall_why_not: str  # empty where it was judged
    falls: bool
    factors: Factors

    @property
    def reported(self) -> list[Effect]:
        """The effects of conditions that are reported, the largest first."""
        found = [effect for effect in self.factors.effects if effect.is_reported]
        return sorted(found, key=lambda effect: -abs(effect.size))


class Judgement(NamedTuple):
    """The answer for a creep curve."""

    shown: Shown
    law: Law
    law_columns: np.ndarray  # columns of X of the law, (n, k)
    law_why_not: str  # empty where it was judged

    @property
    def law_fails(self) -> bool:
        """Whether the points contradict Polach's law."""
        return not self.law_why_not and not self.law.fits

    @property
    def verdict(self) -> str:
        """One of consistent, explained, partly, unexplained, not_judged."""
        has_cause = self.shown.falls or bool(self.shown.reported)
        if self.law_fails:
            return "partly" if has_cause else "unexplained"
        if has_cause:
            return "explained"
        are_judged = [effect.judged for effect in self.shown.factors.effects]
        are_judged += [not self.shown.fall_why_not, not self.law_why_not]
        return "consistent" if any(are_judged) else "not_judged"


def judge(data: Dataset, seed: int = 0) -> Judgement:
    """Return the judgement of a creep-curve dataset. Raises ConfigError for another kind."""
    shown = without_law(data, seed)
    prepared = shown.prepared
    in_law = [effect.name for effect in shown.reported]
    columns = prepared.columns(in_law)
    beta = [
        exponent
        for exponent, name in zip(shown.factors.beta, shown.factors.names, strict=True)
        if name in in_law
    ]
    arguments = (prepared, columns, np.array(beta), patch_of(data), shown.smooth, shown.falls, seed)
    law = laws.fit(*arguments)
    if law.needs_a_stiffer_contact:
        stiffer = laws.fit(*arguments, most_k_a=laws.MOST_STIFF)
        if stiffer.fits and not stiffer.parameters["k_a"].bound:
            law = stiffer
    return Judgement(
        shown=shown,
        law=law,
        law_columns=columns,
        law_why_not=_why_no_law_is_judged(shown.smooth, law, float(np.max(prepared.adhesion))),
    )


def without_law(data: Dataset, seed: int = 0) -> Shown:
    """Return what the points of a dataset show without a law. Raises ConfigError."""
    if data.curve is None:
        raise ConfigError(
            f"{data.folder / 'dataset.toml'}: kind is '{data.kind}'; a creep_curve is required here"
        )
    prepared = conditions.prepare(data.curve, data.accuracy)
    groups, varying_within = _groups(prepared)
    smooth = shape.fit(
        prepared.creepage,
        prepared.adhesion,
        groups,
        prepared.columns(varying_within),
        prepared.file_order,
    )
    fall = shape.fall(smooth, prepared.adhesion, seed)
    why_not = _why_no_fall_is_judged(prepared, smooth)
    falls = (
        not why_not
        # the interval holds 0 unless the test by simulations rejects it
        and interval.excludes(fall.low, fall.high)
        and fall.size >= LEAST_FALL
        and fall.points_beyond >= LEAST_POINTS_BEYOND
    )
    if not why_not and not falls and fall.smallest > MOST_UNSEEN_FALL:
        why_not = (
            f"these points would not have shown a fall of {100.0 * MOST_UNSEEN_FALL:.0f} % of the "
            f"maximum, since they scatter by {smooth.scatter:.2g}{_shared_words(smooth)}"
        )
    found = factors.fit(prepared)
    return Shown(
        prepared=prepared._replace(conditions=found.conditions),
        smooth=smooth,
        fall=fall,
        fall_why_not=why_not,
        falls=falls,
        factors=found,
    )


def _groups(prepared: Prepared) -> tuple[np.ndarray, list[str]]:
    """Return the group of each point that has its curve, and the conditions that vary within.

    Small groups share one curve, and all conditions vary within it.
    """
    # what may be noise belongs to the scatter of the points
    varying = [c for c in prepared.conditions if c.varies and not c.may_be_noise]
    together = conditions.going_together(prepared)
    for number in np.unique(prepared.group):
        creepage = prepared.creepage[prepared.group == number]
        is_small = creepage.size < shape.LEAST_GROUP_POINTS
        if is_small or shape.distinct(creepage) < shape.LEAST_GROUP_CREEPAGES:
            names = [c.name for c in varying if c.name not in together]
            return np.zeros_like(prepared.group), names
    names = [c.name for c in varying if not c.is_levels and c.name not in together]
    return prepared.group, names


def _why_no_fall_is_judged(prepared: Prepared, smooth: Shape) -> str:
    """Return why no fall can be judged; empty where it can."""
    creepages = shape.distinct(prepared.creepage)
    if creepages < LEAST_CREEPAGES:
        return f"there are {creepages} different creepages; at least {LEAST_CREEPAGES} are needed"
    if any(_goes_with_the_curve(part) for part in smooth.groups):
        return (
            "points of other conditions were measured at other creepages, and each condition has too "
            "few points for a curve"
        )
    return _why_no_scatter_is_known(smooth)


def _goes_with_the_curve(part: Group) -> bool:
    """Whether the curve of a group explains nearly all of a condition that varies within it."""
    curve = np.column_stack([part.nuisance[:, :1], part.basis])
    for column in part.nuisance[:, 1:].T:
        left = column - curve @ np.linalg.lstsq(curve, column, rcond=None)[0]
        centred = column - column.mean()
        if float(left @ left) < (1.0 - conditions.TOGETHER) * float(centred @ centred):
            return True
    return False


def _why_no_law_is_judged(smooth: Shape, law: Law, largest: float) -> str:
    """Return why the law cannot be judged; empty where it can."""
    if law.fits and law.smallest > laws.MOST_UNSEEN * largest:
        return (
            f"these points would not have shown a misfit of {100.0 * laws.MOST_UNSEEN:.0f} % of the "
            f"largest adhesion, since they scatter by {smooth.scatter:.2g}{_shared_words(smooth)}"
        )
    return _why_no_scatter_is_known(smooth)


def _shared_words(smooth: Shape) -> str:
    return " and neighbours share their errors" if smooth.shared > 0.0 else ""


def _why_no_scatter_is_known(smooth: Shape) -> str:
    """Return why the scatter of the points is unknown; empty where it is known."""
    if smooth.freedom < LEAST_FREEDOM:
        return (
            f"{smooth.freedom} points more than coefficients of a smooth curve show no scatter; "
            f"at least {LEAST_FREEDOM} are needed: repeat some points"
        )
    return ""
