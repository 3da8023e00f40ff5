"""Makes a dataset of a logger's files: reads their columns and writes dataset.toml with [channels].

Files that are outside of the dataset's folder are copied into it, because a dataset reads only
files in its folder. The files themselves are not changed.
"""

import datetime
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, replaced, write_text, writing
from rollerrig.rig.identify.data import dataset, mdf
from rollerrig.rig.identify.files import channels, stamps, tables, units, words
from rollerrig.rig.identify.files.channels import Source
from rollerrig.rig.identify.files.proposal import KINDS, Content, Proposal, full_key
from rollerrig.rig.identify.files.tables import Table
from rollerrig.rig.identify.train_recorder import recording

# of the runs, one in so many is never fitted
RUNS_FOR_ONE_HELD_OUT = 3
_JUDGED_SAMPLES = 1000  # of a column, to see what it holds
# stamps below are no dates since 1970
_FIRST_DATE_S = 3e8
_INITIAL_SAMPLES = 20


class File(NamedTuple):
    """A file to import: its columns, how it is written, and what was left out.

    `table` is None for MDF4.
    """

    path: Path
    contents: list[Content]
    form: str
    notes: tuple[str, ...]
    table: Table | None


class Run(NamedTuple):
    """What dataset.toml says of a file: its stamps, and the date of the first one, or ""."""

    name: str
    step_s: float
    duration_s: float
    date: str
    notes: tuple[str, ...]


def read(path: Path, head: Mapping[str, str]) -> File:
    """Return the columns of a file of a logger. Raises ConfigError.

    `head` has the keys `separator` and `decimal` of dataset.toml.
    """
    if path.suffix.lower() in mdf.SUFFIXES:
        user_files.check(path, user_files.MDF)
        contents = [Content(*channel, is_stamp=False) for channel in mdf.listed(path)]
        return File(path, contents, "MDF4", (), None)
    table = tables.read(path, None, dict(head))
    contents = []
    for name in table.names:
        if table.names.count(name) > 1:
            raise ConfigError(
                f"{path}: column '{name}' is there {table.names.count(name)} times; give each "
                "column a different name"
            )
        contents.append(_content(table, name))
    return File(path, contents, table.form, table.notes, table)


def _content(table: Table, name: str) -> Content:
    """Return a column of a table with its first values."""
    values = table.data[name].slice(0, _JUDGED_SAMPLES)
    is_stamp = stamps.holds_dates(values)
    numbers = np.full(len(values), np.nan)
    if not is_stamp:
        numbers = stamps.numbers_or_nan(values)
    return Content(name, table.units.get(name, ""), numbers, is_stamp)


def check_same_columns(files: Sequence[File], found: Proposal) -> None:
    """Raise ConfigError unless all files have the columns of a proposal, in the same units."""
    for file in files:
        by_name = {content.name: content for content in file.contents}
        for channel in found.channels:
            content = by_name.get(channel.column)
            if content is None:
                raise ConfigError(
                    f"{file.path}: column '{channel.column}' is missing, which {files[0].path} has; "
                    "import files with different columns separately"
                )
            unit = units.find(content.unit)
            if unit and channel.unit and channel.key != "brake_demand":
                channels.factor(
                    file.path, Source(channel.column, channel.unit), channel.key, unit.name,
                    content.unit,
                )  # fmt: skip


def describe_run(file: File, found: Proposal) -> Run:
    """Return what the stamps of a file show. Raises ConfigError if they are no stamps."""
    channel = found.channel("time_s")
    if file.table is None or channel is None:
        return Run(file.path.name, 0.0, 0.0, "", ())
    read_stamps = channels.seconds(file.path, file.table, Source(channel.column, channel.unit))
    time_s = read_stamps.time_s[np.isfinite(read_stamps.time_s)]
    if time_s.size < 2:
        raise ConfigError(f"{file.path}: column '{channel.column}' has fewer than two stamps")
    date = ""
    if time_s[0] > _FIRST_DATE_S and "spreadsheet" not in "".join(read_stamps.notes):
        first = datetime.datetime.fromtimestamp(float(time_s[0]), datetime.UTC)
        date = first.date().isoformat()
    if not date:
        date = _date_of_column(file.table)
    return Run(
        name=file.path.name,
        step_s=float(np.median(np.diff(time_s))),
        duration_s=float(time_s[-1] - time_s[0]),
        date=date,
        notes=read_stamps.notes,
    )


def _date_of_column(table: Table) -> str:
    """Return the first date of a column of dates beside the stamps, year-month-day; "" for none."""
    for name in table.names:
        found = words.meaning(words.column(name, ""))
        if found is not None and found.quantity == words.DATE:
            texts = [str(text) for text in table.data[name].slice(0, 1).to_pylist() if text]
            return stamps.date_of(texts[0]) if texts else ""
    return ""


def write(
    out: Path,
    files: Sequence[File],
    found: Proposal,
    runs: Sequence[Run],
    vehicle: str,
    head: Mapping[str, str],
) -> Path:
    """Write dataset.toml, and copies of files that are outside of the folder; return the folder.

    Raises ConfigError if there is a dataset already, or the folder cannot be written.
    """
    toml = out / "dataset.toml"
    if toml.exists():
        raise ConfigError(f"{toml}: is there already; give another folder with --out, or remove it")
    with writing(out):
        make_folder(out)
        names = _copied(files, out)
        text = _toml(names, found, runs, vehicle, head)
        # a name of a file may hold the end of a line, which would end the comment
        origin = repr([file.path.name for file in files])
        write_text(toml, f"# imported by rollerrig from {origin}\n{text}")
    return out


def _copied(files: Sequence[File], out: Path) -> list[str]:
    """Return the names of the files in the folder; those outside of it are copied."""
    names: list[str] = []
    for file in files:
        place = file.path.resolve()
        if place.is_relative_to(out.resolve()):
            names.append(place.relative_to(out.resolve()).as_posix())
            continue
        name = file.path.name
        number = 1
        while name in names:
            number += 1
            name = f"{file.path.stem}_{number}{file.path.suffix}"
        kind = user_files.MDF if file.table is None else user_files.CSV
        if file.path.suffix.lower() == ".parquet":
            kind = user_files.PARQUET
        with (
            user_files.open_binary(file.path, kind) as source,
            replaced(out / name) as new,
            new.open("wb") as copy,
        ):
            shutil.copyfileobj(source, copy)
        names.append(name)
    return names


def _toml(
    names: Sequence[str],
    found: Proposal,
    runs: Sequence[Run],
    vehicle: str,
    head: Mapping[str, str],
) -> str:
    """Return the text of dataset.toml."""
    content: dict[str, Any] = {"kind": found.kind}
    # what is found in each file needs no key
    content.update({key: value for key, value in head.items() if value != "auto"})
    if found.kind == "recorder":
        content["wheel_radius_m"] = wheel_radius_m(vehicle)
    else:
        content["vehicle"] = vehicle
    if found.kind == "braking_runs" and runs[0].step_s > 0.0:
        content["sample_time_s"] = _rounded(runs[0].step_s)
    text = tomli_w.dumps(content) + "\n[channels]\n"

    for channel in found.channels:
        entry = {"column": channel.column, "unit": channel.unit}
        if not channel.unit:
            del entry["unit"]
        # one line for each channel
        cells = ", ".join(tomli_w.dumps({key: cell}).strip() for key, cell in entry.items())
        text += f"{channel.key} = {{ {cells} }}\n"

    first_held_out = len(names) - len(names) // RUNS_FOR_ONE_HELD_OUT
    for number, (name, run) in enumerate(zip(names, runs, strict=True)):
        table: dict[str, Any] = {"file": name}
        if found.kind == "braking_runs":
            table["group"] = "tune" if number < first_held_out else "validate"
        if found.kind == "recorder" and run.date:
            table["date"] = run.date
        text += f"\n[[run]]\n{tomli_w.dumps(table)}"
    return text


def _rounded(step_s: float) -> float:
    """Return a sample time without the rounding of its stamps: three significant digits."""
    return float(f"{step_s:.3g}")


def axles_of(vehicle: str) -> int:
    """Return the number of axles of a packaged vehicle. Raises ConfigError."""
    sections = dataset.base_sections(vehicle, {}, f"--vehicle {vehicle}")
    return int(sections["vehicle"]["axles"])


def wheel_radius_m(vehicle: str) -> float:
    """Return the radius of the wheels of a packaged vehicle. Raises ConfigError."""
    sections = dataset.base_sections(vehicle, {}, f"--vehicle {vehicle}")
    return float(sections["vehicle"]["wheel_radius_m"])


def check_keys(kind: str, keys: Sequence[str], axles: int) -> None:
    """Raise ConfigError unless a kind of data of a vehicle has channels with these keys."""
    wrong = [key for key in keys if not _is_key(kind, key, axles)]
    if not wrong:
        return
    if kind == "recorder":
        allowed = "time_s, wheel_speed_1_m_s, bogie_speed_1_m_s, reference_speed_m_s, brake_demand"
    else:
        # of the axles, the first and the last
        left_out = [f"_{axle}_" for axle in range(2, axles + 1)]
        names = [key for key in _keys(kind, axles) if not any(part in key for part in left_out)]
        allowed = ", ".join(
            f"{name} .. {name.replace('_1_', f'_{axles}_')}" if "_1_" in name else name
            for name in names
        )
    others = [
        f"; of {other}, add --kind {other}"
        for other in KINDS
        if other != kind and all(_is_key(other, full_key(key, other), axles) for key in wrong)
    ]
    raise ConfigError(
        f"--map: {kind} has no channel {', '.join(wrong)}; allowed: {allowed}{''.join(others)}"
    )


def _is_key(kind: str, key: str, axles: int) -> bool:
    """Return whether a kind of data of a vehicle has a channel with this key."""
    if kind == "recorder":
        return key == "time_s" or recording.is_key(key)
    return key in _keys(kind, axles)


def _keys(kind: str, axles: int) -> tuple[str, ...]:
    """Return the keys of the channels of braking runs, or of a creep curve."""
    if kind == "creep_curve":
        return dataset.CURVE_CHANNELS
    return ("time_s", *dataset.channels_of(axles))


def check(folder: Path, kind: str) -> list[str]:
    """Return the warnings of the dataset in a folder. Raises ConfigError if it cannot be used."""
    try:
        if kind == "recorder":
            return recording.load(folder).warnings
        return dataset.load(folder).warnings
    except ConfigError as error:
        raise ConfigError(
            f"{folder / 'dataset.toml'} is written, but `rollerrig explain` would refuse it: {error}"
        ) from None
