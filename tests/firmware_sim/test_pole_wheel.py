"""The speed sensors: the pulses of a pole wheel, and the speed that is measured from them."""

from typing import NamedTuple

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.faults import effects
from rollerrig.wsp_interface import signals

TICK_S = 0.001
TEETH = 100
WINDOW = 10  # ticks
# columns of axle 1
SPEED = signals.column("wheel_speed")
ANGLE = signals.column("wheel_angle")
MEASURED = signals.column("measured_speed")
PULSES = signals.column("pulse_count")
FREQUENCY = signals.column("tooth_frequency")


class Samples(NamedTuple):
    """Signals of axle 1, one value a tick."""

    measured: np.ndarray
    pulses: np.ndarray
    frequency: np.ndarray
    angle: np.ndarray


def turn(speeds, model="pole_wheel", timer_Hz=1e6, dropout_rad_s=1.0, faults=(), noise_rad_s=0.0):
    """Return the samples of an axle that turns with speeds in rad/s, one a tick.

    `faults`: pairs of an effect and its value.
    """
    sensor = pole_wheel.Sensor(
        model=pole_wheel.MODELS[model],
        teeth=TEETH,
        window_ticks=WINDOW,
        dropout_rad_s=dropout_rad_s,
        timer_Hz=timer_Hz,
        tick_s=TICK_S,
        noise_rad_s=noise_rad_s,
    )
    row = np.zeros(signals.WIDTH)
    memory = pole_wheel.memory(1, COACH.axles)
    active_faults = np.zeros(effects.SIZE)
    for kind, value in faults:
        active_faults[effects.slot(kind, 1)] = value
    samples = []
    for speed in speeds:
        row[SPEED] = speed
        row[ANGLE] += speed * TICK_S
        pole_wheel.sense(row, memory, sensor, active_faults)
        samples.append((row[MEASURED], row[PULSES], row[FREQUENCY], row[ANGLE]))
    return Samples(*np.array(samples).T)


def test_the_ideal_sensor_gives_the_speed_of_the_wheel_and_counts_its_teeth():
    speeds = np.linspace(90.0, 0.0, 500)
    samples = turn(speeds, "ideal")
    assert np.array_equal(samples.measured, speeds)
    assert samples.frequency == pytest.approx(speeds * TEETH / (2 * np.pi))
    assert np.array_equal(samples.pulses, np.floor(samples.angle * (TEETH / (2.0 * np.pi))))


@pytest.mark.conformance("CiA 406", "pole wheel: quantised pulses")
@pytest.mark.parametrize("speed", [3.0, 17.3, 95.1])
def test_a_constant_speed_is_measured_within_the_resolution_of_the_timer(speed):
    timer_Hz = 1e5
    measured = turn(np.full(600, speed), timer_Hz=timer_Hz).measured
    # each of two edges may be one count of the timer early, in a window of at least one tooth
    pitch_s = 2 * np.pi / TEETH / speed
    window_s = max(pitch_s, 0.5 * WINDOW * TICK_S)
    assert measured[100:] == pytest.approx(speed, rel=2 / timer_Hz / window_s)
    assert len(set(measured[100:])) > 1


def test_the_measured_speed_changes_once_in_a_window():
    measured = turn(np.linspace(90.0, 60.0, 500)).measured
    changed = np.flatnonzero(np.diff(measured)) + 1
    assert set((changed + 1) % WINDOW) == {0}


def test_the_measured_speed_lags_a_braking_wheel_by_about_half_a_window():
    rate_rad_s2 = -30.0
    speeds = 90.0 + rate_rad_s2 * TICK_S * np.arange(1000)
    measured = turn(speeds).measured
    ends = np.arange(5 * WINDOW - 1, 1000, WINDOW)  # of windows
    lag_s = (speeds[ends] - measured[ends]) / rate_rad_s2
    assert lag_s.mean() == pytest.approx(0.5 * WINDOW * TICK_S, rel=0.3)


@pytest.mark.conformance("CiA 406", "pole wheel: low-speed drop-out")
def test_below_its_dropout_speed_the_sensor_gives_no_pulses_and_the_speed_falls_to_zero():
    speeds = np.concatenate([np.full(500, 10.0), np.full(600, 0.9)])
    samples = turn(speeds)
    assert np.ptp(samples.pulses[500:]) <= 1
    measured = samples.measured
    assert (np.diff(measured[500:]) <= 0).all()
    # without a pulse the speed is lower than a tooth in the time that has passed
    assert measured[560] <= 2 * np.pi / TEETH / 0.05
    assert measured[-1] == 0.0


def test_a_slow_wheel_above_the_dropout_speed_is_measured_between_its_rare_pulses():
    measured = turn(np.full(2000, 1.5)).measured
    assert measured[500:] == pytest.approx(1.5, rel=0.01)


def test_a_wheel_that_starts_again_is_measured_again():
    measured = turn(np.concatenate([np.full(300, 0.0), np.full(300, 20.0)])).measured
    assert measured[299] == 0.0
    assert measured[-1] == pytest.approx(20.0, rel=0.01)


@pytest.mark.conformance("CiA 406", "pole wheel: teeth")
def test_a_missing_tooth_is_a_missing_pulse_in_each_turn():
    speeds = np.full(1000, 62.8)
    whole = turn(speeds)
    damaged = turn(speeds, faults=[(effects.MISSING_TEETH, 3.0)])
    turns = whole.angle[-1] / (2 * np.pi)
    assert whole.pulses[-1] - damaged.pulses[-1] == pytest.approx(3 * turns, abs=3)


def test_a_seed_repeats_the_noise_of_a_burst():
    noise = [(effects.NOISE_rad_s, 2.0)]
    speeds = np.full(4000, 50.0)
    first = turn(speeds, "ideal", faults=noise).measured
    second = turn(speeds, "ideal", faults=noise).measured
    assert np.array_equal(first, second)
    assert first.std() == pytest.approx(2.0, rel=0.1)
    assert first.mean() == pytest.approx(50.0, abs=0.2)
    correlation = np.corrcoef(first[1:], first[:-1])[0, 1]
    assert np.abs(correlation) < 0.06


def test_noise_of_the_sensor_has_its_deviation_and_no_mean_and_none_at_standstill():
    deviation = 0.2
    speeds = np.concatenate([np.full(4000, 50.0), np.zeros(200)])
    measured = turn(speeds, "ideal", noise_rad_s=deviation).measured
    error = measured[:4000] - 50.0
    assert error.std() == pytest.approx(deviation, rel=0.05)
    # the mean of 4000 numbers is within four of its deviations
    assert abs(error.mean()) < 4.0 * deviation / np.sqrt(4000)
    assert not measured[4000:].any()
