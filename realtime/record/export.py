"""A recorded run in the formats of other programs: MDF4, MATLAB, CSV.

Every channel of the record goes out in SI with its unit and its description; events go along. An
MDF4 file holds one group of channels over time and one of events; a MAT file one variable a channel
and the tables `units`, `descriptions`, `events`; a CSV file names in its first line and units in its
second, with the events in a file of their own beside it. Files appear whole or not at all.

Source: ASAM MDF 4.1 as asammdf writes it; MAT-file level 5 as scipy does.
"""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.realtime.record.files import replaced
from rollerrig.realtime.record.records import Run
from rollerrig.wsp_interface import signals

# unit suffixes as other programs write them
UNITS = {"m_s": "m/s", "m_s2": "m/s^2", "rad_s": "rad/s", "Nm": "N*m", "J_m": "J/m", "N_m": "N/m"}
EVENTS = "events"


class Column(NamedTuple):
    """A channel on its way out; values of shape (n,)."""

    name: str
    unit: str
    text: str
    values: np.ndarray


def columns(run: Run) -> list[Column]:
    """All channels of a run but time, with unit and description."""
    known = {name: signal for signal in signals.SIGNALS for name in signals.columns(signal)}
    found = []
    for name in run.table.column_names:
        signal = known.get(name)
        unit = signal.unit if signal else ""
        if name != "time_s":
            found.append(Column(name, UNITS.get(unit, unit), signal.text if signal else "",
                                run.column(name)))
    return found


def write(run: Run, kind: str, out: Path) -> list[Path]:
    """Write a run as `kind` (mdf4, mat, csv); the files written. Raises ConfigError."""
    if kind not in WRITERS:
        raise ConfigError(f"--format {kind}: no such format{nearest(kind, WRITERS)}")
    if not len(run.table):
        raise ConfigError(f"{run.folder}: the record holds no samples, so there is nothing to export")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return WRITERS[kind](run, out)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror or error}; give another file "
                          "with --out, or make room") from None


def _mdf4(run: Run, out: Path) -> list[Path]:
    try:
        from asammdf import MDF, Signal
    except ImportError:
        raise ConfigError("--format mdf4 needs asammdf: pip install 'rollerrig[export]'") from None
    time_s = run.column("time_s")
    with MDF(version="4.10") as made:
        made.append([Signal(one.values, time_s, name=one.name, unit=one.unit, comment=one.text)
                     for one in columns(run)], comment=f"rollerrig {run.folder.name}",
                    common_timebase=True)
        if run.events:
            at_s = np.array([event[0] for event in run.events])
            text = np.array([f"{level}: {text}".encode() for _, level, text in run.events])
            made.append([Signal(text, at_s, name=EVENTS, encoding="utf-8")], comment=EVENTS)
        with replaced(out, ".mf4") as new:
            made.save(new, overwrite=True, compression=2)
    return [out]


def _mat(run: Run, out: Path) -> list[Path]:
    from scipy.io import savemat

    found = columns(run)
    content: dict[str, Any] = {one.name: one.values for one in found}
    content["time_s"] = run.column("time_s")
    content["units"] = {one.name: one.unit for one in found} | {"time_s": "s"}
    content["descriptions"] = {one.name: one.text for one in found}
    content[EVENTS] = {
        "time_s": np.array([event[0] for event in run.events]),
        "level": np.array([event[1] for event in run.events], dtype=object),
        "text": np.array([event[2] for event in run.events], dtype=object)}
    with replaced(out, ".mat") as new:
        savemat(new, content, long_field_names=True, oned_as="column", do_compression=True)
    return [out]


def _csv(run: Run, out: Path) -> list[Path]:
    found = columns(run)
    table = np.column_stack([run.column("time_s"), *(one.values for one in found)])
    beside = out.with_name(f"{out.stem}.{EVENTS}.csv")
    with replaced(out) as new, new.open("w", encoding="utf-8", newline="") as file:
        head = csv.writer(file)
        head.writerow(["time_s", *(one.name for one in found)])
        head.writerow(["s", *(one.unit for one in found)])
        np.savetxt(file, table, fmt="%.17g", delimiter=",")
    with replaced(beside) as new, new.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([("time_s", "level", "text"), *run.events])
    return [out, beside]


WRITERS: dict[str, Callable[[Run, Path], list[Path]]] = {"mdf4": _mdf4, "mat": _mat, "csv": _csv}
SUFFIX = {"mdf4": ".mf4", "mat": ".mat", "csv": ".csv"}
