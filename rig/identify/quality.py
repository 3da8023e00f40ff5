"""Refuses data from which nothing can be concluded, and warns of data from which little can.

Units, signs, sample times, gaps, excitation, copies: each check names the file, the value with its
unit, what is allowed, and how to mend it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rollerrig.configs.errors import ConfigError

if TYPE_CHECKING:
    from rollerrig.rig.identify.dataset import Dataset, Run

LEAST_SAMPLES = 200
# mean sliding below which a stop tells nothing about adhesion, m/s
LEAST_SLIDING_M_S = 0.15


def check_run(run: "Run", path: Path, sections: Mapping[str, Any], sample_time_s: float,
              initial_speed_m_s: float, warnings: list[str]) -> None:
    """Raises ConfigError for a run that cannot be what it says; appends what is only doubtful."""
    _check_time(run, path, sample_time_s)
    _check_units(run, path, sections, initial_speed_m_s)
    _check_constant(run, path)
    _check_signs(run, path, sections)
    _check_fall(run, path, warnings)


def _check_time(run: "Run", path: Path, sample_time_s: float) -> None:
    if run.time_s.size < LEAST_SAMPLES:
        raise ConfigError(f"{path}: {run.time_s.size} samples; a stop needs at least "
                          f"{LEAST_SAMPLES}; give a longer recording")
    steps = np.diff(run.time_s)
    if np.any(steps <= 0.0):
        at = int(np.argmax(steps <= 0.0))
        raise ConfigError(f"{path}: time_s does not rise at row {at + 3} "
                          f"({run.time_s[at]:g} s, then {run.time_s[at + 1]:g} s); sort the rows")
    typical = float(np.median(steps))
    if abs(typical - sample_time_s) > 0.02 * sample_time_s:
        raise ConfigError(f"{path}: samples are {typical:.6g} s apart, dataset.toml says "
                          f"sample_time_s = {sample_time_s:g}; is time_s in seconds? Correct one")
    gaps = np.flatnonzero(steps > 1.5 * sample_time_s)
    if gaps.size:
        raise ConfigError(f"{path}: {gaps.size} gaps, the first of {steps[gaps[0]]:.4g} s after "
                          f"t = {run.time_s[gaps[0]]:.4g} s; split the run there or resample it")


def _check_units(run: "Run", path: Path, sections: Mapping[str, Any], initial: float) -> None:
    v, radius = run.speed_m_s, sections["vehicle"]["wheel_radius_m"]
    top = float(np.max(v))
    if not 1.0 < top < 150.0:
        raise ConfigError(f"{path}: vehicle_speed_m_s reaches {top:.4g}; 1 to 150 m/s are allowed: "
                          "is it in another unit?")
    if initial > 0 and abs(np.median(v[:20]) - initial) > max(2.0, 0.1 * initial):
        raise ConfigError(f"{path}: starts at {np.median(v[:20]):.4g} m/s, dataset.toml says "
                          f"initial_speed_m_s = {initial:g}; is vehicle_speed_m_s in km/h?")
    first = slice(0, 50)
    for j in range(run.wheel_speed_rad_s.shape[1]):
        rolling = radius * np.median(run.wheel_speed_rad_s[first, j])
        ratio = rolling / max(float(np.median(v[first])), 1e-9)
        if not 0.5 < ratio < 1.5:
            raise ConfigError(
                f"{path}: wheelset {j + 1} runs at {ratio:.3g} times the vehicle's speed with "
                f"wheel_radius_m = {radius:g}; rolling wheels give 1: check the radius (metres) and "
                "the unit of wheel_speed (rad/s)")
    static = run.mass_kg * 9.80665 / run.load_N.shape[1]
    ratio = float(np.median(run.load_N)) / static
    if not 0.7 < ratio < 1.4:
        raise ConfigError(f"{path}: wheel_load is {np.median(run.load_N):.4g} N, a wheelset of this "
                          f"vehicle carries {static:.4g} N: loads are newtons for both wheels")
    most = sections["vehicle"]["wheel_radius_m"] * static
    if np.max(np.abs(run.torque_Nm)) > 2.0 * most:
        raise ConfigError(f"{path}: brake_torque reaches {np.max(np.abs(run.torque_Nm)):.4g} N m, "
                          f"more than adhesion 1 could hold ({most:.4g} N m): is it N m a wheelset?")


def _check_constant(run: "Run", path: Path) -> None:
    for name, values in (("vehicle_speed_m_s", run.speed_m_s[:, None]),
                         ("wheel_speed_rad_s", run.wheel_speed_rad_s),
                         ("brake_torque_Nm", run.torque_Nm)):
        for j in range(values.shape[1]):
            if np.ptp(values[:, j]) < 1e-9:
                raise ConfigError(f"{path}: {name} of channel {j + 1} is constant "
                                  f"({values[0, j]:g}); a channel that does not move cannot be used")


def _check_signs(run: "Run", path: Path, sections: Mapping[str, Any]) -> None:
    sliding = run.speed_m_s[:, None] - sections["vehicle"]["wheel_radius_m"] * run.wheel_speed_rad_s
    if np.mean(run.torque_Nm) < 0.0:
        raise ConfigError(f"{path}: the mean brake torque is {np.mean(run.torque_Nm):.4g} N m; "
                          "braking torque is positive: change its sign")
    if np.mean(sliding) < -0.2:
        raise ConfigError(f"{path}: the mean sliding is {np.mean(sliding):.3g} m/s; speed - radius x "
                          "wheel speed is positive in braking: check radius and channels")


def _check_fall(run: "Run", path: Path, warnings: list[str]) -> None:
    lost = float(run.speed_m_s[0] - run.speed_m_s[-1])
    if lost < 2.0:
        warnings.append(f"{path.name}: the speed falls by {lost:.3g} m/s only")


def check(found: "Dataset", where: str) -> None:
    """The dataset as a whole. Raises ConfigError where nothing can be concluded."""
    if not found.runs:
        raise ConfigError(f"{where}: no [[run]]; name at least two files")
    tune, validate = found.group("tune"), found.group("validate")
    if not tune:
        raise ConfigError(f"{where}: no run has group = \"tune\"; nothing can be fitted")
    _check_copies(found, where)
    radius = found.sections["vehicle"]["wheel_radius_m"]
    sliding = [float(np.mean(np.abs(run.speed_m_s[:, None] - radius * run.wheel_speed_rad_s)))
               for run in tune]
    if max(sliding) < LEAST_SLIDING_M_S:
        raise ConfigError(f"{where}: the wheels hardly slide (mean {max(sliding):.3g} m/s in the best "
                          f"run, {LEAST_SLIDING_M_S} m/s are needed): adhesion was never used up and "
                          "nothing can be said about it; brake harder or on a slippery rail")
    if len(tune) < 2:
        found.warnings.append("one run only is fitted: a cause seen in a single run is not named")
    if not validate:
        found.warnings.append("no run has group = \"validate\": no gain can be claimed")


def _check_copies(found: "Dataset", where: str) -> None:
    for i, one in enumerate(found.runs):
        for other in found.runs[i + 1:]:
            same = min(one.time_s.size, other.time_s.size)
            if np.array_equal(one.wheel_speed_rad_s[:same], other.wheel_speed_rad_s[:same]):
                raise ConfigError(f"{where}: runs '{one.name}' and '{other.name}' hold the same "
                                  "samples; a copy cannot validate: remove one")
