"""Reads columns of a recorder's files with their stamps: CSV, Parquet, MDF4 and rosbag2.

Every column keeps its stamps, in seconds. A missing cell is NaN, because a gap is a finding here
and not an error. CSV and Parquet are read by `rig/identify/files`.

rosbag2 needs the package rosbags (the extra `rosbag`). Its columns are written
"/topic:field.field". Their stamps come from the message header, else they are the times of
reception. The times of reception also count where the headers of a topic all have the same stamp.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import mdf
from rollerrig.rig.identify.files import channels, numbers, tables

_ROSBAG_SUFFIXES = (".db3", ".mcap", ".bag")


class _Message(NamedTuple):
    """A value of a field with the stamp of its header, or NaN, and its time of reception, s."""

    stamp_s: float
    received_s: float
    value: float


class Column(NamedTuple):
    """Stamps and values (n,), and the unit that the file gives, or "".

    `notes` are what the reader of a report must know of the file.
    """

    time_s: np.ndarray
    values: np.ndarray
    unit: str
    notes: tuple[str, ...] = ()


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
        user_files.check(path, user_files.MDF, folder, tables.FILE_REMEDY)
        return _read_mdf(path, names)

    table = tables.read(path, folder, dict(head))
    for name in (head["time"], *names):
        tables.check_column(path, name, table.names)
    stamps = channels.seconds(path, table, channels.Source(head["time"], head["time_unit"]))
    has_stamp = np.isfinite(stamps.time_s)
    if not has_stamp.any():
        raise ConfigError(
            f"{path}: column '{head['time']}' has no stamp; name the column of the stamps as time_s"
        )

    time_s = stamps.time_s[has_stamp]
    columns = {}
    for name in names:
        columns[name] = Column(
            time_s=time_s,
            values=channels.values(path, table, name)[has_stamp],
            unit=table.units.get(name, ""),
            notes=(*table.notes, *stamps.notes),
        )
    return columns


def column_names(path: Path, head: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the names of the columns of a CSV or Parquet file.

    The list is empty for other files: their channels must be in dataset.toml.
    """
    if path.suffix.lower() in (".csv", ".txt", ".tsv", ".parquet"):
        return tables.read(path, folder, dict(head)).names
    return []


# --- MDF4 ---


def _read_mdf(path: Path, names: Sequence[str]) -> dict[str, Column]:
    """Return the columns of an MDF4 file. Raises ConfigError."""
    signals = mdf.channels(path, tuple(names))
    for name in names:
        tables.check_column(path, name, list(signals))

    columns = {}
    for name, signal in signals.items():
        columns[name] = Column(
            time_s=np.asarray(signal.timestamps, float),
            values=numbers.as_floats(path, pa.array(signal.samples), name),
            unit=str(signal.unit or "").strip(),
        )
    return columns


# --- rosbag2 ---


def _check_rosbag(path: Path, folder: Path) -> None:
    """Raise ConfigError unless every file of a rosbag2 recording may be opened."""
    files = [path]
    if path.is_dir():
        files = sorted(path.iterdir())
    for file in files:
        user_files.check(file, user_files.ROSBAG, folder, tables.FILE_REMEDY)


def _read_rosbag(path: Path, names: Sequence[str]) -> dict[str, Column]:
    """Return the columns of a rosbag2 recording. Raises ConfigError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        from rollerrig.rig.identify.train_recorder import rosbag_limits
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

    samples: dict[str, list[_Message]] = {name: [] for name in names}
    try:
        unpacking = rosbag_limits.check(path)
        typestore = get_typestore(Stores.LATEST)
        with (
            rosbag_limits.applied(unpacking),
            AnyReader([path], default_typestore=typestore) as bag,
        ):
            unpack = unpacking.zstd if rosbag_limits.compressed_messages(bag) else None
            _collect_messages(path, bag, samples, unpack)
    except ConfigError:
        raise
    except MemoryError:
        raise ConfigError(
            f"{path}: needs more memory than there is; split it into several recordings"
        ) from None
    except Exception as error:  # rosbags and what it uses raise exceptions of many kinds
        reason = str(error) or type(error).__name__
        raise ConfigError(f"{path}: cannot be read as rosbag2: {reason}; record it again") from None

    columns = {}
    for name, rows in samples.items():
        if not rows:
            raise ConfigError(f"{path}: '{name}' has no message")
        columns[name] = _column_of_messages(path, name, rows)
    return columns


def _column_of_messages(path: Path, name: str, rows: list[_Message]) -> Column:
    """Return the column of a field. Headers whose stamps never change hold no time."""
    stamp_s, received_s, values = np.array(rows).T
    if np.isnan(stamp_s).any():
        return Column(received_s, values, "")
    if stamp_s.size > 1 and np.ptp(stamp_s) == 0.0 and np.ptp(received_s) > 0.0:
        note = (
            f"{path.name}: the headers of {name.partition(':')[0]} all have the stamp {stamp_s[0]:g} s, so "
            "the times of reception are used"
        )
        return Column(received_s, values, "", (note,))
    return Column(stamp_s, values, "")


def _collect_messages(
    path: Path,
    bag: Any,
    samples: dict[str, list[_Message]],
    unpack: Callable[[bytes], bytes] | None,
) -> None:
    """Append every message to the samples of its fields.

    `unpack` unpacks the messages if they are compressed.
    """
    topic_of = {}
    fields_of = {}  # path from the message to the number, field by field
    for name in samples:
        topic, _, fields = name.partition(":")
        topic_of[name] = topic
        fields_of[name] = fields.split(".")
    topics = {connection.topic for connection in bag.connections}
    for name in samples:
        tables.check_column(path, topic_of[name], sorted(topics))

    wanted = [connection for connection in bag.connections if connection.topic in topic_of.values()]
    for connection, received_ns, raw in bag.messages(connections=wanted):
        if unpack is not None:
            raw = unpack(raw)
        message: Any = bag.deserialize(raw, connection.msgtype)

        stamp_s = np.nan
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        if stamp is not None:
            stamp_s = stamp.sec + stamp.nanosec * 1e-9

        for name in samples:
            if topic_of[name] == connection.topic:
                try:
                    value = reduce(getattr, fields_of[name], message)
                except AttributeError as error:
                    raise ConfigError(
                        f"{path}: {error}; name a field that is a single number: "
                        '"/topic:field.field"'
                    ) from None
                samples[name].append(_Message(stamp_s, received_ns * 1e-9, float(value)))
