"""Fits causes and chooses the most likely one, its confusable rivals, and a second one.

A cause must win more likelihood than the choice of its shape costs, and not in one place of one run
only. A second cause must win more than a wrong shape of the first one could lend to it. If there
are two, the first one is chosen again with the second in the model: a cause that had to account for
the effects of both gives way.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import (
    evidence,
    fitting,
    null_simulations,
    shapes,
    thresholds,
)
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.null_simulations import Workspace
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, LOAD, VEHICLE

# seeds of the null simulations with a cause in the model begin here
_SEEDS_WITH_CAUSE = 7


class BlockwiseFit(NamedTuple):
    """A fitted explanation, with its deviance by blocks."""

    explanation: Explanation
    deviance: float  # -2 ln L
    covariance: np.ndarray  # of the causes' coefficients, one cause after the other
    blocks: np.ndarray  # (5, blocks), see `deviance_by_block`


class Candidate(NamedTuple):
    """A cause that may be the right one: its score test, and its fit, whose last cause it is."""

    test: ScoreTest
    fit: BlockwiseFit


class Rival(NamedTuple):
    """A cause that was fitted in place of the identified one."""

    name: str
    share: float  # its likelihood ratio over that of the identified cause
    is_distinguishable: bool  # by Vuong's test


class IdentifiedCause(NamedTuple):
    """A cause that the data support."""

    score_test: ScoreTest
    cause: Cause  # as fitted
    likelihood_ratio: float  # drop of -2 ln L, less what the choice of the shape costs
    # (5,) the same before that cost, in the filters of the four wheelsets and of the vehicle
    ratio_by_filter: tuple[float, ...]
    deviation: tuple[float, ...]  # standard deviation of each coefficient
    confusable: tuple[str, ...]  # names of the rivals that cannot be distinguished from it
    rivals: tuple[Rival, ...]

    @property
    def unbiased(self) -> Cause:
        """The cause less the bias that null simulations show."""
        values = np.subtract(self.cause.values, self.score_test.bias)
        return fitting.within_bounds(self.cause._replace(values=tuple(values)))


# --- fits ---


def fit_explanation(design: Design, explanation: Explanation) -> BlockwiseFit:
    """Fit an explanation to a design.

    A cause with a finite step is also fitted from another start. Windows are moved off the grid of
    the search.
    """
    fit = fitting.fit(design, explanation, 6)
    if explanation.causes:
        last = explanation.causes[-1].name
        if table.BY_NAME[last].finite_step:
            restarted = shapes.restarted(design, fit.explanation, last)
            fit = min(fit, fitting.fit(design, restarted, 9), key=lambda fit: fit.deviance)
    if any(table.BY_NAME[cause.name].edge_step for cause in explanation.causes):
        fit = fitting.fit(design, shapes.refine_windows(design, fit.explanation), 4)
    return BlockwiseFit(*fit, blocks=deviance_by_block(design, fit.explanation))


def fit_explanations(
    workspace: Workspace, explanations: Sequence[Explanation], title: str
) -> list[BlockwiseFit]:
    """Fit each of some explanations to the measured runs, on all cores."""
    tasks = [(workspace.design, explanation) for explanation in explanations]
    return workspace.run_all(fit_explanation, tasks, title)


def deviance_by_block(design: Design, explanation: Explanation) -> np.ndarray:
    """Return the deviance in blocks of all runs, shape (5, blocks): wheels, then vehicle."""
    innovation, variance, _, vehicle_innovation, vehicle_variance = sensitivity.innovations(
        design, inputs(design, explanation)
    )
    of_wheels = fitting.deviance_terms(innovation, variance)
    of_vehicle = fitting.deviance_terms(vehicle_innovation, vehicle_variance)
    length = int(thresholds.BLOCK_S / design.step_s)
    sums = []
    for run in range(design.mass_kg.size):
        terms = np.column_stack(
            [design.by_axle(of_wheels, run), of_vehicle[design.vehicle_span(run)]]
        )
        for begin in range(0, len(terms), length):
            sums.append(terms[begin : begin + length].sum(axis=0))
    return np.array(sums).T


def with_remaining_irregularity(
    workspace: Workspace, base: Explanation, promising: list[Cause]
) -> tuple[Explanation, list[BlockwiseFit]]:
    """Return an explanation with the irregularity that the best promising cause leaves.

    The second value is the fits of all promising causes. The effect of a cause that is not in the
    model looks like a rougher rail, and would hide in it.
    """
    fits = fit_explanations(
        workspace,
        [base._replace(causes=(*base.causes, cause)) for cause in promising],
        "irregularity of the rail",
    )
    best = min(fits, key=lambda fit: fit.deviance, default=None)
    if best is None or best.explanation.sigma >= base.sigma:
        return base, fits
    smoother = base._replace(
        sigma=best.explanation.sigma,
        length_m=best.explanation.length_m,
    )
    return fitting.fit(workspace.design, smoother, 4, noise=False).explanation, fits


def fit_significant(
    workspace: Workspace,
    explanation: Explanation,
    tests: list[ScoreTest],
    most: int,
    ready: Sequence[BlockwiseFit] = (),
) -> list[Candidate]:
    """Fit each significant cause together with an explanation, at most `most` of them.

    A `ready` fit of a cause with a finite step is used again: such a fit starts from an untuned
    base and takes long.
    """
    present = {cause.name for cause in explanation.causes}
    significant = [
        test
        for test in tests
        if not evidence.is_smooth_function(test.name)
        and evidence.is_significant(test)
        and test.name not in present
    ]
    significant = sorted(significant, key=lambda test: -test.statistic)[:most]

    fits = {}
    for fit in ready:
        name = fit.explanation.causes[-1].name
        if table.BY_NAME[name].finite_step:
            fits[name] = fit
    missing = [test for test in significant if test.name not in fits]
    new_fits = fit_explanations(
        workspace,
        [explanation._replace(causes=(*explanation.causes, test.cause())) for test in missing],
        "fit of causes",
    )
    for test, fit in zip(missing, new_fits, strict=True):
        fits[test.name] = fit
    return [Candidate(test, fits[test.name]) for test in significant]


def add_ready_fits(
    deviance: float,
    candidates: list[Candidate],
    ready: list[BlockwiseFit],
    normal: fitting.NormalEquations,
    nulls: list[evidence.Scores],
) -> list[Candidate]:
    """Return the candidates, with ready fits where these are better.

    A ready fit replaces that of another shape of its cause if it is better. It is added if it wins
    so much that its cause needs no score: scores say little far from the base. `deviance` is that
    of the base.
    """
    best = {candidate.test.name: candidate for candidate in candidates}
    for fit in ready:
        cause = fit.explanation.causes[-1]
        test = evidence.score_test_of(normal, nulls, cause)
        if test is None:
            continue
        known = best.get(cause.name)
        if known is None:
            if deviance - fit.deviance > thresholds.CERTAIN_RATIO:
                best[cause.name] = Candidate(test._replace(trials=1), fit)
        elif fit.deviance < known.fit.deviance - thresholds.BETTER_FIT_RATIO:
            best[cause.name] = Candidate(test._replace(trials=known.test.trials), fit)
    return [*best.values()]


# --- the most likely cause ---


def choose(
    design: Design, explanation: Explanation, deviance: float, candidates: list[Candidate]
) -> tuple[Explanation, list[IdentifiedCause]]:
    """Return the explanation with the best further cause, and that cause.

    Both are without a further cause if none wins enough. `deviance` is that of the explanation.
    """
    ratios = []
    for test, fit in candidates:
        chance = max(test.expected - len(test.estimate), 0.0)
        ratios.append(deviance - fit.deviance - chance - _price(test))
    if max(ratios, default=0.0) < thresholds.LEAST_RATIO:
        return explanation, []
    order = np.argsort(ratios)[::-1]
    top = int(order[0])
    test, best = candidates[top]
    ratio = ratios[top]

    # Evidence that the tolerances had absorbed is not assigned to any block. The rest must not come
    # from one place of one run.
    drop = deviance_by_block(design, explanation) - best.blocks
    whole = max(float(drop.sum()), ratio)
    outside_best_block = whole - drop.sum(axis=0).max()
    least_outside = max(thresholds.SCORE_FLOOR, thresholds.SHARE_OUTSIDE_BEST_BLOCK * whole)
    is_window = bool(table.BY_NAME[test.name].edge_step)
    if not is_window and outside_best_block < least_outside:
        return explanation, []

    others = [(candidates[int(k)], ratios[k]) for k in order[1:]]
    rivals = _rivals(best, ratio, others)
    cause = best.explanation.causes[-1]
    identified = IdentifiedCause(
        score_test=test,
        cause=cause,
        likelihood_ratio=float(ratio),
        ratio_by_filter=tuple(drop.sum(axis=1)),
        deviation=_deviation(test, best.covariance, len(best.covariance) - len(cause.values)),
        confusable=_confusable(rivals, design.form),
        rivals=rivals,
    )
    return best.explanation, [identified]


def refine_scales(
    design: Design, explanation: Explanation, causes: list[IdentifiedCause]
) -> tuple[Explanation, list[IdentifiedCause]]:
    """Return explanation and causes with their scales off the grid of the search, fitted again."""
    better = shapes.refine_scales(design, explanation)
    if better == explanation:
        return explanation, causes

    fit = fitting.fit(design, better, 4)
    refined = []
    at = 0
    for identified, cause in zip(causes, fit.explanation.causes, strict=True):
        deviation = _deviation(identified.score_test, fit.covariance, at)
        refined.append(identified._replace(cause=cause, deviation=deviation))
        at += len(cause.values)
    return fit.explanation, refined


def _price(test: ScoreTest) -> float:
    """Return the likelihood ratio that the choice of a cause's shape and axle costs."""
    of_shape = thresholds.PRICE_OF_COEFFICIENT * table.BY_NAME[test.name].price
    return of_shape + 2.0 * float(np.log(test.trials))


def _deviation(test: ScoreTest, covariance: np.ndarray, at: int) -> tuple[float, ...]:
    """Return the deviations of a cause's coefficients, from place `at` of the covariance."""
    nominal = np.sqrt(np.diag(covariance)[at : at + len(test.estimate)])
    floor = table.BY_NAME[test.name].floor
    return tuple(float(np.hypot(s * max(test.spread, 1.0), floor)) for s in nominal)


def _rivals(
    best: BlockwiseFit, ratio: float, others: Sequence[tuple[Candidate, float]]
) -> tuple[Rival, ...]:
    """Return the rivals of the best fit. `others` are candidates with their likelihood ratios."""
    rivals = []
    for other, other_ratio in others:
        rivals.append(
            Rival(
                name=other.test.name,
                share=float(other_ratio / ratio),
                is_distinguishable=is_distinguishable(best, other.fit, ratio, other_ratio),
            )
        )
    return tuple(rivals)


def _confusable(rivals: Sequence[Rival], form: float) -> tuple[str, ...]:
    """Return the names of the rivals that may be the right cause.

    A rival is confusable if it loses by chance only, or by less than the share `form`: no law of
    the library is nearer to the truth than that.
    """
    return tuple(
        rival.name for rival in rivals if not rival.is_distinguishable or rival.share > 1.0 - form
    )


def is_distinguishable(
    best: BlockwiseFit, other: BlockwiseFit, ratio: float, other_ratio: float
) -> bool:
    """Return whether another fit cannot be the better one, by Vuong's test on blocks."""
    difference = ratio - other_ratio
    is_clearly_less = other_ratio < thresholds.CLEARLY_LESS_SHARE * ratio
    if is_clearly_less and difference > thresholds.CLEARLY_LESS_RATIO:
        return True
    by_block = (other.blocks - best.blocks).sum(axis=0)
    spread = float(by_block.std(ddof=1) * np.sqrt(by_block.size))
    least = max(thresholds.VUONG_DEVIATIONS * spread, thresholds.VUONG_LEAST_RATIO)
    return bool(difference >= least)


# --- a second cause ---


def add_second_cause(
    workspace: Workspace,
    explanation: Explanation,
    causes: list[IdentifiedCause],
    candidates: list[Candidate],
    seed: int,
) -> tuple[Explanation, list[IdentifiedCause], list[ScoreTest] | None]:
    """Return the explanation with a second cause if there is one, the causes, and the remainder.

    `causes` holds the first cause, `candidates` those among which it was chosen. The remainder is
    the tests of the smooth functions with the causes in the model. It is None if stops simulated
    with the causes do not brake like the recording.
    """
    design = workspace.design
    remainder: list[ScoreTest] = []
    for turn in range(thresholds.MOST_CAUSES):
        is_last_turn = turn + 1 == thresholds.MOST_CAUSES
        try:
            tests = _test_with_causes(
                workspace,
                explanation,
                known=tuple(identified.score_test.name for identified in causes),
                seed=seed + _SEEDS_WITH_CAUSE + turn,
                searches_windows=not is_last_turn,
            )
        except ConfigError:
            return explanation, causes, None
        deviance = fitting.deviance(design, explanation)
        remainder = [test for test in tests if evidence.is_smooth_function(test.name)]
        if len(causes) >= thresholds.MOST_CAUSES:
            break

        first = causes[0]
        tests = [test for test in tests if _may_be_second(first, test)]
        second_candidates = fit_significant(
            workspace, explanation, tests, thresholds.MOST_FITTED_SECOND
        )
        if second_candidates:
            # what the first cause wins by being fitted once more does not belong to the second
            explanation, deviance, _ = fitting.fit(design, explanation, 9)
            first = first._replace(cause=explanation.causes[0])
            causes = [first]

        better, more = choose(design, explanation, deviance, second_candidates)
        if not more:
            break
        second = more[0]
        net_ratio = _net_likelihood(
            first, second.score_test, second.likelihood_ratio, np.array(second.ratio_by_filter)
        )
        if net_ratio < thresholds.LEAST_RATIO_OF_SECOND:
            break
        if not _are_both_needed(workspace, better, deviance):
            break
        first_now = first._replace(cause=better.causes[0])
        better, both = _choose_first_again(workspace, better, first_now, second, candidates)

        ratio = deviance - fitting.deviance(design, better)
        is_confusable = second.score_test.name in first.confusable
        least = thresholds.CONFUSABLE_SECOND_SHARE * first.likelihood_ratio
        if is_confusable and ratio < least:
            break
        explanation, both = refine_scales(design, better, both)
        causes = _without_each_other(both)
    return explanation, causes, remainder


def _test_with_causes(
    workspace: Workspace,
    explanation: Explanation,
    known: tuple[str, ...],
    seed: int,
    searches_windows: bool,
) -> list[ScoreTest]:
    """Return the score tests of what an explanation with causes leaves.

    With `searches_windows` promising windows are tested on the smoother rail that they leave. All
    else is judged on the rail as it was fitted. Raises ConfigError as the null simulations do.
    """
    windows = []
    if searches_windows:
        normal, *_ = fitting.normal_equations(workspace.design, explanation)
        promising = evidence.most_promising(workspace.design, normal, thresholds.MOST_FITTED_SECOND)
        windows = [
            cause
            for cause in promising
            if table.BY_NAME[cause.name].edge_step and cause.name not in known
        ]

    most = thresholds.MOST_NULL_SIMULATIONS_WITH_CAUSE
    tests, *_ = null_simulations.score_against_nulls(workspace, explanation, most, seed, known)
    if not windows:
        return tests

    smoother, _ = with_remaining_irregularity(workspace, explanation, windows)
    tests_on_smoother, *_ = null_simulations.score_against_nulls(
        workspace, smoother, most, seed, known
    )
    names = {cause.name for cause in windows}
    of_others = [test for test in tests if test.name not in names]
    of_windows = [test for test in tests_on_smoother if test.name in names]
    return of_others + of_windows


def _may_be_second(first: IdentifiedCause, test: ScoreTest) -> bool:
    """Return whether a cause, by its score, wins more than the first can lend to it."""
    ratio = test.statistic / thresholds.SCORE_SHARE_OF_RATIO
    filters = _filters_that_respond(test)
    by_filter = ratio * filters / filters.sum()
    return _net_likelihood(first, test, ratio, by_filter) > thresholds.LEAST_RATIO_OF_SECOND


def _filters_that_respond(test: ScoreTest) -> np.ndarray:
    """Return 1 for each filter in which a cause shows, else 0, shape (5,).

    The filters are those of the four wheelsets and of the vehicle. The filter of the vehicle
    contains no adhesion law. Those of the wheels contain no force on the vehicle.
    """
    acts_on = ""
    if test.name in table.BY_NAME:
        acts_on = table.BY_NAME[test.name].mechanism.acts_on
    wheels = [acts_on != VEHICLE and test.axle in (0, axle) for axle in range(1, AXLES + 1)]
    vehicle = acts_on not in (FRICTION, CONTACT, LOAD)
    return np.array([*wheels, vehicle], dtype=float)


def _net_likelihood(
    first: IdentifiedCause, second: ScoreTest, ratio: float, by_filter: np.ndarray
) -> float:
    """Return the likelihood ratio of a second cause less what the first can lend to it.

    A wrong shape of the first cause would lend it. In each filter the first cause can lend a share
    of its ratio there. `by_filter` (5,) is the ratio of the second cause in each filter.
    """
    ratios = np.array([by_filter, first.ratio_by_filter])
    share = thresholds.LENT_SHARE
    if first.cause.axle == 0:
        # wheelsets have one level and one recovery: an error in one of them moves the others
        ratios = np.add.reduceat(ratios, [0, AXLES], axis=1)
        if second.axle:
            share = thresholds.LENT_SHARE_TO_ONE_AXLE
    of_second, of_first = ratios
    lent = np.minimum(of_second, share * of_first).clip(0.0)
    return ratio - float(lent.sum())


def _are_both_needed(workspace: Workspace, explanation: Explanation, deviance: float) -> bool:
    """Return whether the first of two causes still wins enough with the second in the model.

    `deviance` is that of the first cause alone.
    """
    with_both, with_second = fit_explanations(
        workspace,
        [explanation, explanation._replace(causes=explanation.causes[1:])],
        "both causes",
    )
    least = max(
        thresholds.LEAST_RATIO_OF_SECOND,
        thresholds.LENT_SHARE * (deviance - with_both.deviance),
    )
    return with_second.deviance - with_both.deviance > least


def _choose_first_again(
    workspace: Workspace,
    explanation: Explanation,
    first: IdentifiedCause,
    second: IdentifiedCause,
    candidates: list[Candidate],
) -> tuple[Explanation, list[IdentifiedCause]]:
    """Return explanation and causes after the first cause is chosen again.

    The second cause is in the model now. The candidates for the first cause are those among which
    it was chosen before.
    """
    others = [c for c in candidates if c.test.name != second.score_test.name]
    fits = fit_explanations(
        workspace,
        [
            explanation._replace(causes=(other.fit.explanation.causes[-1], second.cause))
            for other in others
        ],
        "first cause again",
    )

    # likelihood ratio of each candidate beyond that of the first cause
    price_of_first = _price(first.score_test)
    deviance = fitting.deviance(workspace.design, explanation) + price_of_first
    gains = []
    for other, fit in zip(others, fits, strict=True):
        gains.append(deviance - fit.deviance - _price(other.test))
    place_of_first = next(k for k, other in enumerate(others) if other.test == first.score_test)
    top = place_of_first
    if max(gains) >= thresholds.BETTER_FIT_RATIO:
        top = int(np.argmax(gains))

    ratios = first.likelihood_ratio + np.array(gains)
    losers = [
        (Candidate(other.test, fits[k]), ratios[k]) for k, other in enumerate(others) if k != top
    ]
    rivals = _rivals(fits[top], ratios[top], losers)
    confusable = _confusable(rivals, workspace.design.form)
    if top == place_of_first:
        all_confusable = tuple(dict.fromkeys(first.confusable + confusable))
        return explanation, [first._replace(confusable=all_confusable, rivals=rivals), second]

    better = fits[top].explanation
    test = others[top].test
    new_first = IdentifiedCause(
        score_test=test,
        cause=better.causes[0],
        likelihood_ratio=ratios[top],
        ratio_by_filter=first.ratio_by_filter,
        deviation=_deviation(test, fits[top].covariance, 0),
        confusable=confusable,
        rivals=rivals,
    )
    return better, [new_first, second._replace(cause=better.causes[1])]


def _without_each_other(causes: list[IdentifiedCause]) -> list[IdentifiedCause]:
    """Return the causes, none of them confusable with another one of them."""
    names = [identified.score_test.name for identified in causes]
    return [
        identified._replace(
            confusable=tuple(name for name in identified.confusable if name not in names)
        )
        for identified in causes
    ]
