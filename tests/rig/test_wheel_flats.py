"""Wheel flats: length by the work of a lock, effect once a turn, none on round wheels."""

import math

import numpy as np
import pytest
from rolling import FILL, LOGGED, VENT, Rig

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import free, scenario
from rollerrig.rig.mechanisms import wheel_flat

WEAR = {"wear_mm3_J": 0.002}
ICE = {"mu_cd": 0.03, "tau_m_J": 0.0}
LOCKING = FILL
FREE = VENT

RADIUS_M = 0.445
WIDTH_M = 0.03  # of a flat
WEAR_M3_J = 0.002e-9  # of `WEAR`
MASS_KG = 43000.0
WHEELSET_KGM2 = 160.0


def locked(flats, seconds=3.0, speed_m_s=15.0, **sections):
    """Return a rig after a lock of every wheel, and the `History` of the lock."""
    rig = Rig(speed_m_s, adhesion=ICE, flats=flats, **sections)
    run = rig.roll(seconds, LOCKING)
    assert (run.wheel_speed[-1] == 0.0).all()
    return rig, run


def test_a_flat_has_the_volume_that_the_work_of_its_lock_grinds_off_one_wheel():
    _, run = locked(WEAR)
    still = run.wheel_speed == 0.0
    for j in range(4):
        # the whole tick in which the wheel locked counts
        begin = np.argmax(still[:, j]) - 1
        work_J = 0.5 * (run.sliding_work[-1, j] - run.sliding_work[begin, j])
        length_m = run.flat_length[-1, j]
        volume_m3 = WIDTH_M * length_m**3 / (12.0 * RADIUS_M)
        assert 0.005 < length_m < 0.1
        assert volume_m3 == pytest.approx(WEAR_M3_J * work_J, rel=1e-9)


def test_a_flat_grows_with_the_cube_root_of_the_work():
    short_m = wheel_flat.length_m(1e5, WEAR_M3_J, WIDTH_M, RADIUS_M)
    long_m = wheel_flat.length_m(8e5, WEAR_M3_J, WIDTH_M, RADIUS_M)
    assert long_m == pytest.approx(2.0 * short_m, rel=1e-12)


def test_a_short_second_lock_does_not_make_the_flat_of_the_first_longer():
    rig, _ = locked(WEAR, 6.0, 25.0)
    before = rig.roll(2.0, FREE).flat_length[-1].copy()
    second = rig.roll(0.9, LOCKING)
    assert (second.wheel_speed[-1] == 0.0).all()
    assert (second.lock_work[-1] > 0.0).all()
    assert (second.flat_length[-1] == before).all()


def test_the_load_over_a_flat_falls_and_rises_once_a_turn_and_its_mean_stays():
    length_m = 0.04

    def load_share(turned_rad):
        return wheel_flat.load_share(turned_rad, length_m, RADIUS_M, 10.0)

    turn_rad = np.linspace(0.0, 2.0 * math.pi, 200_001)
    shares = np.array([load_share(angle_rad) for angle_rad in turn_rad])
    assert shares.mean() == pytest.approx(1.0, abs=1e-6)
    assert shares.min() == pytest.approx(0.6, abs=1e-3)
    assert shares.max() == pytest.approx(1.4, abs=1e-3)
    share_of_turn = length_m / (2.0 * math.pi * RADIUS_M)
    assert np.mean(shares != 1.0) == pytest.approx(share_of_turn, rel=1e-2)
    # the wheel drops into the flat first, then it strikes
    assert load_share(-0.02) < 1.0
    assert load_share(0.02) > 1.0


def test_the_load_on_a_round_wheel_does_not_change():
    assert wheel_flat.load_share(0.01, 0.0, RADIUS_M, 10.0) == 1.0


def kinetic_J(history, tick):
    """Return the kinetic energy of vehicle and wheelsets."""
    vehicle_J = 0.5 * MASS_KG * history.vehicle_speed[tick] ** 2
    wheelsets_J = 0.5 * WHEELSET_KGM2 * (history.wheel_speed[tick] ** 2).sum()
    return vehicle_J + wheelsets_J


def test_the_energy_of_a_stop_with_acting_flats_balances():
    rig, lock = locked(WEAR, rig={"mode": "track"})
    rolling = rig.roll(2.0, FREE)
    loads = rolling.wheel_load / rolling.wheel_load[0]
    assert np.abs(loads - 1.0).max() > 0.1

    counted_J = 0.0
    for history in (lock, rolling):
        counted_J += history.change("sliding_work").sum()
        counted_J += history.change("brake_work").sum()
        counted_J += history.change("resistance_work")
    lost_J = kinetic_J(lock, 0) - kinetic_J(rolling, -1)
    assert counted_J == pytest.approx(lost_J, rel=1e-6)


def test_wear_without_a_lock_and_a_lock_without_wear_change_no_bit():
    plain = Rig(30.0).roll(3.0, FREE)
    worn = Rig(30.0, flats=WEAR).roll(3.0, FREE)
    for name in LOGGED:
        if name != "sliding_work_before":
            assert np.array_equal(getattr(plain, name), getattr(worn, name), equal_nan=True), name
    _, run = locked({})
    assert (run.flat_length == 0.0).all()


def test_a_flat_gives_repeatable_noise_only_at_the_sensor_of_its_wheel():
    settings = (
        "adhesion.mu_cd=0.02",
        "adhesion.tau_m_J=0.0",
        "initial_speed_m_s=12.0",
        "duration_max_s=8.0",
        "flats.wear_mm3_J=0.002",
        "flats.load_1_m=0.0",
        "rig=plain_track",
    )
    fault = ("vent_magnet_stuck axle=1 at=3", "vent_magnet_stuck axle=2")

    def channels(*more):
        plan = scenario.load("velim_a1", "", (*settings, *more), faults=fault)
        return free.channels(free.simulate(plan, "none"), plan.table)

    noisy = channels()
    repeated = channels()
    quiet = channels("flats.noise_rad_s_m=0.0")

    noise_rad_s = noisy["measured_speed_1_rad_s"] - noisy["wheel_speed_1_rad_s"]
    turns = noisy["wheel_speed_1_rad_s"] > 1.0
    late = noisy["time_s"] > 4.0
    expected_rad_s = 5.0 * noisy["flat_length_1_m"][-1]
    assert noise_rad_s[turns & late].std() == pytest.approx(expected_rad_s, rel=0.3)
    assert np.array_equal(noisy["measured_speed_2_rad_s"], noisy["wheel_speed_2_rad_s"])
    assert np.array_equal(noisy["measured_speed_1_rad_s"], repeated["measured_speed_1_rad_s"])
    assert np.array_equal(quiet["measured_speed_1_rad_s"], quiet["wheel_speed_1_rad_s"])


def test_the_coach_in_3d_refuses_loads_over_flats():
    with pytest.raises(ConfigError, match=r"load_1_m.*coach in 3D.*planar"):
        Rig(20.0, vehicle={"model": "multibody"}, flats=WEAR)
