"""Reads channels of an MDF4 file and resamples them to one common clock.

The channels of a measuring car often have different clocks. A channel with a higher sample rate is
low-passed and thinned. A channel whose samples lie between those of the common clock is moved by a
cubic spline through its samples, and a warning reports that. Straight lines between samples would
smooth the noise, which would look like physics. The package asammdf is needed (the extra `mdf`).

A channel of a file may have a formula that converts its values. asammdf evaluates this text as
Python, so a file could run code. Formulas that are more than arithmetic are refused.

Source of the format: ASAM MDF 4.1.
"""

import contextlib
import gc
import math
import mmap
import re
import struct
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy.interpolate import CubicSpline

from rollerrig.configs import unpacking
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files.tables import Table

SUFFIXES = (".mf4", ".mdf")
# Accepted spellings of a unit, by the end of the channel's name. A channel without a unit in the
# file is taken to have the unit in its name.
_UNITS = {
    "m_s": ("m/s", "m_s", "m*s^-1", "mps"),
    "rad_s": ("rad/s", "rad_s", "1/s", "s^-1"),
    "N": ("N",),
    "Nm": ("Nm", "N m", "N*m", "N·m"),
    "Pa": ("Pa",),
    "K": ("K",),
    "m": ("m",),
}
_LEAST_SHIFT = 0.01  # share of a sample; smaller shifts are ignored
# A conversion of a channel that is evaluated: numbers, the value X or X1, + - * / and brackets.
# Powers are left out, because a short formula with powers of powers never ends.
_ARITHMETIC = re.compile(
    r"""(?:
        (?:\d++(?:\.\d*+)?+ | \.\d++) (?:[eE][-+]?\d++)?+    # a number
        | X1?+\b
        | \*(?!\s*\*)
        | [-+/()\s]
    )*+""",
    re.ASCII | re.VERBOSE,
)
_LONGEST_FORMULA = 200
# nothing here needs the frames of a bus logger, and to read them asammdf would convert channels
_WITHOUT_FRAMES: Any = {"process_bus_logging": False}
_SHOWN_OF_FORMULA = 60
_LISTED_SAMPLES = 1000  # of a channel that is listed
_LEAST_SAMPLES = 4  # a cubic spline needs them
_LONGEST_STEP = 1.5  # times the typical step; a longer one is a gap

# what a file may need in memory
_MOST_BYTES = 1_000_000_000
_STAMP_BYTES = 8

# a compressed block
_ZIPPED = b"##DZ"
_ZIP_HEADER = struct.Struct("<26xB5xQQ")
_DEFLATE = (0, 1)  # methods: plain, and with transposed bytes


class _ZipHeader(NamedTuple):
    """The header of a compressed block."""

    method: int
    unpacked_bytes: int
    packed_bytes: int


def read(
    path: Path,
    step_s: float,
    names: tuple[str, ...],
    warnings: list[str],
    lead: str,
    mapped: Collection[str] = (),
) -> Table:
    """Return those channels of a file that exist, on one clock of `step_s`, and `time_s`.

    `lead` is the channel of the first wheel speed. `mapped` are channels that dataset.toml names:
    the unit in the file is returned, and not held against the unit in the name.

    Adds a warning where samples were moved. Raises ConfigError where asammdf is missing, the file
    is damaged, or a channel has gaps, another unit, or no time in common with the others.
    """
    signals = channels(path, names)
    found_units = {}
    checked = {}
    for name, signal in signals.items():
        unit = str(signal.unit or "").strip()
        if name in mapped:
            found_units[name] = unit
        else:
            _check_unit(unit, name, path)
        checked[name] = _checked(signal, name, path)

    first_s = max(float(time[0]) for time, _ in checked.values())
    last_s = min(float(time[-1]) for time, _ in checked.values())
    if last_s - first_s < step_s:
        raise ConfigError(
            f"{path}: its channels have no time in common (the latest begins at {first_s:g} s, the "
            f"earliest ends at {last_s:g} s); give channels that were recorded together"
        )

    # the common clock is that of the first wheel speed: interpolation must not change innovations
    lead_time, _ = checked.get(lead, next(iter(checked.values())))
    lead_s = lead_time[0]
    first_s = lead_s + step_s * math.ceil((first_s - lead_s) / step_s - 1e-6)
    grid_s = first_s + step_s * np.arange(int((last_s - first_s) / step_s + 1e-6) + 1)

    columns = {"time_s": grid_s - first_s}
    moved = []
    for name, (time_s, values) in checked.items():
        columns[name], shift = _on_clock(time_s, values, grid_s, step_s)
        if shift > _LEAST_SHIFT:
            moved.append(f"{name} by {1e3 * shift * step_s:.2g} ms")
    if moved:
        warnings.append(
            f"{path.name}: channels with other clocks were moved to the common clock: "
            f"{', '.join(moved)}; delays below one sample cannot be judged"
        )
    return Table(pa.table(columns), found_units, 0, "MDF4")


def channels(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Return those channels of a file that exist, as signals of asammdf, by name.

    Raises ConfigError where the file cannot be read or has none of the channels.
    """
    signals = {}
    with _opened(path) as file:
        repeated = [name for name in names if len(file.channels_db.get(name, ())) > 1]
        if not repeated:
            signals = {name: file.get(name) for name in names if name in file.channels_db}
    if repeated:
        raise ConfigError(
            f"{path}: channel '{repeated[0]}' is there more than once; give each channel a different "
            "name"
        )
    if not signals:
        raise ConfigError(
            f"{path}: has none of the channels {', '.join(names[:3])} ...; name the channels as "
            "described in the README"
        )
    return signals


class Listed(NamedTuple):
    """A channel of a file: its name, its unit or "", and its first values, NaN if it is text."""

    name: str
    unit: str
    numbers: np.ndarray


def listed(path: Path) -> list[Listed]:
    """Return the channels of a file that have a name of their own, without those of time.

    Raises ConfigError where the file cannot be read.
    """
    with _opened(path) as file:
        channels_of_file = []
        for name, places in file.channels_db.items():
            group, index = places[0]
            if len(places) > 1 or file.masters_db.get(group) == index:
                continue
            signal = file.get(name, record_count=_LISTED_SAMPLES)
            numbers = np.full(len(signal.samples), np.nan)
            if signal.samples.ndim == 1 and signal.samples.dtype.kind in "biuf":
                numbers = np.asarray(signal.samples, float)
            channels_of_file.append(Listed(name, str(signal.unit or "").strip(), numbers))
    return channels_of_file


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield a file of asammdf after all checks.

    Raises ConfigError if the file cannot be read, also inside the block.
    """
    try:
        from asammdf import MDF
    except ImportError:
        raise ConfigError(
            f"{path}: MDF files need the package asammdf, which is not installed; install the extra: "
            "pip install 'rollerrig[mdf]'"
        ) from None
    _check_blocks(path)
    try:
        with MDF(path, **_WITHOUT_FRAMES) as file:
            _check_size(path, file.groups)
            _refuse_code(file, path)
            yield file
    except ConfigError:
        raise
    except Exception as error:  # the parser of asammdf raises many types
        _delete_unread(error)
        raise ConfigError(
            f"{path}: cannot be read as MDF: {error}; copy it again, it may be cut off"
        ) from None


def _delete_unread(error: Exception) -> None:
    """Delete the file object of asammdf that an error has kept, and ignore what this raises.

    asammdf raises another error when a file that it could not read is deleted, and Python would
    print that one with a traceback.
    """
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        traceback.clear_frames(error.__traceback__)
        gc.collect()
    finally:
        sys.unraisablehook = hook


def _check_blocks(path: Path) -> None:
    """Raise ConfigError if the compressed blocks of a file unpack to more than the limit."""
    with path.open("rb") as file:
        if not path.stat().st_size:
            return  # an empty file cannot be mapped
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            unpacked = 0
            at = content.find(_ZIPPED)
            while at >= 0 and unpacked <= _MOST_BYTES:
                unpacked += _unpacked_bytes(content, at)
                at = content.find(_ZIPPED, at + 1)
    if unpacked > _MOST_BYTES:
        raise _too_large(path)


def _unpacked_bytes(content: mmap.mmap, at: int) -> int:
    """Return the size to which the compressed block at a place unpacks."""
    if at + _ZIP_HEADER.size > len(content):
        return 0
    header = _ZipHeader(*_ZIP_HEADER.unpack_from(content, at))
    begin = at + _ZIP_HEADER.size
    if header.method not in _DEFLATE:
        return int(header.unpacked_bytes)
    with memoryview(content) as view, view[begin : begin + header.packed_bytes] as packed:
        return unpacking.inflated_bytes(packed, _MOST_BYTES)


def _check_size(path: Path, groups: Iterable[Any]) -> None:
    """Raise ConfigError if the channels of a file need more memory than the limit."""
    needed = 0
    for group in groups:
        channel_group = group.channel_group
        # a sample has a stamp, also if the group stores none
        row_bytes = getattr(channel_group, "samples_byte_nr", 0) + _STAMP_BYTES
        needed += row_bytes * channel_group.cycles_nr
    if needed > _MOST_BYTES:
        raise _too_large(path)


def _too_large(path: Path) -> ConfigError:
    return ConfigError(
        f"{path}: its channels need more than {_MOST_BYTES / 1e6:.4g} MB of memory, which are "
        "allowed: split it, or export only the channels that are needed"
    )


def _refuse_code(file: Any, path: Path) -> None:
    """Raise ConfigError if the conversion of a channel is a formula that is not plain arithmetic.

    Every channel counts, because the time of a channel has a conversion, too.
    """
    for group in file.groups:
        for channel in group.channels:
            for formula in _formulas(channel.conversion):
                if len(formula) > _LONGEST_FORMULA or not _ARITHMETIC.fullmatch(formula):
                    raise ConfigError(
                        f"{path}: the conversion of channel '{channel.name}' is the formula "
                        f"{formula[:_SHOWN_OF_FORMULA]!r}, which would run as code; allowed is "
                        "arithmetic with numbers, X, + - * / and brackets: save the file with "
                        "converted values, or without this channel"
                    )


def _formulas(conversion: Any) -> Iterator[str]:
    """Yield the formulas of a conversion of asammdf, and of the conversions that it refers to."""
    formula = getattr(conversion, "formula", "")
    if formula:
        yield formula
    # some references are plain text
    for block in (getattr(conversion, "referenced_blocks", None) or {}).values():
        yield from _formulas(block)


def _checked(signal: Any, name: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return (time in s, values) of a signal. Raises ConfigError."""
    time_s = np.asarray(signal.timestamps, float)
    values = np.asarray(signal.samples, float)
    if time_s.size < _LEAST_SAMPLES:
        raise ConfigError(f"{path}: {name} has {time_s.size} samples; give a longer recording")

    steps_s = np.diff(time_s)
    if np.any(steps_s <= 0.0):
        raise ConfigError(
            f"{path}: the time of {name} does not increase after {time_s[np.argmin(steps_s)]:g} s; "
            "sort the samples"
        )
    typical_s = float(np.median(steps_s))
    if steps_s.max() > _LONGEST_STEP * typical_s:
        raise ConfigError(
            f"{path}: {name} has a gap of {steps_s.max():.4g} s after "
            f"{time_s[np.argmax(steps_s)]:.4g} s; split the file there into two runs"
        )
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ConfigError(
            f"{path}: {name} is not a finite number in {bad.size} samples, the first at "
            f"{time_s[bad[0]]:g} s; split the run at the gap into two runs, or repair it"
        )
    return time_s, values


def _check_unit(unit: str, name: str, path: Path) -> None:
    """Raise ConfigError where the unit in the file is not the unit in the channel's name."""
    for ending, allowed in _UNITS.items():
        if name.endswith(f"_{ending}"):
            if unit and unit not in allowed:
                raise ConfigError(
                    f"{path}: {name} has the unit '{unit}'; '{allowed[0]}' is required: convert it"
                )
            return


def _on_clock(
    time_s: np.ndarray, values: np.ndarray, grid_s: np.ndarray, step_s: float
) -> tuple[np.ndarray, float]:
    """Return (values on the grid, how far samples had to be moved in samples of the grid)."""
    own_step_s = float(time_s[-1] - time_s[0]) / (time_s.size - 1)
    if own_step_s < 0.95 * step_s:
        # the package takes a second of processor time to import, and few files need it
        from scipy.signal import resample_poly

        # a higher sample rate: low-pass and thin it
        ratio = Fraction(step_s / own_step_s).limit_denominator(100)
        values = resample_poly(values, ratio.denominator, ratio.numerator, padtype="line")
        time_s = time_s[0] + step_s * np.arange(values.size)

    same_rate = abs(own_step_s / step_s - 1.0) < 0.05 or own_step_s < step_s
    if same_rate:
        position = (grid_s - time_s[0]) / step_s
        nearest = np.rint(position)
        shift = float(np.max(np.abs(position - nearest)))
        if shift <= _LEAST_SHIFT and nearest[-1] < values.size:
            return values[nearest.astype(int)], 0.0
    else:
        shift = own_step_s / step_s
    return CubicSpline(time_s, values)(grid_s), shift
