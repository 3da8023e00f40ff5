"""Reads channels of an MDF4 file onto one clock, which the channels of a measuring car seldom share.

A channel that is sampled faster is low-passed and thinned; one whose samples lie between those of the common clock is
moved onto it by a cubic spline through its samples, and a warning says so. Straight lines between samples would smooth
the noise and look like physics. Needs asammdf (the extra `mdf`). Source of the format: ASAM MDF 4.1.
"""

import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.interpolate import CubicSpline
from scipy.signal import resample_poly

from rollerrig.configs.errors import ConfigError

SUFFIXES = (".mf4", ".mdf")
# spellings of the unit that a channel's name ends with; a channel without a unit is taken at its name
_UNITS = {
    "m_s": ("m/s", "m_s", "m*s^-1", "mps"),
    "rad_s": ("rad/s", "rad_s", "1/s", "s^-1"),
    "N": ("N",),
    "Nm": ("Nm", "N m", "N*m", "N·m"),
    "Pa": ("Pa",),
    "K": ("K",),
    "m": ("m",),
}
_SAME = 0.01  # a shift below this share of a sample is none


def read(path: Path, step_s: float, names: tuple[str, ...], warnings: list[str]) -> pa.Table:
    """Those channels of a file that it has, on one clock of `step_s`, with `time_s`.

    Raises ConfigError where asammdf is missing, the file is damaged, or a channel has gaps, another
    unit, or no time in common with the others.
    """
    found = channels(path, names)
    checked = {name: _checked(signal, name, path) for name, signal in found.items()}
    first = max(float(time[0]) for time, _ in checked.values())
    last = min(float(time[-1]) for time, _ in checked.values())
    if last - first < step_s:
        raise ConfigError(
            f"{path}: its channels have no time in common (the latest begins at {first:g} s, "
            f"the earliest ends at {last:g} s)"
        )
    # the clock of the first wheel speed: an innovation must not be a matter of interpolation
    lead = checked.get("wheel_speed_1_rad_s", next(iter(checked.values())))[0][0]
    first = lead + step_s * math.ceil((first - lead) / step_s - 1e-6)
    grid = first + step_s * np.arange(int((last - first) / step_s + 1e-6) + 1)
    columns, moved = {"time_s": grid - first}, []
    for name, (time, values) in checked.items():
        columns[name], shift = _on_clock(time, values, grid, step_s)
        if shift > _SAME:
            moved.append(f"{name} by {1e3 * shift * step_s:.2g} ms")
    if moved:
        warnings.append(
            f"{path.name}: channels of other clocks were moved onto one: {', '.join(moved)}; "
            "delays below a sample cannot be judged"
        )
    return pa.table(columns)


def channels(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Those channels of a file that it has, as asammdf's signals. Raises ConfigError where it cannot be read."""
    try:
        from asammdf import MDF
    except ImportError:
        raise ConfigError(
            f"{path}: MDF files need the package asammdf, which is not installed; install "
            "the extra: pip install 'rollerrig[mdf]'"
        ) from None
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; correct `file` in dataset.toml")
    try:
        with MDF(path) as file:
            twice = [name for name in names if len(file.channels_db.get(name, ())) > 1]
            found = {
                name: file.get(name) for name in names if name in file.channels_db and not twice
            }
    except Exception as error:  # asammdf raises whatever its parser meets
        raise ConfigError(f"{path}: cannot be read as MDF: {error}") from None
    if twice:
        raise ConfigError(
            f"{path}: channel '{twice[0]}' is there more than once; give each a name of its own"
        )
    if not found:
        raise ConfigError(
            f"{path}: none of the channels {', '.join(names[:3])} ... is in it; name the "
            "channels as the README has them"
        )
    return found


def _checked(signal: Any, name: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    unit = str(signal.unit or "").strip()
    wanted = next((allowed for tail, allowed in _UNITS.items() if name.endswith(f"_{tail}")), ())
    if unit and wanted and unit not in wanted:
        raise ConfigError(
            f"{path}: {name} has the unit '{unit}'; '{wanted[0]}' is wanted: convert it"
        )
    time, values = np.asarray(signal.timestamps, float), np.asarray(signal.samples, float)
    steps = np.diff(time)
    if time.size < 4:
        raise ConfigError(f"{path}: {name} has {time.size} samples; give a longer recording")
    if np.any(steps <= 0.0):
        raise ConfigError(
            f"{path}: the time of {name} does not rise after {time[np.argmin(steps)]:g} s"
        )
    typical = float(np.median(steps))
    if steps.max() > 1.5 * typical:
        raise ConfigError(
            f"{path}: {name} has a gap of {steps.max():.4g} s after "
            f"{time[np.argmax(steps)]:.4g} s; cut the file there into two runs"
        )
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ConfigError(
            f"{path}: {name} is not a finite number in {bad.size} samples, the first at "
            f"{time[bad[0]]:g} s"
        )
    return time, values


def _on_clock(
    time: np.ndarray, values: np.ndarray, grid: np.ndarray, step_s: float
) -> tuple[np.ndarray, float]:
    """Values on the grid, and how far samples had to be moved, in samples of the grid."""
    own_s = float(time[-1] - time[0]) / (time.size - 1)
    if own_s < 0.95 * step_s:
        ratio = Fraction(step_s / own_s).limit_denominator(100)
        values = resample_poly(values, ratio.denominator, ratio.numerator, padtype="line")
        time = time[0] + step_s * np.arange(values.size)
    at = (grid - time[0]) / step_s
    if abs(own_s / step_s - 1.0) < 0.05 or own_s < step_s:
        shift = float(np.max(np.abs(at - np.rint(at))))
        if shift <= _SAME and np.rint(at[-1]) < values.size:
            return values[np.rint(at).astype(int)], 0.0
    else:
        shift = own_s / step_s
    return CubicSpline(time, values)(grid), shift
