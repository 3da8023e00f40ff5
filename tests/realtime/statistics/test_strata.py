"""Failures in strata: exact probabilities, unbiased estimates, and bounds that hold."""

import itertools
import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy import optimize, stats

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign.statistics import (
    corrections,
    failing,
    laws,
    quantiles,
    strata,
    stratified,
)

RAREST = 1e-10
LEVELS = tuple(range(1, 10))
# an analytic stop: the deceleration relative to the nominal one is the product of the pad friction,
# of 1 / mass, and of 1 - loss * failed / places of each kind of component
PADS_S, MASS_S = 0.05, 0.02


class Component(NamedTuple):
    places: int
    probability: float
    loss: float


TEN = (
    Component(8, 1e-3, 1.0),
    Component(8, 2e-4, 1.0),
    Component(4, 2e-3, 1.0),
    Component(4, 1e-5, 0.6),
    Component(4, 3e-6, 0.3),
    Component(4, 2e-4, 1.0),
    Component(2, 2e-5, 0.5),
    Component(1, 3e-7, 0.7),
    Component(1, 4e-9, 0.9),
    Component(8, 1e-2, 0.1),
)
# two kinds and no rare ones: brute force reaches what they do
FEW = (Component(8, 0.01, 1.0), Component(2, 0.005, 0.6))


def kinds_of(components):
    return [failing.Kind(one.places, one.probability, one.places) for one in components]


def inputs():
    lognormal = {"distribution": "lognorm", "source": "a test"}
    pads = laws.read("brake.pad_friction", lognormal | {"s": PADS_S, "scale": 0.35}, "a test")
    mass = laws.read("vehicle.mass_kg", lognormal | {"s": MASS_S, "scale": 43e3}, "a test")
    return [pads, mass]


def left(components, counts):
    """Return the fraction of the brake that the failures leave."""
    parts = zip(components, counts, strict=True)
    return math.prod(1.0 - one.loss * count / one.places for one, count in parts)


def campaign(components, runs, seed):
    """Return the negative ratios of a stratified campaign of the analytic stop."""
    drawn = stratified.draw(
        inputs(),
        np.eye(2),
        kinds_of(components),
        [f"kind {number}" for number in range(len(components))],
        runs,
        seed,
        RAREST,
    )
    pads, mass = (law.at(drawn.shares[:, place]) for place, law in enumerate(inputs()))
    remaining = [left(components, [len(places) for places in failed]) for failed in drawn.failed]
    ratios = np.array(remaining) * (pads / 0.35) * (43e3 / mass)
    stratum = np.repeat(np.arange(len(drawn.strata)), [one.runs for one in drawn.strata])
    return strata.Sample(-ratios, stratum, drawn.strata)


class Exact:
    """The law of the analytic stop: a sum over all numbers of failed components."""

    def __init__(self, components):
        self.probability = np.ones(1)
        self.left = np.ones(1)
        for one, kind in zip(components, kinds_of(components), strict=True):
            count = np.arange(one.places + 1)
            self.probability = np.outer(self.probability, kind.chances).ravel()
            self.left = np.outer(self.left, 1.0 - one.loss * count / one.places).ravel()
            # what is left out is far below the rarest level
            known = self.probability > 1e-17
            self.probability, self.left = self.probability[known], self.left[known]

    def share_below(self, ratio):
        braking = self.left > 0.0
        z = np.log(ratio / self.left[braking]) / math.hypot(PADS_S, MASS_S)
        rolling_on = self.probability[~braking].sum()
        return float(self.probability[braking] @ stats.norm.cdf(z) + rolling_on)

    def factor(self, level):
        share = corrections.failing_share(level)
        return optimize.brentq(
            lambda ratio: math.log(self.share_below(ratio) / share), 1e-4, 2.0, xtol=1e-9
        )


def test_two_brake_units_have_the_probabilities_of_the_binomial_law_to_1e_12():
    """By hand: 0.97^2 both brake, 2 * 0.97 * 0.03 one does, 0.03^2 none."""
    kinds = [failing.Kind(places=2, probability=0.03, most=2)]
    drawn = stratified.draw([], np.eye(0), kinds, ["brake unit"], 100, 0, RAREST)
    by_hand = {"no failure": 0.9409, "1 x brake unit": 0.0582, "2 x brake unit": 0.0009}
    assert {one.text: one.probability for one in drawn.strata} == pytest.approx(by_hand, abs=1e-12)
    # each set of places is computed once, so the law of the brake has no error of sampling
    assert drawn.failed == [((),), ((0,),), ((1,),), ((0, 1),)]
    stratum = np.repeat(np.arange(3), [one.runs for one in drawn.strata])
    lost = np.array([len(failed[0]) / 2.0 for failed in drawn.failed])
    sample = strata.Sample(lost, stratum, drawn.strata)
    for lost_part, share in ((0.0, 0.0591), (0.5, 0.0009), (1.0, 0.0)):
        estimate, error = sample.share_above(lost_part)
        assert estimate == pytest.approx(share, abs=1e-12)
        assert error == 0.0
    assert [sample.bounded(share).bound for share in (0.06, 0.05, 8e-4)] == [0.0, 0.5, 1.0]


def test_a_probability_of_1e_9_is_exact_without_1e9_draws():
    kinds = [failing.Kind(4, 3e-5, 4), failing.Kind(2, 1e-4, 2)]
    kept, cut = failing.branches(kinds, 1e-30)
    found = {branch.counts: branch.probability for branch in kept}
    assert found[(2, 0)] == pytest.approx(6 * 9e-10 * (1 - 3e-5) ** 2 * (1 - 1e-4) ** 2, rel=1e-12)
    assert found[(1, 2)] == pytest.approx(1.2e-4 * (1 - 3e-5) ** 3 * 1e-8, rel=1e-12)
    assert cut == []


def test_kept_and_cut_combinations_are_together_all_stops():
    for least in (1e-3, 1e-7, 1e-12):
        kept, cut = failing.branches(kinds_of(TEN), least)
        total = math.fsum(branch.probability for branch in (*kept, *cut))
        assert total == pytest.approx(1.0, abs=1e-13)
        assert min(branch.probability for branch in kept) >= least


def test_a_rule_on_isolated_bogies_is_the_law_under_its_condition():
    kind = failing.Kind(places=3, probability=0.2, most=1)
    # 0.8^3 and 3 * 0.2 * 0.8^2, divided by their sum
    assert kind.chances == pytest.approx([0.512 / 0.896, 0.384 / 0.896], abs=1e-15)
    shares = np.random.default_rng(1).random((200_000, 3))
    failed = failing.from_shares(shares, kind)
    number = failed.sum(axis=1)
    assert number.max() == 1
    assert (number == 1).mean() == pytest.approx(0.384 / 0.896, abs=0.004)
    # no place is preferred
    assert failed.mean(axis=0) == pytest.approx([0.128 / 0.896] * 3, abs=0.004)


@pytest.mark.parametrize(("rate_1_h", "interval_h"), [(1e-9, 720.0), (1e-6, 720.0), (1e-3, 3e3)])
def test_a_rate_with_inspections_is_the_mean_probability_between_two_of_them(rate_1_h, interval_h):
    middles_h = (np.arange(100_000) + 0.5) / 100_000 * interval_h
    mean = -np.expm1(-rate_1_h * middles_h).mean()
    found = failing.probability_at_a_stop(rate_1_h, interval_h)
    assert found == pytest.approx(mean, rel=1e-9)


def test_the_series_of_a_small_rate_joins_the_formula():
    below = failing.probability_at_a_stop(0.999_999e-3, 1.0)
    above = failing.probability_at_a_stop(1.000_001e-3, 1.0)
    assert above - below == pytest.approx(1e-9, rel=1e-3)


def test_kdry_of_ten_kinds_of_failures_is_within_5_percent_at_levels_1_to_9():
    exact = Exact(TEN)
    found = corrections.corrections(campaign(TEN, runs=10_000, seed=1), levels=LEVELS)
    for factor in found:
        assert factor.method == corrections.BY_STRATA
        assert factor.estimate == pytest.approx(exact.factor(factor.level), rel=0.05)
        assert factor.low <= factor.estimate <= factor.high
        assert factor.bound <= factor.estimate


@pytest.mark.parametrize("draws", [1_000_000, pytest.param(10_000_000, marks=pytest.mark.nightly)])
def test_kdry_is_that_of_brute_force(draws):
    """Draws every component and every input of each stop, without strata."""
    rng = np.random.default_rng(2)
    log_ratio = rng.normal(0.0, math.hypot(PADS_S, MASS_S), draws)
    remaining = np.ones(draws)
    for one in FEW:
        failed = rng.binomial(one.places, one.probability, draws)
        remaining *= 1.0 - one.loss * failed / one.places
    drawn = remaining * np.exp(log_ratio)
    # a level of which at least 100 of the draws are weaker
    levels = range(round(math.log10(draws)) - 1)
    for factor in corrections.corrections(campaign(FEW, runs=5_000, seed=3), levels=levels):
        share = corrections.failing_share(factor.level)
        by_force = quantiles.interval(drawn, share, 0.999)
        assert 0.98 * by_force.low <= factor.estimate <= 1.02 * by_force.high
        assert factor.estimate == pytest.approx(Exact(FEW).factor(factor.level), rel=0.03)


@pytest.mark.parametrize("campaigns", [60, pytest.param(600, marks=pytest.mark.nightly)])
def test_estimates_are_unbiased_and_bounds_hold_in_95_of_100_campaigns(campaigns):
    """Small campaigns: many levels have few stops, and some have no bound."""
    exact = Exact(TEN)
    true_factors = np.array([exact.factor(level) for level in LEVELS])
    shares = np.array([corrections.failing_share(level) for level in LEVELS])
    held = np.zeros(len(LEVELS))
    between = np.zeros(len(LEVELS))
    bounded = np.zeros(len(LEVELS))
    estimated = np.empty((campaigns, len(LEVELS)))
    for number in range(campaigns):
        sample = campaign(TEN, runs=2_000, seed=100 + number)
        factors = corrections.corrections(sample, levels=LEVELS)
        for place, (factor, true_factor) in enumerate(zip(factors, true_factors, strict=True)):
            # a missing bound states nothing, so it is never wrong
            held[place] += not factor.bound > true_factor
            between[place] += not factor.low > true_factor and not factor.high < true_factor
            bounded[place] += math.isfinite(factor.bound)
            estimated[number, place] = sample.share_above(-true_factor)[0]
    assert bounded[:5].min() == campaigns
    assert held.min() >= 0.95 * campaigns - 1.7 * math.sqrt(0.0475 * campaigns)
    assert between.min() >= 0.95 * campaigns - 1.7 * math.sqrt(0.0475 * campaigns)
    error = estimated.std(axis=0, ddof=1) / math.sqrt(campaigns)
    assert np.all(np.abs(estimated.mean(axis=0) - shares) <= 4.0 * error + 1e-13)


def test_the_stated_variance_is_that_of_repeated_campaigns():
    ratio = Exact(FEW).factor(3)
    found = [campaign(FEW, runs=800, seed=seed).share_above(-ratio) for seed in range(200)]
    estimates, errors = np.array(found).T
    assert np.sqrt((errors**2).mean()) == pytest.approx(estimates.std(ddof=1), rel=0.2)


def test_one_stratum_has_the_quantiles_and_bounds_of_equal_draws():
    values = np.random.default_rng(4).normal(size=400)
    one = strata.Stratum(1.0, 400, 0, 0, False, "no failure")
    sample = strata.Sample(values, np.zeros(400, dtype=np.int64), [one])
    for quantile in quantiles_of_400():
        plain = quantiles.upper_bound(values, quantile)
        found = sample.bounded(1.0 - quantile)
        assert found.estimate == plain.estimate
        # the bound by a gamma law may be one rank further out, and never further in
        ordered = np.sort(values)
        rank = int(np.searchsorted(ordered, found.bound)) + 1
        assert plain.rank <= rank <= plain.rank + 1


def quantiles_of_400():
    return (0.5, 0.9, 0.95, 0.98)


def test_a_stratum_without_a_stop_counts_as_longer_than_any_other():
    two = [
        strata.Stratum(0.99, 100, 0, 0, False, "no failure"),
        strata.Stratum(0.01, 10, 1, 0, False, "1 x unit"),
    ]
    sample = strata.Sample(np.linspace(0.0, 1.0, 100), np.zeros(100, dtype=np.int64), two)
    assert sample.missing == 0.01
    assert sample.quantile(0.005) == math.inf
    assert sample.quantile(0.5) == pytest.approx(0.505, abs=0.011)


def test_strata_along_the_strength_have_the_law_of_the_inputs():
    """The weights of all stops give mean, spread and correlation of the inputs back."""
    all_laws = inputs()
    matrix = np.array([[1.0, 0.5], [0.5, 1.0]])
    drawn = stratified.draw(all_laws, matrix, [], [], 40_000, 5, RAREST)
    weight = np.repeat(
        [one.probability / one.runs for one in drawn.strata], [one.runs for one in drawn.strata]
    )
    assert weight.sum() == pytest.approx(1.0, abs=1e-12)
    normal = stats.norm.ppf(drawn.shares)
    assert weight @ normal == pytest.approx([0.0, 0.0], abs=0.02)
    assert (weight * normal.T) @ normal == pytest.approx(matrix, abs=0.03)


def test_units_of_a_car_are_correlated_as_stated_and_those_of_two_cars_less():
    cars = [0, 0, 0, 1, 1, 1]
    matrix = laws.of_units(cars, in_car=0.6, between_cars=0.2)
    shares = laws.correlated(np.random.default_rng(6).random((100_000, 6)), matrix)
    found = stats.spearmanr(shares).statistic
    for first, second in itertools.combinations(range(6), 2):
        stated = 0.6 if cars[first] == cars[second] else 0.2
        assert found[first, second] == pytest.approx(stated, abs=0.01)


def test_too_few_runs_for_the_strata_are_refused_with_the_number_that_is_enough():
    kinds = kinds_of(TEN)
    names = [str(number) for number in range(len(kinds))]
    with pytest.raises(ConfigError, match=r"runs = 100: .* set runs = (\d+) or more") as error:
        stratified.draw(inputs(), np.eye(2), kinds, names, 100, 0, RAREST)
    enough = int(str(error.value).partition("set runs = ")[2].partition(" ")[0])
    drawn = stratified.draw(inputs(), np.eye(2), kinds, names, enough, 0, RAREST)
    assert sum(one.runs for one in drawn.strata) == len(drawn.failed) == enough
