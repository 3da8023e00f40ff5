"""A recorded run in the formats of other programs: MDF4, MATLAB, CSV, MCAP.

Every channel of the record is exported in SI with its unit and description, and so are the events.
An MDF4 file has one group of channels over time and one of events. A MAT file has one variable a
channel and the tables `units`, `descriptions` and `events`. A CSV file has names in its first line
and units in its second, and a second file has the events. What was played, and whether the run is
valid, is in the comment of the MDF4 file, in the table `run` of the MAT file, and in a third file
beside the CSV file. Files appear complete or not at all.
Source: ASAM MDF 4.1 as asammdf writes it; MAT-file level 5 as scipy writes it.
"""

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, replaced, writing
from rollerrig.configs.table import nearest
from rollerrig.configs.vehicle import COACH
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
    known = _of_train(run.table.column_names) if run.is_train else _of_vehicle(run)
    return [
        Column(name, *known.get(name, ("", "")), run.column(name))
        for name in run.table.column_names
        if name != "time_s"
    ]


def _of_vehicle(run: Run) -> dict[str, tuple[str, str]]:
    """Return unit and description of each channel of a vehicle."""
    known: dict[str, tuple[str, str]] = {}
    for signal in run.signal_table.signals:
        unit = UNITS.get(signal.unit, signal.unit)
        for name in signals.columns(signal):
            known[name] = (unit, signal.text)
    return known


def _of_train(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return unit and description of each channel of a train.

    The end of a name is its unit; axles count through, so a signal has more of them than a vehicle.
    """
    of_signals = signals.table(COACH).signals
    # the longest one that fits: N_m also ends like m
    units = sorted({signal.unit for signal in of_signals if signal.unit} | {"N"}, key=len)
    known = {}
    for name in names:
        unit = next((one for one in reversed(units) if name.endswith(f"_{one}")), "")
        text = next((one.text for one in of_signals if re.match(rf"{one.name}_\d+(_|$)", name)), "")
        known[name] = (UNITS.get(unit, unit), text)
    return known


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


def _mcap(run: Run, out: Path) -> list[Path]:
    """Write a run as MCAP, for Foxglove and PlotJuggler."""
    try:
        from mcap.writer import Writer as Mcap
    except ImportError:
        raise ConfigError("--format mcap needs mcap: pip install 'rollerrig[export]'") from None
    exported = columns(run)
    properties = {
        column.name: {"type": "number", "description": f"{column.text} [{column.unit}]"}
        for column in exported
    }
    with replaced(out, ".mcap") as new, new.open("wb") as file:
        made = Mcap(file)
        made.start(profile="", library=f"rollerrig {played.version()}")
        made.add_metadata(RUN, played.of_summary(run.summary).texts())
        of_signals = _topic(made, "/signals", "rollerrig.Signals", properties)
        names = [column.name for column in exported]
        rows = np.column_stack([column.values for column in exported])
        known = np.isfinite(rows)
        for time_s, row, is_known in zip(run.column("time_s"), rows, known, strict=True):
            values = {
                name: value
                for name, value, shown in zip(names, row.tolist(), is_known.tolist(), strict=True)
                if shown
            }
            _message(made, of_signals, float(time_s), values)
        of_events = _topic(made, "/events", "foxglove.Log", _LOG)
        for event in run.events:
            sec, nsec = divmod(_ns(event.time_s), 1_000_000_000)
            entry = {
                "timestamp": {"sec": sec, "nsec": nsec},
                "level": _LOG_LEVELS.get(event.level, 0),
                "message": event.text,
                "name": str(event.code),
                "file": "",
                "line": 0,
            }
            _message(made, of_events, event.time_s, entry)
        made.finish()
    return [out]


# the schema foxglove.Log, as far as it has values here
_LOG = {
    "timestamp": {
        "type": "object",
        "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
    },
    "level": {"type": "integer"},
    "message": {"type": "string"},
    "name": {"type": "string"},
    "file": {"type": "string"},
    "line": {"type": "integer"},
}
_LOG_LEVELS = {"info": 2, "warning": 3, "error": 4}


def _topic(made: Any, topic: str, name: str, properties: Mapping[str, Any]) -> int:
    """Register a topic whose messages are JSON objects; return its number."""
    schema = json.dumps({"title": name, "type": "object", "properties": properties})
    number = made.register_schema(name=name, encoding="jsonschema", data=schema.encode())
    return int(made.register_channel(topic=topic, message_encoding="json", schema_id=number))


def _message(made: Any, topic: int, time_s: float, content: Mapping[str, Any]) -> None:
    at_ns = _ns(time_s)
    data = json.dumps(content).encode()
    made.add_message(channel_id=topic, log_time=at_ns, data=data, publish_time=at_ns)


def _ns(time_s: float) -> int:
    return round(time_s * 1e9)


Writer = Callable[[Run, Path], list[Path]]
WRITERS: dict[str, Writer] = {"mdf4": _mdf4, "mat": _mat, "csv": _csv, "mcap": _mcap}
SUFFIX = {"mdf4": ".mf4", "mat": ".mat", "csv": ".csv", "mcap": ".mcap", "svg": ".svg"}
