"""Sketches: quantiles within their accuracy, bounds on the safe side, and any order of merging."""

import math

import numpy as np
import pytest

from rollerrig.realtime.campaign.statistics import corrections, draws, quantiles, tail

RUNS = 30_000
LARGEST = 2_000
# accuracy with the rounding of the ends of bins
WITHIN = draws.ACCURACY * (1.0 + 1e-6)


def sketched(values):
    """Return draws of which only the largest are known."""
    return draws.Draws(values.size, np.sort(values)[-LARGEST:], draws.sketch(values))


@pytest.fixture(scope="module")
def distance_m():
    return np.random.default_rng(5).lognormal(math.log(600.0), 0.2, RUNS)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_every_draw_is_within_the_accuracy_and_between_its_bounds(distance_m, sign):
    values = sign * distance_m
    ordered = np.sort(values)
    found = sketched(values)
    for rank in (1, 2, 50, RUNS // 2, RUNS - LARGEST, RUNS - LARGEST + 1, RUNS - 3, RUNS):
        exact = float(ordered[rank - 1])
        assert found.at(rank) == pytest.approx(exact, rel=WITHIN)
        assert found.below(rank) <= exact <= found.above(rank)
        assert found.above(rank) - found.below(rank) <= 2.001 * draws.ACCURACY * abs(exact)
        if rank > RUNS - LARGEST:
            assert found.below(rank) == exact == found.above(rank)


def test_values_around_zero_and_infinite_ones_have_their_ranks():
    values = np.array([-2.0, 0.0, 1e-12, 3.0])
    found = draws.Draws(6, np.array([math.inf]), draws.sketch(values))
    assert [found.at(rank) for rank in (2, 3)] == [0.0, 0.0]
    assert found.at(1) == pytest.approx(-2.0, rel=WITHIN)
    assert found.at(4) == pytest.approx(3.0, rel=WITHIN)
    # both are beyond all finite values, also the one that is not among the largest ones kept
    assert [found.above(rank) for rank in (5, 6)] == [math.inf, math.inf]


def test_a_merged_sketch_is_that_of_all_values_in_any_order(distance_m):
    whole = draws.sketch(distance_m)
    parts = [draws.sketch(part) for part in np.array_split(distance_m, 7)]
    for order in (parts, parts[::-1], parts[3:] + parts[:3]):
        merged = order[0]
        for part in order[1:]:
            merged = merged.merged(part)
        assert np.array_equal(merged.bins, whole.bins)
        assert np.array_equal(merged.counts, whole.counts)


def test_merged_moments_are_those_of_all_values(distance_m):
    merged = draws.Moments()
    for part in np.array_split(distance_m, 7):
        merged = merged.merged(draws.moments(part))
    assert merged.number == RUNS
    assert merged.mean == pytest.approx(distance_m.mean(), rel=1e-12)
    assert merged.variance == pytest.approx(distance_m.var(ddof=1), rel=1e-9)


def test_bounds_of_a_sketch_are_those_of_all_values_or_on_the_safe_side(distance_m):
    for quantile in (0.5, 0.9, 0.99, 0.999):
        exact = quantiles.upper_bound(distance_m, quantile)
        found = quantiles.upper_bound(sketched(distance_m), quantile)
        assert found.rank == exact.rank
        assert exact.bound <= found.bound <= exact.bound * (1.0 + 2.0 * WITHIN)
        # the tail is kept, so rare quantiles are exact
        if quantile > 1.0 - LARGEST / RUNS:
            assert found.bound == exact.bound
        exact_interval = quantiles.interval(distance_m, quantile)
        found_interval = quantiles.interval(sketched(distance_m), quantile)
        assert found_interval.low <= exact_interval.low
        assert exact_interval.high <= found_interval.high


def test_the_law_of_the_tail_is_fitted_to_the_largest_draws_that_are_kept(distance_m):
    exact = tail.fit(distance_m, (LARGEST - 1) / RUNS)
    found = tail.fit(sketched(distance_m))
    assert found.excesses.size == LARGEST - 1
    assert (found.threshold, found.shape, found.scale) == (
        exact.threshold,
        exact.shape,
        exact.scale,
    )
    assert [row.share for row in tail.stability(sketched(distance_m), 1e-4)] == [
        (LARGEST - 1) / RUNS,
        (LARGEST - 1) / RUNS / 2,
    ]


def test_correction_factors_from_a_sketch_are_those_of_all_values_or_below_them():
    ratios = np.random.default_rng(8).normal(1.0, 0.04, RUNS)
    nominal_m_s2 = 1.3
    weakness = sketched(-ratios * nominal_m_s2).divided(nominal_m_s2)
    found = corrections.corrections(weakness, levels=(0, 1, 2, 3))
    for factor, exact in zip(
        found, corrections.corrections(ratios, levels=(0, 1, 2, 3)), strict=True
    ):
        assert factor.method == exact.method == corrections.BY_RANK
        assert factor.bound == pytest.approx(exact.bound, rel=2.0 * WITHIN)
        assert factor.bound <= exact.bound * (1.0 + 1e-15)
        assert factor.estimate == pytest.approx(exact.estimate, rel=WITHIN)
