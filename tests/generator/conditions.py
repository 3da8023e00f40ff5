"""Realistic conditions in which stops are measured while nothing is wrong with the model.

The generators of stops have ideal sensors, a brake of one calibration error and a smooth rail.
With `Conditions` they have wheel speeds from pulses, pads whose friction varies a little, and a
rail that is rougher and the same under all wheelsets and in all runs. None of these is a fault.
"""

from typing import NamedTuple

import numpy as np

# fewest and most teeth of a pole wheel
TEETH = (80, 128)
# resolution of the clock that times the pulses, s
CLOCK_S = 2e-6
# a wheel without a pulse for this time stands still, s
STANDSTILL_S = 0.5
# in how many seconds the friction of the pads swings once, and the speed about which it turns, m/s
PAD_PERIOD_S = (18.0, 40.0)
PAD_SPEED_M_S = 20.0


class Conditions(NamedTuple):
    """What differs from ideal sensors, an even brake and a smooth rail."""

    # "" ideal; "counted": the pulses in each sample; "timed": the whole periods in each sample;
    # "last period": the time between the last two pulses
    sensor: str = ""
    # "" even; "time", "speed": pad friction varies with it; "run": from run to run
    brake: str = ""
    brake_variation: float = 0.006  # largest change of the torque, as a share
    rail_deviation: float = 0.0  # of the friction along the rail; 0: that of the generator
    rail_is_shared: bool = False  # by all wheelsets and runs; otherwise half of the variance is


# kinds of fault-free sets, by the names in the table of rates
KINDS = {
    "ideal": Conditions(),
    "pulses counted": Conditions(sensor="counted"),
    "pulses timed": Conditions(sensor="timed"),
    "last pulse period": Conditions(sensor="last period"),
    "brake by time": Conditions(brake="time"),
    "brake by speed": Conditions(brake="speed"),
    "brake by run": Conditions(brake="run"),
    "rough rail": Conditions(rail_deviation=0.045),
    "rough shared rail": Conditions(rail_deviation=0.045, rail_is_shared=True),
    "all together": Conditions(
        sensor="timed", brake="time", rail_deviation=0.035, rail_is_shared=True
    ),
}


def rail_deviations(conditions: Conditions, of_generator: float) -> tuple[float, float]:
    """Return the deviation of the friction of the rail, and that which each wheelset adds.

    `of_generator` is that of each of them in ideal conditions.
    """
    if not conditions.rail_deviation:
        return of_generator, of_generator
    if conditions.rail_is_shared:
        return conditions.rail_deviation, 0.0
    each = conditions.rail_deviation / np.sqrt(2.0)
    return each, each


class PadVariation(NamedTuple):
    """How the torque that acts differs from the recorded one, of each wheelset of one run."""

    constant: np.ndarray  # (4,)
    by_time: np.ndarray  # (4,) size of a swing
    by_speed: np.ndarray  # (4,) at a speed of 0, and the opposite at twice PAD_SPEED_M_S
    period_s: float
    phase: float  # of the swing, rad


def pad_variation(conditions: Conditions, seed: int, run: int) -> PadVariation:
    """Return the variation of the pads in one run; zeros for an even brake.

    Pads of one make vary in the same direction, and each by another amount.
    """
    of_set = np.random.default_rng((seed, 81))
    direction = of_set.choice([-1.0, 1.0])
    amounts = direction * conditions.brake_variation * of_set.uniform(0.3, 1.0, 4)
    period_s = of_set.uniform(*PAD_PERIOD_S)
    phase = of_set.uniform(0.0, 2.0 * np.pi)
    of_run = np.random.default_rng((seed, 82, run))
    in_run = conditions.brake_variation * of_run.uniform(-1.0, 1.0, 4)
    none = np.zeros(4)
    return PadVariation(
        constant=in_run if conditions.brake == "run" else none,
        by_time=amounts if conditions.brake == "time" else none,
        by_speed=amounts if conditions.brake == "speed" else none,
        period_s=period_s,
        phase=phase,
    )


# --- pole wheels ---


class PoleWheels(NamedTuple):
    """The pole wheels of four wheelsets."""

    teeth: int
    phase: np.ndarray  # (4,) angle of the first tooth over the pitch of the teeth


def pole_wheels(seed: int, run: int) -> PoleWheels:
    """Return the pole wheels of a set. They begin each run at another angle."""
    teeth = int(np.random.default_rng((seed, 83)).integers(TEETH[0], TEETH[1] + 1))
    return PoleWheels(teeth, np.random.default_rng((seed, 84, run)).uniform(size=4))


def wheel_speeds(
    conditions: Conditions,
    time_s: np.ndarray,
    spins_rad_s: np.ndarray,
    samples_s: np.ndarray,
    wheels: PoleWheels,
) -> np.ndarray:
    """Return wheel speeds from pulses in rad/s, shape (samples, 4).

    `spins_rad_s` (n, 4) are the true speeds at the times `time_s` (n,), and `samples_s` the times
    of the samples. The wheels roll before the first time as they do there.
    """
    sample_s = float(samples_s[1] - samples_s[0])
    before_s = 2.0 * sample_s
    step_s = np.diff(time_s, prepend=time_s[0] - before_s)
    measured = []
    for spin, phase in zip(spins_rad_s.T, wheels.phase, strict=True):
        spin = np.maximum(spin, 1e-6)
        mean = 0.5 * (spin + np.concatenate([spin[:1], spin[:-1]]))
        turned = np.concatenate([[0.0], np.cumsum(mean * step_s)])
        at_s = np.concatenate([[time_s[0] - before_s], time_s])
        pulses = turned * wheels.teeth / (2.0 * np.pi) + phase
        numbers = np.arange(np.floor(pulses[-1]) + 1.0)[1:]
        pulses_s = np.floor(np.interp(numbers, pulses, at_s) / CLOCK_S) * CLOCK_S
        speed = _pulses_per_second(conditions.sensor, pulses_s, samples_s, sample_s)
        measured.append(speed * 2.0 * np.pi / wheels.teeth)
    return np.column_stack(measured)


def _pulses_per_second(
    sensor: str, pulses_s: np.ndarray, samples_s: np.ndarray, sample_s: float
) -> np.ndarray:
    """Return what a sensor makes of the times of its pulses, at each sample."""
    seen = np.searchsorted(pulses_s, samples_s, side="right")
    seen_before = np.searchsorted(pulses_s, samples_s - sample_s, side="right")
    if sensor == "counted":
        return (seen - seen_before) / sample_s

    last = np.clip(seen - 1, 1, len(pulses_s) - 1)
    first = last - 1
    if sensor == "timed":
        # from the last pulse before the sample to the last one in it; a period if there is none
        first = np.clip(np.minimum(seen_before - 1, first), 0, None)
    periods_s = pulses_s[last] - pulses_s[first]
    rate = (last - first) / np.maximum(periods_s, CLOCK_S)
    # no pulse for longer than the last period: the wheel is slower than that
    waited_s = samples_s - pulses_s[last]
    rate = np.minimum(rate, 1.0 / np.maximum(waited_s, CLOCK_S))
    return np.where(waited_s > STANDSTILL_S, 0.0, rate)
