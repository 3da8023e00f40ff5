"""The extrapolated tail against laws whose tail is known, and against brute force."""

import numpy as np
import pytest
from scipy import optimize, stats

from rollerrig.realtime.campaign.statistics import tail

CAMPAIGNS = 600  # with 200, chance alone misses the range of 93 to 97 % in one test of three
RUNS = 5000  # of one campaign
EXCEEDED = 1e-4


def pareto(rng, shape, size):
    """Return draws of a generalised Pareto law with the scale 1, by its inverse."""
    uniform = rng.random(size)
    return -np.log(uniform) if shape == 0.0 else (uniform**-shape - 1.0) / shape


def profile_at(law, value, begin):
    """Return the largest log-likelihood of all laws of which `EXCEEDED` is above this value [T4].

    Independent of `tail`: with the densities of scipy.
    """

    def cost(place):
        shape, log_scale = place
        above_threshold = stats.genpareto.sf(value - law.threshold, shape, scale=np.exp(log_scale))
        if not above_threshold > EXCEEDED:
            return np.inf
        share = EXCEEDED / above_threshold
        number = law.excesses.size
        sizes = stats.genpareto.logpdf(law.excesses, shape, scale=np.exp(log_scale)).sum()
        return -sizes - stats.binom.logpmf(number, law.draws, share)

    options = {"xatol": 1e-6, "fatol": 1e-7, "maxiter": 2000}
    return -optimize.minimize(cost, begin, method="Nelder-Mead", options=options).fun


@pytest.mark.parametrize("shape", [-0.2, 0.0, 0.2])
def test_the_likelihood_at_the_ends_of_an_interval_is_lower_by_a_quantile_of_chi_squared(shape):
    law = tail.fit(pareto(np.random.default_rng(SEEDS[shape]), shape, RUNS))
    found = tail.exceeded(law, EXCEEDED)
    place = np.array([law.shape, np.log(law.scale)])
    best = profile_at(law, found.estimate, place)
    # the scale that reaches the value with the same shape is near the best one
    for end, quantile in (
        (found.low, stats.norm.ppf(0.975)),
        (found.high, stats.norm.ppf(0.975)),
        (found.bound, stats.norm.ppf(0.95)),
    ):
        factor = (end - law.threshold) / (found.estimate - law.threshold)
        lower = best - profile_at(law, end, place + np.array([0.0, np.log(factor)]))
        assert np.sqrt(2.0 * lower) == pytest.approx(quantile, rel=0.01)


@pytest.mark.nightly
@pytest.mark.parametrize("shape", [-0.2, 0.0, 0.2])
def test_intervals_of_600_campaigns_hold_the_true_value_in_93_to_97_of_100(shape):
    rng = np.random.default_rng(SEEDS[shape])
    true_value = EXCEEDED**-shape / shape - 1.0 / shape if shape else -np.log(EXCEEDED)
    in_interval = 0
    below_bound = 0
    for _ in range(CAMPAIGNS):
        found = tail.exceeded(tail.fit(pareto(rng, shape, RUNS)), EXCEEDED)
        in_interval += found.low <= true_value <= found.high
        below_bound += true_value <= found.bound
        assert found.low < found.estimate < found.bound < found.high
    assert 0.93 <= in_interval / CAMPAIGNS <= 0.97
    assert 0.93 <= below_bound / CAMPAIGNS <= 0.97


def test_an_extrapolation_from_5000_runs_agrees_with_two_million_runs():
    # no Pareto law: the distance of a stop with a random friction, plus a random delay
    def distances(rng, size):
        friction = 0.08 * np.exp(0.1 * rng.standard_normal(size))
        return 40.0 * rng.gamma(2.0, 0.5, size) + 33.3**2 / (2.0 * 9.81 * friction)

    brute = np.sort(distances(np.random.default_rng(1), 2_000_000))
    value = tail.exceeded(tail.fit(distances(np.random.default_rng(2), RUNS)), EXCEEDED)
    true_m = brute[-int(EXCEEDED * brute.size)]
    assert value.low <= true_m <= value.high
    assert value.estimate == pytest.approx(true_m, rel=0.1)


def test_the_fit_finds_the_largest_likelihood_that_scipy_finds():
    drawn = pareto(np.random.default_rng(6), 0.1, 4000)
    law = tail.fit(drawn)
    shape, _, scale = stats.genpareto.fit(law.excesses, floc=0.0)
    assert law.shape == pytest.approx(shape, abs=2e-3)
    assert law.scale == pytest.approx(scale, rel=2e-3)
    # a value at the edge of the sample is known without any law
    assert tail.exceeded(law, 0.05).estimate == pytest.approx(np.quantile(drawn, 0.95), rel=0.05)


def test_a_scale_of_metres_or_of_kilometres_gives_the_same_law():
    drawn = pareto(np.random.default_rng(9), -0.1, 3000)
    in_m = tail.exceeded(tail.fit(1000.0 * drawn), EXCEEDED)
    in_km = tail.exceeded(tail.fit(drawn), EXCEEDED)
    assert in_m.high == pytest.approx(1000.0 * in_km.high, rel=1e-3)
    assert in_m.estimate == pytest.approx(1000.0 * in_km.estimate, rel=1e-5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.arange(499.0), "so 500 runs"),
        (np.append(np.arange(999.0), np.inf), "did not stop"),
        (np.repeat(np.arange(10.0), 100)[:-50], "same value"),
        (np.repeat(np.arange(10.0), 100), "same value"),
        (np.random.default_rng(1).random(2000), "end in a step"),
    ],
)
def test_a_sample_without_such_a_tail_is_refused_with_its_reason(values, message):
    with pytest.raises(tail.NoTailError, match=message):
        tail.fit(values)


def test_another_threshold_gives_about_the_same_value_where_the_law_holds():
    drawn = pareto(np.random.default_rng(3), 0.0, 20_000)
    rows = tail.stability(drawn, 1e-3)
    assert [row.share for row in rows] == [0.2, 0.1, 0.05]
    values = [row.estimate for row in rows]
    assert max(values) / min(values) < 1.1


def test_a_share_that_the_threshold_does_not_reach_is_an_error():
    law = tail.fit(pareto(np.random.default_rng(3), 0.0, 1000))
    with pytest.raises(ValueError, match=r"below 0\.1"):
        tail.exceeded(law, 0.2)


# of the campaigns of each shape
SEEDS = {-0.2: 31, 0.0: 32, 0.2: 33}
