"""Quantiles, bounds and the law of the tail against published campaigns of ten million stops.

Model and results: github.com/RailProfAC/ShuntingBrakingCurves, MIT License, Copyright (c) 2022
Raphael Pfaff: MonteCarloSimulation-multiprocessing.py and the results in README.md, of ten million
stops each. A locomotive and five wagons brake from 25 km/h.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from rollerrig.realtime.campaign.statistics import quantiles, tail

WAGONS = 5
WAGON_KG = 90_000.0
LOCOMOTIVE_KG = 53_000.0
# lambda of 105 %, and the deceleration that belongs to it
LOCOMOTIVE_N = LOCOMOTIVE_KG * round(0.0075 * 105 + 0.076, 2)
STEP_S = 0.01


class Mode(NamedTuple):
    """A brake mode: the filling times, the share that is filled immediately, and the results.

    beyond: share of the stops beyond each distance in m.
    """

    fill_mean_s: float
    fill_deviation_s: float
    immediate: float
    mean_m: float
    deviation_m: float
    one_in_100_000_m: float
    beyond: dict[float, float]


G = Mode(
    24.0,
    2.0,
    0.1,
    mean_m=64.26639085984135,
    deviation_m=0.810189260353572,
    one_in_100_000_m=67.6372804335411,
    beyond={64.0: 0.6315591, 65.0: 0.1826848, 66.0: 0.0151151},
)
P = Mode(
    4.0,
    0.33,
    0.0,
    mean_m=38.34119851977985,
    deviation_m=0.47121113975515005,
    one_in_100_000_m=40.35518598,
    beyond={38.0: 0.7653449, 39.0: 0.081124},
)


def friction(speed_m_s, block_N):
    """The friction of blocks by Karwatzki."""
    by_force = (block_N + 200_000.0) / (block_N + 50_000.0)
    by_speed = (speed_m_s + 150.0 / 3.6) / (speed_m_s + 75.0 / 3.6)
    return 0.055 * by_force * by_speed


def distances_m(mode, count, seed):
    """Return the distances of the published model; it counts the locomotive's brake twice."""
    rng = np.random.default_rng(seed)
    shape = (count, WAGONS)
    pressure_Pa = rng.normal(3.8e5, 5e3, shape)
    factor = rng.normal(0.83, 0.02, shape) * rng.normal(1.0, 0.025, shape)
    fill_s = rng.normal(mode.fill_mean_s, mode.fill_deviation_s, shape)
    fill_s += (10.5 + 14.0 * np.arange(WAGONS)) / 250.0
    full_N = (pressure_Pa * np.pi * 0.406**2 / 4.0 - 1500.0) * 5.65
    mass_kg = LOCOMOTIVE_KG + 1.04 * WAGON_KG * WAGONS

    speed_m_s = np.full(count, 25.0 / 3.6)
    distance_m = np.zeros(count)
    time_s = 0.0
    while (rolls := speed_m_s > 0.0).any():
        filled = np.minimum(mode.immediate + (1.0 - mode.immediate) * time_s / fill_s, 1.0)
        of_locomotive = min(
            mode.immediate + (1.0 - mode.immediate) * time_s / mode.fill_mean_s, 1.0
        )
        blocks_N = full_N * filled
        brakes_N = (blocks_N * friction(speed_m_s[:, None], blocks_N / 16.0) * factor).sum(axis=1)
        resistance_N = (1.6e-3 + 5.7e-3 * (speed_m_s / 27.8) ** 2) * WAGONS * WAGON_KG * 9.81
        force_N = LOCOMOTIVE_N * (1.0 + of_locomotive) + brakes_N + resistance_N
        speed_m_s = np.where(rolls, speed_m_s - force_N / mass_kg * STEP_S, speed_m_s)
        distance_m += np.where(rolls, speed_m_s * STEP_S, 0.0)
        time_s += STEP_S
    return distance_m


@pytest.mark.parametrize(
    ("mode", "count"),
    [(G, 4_000), pytest.param(P, 12_000, marks=pytest.mark.nightly)],
    ids=["G", "P"],
)
def test_a_small_campaign_agrees_with_a_published_one_of_ten_million_stops(mode, count):
    found_m = distances_m(mode, count, seed=11)
    # four standard errors of the small campaign
    error_m = mode.deviation_m / np.sqrt(count)
    assert found_m.mean() == pytest.approx(mode.mean_m, abs=4.0 * error_m)
    assert found_m.std() == pytest.approx(mode.deviation_m, abs=4.0 * error_m / np.sqrt(2.0))
    for limit_m, share in mode.beyond.items():
        beyond = int((found_m > limit_m).sum())
        assert quantiles.probability_bound(beyond, count, 0.9999) >= share
        assert stats.binom.cdf(beyond, count, share) < 0.9999
        # the quantile of the published share: between the ends of its interval
        interval = quantiles.interval(found_m, 1.0 - share, 0.9999)
        assert interval.low <= limit_m <= interval.high

    law = tail.fit(found_m)
    extrapolated = tail.exceeded(law, 1e-5, 0.99)
    assert extrapolated.low <= mode.one_in_100_000_m <= extrapolated.high
    assert extrapolated.estimate == pytest.approx(mode.one_in_100_000_m, rel=0.01)
