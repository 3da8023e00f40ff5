"""Finds channels with fewer independent samples than rows, and a clock that the position denies.

A straight line between samples has a second difference of 0. White noise has it hardly ever. A
rounded channel has it often too, but then all its other differences are single steps.
"""

import numpy as np

from rollerrig.rig.identify.base.findings import Code, Finding
from rollerrig.rig.identify.data.dataset import columns_of_axles
from rollerrig.rig.identify.data.preparation import estimated_noise
from rollerrig.rig.identify.data.runs import Dataset, Run

# A second difference below this share of their root mean square counts as 0, and this share of them
# may be 0: every second sample in the middle of a line gives 0.5, white noise 0.02. Chosen.
NEAR_ZERO = 0.02
MOST_ON_LINES = 0.4
# a channel is rounded where its second differences are at most this number of its steps
STEPS_OF_ROUNDING = 4.0
# Least noise of a channel, as a share of the declared one: the noise of three generators is 0.96
# to 1.06 of it, that of lines between every second sample 0.27. Chosen.
LEAST_NOISE = 0.2
# Largest step of a rounded vehicle speed, in standard deviations of its declared noise, and in m/s
# where none is declared. Chosen: above it the rounding is no noise of independent samples.
LARGEST_STEP_IN_DEVIATIONS = 4.0
LARGEST_STEP_M_S = 0.15
# largest difference between the way by position and by speed. Chosen.
LARGEST_OF_WAY = 0.01
LEAST_WAY_M = 50.0


def check(data: Dataset) -> list[Finding]:
    """Return findings on interpolated, smoothed and coarse channels, and on the clock."""
    findings = [*_check_lines(data), *_check_resolution(data)]
    if not findings:
        findings += _check_noise(data)
    return [*findings, *_check_way(data)]


def _channels(run: Run) -> dict[str, np.ndarray]:
    """Return the channels that the filters compare with a model, by their columns."""
    names = columns_of_axles("wheel_speed", "rad_s", run.axles)
    wheels = zip(names, run.wheel_speed_rad_s.T, strict=True)
    return {"vehicle_speed_m_s": run.speed_m_s, **dict(wheels)}


def rounding(values: np.ndarray) -> float:
    """Return the smallest step between the values of a channel."""
    steps = np.diff(np.unique(values))
    return float(steps.min(initial=np.inf, where=steps > 0.0))


def share_on_lines(values: np.ndarray) -> float:
    """Return the share of samples on straight lines; 0 for a channel that is only rounded."""
    second = np.abs(np.diff(values, n=2))
    rms = float(np.sqrt(np.mean(second * second)))
    if rms == 0.0 or rms < STEPS_OF_ROUNDING * rounding(values):
        return 0.0
    # a sample that repeats the one before is held, not interpolated
    is_held = np.diff(values)[1:] == 0.0
    return float(np.mean((second < NEAR_ZERO * rms) & ~is_held))


def _check_lines(data: Dataset) -> list[Finding]:
    shares: dict[str, list[float]] = {}
    for run in data.runs:
        for name, values in _channels(run).items():
            shares.setdefault(name, []).append(share_on_lines(values))
    of_channels = {name: float(np.median(of_runs)) for name, of_runs in shares.items()}
    wrong = {name: share for name, share in of_channels.items() if share > MOST_ON_LINES}
    if not wrong:
        return []
    return [
        Finding(
            Code.INTERPOLATED,
            measured=float(np.median(list(wrong.values()))),
            allowed=MOST_ON_LINES,
            channels=tuple(wrong),
        )
    ]


def _check_resolution(data: Dataset) -> list[Finding]:
    """Return a finding if the vehicle's speed is rounded to coarse steps."""
    declared_m_s = data.accuracy["speed_m_s"]
    allowed_m_s = LARGEST_STEP_M_S
    if declared_m_s > 0.0:
        allowed_m_s = LARGEST_STEP_IN_DEVIATIONS * declared_m_s
    step_m_s = float(np.median([rounding(run.speed_m_s) for run in data.runs]))
    if not step_m_s > allowed_m_s:
        return []
    return [
        Finding(
            Code.RESOLUTION,
            measured=step_m_s,
            allowed=allowed_m_s,
            channels=("vehicle_speed_m_s",),
        )
    ]


def _check_noise(data: Dataset) -> list[Finding]:
    """Return a finding if channels have far less noise than the dataset declares."""
    shares: dict[str, list[float]] = {}
    for run in data.runs:
        for name, values in _channels(run).items():
            key = "speed_m_s" if name == "vehicle_speed_m_s" else "wheel_speed_rad_s"
            if data.accuracy[key] > 0.0:
                shares.setdefault(name, []).append(estimated_noise(values) / data.accuracy[key])
    of_channels = {name: float(np.median(of_runs)) for name, of_runs in shares.items()}
    wrong = {name: share for name, share in of_channels.items() if share < LEAST_NOISE}
    if not wrong:
        return []
    return [
        Finding(
            Code.SMOOTHED,
            measured=float(np.median(list(wrong.values()))),
            allowed=LEAST_NOISE,
            channels=tuple(wrong),
        )
    ]


def _check_way(data: Dataset) -> list[Finding]:
    """Return a finding if the position advances at another rate than the speed."""
    ratios = []
    for run in data.runs:
        if run.position_m is None:
            continue
        way_m = float(np.trapezoid(run.speed_m_s, run.time_s))
        if way_m > LEAST_WAY_M:
            ratios.append(float(run.position_m[-1] - run.position_m[0]) / way_m)
    if not ratios:
        return []
    middle = float(np.median(ratios))
    if abs(middle - 1.0) < LARGEST_OF_WAY:
        return []
    return [Finding(Code.CLOCK, measured=middle, allowed=LARGEST_OF_WAY)]
