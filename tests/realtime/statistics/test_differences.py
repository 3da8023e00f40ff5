"""Differences of two samples: medians, intervals that hold, and tests that chance does not pass."""

import math

import numpy as np
import pytest

from rollerrig.realtime.campaign.statistics import differences, draws


@pytest.fixture(params=[100, pytest.param(400, marks=pytest.mark.nightly)])
def campaigns(request):
    return request.param


def missed(low: float, high: float, true: float) -> bool:
    return not low <= true <= high


def test_the_interval_of_pairs_holds_the_true_median_in_95_percent_of_the_campaigns(campaigns):
    random = np.random.default_rng(1)
    misses = 0
    for _ in range(campaigns):
        # a skewed law: its mean is not its median
        found = differences.paired(random.exponential(size=40) - math.log(2.0) + 1.5)
        misses += missed(found.low, found.high, 1.5)
    assert misses <= 0.08 * campaigns


def test_chance_alone_is_significant_in_5_percent_of_the_campaigns(campaigns):
    random = np.random.default_rng(2)
    pairs = 0
    samples = 0
    for _ in range(campaigns):
        first, second = random.normal(size=(2, 40))
        pairs += differences.is_significant(differences.paired(second - first).p_value)
        samples += differences.is_significant(differences.unpaired(first, second).p_value)
    assert pairs <= 0.08 * campaigns
    assert samples <= 0.08 * campaigns


def test_the_interval_of_the_medians_holds_for_samples_of_any_size(campaigns):
    random = np.random.default_rng(3)
    misses = 0
    for _ in range(campaigns):
        first = random.exponential(size=30)
        second = random.exponential(size=80) + 2.0
        found = differences.unpaired(first, second)
        misses += missed(found.low, found.high, 2.0)
    assert misses <= 0.05 * campaigns


def test_pairs_show_a_small_change_that_two_samples_hide():
    random = np.random.default_rng(4)
    first = random.normal(500.0, 50.0, size=40)
    second = first + random.normal(3.0, 2.0, size=40)
    gaps, _ = differences.of_pairs(first, second)
    assert differences.is_significant(differences.paired(gaps).p_value)
    assert not differences.is_significant(differences.unpaired(first, second).p_value)


def test_a_sketch_gives_the_interval_of_its_values_within_its_accuracy():
    random = np.random.default_rng(5)
    values = random.normal(500.0, 50.0, size=(2, 3000))
    exact = differences.unpaired(*values)
    sketches = [draws.Draws(one.size, np.zeros(0), draws.sketch(one)) for one in values]
    kept = differences.of_medians(*sketches)
    # each of two values near 500 is within ACCURACY; the ends of an interval use far ends of bins
    tolerance = 2 * 2 * 600.0 * draws.ACCURACY
    assert kept.median == pytest.approx(exact.median, abs=tolerance)
    assert exact.low - tolerance <= kept.low <= exact.low
    assert exact.high <= kept.high <= exact.high + tolerance
    assert kept.p_value is None


def test_a_stop_that_does_not_end_is_worse_than_any_other():
    gaps, counts = differences.of_pairs(
        np.array([100.0, np.inf, np.inf, 100.0]), np.array([np.inf, 100.0, np.inf, 90.0])
    )
    assert counts == differences.Counts(larger=1, smaller=2, equal=1)
    assert counts.pairs == 4
    assert gaps.tolist() == [np.inf, -np.inf, 0.0, -10.0]


def test_pairs_of_which_most_do_not_stop_any_more_are_significant():
    gaps = np.array([np.inf] * 12 + [1.0, 2.0])
    found = differences.paired(gaps)
    assert found.median == np.inf
    assert differences.is_significant(found.p_value)


def test_equal_campaigns_do_not_differ():
    found = differences.paired(np.zeros(20))
    assert found == differences.Difference(0.0, 0.0, 0.0, 1.0)


def test_too_few_pairs_have_no_interval():
    found = differences.paired(np.array([1.0, 2.0, 3.0]))
    assert found.median == 2.0
    assert (found.low, found.high) == (-np.inf, np.inf)


def test_the_correction_is_that_of_benjamini_and_yekutieli():
    # with 1 + 1/2 + 1/3 = 11/6: 3 * 11/6 * p / place in the order
    corrected = differences.corrected([0.001, 0.04, 0.02])
    assert corrected == pytest.approx([0.0055, 11 / 6 * 0.04, 11 / 6 * 0.03])
    assert differences.corrected([]) == []


@pytest.mark.nightly
def test_the_correction_keeps_the_chance_that_any_of_many_figures_is_significant(campaigns):
    random = np.random.default_rng(6)
    any_significant = 0
    for _ in range(campaigns):
        p_values = [differences.paired(random.normal(size=20)).p_value for _ in range(6)]
        any_significant += any(map(differences.is_significant, differences.corrected(p_values)))
    assert any_significant <= 0.08 * campaigns
