"""Columns of a recorder's files with their stamps: CSV of any separator, Parquet, MDF4, rosbag2.

Every column keeps its own stamps in seconds; a missing cell is NaN, for a gap is a finding here and no error. A row
of units below the names is read. rosbag2 needs the package rosbags (the extra `rosbag`); a column there is written
"/topic:field.field", and stamps are the header's, else those of reception.
"""

import csv
import itertools
from collections.abc import Mapping, Sequence
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
    _there(path)
    if path.is_dir() or path.suffix in (".db3", ".mcap", ".bag"):
        return _rosbag(path, names)
    if path.suffix in mdf.SUFFIXES:
        found = mdf.channels(path, tuple(names))
        for name in names:
            _known(path, name, found)
        return {name: Column(np.asarray(s.timestamps, float), np.asarray(s.samples, float), str(s.unit or "").strip())
                for name, s in found.items()}
    data, units = (dataset.read_table(path), {}) if path.suffix == ".parquet" else _csv(path, head)
    stamps = _numbers(path, data, head["time"], head["decimal"])
    told = units.get(head["time"], head["time_unit"])
    if told not in TIME:
        raise ConfigError(f"{path}: the unit of '{head['time']}' is '{told}'; allowed: {', '.join(TIME)}")
    if not pa.types.is_timestamp(data[head["time"]].type):
        stamps = stamps * TIME[told]
    kept = np.isfinite(stamps)
    return {name: Column(stamps[kept], _numbers(path, data, name, head["decimal"])[kept], units.get(name, ""))
            for name in names}


def column_names(path: Path, head: Mapping[str, Any]) -> list[str]:
    """Names of the columns of a CSV or Parquet file; none of another, whose channels dataset.toml has to name."""
    _there(path)
    if path.suffix == ".parquet":
        return list(dataset.read_table(path).column_names)
    return list(_csv(path, {**head, "time": "time_s"})[0].column_names) if path.suffix == ".csv" else []


def _there(path: Path) -> None:
    if not path.exists():
        raise ConfigError(f"{path}: no such file; correct `file` in dataset.toml")


def _known(path: Path, name: str, found: Any) -> None:
    if name not in found:
        raise ConfigError(f"{path}: column '{name}' is missing{table.nearest(name, list(found))}; name it in "
                          "dataset.toml as `column` in [channels], that of the stamps under time_s")


def _csv(path: Path, head: Mapping[str, Any]) -> tuple[pa.Table, dict[str, str]]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text: {error}") from None
    skipped = sum(1 for _ in itertools.takewhile(lambda line: line.startswith("#"), lines))
    lines = lines[skipped:]
    if len(lines) < 3:
        raise ConfigError(f"{path}: {len(lines)} lines; a line of names and one line a sample are wanted")
    separator = {"tab": "\t", "auto": max(",;\t", key=lines[0].count)}.get(head["separator"], head["separator"])
    names, second = next(csv.reader(lines[:1], delimiter=separator)), next(csv.reader(lines[1:2], delimiter=separator))
    at = names.index(head["time"]) if head["time"] in names else 0
    units = {}
    if len(second) > at and second[at].strip(" []()") in TIME:
        units = {name: unit.strip(" []()") for name, unit in zip(names, second, strict=False)}
    text = "\n".join(lines[:1] + lines[2 if units else 1:]) + "\n"
    try:
        return pyarrow.csv.read_csv(
            pa.BufferReader(text.encode()), parse_options=pyarrow.csv.ParseOptions(delimiter=separator),
            convert_options=pyarrow.csv.ConvertOptions(decimal_point=head["decimal"])), units
    except (pa.ArrowInvalid, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as a table: {error}; separator taken: {separator!r}, write "
                          "separator and decimal in dataset.toml if they are others") from None


def _numbers(path: Path, data: pa.Table, name: str, decimal: str) -> np.ndarray:
    _known(path, name, data.column_names)
    values = data[name]
    try:
        if pa.types.is_timestamp(values.type):
            return np.asarray(values.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy(), float) * 1e-9
        return np.asarray(values.cast(pa.float64()).to_numpy(zero_copy_only=False), float)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: column '{name}' is not all numbers: {error}; one number a row is wanted, decimal "
                          f"'{decimal}'") from None


def _rosbag(path: Path, names: Sequence[str]) -> dict[str, Column]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ConfigError(f"{path}: rosbag2 needs the package rosbags, which is not installed; install the extra: "
                          "pip install 'rollerrig[rosbag]'") from None
    wrong = [name for name in names if ":" not in name]
    if wrong:
        raise ConfigError(f"{path}: column '{wrong[0]}' names no field of a topic; write \"/topic:field.field\"")
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            topics = {connection.topic for connection in bag.connections}
            for name in names:
                if (topic := name.partition(":")[0]) not in topics:
                    raise ConfigError(f"{path}: topic '{topic}' is missing{table.nearest(topic, sorted(topics))}")
            wanted = [c for c in bag.connections if any(name.partition(":")[0] == c.topic for name in names)]
            for connection, received_ns, raw in bag.messages(connections=wanted):
                message: Any = bag.deserialize(raw, connection.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                at = received_ns * 1e-9 if stamp is None else stamp.sec + stamp.nanosec * 1e-9
                for name in names:
                    topic, _, field = name.partition(":")
                    if topic == connection.topic:
                        found[name].append((at, float(reduce(getattr, field.split("."), message))))
    except AttributeError as error:
        raise ConfigError(f"{path}: {error}; name a field that is one number: \"/topic:field.field\"") from None
    except (AnyReaderError, OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: cannot be read as rosbag2: {error}") from None
    empty = [name for name, samples in found.items() if not samples]
    if empty:
        raise ConfigError(f"{path}: '{empty[0]}' holds no message")
    return {name: Column(np.array(samples)[:, 0], np.array(samples)[:, 1], "") for name, samples in found.items()}
