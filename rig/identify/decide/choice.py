"""Fits causes, chooses the most likely one, lists its confusable rivals, and adds a second cause.

"Wins" means: the cause reduces the deviance (-2 ln L) of the model by a ratio.

- The first cause must win more than the choice of its shape costs. Its evidence must not come from
  one short part of one run only.
- A wrong shape of the first cause leaves a remainder that looks like a second one. A second cause
  must win more than that.
- If there are two causes, the first one is chosen again with the second in the model. Alone it had
  to account for the effects of both, so another cause may fit better now.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import wheelsets_of
from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, inputs
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import (
    coherence,
    evidence,
    fitting,
    null_simulations,
    shapes,
    thresholds,
)
from rollerrig.rig.identify.decide.coherence import Contradicted
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
    blocks: np.ndarray  # (axles + 1, blocks), the deviance as in `deviance_by_block`


class Candidate(NamedTuple):
    """A cause that may be the right one: its score test, and a fit with it as the last cause."""

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
    # drop of -2 ln L, less what the choice of the shape costs
    likelihood_ratio: float
    # (axles + 1,) drop of -2 ln L without that cost, in each filter: wheelsets, then the vehicle
    ratio_by_filter: tuple[float, ...]
    deviation: tuple[float, ...]  # standard deviation of each coefficient
    confusable: tuple[str, ...]  # names of the rivals that cannot be distinguished from it
    rivals: tuple[Rival, ...]
    form: float = 0.0  # of the dataset: how far the law may differ, as a share of the effect

    @property
    def unbiased(self) -> Cause:
        """The cause less the bias that null simulations show."""
        values = np.subtract(self.cause.values, self.score_test.bias)
        return fitting.within_bounds(self.cause._replace(values=tuple(values)))


class CausesAndRemainder(NamedTuple):
    """The causes that were found, and what they leave."""

    explanation: Explanation
    causes: list[IdentifiedCause]
    # tests of the smooth functions with the causes in the model; None: stops simulated with the
    # causes do not brake like the recording
    remainder: list[ScoreTest] | None
    rejected: Contradicted | None  # a second cause in a window that is no sand and no patch


# --- fits ---


def fit_explanation(design: Design, explanation: Explanation) -> BlockwiseFit:
    """Fit an explanation to a design.

    If the last cause has a finite step, it is also fitted from an untuned base, and the better fit
    is kept. Then the windows of causes are moved off the grid of the search.
    """
    fit = fitting.fit(design, explanation, steps=6)
    if explanation.causes:
        last = explanation.causes[-1].name
        if table.BY_NAME[last].finite_step:
            restarted = shapes.restarted(design, fit.explanation, last)
            fit_of_restarted = fitting.fit(design, restarted, steps=9)
            fit = min(fit, fit_of_restarted, key=lambda fit: fit.deviance)
    if any(table.BY_NAME[cause.name].edge_step for cause in explanation.causes):
        refined = shapes.refine_windows(design, fit.explanation)
        fit = fitting.fit(design, refined, steps=4)
    return BlockwiseFit(*fit, blocks=deviance_by_block(design, fit.explanation))


def fit_explanations(
    workspace: Workspace, explanations: Sequence[Explanation], title: str
) -> list[BlockwiseFit]:
    """Fit each of some explanations to the measured runs, on all cores."""
    tasks = [(workspace.design, explanation) for explanation in explanations]
    return workspace.run_all(fit_explanation, tasks, title)


def deviance_by_block(design: Design, explanation: Explanation) -> np.ndarray:
    """Return the deviance in blocks of BLOCK_S of all runs, shape (axles + 1, blocks).

    The rows are the filters: the wheelsets, then the vehicle.
    """
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
    """Return the base on a smoother rail, and the fits of all promising causes.

    The effect of a cause that is not in the model looks like a rough rail, and would hide in it. So
    the irregularity of the rail is taken from the best fit of a promising cause, and the base is
    fitted again with this irregularity and without the cause. The base is returned unchanged if no
    such fit has a smoother rail.
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
    fit = fitting.fit(workspace.design, smoother, steps=4, noise=False)
    return fit.explanation, fits


def fit_significant(
    workspace: Workspace,
    explanation: Explanation,
    tests: list[ScoreTest],
    most: int,
    ready: Sequence[BlockwiseFit] = (),
) -> list[Candidate]:
    """Fit each significant cause together with an explanation, at most `most` of them.

    `ready` are fits of the same explanation that were made before. Those in the same shape are not
    repeated, and those of causes with a finite step in no shape: they start from an untuned base,
    which takes long. With a cause in the explanation, the further
    one is fitted in all shapes that are nearly as significant as the best, and the best fit counts.
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

    ready_by_name = {fit.explanation.causes[-1].name: fit for fit in ready}
    best = {}
    missing = []
    for test in significant:
        has_finite_step = table.BY_NAME[test.name].finite_step > 0.0
        ready_fit = ready_by_name.get(test.name)
        if ready_fit is not None:
            fitted = ready_fit.explanation.causes[-1]
            is_same = fitted.axle == test.axle and fitted.shape == test.shape
            if has_finite_step or is_same:
                best[test.name] = Candidate(test, ready_fit)
                continue
        missing.append(test)
        if explanation.causes and not has_finite_step:
            missing += test.near
    fits = fit_explanations(
        workspace,
        [explanation._replace(causes=(*explanation.causes, test.cause())) for test in missing],
        "fit of causes",
    )
    for test, fit in zip(missing, fits, strict=True):
        known = best.get(test.name)
        if known is None or fit.deviance < known.fit.deviance:
            best[test.name] = Candidate(test, fit)
    return [best[test.name] for test in significant]


def add_ready_fits(
    deviance: float,
    candidates: list[Candidate],
    ready: list[BlockwiseFit],
    normal: fitting.NormalEquations,
    nulls: list[evidence.Scores],
) -> list[Candidate]:
    """Return the candidates, with fits that were made before (`ready`) where these are better.

    A ready fit may have another shape of the same cause than the candidate. It replaces the fit of
    the candidate if it is clearly better. If its cause is no candidate, its score is not
    significant. But scores are unreliable far from the base, so a ready fit that wins very much is
    added anyway. `deviance` is that of the base.
    """
    best = {candidate.test.name: candidate for candidate in candidates}
    for fit in ready:
        cause = fit.explanation.causes[-1]
        test = evidence.score_test_of(normal, nulls, cause)
        if test is None:
            continue
        known = best.get(cause.name)
        if known is None:
            # null simulations show by how much a nominal likelihood is too large
            if deviance - fit.deviance > thresholds.CERTAIN_RATIO * max(1.0, test.spread**2):
                # trials=1: no price of a choice among shapes; this ratio exceeds any such price
                best[cause.name] = Candidate(test._replace(trials=1), fit)
        elif fit.deviance < known.fit.deviance - thresholds.BETTER_FIT_RATIO:
            best[cause.name] = Candidate(test._replace(trials=known.test.trials), fit)
    return list(best.values())


# --- the most likely cause ---


def choose(
    design: Design, explanation: Explanation, deviance: float, candidates: list[Candidate]
) -> tuple[Explanation, list[IdentifiedCause]]:
    """Return the explanation with the best further cause, and a list with that cause.

    If no candidate wins enough, return the explanation unchanged and an empty list. `deviance` is
    that of the explanation.
    """
    ratios = []
    for test, fit in candidates:
        ratios.append(deviance - fit.deviance - by_chance(test) - price(test))
    if max(ratios, default=0.0) < thresholds.LEAST_RATIO:
        return explanation, []

    order = np.argsort(ratios)[::-1]
    top = int(order[0])
    test, best = candidates[top]
    ratio = ratios[top]

    # The evidence must not come from one block only. The blocks do not hold all of it: without the
    # cause, tolerances of the base absorb a part of its effect. The drop of their prior deviance is
    # in `ratio`, but in no block.
    drop = deviance_by_block(design, explanation) - best.blocks  # (axles + 1, blocks)
    whole = max(float(drop.sum()), ratio)
    outside_best_block = whole - drop.sum(axis=0).max()
    least_outside = max(thresholds.SCORE_FLOOR, thresholds.SHARE_OUTSIDE_BEST_BLOCK * whole)
    is_window = bool(table.BY_NAME[test.name].edge_step)
    if not is_window and outside_best_block < least_outside:
        return explanation, []

    others = [(candidates[int(k)], ratios[k]) for k in order[1:]]
    rivals = _rivals(best, ratio, others)
    alike = _alike_at_one_load(design, test.name)
    cause = best.explanation.causes[-1]
    first_coefficient = len(best.covariance) - len(cause.values)
    identified = IdentifiedCause(
        score_test=test,
        cause=cause,
        likelihood_ratio=float(ratio),
        ratio_by_filter=tuple(drop.sum(axis=1)),
        deviation=_deviation(test, best.covariance, first_coefficient),
        confusable=tuple(dict.fromkeys(_confusable(rivals, design.form) + alike)),
        rivals=rivals,
        form=design.form,
    )
    return best.explanation, [identified]


def refine_scales(
    design: Design, explanation: Explanation, causes: list[IdentifiedCause]
) -> tuple[Explanation, list[IdentifiedCause]]:
    """Return explanation and causes with their scales off the grid of the search, fitted again."""
    better = shapes.refine_scales(design, explanation)
    if better == explanation:
        return explanation, causes

    fit = fitting.fit(design, better, steps=4)
    refined = []
    at = 0  # place of the first coefficient of a cause in the covariance
    for identified, cause in zip(causes, fit.explanation.causes, strict=True):
        deviation = _deviation(identified.score_test, fit.covariance, at)
        refined.append(identified._replace(cause=cause, deviation=deviation))
        at += len(cause.values)
    return fit.explanation, refined


def by_chance(test: ScoreTest) -> float:
    """Return the likelihood ratio that comes by chance and does not count.

    The mean statistic without any effect is the number of coefficients. Null simulations may show a
    larger one.
    """
    return max(test.expected - len(test.estimate), 0.0)


def price(test: ScoreTest) -> float:
    """Return the likelihood ratio that the choice of a cause's shape and axle costs."""
    of_shape = thresholds.PRICE_OF_COEFFICIENT * table.BY_NAME[test.name].price
    return of_shape + 2.0 * float(np.log(test.trials))


def _deviation(test: ScoreTest, covariance: np.ndarray, at: int) -> tuple[float, ...]:
    """Return the standard deviations of a cause's coefficients.

    They begin at place `at` of the covariance. The nominal deviations are widened by the spread
    that null simulations show, and by the numerical errors of the filter (`floor`).
    """
    nominal = np.sqrt(np.diag(covariance)[at : at + len(test.estimate)])
    widening = max(test.spread_by_chance, 1.0)
    floor = table.BY_NAME[test.name].floor
    return tuple(float(np.hypot(deviation * widening, floor)) for deviation in nominal)


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

    A rival is confusable if it may be worse by chance only (Vuong's test), or if it wins nearly as
    much as the identified cause: less by a share below `form`. `form` is the share of an effect by
    which any law of the library may differ from the true law.
    """
    return tuple(
        rival.name for rival in rivals if not rival.is_distinguishable or rival.share > 1.0 - form
    )


def _alike_at_one_load(design: Design, name: str) -> tuple[str, ...]:
    """Return the causes that differ from a cause only by load, where the runs have about one."""
    runs = range(design.mass_kg.size)
    load_N = [float(design.by_axle(design.load_N, run).sum(axis=1).mean()) for run in runs]
    if max(load_N) / min(load_N) - 1.0 > thresholds.LEAST_LOAD_DIFFERENCE:
        return ()
    return table.BY_NAME[name].alike_at_one_load


def is_distinguishable(
    best: BlockwiseFit, other: BlockwiseFit, ratio: float, other_ratio: float
) -> bool:
    """Return whether another fit is worse by more than chance, by Vuong's test on blocks."""
    difference = ratio - other_ratio
    is_clearly_less = other_ratio < thresholds.CLEARLY_LESS_SHARE * ratio
    if is_clearly_less and difference > thresholds.CLEARLY_LESS_RATIO:
        return True
    by_block = (other.blocks - best.blocks).sum(axis=0)
    # standard deviation of the sum over the blocks
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
) -> CausesAndRemainder:
    """Return the explanation with a second cause if there is one, the causes, and what is left.

    `causes` holds the first cause, `candidates` those among which it was chosen.

    The first turn of the loop looks for a second cause. If there is one, the second turn only tests
    the remainder that both causes leave.
    """
    remainder: list[ScoreTest] = []
    rejected: Contradicted | None = None
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
            return CausesAndRemainder(explanation, causes, None, rejected)
        remainder = [test for test in tests if evidence.is_smooth_function(test.name)]
        if len(causes) >= thresholds.MOST_CAUSES:
            break

        explanation, causes, rejected = _try_second_cause(
            workspace, explanation, causes[0], candidates, tests
        )
        if len(causes) == 1:
            break
    return CausesAndRemainder(explanation, causes, remainder, rejected)


def _try_second_cause(
    workspace: Workspace,
    explanation: Explanation,
    first: IdentifiedCause,
    candidates: list[Candidate],
    tests: list[ScoreTest],
) -> tuple[Explanation, list[IdentifiedCause], Contradicted | None]:
    """Return the explanation with a second cause, both causes, and None.

    If there is no second cause, return the explanation with the first cause alone, that cause, and
    a window that won enough and is contradicted, if there is one.
    `tests` are the score tests with the first cause in the model, `candidates` those among which
    the first cause was chosen.
    """
    design = workspace.design
    deviance = fitting.deviance(design, explanation)
    possible = [test for test in tests if _may_be_second(first, test)]
    second_candidates = fit_significant(
        workspace, explanation, possible, thresholds.MOST_FITTED_SECOND
    )
    if second_candidates:
        # what the first cause wins by being fitted once more does not belong to the second
        explanation, deviance, _ = fitting.fit(design, explanation, 9)
        first = first._replace(cause=explanation.causes[0])
    first_alone = (explanation, [first], None)

    # the second cause must win more than the first can lend to it
    better, more = choose(design, explanation, deviance, second_candidates)
    if not more:
        return first_alone
    second = more[0]
    is_sand = second.cause.name == "sanding"
    if is_sand and second.cause.values[0] < thresholds.LEAST_SAND_AS_SECOND:
        return first_alone
    net_ratio = _net_likelihood(
        first, second.score_test, second.likelihood_ratio, np.array(second.ratio_by_filter)
    )
    if net_ratio < thresholds.LEAST_RATIO_OF_SECOND:
        return first_alone

    rejected = coherence.of_window(design, better, len(better.causes) - 1, net_ratio)
    if rejected is not None:
        return explanation, [first], rejected

    # the first cause must still be needed, and may be replaced
    if not _are_both_needed(workspace, better, deviance):
        return first_alone
    first_of_both = first._replace(cause=better.causes[0])
    better, both = _choose_first_again(workspace, better, first_of_both, second, candidates)

    # a confusable second cause must win more
    ratio = deviance - fitting.deviance(design, better)
    is_confusable = second.score_test.name in first.confusable
    least = thresholds.CONFUSABLE_SECOND_SHARE * first.likelihood_ratio
    if is_confusable and ratio < least:
        return first_alone

    explanation, both = refine_scales(design, better, both)
    return explanation, _without_each_other(both), None


def _test_with_causes(
    workspace: Workspace,
    explanation: Explanation,
    known: tuple[str, ...],
    seed: int,
    searches_windows: bool,
) -> list[ScoreTest]:
    """Return the score tests of further causes and smooth functions, with causes in the model.

    `known` are the names of the causes in the model. With `searches_windows` the promising windows
    are tested on a smoother rail (see `with_remaining_irregularity`), because a rough rail hides
    them. All other causes are tested on the rail as it was fitted. Raises ConfigError as the null
    simulations do.
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
    """Return whether a cause can win more than the first can lend to it.

    Its ratio is not known before its fit. It is estimated generously from the score, in equal parts
    over the filters that respond to the cause.
    """
    ratio = test.statistic / thresholds.SCORE_SHARE_OF_RATIO
    filters = _filters_that_respond(test, len(first.ratio_by_filter) - 1)
    by_filter = ratio * filters / filters.sum()
    return _net_likelihood(first, test, ratio, by_filter) > thresholds.LEAST_RATIO_OF_SECOND


def _filters_that_respond(test: ScoreTest, axles: int) -> np.ndarray:
    """Return 1 for each filter in which a cause shows, else 0, shape (axles + 1,).

    The filters are those of the wheelsets and of the vehicle. The filter of the vehicle contains no
    adhesion law. Those of the wheels contain no force on the vehicle.
    """
    acts_on = ""
    if test.name in table.BY_NAME:
        acts_on = table.BY_NAME[test.name].mechanism.acts_on
    places = wheelsets_of(test.axle, axles)
    wheels = [acts_on != VEHICLE and axle in places for axle in range(1, axles + 1)]
    vehicle = acts_on not in (FRICTION, CONTACT, LOAD)
    return np.array([*wheels, vehicle], dtype=float)


def _net_likelihood(
    first: IdentifiedCause, second: ScoreTest, ratio: float, by_filter: np.ndarray
) -> float:
    """Return the likelihood ratio of a second cause less what the first can lend to it.

    A wrong shape of the first cause leaves a remainder, and the second cause wins by explaining it.
    This part is "lent" by the first cause. In each filter it is at most a share of the ratio of the
    first cause there. `by_filter` (axles + 1,) is the ratio of the second cause in each filter.
    """
    ratios = np.array([by_filter, first.ratio_by_filter])
    axles = ratios.shape[1] - 1
    share = thresholds.LENT_SHARE
    if first.cause.axle == 0:
        # All wheelsets share one friction level and one recovery, so an error on one wheelset moves
        # the others. Their filters are therefore summed: columns are now wheelsets, and vehicle.
        ratios = np.add.reduceat(ratios, [0, axles], axis=1)
        if second.axle > 0:
            share = thresholds.LENT_SHARE_TO_ONE_AXLE
    of_second, of_first = ratios
    lent = np.minimum(of_second, share * of_first).clip(0.0)
    return ratio - float(lent.sum())


def _are_both_needed(workspace: Workspace, explanation: Explanation, deviance: float) -> bool:
    """Return whether the first of two causes still wins enough with the second in the model.

    `deviance` is that of the first cause alone. "Enough" is more than the second cause, by a wrong
    shape, could lend to the first.
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

    The second cause is in the model now. `candidates` are the causes among which the first one was
    chosen before, so `first` is among them. It stays unless another one is clearly better.
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

    # what each candidate wins more than the first cause, both less the price of their shapes
    price_of_first = price(first.score_test)
    priced_deviance = fitting.deviance(workspace.design, explanation) + price_of_first
    gains = []
    for other, fit in zip(others, fits, strict=True):
        gains.append(priced_deviance - fit.deviance - price(other.test))

    place_of_first = next(k for k, other in enumerate(others) if other.test == first.score_test)
    top = place_of_first
    if max(gains) >= thresholds.BETTER_FIT_RATIO:
        top = int(np.argmax(gains))

    ratios = first.likelihood_ratio + np.array(gains)
    losers = [
        (Candidate(other.test, fits[k]), ratios[k]) for k, other in enumerate(others) if k != top
    ]
    rivals = _rivals(fits[top], ratios[top], losers)
    alike = _alike_at_one_load(workspace.design, others[top].test.name)
    confusable = tuple(dict.fromkeys(_confusable(rivals, workspace.design.form) + alike))
    if top == place_of_first:
        # those from the first choice stay; each name once, in order
        all_confusable = tuple(dict.fromkeys(first.confusable + confusable))
        return explanation, [first._replace(confusable=all_confusable, rivals=rivals), second]

    better = fits[top].explanation
    test = others[top].test
    new_first = IdentifiedCause(
        score_test=test,
        cause=better.causes[0],
        likelihood_ratio=ratios[top],
        ratio_by_filter=first.ratio_by_filter,  # not computed again: still of the cause before
        deviation=_deviation(test, fits[top].covariance, 0),
        confusable=confusable,
        rivals=rivals,
        form=workspace.design.form,
    )
    return better, [new_first, second._replace(cause=better.causes[1])]


def _without_each_other(causes: list[IdentifiedCause]) -> list[IdentifiedCause]:
    """Return the causes, without these causes in their lists of confusable names.

    The data support both of them, so they are no alternatives.
    """
    names = [identified.score_test.name for identified in causes]
    return [
        identified._replace(
            confusable=tuple(name for name in identified.confusable if name not in names)
        )
        for identified in causes
    ]
