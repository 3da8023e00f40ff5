"""Reads columns of a recorder's files with their stamps: CSV, Parquet, MDF4 and rosbag2.

Every column keeps its stamps, in seconds. A missing cell is NaN, because a gap is a finding here
and not an error. Stamps are numbers, instants of any unit and time zone, or text in the form of
ISO 8601. A CSV may have a row of units below the names.

rosbag2 needs the package rosbags (the extra `rosbag`). Its columns are written
"/topic:field.field". Their stamps come from the message header, else they are the times of
reception.
"""

import csv
import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv

from rollerrig.configs import table, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import dataset, mdf

# a unit of stamps -> its length in s
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

_ROSBAG_SUFFIXES = (".db3", ".mcap", ".bag")
_SEPARATORS = ",;\t"
_BRACKETS = " []()"  # around a unit


class Column(NamedTuple):
    """Stamps and values (n,), and the unit that the file gives, or ""."""

    time_s: np.ndarray
    values: np.ndarray
    unit: str


def read(
    path: Path, names: Sequence[str], head: Mapping[str, Any], folder: Path
) -> dict[str, Column]:
    """Return the columns of a file that have these names, from a dataset in `folder`.

    `head` holds the keys `separator` and `decimal` of dataset.toml, and for the column of the
    stamps its name `time` and its unit `time_unit`. MDF4 and rosbag2 need none of these keys: their
    stamps are part of the format. Raises ConfigError with the file and the column where something
    cannot be read.
    """
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in _ROSBAG_SUFFIXES:
        _check_rosbag(path, folder)
        return _read_rosbag(path, names)
    if suffix in mdf.SUFFIXES:
        user_files.check(path, user_files.MDF, folder, dataset.FILE_REMEDY)
        return _read_mdf(path, names)

    units: dict[str, str] = {}
    if suffix == ".parquet":
        data = dataset.read_table(path, folder)
    else:
        data, units = _read_csv(path, head, folder)
    for name in (head["time"], *names):
        _check_column(path, name, data.column_names)

    time_unit = units.get(head["time"], head["time_unit"])
    if time_unit not in TIME:
        raise ConfigError(
            f"{path}: the unit of '{head['time']}' is '{time_unit}'; allowed: {', '.join(TIME)}"
        )
    time_s = _seconds(path, data[head["time"]], head["time"], TIME[time_unit])
    has_stamp = np.isfinite(time_s)
    if not has_stamp.any():
        raise ConfigError(
            f"{path}: column '{head['time']}' has no stamp; name the column of the stamps as time_s"
        )

    columns = {}
    for name in names:
        values = _numbers(path, data[name], name, head["decimal"])
        columns[name] = Column(time_s[has_stamp], values[has_stamp], units.get(name, ""))
    return columns


def column_names(path: Path, head: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the names of the columns of a CSV or Parquet file.

    The list is empty for other files: their channels must be in dataset.toml.
    """
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        return list(dataset.read_table(path, folder).column_names)
    if suffix == ".csv":
        # called before [channels] is known, so the column of the stamps has its standard name
        data, _ = _read_csv(path, {**head, "time": "time_s"}, folder)
        return list(data.column_names)
    return []


def _check_column(path: Path, name: str, names: list[str]) -> None:
    """Raise ConfigError unless a name is there exactly once."""
    if names.count(name) > 1:
        raise ConfigError(
            f"{path}: column '{name}' is there {names.count(name)} times; give each column a "
            "different name"
        )
    if name not in names:
        raise ConfigError(
            f"{path}: column '{name}' is missing{table.nearest(name, names)}; name it in "
            "dataset.toml as `column` in [channels], the column of the stamps under time_s"
        )


# --- MDF4 ---


def _read_mdf(path: Path, names: Sequence[str]) -> dict[str, Column]:
    """Return the columns of an MDF4 file. Raises ConfigError."""
    signals = mdf.channels(path, tuple(names))
    for name in names:
        _check_column(path, name, list(signals))

    columns = {}
    for name, signal in signals.items():
        columns[name] = Column(
            time_s=np.asarray(signal.timestamps, float),
            values=_numbers(path, pa.array(signal.samples), name, "."),
            unit=str(signal.unit or "").strip(),
        )
    return columns


# --- CSV ---


def _read_csv(path: Path, head: Mapping[str, Any], folder: Path) -> tuple[pa.Table, dict[str, str]]:
    """Return the table, and the units by column where the second line holds units."""
    all_lines = user_files.read_text(
        path, user_files.CSV, folder, dataset.FILE_REMEDY, encoding="utf-8-sig"
    ).splitlines()
    # comment lines are allowed at the top only
    lines = list(itertools.dropwhile(lambda line: line.startswith("#"), all_lines))
    # the names, then either the units and a sample, or two samples
    if len(lines) < 3:
        raise ConfigError(
            f"{path}: the file has {len(lines)} lines; it needs a line of names and one line for "
            "each sample"
        )

    separator = head["separator"]
    if separator == "tab":
        separator = "\t"
    elif separator == "auto":
        separator = max(_SEPARATORS, key=lines[0].count)

    dataset.check_columns(path, lines[0].count(separator) + 1)
    names = next(csv.reader(lines[:1], delimiter=separator))
    second_line = next(csv.reader(lines[1:2], delimiter=separator))
    units = _units_of_line(names, second_line, head["time"])
    first_sample = 2 if units else 1
    text = "\n".join(lines[:1] + lines[first_sample:]) + "\n"

    try:
        data = pyarrow.csv.read_csv(
            pa.BufferReader(text.encode()),
            parse_options=pyarrow.csv.ParseOptions(delimiter=separator),
            convert_options=pyarrow.csv.ConvertOptions(decimal_point=head["decimal"]),
        )
    except (pa.ArrowInvalid, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be read as a table: {error}; the separator is taken as {separator!r}; "
            "write separator and decimal in dataset.toml if this is wrong"
        ) from None
    return data, units


def _units_of_line(names: list[str], line: list[str], time_name: str) -> dict[str, str]:
    """Return the units by column if this line is a line of units, else an empty dict.

    It is one if it has a unit of time in the column of the stamps. If no column has that name, the
    first column counts.
    """
    stamps_at = 0
    if time_name in names:
        stamps_at = names.index(time_name)
    if len(line) <= stamps_at or line[stamps_at].strip(_BRACKETS) not in TIME:
        return {}
    return {name: unit.strip(_BRACKETS) for name, unit in zip(names, line, strict=False)}


def _seconds(path: Path, values: pa.ChunkedArray, name: str, unit_s: float) -> np.ndarray:
    """Return stamps (n,) in s, NaN where there is none."""
    types = pa.types
    if types.is_string(values.type) or types.is_large_string(values.type):
        # Text with an offset from UTC fails without a zone and is read with the zone UTC. Text
        # without an offset is read without a zone, and the second cast keeps its count. Other
        # text fails twice and stays text.
        for zone in (None, "UTC"):
            with suppress(pa.ArrowInvalid):
                values = values.cast(pa.timestamp("ns", tz=zone))

    if types.is_timestamp(values.type):
        # Only the count since 1970 is used. It is in UTC if the file gives a zone, so it does not
        # jump when local clocks change to winter time.
        values = values.cast(pa.int64()).cast(pa.duration(values.type.unit))
    if types.is_duration(values.type):
        return _nanoseconds(values.cast(pa.duration("ns"))) * 1e-9
    if types.is_time(values.type):
        return _nanoseconds(values.cast(pa.time64("ns"))) * 1e-9

    try:
        return _numbers(path, values, name, ".") * unit_s
    except ConfigError:
        raise ConfigError(
            f"{path}: column '{name}' has neither numbers nor date and time; write "
            "2026-03-29 10:00:00.0, followed by Z or +02:00 if the time zone is known"
        ) from None


def _nanoseconds(values: pa.ChunkedArray) -> np.ndarray:
    """Return counts (n,) of a column of durations or times in ns."""
    return np.asarray(values.cast(pa.int64()).to_numpy(), float)


def _numbers(path: Path, values: Any, name: str, decimal: str) -> np.ndarray:
    """Return a column as numbers (n,), NaN where there is none."""
    try:
        # safe=False allows rounding: a float holds a count of ns since 1970 to about 0.3 us only
        numbers = values.cast(pa.float64(), safe=False)
        return np.asarray(numbers.to_numpy(zero_copy_only=False), float)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{path}: column '{name}' is not all numbers: {error}; write one number in each row, "
            f"with the decimal mark '{decimal}'"
        ) from None


# --- rosbag2 ---


def _check_rosbag(path: Path, folder: Path) -> None:
    """Raise ConfigError unless every file of a rosbag2 recording may be opened."""
    files = [path]
    if path.is_dir():
        files = sorted(path.iterdir())
    for file in files:
        user_files.check(file, user_files.ROSBAG, folder, dataset.FILE_REMEDY)


def _read_rosbag(path: Path, names: Sequence[str]) -> dict[str, Column]:
    """Return the columns of a rosbag2 recording. Raises ConfigError."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ConfigError(
            f"{path}: rosbag2 needs the package rosbags, which is not installed; install the extra: "
            "pip install 'rollerrig[rosbag]'"
        ) from None

    for name in names:
        if ":" not in name:
            raise ConfigError(
                f"{path}: column '{name}' names no field of a topic; write \"/topic:field.field\""
            )

    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            _collect_messages(path, bag, samples)
    except AttributeError as error:  # a message has no field of this name
        raise ConfigError(
            f'{path}: {error}; name a field that is a single number: "/topic:field.field"'
        ) from None
    except (AnyReaderError, OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: cannot be read as rosbag2: {error}") from None

    columns = {}
    for name, rows in samples.items():
        if not rows:
            raise ConfigError(f"{path}: '{name}' has no message")
        table_of_rows = np.array(rows)
        columns[name] = Column(table_of_rows[:, 0], table_of_rows[:, 1], "")
    return columns


def _collect_messages(path: Path, bag: Any, samples: dict[str, list[tuple[float, float]]]) -> None:
    """Append (stamp s, value) of every message to the samples of its fields."""
    topic_of = {}
    fields_of = {}  # path from the message to the number, field by field
    for name in samples:
        topic, _, fields = name.partition(":")
        topic_of[name] = topic
        fields_of[name] = fields.split(".")
    topics = {connection.topic for connection in bag.connections}
    for name in samples:
        _check_column(path, topic_of[name], sorted(topics))

    wanted = [connection for connection in bag.connections if connection.topic in topic_of.values()]
    for connection, received_ns, raw in bag.messages(connections=wanted):
        message: Any = bag.deserialize(raw, connection.msgtype)

        # the stamp of the header, if the message has one, else the time of reception
        time_s = received_ns * 1e-9
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        if stamp is not None:
            time_s = stamp.sec + stamp.nanosec * 1e-9

        for name in samples:
            if topic_of[name] == connection.topic:
                value = reduce(getattr, fields_of[name], message)
                samples[name].append((time_s, float(value)))
