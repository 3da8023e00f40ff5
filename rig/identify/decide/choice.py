"""Fits causes and chooses: the likeliest first, those that cannot be told from it, and a second one.

A cause must win likelihood by more than its choice of shape costs, not in one place of one run only;
a second one by more than the first one's wrong shape could lend it. When two are taken the first is
looked for again beside the second, for one that had to stand for both gives way.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import evidence, fitting, null_simulations, shapes
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, LOAD, VEHICLE

CHECK_SETS, MOST_BESIDE, MOST_CAUSES = 40, 3, 2
TAKEN = 20.0  # likelihood that a cause must win at least
ELSEWHERE = 0.2  # share of the evidence that must lie outside its best block
# a second cause below this share of the first is taken for the first one's shape
SECOND_SHARE, SECOND_FLOOR = 0.11, 20.0
SECOND_SHARE_OF_AXLE = (
    0.05  # one of a single wheelset is no matter of the shape of a first one of all
)
CERTAIN = 300.0  # likelihood beyond what a clean set can win
SCORE_SHARE = 0.3  # its score, before it is fitted, may be this share of that
OWN_SHARE = (
    0.3  # a second cause that could be taken for the first must have this share of its likelihood
)
PRICE = 5.0  # likelihood that each further coefficient of a shape must earn, beside that of the choice of shape
BLOCK_S = 3.0


class Rival(NamedTuple):
    """A cause that was fitted in place of one: what it wins, as a share; whether Vuong's test parts them."""

    name: str
    share: float
    parted: bool


class IdentifiedCause(NamedTuple):
    """A cause that is taken: its finding, its share of the likelihood, what else was fitted and how well."""

    finding: evidence.ScoreTest
    cause: Cause
    ratio: float
    won: tuple[float, ...]  # likelihood in the filters of the four wheelsets and of the vehicle
    deviation: tuple[float, ...]
    confusable: tuple[str, ...]  # of the rivals those that cannot be told from it
    rivals: tuple[Rival, ...]

    @property
    def unbiased(self) -> Cause:
        """The cause less the bias that clean sets show."""
        return fitting.within_bounds(
            self.cause._replace(values=tuple(np.subtract(self.cause.values, self.finding.bias)))
        )


class Fit(NamedTuple):
    """It fitted: deviance, covariance of the causes' coefficients, deviance of each filter by blocks of 3 s."""

    explanation: Explanation
    value: float
    covariance: np.ndarray
    blocks: np.ndarray


class Candidate(NamedTuple):
    """A cause that may be the one: how it was found, and its fit."""

    finding: evidence.ScoreTest
    fit: Fit


def fit_explanation(design: Design, explanation: Explanation) -> Fit:
    """Fit an explanation to a design; its deviance by blocks of 3 s."""
    found = fitting.fit(design, explanation, 6)
    if explanation.causes and explanation.causes[-1].name == fitting.MEMORY:
        found = min(
            found,
            fitting.fit(design, shapes.restarted(design, found[0]), 9),
            key=lambda fit: fit[1],
        )
    if any(table.BY_NAME[cause.name].edge_step for cause in explanation.causes):
        found = fitting.fit(design, shapes.refine_windows(design, found[0]), 4)
    return Fit(*found, blocks(design, found[0]))


def fit_explanations(
    setting: null_simulations.Workspace, explanations: Sequence[Explanation], title: str
) -> list[Fit]:
    """Each of some explanations fitted to the measured runs, on all cores."""
    return setting.run_all(
        fit_explanation, [(setting.design, explanation) for explanation in explanations], title
    )


def blocks(design: Design, explanation: Explanation) -> np.ndarray:
    """Deviance of the wheelsets and of the vehicle in blocks of 3 s of all runs, shape (5, blocks)."""
    nu, S, _, vnu, vS = sensitivity.innovations(design, inputs(design, explanation))
    wheel, car = fitting.deviance_terms(nu, S), fitting.deviance_terms(vnu, vS)
    length, found = int(BLOCK_S / design.step_s), []
    for run in range(design.mass_kg.size):
        whole = np.column_stack([design.by_axle(wheel, run), car[design.vehicle_span(run)]])
        found += [whole[k : k + length].sum(axis=0) for k in range(0, len(whole), length)]
    return np.array(found).T


def with_remaining_irregularity(
    setting: null_simulations.Workspace, base: Explanation, likely: list[Cause]
) -> tuple[Explanation, list[Fit]]:
    """An explanation with the irregularity that is left beside the most promising further causes, and their fits."""
    # a cause that it does not have looks like a rougher rail, and would hide in it
    fits = fit_explanations(
        setting,
        [base._replace(causes=(*base.causes, cause)) for cause in likely],
        "irregularity of the rail",
    )
    best = min(fits, key=lambda fit: fit.value, default=None)
    if best is None or best.explanation.sigma >= base.sigma:
        return base, fits
    calm = base._replace(sigma=best.explanation.sigma, length_m=best.explanation.length_m)
    return fitting.fit(setting.design, calm, 4, False)[0], fits


def fit_significant(
    setting: null_simulations.Workspace,
    explanation: Explanation,
    found: list[evidence.ScoreTest],
    most: int,
    ready: Sequence[Fit] = (),
) -> list[Candidate]:
    """The causes that count beside an explanation, each fitted; a memory, whose fit begins anew, from those ready."""
    present = {cause.name for cause in explanation.causes}
    counted = [
        f
        for f in found
        if not evidence.is_smooth_function(f.name)
        and evidence.is_significant(f)
        and f.name not in present
    ]
    counted = sorted(counted, key=lambda f: -f.statistic)[:most]
    fits = {
        name: fit for fit in ready if (name := fit.explanation.causes[-1].name) == fitting.MEMORY
    }
    new = [f for f in counted if f.name not in fits]
    fits |= zip(
        (f.name for f in new),
        fit_explanations(
            setting,
            [explanation._replace(causes=(*explanation.causes, f.cause())) for f in new],
            "fit of causes",
        ),
        strict=True,
    )
    return [Candidate(f, fits[f.name]) for f in counted]


def add_ready_fits(
    value: float,
    rivals: list[Candidate],
    ready: list[Fit],
    scored: fitting.NormalEquations,
    nulls: list[evidence.Scores],
) -> list[Candidate]:
    """The rivals, each in the shape of a fit that is ready where that is better, and causes whose fit wins so much that
    no score is asked: far from the base, scores say little."""
    best = {rival.finding.name: rival for rival in rivals}
    for fit in ready:
        cause = fit.explanation.causes[-1]
        known, finding = best.get(cause.name), evidence.score_test_of(scored, nulls, cause)
        if finding and (
            value - fit.value > CERTAIN if known is None else fit.value < known.fit.value - 4.0
        ):
            best[cause.name] = Candidate(
                finding._replace(trials=known.finding.trials if known else 1), fit
            )
    return [*best.values()]


def choose(
    design: Design, explanation: Explanation, value: float, rivals: list[Candidate]
) -> tuple[Explanation, list[IdentifiedCause]]:
    """The best further cause, with those that cannot be told from it."""
    ratio = [
        value - fit.value - max(f.expected - len(f.estimate), 0.0) - _price(f) for f, fit in rivals
    ]
    if max(ratio, default=0.0) < TAKEN:
        return explanation, []
    order = np.argsort(ratio)[::-1]
    top = int(order[0])
    finding, best = rivals[top]
    drop = blocks(design, explanation) - best.blocks
    # what tolerances had taken up stands in no block; the rest must not be one place of one run
    whole = max(float(drop.sum()), ratio[top])
    if not table.BY_NAME[finding.name].edge_step and whole - drop.sum(axis=0).max() < max(
        evidence.FLOOR, ELSEWHERE * whole
    ):
        return explanation, []
    beside = _rivals(best, ratio[top], [(rivals[int(k)], ratio[k]) for k in order[1:]])
    at = len(best.covariance) - len(best.explanation.causes[-1].values)
    return best.explanation, [
        IdentifiedCause(
            finding,
            best.explanation.causes[-1],
            float(ratio[top]),
            tuple(drop.sum(axis=1)),
            _deviation(finding, best, at),
            _confusable(beside, design.form),
            beside,
        )
    ]


def refine_scales(
    design: Design, explanation: Explanation, causes: list[IdentifiedCause]
) -> tuple[Explanation, list[IdentifiedCause]]:
    """The causes with their scales off the grid of the search, fitted again."""
    better = shapes.refine_scales(design, explanation)
    if better == explanation:
        return explanation, causes
    fit = Fit(*fitting.fit(design, better, 4), np.zeros(0))
    found, at = [], 0
    for named, cause in zip(causes, fit.explanation.causes, strict=True):
        found.append(named._replace(cause=cause, deviation=_deviation(named.finding, fit, at)))
        at += len(cause.values)
    return fit.explanation, found


def _price(finding: evidence.ScoreTest) -> float:
    return PRICE * table.BY_NAME[finding.name].price + 2.0 * float(np.log(finding.trials))


def _deviation(finding: evidence.ScoreTest, fit: Fit, at: int) -> tuple[float, ...]:
    """Deviations of a cause's coefficients, which stand from place `at` on in the covariance."""
    nominal = np.sqrt(np.diag(fit.covariance)[at : at + len(finding.estimate)])
    floor = table.BY_NAME[finding.name].floor
    return tuple(float(np.hypot(s * max(finding.spread, 1.0), floor)) for s in nominal)


def _rivals(
    best: Fit, ratio: float, others: Sequence[tuple[Candidate, float]]
) -> tuple[Rival, ...]:
    return tuple(
        Rival(one.finding.name, float(less / ratio), parted(best, one.fit, ratio, less))
        for one, less in others
    )


def _confusable(rivals: Sequence[Rival], form: float) -> tuple[str, ...]:
    """Those that may be the better ones, by chance, or as no law is nearer to the truth than `form`."""
    return tuple(rival.name for rival in rivals if not rival.parted or rival.share > 1.0 - form)


def parted(best: Fit, other: Fit, ratio: float, less: float) -> bool:
    """Vuong's test on blocks: whether the other cannot be the better one."""
    if less < 0.75 * ratio and ratio - less > 10.0:
        return True
    difference = (other.blocks - best.blocks).sum(axis=0)
    spread = float(difference.std(ddof=1) * np.sqrt(difference.size))
    return bool(ratio - less >= max(1.64 * spread, 4.0))


def add_second_cause(
    setting: null_simulations.Workspace,
    explanation: Explanation,
    causes: list[IdentifiedCause],
    rivals: list[Candidate],
    seed: int,
) -> tuple[Explanation, list[IdentifiedCause], list[evidence.ScoreTest] | None]:
    """Further causes beside the first, and the remainder behind all of them.

    The remainder is None where stops simulated with them do not brake like the recording.
    """
    design = setting.design
    remainder: list[evidence.ScoreTest] = []
    for turn in range(MOST_CAUSES):
        known = tuple(named.finding.name for named in causes)
        windows = [
            cause
            for cause in evidence.most_promising(
                design, fitting.normal_equations(design, explanation)[0], MOST_BESIDE
            )
            if table.BY_NAME[cause.name].edge_step
            and cause.name not in known
            and turn + 1 < MOST_CAUSES
        ]
        try:
            found, *_ = null_simulations.score_against_nulls(
                setting, explanation, CHECK_SETS, seed + 7 + turn, known
            )
            if windows:  # the remainder is judged on the rail as it was fitted
                quiet, _ = with_remaining_irregularity(setting, explanation, windows)
                again, *_ = null_simulations.score_against_nulls(
                    setting, quiet, CHECK_SETS, seed + 7 + turn, known
                )
                sought = {cause.name for cause in windows}
                found = [f for f in found if f.name not in sought] + [
                    f for f in again if f.name in sought
                ]
        except ConfigError:
            return explanation, causes, None
        value = fitting.deviance(design, explanation)
        remainder = [f for f in found if evidence.is_smooth_function(f.name)]
        first = causes[0]
        most = [(f, f.statistic / SCORE_SHARE, _filters_that_respond(f)) for f in found]
        found = [
            f
            for f, ratio, shows in most
            if _net_likelihood(first, f, ratio, ratio * shows / shows.sum()) > SECOND_FLOOR
        ]
        if len(causes) >= MOST_CAUSES:
            break
        beside = fit_significant(setting, explanation, found, MOST_BESIDE)
        if beside:  # what the first wins by being fitted once more is not the second's
            explanation, value, _ = fitting.fit(design, explanation, 9)
            causes = [first := first._replace(cause=explanation.causes[0])]
        better, more = choose(design, explanation, value, beside)
        if (
            not more
            or _net_likelihood(first, more[0].finding, more[0].ratio, np.array(more[0].won))
            < SECOND_FLOOR
            or not _both_needed(setting, better, value)
        ):
            break
        better, both = _choose_first_again(
            setting, better, [first._replace(cause=better.causes[0]), more[0]], rivals
        )
        won = value - fitting.deviance(design, better)
        if more[0].finding.name in first.confusable and won < OWN_SHARE * first.ratio:
            break
        explanation, causes = refine_scales(design, better, both)
        names = [named.finding.name for named in causes]
        causes = [
            named._replace(confusable=tuple(n for n in named.confusable if n not in names))
            for named in causes
        ]
    return explanation, causes, remainder


def _filters_that_respond(second: evidence.ScoreTest) -> np.ndarray:
    """In which filters a cause shows, shape (5,): the vehicle's knows no adhesion law, the wheels' no force on it."""
    on = table.BY_NAME[second.name].mechanism.acts_on if second.name in table.BY_NAME else ""
    return np.array(
        [
            *(on != VEHICLE and second.axle in (0, j + 1) for j in range(AXLES)),
            on not in (FRICTION, CONTACT, LOAD),
        ],
        dtype=float,
    )


def _net_likelihood(
    first: IdentifiedCause, second: evidence.ScoreTest, ratio: float, won: np.ndarray
) -> float:
    """Likelihood of a second cause less what a wrong shape of the first may lend it in a filter: a share of its own."""
    both, share = np.array([won, first.won]), SECOND_SHARE
    if (
        first.cause.axle == 0
    ):  # wheelsets have one level and one recovery: what is wrong in one moves the others
        both, share = (
            np.add.reduceat(both, [0, AXLES], axis=1),
            SECOND_SHARE_OF_AXLE if second.axle else SECOND_SHARE,
        )
    return ratio - float(np.minimum(both[0], share * both[1]).clip(0.0).sum())


def _choose_first_again(
    setting: null_simulations.Workspace,
    explanation: Explanation,
    causes: list[IdentifiedCause],
    rivals: list[Candidate],
) -> tuple[Explanation, list[IdentifiedCause]]:
    """The first cause looked for again beside the second: one that had to stand for both gives way."""
    first, second = causes
    others = [rival for rival in rivals if rival.finding.name != second.finding.name]
    fits = fit_explanations(
        setting,
        [
            explanation._replace(causes=(one.fit.explanation.causes[-1], second.cause))
            for one in others
        ],
        "first cause again",
    )
    value = fitting.deviance(setting.design, explanation) + _price(first.finding)
    won = [value - fit.value - _price(one.finding) for one, fit in zip(others, fits, strict=True)]
    own = next(k for k, one in enumerate(others) if one.finding == first.finding)
    top = int(np.argmax(won)) if max(won) >= 4.0 else own
    ratio = first.ratio + np.array(won)
    beside = _rivals(
        fits[top],
        ratio[top],
        [
            (Candidate(other.finding, fits[k]), ratio[k])
            for k, other in enumerate(others)
            if k != top
        ],
    )
    alike = _confusable(beside, setting.design.form)
    if top == own:
        return explanation, [
            first._replace(
                confusable=tuple(dict.fromkeys(first.confusable + alike)), rivals=beside
            ),
            second,
        ]
    finding, better = others[top].finding, fits[top].explanation
    first = IdentifiedCause(
        finding,
        better.causes[0],
        ratio[top],
        first.won,
        _deviation(finding, fits[top], 0),
        alike,
        beside,
    )
    return better, [first, second._replace(cause=better.causes[1])]


def _both_needed(
    setting: null_simulations.Workspace, explanation: Explanation, value: float
) -> bool:
    """Whether the first cause still earns its likelihood beside the second."""
    both, alone = (
        fit.value
        for fit in fit_explanations(
            setting,
            [explanation, explanation._replace(causes=explanation.causes[1:])],
            "both causes",
        )
    )
    return alone - both > max(SECOND_FLOOR, SECOND_SHARE * (value - both))
