"""The speed sensors: pulses of a pole wheel, what is measured from them, and where they end."""

import numpy as np
import pytest

from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.faults import effects
from rollerrig.wsp_interface import signals

TICK_S, TEETH, WINDOW = 0.001, 100, 10
SPEED, ANGLE = signals.column("wheel_speed"), signals.column("wheel_angle")
MEASURED, PULSES = signals.column("measured_speed"), signals.column("pulse_count")
FREQUENCY = signals.column("tooth_frequency")


def drive(speeds, model="pole_wheel", timer_Hz=1e6, dropout_rad_s=1.0, faults=()):
    """Rows of axle 1 that turns with speeds in rad/s, one a tick: measured speed and pulses."""
    sensor = pole_wheel.Sensor(
        pole_wheel.MODELS[model], TEETH, WINDOW, dropout_rad_s, timer_Hz, TICK_S
    )
    row, memory = np.zeros(len(signals.COLUMNS)), pole_wheel.memory(1)
    array = np.zeros(effects.SIZE)
    for kind, value in faults:
        array[effects.slot(kind, 1)] = value
    told = []
    for speed in speeds:
        row[SPEED] = speed
        row[ANGLE] += speed * TICK_S
        pole_wheel.sense(row, memory, sensor, array)
        told.append((row[MEASURED], row[PULSES], row[FREQUENCY], row[ANGLE]))
    return np.array(told).T


def test_the_ideal_sensor_tells_the_wheels_own_speed_and_counts_its_teeth():
    speeds = np.linspace(90.0, 0.0, 500)
    measured, pulses, frequency, angle = drive(speeds, "ideal")
    assert np.array_equal(measured, speeds)
    assert frequency == pytest.approx(speeds * TEETH / (2 * np.pi))
    assert np.array_equal(pulses, np.floor(angle * (TEETH / (2.0 * np.pi))))


@pytest.mark.conformance("CiA 406", "pole wheel: quantised pulses")
@pytest.mark.parametrize("speed", [3.0, 17.3, 95.1])
def test_a_constant_speed_is_measured_within_the_resolution_of_the_timer(speed):
    measured, _, _, _ = drive(np.full(600, speed), timer_Hz=1e5)
    # of two edges each may be one count of the timer early, in a window of at least one tooth
    pitch_s = 2 * np.pi / TEETH / speed
    assert measured[100:] == pytest.approx(
        speed, rel=2 * 1e-5 / max(pitch_s, 0.5 * WINDOW * TICK_S)
    )
    assert len(set(measured[100:])) > 1


def test_the_measured_speed_changes_once_in_a_window():
    measured, _, _, _ = drive(np.linspace(90.0, 60.0, 500))
    changed = np.flatnonzero(np.diff(measured)) + 1
    assert set((changed + 1) % WINDOW) == {0}


def test_the_measured_speed_lags_a_braking_wheel_by_about_half_a_window():
    rate = -30.0
    speeds = 90.0 + rate * TICK_S * np.arange(1000)
    measured, _, _, _ = drive(speeds)
    at = np.arange(5 * WINDOW - 1, 1000, WINDOW)
    lag_s = (speeds[at] - measured[at]) / rate
    assert lag_s.mean() == pytest.approx(0.5 * WINDOW * TICK_S, rel=0.3)


@pytest.mark.conformance("CiA 406", "pole wheel: low-speed drop-out")
def test_below_its_dropout_speed_the_sensor_gives_no_pulses_and_the_speed_falls_to_zero():
    speeds = np.concatenate([np.full(500, 10.0), np.full(600, 0.9)])
    measured, pulses, _, _ = drive(speeds)
    assert np.ptp(pulses[500:]) <= 1
    assert (np.diff(measured[500:]) <= 0).all()
    # without a pulse the speed is lower than a tooth in the time that has passed
    assert measured[560] <= 2 * np.pi / TEETH / 0.05
    assert measured[-1] == 0.0


def test_a_slow_wheel_above_the_dropout_speed_is_measured_between_its_rare_pulses():
    measured, _, _, _ = drive(np.full(2000, 1.5))
    assert measured[500:] == pytest.approx(1.5, rel=0.01)


def test_a_wheel_that_starts_again_is_measured_again():
    measured, _, _, _ = drive(np.concatenate([np.full(300, 0.0), np.full(300, 20.0)]))
    assert measured[299] == 0.0
    assert measured[-1] == pytest.approx(20.0, rel=0.01)


@pytest.mark.conformance("CiA 406", "pole wheel: teeth")
def test_a_missing_tooth_is_a_pulse_less_in_each_turn():
    speeds = np.full(1000, 62.8)
    _, all_of_them, _, angle = drive(speeds)
    _, pulses, _, _ = drive(speeds, faults=[(effects.MISSING_TEETH, 3.0)])
    turns = angle[-1] / (2 * np.pi)
    assert all_of_them[-1] - pulses[-1] == pytest.approx(3 * turns, abs=3)


def test_a_seed_repeats_the_noise_of_a_burst():
    noisy = [(effects.NOISE_rad_s, 2.0)]
    first, second = (drive(np.full(4000, 50.0), "ideal", faults=noisy)[0] for _ in range(2))
    assert np.array_equal(first, second)
    assert first.std() == pytest.approx(2.0, rel=0.1)
    assert first.mean() == pytest.approx(50.0, abs=0.2)
    assert np.abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.06
