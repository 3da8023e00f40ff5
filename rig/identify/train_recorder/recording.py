"""Reads a dataset of `kind = "recorder"`: channels by name and unit, runs by file, date and vehicle.

All values come out in SI; stamps of a run count from its first sample. What is doubtful stays in, for
`faults` to find; what cannot be read at all is refused here.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import choice, number
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.train_recorder import files

HEAD = (
    choice("kind", "recorder", ("recorder",), "what the data is"),
    choice("title", "", (), "a sentence"),
    choice("source", "", (), "where the data is from"),
    choice("note", "", (), "what the reader of a report must know; the report repeats it"),
    choice("separator", "auto", ("auto", ",", ";", "tab"), "of a CSV; auto: found by itself"),
    choice("decimal", ".", (".", ","), "of a CSV"),
    number("wheel_radius_m", 0.445, 0.2, 0.7, "that the recorder takes, where a speed is in rad/s"),
)
CHANNEL = (
    choice(
        "column",
        "",
        (),
        "column or channel of the file, as the key where not given; rosbag2: /topic:field.field",
    ),
    choice("unit", "", (), "of the values in the file, as the key says where not given"),
    choice("name", "", (), "how the report calls it"),
    number(
        "delay_s",
        -1.0,
        0.0,
        3.0,
        "so late it may be: 0 of a speed, 0.5 of a reference where not given",
    ),
)
RUN = (
    choice("file", "", (), "CSV, Parquet, MDF4 or rosbag2 (its folder)"),
    choice("date", "", (), "year-month-day: wheels may change between dates"),
    choice("vehicle_id", "", (), "runs of one vehicle share their wheels"),
)
_SPEED = {"m_s": "m/s", "rad_s": "rad/s"}
# key of a channel, what it measures, how the report calls it
KEYS = (
    (r"wheel_speed_([1-9]\d*)_(m_s|rad_s)", "speed", "axle {}"),
    (r"bogie_speed_([1-9]\d*)_(m_s)", "speed", "bogie {}"),
    (r"reference_speed_(m_s)", "reference", "reference"),
    (r"position_(m)", "position", "position"),
    (r"brake_demand", "demand", "demand"),
)
UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704, "m": 1.0, "km": 1000.0}
_OF = {
    "speed": ("m/s", "km/h", "mph", "rad/s"),
    "reference": ("m/s", "km/h", "mph"),
    "position": ("m", "km"),
    "demand": ("",),
}
LEAST_SAMPLES = 100


class Channel(NamedTuple):
    """Stamps and values (n,) in SI, NaN where there is none; `quantum`: step of its rounding, 0 if none is seen."""

    name: str
    quantity: str
    delay_s: float
    time_s: np.ndarray
    values: np.ndarray
    quantum: float
    axle: int = 0  # 0: not of one axle

    @property
    def step_s(self) -> float:
        """Usual time between two samples."""
        return (
            float(np.median(np.diff(t)))
            if (t := self.time_s[np.isfinite(self.values)]).size > 1
            else np.inf
        )


class Run(NamedTuple):
    name: str
    date: str
    vehicle_id: str
    channels: dict[str, Channel]

    def of(self, *quantities: str) -> list[Channel]:
        return [channel for channel in self.channels.values() if channel.quantity in quantities]


class Recording(NamedTuple):
    name: str
    runs: list[Run]
    warnings: list[str]


class Finding(NamedTuple):
    """What was found: `size` with its 95 % interval; a run "" means all, times are those of the run."""

    name: str
    channels: tuple[str, ...]
    run: str
    start_s: float
    end_s: float
    size: float
    low: float
    high: float
    unit: str
    text: str
    date: str = ""
    place_m: tuple[float, float] | None = None


def load(folder: Path | str) -> Recording:
    """A folder of recorder data, or the name of a packaged one. Raises ConfigError saying how to mend it."""
    place = dataset.find(folder)
    path = place / "dataset.toml"
    given = dataset.parse(path)
    rows, named = given.pop("run", []), given.pop("channels", None)
    head = table.read(HEAD, given, str(path))
    if not (isinstance(rows, list) and rows and all(isinstance(row, Mapping) for row in rows)):
        raise ConfigError(f"{path}: no [[run]]; a recording needs at least one")
    runs = [
        table.read(RUN, {**row, "date": str(row.get("date", ""))}, f"{path} [[run]] {i}")
        for i, row in enumerate(rows, start=1)
    ]
    for i, run in enumerate(runs, start=1):
        if not run["file"]:
            raise ConfigError(f"{path} [[run]] {i}: file is missing; name the data of this run")
        if not (place / run["file"]).exists():
            raise ConfigError(
                f"{place / run['file']}: no such file; correct `file` in dataset.toml"
            )
        if not re.fullmatch(r"(\d{4}-[01]\d-[0-3]\d)?", run["date"]):
            raise ConfigError(
                f"{path} [[run]] {i}: date = '{run['date']}' is none; write year-month-day, 2026-03-01"
            )
    if named is None:
        named = {
            name: {} for name in files.column_names(place / runs[0]["file"], head) if _kind(name)
        }
    if not isinstance(named, Mapping):
        raise ConfigError(f"{path}: channels is no table; write [channels]")
    stamps, channels = _channels(named, head, f"{path} [channels]")
    found = Recording(place.name, [], [head["note"]] if head["note"] else [])
    for run in runs:
        found.runs.append(_run(place, head | stamps, channels, run, found))
    return found


def _kind(key: str) -> tuple[str, str, int, str] | None:
    """(quantity, name, axle, unit) of a channel's key; None for any other."""
    for pattern, quantity, name in KEYS:
        if match := re.fullmatch(pattern, key):
            own = match.groups()
            axle = int(own[0]) if key.startswith("wheel") else 0
            unit = _SPEED.get(own[-1], own[-1]) if own else ""
            return quantity, name.format(own[0] if own else ""), axle, unit
    return None


def _channels(
    named: Mapping[str, Any], head: Mapping[str, Any], where: str
) -> tuple[dict[str, str], list[dict[str, Any]]]:
    """Column and unit of the stamps, and the channels."""
    stamps, found = {"time": "time_s", "time_unit": "s"}, []
    for key, content in named.items():
        row = dataset.read_rows(
            CHANNEL, {"column": content} if isinstance(content, str) else content, f"{where} {key}"
        )
        row["column"] = row["column"] or key
        if key == "time_s":
            stamps = {"time": row["column"], "time_unit": row["unit"] or "s"}
            continue
        if (kind := _kind(key)) is None:
            raise ConfigError(
                f"{where}: {key} is no channel; allowed: time_s, wheel_speed_1_rad_s .., "
                "wheel_speed_1_m_s .., bogie_speed_1_m_s .., reference_speed_m_s, brake_demand, "
                "position_m"
            )
        quantity, name, axle, unit = kind
        declared = row["unit"] or unit
        if quantity != "demand" and declared not in (allowed := _OF[quantity]):
            raise ConfigError(
                f"{where} {key}: unit = '{declared}' is none of a {quantity}; allowed: "
                f"{', '.join(allowed)}"
            )
        delay_s = (
            row["delay_s"] if row["delay_s"] >= 0.0 else 0.5 if quantity == "reference" else 0.0
        )
        found.append(
            {
                "quantity": quantity,
                "name": row["name"] or name,
                "axle": axle,
                "column": row["column"],
                "unit": declared,
                "told": bool(row["unit"]),
                "delay_s": delay_s,
                "scale": head["wheel_radius_m"]
                if declared == "rad/s"
                else UNITS.get(declared, 1.0),
            }
        )
    names = [channel["name"] for channel in found]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"{where}: two channels are called '{name}'; give each a name of its own"
            )
    if not any(channel["quantity"] == "speed" for channel in found):
        raise ConfigError(
            f"{where}: no speed of an axle or a bogie; name one at least, as wheel_speed_1_m_s = "
            '{ column = "v1", unit = "km/h" }'
        )
    return stamps, found


def _run(
    folder: Path,
    head: Mapping[str, Any],
    channels: list[dict[str, Any]],
    given: Mapping[str, Any],
    found: Recording,
) -> Run:
    path = folder / given["file"]
    columns = files.read(path, [channel["column"] for channel in channels], head)
    first = min(float(column.time_s.min()) for column in columns.values() if column.time_s.size)
    made = {}
    for channel in channels:
        column, scale, name = columns[channel["column"]], channel["scale"], channel["name"]
        told = column.unit.replace(" ", "")
        if told in UNITS and channel["told"] and told != channel["unit"]:
            raise ConfigError(
                f"{path}: column '{channel['column']}' says '{told}', dataset.toml says unit = "
                f"'{channel['unit']}' of {name}; correct one of them"
            )
        if told in UNITS and told in _OF[channel["quantity"]]:
            scale = UNITS[told]
        if np.count_nonzero(np.isfinite(column.values)) < LEAST_SAMPLES:
            raise ConfigError(
                f"{path}: {name} has {np.count_nonzero(np.isfinite(column.values))} samples; give a "
                f"recording of {LEAST_SAMPLES} at least, or leave the channel out"
            )
        made[name] = Channel(
            name,
            channel["quantity"],
            channel["delay_s"],
            column.time_s - first,
            column.values * scale,
            scale * quantum(column.values),
            channel["axle"],
        )
    name = path.stem
    if name in {run.name for run in found.runs}:
        name = f"{name}_{len(found.runs) + 1}"
    return Run(name, given["date"], given["vehicle_id"], made)


def quantum(values: np.ndarray) -> float:
    """The step of rounding by decimal digits, as most values have it; 0 where they have none."""
    values = values[np.isfinite(values)]
    for digits in range(4):
        scaled = values * 10.0**digits
        if values.size and np.mean(np.abs(scaled - np.rint(scaled)) < 1e-6) > 0.6:
            return float(10.0**-digits)
    return 0.0
