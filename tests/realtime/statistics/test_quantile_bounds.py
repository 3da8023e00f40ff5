"""Bounds of quantiles and probabilities reach the confidence that they state."""

import math

import numpy as np
import pytest
from scipy import stats

from rollerrig.realtime.campaign.statistics import quantiles


@pytest.mark.parametrize(
    ("count", "quantile", "rank"),
    [
        (58, 0.95, 0),
        (59, 0.95, 59),
        (93, 0.95, 92),
        (92, 0.95, 92),
        (124, 0.95, 122),
        (299, 0.99, 299),
        (298, 0.99, 0),
    ],
)
def test_the_ranks_are_those_of_wilks(count, quantile, rank):
    # 59 for 95/95, 93 for its second order, 299 for 99/95: Wilks 1941 and all that use him
    assert quantiles.rank(count, quantile) == rank


def test_the_interval_of_a_median_has_the_ranks_of_published_tables():
    # n = 30 in tables of confidence intervals of the median: ranks 10 and 21, 95.7 %
    found = quantiles.interval(np.arange(1.0, 31.0), 0.5)
    assert (found.low, found.high) == (10.0, 21.0)
    assert found.confidence == pytest.approx(0.957, abs=5e-4)


@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.95])
def test_a_bound_lies_above_its_quantile_with_the_stated_confidence(quantile):
    rng = np.random.default_rng(5)
    count, tries = 80, 4000
    drawn = np.sort(rng.exponential(size=(tries, count)), axis=1)
    true_quantile = -math.log1p(-quantile)

    # a rank is a whole number, so the confidence is a little above the required one, never below
    place = quantiles.rank(count, quantile) - 1
    above = drawn[:, place] >= true_quantile
    assert quantiles.CONFIDENCE - 0.01 <= above.mean() <= 1.0
    above_by_lower_rank = drawn[:, place - 1] >= true_quantile
    assert above_by_lower_rank.mean() < quantiles.CONFIDENCE + 0.01


@pytest.mark.parametrize("tries", [800, pytest.param(4000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(("count", "quantile"), [(60, 0.95), (92, 0.95), (450, 0.99), (30, 0.5)])
def test_the_confidence_that_a_bound_states_is_the_one_it_has(count, quantile, tries):
    rng = np.random.default_rng(8)
    true_quantile = stats.gumbel_r.ppf(quantile)
    covered = 0
    for _ in range(tries):
        drawn = -np.log(-np.log(rng.random(count)))
        bound = quantiles.upper_bound(drawn, quantile)
        covered += bound.bound >= true_quantile
    # three standard errors of a share of so many tries
    error = 3.0 * math.sqrt(0.05 * 0.95 / tries)
    assert covered / tries == pytest.approx(bound.confidence, abs=error)


@pytest.mark.parametrize(
    ("tries", "share"), [(400, 0.025), pytest.param(2000, 0.02, marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.99])
def test_bounds_of_large_campaigns_hold_in_95_of_100(quantile, tries, share):
    rng = np.random.default_rng(21)
    true_quantile = -math.log1p(-quantile)
    bounds = [
        quantiles.upper_bound(rng.exponential(size=3000), quantile).bound for _ in range(tries)
    ]
    held = np.mean(np.array(bounds) >= true_quantile)
    assert held == pytest.approx(0.95, abs=share)


def test_too_few_runs_give_no_bound_and_the_number_that_is_needed():
    bound = quantiles.upper_bound(np.arange(58.0), 0.95)
    assert (bound.rank, bound.bound, bound.confidence, bound.needs) == (0, math.inf, 0.0, 59)


@pytest.mark.parametrize(("count", "probability"), [(3000, 0.02), (20_000, 0.003)])
def test_the_bound_of_a_probability_holds_in_93_to_97_of_100(count, probability):
    rng = np.random.default_rng(4)
    cases = rng.binomial(count, probability, 4000)
    bounds = np.array([quantiles.probability_bound(int(number), count) for number in cases])
    assert 0.93 <= np.mean(bounds >= probability) <= 0.97


def test_no_case_in_299_runs_bounds_a_probability_of_one_percent():
    # the same statement as that of Wilks for the largest of 299
    assert quantiles.probability_bound(0, 299) < 0.01 < quantiles.probability_bound(0, 298)
    assert quantiles.probability_bound(5, 5) == 1.0
