"""Recognises wheel speeds that a sensor makes from the pulses of a pole wheel.

Such a speed belongs to an earlier time: to the middle of the window in which pulses are counted,
or of the periods that are timed. Its error is no white noise either. A counted pulse more in one
sample is a pulse less in the next one, and the error of a timed period grows with the square of the
speed.

    [D1] counted: omega = 2 pi n / (teeth window), so all values are multiples of a quantum, and the
         differences of neighbouring samples have a correlation of -2/3 (white noise: -1/2)
    [D2] timed: the error is omega^2 tick / (2 pi periods) by the clock, and d omega/dt times the
         age of the last pulse
    [D3] late by `late_window` step + `late_pulse` / omega
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.data.runs import Run
from rollerrig.rig.identify.data.smoothing import smoothed

# --- thresholds of the recognition; the reasons are in docs/explain_causes.md ---

# a counted channel has at most this share of different values
MOST_VALUES = 0.1
# Largest correlation of neighbouring differences of a counted channel: -0.67 by [D1], while
# rounded white noise has -0.5.
MOST_CORRELATION = -0.57
# Least ratio of the noise in the fastest third to that in the slowest third of a timed channel: at
# most 1.2 with white noise, at least 2.5 with a clock of 2 microseconds.
LEAST_GROWTH = 1.6
# A channel with less noise than this share of its largest value has no white noise.
LEAST_NOISE_SHARE = 2e-4

# Deviation of white noise over the median of its absolute third differences, which have 20 times
# its variance.
_OF_MEDIAN = 1.0 / (0.6745 * np.sqrt(20.0))

# --- what is assumed of a pole wheel that nobody describes ---

PITCH_RAD = 2.0 * np.pi / 100.0  # angle between teeth: 80 to 128 teeth are usual
_PITCHES_RAD = (2.0 * np.pi / 160.0, 2.0 * np.pi / 60.0)
LEAST_SPEED_RAD_S = 5.0  # slower wheels have too few pulses for [D2]
LEAST_NOISE_RAD_S = 0.02  # of a timed channel: irregular teeth and the clock of the recorder
RATE_WINDOW = 21  # samples over which d omega/dt is taken


class Sensor(StrEnum):
    """The kind of a wheel speed sensor."""

    DIRECT = "direct"  # white noise
    COUNTED = "counted"  # pulses in a window of one sample
    TIMED = "timed"  # periods of pulses


class PulseSensor(NamedTuple):
    """How the wheel speeds of a dataset were measured."""

    kind: Sensor
    quantum_rad_s: float = 0.0  # step of a counted speed
    # of a timed speed, in the fastest third of the samples: noise, and mean speed
    fast_noise_rad_s: float = 0.0
    fast_rad_s: float = 0.0

    @property
    def is_pulses(self) -> bool:
        return self.kind is not Sensor.DIRECT


def recognise(runs: list[Run]) -> PulseSensor:
    """Return the sensor of the wheel speeds of some runs: the kind that most channels show."""
    kinds = []
    quanta = []
    for run in runs:
        for values in run.wheel_speed_rad_s.T:
            quantum_rad_s = counted_quantum(values)
            if quantum_rad_s > 0.0:
                kinds.append(Sensor.COUNTED)
                quanta.append(quantum_rad_s)
            elif is_timed(values):
                kinds.append(Sensor.TIMED)
            else:
                kinds.append(Sensor.DIRECT)
    most = max(Sensor, key=kinds.count)
    if most is Sensor.COUNTED:
        return PulseSensor(most, float(np.median(quanta)))
    if most is Sensor.TIMED:
        fast = [_noise_of_fast(values) for run in runs for values in run.wheel_speed_rad_s.T]
        noise_rad_s, speed_rad_s = np.median(fast, axis=0)
        return PulseSensor(most, fast_noise_rad_s=float(noise_rad_s), fast_rad_s=float(speed_rad_s))
    return PulseSensor(most)


def _noise_of_fast(values: np.ndarray) -> tuple[float, float]:
    """Return noise and mean speed of the fastest third of a channel's samples, both in rad/s."""
    at = values[3:]
    is_fast = at >= np.quantile(at, 2.0 / 3.0)
    third = np.abs(np.diff(values, n=3))[is_fast]
    return float(np.median(third)) * _OF_MEDIAN, float(at[is_fast].mean())


def counted_quantum(values: np.ndarray) -> float:
    """Return the step of a channel of counted pulses [D1], 0 for any other channel."""
    different = np.unique(np.round(values, 6))
    if different.size < 3 or different.size > MOST_VALUES * values.size:
        return 0.0
    steps = np.diff(values)
    power = float(np.mean(steps * steps))
    if power == 0.0 or np.mean(steps[1:] * steps[:-1]) > MOST_CORRELATION * power:
        return 0.0
    return float(np.median(np.diff(different)))


def is_timed(values: np.ndarray) -> bool:
    """Return whether a channel has the noise of timed pulses [D2]."""
    slow, fast = np.quantile(values, [1.0 / 3.0, 2.0 / 3.0])
    third = np.abs(np.diff(values, n=3))
    at = values[3:]
    of_slow = float(np.median(third[at < slow])) if np.any(at < slow) else 0.0
    of_fast = float(np.median(third[at > fast])) if np.any(at > fast) else 0.0
    if slow > 0.0 and of_fast > LEAST_GROWTH * of_slow:
        return True
    return noise(values) < LEAST_NOISE_SHARE * float(values.max())


def noise(values: np.ndarray) -> float:
    """Return the deviation of the noise of a channel, the root mean square over its speeds."""
    third = np.abs(np.diff(values, n=3))
    order = np.argsort(values[3:])
    medians = [float(np.median(part)) for part in np.array_split(third[order], 5)]
    return float(np.sqrt(np.mean(np.square(medians)))) * _OF_MEDIAN


def noise_of_pulses(sensor: PulseSensor, run: Run, step_s: float) -> float:
    """Return the deviation of the error of wheel speeds from pulses in rad/s."""
    if sensor.kind is Sensor.COUNTED:
        # the difference of two uniform errors of the angle
        return sensor.quantum_rad_s / np.sqrt(6.0)
    of_channels = [noise(values) for values in run.wheel_speed_rad_s.T]
    window = min(RATE_WINDOW, run.time_s.size - 1 + run.time_s.size % 2)
    rate_rad_s2 = smoothed(run.wheel_speed_rad_s, window, order=2, derivative=1, step=step_s)
    speed_rad_s = np.maximum(run.wheel_speed_rad_s, LEAST_SPEED_RAD_S)
    # the age of the last pulse is anything up to a period
    by_age = rate_rad_s2 * PITCH_RAD / speed_rad_s / np.sqrt(12.0)
    squares = np.mean(np.square(of_channels)) + np.mean(by_age * by_age)
    return float(np.sqrt(squares + LEAST_NOISE_RAD_S**2))


# --- how late such a speed is [D3] ---

# mean of both parts, and their standard deviations, as shares of a step and in rad
LATE_WINDOW = 0.25
LATE_WINDOW_DEVIATION = 0.25
LATE_PULSE_RAD = 0.05
LATE_PULSE_DEVIATION_RAD = 0.03


def late_s(
    step_s: float, wheel_rad_s: np.ndarray, late_window: float, late_pulse: float
) -> np.ndarray:
    """Return how late a speed from pulses is [D3]; both parts are given less their means."""
    turning_rad_s = np.maximum(wheel_rad_s, LEAST_SPEED_RAD_S)
    return step_s * (LATE_WINDOW + late_window) + (LATE_PULSE_RAD + late_pulse) / turning_rad_s


def delayed(values: np.ndarray, by_steps: np.ndarray) -> np.ndarray:
    """Return values(t - by) of one channel; both have the shape (n,), and n is at least 4.

    Cubic polynomials through four samples are used, because straight lines would reduce the noise.
    """
    n = values.size
    place = np.clip(np.arange(n) - by_steps, 0.0, n - 1.0)
    k = np.clip(place.astype(int), 1, n - 3)
    x = place - k
    before, here, after, far = (values[k + step] for step in (-1, 0, 1, 2))
    return (
        -x * (x - 1.0) * (x - 2.0) / 6.0 * before
        + (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0 * here
        - (x + 1.0) * x * (x - 2.0) / 2.0 * after
        + (x + 1.0) * x * (x - 1.0) / 6.0 * far
    )


def counted(wheel_rad_s: np.ndarray, quantum_rad_s: float, rng: np.random.Generator) -> np.ndarray:
    """Return what a sensor that counts pulses in each sample shows [D1], shape (n, wheels)."""
    # angle in pulses, which the speed changes by its quotient to the quantum in a sample
    steps = wheel_rad_s / quantum_rad_s
    steps = 0.5 * (steps + np.concatenate([steps[:1], steps[:-1]]))
    before = rng.uniform(size=(1, wheel_rad_s.shape[1]))
    angle = np.concatenate([before, before + np.cumsum(steps, axis=0)])
    return np.diff(np.floor(angle), axis=0) * quantum_rad_s


# Samples are divided into so many parts for the times of pulses.
_PARTS = 8
# A sensor times the periods of a whole sample if its speeds are late by more than this share of a
# step, less the mean of [D3]; otherwise it times the last period.
_LATE_OF_WINDOW = 0.3 - LATE_WINDOW


def timed(
    sensor: PulseSensor,
    wheel_rad_s: np.ndarray,
    step_s: float,
    late_window: float,
    late_pulse: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return what a sensor that times its pulses shows [D2], shape (n, wheels).

    Pitch and window are those by which the speeds of the recording are late [D3].
    """
    has_window = late_window > _LATE_OF_WINDOW
    # the last pulse is half a period old in the mean; a last period is half a period longer
    pitch_rad = (LATE_PULSE_RAD + late_pulse) * (2.0 if has_window else 1.0)
    pitch_rad = float(np.clip(pitch_rad, *_PITCHES_RAD))
    # clock by the noise: of a last period it grows with the square of the speed
    tick_s = np.sqrt(6.0) * sensor.fast_noise_rad_s / max(sensor.fast_rad_s, LEAST_SPEED_RAD_S)
    tick_s *= step_s if has_window else pitch_rad / max(sensor.fast_rad_s, LEAST_SPEED_RAD_S)
    tick_s = max(tick_s, 1e-9)

    n = len(wheel_rad_s)
    at_s = step_s * np.arange(n)
    fine_s = step_s * np.arange(-2 * _PARTS, (n - 1) * _PARTS + 1) / _PARTS
    out = np.empty_like(wheel_rad_s)
    for wheel in range(wheel_rad_s.shape[1]):
        speed = np.maximum(np.interp(fine_s, at_s, wheel_rad_s[:, wheel]), 1e-6)
        steps = 0.5 * (speed[1:] + speed[:-1]) * step_s / _PARTS / pitch_rad
        turned = np.concatenate([[0.0], np.cumsum(steps)]) + rng.uniform()
        numbers = np.arange(1.0, np.floor(turned[-1]) + 1.0)
        pulses_s = np.floor(np.interp(numbers, turned, fine_s) / tick_s) * tick_s
        last = np.clip(np.searchsorted(pulses_s, at_s, side="right") - 1, 1, numbers.size - 1)
        first = last - 1
        if has_window:
            seen_before = np.searchsorted(pulses_s, at_s - step_s, side="right") - 1
            first = np.clip(np.minimum(seen_before, first), 0, None)
        periods_s = np.maximum(pulses_s[last] - pulses_s[first], tick_s)
        waited_s = np.maximum(at_s - pulses_s[last], tick_s)
        out[:, wheel] = pitch_rad * np.minimum((last - first) / periods_s, 1.0 / waited_s)
    return out
