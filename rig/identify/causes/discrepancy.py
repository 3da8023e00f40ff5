"""The model discrepancy: what a right model may differ by from measured runs.

No cause of the library accounts for it, and none may win from it. It consists of base parameters
with priors, so the fit may use them, the scores leave out what they can absorb, and each null
simulation draws them again.

    [Y1] acting torque = recorded torque (1 + sum_k x_k phi_k), x_k with deviation `share` times
         the declared calibration, over k
    [Y2] phi_k = T_k(2 t / t_end - 1), Chebyshev's polynomial, of each wheelset in each run
    [Y3] wheel speeds from pulses are late [D3]
    [Y4] acting torque of all wheelsets of a run = recorded torque (1 + sum_k x_k phi_k), k from 1,
         x_k with the deviation of the declared calibration. Three forms: phi_k over the time of
         each run with x_k of this run; over the time, T_k(2 t / t_max - 1), with x_k of all runs;
         and over the speed of the vehicle, T_k(2 v / v_max - 1), with x_k of all runs

[Y4] is in no base and in no null simulation. It is the rival of causes that act on the brake or on
the vehicle (`decide.decision`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.data import parameters, pulses
from rollerrig.rig.identify.data.preparation import CommonBrake, Design

# --- the shape of the brake inside its calibration ---

# beginning of the labels of all its parameters
BRAKE = "brake"
# Deviation of the modes of a wheelset in a run over the declared calibration. Modes of all
# wheelsets together are left out: with a deviation of 0.25 the score of a gradient of 0.6 per
# mille, on a clean set of the second generator, would fall from 65 to 11. What all brakes have in
# common is their rival instead ([Y4]), after the search. Chosen.
SHARE_OF_MODE = 0.25
MODES = 3
# Highest polynomials of [Y4]. Over time it follows a swing of 18 s in a stop of 50 s. Over speed it
# is a straight line, about as the friction of pads changes. Chosen.
MODES_OVER_TIME = 6
MODES_OVER_SPEED = 1
ALL_AXLES = 0
ALL_RUNS = -1
# Two standard deviations contain an error in this share of the time.
SHARE_OF_TIME = 0.95

# --- a sensor of pulses ---

LATE_WINDOW = "late_window"  # in steps, less the mean of [D3]
LATE_PULSE = "late_pulse"  # in rad, less the mean of [D3]
LATE = "late_"  # beginning of both labels


class Mode(NamedTuple):
    """A mode of the brake of a wheelset in a run: a base parameter."""

    label: str
    run: int  # ALL_RUNS: the same in all runs
    axle: int  # 1 is the leading wheelset; ALL_AXLES: the wheelsets of the run in common
    number: int  # k of [Y2] or [Y4]
    prior: float


def modes(design: Design) -> list[Mode]:
    """Return the modes of the brake in the runs of a design."""
    found = []
    for run in range(design.mass_kg.size):
        for axle in range(1, design.axles + 1):
            for k in range(MODES):
                label = f"{BRAKE}_{run}_{axle}_{k}"
                found.append(Mode(label, run, axle, k, SHARE_OF_MODE * design.calibration))
    return found + common_modes(design)


def common_modes(design: Design) -> list[Mode]:
    """Return the modes that the brakes of a run have in common [Y4]; none in a base model."""
    found: list[Mode] = []
    if design.common_brake is CommonBrake.NONE:
        return found
    runs: Sequence[int] = (ALL_RUNS,)
    if design.common_brake is CommonBrake.TIME_OF_RUN:
        runs = range(design.mass_kg.size)
    highest = MODES_OVER_SPEED if design.common_brake is CommonBrake.SPEED else MODES_OVER_TIME
    for run in runs:
        for k in range(1, highest + 1):
            label = f"{BRAKE}_{run}_{ALL_AXLES}_{k}"
            found.append(Mode(label, run, ALL_AXLES, k, design.calibration))
    return found


def course(design: Design, mode: Mode) -> np.ndarray:
    """Return a mode [Y2] at each sample of each wheelset, shape (n,)."""
    if mode.run == ALL_RUNS and design.common_brake is CommonBrake.SPEED:
        x = 2.0 * design.speed_m_s / design.speed_m_s.max() - 1.0
    elif mode.run == ALL_RUNS:
        x = 2.0 * design.time_s / design.time_s.max() - 1.0
    else:
        last_s = design.time_s[design.start[1:] - 1]
        ends_s = np.repeat(last_s, np.diff(design.start))
        x = 2.0 * design.time_s / ends_s - 1.0
    return _chebyshev(x, mode.number)


def _chebyshev(x: np.ndarray, number: int) -> np.ndarray:
    """Return Chebyshev's polynomial T_k at x from -1 to 1."""
    if number == 0:
        return np.ones_like(x)
    if number == 1:
        return x
    if number == 2:
        return 2.0 * x * x - 1.0
    return np.cos(number * np.arccos(np.clip(x, -1.0, 1.0)))


def brake_share(design: Design, base: dict[str, float]) -> np.ndarray | None:
    """Return the change of the torque by the modes of the brake, as a share (n,); None: none."""
    present = {label: value for label, value in base.items() if label.startswith(BRAKE)}
    if not present:
        return None
    change = np.zeros(design.time_s.size)
    courses: dict[tuple[bool, int], np.ndarray] = {}
    for mode in modes(design):
        kind = (mode.axle == ALL_AXLES, mode.number)
        if kind not in courses:
            courses[kind] = course(design, mode)
        axles = range(1, design.axles + 1) if mode.axle == ALL_AXLES else (mode.axle,)
        runs = range(design.mass_kg.size) if mode.run == ALL_RUNS else (mode.run,)
        for run in runs:
            for axle in axles:
                at = design.span(design.axles * run + axle - 1)
                change[at] += present.get(mode.label, 0.0) * courses[kind][at]
    return change


def common_share(design: Design, base: dict[str, float]) -> float:
    """Return the change of the torque by [Y4] that is exceeded in 5 % of the time, as a share.

    The change is divided by the root mean square torque of its run. So a change while the brake
    fills or is released counts as little as it brakes.
    """
    shares = []
    for run in range(design.mass_kg.size):
        first = design.axles * run
        at = design.span(first)
        change = np.zeros(design.time_s[at].size)
        for mode in common_modes(design):
            if mode.run in (run, ALL_RUNS):
                change += base.get(mode.label, 0.0) * course(design, mode)[at]
        of_run = range(first, first + design.axles)
        torque_Nm = np.mean([design.brake_Nm[design.span(s)] for s in of_run], axis=0)
        shares.append(np.abs(change * torque_Nm) / np.sqrt(np.mean(torque_Nm**2)))
    return float(np.quantile(np.concatenate(shares), SHARE_OF_TIME))


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
