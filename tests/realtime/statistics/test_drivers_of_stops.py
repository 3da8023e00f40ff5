"""Rank correlations and Sobol indices against models whose answer is known."""

import math

import numpy as np
import pytest

from rollerrig.realtime.campaign.statistics import drivers

BLOCKS = 300

# Ishigami function with a = 7, b = 0.1: variances in closed form (Ishigami and Homma 1990)
PI_4 = math.pi**4
ALONE_1 = 0.5 * (1.0 + 0.1 * PI_4 / 5.0) ** 2
ALONE_2 = 49.0 / 8.0
ONE_AND_THREE = 0.01 * PI_4**2 * (1.0 / 18.0 - 1.0 / 50.0)
VARIANCE = ALONE_1 + ALONE_2 + ONE_AND_THREE
FIRST = np.array([ALONE_1, ALONE_2, 0.0]) / VARIANCE
TOTAL = np.array([ALONE_1 + ONE_AND_THREE, ALONE_2, ONE_AND_THREE]) / VARIANCE


def ishigami(shares):
    x = 2.0 * math.pi * shares - math.pi
    first, second, third = x.T
    return np.sin(first) + 7.0 * np.sin(second) ** 2 + 0.1 * third**4 * np.sin(first)


@pytest.mark.parametrize(
    ("campaigns", "share"), [(40, 0.04), pytest.param(200, 0.02, marks=pytest.mark.nightly)]
)
def test_intervals_of_sobol_indices_hold_the_known_ones_in_95_of_100(campaigns, share):
    pytest.importorskip("SALib")
    covered = 0
    for seed in range(campaigns):
        values = ishigami(drivers.blocks(BLOCKS, 3, seed))
        found = drivers.sobol_indices(values, 3, seed)
        for indices, first, total in zip(found, FIRST, TOTAL, strict=True):
            covered += indices.first.low <= first <= indices.first.high
            covered += indices.total.low <= total <= indices.total.high
    assert covered / (6 * campaigns) == pytest.approx(0.95, abs=share)


def test_a_block_with_a_run_without_a_value_is_left_out_and_few_blocks_give_no_indices():
    pytest.importorskip("SALib")
    values = ishigami(drivers.blocks(BLOCKS, 3, 1))
    values[7] = np.inf
    assert drivers.left_out_blocks(values, 3) == 1
    without = drivers.sobol_indices(np.delete(values, range(5, 10)), 3, 1)
    assert drivers.sobol_indices(values, 3, 1) == without
    assert drivers.sobol_indices(values[: 5 * (drivers.FEWEST_BLOCKS - 1)], 3, 1) == []


@pytest.mark.parametrize(
    ("tries", "share"), [(400, 0.025), pytest.param(2000, 0.02, marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize(
    ("count", "rho"),
    [
        (40, 0.0),
        pytest.param(100, 0.5, marks=pytest.mark.nightly),
        pytest.param(100, 0.9, marks=pytest.mark.nightly),
        (1000, -0.3),
    ],
)
def test_intervals_of_rank_correlations_hold_the_known_one_in_95_of_100(count, rho, tries, share):
    rng = np.random.default_rng(3)
    # of a pair of normal numbers with the correlation rho (Pearson 1907)
    known = 6.0 / math.pi * math.asin(rho / 2.0)
    covered = 0
    for _ in range(tries):
        x, other = rng.standard_normal((2, count))
        found = drivers.rank_correlation(x, rho * x + math.sqrt(1.0 - rho**2) * other)
        covered += found.low <= known <= found.high
    assert covered / tries == pytest.approx(0.95, abs=share)


def test_a_constant_has_no_rank_correlation_and_equal_orders_have_one():
    count = np.arange(10.0)
    assert math.isnan(drivers.rank_correlation(count, np.ones(10)).value)
    assert drivers.rank_correlation(count, np.exp(count)) == pytest.approx((1.0, 1.0, 1.0))
