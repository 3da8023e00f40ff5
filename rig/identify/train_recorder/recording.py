"""Reads a dataset of `kind = "recorder"`: channels with unit, runs with date and vehicle.

All values are returned in SI units. The stamps of a run count from its first sample. Doubtful data
stays in for `faults` to find. Data that cannot be read is refused here.
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
from rollerrig.rig.identify.files import channels as file_channels
from rollerrig.rig.identify.files import tables, units
from rollerrig.rig.identify.train_recorder import files
from rollerrig.rig.identify.train_recorder import thresholds as limit

HEAD = (
    choice("kind", "recorder", ("recorder",), "what the data is"),
    choice("title", "", (), "a sentence"),
    choice("source", "", (), "where the data is from"),
    choice("note", "", (), "what a reader of the report must know; the report repeats it"),
    choice("separator", "auto", tables.SEPARATORS, "of a CSV; auto: found in the file"),
    choice("decimal", "auto", tables.DECIMALS, "of a CSV; auto: found in the file"),
    number("wheel_radius_m", 0.445, 0.02, 2.0, "that the recorder assumes, for speeds in rad/s"),
    number(
        "hardest_m_s2",
        0.0,
        0.0,
        50.0,
        "hardest braking of the vehicle; 0: from the data, and at least 3",
    ),
)
CHANNEL = (
    choice(
        "column",
        "",
        (),
        "column or channel of the file; default: the key; rosbag2: /topic:field.field",
    ),
    choice("unit", "", (), "of the values in the file; default: the unit in the key"),
    choice("name", "", (), "of the channel in the report"),
    number(
        "delay_s",
        -1.0,
        0.0,
        3.0,
        "delay that is normal for this channel; default: 0 for a speed, 0.5 for a reference",
    ),
)
RUN = (
    choice("file", "", (), "CSV, Parquet, MDF4 or rosbag2 (its folder)"),
    choice("date", "", (), "year-month-day: wheels may change between dates"),
    choice("vehicle_id", "", (), "runs of one vehicle have the same wheels"),
)


class KeyPattern(NamedTuple):
    """Keys of one kind of channel.

    The groups of `pattern` are the number of the axle or bogie, and the unit.
    """

    pattern: str
    quantity: str
    name: str  # in the report, with the number


KEYS = (
    KeyPattern(r"wheel_speed_([1-9]\d*)_(m_s|rad_s)", "speed", "axle {}"),
    KeyPattern(r"bogie_speed_([1-9]\d*)_(m_s)", "speed", "bogie {}"),
    KeyPattern(r"reference_speed_(m_s)", "reference", "reference"),
    KeyPattern(r"position_(m)", "position", "position"),
    KeyPattern(r"brake_demand", "demand", "demand"),
    KeyPattern(r"yaw_rate_(rad_s)", "yaw", "yaw rate"),
)
# unit in a key -> unit
_KEY_UNITS = {"m_s": "m/s", "rad_s": "rad/s"}

# quantity -> unit to which its values are converted
_SI_UNITS = {"speed": "m/s", "reference": "m/s", "position": "m", "demand": "", "yaw": "rad/s"}

# quantity -> allowed units
_ALLOWED_UNITS = {
    "speed": (*units.of_quantity(units.SPEED), *units.of_quantity(units.ROTATION)),
    "reference": units.of_quantity(units.SPEED),
    "position": units.of_quantity(units.LENGTH),
    "demand": ("",),
    "yaw": units.of_quantity(units.ROTATION),
}

# s. Delay that is normal for a reference (receiver of GNSS, radar) where dataset.toml gives none.
REFERENCE_DELAY_S = 0.5

# samples. A channel with fewer is refused.
LEAST_SAMPLES = 100

# m/s. No vehicle of a recorder is faster: 540 km/h.
MOST_SPEED_M_S = 150.0

# Codes for "not available" are above all speeds by this ratio, and at most so many. Chosen.
FAR_RATIO = 2.0
MOST_CODES = 4

# share of the values that must be multiples of a step to make it the rounding step
_ROUNDED_SHARE = 0.6
_MOST_DIGITS = 3

# rounding of a unit that the file does not have, as 0.1 km/h written in m/s: values of a channel
# that are compared, samples for each distinct value, and the share of a step by which values may
# be off
_MOST_LEVELS = 2000
_SAMPLES_PER_LEVEL = 1.5
_OFF_STEP = 0.1


# faster samples are outliers
_FASTEST_PERCENTILE = 99

# bits of a sample that is not rounded. Chosen.
_BITS_WITHOUT_ROUNDING = 4.0


class Channel(NamedTuple):
    """Stamps and values (n,) in SI units, NaN where there is no value."""

    name: str
    quantity: str  # speed, reference, position, demand or yaw
    delay_s: float  # that is normal for this channel
    time_s: np.ndarray
    values: np.ndarray
    quantum: float  # step of rounding; 0 if none is visible
    axle: int = 0  # 0: not of a single axle
    deadband_m_s: float = 0.0  # of a recorder that logs on change; 0: it logs every sample

    @property
    def noise(self) -> float:
        """Standard deviation of the noise from sample to sample, by second differences.

        Values that are held count as rounding and not as noise.
        """
        known = self.values[np.isfinite(self.values)]
        bends = np.diff(known, 2)
        bends = bends[bends != 0.0]
        if bends.size < 3:
            return 0.0
        deviation = 1.4826 * float(np.median(np.abs(bends))) / np.sqrt(6.0)
        return max(deviation - 0.5 * self.quantum, 0.0)

    @property
    def bits(self) -> float:
        """Information in one sample, given the samples before it.

        Rounded values that repeat or change by one step carry little: they are equal by chance.
        """
        if not self.quantum:
            return _BITS_WITHOUT_ROUNDING
        bends = np.diff(self.values[np.isfinite(self.values)], 2) / self.quantum
        return 0.5 * float(np.log2(1.0 + np.mean(bends**2))) if bends.size else 0.0

    @property
    def error(self) -> float:
        """Standard error of a sample by noise, rounding and the deadband of the recorder."""
        return limit.error_m_s(self.noise, max(self.quantum, self.deadband_m_s))

    @property
    def step_s(self) -> float:
        """Median interval between two samples; infinite for fewer than two samples."""
        known_s = self.time_s[np.isfinite(self.values)]
        if known_s.size > 1:
            return float(np.median(np.diff(known_s)))
        return np.inf


class Run(NamedTuple):
    """One file of a recorder: channels by name."""

    name: str
    date: str
    vehicle_id: str
    channels: dict[str, Channel]
    hardest_m_s2: float = 0.0  # hardest braking; 0: not known
    hardest_is_given: bool = False  # by dataset.toml
    logs_on_change: bool = False

    @property
    def fastest_m_s(self) -> float:
        """The largest speed of any channel, but for one sample in a hundred; 0 without speeds."""
        highest_m_s = [
            float(np.nanpercentile(np.abs(channel.values), _FASTEST_PERCENTILE))
            for channel in self.of("speed", "reference")
            if np.isfinite(channel.values).any()
        ]
        return max(highest_m_s, default=0.0)

    def of(self, *quantities: str) -> list[Channel]:
        """The channels of some quantities."""
        return [channel for channel in self.channels.values() if channel.quantity in quantities]


class Recording(NamedTuple):
    """A dataset of a recorder; `warnings` are its notes to the reader of the report."""

    name: str
    runs: list[Run]
    warnings: list[str]


class _Key(NamedTuple):
    """The parts of a channel's key."""

    quantity: str
    name: str
    axle: int
    unit: str


class _Stamps(NamedTuple):
    """Column of the stamps, and their unit, or "" if dataset.toml gives none."""

    column: str
    unit: str


class _ChannelSource(NamedTuple):
    """A channel as dataset.toml describes it."""

    quantity: str
    name: str
    axle: int
    column: str
    unit: str
    unit_is_given: bool  # by `unit`, not only by the key
    delay_s: float
    radius_m: float  # that the recorder assumes


def load(folder: Path | str) -> Recording:
    """Return the recording of a folder, or of a packaged dataset by its name.

    Raises ConfigError with the file, the key and the remedy.
    """
    place = dataset.find(folder)
    path = place / "dataset.toml"
    content = dataset.parse(path)
    run_tables = content.pop("run", [])
    channel_tables = content.pop("channels", None)
    missing = tables.take_missing(content, str(path))
    head = table.read(HEAD, content, str(path)) | {"missing": missing}
    run_rows = _read_runs(place, path, run_tables)

    if channel_tables is None:
        # columns with standard names need no table
        names = files.column_names(place / run_rows[0]["file"], head, place)
        channel_tables = {name: {} for name in names if _parse_key(name) is not None}
    if not isinstance(channel_tables, Mapping):
        raise ConfigError(f"{path}: channels is not a table; write [channels]")
    stamps, sources = _read_channels(channel_tables, head, f"{path} [channels]")
    file_head = head | {"time": stamps.column, "time_unit": stamps.unit}

    notes = [head["note"]] if head["note"] else []
    runs: list[Run] = []
    for row in run_rows:
        name = Path(row["file"]).stem
        if name in {run.name for run in runs}:
            name = f"{name}_{len(runs) + 1}"
        channels, notes_of_file = _load_channels(place / row["file"], file_head, sources, place)
        notes.extend(notes_of_file)
        runs.append(
            Run(
                name=name,
                date=row["date"],
                vehicle_id=row["vehicle_id"],
                channels=channels,
                hardest_m_s2=head["hardest_m_s2"],
                hardest_is_given=head["hardest_m_s2"] > 0.0,
            )
        )
    return Recording(place.name, runs, notes)


def _read_runs(place: Path, path: Path, run_tables: Any) -> list[dict[str, Any]]:
    """Return the rows of [[run]] after their checks."""
    are_tables = isinstance(run_tables, list) and all(
        isinstance(row, Mapping) for row in run_tables
    )
    if not are_tables or not run_tables:
        raise ConfigError(f"{path}: there is no [[run]]; a recording needs at least one")

    rows = []
    for number_of_run, run_table in enumerate(run_tables, start=1):
        # TOML also has dates of its own type
        with_date = {**run_table, "date": str(run_table.get("date", ""))}
        rows.append(table.read(RUN, with_date, f"{path} [[run]] {number_of_run}"))

    for number_of_run, row in enumerate(rows, start=1):
        if not row["file"]:
            raise ConfigError(
                f"{path} [[run]] {number_of_run}: file is missing; name the data of this run"
            )
        if not (place / row["file"]).exists():
            raise ConfigError(
                f"{place / row['file']}: no such file; correct `file` in dataset.toml"
            )
        if not re.fullmatch(r"(\d{4}-[01]\d-[0-3]\d)?", row["date"]):
            raise ConfigError(
                f"{path} [[run]] {number_of_run}: date = '{row['date']}' is not a date; write "
                "year-month-day, as 2026-03-01"
            )
    return rows


def is_key(key: str) -> bool:
    """Return whether a channel of a recorder can have this key."""
    return _parse_key(key) is not None


def _parse_key(key: str) -> _Key | None:
    """Return the parts of a channel's key; None for any other key."""
    for kind in KEYS:
        match = re.fullmatch(kind.pattern, key)
        if match is None:
            continue
        groups = match.groups()
        number_of_axle = groups[0] if groups else ""
        unit = _KEY_UNITS.get(groups[-1], groups[-1]) if groups else ""
        axle = int(number_of_axle) if key.startswith("wheel") else 0
        return _Key(kind.quantity, kind.name.format(number_of_axle), axle, unit)
    return None


def _read_channels(
    tables: Mapping[str, Any], head: Mapping[str, Any], where: str
) -> tuple[_Stamps, list[_ChannelSource]]:
    """Return column and unit of the stamps, and the channels."""
    stamps = _Stamps("time_s", "")
    sources = []
    for key, content in tables.items():
        given = {"column": content} if isinstance(content, str) else content
        row = dataset.read_rows(CHANNEL, given, f"{where} {key}")
        row["column"] = row["column"] or key
        if key == "time_s":
            stamps = _Stamps(row["column"], row["unit"])
        else:
            sources.append(_channel_source(key, row, head, where))

    names = [source.name for source in sources]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"{where}: two channels are called '{name}'; give each channel a different name"
            )
    if not any(source.quantity == "speed" for source in sources):
        raise ConfigError(
            f"{where}: there is no speed of an axle or a bogie; name at least one, as "
            'wheel_speed_1_m_s = { column = "v1", unit = "km/h" }'
        )
    return stamps, sources


def _channel_source(
    key: str, row: Mapping[str, Any], head: Mapping[str, Any], where: str
) -> _ChannelSource:
    """Return one channel of [channels]: its key and the row under it."""
    kind = _parse_key(key)
    if kind is None:
        raise ConfigError(
            f"{where}: {key} is no channel; allowed: time_s, wheel_speed_1_rad_s .., "
            "wheel_speed_1_m_s .., bogie_speed_1_m_s .., reference_speed_m_s, brake_demand, "
            "position_m, yaw_rate_rad_s"
        )

    known = units.find(row["unit"] or kind.unit)
    unit = known.name if known else row["unit"]
    allowed = _ALLOWED_UNITS[kind.quantity]
    if kind.quantity != "demand" and unit not in allowed:
        raise ConfigError(
            f"{where} {key}: unit = '{unit}' is not a unit of a {kind.quantity}; allowed: "
            f"{', '.join(allowed)}"
        )

    delay_s = row["delay_s"]
    if delay_s < 0.0:  # not given
        delay_s = REFERENCE_DELAY_S if kind.quantity == "reference" else 0.0
    return _ChannelSource(
        quantity=kind.quantity,
        name=row["name"] or kind.name,
        axle=kind.axle,
        column=row["column"],
        unit=unit,
        unit_is_given=bool(row["unit"]),
        delay_s=delay_s,
        radius_m=head["wheel_radius_m"],
    )


def not_available(speed_m_s: np.ndarray) -> np.ndarray:
    """Return which values of a speed mean that there is none (n,), such as FFFFh.

    They are a few different values that no vehicle reaches, far above all others. Values of another
    unit are as close to each other as speeds are, so they stay.
    """
    size = np.abs(speed_m_s)
    above = np.isfinite(size) & (size > MOST_SPEED_M_S)
    below = np.isfinite(size) & ~above
    if not above.any() or not below.any():
        return np.zeros(size.size, bool)
    is_far = float(size[above].min()) > FAR_RATIO * float(size[below].max())
    is_few = np.unique(size[above]).size <= MOST_CODES
    return above if is_far and is_few else np.zeros(size.size, bool)


def _load_channels(
    path: Path, head: Mapping[str, Any], sources: list[_ChannelSource], folder: Path
) -> tuple[dict[str, Channel], list[str]]:
    """Return the channels of a file by name, in SI units, and notes of the file.

    The stamps count from the first sample.
    The file belongs to a dataset in `folder`.
    """
    columns = files.read(path, [source.column for source in sources], head, folder)
    first_s = min(float(column.time_s.min()) for column in columns.values() if column.time_s.size)

    channels = {}
    notes_of_values: list[str] = []
    for source in sources:
        column = columns[source.column]
        scale = _scale(path, source, column)
        if source.quantity in ("speed", "reference"):
            none = not_available(column.values * scale)
            if none.any():
                largest = float(np.max(np.abs(column.values[none] * scale)))
                notes_of_values.append(
                    f"{path.name}: {source.name} has {np.count_nonzero(none)} values of {largest:.4g} m/s, "
                    "far from all others and from what a vehicle does: they mean 'not available', and "
                    "are left out"
                )
                column = column._replace(values=np.where(none, np.nan, column.values))
        samples = np.count_nonzero(np.isfinite(column.values))
        if samples < LEAST_SAMPLES:
            raise ConfigError(
                f"{path}: {source.name} has {samples} samples; give a recording of at least "
                f"{LEAST_SAMPLES} samples, or leave the channel out"
            )
        channels[source.name] = Channel(
            name=source.name,
            quantity=source.quantity,
            delay_s=source.delay_s,
            time_s=column.time_s - first_s,
            values=column.values * scale,
            quantum=scale * quantum(column.values),
            axle=source.axle,
        )
    notes_of_file = [note for column in columns.values() for note in column.notes]
    notes = [*dict.fromkeys(notes_of_file), *notes_of_values]
    other_units: dict[tuple[str, str], list[str]] = {}
    for source in sources:
        found = units.find(columns[source.column].unit)
        if found and source.unit and not source.unit_is_given and found.name != source.unit:
            other_units.setdefault((found.name, source.unit), []).append(source.column)
    for (unit_of_file, unit_of_key), names in other_units.items():
        notes.append(
            f"{path.name}: {', '.join(names)} have the unit {unit_of_file} in the file, but "
            f"{unit_of_key} in the keys of dataset.toml; the unit of the file is used: write it as "
            "`unit` in [channels]"
        )
    return channels, notes


def _scale(path: Path, source: _ChannelSource, column: files.Column) -> float:
    """Return the factor to SI units; a unit in the file wins over the unit in the key.

    Raises ConfigError if the unit in the file contradicts the unit in dataset.toml.
    """
    if source.quantity == "demand":
        return 1.0
    found = column.unit
    if found in units.AMBIGUOUS and source.unit == "rad/s":
        found = ""  # the key decides what this unit means
    given = file_channels.Source(source.column, source.unit)
    if found and not source.unit_is_given:
        given = given._replace(unit="")
    return file_channels.factor(
        path, given, source.name, _SI_UNITS[source.quantity], found, source.radius_m
    )


# --- rounding ---


def quantum(values: np.ndarray) -> float:
    """Return the step to which most values are rounded; 0 where there is none.

    It is a decimal step, or the step of another unit: 0.1 km/h written in m/s with four digits.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0
    # a value that is held for long counts once
    changes = np.concatenate([[True], np.diff(known) != 0.0])
    decimal = _decimal_step(known[changes])
    levels = np.unique(known)
    if levels.size * _SAMPLES_PER_LEVEL > known.size or not 1 < levels.size < _MOST_LEVELS:
        return decimal
    return max(decimal, _even_step(levels))


def _decimal_step(known: np.ndarray) -> float:
    """Return the largest decimal step, at most 1, of which most values are multiples; else 0."""
    for digits in range(_MOST_DIGITS + 1):
        scaled = known * 10.0**digits
        on_step = np.abs(scaled - np.rint(scaled)) < 1e-6
        if np.mean(on_step) > _ROUNDED_SHARE:
            return float(10.0**-digits)
    return 0.0


def _even_step(levels: np.ndarray) -> float:
    """Return the step of distinct sorted values (n,) that are evenly spaced; 0 if they are not."""
    distances = np.diff(levels)
    step = float(np.median(distances[distances <= 1.5 * np.quantile(distances, 0.1)]))
    first = levels[0]
    # the step is improved over a range of values that doubles
    reach = 8
    while True:
        part = levels[:reach] - first
        counts = np.rint(part / step)
        if counts @ counts == 0.0:
            return 0.0
        step = float(counts @ part / (counts @ counts))
        if reach >= levels.size:
            break
        reach *= 2
    off = np.abs((levels - first) / step - np.rint((levels - first) / step))
    return step if np.mean(off < _OFF_STEP) > 0.9 else 0.0
