"""Tells channels in other units, and clocks that do not agree, from what a braked vehicle must do.

Rolling wheels turn with the vehicle, loads carry its weight, torques take its momentum: a ratio far
from 1 is an error of the data, and a ratio of a known size names its unit. Torque and wheel speed
move against each other while a wheel slides, so a shift between their clocks shows too.

    [D1] r omega / v = 1 while rolling;  N = M g / 4;  integral of sum C / r dt = loss of momentum
    [D2] J domega/dt = r T - C, with T nearly constant while the wheel slides
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES, GRAVITY_M_S2
from rollerrig.rig.identify.data.runs import Run
from rollerrig.rig.identify.data.smoothing import smoothed

# ratio [D1] -> what it tells; within 6 %
_WHEEL = (
    (1000.0, "wheel_radius_m is in millimetres: divide it by 1000"),
    (60.0 / (2.0 * np.pi), "wheel_speed is in rpm: multiply it by 2 pi / 60"),
    (1.0 / (2.0 * np.pi), "wheel_speed is in turns a second: multiply it by 2 pi"),
    (180.0 / np.pi, "wheel_speed is in degrees a second: multiply it by pi / 180"),
    (1.0 / 3.6, "vehicle_speed_m_s is in km/h: divide it by 3.6"),
    (2.0, "wheel_radius_m is a diameter: halve it"),
)
# the same without the radius
_RIM = (
    (1.0, "wheel_speed is in m/s: divide it by the radius"),
    (3.6, "wheel_speed is in km/h: divide it by 3.6 and the radius"),
)
_LOAD = (
    (1e-3, "it is in kN: multiply by 1000"),
    (0.5, "it is of one wheel: double it"),
    (AXLES, f"it is the vehicle's weight: divide by {AXLES}"),
    (1.0 / GRAVITY_M_S2, "it is in kg: multiply by 9.80665"),
    (1e-3 / GRAVITY_M_S2, "it is in t: multiply by 9806.65"),
)
_TORQUE = (
    (1e-3, "it is in kN m: multiply by 1000"),
    (0.5, "it is of one wheel: double it"),
    (AXLES, f"it is the vehicle's: divide by {AXLES}"),
)
LATEST_S = 0.3


def check(run: Run, path: Path, vehicle: Mapping[str, Any], warnings: list[str]) -> None:
    """Raises ConfigError where a channel cannot be in its unit; warns where torque and speed disagree."""
    _rolling(run, path, vehicle["wheel_radius_m"])
    if np.isfinite(run.mass_kg):
        _weight(run, path)
        _momentum(run, path, vehicle, warnings)


def _guess(ratio: float, table: tuple[tuple[float, str], ...], otherwise: str) -> str:
    return next((text for size, text in table if abs(ratio / size - 1.0) < 0.06), otherwise)


def _rolling(run: Run, path: Path, radius_m: float) -> None:
    speed = max(float(np.median(run.speed_m_s[:50])), 1e-9)
    for j in range(run.wheel_speed_rad_s.shape[1]):
        turning = float(np.median(run.wheel_speed_rad_s[:50, j]))
        ratio = radius_m * turning / speed
        if 0.5 < ratio < 1.5:
            continue
        why = _guess(
            turning / speed,
            _RIM,
            _guess(ratio, _WHEEL, "check the radius (metres) and the unit of wheel_speed (rad/s)"),
        )
        raise ConfigError(
            f"{path}: wheelset {j + 1} runs at {ratio:.3g} times the vehicle's speed with "
            f"wheel_radius_m = {radius_m:g}; rolling wheels give 1: {why}"
        )


def _weight(run: Run, path: Path) -> None:
    static_N = run.mass_kg * GRAVITY_M_S2 / run.load_N.shape[1]
    for j in range(run.load_N.shape[1]):
        ratio = float(np.median(run.load_N[:, j])) / static_N
        if not 0.7 < ratio < 1.4:
            why = _guess(ratio, _LOAD, "loads are newtons for both wheels; check mass_kg too")
            raise ConfigError(
                f"{path}: wheel_load_{j + 1}_N is {np.median(run.load_N[:, j]):.4g}, a "
                f"wheelset of this vehicle carries {static_N:.4g} N: {why}"
            )


def _momentum(run: Run, path: Path, vehicle: Mapping[str, float], warnings: list[str]) -> None:
    """Share of the lost momentum that the torques account for [D1]."""
    step_s = float(np.mean(np.diff(run.time_s)))
    radius_m, v = vehicle["wheel_radius_m"], run.speed_m_s

    def lost(values: np.ndarray) -> np.ndarray:
        return values[:20].mean(axis=0) - values[-20:].mean(axis=0)

    coast_N = (
        vehicle["resistance_A_N"]
        + vehicle["resistance_B_N_s_m"] * v
        + vehicle["resistance_C_N_s2_m2"] * v * v
    )
    momentum = (
        run.mass_kg * float(lost(v))
        - float(coast_N.sum()) * step_s
        + vehicle["wheelset_inertia_kgm2"] / radius_m * float(lost(run.wheel_speed_rad_s).sum())
    )
    if float(lost(v)) < 3.0 or momentum < 0.3 * run.mass_kg * float(lost(v)):
        return
    share = float(run.torque_Nm.sum()) * step_s / radius_m / momentum
    if 0.6 < share < 1.6:
        return
    said = f"{path}: brake_torque accounts for {share:.3g} of the momentum that the vehicle loses"
    why = _guess(share, _TORQUE, "")
    if why or not 0.1 < share < 10.0:
        raise ConfigError(f"{said}; 1 is right: {why or 'is it N m a wheelset?'}")
    warnings.append(
        f"{said}: another brake, a gradient or mass_kg is missing; causes in torque and "
        "resistance will be named for it"
    )


def check_clocks(runs: Sequence[Run], where: str, vehicle: Mapping[str, Any]) -> None:
    """Raises ConfigError where torque and wheel speed of a sliding wheel are shifted in time [D2].

    A clock is that of a channel or of a run: a weak sign on one wheelset in one run of several is chance.
    """
    found = np.array([[_late(run, j, vehicle) for j in range(AXLES)] for run in runs])
    seen, judged = found[..., 1] > 0.25, np.isfinite(found[..., 1])
    for r, j in np.argwhere(seen):
        (shift_s, clear), beside = found[r, j], (np.s_[r], np.s_[:, j])
        if clear > 0.5 or any(2 * seen[own].sum() > judged[own].sum() for own in beside):
            late, early = (
                ("wheel_speed", "brake_torque") if shift_s > 0 else ("brake_torque", "wheel_speed")
            )
            raise ConfigError(
                f"{where}: run '{runs[r].name}': {late} of wheelset {j + 1} comes {abs(shift_s):.2g} s "
                f"behind {early}; clocks may differ by {LATEST_S:g} s at most: shift one channel by that"
            )


def _late(run: Run, axle: int, vehicle: Mapping[str, Any]) -> tuple[float, float]:
    """(shift in s, correlation that it gains: nan where the wheel hardly slides, 0 where the shift may be)."""
    if (
        np.mean(np.abs(run.speed_m_s - vehicle["wheel_radius_m"] * run.wheel_speed_rad_s[:, axle]))
        < 1.0
    ):
        return 0.0, math.nan
    shift_s, best, at_zero = _shift(run, axle, vehicle["wheelset_inertia_kgm2"])
    return shift_s, best - at_zero if abs(shift_s) > LATEST_S and best > 0.5 else 0.0


def _shift(run: Run, axle: int, inertia_kgm2: float) -> tuple[float, float, float]:
    """(shift in s of greatest correlation, that correlation, correlation without shift)."""
    step_s = float(np.mean(np.diff(run.time_s)))
    window, second = 2 * max(int(0.1 / step_s), 3) + 1, max(int(1.0 / step_s), 4)
    moves = run.speed_m_s > 5.0
    if np.count_nonzero(moves) < 4 * second:
        return 0.0, 0.0, 0.0

    def quick(values: np.ndarray) -> np.ndarray:
        kept = (values - gaussian_filter1d(values, second))[moves]
        return (kept - kept.mean()) / max(float(kept.std()), 1e-12)

    gains = quick(inertia_kgm2 * smoothed(run.wheel_speed_rad_s[:, axle], window, 3, 1, step_s))
    takes = quick(-smoothed(run.torque_Nm[:, axle], window, 3))
    n = gains.size
    found = np.array(
        [
            np.mean(gains[max(0, k) : n + min(0, k)] * takes[max(0, -k) : n + min(0, -k)])
            for k in range(-second, second + 1)
        ]
    )
    at = int(np.argmax(found))
    return (at - second) * step_s, float(found[at]), float(found[second])
