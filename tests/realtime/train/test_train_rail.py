"""The rail under a train: what the wheels ahead have done, place by place, and its trend."""

from pathlib import Path

import numpy as np
import pytest

from rollerrig.realtime.train import plan, stop
from rollerrig.rig.surface import CELL_M

GAIN = 0.4
ENERGY_J_M = 300.0
COACHES = {
    "vehicle": "uic_z1",
    "adhesion": "low",
    "initial_speed_m_s": 25.0,
    "demand": [{"pressure_Pa": 3.8e5}],
    "mechanisms": {"rail_cleaning_gain": GAIN, "rail_cleaning_energy_J_m": ENERGY_J_M},
}


def read(*, train, **changes):
    return plan.read({**COACHES, **changes, "train": train}, Path("train.toml"))


def moving(channels):
    return stop.moving(channels, 2.0)


def test_friction_behind_each_axle_is_that_of_the_work_of_all_axles_ahead():
    # a sample is a tick, so the work at each place is known without the rail of the product
    train = read(train={"car": [{"count": 3}]}, loop={"record_hz": 1000})
    cars = stop.simulate(train).samples().cars
    mu_cd = train.cars[0].plan["adhesion"]["mu_cd"]
    places_m = np.arange(20.0, 120.0, 5.0)
    work_J_m = np.zeros_like(places_m)
    for car, channels in zip(train.cars, cars, strict=True):
        kept = moving(channels)
        for axle, behind_m in enumerate(car.plan.params.axle_position_m, start=1):
            place_m = channels["position_m"][kept] - behind_m
            friction = channels[f"friction_degraded_{axle}"][kept]
            found = friction[np.searchsorted(place_m, places_m + 0.5 * CELL_M)]
            factor = np.exp(GAIN * (1.0 - np.exp(-work_J_m / ENERGY_J_M)))
            assert found == pytest.approx(mu_cd * factor, rel=0.02)
            energy_J_m = np.maximum(channels[f"dissipated_energy_{axle}_J_m"][kept], 0.0)
            done_J = np.concatenate(
                [[0.0], np.cumsum(0.5 * (energy_J_m[1:] + energy_J_m[:-1]) * np.diff(place_m))]
            )
            cells_m = CELL_M * np.floor((places_m + 0.5 * CELL_M) / CELL_M)
            ends_J = np.interp([cells_m, cells_m + CELL_M], place_m, done_J)
            work_J_m += (ends_J[1] - ends_J[0]) / CELL_M
    assert np.all(work_J_m > ENERGY_J_M)


def test_all_work_of_the_wheels_is_laid_on_the_rail():
    train = read(train={"car": [{"count": 2}]}, loop={"record_hz": 1000})
    run = stop.simulate(train)
    done_J = 0.0
    for car, channels in zip(train.cars, run.samples().cars, strict=True):
        for axle in range(1, car.plan.kind.axles + 1):
            energy_J_m = np.maximum(channels[f"dissipated_energy_{axle}_J_m"], 0.0)
            done_J += 1e-3 * np.sum(energy_J_m * channels["vehicle_speed_m_s"])
    # the last cells are left by nobody
    rest_J = np.sum(run.link.rail.own_J)
    assert run.link.rail.laid_J[0] + rest_J == pytest.approx(done_J, rel=1e-3)


def distances_m(cars, **changes):
    run = stop.simulate(read(train={"car": [{"count": cars}]}, **changes))
    position_m = run.samples().cars[0]["position_m"]
    return float(position_m[-1] - position_m[0])


def test_long_trains_stop_shorter_on_low_adhesion_because_their_wheels_clean_the_rail():
    of_cars = [distances_m(cars) for cars in (1, 2, 4, 8)]
    assert of_cars == sorted(of_cars, reverse=True)
    assert of_cars[3] < 0.98 * of_cars[1]
    # without cleaning the length does not matter
    dirty = {"mechanisms": {"rail_cleaning_gain": 0.0}}
    assert distances_m(8, **dirty) == pytest.approx(distances_m(2, **dirty), rel=0.01)


def test_a_film_that_comes_back_quickly_is_the_same_for_all_cars():
    quick = read(train={"car": [{"count": 3}], "film_recovery_s": 0.005})
    slow = read(train={"car": [{"count": 3}], "film_recovery_s": 1e5})
    of_first, of_last = [], []
    for train in (quick, slow):
        cars = stop.simulate(train).samples().cars
        for channels, found in ((cars[0], of_first), (cars[2], of_last)):
            found.append(np.mean(channels["friction_degraded_1"][moving(channels)]))
    assert of_last[0] == pytest.approx(of_first[0], rel=1e-3)
    assert of_last[1] > 1.2 * of_first[1]


def test_a_place_with_other_friction_is_met_by_each_axle_when_it_is_there():
    train = read(
        train={"car": [{"count": 2}]},
        mechanisms={"rail_cleaning_gain": 0.0},
        friction=[{"from_m": 60.0, "mu_cd": 0.1}],
        loop={"record_hz": 1000},
    )
    for car, channels in zip(train.cars, stop.simulate(train).samples().cars, strict=True):
        for axle, behind_m in enumerate(car.plan.params.axle_position_m, start=1):
            first = np.flatnonzero(channels[f"friction_degraded_{axle}"] > 0.09)[0]
            assert channels["position_m"][first] - behind_m == pytest.approx(60.0, abs=0.06)
