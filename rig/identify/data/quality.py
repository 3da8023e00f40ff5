"""Refuses data from which nothing can be concluded, and warns of data from which little can.

Units, signs, sample times, gaps, excitation, copies: each check names the file, the value with its
unit, what is allowed, and how to mend it.
"""

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import units
from rollerrig.rig.identify.data.runs import Dataset, Run

LEAST_SAMPLES = 200
LEAST_SLIDING_M_S = 0.15  # mean sliding below which a stop tells nothing about adhesion, m/s
LONGEST_HELD_S = 1.0


def check_run(run: Run, path: Path, found: Dataset, initial_speed_m_s: float) -> None:
    """Raises ConfigError for a run of a dataset that cannot be what it says; appends what is only doubtful."""
    vehicle, warnings = found.sections["vehicle"], found.warnings
    _check_time(run, path, found.sample_time_s)
    _check_constant(run, path)
    _check_speed(run, path, initial_speed_m_s)
    _check_signs(run, path)
    units.check(run, path, vehicle, warnings)
    _check_sliding(run, path, vehicle, warnings)
    _check_held(run, path, warnings)


def _check_time(run: Run, path: Path, sample_time_s: float) -> None:
    n = run.time_s.size
    if n < LEAST_SAMPLES:
        raise ConfigError(
            f"{path}: {n} samples; a stop needs at least {LEAST_SAMPLES}; give a longer recording"
        )
    steps = np.diff(run.time_s)
    if np.any(steps <= 0.0):
        at = int(np.argmax(steps <= 0.0))
        how = "stands still" if steps[at] == 0.0 else "goes back"
        raise ConfigError(
            f"{path}: time_s {how} at row {at + 3} ({run.time_s[at]:g} s, then "
            f"{run.time_s[at + 1]:g} s); sort the rows and remove those that stand twice"
        )
    typical = float(np.median(steps))
    if abs(typical - sample_time_s) > 0.1 * sample_time_s:
        unit = (
            "; time_s is in milliseconds: divide it by 1000"
            if (abs(typical / sample_time_s / 1000.0 - 1.0) < 0.1)
            else "; correct one of them"
        )
        raise ConfigError(
            f"{path}: samples are {typical:.6g} s apart, dataset.toml says "
            f"sample_time_s = {sample_time_s:g}{unit}"
        )
    gaps = np.flatnonzero(steps > 1.5 * sample_time_s)
    if gaps.size:
        raise ConfigError(
            f"{path}: {gaps.size} gaps, the first of {steps[gaps[0]]:.4g} s after "
            f"t = {run.time_s[gaps[0]]:.4g} s; split the run there or resample it"
        )
    uneven = np.flatnonzero(np.abs(steps - typical) > 0.15 * sample_time_s)
    if uneven.size > 0.01 * n:
        raise ConfigError(
            f"{path}: time_s is not even: steps from {steps.min():.4g} to {steps.max():.4g} "
            f"s where sample_time_s = {sample_time_s:g}; samples of one clock are wanted: "
            "resample with a low-pass filter, not by straight lines"
        )
    mean = float(run.time_s[-1] - run.time_s[0]) / (n - 1)
    if abs(mean - sample_time_s) > 0.003 * sample_time_s:
        raise ConfigError(
            f"{path}: {n} samples last {run.time_s[-1] - run.time_s[0]:.6g} s, which is "
            f"{mean:.6g} s each, dataset.toml says sample_time_s = {sample_time_s:g}: the "
            "clock drifts; correct time_s or sample_time_s"
        )


def _check_speed(run: Run, path: Path, initial: float) -> None:
    v, top = run.speed_m_s, float(np.max(run.speed_m_s))
    if not 1.0 < top < 150.0:
        raise ConfigError(
            f"{path}: vehicle_speed_m_s reaches {top:.4g}; 1 to 150 m/s are allowed: "
            "is it in another unit?"
        )
    if initial > 0 and abs(np.median(v[:20]) - initial) > max(2.0, 0.1 * initial):
        raise ConfigError(
            f"{path}: starts at {np.median(v[:20]):.4g} m/s, dataset.toml says "
            f"initial_speed_m_s = {initial:g}; is vehicle_speed_m_s in km/h?"
        )


def _check_constant(run: Run, path: Path) -> None:
    for name, values in (
        ("vehicle_speed_m_s", run.speed_m_s[:, None]),
        ("wheel_speed_rad_s", run.wheel_speed_rad_s),
        ("brake_torque_Nm", run.torque_Nm),
    ):
        for j in range(values.shape[1]):
            if np.ptp(values[:, j]) < 1e-9:
                raise ConfigError(
                    f"{path}: {name} of channel {j + 1} is constant "
                    f"({values[0, j]:g}); a channel that does not move cannot be used"
                )


def _check_signs(run: Run, path: Path) -> None:
    if np.mean(run.torque_Nm) < 0.0:
        raise ConfigError(
            f"{path}: the mean brake torque is {np.mean(run.torque_Nm):.4g} N m; "
            "braking torque is positive: change its sign"
        )
    for j in range(run.torque_Nm.shape[1]):
        if np.mean(run.torque_Nm[:, j]) < -0.1 * np.max(np.abs(run.torque_Nm)):
            raise ConfigError(
                f"{path}: brake_torque_{j + 1}_Nm is negative in the mean, the others are "
                "not: change its sign"
            )
        if np.median(run.wheel_speed_rad_s[:50, j]) < 0.0:
            raise ConfigError(
                f"{path}: wheel_speed_{j + 1}_rad_s is negative; wheels turn forwards with "
                "positive speed: change its sign"
            )


def _check_sliding(run: Run, path: Path, vehicle: Mapping[str, Any], warnings: list[str]) -> None:
    sliding = run.speed_m_s[:, None] - vehicle["wheel_radius_m"] * run.wheel_speed_rad_s
    if np.mean(sliding) < -0.2:
        raise ConfigError(
            f"{path}: the mean sliding is {np.mean(sliding):.3g} m/s; speed - radius x "
            "wheel speed is positive in braking: check radius and channels"
        )
    still = [
        str(j + 1)
        for j in range(sliding.shape[1])
        if np.mean(np.abs(sliding[:, j])) < LEAST_SLIDING_M_S
    ]
    if still:
        warnings.append(
            f"{path.name}: wheelset {', '.join(still)} hardly slides; of its friction this "
            "run tells little"
        )
    lost = float(run.speed_m_s[0] - run.speed_m_s[-1])
    if lost < 2.0 and np.isfinite(run.mass_kg):
        warnings.append(f"{path.name}: the speed falls by {lost:.3g} m/s only")


def _check_held(run: Run, path: Path, warnings: list[str]) -> None:
    """Channels that repeat their samples: stuck, or sampled slower than told."""
    moves = (run.speed_m_s > 5.0)[1:]
    if not np.any(moves):
        return
    for j in range(run.wheel_speed_rad_s.shape[1]):
        same = (
            (np.diff(run.wheel_speed_rad_s[:, j]) == 0.0)
            & (run.wheel_speed_rad_s[1:, j] > 0.0)
            & moves
        )
        at = np.flatnonzero(~same)
        longest = int(np.max(np.diff(np.concatenate([[-1], at, [same.size]])))) - 1
        step_s = float(run.time_s[1] - run.time_s[0])
        if longest * step_s > LONGEST_HELD_S:
            raise ConfigError(
                f"{path}: wheel_speed_{j + 1}_rad_s stays the same for {longest * step_s:.3g} "
                f"s while the vehicle runs; {LONGEST_HELD_S:g} s are allowed: the sensor was "
                "stuck: cut the run there"
            )
        if np.mean(same[moves]) > 0.4:
            warnings.append(
                f"{path.name}: {100 * np.mean(same[moves]):.0f} % of the samples of "
                f"wheel_speed_{j + 1}_rad_s repeat the one before: it was sampled slower than "
                "told, or rounded; delays cannot be judged"
            )


def check(found: Dataset, where: str) -> None:
    """The dataset as a whole. Raises ConfigError where nothing can be concluded."""
    if not found.runs:
        raise ConfigError(f"{where}: no [[run]]; name at least two files")
    tune, validate = found.group("tune"), found.group("validate")
    if not tune:
        raise ConfigError(f'{where}: no run has group = "tune"; nothing can be fitted')
    units.check_clocks(found.runs, where, found.sections["vehicle"])
    for one, other in combinations(found.runs, 2):
        if _shared(one, other):
            raise ConfigError(
                f"{where}: runs '{one.name}' and '{other.name}' hold the same samples; a copy tells "
                "nothing new and cannot validate: remove one"
            )
    radius = found.sections["vehicle"]["wheel_radius_m"]
    sliding = [
        float(np.mean(np.abs(run.speed_m_s[:, None] - radius * run.wheel_speed_rad_s)))
        for run in tune
    ]
    if max(sliding) < LEAST_SLIDING_M_S:
        raise ConfigError(
            f"{where}: the wheels hardly slide (mean {max(sliding):.3g} m/s in the best "
            f"run, {LEAST_SLIDING_M_S} m/s are needed): adhesion was never used up and "
            "nothing can be said about it; brake harder or on a slippery rail"
        )
    if len(tune) < 2:
        found.warnings.append("one run only is fitted: a cause seen in a single run is not named")
    if not validate:
        found.warnings.append('no run has group = "validate": no gain can be claimed')


def _shared(one: Run, other: Run, length: int = 50) -> bool:
    """Whether a stretch from the middle of a run, of wheel or vehicle speed, stands in another one too."""
    middle = one.time_s.size // 2
    for mine, its in (
        (one.wheel_speed_rad_s[:, 0], other.wheel_speed_rad_s[:, 0]),
        (one.speed_m_s, other.speed_m_s),
    ):
        piece = mine[middle : middle + length]
        starts = np.flatnonzero(its[: max(its.size - length, 0)] == piece[0])
        if any(np.array_equal(its[at : at + length], piece) for at in starts):
            return True
    return False
