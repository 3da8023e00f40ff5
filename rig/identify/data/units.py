"""Detects wrong units and clocks that do not agree, from the physics of a braked vehicle.

Rolling wheels turn with the vehicle, loads carry its weight, and torques take its momentum. A ratio
far from 1 is an error of the data, and a known ratio identifies the unit. While a wheel slides,
torque and wheel speed change against each other, so a shift between their clocks is visible too.

    [D1] r omega / v = 1 while rolling;  N = M g / n of n wheelsets;
         integral of sum C / r dt = loss of momentum
    [D2] J domega/dt = r T - C, with T nearly constant while the wheel slides
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig.identify.data.runs import Run
from rollerrig.rig.identify.data.smoothing import smoothed

# Tables of the ratios [D1] that a known error of the data gives. A row holds the ratio, and what it
# means and what to do.
# r omega / v, where a quantity is in another unit:
_SPEED_RATIOS = (
    (1000.0, "wheel_radius_m is in millimetres: divide it by 1000"),
    (60.0 / (2.0 * np.pi), "wheel_speed is in rpm: multiply it by 2 pi / 60"),
    (1.0 / (2.0 * np.pi), "wheel_speed is in turns a second: multiply it by 2 pi"),
    (180.0 / np.pi, "wheel_speed is in degrees a second: multiply it by pi / 180"),
    (1.0 / 3.6, "vehicle_speed_m_s is in km/h: divide it by 3.6"),
    (0.44704, "vehicle_speed_m_s is in miles an hour: multiply it by 0.44704"),
    (2.0, "wheel_radius_m is a diameter: halve it"),
)
# omega / v, where the channel has the speed of the rim and not the angular speed:
_RIM_SPEED_RATIOS = (
    (1.0, "wheel_speed is in m/s: divide it by the radius"),
    (3.6, "wheel_speed is in km/h: divide it by 3.6 and the radius"),
)
# N / (M g / n), besides that of the whole vehicle:
_LOAD_RATIOS = (
    (1e-3, "it is in kN: multiply by 1000"),
    (0.5, "it is of one wheel: double it"),
    (1.0 / GRAVITY_M_S2, "it is in kg: multiply by 9.80665"),
    (1e-3 / GRAVITY_M_S2, "it is in t: multiply by 9806.65"),
)
# integral of sum C / r over the loss of momentum, besides that of the whole vehicle:
_TORQUE_RATIOS = (
    (1e-3, "it is in kN m: multiply by 1000"),
    (0.1, "it is in daN m or kgf m: multiply by 10 or by 9.80665"),
    (0.5, "it is of one wheel: double it"),
)
# a measured ratio matches a row if it differs from the ratio of the row by less than this share
_SAME_RATIO = 0.06

# Shift in s between torque and wheel speed: more is two clocks, less may be a delay that `explain`
# finds. 0.2 refused 2 of 40 fault-free recordings of sealed rigs, where wheels cycle slowly.
LARGEST_CLOCK_SHIFT_S = 0.3
# a shift counts only if torque and wheel speed then have at least this correlation
LEAST_CORRELATION = 0.5
# increase of the correlation by a shift that is a weak sign, which wheelsets or runs must confirm
LEAST_GAIN = 0.25
# increase of the correlation by a shift that is a proof on a single wheelset
CLEAR_GAIN = 0.5


def check(run: Run, path: Path, vehicle: Mapping[str, Any], warnings: list[str]) -> None:
    """Check loads and torques of a run; warns where torque and speed disagree.

    Raises ConfigError.
    """
    if np.isfinite(run.mass_kg):
        _check_weight(run, path)
        _check_momentum(run, path, vehicle, warnings)


def _meaning(ratio: float, table: tuple[tuple[float, str], ...], otherwise: str) -> str:
    """Return the text of the first row with this ratio, or `otherwise`."""
    for known_ratio, text in table:
        if abs(ratio / known_ratio - 1.0) < _SAME_RATIO:
            return text
    return otherwise


def check_rolling(run: Run, path: Path, radius_m: float) -> None:
    """Raise ConfigError where wheels at the start of a run do not roll with the vehicle [D1]."""
    speed_m_s = max(float(np.median(run.speed_m_s[:50])), 1e-9)
    for j in range(run.wheel_speed_rad_s.shape[1]):
        wheel_rad_s = float(np.median(run.wheel_speed_rad_s[:50, j]))
        ratio = radius_m * wheel_rad_s / speed_m_s
        if 0.5 < ratio < 1.5:
            continue
        unknown = "check the radius (metres) and the unit of wheel_speed (rad/s)"
        # both tables may match: with a radius of 0.447 m a rim in m/s looks like a speed in mph
        meanings = [
            _meaning(wheel_rad_s / speed_m_s, _RIM_SPEED_RATIOS, ""),
            _meaning(ratio, _SPEED_RATIOS, ""),
        ]
        why = ", or ".join(meaning for meaning in meanings if meaning) or unknown
        raise ConfigError(
            f"{path}: wheelset {j + 1} runs at {ratio:.3g} times the vehicle's speed with "
            f"wheel_radius_m = {radius_m:g}; rolling wheels give 1: {why}"
        )


def _check_weight(run: Run, path: Path) -> None:
    """Raise ConfigError where a load is far from the wheelset's share of the weight [D1]."""
    static_N = run.mass_kg * GRAVITY_M_S2 / run.axles
    ratios = (*_LOAD_RATIOS, (run.axles, f"it is the vehicle's weight: divide by {run.axles}"))
    # braking moves load from one wheelset to another, so the mean of all shows the unit
    mean_ratio = float(np.mean(np.median(run.load_N, axis=0))) / static_N
    for j in range(run.axles):
        load_N = np.median(run.load_N[:, j])
        ratio = float(load_N) / static_N
        if not 0.7 < ratio < 1.4:
            unknown = "loads are newtons for both wheels; check mass_kg too"
            why = _meaning(ratio, ratios, _meaning(mean_ratio, ratios, unknown))
            raise ConfigError(
                f"{path}: wheel_load_{j + 1}_N is {load_N:.4g}, a wheelset of this vehicle carries "
                f"{static_N:.4g} N: {why}"
            )


def torque_share(run: Run, vehicle: Mapping[str, float]) -> float | None:
    """Return the share of the momentum that the vehicle loses for which the torques account [D1].

    1 is right. None if the brakes took too little momentum to judge them.
    """
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
    if lost_m_s < 3.0 or momentum_Ns < 0.3 * run.mass_kg * lost_m_s:
        return None
    return float(run.torque_Nm.sum()) * step_s / radius_m / momentum_Ns


def _check_momentum(
    run: Run, path: Path, vehicle: Mapping[str, float], warnings: list[str]
) -> None:
    """Raise ConfigError, or warns, where the torques do not account for the lost momentum [D1]."""
    share = torque_share(run, vehicle)
    if share is None or 0.6 < share < 1.6:
        return
    finding = (
        f"{path}: brake_torque accounts for {share:.3g} of the momentum that the vehicle loses"
    )
    of_vehicle = (run.axles, f"it is the vehicle's: divide by {run.axles}")
    why = _meaning(share, (*_TORQUE_RATIOS, of_vehicle), "")
    if why:
        raise ConfigError(f"{finding}; 1 is right: {why}")
    if not 0.1 < share < 10.0:
        raise ConfigError(f"{finding}; 1 is right: is it N m of a wheelset?")
    warnings.append(
        f"{finding}: another brake, a gradient or mass_kg is missing; causes in torque and "
        "resistance will be reported because of it"
    )


def _decrease(values: np.ndarray) -> np.ndarray:
    """Return how far values (n,) or (n, columns) decrease from the first sample to the last.

    Both are ends of straight lines through 20 samples: their means would miss what a short stop
    loses in these samples, 1.4 % of that of a car.
    """
    number = np.arange(20.0)
    first = np.polynomial.polynomial.polyfit(number, values[:20], 1)
    last = np.polynomial.polynomial.polyfit(number, values[-20:], 1)
    return first[0] - (last[0] + number[-1] * last[1])


class _Shift(NamedTuple):
    """The shift in time that makes torque and wheel speed of a wheelset agree best."""

    shift_s: float  # above 0: wheel speed is late
    # increase of the correlation by the shift; 0: the shift is allowed; nan: cannot be judged
    gain: float


def check_clocks(runs: Sequence[Run], where: str, vehicle: Mapping[str, Any]) -> None:
    """Raise ConfigError where torque and wheel speed of a sliding wheel are shifted in time [D2].

    A clock belongs to a channel of all runs, or to all channels of a run. So a weak sign on one
    wheelset of one run is chance. It counts only if most wheelsets of this run show it, or this
    wheelset in most runs (so always if there is a single run). A clear sign always counts.
    """
    shifts = []  # by run, then by wheelset
    for run in runs:
        shifts.append([_clock_shift(run, axle, vehicle) for axle in range(run.axles)])
    gains = np.array([[shift.gain for shift in shifts_of_run] for shifts_of_run in shifts])

    has_sign = gains > LEAST_GAIN  # (runs, axles)
    is_judged = np.isfinite(gains)
    for r, j in np.argwhere(has_sign):
        is_clear = gains[r, j] > CLEAR_GAIN
        in_most_wheelsets = 2 * has_sign[r].sum() > is_judged[r].sum()
        in_most_runs = 2 * has_sign[:, j].sum() > is_judged[:, j].sum()
        if not (is_clear or in_most_wheelsets or in_most_runs):
            continue

        shift_s = shifts[r][j].shift_s
        if shift_s > 0:
            late = "wheel_speed"
            early = "brake_torque"
        else:
            late = "brake_torque"
            early = "wheel_speed"
        raise ConfigError(
            f"{where}: run '{runs[r].name}': {late} of wheelset {j + 1} comes {abs(shift_s):.2g} s "
            f"behind {early}; clocks may differ by {LARGEST_CLOCK_SHIFT_S:g} s at most: shift one "
            "channel by that"
        )


def _clock_shift(run: Run, axle: int, vehicle: Mapping[str, Any]) -> _Shift:
    """Return the shift between wheel speed and torque of a wheelset in a run."""
    wheel_m_s = vehicle["wheel_radius_m"] * run.wheel_speed_rad_s[:, axle]
    if np.mean(np.abs(run.speed_m_s - wheel_m_s)) < 1.0:
        return _Shift(0.0, math.nan)  # it hardly slides
    shift_s, correlation, unshifted = _best_shift(run, axle, vehicle["wheelset_inertia_kgm2"])
    if abs(shift_s) > LARGEST_CLOCK_SHIFT_S and correlation > LEAST_CORRELATION:
        return _Shift(shift_s, correlation - unshifted)
    return _Shift(shift_s, 0.0)


def _best_shift(run: Run, axle: int, inertia_kgm2: float) -> tuple[float, float, float]:
    """Return the shift in s with the best correlation, this correlation, and that without shift.

    The two sides of [D2] are correlated: J domega/dt of the measured wheel speed, and -C of the
    measured torque. Their difference r T changes slowly, so only fast changes are compared. All
    three values are 0 if the run is too short.
    """
    step_s = float(np.mean(np.diff(run.time_s)))
    window = derivative_window(step_s)
    most_samples = max(int(1.0 / step_s), 4)  # the largest shift that is tried, one second
    is_moving = run.speed_m_s > 5.0
    if np.count_nonzero(is_moving) < 4 * most_samples:
        return 0.0, 0.0, 0.0

    wheel_rad_s = run.wheel_speed_rad_s[:, axle]
    inertial_Nm = inertia_kgm2 * smoothed(wheel_rad_s, window, 3, 1, step_s)
    braking_Nm = -smoothed(run.torque_Nm[:, axle], window, 3)
    inertial = fast_part(inertial_Nm, most_samples, is_moving)
    braking = fast_part(braking_Nm, most_samples, is_moving)

    shifts = range(-most_samples, most_samples + 1)
    correlations = np.array([_correlation(inertial, braking, shift) for shift in shifts])
    best = int(np.argmax(correlations))
    unshifted = most_samples  # place of the shift 0
    return (
        (best - most_samples) * step_s,
        float(correlations[best]),
        float(correlations[unshifted]),
    )


def _correlation(inertial: np.ndarray, braking: np.ndarray, shift: int) -> np.floating[Any]:
    """Return the correlation if `inertial` is late by `shift` samples (below 0: early).

    Both have mean 0 and deviation 1, so the mean of their product is the correlation. Samples
    without a counterpart are left out.
    """
    n = inertial.size
    later = inertial[max(0, shift) : n + min(0, shift)]
    earlier = braking[max(0, -shift) : n + min(0, -shift)]
    return np.mean(later * earlier)


def derivative_window(step_s: float) -> int:
    """Return the samples of the window in which accelerations of wheels are compared, odd."""
    return 2 * max(int(0.1 / step_s), 3) + 1


def fast_part(values: np.ndarray, width: int, chosen: np.ndarray) -> np.ndarray:
    """Return the fast changes of values at the chosen samples, scaled to mean 0 and deviation 1.

    A change is fast if a Gaussian filter of this width, in samples, removes it.
    """
    fast = (values - gaussian_filter1d(values, width))[chosen]
    return (fast - fast.mean()) / max(float(fast.std()), 1e-12)
