"""Every threshold by which a recording is judged, with its unit, its reason and what it was set on.

The table in docs/recorders.md repeats values and reasons; a test compares the two. Values are set
by hand from what the channels can do. "Twins" are simulated recordings of runs of the bench.

Limits that depend on the sample rate, the rounding or the noise of a channel are functions at the
end of this file. Their arguments are in SI units.
"""

import math

import numpy as np

# --- stamps and sensors ---

# s. Samples further apart are a gap. Shorter intervals are lost messages.
GAP_S = 1.0

# s. A smaller irregularity of the stamps is a late message.
LEAST_STEP_S = 0.3

# standard errors. Speed or position must contradict a gap by this much to make it a clock step.
# Chosen.
CLOCK_RATIO = 4.0

# share of its slope by which the motion before and after a clock step may differ. Chosen.
CLOCK_SLOPE_SHARE = 0.5

# share of the change of a short gap. The value must jump less at a clock step. Chosen.
CLOCK_JUMP_SHARE = 0.25

# s. Samples on each side of a jump of the stamps. A vehicle keeps its curvature for as long; at low
# rates they are too few to show a clock step. Chosen.
CLOCK_SIDE_S = 4.0

# share of the error at equal rates. At another rate of the clock less must be left. Chosen.
RATE_SHARE = 0.25

# s. A fast or slow clock must shift the reference by so much from the start to the end: ten times
# the smallest delay at 10 Hz and above. Chosen.
LEAST_DRIFT_S = 1.5

# share of the error of the best delay. A fast or slow clock must leave less. Chosen.
DRIFT_SHARE = 0.6

# long intervals without a change. Fewer do not show that a recorder logs on change.
CHANGE_INTERVALS = 10

# s. Old messages are searched for in this time after the start. In recordings of trams they lasted
# 2 to 6 s.
START_S = 15.0

# m/s^2. Least value of the hardest braking, where dataset.toml gives none. Emergency brakes of
# trams with track brakes reach 2.7.
HARDEST_M_S2 = 3.0

# factor between the hardest change that the channels agree on and the hardest possible one. Chosen.
HARDEST_FACTOR = 1.25

# multiples of the hardest braking. A braked wheel changes its speed less. Wheels of cars lock with
# about 100 m/s^2, railway wheelsets with about 30.
WHEEL_FACTOR = 10.0

# m/s^2. What a vehicle may gain while its wheels slide in braking: 30 per mille downhill. Set on
# twins.
DRIVES_M_S2 = 0.3

# m/s. A larger change between two samples, beyond the hardest braking, cannot be vehicle motion.
# Noise and rounding stay below.
JUMP_M_S = 1.0

# m/s. A wheel does not lock, or take up speed again, by this much between two samples.
ZERO_JUMP_M_S = 2.0

# multiples of the usual change between two samples. A larger one is a jump. Chosen.
JUMP_FACTOR = 3.0

# s and samples. A value that is held for longer, while the other channels move, is stuck. At low
# rates a vehicle that is compared at the wrong time may keep its speed for a few samples. Chosen.
STUCK_S = 1.0
STUCK_SAMPLES = 4.0

# s. The same where a recorder logs only changes: held values are normal there. Set on a van whose
# speed has steps of 1 km/h.
STUCK_ON_CHANGE_S = 5.0

# m/s. The other channels must move by this much while a value is held. That is many rounding steps.
# For slow vehicles it is less; see `moved_m_s`.
MOVED_M_S = 1.0

# s. Shorter straight stretches occur by chance.
LINE_S = 2.0

# share of the channel's usual roughness. A stretch below it is drawn, not measured. Chosen.
LINE_SHARE = 0.05

# samples. Length of the equal stretches that are searched for.
COPY_SAMPLES = 50

# samples out of COPY_SAMPLES that must differ from the previous one. Standing still repeats, moving
# does not.
COPY_CHANGES = 20

# changes of a speed. If another speed makes all of them in the same samples, it is a copy. Chosen.
EQUAL_CHANGES = 200

# the same changes of a speed whose noise is larger than its rounding step. Chosen.
EQUAL_CHANGES_FINE = 50

# share. A ratio this close to the ratio of two units is a wrong unit. The nearest two ratios differ
# by 0.28.
UNIT_SHARE = 0.06

# share of the samples in motion that must have the ratio of two units. A wheel that slips has
# different ratios. Chosen.
UNIT_STEADY = 0.8

# share. Samples this close to a ratio of m/s and km/h or mph have it: speeds that are compared at
# the wrong time differ as much. The nearest two ratios differ by 0.28. Chosen.
UNIT_WIDE_SHARE = 0.14

# bits. Equal samples that carry less information are equal by chance. Chosen.
COPY_BITS = 60.0

# --- comparison of channels ---

# s. Means over blocks of this length count as independent. Receiver noise and slides are shorter.
BLOCK_S = 5.0

# s. Shortest blocks, in short recordings. Half of the noise of a receiver lasts for a second.
BLOCK_LEAST_S = 1.0

# blocks that a recording is divided into at least; samples that a block has at least.
BLOCKS = 24.0
BLOCK_SAMPLES = 10.0

# m/s^2. Braking below it makes less than 0.1 % of creepage on a dry rail.
QUIET_M_S2 = 0.5

# m/s. Largest and smallest value of the lowest speed at which wheels are compared; see
# `slowest_m_s`.
SLOWEST_M_S = 4.0
SLOWEST_LEAST_M_S = 0.3

# share of the fastest speed of a slow vehicle, such as a small robot. Limits in m/s that do not
# come from noise are at most this share. Chosen.
SLOW_SHARE = 0.25

# multiples of noise and rounding. Below this speed they weigh too much.
SLOWEST_FACTOR = 50.0

# probability of a false alarm in a fault-free recording, shared among channels and dates.
ALPHA = 0.02

# blocks. Fewer do not show their scatter.
LEAST_BLOCKS = 6

# share of the radius beyond its error. Wear within a setting, creepage, receiver and rounding stay
# below.
LEAST_RADIUS = 0.002

# share. Standard error of a radius that no amount of data removes: tyre, load, creepage, curves.
# Chosen.
SYSTEMATIC_RADIUS = 0.0004

# share. A larger difference is no radius of a wheel: worn and new wheels differ less.
MOST_RADIUS = 0.05

# share. A ratio that scatters more between blocks is no property of a wheel: it slips. Chosen.
STEADY_SHARE = 0.01

# share by which all wheels differ from the reference before its scale is doubted. Chosen.
COMMON_SHARE = 0.025

# m/s beyond its error. A smaller offset of a speed is rounding.
LEAST_OFFSET_M_S = 0.1

# ratio of the highest to the lowest speed. Below it scale and offset cannot be distinguished.
# Chosen.
OFFSET_RANGE = 1.3

# blocks at low and at high speed. Fewer do not distinguish scale and offset. Chosen.
OFFSET_BLOCKS = 3

# visits of low and of high speed. One visit shares one curve or one slope: it shows no offset of a
# wheel. Chosen.
OFFSET_VISITS = 2

# share of the scatter about a line through the origin. An offset must leave less. Chosen.
OFFSET_SCATTER = 0.8

# m/s. If an offset and a delay leave less than this, they cannot be distinguished. Chosen.
RIVAL_M_S = 0.025

# s. One and a half samples at 10 Hz. Creepage in braking looks like 0.04 s.
LATE_S = 0.15

# s. Longest delay that is searched for.
LATEST_S = 3.0

# m/s. A slide counts no more than this against a delay.
CAP_M_S = 1.0

# s per m/s. Delay of a reference that creepage of tyres looks like: 0.5 % of creepage for each
# m/s^2.
CREEPAGE_S2_M = 0.005

# share of the error without a delay. A delay that is reported must leave less. Chosen.
LATE_SHARE = 0.7

# share. A speed that differs by a larger factor while it changes is reported as unknown. Creepage
# in braking stays below. Chosen.
LATE_FACTOR = 0.02

# share of samples with an error above CAP_M_S. With more the wheel slips. Chosen.
LATE_CAPPED = 0.2

# --- slides ---

# m/s. Largest and smallest value of the smallest slide; see `slide_m_s`.
SLIDE_M_S = 0.4
SLIDE_LEAST_M_S = 0.15

# multiples of noise and rounding that a slide must exceed. Chosen.
SLIDE_NOISE = 10.0

# share of the vehicle speed. Beyond the creepage at the peak of adhesion.
SLIDE_SHARE = 0.03

# share of the vehicle speed for each m/s^2 of deceleration. Creepage at the peak of adhesion of a
# tyre is 0.1 at 10 m/s^2.
SLIDE_SHARE_M_S2 = 0.01

# share of the vehicle speed. A driven wheel that is faster slips. Wheels at work stay below. At
# low speed wheels of sharp curves reach the larger share; see `curve_share`. Chosen.
SLIP_SHARE = 0.1
SLIP_SHARE_CURVE = 0.25

# m^2/s^2. Half a track of 1.5 m times a lateral acceleration of 4 m/s^2 in a curve.
CURVE_M2_S2 = 3.0

# share of the vehicle speed. Without a reference wheels of a road vehicle in a curve differ by
# less. Chosen.
SLIDE_SHARE_CURVE = 0.1

# share of the deviation of one wheel that another wheel has with the opposite sign in a curve.
# Chosen.
MIRROR_SHARE = 0.3

# share of the vehicle speed. A wheel that is so much slower slides even if nobody brakes. Chosen.
LOCKED_SHARE = 0.5

# multiples of the channel's scatter.
SLIDE_DEVIATIONS = 5.0

# s and samples. Shorter is noise: 0.5 s at 10 Hz, where a burst of noise of a twin of 0.3 s looked
# like a slide, and 0.1 s at 50 Hz and above.
SLIDE_S = 0.1
SLIDE_SAMPLES = 5.0

# s. Up to this interval between samples short drops are searched for: a slide of 0.1 s has two and
# a half samples.
DROP_STEP_S = 0.04

# s. A drop is compared with so much before and after it. Cycles of an ABS last 0.1 to 0.3 s.
DROP_WINDOW_S = 0.75

# samples and s. A shorter drop is a jump of the sensor. Chosen.
DROP_SAMPLES = 4
DROP_S = 0.05

# samples of the shortest drop that has to be explained. Fewer are a jump of the sensor. Chosen.
DROP_VISIBLE_SAMPLES = 2

# share of their mean sliding by which all wheels may differ where the reference is off. Wheels that
# slide differ by more. Chosen.
AGREE_SHARE = 0.25

# s. A reference that is off for less is late, or its values are too far apart. Chosen.
REFERENCE_OFF_S = 1.0

# m/s. Without a reference, wheels roll where their speeds stay closer than this for 2 s. Set on
# twins.
TOGETHER_M_S = 0.4

# m/s^2. Running resistance of a coach at 40 m/s, subtracted from the adhesion bound.
RESISTANCE_M_S2 = 0.05

# probability that slides anywhere on the braked track would meet as often.
PLACE_P = 0.01

# runs. Fewer do not make a shared place.
PLACE_RUNS = 3

# --- what is left ---

# m/s. Offset of a block of BLOCK_S that is reported as unknown. Chosen.
LEFT_M_S = 0.15

# share of the speed, for the same offset. Creepage of driving stays below.
LEFT_SHARE = 0.01

# standard errors of the block's mean that the same offset must exceed.
LEFT_DEVIATIONS = 6.0

# multiples of the channel's usual scatter. A block above it is reported as unknown. Chosen.
ROUGH = 3.0

# multiples of the scatter between blocks that an offset of a block must exceed. Chosen.
LEFT_SPREAD = 6.0

# multiples of the size that one block in five exceeds, as in curves. The same offset must exceed
# it. Set on simulated cars.
LEFT_TAIL = 3.0


# --- limits from rate, rounding and noise ---


def error_m_s(noise_m_s: float, quantum_m_s: float) -> float:
    """Return the standard error of one sample from its noise and its rounding step."""
    return math.hypot(noise_m_s, quantum_m_s / math.sqrt(12.0))


def slowest_m_s(noise_m_s: float, quantum_m_s: float, fastest_m_s: float) -> float:
    """Return the lowest speed at which wheels are compared, from the fastest speed of the run."""
    slowest = SLOWEST_FACTOR * error_m_s(noise_m_s, quantum_m_s)
    least = min(SLOWEST_LEAST_M_S, SLOW_SHARE * fastest_m_s)
    return min(max(slowest, least), SLOWEST_M_S)


def moved_m_s(error_m_s: float, fastest_m_s: float) -> float:
    """Return by how much other channels must move while a value is held.

    `error_m_s` is the largest error of a sample of the other channels.
    """
    return min(max(SLOWEST_FACTOR * error_m_s, SLOW_SHARE * fastest_m_s), MOVED_M_S)


def block_s(duration_s: float, step_s: float) -> float:
    """Return the length of blocks that count as independent, from the length of all runs."""
    by_duration_s = min(max(duration_s / BLOCKS, BLOCK_LEAST_S), BLOCK_S)
    return max(by_duration_s, BLOCK_SAMPLES * step_s)


def slide_s(step_s: float) -> float:
    """Return the duration of the shortest slide."""
    return max(SLIDE_S, SLIDE_SAMPLES * step_s)


def drop_samples(step_s: float) -> int:
    """Return the number of samples of the shortest drop."""
    return max(DROP_SAMPLES, math.ceil(DROP_S / step_s))


def slide_m_s(noise_m_s: float, quantum_m_s: float, fastest_m_s: float) -> float:
    """Return the smallest slide at low speed, from the fastest speed of the run."""
    slide = SLIDE_NOISE * error_m_s(noise_m_s, quantum_m_s)
    least = min(SLIDE_LEAST_M_S, SLOW_SHARE * fastest_m_s)
    return min(max(slide, least), SLIDE_M_S)


def curve_share(v: np.ndarray) -> np.ndarray:
    """Return the share of the vehicle speed by which a wheel in a curve may differ, (n,)."""
    return np.minimum(CURVE_M2_S2 / np.maximum(v, 1e-3) ** 2, SLIP_SHARE_CURVE)


def slip_share(v: np.ndarray) -> np.ndarray:
    """Return the share of the vehicle speed beyond which a driven wheel slips, (n,)."""
    return np.maximum(curve_share(v), SLIP_SHARE)


def late_s(step_s: float) -> float:
    """Return the smallest delay: one and a half samples at 10 Hz and below."""
    return max(LATE_S, 1.5 * step_s)


def stuck_s(step_s: float, logs_on_change: bool) -> float:
    """Return for how long the shortest stuck value is held."""
    shortest = STUCK_ON_CHANGE_S if logs_on_change else STUCK_S
    return max(shortest, STUCK_SAMPLES * step_s)


def gap_s(step_s: float) -> float:
    """Return the length of the shortest gap."""
    return max(GAP_S, 3.0 * step_s)


def jump_m_s(hardest_m_s2: float, step_s: float) -> float:
    """Return the largest change of the vehicle's speed between two samples."""
    return JUMP_M_S + hardest_m_s2 * step_s


def zero_jump_m_s(hardest_m_s2: float, step_s: float) -> float:
    """Return the largest change of a wheel that locks or is released between two samples."""
    return max(ZERO_JUMP_M_S, WHEEL_FACTOR * hardest_m_s2 * step_s)
