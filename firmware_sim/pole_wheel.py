"""The speed sensors: a pole wheel on each axle, and the unit that measures speed from its pulses.

Each tooth that passes gives a pulse, and a timer measures its time. At the end of each window the
unit computes the speed from the pulses since the last window [P1]. Without a pulse the speed must
be lower than one tooth in the time that has passed [P2]; after a while it is zero. Below a certain
speed the voltage of the sensor is too small, and there are no pulses. The model "ideal" gives the
speed of the wheel itself.

    [P1] omega = (2 pi / n) N / (t_N - t_0), t_N and t_0 the times of the latest pulses of this
         window and of the one before with pulses, N the pulses between them
    [P2] omega <= (2 pi / n) / (t - t_0)

Faults of sensors act here, between the wheel and the values that the rig publishes. A missing tooth
always acts through the pulses. The noise is the sum of twelve uniform numbers of Park and Miller's
minimal generator (1988), so a seed repeats it. Limits: the pulses within a tick are evenly spaced.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim.faults import effects as faulty
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.wsp_interface import signals

IDEAL = 0
POLE_WHEEL = 1
MODELS = {"ideal": IDEAL, "pole_wheel": POLE_WHEEL}
# rows of the memory, float64 of shape (MEMORY, 4), one column an axle
CLOCK = 0  # ticks so far; only the first column is used
COUNT = 1  # teeth passed
MISSED = 2  # teeth that gave no pulse
RECENT = 3  # pulses since BEGIN_s
EDGE_s = 4  # time of the latest pulse
BEGIN_s = 5  # time of the pulse with which the measurement began; negative: none
READING = 6  # measured speed in rad/s
RANDOM = 7  # state of the random generator
DRIFTED = 8  # how far a faulty measurement has drifted: measured over true speed, less 1
MEMORY = 9  # number of rows

SILENCE_S = 0.25  # without a pulse for this long the speed is zero
# the minimal generator: x' = factor x mod modulus
_MODULUS = 2147483647.0
_FACTOR = 16807.0
_SUMMANDS = 12  # uniform numbers in a normal one

_SPEED = signals.column("wheel_speed")
_ANGLE = signals.column("wheel_angle")
_MEASURED = signals.column("measured_speed")
_FREQUENCY = signals.column("tooth_frequency")
_PULSES = signals.column("pulse_count")
_FLAT = signals.column("flat_length")
# the signals of a row that only this file writes
COLUMNS = frozenset(("measured_speed", "tooth_frequency", "pulse_count"))


class Sensor(NamedTuple):
    """Constants of the pole wheels and their unit.

    `dropout_rad_s`: speed below which there are no pulses. `flat_noise_rad_s_m`: standard deviation
    that each metre of a wheel flat adds to the speed of a turning wheel. `noise_rad_s`: that of a
    round wheel.
    """

    model: int
    teeth: int
    window_ticks: int
    dropout_rad_s: float
    timer_Hz: float
    tick_s: float
    flat_noise_rad_s_m: float = 0.0
    noise_rad_s: float = 0.0


def memory(seed: int, axles: int) -> np.ndarray:
    """The memory of the sensors of all axles before the first tick, shape (MEMORY, axles)."""
    new = np.zeros((MEMORY, axles))
    # another sequence of the generator for each axle and seed; never 0, which it would repeat
    new[RANDOM] = [1 + (7919 * seed + 104729 * axle) % 2147483646 for axle in range(1, axles + 1)]
    return new


@kernel
def sense(row, memory, sensor, faults):
    """Write measured speeds, tooth frequencies and pulse counters of this tick into a row."""
    memory[CLOCK, 0] += 1.0
    axles = memory.shape[1]
    for j in range(axles):
        count_teeth(row[_SPEED + j], row[_ANGLE + j], j, memory, sensor, faults)
    for j in range(axles):
        if faulty.value(faults, faulty.STUCK, j) != 0.0:
            continue
        wheel = j
        if faulty.value(faults, faulty.SOURCE, j) != 0.0:
            wheel = int(faulty.value(faults, faulty.SOURCE, j)) - 1
        speed = reading(row[_SPEED + wheel], wheel, memory, sensor, faults)
        if faulty.value(faults, faulty.NOISE_rad_s, j) != 0.0:
            speed += faulty.value(faults, faulty.NOISE_rad_s, j) * noise(memory, j)
        speed = drifting(speed, j, memory, sensor, faults)
        deviation = np.hypot(sensor.noise_rad_s, sensor.flat_noise_rad_s_m * row[_FLAT + wheel])
        # a sensor without pulses has no noise
        if deviation > 0.0 and speed > 0.0 and row[_SPEED + wheel] > 0.0:
            speed = max(0.0, speed + deviation * noise(memory, j))
        row[_MEASURED + j] = speed
        row[_FREQUENCY + j] = speed * (sensor.teeth / (2.0 * np.pi))
        row[_PULSES + j] = np.floor(memory[COUNT, wheel] - memory[MISSED, wheel])


@kernel
def reading(speed, j, memory, sensor, faults):
    """The speed in rad/s that the sensor of wheel j measures."""
    if faulty.value(faults, faulty.DROPOUT, j) != 0.0:
        return 0.0
    if sensor.model != IDEAL or faulty.value(faults, faulty.MISSING_TEETH, j) != 0.0:
        speed = memory[READING, j]
    larger = faulty.value(faults, faulty.LARGER, j)
    if larger != 0.0:
        speed /= 1.0 + larger
    return speed


@kernel
def drifting(speed, j, memory, sensor, faults):
    """Return the speed that a sensor with a step and a drift in its gain gives for axle j."""
    step = faulty.value(faults, faulty.STEP, j)
    rate_per_s = faulty.value(faults, faulty.DRIFT_per_s, j)
    if step == 0.0 and rate_per_s == 0.0:
        memory[DRIFTED, j] = 0.0
        return speed
    gain = max(0.0, 1.0 + step + memory[DRIFTED, j])
    memory[DRIFTED, j] += rate_per_s * sensor.tick_s
    return speed * gain


@kernel
def count_teeth(speed, angle, j, memory, sensor, faults):
    """Count the pulses of a tick on wheel j, and measure at the end of a window."""
    passed = angle * (sensor.teeth / (2.0 * np.pi))  # teeth, with the fraction of the next one
    count = np.floor(passed)
    rate = abs(speed) * sensor.teeth / (2.0 * np.pi)  # teeth a second
    now_s = memory[CLOCK, 0] * sensor.tick_s
    new = int(count - memory[COUNT, j])
    memory[COUNT, j] = count
    if memory[CLOCK, 0] == 1.0 or new < 0 or new > sensor.teeth:
        # switched on, or the angle of the wheel has been set: begin a new measurement here
        memory[READING, j] = speed
        memory[RECENT, j] = 0.0
        memory[BEGIN_s, j] = now_s - (passed - count) / max(rate, 1.0)
        return
    pulses, last = pulses_of(int(count), new, j, sensor, faults)
    too_slow = sensor.model != IDEAL and abs(speed) < sensor.dropout_rad_s
    if too_slow or faulty.value(faults, faulty.DROPOUT, j) != 0.0:
        pulses = 0
    larger = faulty.value(faults, faulty.LARGER, j)
    memory[MISSED, j] += new - pulses / (1.0 + larger)
    if pulses > 0:
        edge_s = now_s - min((passed - last) / max(rate, 1e-9), sensor.tick_s)
        memory[EDGE_s, j] = np.floor(edge_s * sensor.timer_Hz) / sensor.timer_Hz
        memory[RECENT, j] += pulses
    if memory[CLOCK, 0] % sensor.window_ticks == 0.0:
        measure(j, now_s, memory, sensor)


@kernel
def pulses_of(count, new, j, sensor, faults):
    """How many of the last `new` teeth gave a pulse, and the number of the latest of these."""
    gone = int(faulty.value(faults, faulty.MISSING_TEETH, j))
    if gone == 0:
        return new, count
    pulses = 0
    last = count
    for tooth in range(count - new + 1, count + 1):
        if tooth % sensor.teeth >= gone:
            pulses += 1
            last = tooth
    return pulses, last


@kernel
def measure(j, now_s, memory, sensor):
    """End a window of wheel j: speed from pulses [P1], or its bound without a pulse [P2]."""
    pitch = 2.0 * np.pi / sensor.teeth
    begun = memory[BEGIN_s, j] >= 0.0
    if memory[RECENT, j] > 0.0:
        took_s = memory[EDGE_s, j] - memory[BEGIN_s, j]
        if begun and took_s > 0.0:
            memory[READING, j] = pitch * memory[RECENT, j] / took_s  # [P1]
        memory[BEGIN_s, j] = memory[EDGE_s, j]
        memory[RECENT, j] = 0.0
    elif begun:
        silent_s = now_s - memory[BEGIN_s, j]
        if silent_s > SILENCE_S:
            memory[READING, j] = 0.0
            memory[BEGIN_s, j] = -1.0
        elif silent_s > 0.0:
            memory[READING, j] = min(memory[READING, j], pitch / silent_s)  # [P2]


@kernel
def noise(memory, j):
    """The next normally distributed number of axle j: mean 0, standard deviation 1."""
    total = -0.5 * _SUMMANDS
    for _ in range(_SUMMANDS):
        memory[RANDOM, j] = (_FACTOR * memory[RANDOM, j]) % _MODULUS
        total += memory[RANDOM, j] / _MODULUS
    return total
