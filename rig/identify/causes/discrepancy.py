"""The model discrepancy: what a right model may differ by from measured runs.

No cause of the library accounts for it, and none may win from it. It consists of base parameters
with priors, so the fit may use them, the scores leave out what they can absorb, and each null
simulation draws them again.

    [Y1] acting torque = recorded torque (1 + sum_k x_k phi_k), x_k with deviation `share` times
         the declared calibration, over k
    [Y2] phi_k = T_k(2 t / t_end - 1), Chebyshev's polynomial, of each wheelset in each run
    [Y3] wheel speeds from pulses are late [D3]
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.data import parameters, pulses
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import AXLES

# --- the shape of the brake inside its calibration ---

# beginning of the labels of all its parameters
BRAKE = "brake"
# Deviation of the modes of a wheelset in a run over the declared calibration. Modes of all
# wheelsets together are left out: with a deviation of 0.25 the score of a gradient of 0.6 per
# mille, on a clean set of the second generator, would fall from 65 to 11. What all brakes have in
# common is judged by its size instead (`thresholds.IMMATERIAL_DEVIATIONS`). Chosen.
SHARE_OF_MODE = 0.25
MODES = 3

# --- a sensor of pulses ---

LATE_WINDOW = "late_window"  # in steps, less the mean of [D3]
LATE_PULSE = "late_pulse"  # in rad, less the mean of [D3]
LATE = "late_"  # beginning of both labels


class Mode(NamedTuple):
    """A mode of the brake of a wheelset in a run: a base parameter."""

    label: str
    run: int
    axle: int  # 1 is the leading wheelset
    number: int  # k of [Y2]
    prior: float


def modes(design: Design) -> list[Mode]:
    """Return the modes of the brake in the runs of a design."""
    found = []
    for run in range(design.mass_kg.size):
        for axle in range(1, AXLES + 1):
            for k in range(MODES):
                label = f"{BRAKE}_{run}_{axle}_{k}"
                found.append(Mode(label, run, axle, k, SHARE_OF_MODE * design.calibration))
    return found


def course(design: Design, number: int) -> np.ndarray:
    """Return mode k [Y2] at each sample of each wheelset, shape (n,)."""
    last_s = design.time_s[design.start[1:] - 1]
    ends_s = np.repeat(last_s, np.diff(design.start))
    return _chebyshev(2.0 * design.time_s / ends_s - 1.0, number)


def _chebyshev(x: np.ndarray, number: int) -> np.ndarray:
    """Return Chebyshev's polynomial T_k at x for k up to 2."""
    if number == 0:
        return np.ones_like(x)
    if number == 1:
        return x
    return 2.0 * x * x - 1.0


def brake_share(design: Design, base: dict[str, float]) -> np.ndarray | None:
    """Return the change of the torque by the modes of the brake, as a share (n,); None: none."""
    present = {label: value for label, value in base.items() if label.startswith(BRAKE)}
    if not present:
        return None
    change = np.zeros(design.time_s.size)
    courses = [course(design, number) for number in range(MODES)]
    for mode in modes(design):
        at = design.span(AXLES * mode.run + mode.axle - 1)
        change[at] += present.get(mode.label, 0.0) * courses[mode.number][at]
    return change


def draw_brake(design: Design, rng: np.random.Generator) -> dict[str, float]:
    """Return random values of the modes of the brake, by their labels."""
    found = modes(design)
    values = rng.normal(size=len(found))
    return {mode.label: float(mode.prior * x) for mode, x in zip(found, values, strict=True)}


def priors(design: Design) -> dict[str, float]:
    """Return the prior standard deviations of the discrepancy's parameters, by their labels."""
    found = {mode.label: mode.prior for mode in modes(design)}
    if design.wheel_sensor.is_pulses:
        found[LATE_WINDOW] = pulses.LATE_WINDOW_DEVIATION
        found[LATE_PULSE] = pulses.LATE_PULSE_DEVIATION_RAD
    return found


def wheel_late_s(design: Design, base: dict[str, float]) -> np.ndarray:
    """Return how late the speed of each wheel is [Y3], shape (n,)."""
    turning_rad_s = design.speed_m_s / design.base[parameters.RADIUS]
    return pulses.late_s(
        design.step_s, turning_rad_s, base.get(LATE_WINDOW, 0.0), base.get(LATE_PULSE, 0.0)
    )


def earlier(design: Design, values: np.ndarray, by_s: np.ndarray) -> np.ndarray:
    """Return values(t - by) in each segment; `values` and `by_s` have the shape (n,)."""
    out = np.empty_like(values)
    for s in range(design.segments):
        at = design.span(s)
        out[at] = pulses.delayed(values[at], by_s[at] / design.step_s)
    return out
