"""A recorded run in the formats of other programs: MDF4, MATLAB, CSV.

Every channel of the record is exported in SI with its unit and description, and so are the events.
An MDF4 file has one group of channels over time and one of events. A MAT file has one variable a
channel and the tables `units`, `descriptions` and `events`. A CSV file has names in its first line
and units in its second, and a second file has the events. What was played, and whether the run is
valid, is in the comment of the MDF4 file, in the table `run` of the MAT file, and in a third file
beside the CSV file. Files appear complete or not at all.
Source: ASAM MDF 4.1 as asammdf writes it; MAT-file level 5 as scipy writes it.
"""

import csv
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, replaced, writing
from rollerrig.configs.table import nearest
from rollerrig.realtime.record import played
from rollerrig.realtime.record.records import Run
from rollerrig.wsp_interface import signals

# unit suffixes as other programs write them
UNITS = {"m_s": "m/s", "m_s2": "m/s^2", "rad_s": "rad/s", "Nm": "N*m", "J_m": "J/m", "N_m": "N/m"}
EVENTS = "events"
RUN = "run"


class Column(NamedTuple):
    """A channel to be exported; values of shape (n,)."""

    name: str
    unit: str
    text: str
    values: np.ndarray


def columns(run: Run) -> list[Column]:
    """Return all channels of a run except time, with unit and description."""
    known: dict[str, tuple[str, str]] = {}
    for signal in run.signal_table.signals:
        unit = UNITS.get(signal.unit, signal.unit)
        for name in signals.columns(signal):
            known[name] = (unit, signal.text)
    return [
        Column(name, *known.get(name, ("", "")), run.column(name))
        for name in run.table.column_names
        if name != "time_s"
    ]


def write(
    run: Run, kind: str, out: Path, more: Mapping[str, "Writer"] = MappingProxyType({})
) -> list[Path]:
    """Write a run as `kind` (mdf4, mat, csv, or one of `more`); return the files.

    Raises ConfigError.
    """
    writers = {**WRITERS, **more}
    if kind not in writers:
        raise ConfigError(f"--format {kind}: no such format{nearest(kind, writers)}")
    if not len(run.table):
        raise ConfigError(
            f"{run.folder}: the record holds no samples, so there is nothing to export"
        )
    with writing(out, "give another file with --out, or make room"):
        make_folder(out.parent)
        return writers[kind](run, out)


def _mdf4(run: Run, out: Path) -> list[Path]:
    """Write a run as MDF4."""
    try:
        from asammdf import MDF, Signal
    except ImportError:
        raise ConfigError("--format mdf4 needs asammdf: pip install 'rollerrig[export]'") from None
    time_s = run.column("time_s")
    channels = [
        Signal(column.values, time_s, name=column.name, unit=column.unit, comment=column.text)
        for column in columns(run)
    ]
    with MDF(version="4.10") as made:
        made.append(channels, comment=f"rollerrig {run.folder.name}", common_timebase=True)
        if run.events:
            at_s = np.array([event.time_s for event in run.events])
            texts = np.array([f"{event.level}: {event.text}".encode() for event in run.events])
            made.append([Signal(texts, at_s, name=EVENTS, encoding="utf-8")], comment=EVENTS)
        what = played.of_summary(run.summary).texts()
        made.header.comment = "\n".join(f"{key}: {text}" for key, text in what.items())
        with replaced(out, ".mf4") as new:
            made.save(new, overwrite=True, compression=2)
    return [out]


def _mat(run: Run, out: Path) -> list[Path]:
    """Write a run as a MAT file."""
    from scipy.io import savemat

    content: dict[str, Any] = {}
    units: dict[str, str] = {}
    descriptions: dict[str, str] = {}
    for column in columns(run):
        content[column.name] = column.values
        units[column.name] = column.unit
        descriptions[column.name] = column.text
    content["time_s"] = run.column("time_s")
    units["time_s"] = "s"
    content["units"] = units
    content["descriptions"] = descriptions
    content[RUN] = played.of_summary(run.summary).texts()
    content[EVENTS] = {
        "time_s": np.array([event.time_s for event in run.events], dtype=float),
        "level": np.array([event.level for event in run.events], dtype=object),
        "text": np.array([event.text for event in run.events], dtype=object),
    }
    with replaced(out, ".mat") as new:
        savemat(new, content, long_field_names=True, oned_as="column", do_compression=True)
    return [out]


def _csv(run: Run, out: Path) -> list[Path]:
    """Write a run as CSV, its events as a second file, and what was played as a third one."""
    exported = columns(run)
    names = ["time_s", *(column.name for column in exported)]
    units = ["s", *(column.unit for column in exported)]
    table = np.column_stack([run.column("time_s"), *(column.values for column in exported)])
    with replaced(out) as new, new.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([names, units])
        np.savetxt(file, table, fmt="%.17g", delimiter=",")

    events_out = out.with_name(f"{out.stem}.{EVENTS}.csv")
    with replaced(events_out) as new, new.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("time_s", "level", "text"))
        writer.writerows((event.time_s, event.level, event.text) for event in run.events)

    run_out = out.with_name(f"{out.stem}.{RUN}.csv")
    with replaced(run_out) as new, new.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(played.of_summary(run.summary).texts().items())
    return [out, events_out, run_out]


Writer = Callable[[Run, Path], list[Path]]
WRITERS: dict[str, Writer] = {"mdf4": _mdf4, "mat": _mat, "csv": _csv}
SUFFIX = {"mdf4": ".mf4", "mat": ".mat", "csv": ".csv", "svg": ".svg"}
