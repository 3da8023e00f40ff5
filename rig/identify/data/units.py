"""Detects wrong units and clocks that do not agree, from the physics of a braked vehicle.

Rolling wheels turn with the vehicle, loads carry its weight, and torques take its momentum. A ratio
far from 1 is an error of the data, and a known ratio identifies the unit. While a wheel slides,
torque and wheel speed change against each other, so a shift between their clocks is visible too.

    [D1] r omega / v = 1 while rolling;  N = M g / 4;  integral of sum C / r dt = loss of momentum
    [D2] J domega/dt = r T - C, with T nearly constant while the wheel slides
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES, GRAVITY_M_S2
from rollerrig.rig.identify.data.runs import Run
from rollerrig.rig.identify.data.smoothing import smoothed

# Tables of (ratio [D1], what it means and what to do).
# r omega / v:
_WHEEL = (
    (1000.0, "wheel_radius_m is in millimetres: divide it by 1000"),
    (60.0 / (2.0 * np.pi), "wheel_speed is in rpm: multiply it by 2 pi / 60"),
    (1.0 / (2.0 * np.pi), "wheel_speed is in turns a second: multiply it by 2 pi"),
    (180.0 / np.pi, "wheel_speed is in degrees a second: multiply it by pi / 180"),
    (1.0 / 3.6, "vehicle_speed_m_s is in km/h: divide it by 3.6"),
    (2.0, "wheel_radius_m is a diameter: halve it"),
)
# omega / v:
_RIM = (
    (1.0, "wheel_speed is in m/s: divide it by the radius"),
    (3.6, "wheel_speed is in km/h: divide it by 3.6 and the radius"),
)
# N / (M g / 4):
_LOAD = (
    (1e-3, "it is in kN: multiply by 1000"),
    (0.5, "it is of one wheel: double it"),
    (AXLES, f"it is the vehicle's weight: divide by {AXLES}"),
    (1.0 / GRAVITY_M_S2, "it is in kg: multiply by 9.80665"),
    (1e-3 / GRAVITY_M_S2, "it is in t: multiply by 9806.65"),
)
# integral of sum C / r over the loss of momentum:
_TORQUE = (
    (1e-3, "it is in kN m: multiply by 1000"),
    (0.5, "it is of one wheel: double it"),
    (AXLES, f"it is the vehicle's: divide by {AXLES}"),
)
_SAME_RATIO = 0.06  # a ratio within this share of a row's ratio is that of the row

LARGEST_CLOCK_SHIFT_S = 0.3
LEAST_CORRELATION = 0.5  # of torque and wheel speed, where a shift counts
LEAST_GAIN = 0.25  # of correlation by a shift, for a sign of it
CLEAR_GAIN = 0.5  # of correlation by a shift, for a proof by a single wheelset


def check(run: Run, path: Path, vehicle: Mapping[str, Any], warnings: list[str]) -> None:
    """Checks the units of a run; warns where torque and speed disagree. Raises ConfigError."""
    _check_rolling(run, path, vehicle["wheel_radius_m"])
    if np.isfinite(run.mass_kg):
        _check_weight(run, path)
        _check_momentum(run, path, vehicle, warnings)


def _meaning(ratio: float, table: tuple[tuple[float, str], ...], otherwise: str) -> str:
    """Returns the text of the first row with this ratio, or `otherwise`."""
    for known_ratio, text in table:
        if abs(ratio / known_ratio - 1.0) < _SAME_RATIO:
            return text
    return otherwise


def _check_rolling(run: Run, path: Path, radius_m: float) -> None:
    """Raises ConfigError where wheels at the start of a run do not roll with the vehicle [D1]."""
    speed_m_s = max(float(np.median(run.speed_m_s[:50])), 1e-9)
    for j in range(run.wheel_speed_rad_s.shape[1]):
        wheel_rad_s = float(np.median(run.wheel_speed_rad_s[:50, j]))
        ratio = radius_m * wheel_rad_s / speed_m_s
        if 0.5 < ratio < 1.5:
            continue
        unknown = "check the radius (metres) and the unit of wheel_speed (rad/s)"
        why = _meaning(wheel_rad_s / speed_m_s, _RIM, _meaning(ratio, _WHEEL, unknown))
        raise ConfigError(
            f"{path}: wheelset {j + 1} runs at {ratio:.3g} times the vehicle's speed with "
            f"wheel_radius_m = {radius_m:g}; rolling wheels give 1: {why}"
        )


def _check_weight(run: Run, path: Path) -> None:
    """Raises ConfigError where a load is far from the wheelset's share of the weight [D1]."""
    axles = run.load_N.shape[1]
    static_N = run.mass_kg * GRAVITY_M_S2 / axles
    for j in range(axles):
        load_N = np.median(run.load_N[:, j])
        ratio = float(load_N) / static_N
        if not 0.7 < ratio < 1.4:
            unknown = "loads are newtons for both wheels; check mass_kg too"
            why = _meaning(ratio, _LOAD, unknown)
            raise ConfigError(
                f"{path}: wheel_load_{j + 1}_N is {load_N:.4g}, a wheelset of this vehicle carries "
                f"{static_N:.4g} N: {why}"
            )


def _check_momentum(
    run: Run, path: Path, vehicle: Mapping[str, float], warnings: list[str]
) -> None:
    """Raises ConfigError, or warns, where the torques do not account for the lost momentum [D1]."""
    step_s = float(np.mean(np.diff(run.time_s)))
    radius_m = vehicle["wheel_radius_m"]
    v = run.speed_m_s
    coast_N = (
        vehicle["resistance_A_N"]
        + vehicle["resistance_B_N_s_m"] * v
        + vehicle["resistance_C_N_s2_m2"] * v * v
    )
    lost_m_s = float(_decrease(v))
    lost_rad_s = float(_decrease(run.wheel_speed_rad_s).sum())
    momentum_Ns = (
        run.mass_kg * lost_m_s
        - float(coast_N.sum()) * step_s
        + vehicle["wheelset_inertia_kgm2"] / radius_m * lost_rad_s
    )
    # too little was lost by braking for a judgement
    if lost_m_s < 3.0 or momentum_Ns < 0.3 * run.mass_kg * lost_m_s:
        return

    share = float(run.torque_Nm.sum()) * step_s / radius_m / momentum_Ns
    if 0.6 < share < 1.6:
        return
    finding = (
        f"{path}: brake_torque accounts for {share:.3g} of the momentum that the vehicle loses"
    )
    why = _meaning(share, _TORQUE, "")
    if why:
        raise ConfigError(f"{finding}; 1 is right: {why}")
    if not 0.1 < share < 10.0:
        raise ConfigError(f"{finding}; 1 is right: is it N m of a wheelset?")
    warnings.append(
        f"{finding}: another brake, a gradient or mass_kg is missing; causes in torque and "
        "resistance will be reported because of it"
    )


def _decrease(values: np.ndarray) -> np.ndarray:
    """Returns how far values decrease from the first 20 samples to the last 20."""
    return values[:20].mean(axis=0) - values[-20:].mean(axis=0)


class _Shift(NamedTuple):
    """A shift in time of wheel speed behind torque, and what it gains."""

    shift_s: float
    gain: float  # of correlation; nan: cannot be judged; 0: the shift is allowed


def check_clocks(runs: Sequence[Run], where: str, vehicle: Mapping[str, Any]) -> None:
    """Raises ConfigError where torque and wheel speed of a sliding wheel are shifted in time [D2].

    A clock belongs to a channel or to a run. So a weak sign on one wheelset in one of several runs
    counts as chance. It counts where most wheelsets of the run, or most runs of the wheelset, show
    it.
    """
    shifts = [[_clock_shift(run, axle, vehicle) for axle in range(AXLES)] for run in runs]
    gains = np.array([[shift.gain for shift in of_run] for of_run in shifts])
    seen = gains > LEAST_GAIN
    judged = np.isfinite(gains)
    for r, j in np.argwhere(seen):
        in_most_of_run = 2 * seen[r].sum() > judged[r].sum()
        in_most_of_axle = 2 * seen[:, j].sum() > judged[:, j].sum()
        if not (gains[r, j] > CLEAR_GAIN or in_most_of_run or in_most_of_axle):
            continue
        shift_s = shifts[r][j].shift_s
        late, early = "brake_torque", "wheel_speed"
        if shift_s > 0:
            late, early = "wheel_speed", "brake_torque"
        raise ConfigError(
            f"{where}: run '{runs[r].name}': {late} of wheelset {j + 1} comes {abs(shift_s):.2g} s "
            f"behind {early}; clocks may differ by {LARGEST_CLOCK_SHIFT_S:g} s at most: shift one "
            "channel by that"
        )


def _clock_shift(run: Run, axle: int, vehicle: Mapping[str, Any]) -> _Shift:
    """Returns the shift of a wheelset's wheel speed behind its torque, and what it gains."""
    wheel_m_s = vehicle["wheel_radius_m"] * run.wheel_speed_rad_s[:, axle]
    if np.mean(np.abs(run.speed_m_s - wheel_m_s)) < 1.0:
        return _Shift(0.0, math.nan)  # it hardly slides
    shift_s, best, at_zero = _best_shift(run, axle, vehicle["wheelset_inertia_kgm2"])
    if abs(shift_s) > LARGEST_CLOCK_SHIFT_S and best > LEAST_CORRELATION:
        return _Shift(shift_s, best - at_zero)
    return _Shift(shift_s, 0.0)


def _best_shift(run: Run, axle: int, inertia_kgm2: float) -> tuple[float, float, float]:
    """Returns (shift in s of greatest correlation, that correlation, correlation without shift)."""
    step_s = float(np.mean(np.diff(run.time_s)))
    window = 2 * max(int(0.1 / step_s), 3) + 1
    second = max(int(1.0 / step_s), 4)  # samples; the largest shift that is tried
    moves = run.speed_m_s > 5.0
    if np.count_nonzero(moves) < 4 * second:
        return 0.0, 0.0, 0.0

    wheel_rad_s = run.wheel_speed_rad_s[:, axle]
    gains_Nm = inertia_kgm2 * smoothed(wheel_rad_s, window, 3, 1, step_s)
    takes_Nm = -smoothed(run.torque_Nm[:, axle], window, 3)
    gains = _fast_part(gains_Nm, second, moves)
    takes = _fast_part(takes_Nm, second, moves)

    n = gains.size
    correlations = np.array(
        [
            np.mean(gains[max(0, k) : n + min(0, k)] * takes[max(0, -k) : n + min(0, -k)])
            for k in range(-second, second + 1)
        ]
    )
    at = int(np.argmax(correlations))
    return (at - second) * step_s, float(correlations[at]), float(correlations[second])


def _fast_part(values: np.ndarray, second: int, moves: np.ndarray) -> np.ndarray:
    """Returns what changes within a second, at the chosen samples, with mean 0 and deviation 1."""
    fast = (values - gaussian_filter1d(values, second))[moves]
    return (fast - fast.mean()) / max(float(fast.std()), 1e-12)
