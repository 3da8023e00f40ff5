"""Profiles from CSV files: two columns in millimetres, checked before anything is built on them.

A wheel has the columns `s_mm, z_mm`: s = 0 on the nominal running circle, negative towards the
flange; z positive where the rolling radius is larger. A rail has the columns `y_mm, z_mm`: y = 0 in
the head's axis of symmetry, negative towards the gauge side; z upwards, the head upright. A first
line of names is optional, further columns are ignored, lines that begin with # are comments.

Other programs (CONTACT, Simpack) write rails with z downwards, or wheels with the flange on the
other side. The shape shows it: a flange is where the radius is largest, a rail head falls to both
sides. Such a file is refused with the axis to flip. The gauge side of a rail is not checked,
because a head that is not worn is the same on both sides.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError

FEWEST_POINTS = 10
# units that users confuse with mm, and their size in mm
OTHER_UNITS_MM = (("m", 1e3), ("cm", 10.0), ("inches", 25.4), ("um", 1e-3))


class Kind(NamedTuple):
    """What a profile must be."""

    name: str
    gap_mm: float  # widest gap between two points
    from_mm: float  # the profile must reach from here
    to_mm: float  # to here
    width_mm: tuple[float, float]  # smallest and largest width
    height_mm: tuple[float, float]  # smallest and largest height


# a rail's top and sides are compared: within this distance of the middle, and of both ends
TOP_MM = 10.0
SIDE_MM = 5.0

WHEEL = Kind("wheel", 3.0, -45.0, 30.0, (75.0, 160.0), (10.0, 60.0))
RAIL = Kind("rail", 3.0, -32.0, 20.0, (50.0, 90.0), (3.0, 60.0))


def read(path: str | Path, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """Return the lateral coordinates, rising, and the vertical coordinates of a file in m.

    Raises ConfigError for cells that are no numbers, other units than mm, gaps, folds and profiles
    that are too short.
    """
    points = _numbers(Path(path), kind)
    if len(points) < FEWEST_POINTS:
        raise ConfigError(
            f"{path}: {len(points)} points; a {kind.name} profile needs at least {FEWEST_POINTS}"
        )
    if points[0][1] > points[-1][1]:
        points = points[::-1]
    lines, y, z = np.array(points).T
    _check_units(path, kind, y, z)

    step = np.diff(y)
    if np.any(step <= 0.0):
        i = int(np.argmax(step <= 0.0))
        raise ConfigError(
            f"{path}, line {lines[i + 1]:.0f}: the profile folds back, from {y[i]:g} to "
            f"{y[i + 1]:g} mm; the first column must rise from point to point: sort or cut the "
            "points"
        )
    if step.max() > kind.gap_mm:
        i = int(np.argmax(step))
        raise ConfigError(
            f"{path}, line {lines[i + 1]:.0f}: a gap of {step[i]:g} mm after {y[i]:g} mm; at most "
            f"{kind.gap_mm:g} mm are bridged: measure or interpolate the points between"
        )
    if kind is WHEEL:
        _check_axes_of_wheel(path, y, z)
    else:
        _check_axes_of_rail(path, y, z)
    if y[0] > kind.from_mm or y[-1] < kind.to_mm:
        raise ConfigError(
            f"{path}: the {kind.name} profile runs from {y[0]:g} to {y[-1]:g} mm; it must reach "
            f"from {kind.from_mm:g} to {kind.to_mm:g} mm: move its origin or measure farther"
        )
    return y * 1e-3, z * 1e-3


def _numbers(path: Path, kind: Kind) -> list[tuple[int, float, float]]:
    """Return the number of the line and both coordinates in mm of each point."""
    remedy = f"for the {kind.name} give s1002, uic60 or a CSV file of two columns in mm"
    text = user_files.read_text(path, user_files.PROFILE, None, remedy, "utf-8-sig")

    points: list[tuple[int, float, float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        cells = re.split("[,;\t]", line)
        try:
            y = float(cells[0])
            z = float(cells[1])
        except (ValueError, IndexError):
            is_line_of_names = not points and not re.match(r"[-+.\d]|$", cells[0].strip())
            if is_line_of_names:
                continue
            raise ConfigError(
                f"{path}, line {number}: '{line.strip()[:40]}' is not two numbers; "
                "write y, z in mm, with a decimal point"
            ) from None
        if not np.isfinite(y) or not np.isfinite(z):
            raise ConfigError(
                f"{path}, line {number}: {y}, {z}: both must be finite; remove the point"
            )
        points.append((number, y, z))
    return points


def _check_units(path: str | Path, kind: Kind, y: np.ndarray, z: np.ndarray) -> None:
    """Raise ConfigError where the extent of a profile is not that of a wheel or rail in mm."""
    extents = (
        ("wide", float(np.ptp(y)), kind.width_mm),
        ("high", float(np.ptp(z)), kind.height_mm),
    )
    for word, extent, (low, high) in extents:
        if low <= extent <= high:
            continue
        hint = "cut everything that is not the running surface"
        for unit, size_mm in OTHER_UNITS_MM:
            if low <= extent * size_mm <= high:
                hint = f"it looks like {unit}: write mm"
        raise ConfigError(
            f"{path}: the {kind.name} profile is {extent:g} mm {word}; "
            f"{low:g} to {high:g} mm are allowed; {hint}"
        )


def _check_axes_of_wheel(path: str | Path, s: np.ndarray, z: np.ndarray) -> None:
    """Raise ConfigError where the flange is on the field side, or points to the axle."""
    # the tread is more than half of a profile
    height = z - np.median(z)
    farthest = int(np.argmax(np.abs(height)))
    axes = []
    if s[farthest] > 0.5 * (s[0] + s[-1]):
        axes.append("s")
    if height[farthest] < 0.0:
        axes.append("z")
    if axes:
        raise ConfigError(
            f"{path}: the flange (the point farthest from the tread) is at s = {s[farthest]:g} mm, "
            f"z = {z[farthest]:g} mm; it must be at negative s, and z must be larger there, because "
            f"z grows with the rolling radius: flip the sign of {' and '.join(axes)}"
        )


def _check_axes_of_rail(path: str | Path, y: np.ndarray, z: np.ndarray) -> None:
    """Raise ConfigError where the sides of a rail head are above its top."""
    middle = 0.5 * (y[0] + y[-1])
    top = float(np.interp(np.linspace(-TOP_MM, TOP_MM, 21) + middle, y, z).mean())
    left = float(np.interp(np.linspace(y[0], y[0] + SIDE_MM, 11), y, z).mean())
    right = float(np.interp(np.linspace(y[-1] - SIDE_MM, y[-1], 11), y, z).mean())
    if left > top and right > top:
        raise ConfigError(
            f"{path}: both sides of the rail head ({left:.3g} and {right:.3g} mm) are above its top "
            f"({top:.3g} mm), so z points downwards; z must point upwards: flip the sign of z"
        )
