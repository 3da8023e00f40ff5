"""Columns of a recorder's files with their stamps: CSV of any separator, Parquet, MDF4, rosbag2.

Every column keeps its own stamps in seconds; a missing cell is NaN, for a gap is a finding here and no error. Stamps
are numbers, or instants of any unit and zone, or text as ISO 8601 has it. A row of units below the names is read.
rosbag2 needs the package rosbags (the extra `rosbag`); a column there is written "/topic:field.field", and stamps are
the header's, else those of reception.
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

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import dataset, mdf

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


class Column(NamedTuple):
    """Stamps and values (n,), and the unit that the file itself tells, or ""."""

    time_s: np.ndarray
    values: np.ndarray
    unit: str


def read(path: Path, names: Sequence[str], head: Mapping[str, Any]) -> dict[str, Column]:
    """Those columns of a file. Raises ConfigError naming file and column for whatever cannot be read."""
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in (".db3", ".mcap", ".bag"):
        return _rosbag(path, names)
    if suffix in mdf.SUFFIXES:
        found = mdf.channels(path, tuple(names))
        for name in names:
            _known(path, name, list(found))
        return {
            name: Column(
                np.asarray(s.timestamps, float),
                _numbers(path, pa.array(s.samples), name, "."),
                str(s.unit or "").strip(),
            )
            for name, s in found.items()
        }
    data, units = (dataset.read_table(path), {}) if suffix == ".parquet" else _csv(path, head)
    for name in (head["time"], *names):
        _known(path, name, data.column_names)
    told = units.get(head["time"], head["time_unit"])
    if told not in TIME:
        raise ConfigError(
            f"{path}: the unit of '{head['time']}' is '{told}'; allowed: {', '.join(TIME)}"
        )
    stamps = _seconds(path, data[head["time"]], head["time"], TIME[told])
    if not (kept := np.isfinite(stamps)).any():
        raise ConfigError(
            f"{path}: column '{head['time']}' holds no stamp; name that of the stamps as time_s"
        )
    return {
        name: Column(
            stamps[kept],
            _numbers(path, data[name], name, head["decimal"])[kept],
            units.get(name, ""),
        )
        for name in names
    }


def column_names(path: Path, head: Mapping[str, Any]) -> list[str]:
    """Names of the columns of a CSV or Parquet file; none of another, whose channels dataset.toml has to name."""
    if path.suffix.lower() == ".parquet":
        return list(dataset.read_table(path).column_names)
    return (
        list(_csv(path, {**head, "time": "time_s"})[0].column_names)
        if path.suffix.lower() == ".csv"
        else []
    )


def _known(path: Path, name: str, found: list[str]) -> None:
    if found.count(name) > 1:
        raise ConfigError(
            f"{path}: column '{name}' is there {found.count(name)} times; give each a name of its own"
        )
    if name not in found:
        raise ConfigError(
            f"{path}: column '{name}' is missing{table.nearest(name, found)}; name it in "
            "dataset.toml as `column` in [channels], that of the stamps under time_s"
        )


def _csv(path: Path, head: Mapping[str, Any]) -> tuple[pa.Table, dict[str, str]]:
    try:
        lines = list(
            itertools.dropwhile(
                lambda line: line.startswith("#"), path.read_text("utf-8-sig").splitlines()
            )
        )
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text: {error}") from None
    if len(lines) < 3:
        raise ConfigError(
            f"{path}: {len(lines)} lines; a line of names and one line a sample are wanted"
        )
    separator = {"tab": "\t", "auto": max(",;\t", key=lines[0].count)}.get(
        head["separator"], head["separator"]
    )
    names, second = (
        next(csv.reader(lines[:1], delimiter=separator)),
        next(csv.reader(lines[1:2], delimiter=separator)),
    )
    at = names.index(head["time"]) if head["time"] in names else 0
    told = (
        zip(names, second, strict=False)
        if len(second) > at and second[at].strip(" []()") in TIME
        else ()
    )
    units = {name: unit.strip(" []()") for name, unit in told}
    text = "\n".join(lines[:1] + lines[2 if units else 1 :]) + "\n"
    try:
        return pyarrow.csv.read_csv(
            pa.BufferReader(text.encode()),
            parse_options=pyarrow.csv.ParseOptions(delimiter=separator),
            convert_options=pyarrow.csv.ConvertOptions(decimal_point=head["decimal"]),
        ), units
    except (pa.ArrowInvalid, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be read as a table: {error}; separator taken: {separator!r}, write "
            "separator and decimal in dataset.toml if they are others"
        ) from None


def _seconds(path: Path, values: pa.ChunkedArray, name: str, unit_s: float) -> np.ndarray:
    """Stamps (n,) in s, NaN where there is none."""
    kind = pa.types
    for zone in (
        (None, "UTC") if kind.is_string(values.type) or kind.is_large_string(values.type) else ()
    ):
        with suppress(pa.ArrowInvalid):  # text with an offset is of an instant
            values = values.cast(pa.timestamp("ns", tz=zone))
    if kind.is_timestamp(values.type):  # in UTC, which no clock is turned back in
        values = values.cast(pa.int64()).cast(pa.duration(values.type.unit))
    if kind.is_duration(values.type) or kind.is_time(values.type):
        in_ns = pa.duration("ns") if kind.is_duration(values.type) else pa.time64("ns")
        return np.asarray(values.cast(in_ns).cast(pa.int64()).to_numpy(), float) * 1e-9
    try:
        return _numbers(path, values, name, ".") * unit_s
    except ConfigError:
        raise ConfigError(
            f"{path}: column '{name}' is neither numbers nor date and time; write 2026-03-29 10:00:00.0, "
            "behind it Z or +02:00 where the zone is known"
        ) from None


def _numbers(path: Path, values: Any, name: str, decimal: str) -> np.ndarray:
    try:
        # counts of ns since 1970 are rounded to 0.3 us
        return np.asarray(
            values.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False), float
        )
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{path}: column '{name}' is not all numbers: {error}; one number a row is wanted, decimal "
            f"'{decimal}'"
        ) from None


def _rosbag(path: Path, names: Sequence[str]) -> dict[str, Column]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ConfigError(
            f"{path}: rosbag2 needs the package rosbags, which is not installed; install the extra: "
            "pip install 'rollerrig[rosbag]'"
        ) from None
    wrong = [name for name in names if ":" not in name]
    if wrong:
        raise ConfigError(
            f"{path}: column '{wrong[0]}' names no field of a topic; write \"/topic:field.field\""
        )
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            topics = {connection.topic for connection in bag.connections}
            for name in names:
                _known(path, name.partition(":")[0], sorted(topics))
            wanted = [
                c
                for c in bag.connections
                if any(name.partition(":")[0] == c.topic for name in names)
            ]
            for connection, received_ns, raw in bag.messages(connections=wanted):
                message: Any = bag.deserialize(raw, connection.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                at = received_ns * 1e-9 if stamp is None else stamp.sec + stamp.nanosec * 1e-9
                for name in names:
                    topic, _, field = name.partition(":")
                    if topic == connection.topic:
                        found[name].append((at, float(reduce(getattr, field.split("."), message))))
    except AttributeError as error:
        raise ConfigError(
            f'{path}: {error}; name a field that is one number: "/topic:field.field"'
        ) from None
    except (AnyReaderError, OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: cannot be read as rosbag2: {error}") from None
    empty = [name for name, samples in found.items() if not samples]
    if empty:
        raise ConfigError(f"{path}: '{empty[0]}' holds no message")
    return {
        name: Column(np.array(samples)[:, 0], np.array(samples)[:, 1], "")
        for name, samples in found.items()
    }
