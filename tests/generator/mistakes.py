"""Mistakes that users make with good data: each damages a copy of a dataset in one way.

A mistake changes the columns of every run, or a number of dataset.toml. None of them is an effect
of physics, so the right answer to each is a message that names the mistake. Nothing is imported
from the rig.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

AXLES = 4
# the vehicle of the sets, where dataset.toml does not give these numbers
VEHICLE = {"mass_kg": 43000.0, "wheel_radius_m": 0.445, "wheelset_inertia_kgm2": 160.0}
Columns = dict[str, np.ndarray]
Mistake = Callable[[Path], None]


# --- files ---


def read(path: Path) -> Columns:
    """Return the columns of a CSV file by name."""
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return dict(zip(names, values.T, strict=True))


def write(path: Path, columns: Columns) -> None:
    """Write columns to a CSV file."""
    np.savetxt(
        path,
        np.column_stack(list(columns.values())),
        delimiter=",",
        fmt="%.9g",
        header=",".join(columns),
        comments="",
    )


def copy_with(mistake: Mistake, source: Path, target: Path) -> Path:
    """Copy a dataset, make one mistake in the copy, and return the copy."""
    shutil.copytree(source, target)
    mistake(target)
    return target


def in_columns(change: Callable[[Columns], Columns]) -> Mistake:
    """Return the mistake of changing the columns of every run."""

    def make(folder: Path) -> None:
        for path in sorted((folder / "runs").glob("*.csv")):
            write(path, change(read(path)))

    return make


def _scaled_key(text: str, key: str, factor: float) -> str:
    """Return TOML with every value of a key multiplied by a factor."""
    return re.sub(
        rf"^{key} = ([0-9.e+-]+)$",
        lambda found: f"{key} = {float(found[1]) * factor!r}",
        text,
        flags=re.MULTILINE,
    )


def of_vehicle(key: str, factor: float) -> Mistake:
    """Return the mistake of a wrong number of the vehicle, in dataset.toml and in its runs."""

    def make(folder: Path) -> None:
        path = folder / "dataset.toml"
        text = _scaled_key(path.read_text(encoding="utf-8"), key, factor)
        table = re.search(r"^\[vehicle\]$(?:\n(?!\[).*)*", text, re.MULTILINE)
        if table is None:
            text += f"\n[vehicle]\n{key} = {VEHICLE[key] * factor!r}\n"
        else:
            assert f"\n{key} = " in table[0]
        path.write_text(text, encoding="utf-8")

    return make


def of_accuracy(key: str, factor: float) -> Mistake:
    """Return the mistake of a wrong declared accuracy."""

    def make(folder: Path) -> None:
        path = folder / "dataset.toml"
        text = path.read_text(encoding="utf-8")
        changed = _scaled_key(text, key, factor)
        assert changed != text
        path.write_text(changed, encoding="utf-8")

    return make


# --- channels ---

SPEED = ("vehicle_speed_m_s",)
WHEELS = tuple(f"wheel_speed_{axle}_rad_s" for axle in range(1, AXLES + 1))
LOADS = tuple(f"wheel_load_{axle}_N" for axle in range(1, AXLES + 1))
TORQUES = tuple(f"brake_torque_{axle}_Nm" for axle in range(1, AXLES + 1))


def scaled(names: tuple[str, ...], factor: float) -> Mistake:
    """Return the mistake of writing channels in another unit."""

    def change(columns: Columns) -> Columns:
        return columns | {name: columns[name] * factor for name in names}

    return in_columns(change)


def exchanged(names: tuple[str, ...], order: tuple[int, ...]) -> Mistake:
    """Return the mistake of connecting channel k to the sensor of wheelset order[k], from 0."""

    def change(columns: Columns) -> Columns:
        return columns | {name: columns[names[k]] for name, k in zip(names, order, strict=True)}

    return in_columns(change)


def reversed_axles(columns: Columns) -> Columns:
    """Count the wheelsets from the rear."""
    other = dict(columns)
    for names in (WHEELS, LOADS, TORQUES):
        for name, opposite in zip(names, reversed(names), strict=True):
            other[name] = columns[opposite]
    return other


def interpolated(names: tuple[str, ...], every: int) -> Mistake:
    """Return the mistake of filling a lower sample rate up by straight lines."""

    def change(columns: Columns) -> Columns:
        time_s = columns["time_s"]
        kept = np.arange(0, time_s.size, every)
        filled = {name: np.interp(time_s, time_s[kept], columns[name][kept]) for name in names}
        return columns | filled

    return in_columns(change)


def low_passed(names: tuple[str, ...], samples: float) -> Mistake:
    """Return the mistake of smoothing channels, by a Gaussian window of this deviation."""

    def change(columns: Columns) -> Columns:
        return columns | {name: gaussian_filter1d(columns[name], samples) for name in names}

    return in_columns(change)


def stamped_too_fast(share: float) -> Mistake:
    """Return the mistake of a clock that counts more seconds than pass."""

    def change(columns: Columns) -> Columns:
        return columns | {"time_s": columns["time_s"] * (1.0 + share)}

    def make(folder: Path) -> None:
        in_columns(change)(folder)
        path = folder / "dataset.toml"
        text = path.read_text(encoding="utf-8")
        path.write_text(_scaled_key(text, "sample_time_s", 1.0 + share), encoding="utf-8")

    return make


def speed_of_wheels(
    reference: Callable[[np.ndarray], np.ndarray], radius_m: float = 0.445
) -> Mistake:
    """Return the mistake of a vehicle speed that is a function of the rims' speeds (n, AXLES)."""

    def change(columns: Columns) -> Columns:
        rims_m_s = radius_m * np.column_stack([columns[name] for name in WHEELS])
        return columns | {"vehicle_speed_m_s": reference(rims_m_s)}

    return in_columns(change)


def fastest(rims_m_s: np.ndarray) -> np.ndarray:
    """Return the speed of the fastest wheelset."""
    return rims_m_s.max(axis=1)


def second_fastest(rims_m_s: np.ndarray) -> np.ndarray:
    """Return the speed of the second fastest wheelset."""
    return np.sort(rims_m_s, axis=1)[:, -2]


def mean(rims_m_s: np.ndarray) -> np.ndarray:
    """Return the mean speed of the wheelsets."""
    return rims_m_s.mean(axis=1)


def slowly_falling(rims_m_s: np.ndarray) -> np.ndarray:
    """Return the reference of a slide protection: the fastest wheel, at most 1.8 m/s2."""
    step_s = 0.01
    most_m_s = 1.8 * step_s
    reference = rims_m_s.max(axis=1).copy()
    for k in range(1, reference.size):
        reference[k] = max(reference[k], reference[k - 1] - most_m_s)
    return reference


def commanded_torque(columns: Columns) -> Columns:
    """Write the torque that the driver commanded, without the slide protection."""
    other = dict(columns)
    for name in TORQUES:
        smooth = gaussian_filter1d(columns[name], 5.0)
        level = np.quantile(smooth, 0.98)
        applied = np.maximum.accumulate(np.clip(smooth, 0.0, level))
        noise = columns[name] - smooth
        other[name] = applied + noise
    return other


def one_wheel_twice(columns: Columns) -> Columns:
    """Write the speed of wheelset 1 in the column of wheelset 2 too."""
    return columns | {WHEELS[1]: columns[WHEELS[0]]}


def whole_kilometres_an_hour(columns: Columns) -> Columns:
    """Write the vehicle's speed in m/s, rounded to whole km/h before."""
    return columns | {SPEED[0]: np.round(columns[SPEED[0]] * 3.6) / 3.6}
