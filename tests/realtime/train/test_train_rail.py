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


SAND = {"axle": 1, "rate_kg_s": 0.07, "from_s": 1.0, "until_s": 4.0}


def test_sand_of_the_first_car_reaches_the_cars_behind_and_none_is_lost():
    train = read(train={"car": [{"sanders": SAND}, {"count": 2}]}, loop={"record_hz": 1000})
    run = stop.simulate(train)
    cars = run.samples().cars
    doses = [[one[f"sand_dose_{axle}_kg_m"].max() for axle in (1, 4)] for one in cars]
    # each axle crushes a share of what it meets
    assert doses[0][0] > doses[0][1] > doses[1][0] > doses[1][1] > doses[2][0] > 0.0
    states = [body.state for body in run.bodies]
    rail = run.link.rail
    found_kg = np.sum(rail.sand_kg) + rail.sand_left_kg[0]
    for state in states:
        found_kg += np.sum(state.sand_hose + state.sand_used) + np.sum(state.rail_sand)
        found_kg += state.sand_blown[0] + state.sand_left[0]
    taken_kg = sum(np.sum(state.sand_taken) for state in states)
    assert taken_kg == pytest.approx(0.07 * 3.0, rel=1e-2)
    assert found_kg == pytest.approx(taken_kg, rel=1e-9)

    # the last axle meets at a place what all before have left of the sand there
    share = 1.0 - train.cars[0].plan.params.sanders.used_share
    place_m = [one["position_m"] for one in cars]
    first = np.interp(40.0, place_m[0], cars[0]["sand_dose_1_kg_m"])
    behind_m = train.cars[2].plan.params.axle_position_m[0]
    third = np.interp(40.0, place_m[2] - behind_m, cars[2]["sand_dose_1_kg_m"])
    assert third == pytest.approx(first * share**8, rel=0.1)


def test_a_train_whose_first_car_sands_stops_shorter():
    sanded, plain = (
        stop.simulate(read(train={"car": [first, {"count": 3}]}))
        for first in ({"sanders": {**SAND, "until_s": 60.0}}, {})
    )
    ways = [run.samples().cars[0]["position_m"][-1] for run in (sanded, plain)]
    assert ways[0] < 0.99 * ways[1]
    # the cars behind sand nothing
    assert np.sum(sanded.bodies[1].state.sand_taken) == 0.0
