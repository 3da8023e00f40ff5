"""Reads a dataset of measured data, and checks it: a folder with `dataset.toml` and data files.

Data files are CSV, Parquet or MDF4. Errors that would make every conclusion worthless raise
ConfigError, which states what is wrong and how to correct it. Flaws that only limit the conclusions
become warnings, which the report repeats. The format is described in the README, measured data.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import store, table, toml_text, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, flag, number
from rollerrig.rig import params
from rollerrig.rig.identify.data import mdf, pressures, quality
from rollerrig.rig.identify.data.runs import LARGEST_ADHESION, Curve, Dataset, Run
from rollerrig.rig.identify.files import channels, tables, units
from rollerrig.rig.identify.files.channels import Source
from rollerrig.rig.identify.files.tables import Table

# the keys of dataset.toml outside its tables
HEAD = (
    choice("kind", "braking_runs", ("braking_runs", "creep_curve", "recorder"), "what the data is"),
    # in the file the key is `vehicle`; `parse` renames it
    choice("vehicle_set", "uic_z1", (), "configs/vehicles; written `vehicle`"),
    number("sample_time_s", 0.01, 1e-4, 0.1, "s"),
    choice("separator", "auto", tables.SEPARATORS, "of a CSV; auto: found in the file"),
    choice("decimal", "auto", tables.DECIMALS, "of a CSV; auto: found in the file"),
    choice(
        "stamps",
        "recorded",
        ("recorded", "even"),
        "even: samples are sample_time_s apart although their stamps are late",
    ),
    choice("file", "", (), "the file of a creep curve"),
    choice("title", "", (), "a sentence"),
    choice("source", "", (), "where the data is from"),
    choice("note", "", (), "what the reader of a report must know; the report repeats it"),
)
# the keys of a table [[run]]
RUN = (
    choice("file", "", (), "CSV, Parquet or MDF4"),
    choice("group", "tune", ("tune", "validate"), "validate: never fitted, only judged"),
    # the default -1 means "not given"
    number("initial_speed_m_s", -1.0, 0.0, 150.0, "m/s"),
    number("mu_cd", -1.0, 1e-4, 1.0, "estimated where not given"),
    number("mass_kg", -1.0, 1000.0, 200000.0, "kg"),
    # where drives hold the speed, the wheels brake no mass, so there is no force balance
    choice("date", "", (), "year-month-day; the report compares runs of different dates"),
    choice("rig", "", (), "rig, vehicle or equipment; the report compares runs of different rigs"),
    flag("held", False, "drives held the speed of the surface: no force balance of a vehicle"),
)
# The keys of the table [accuracy]. Each value is one standard deviation. The default -1 means "not
# given": the value is estimated from the data. The other two defaults are assumptions.
ACCURACY = (
    number("speed_m_s", -1.0, 1e-5, 5.0, "m/s"),
    number("wheel_speed_rad_s", -1.0, 1e-5, 10.0, "rad/s"),
    number("torque_fraction", -1.0, 1e-5, 0.5, "of the run's largest torque"),
    number("load_fraction", -1.0, 1e-5, 0.5, "of the static load"),
    number("temperature_K", -1.0, 1e-3, 50.0, "K; of a creep curve"),
    number("calibration_fraction", 0.003, 0.0, 0.2, "of torque, load and mass"),
    # `form` is the form of a law: a library law is never exactly the true one
    number(
        "form_fraction",
        0.07,
        0.0,
        0.5,
        "of what a cause explains: how far its law may differ from the true law",
    ),
)


def columns_of_axles(quantity: str, unit: str, axles: int) -> tuple[str, ...]:
    """Return the column names of a quantity, one for each wheelset."""
    return tuple(f"{quantity}_{axle}_{unit}" for axle in range(1, axles + 1))


def channels_of(axles: int) -> tuple[str, ...]:
    """Return the columns of braking runs of a vehicle with this number of axles, without time_s."""
    return (
        "vehicle_speed_m_s",
        "position_m",
        *columns_of_axles("wheel_speed", "rad_s", axles),
        *columns_of_axles("wheel_load", "N", axles),
        *columns_of_axles("brake_torque", "Nm", axles),
        *columns_of_axles("brake_pressure", "Pa", axles),
        *columns_of_axles("surface_speed", "m_s", axles),
    )


# the columns of a creep curve
CURVE_CHANNELS = ("creepage", "adhesion", "speed_m_s", "wheel_load_N", "series")
# the keys of an entry of [channels]
CHANNEL = (
    choice("column", "", (), "column or channel of the file; default: the key"),
    choice("unit", "", (), "of the values in the file; default: from the file, else from the key"),
)
# the unit at the end of a key -> unit
KEY_UNITS = {
    "time_s": "s",
    "m_s": "m/s",
    "rad_s": "rad/s",
    "N": "N",
    "Nm": "Nm",
    "Pa": "Pa",
    "m": "m",
    "creepage": "-",
    "adhesion": "-",
}
TABLES = ("vehicle", "adhesion", "contact", "brake", "accuracy", "axles", "channels", "run")
MODEL_TABLES = ("vehicle", "adhesion", "contact", "brake")

# Larger stamps are dates. They count from the first sample, so that they lose no digits.
LARGEST_TIME_S = 1e6
LEAST_CURVE_POINTS = 12  # a creep curve has five parameters to fit
LARGEST_CREEPAGE = 1.5  # creepage and adhesion are shares; larger values are probably percent
DEFAULT_CURVE_SPEED_M_S = 10.0
DEFAULT_CURVE_LOAD_N = 52700.0  # about the static load of one wheel of the vehicle uic_z1


def load(folder: Path | str) -> Dataset:
    """Return the checked dataset of a folder, or of the packaged dataset with this name.

    Raises ConfigError, which states how to correct the data.
    """
    folder = find(folder)
    path = folder / "dataset.toml"
    content = parse(path)
    if content.get("kind") == "recorder":
        raise ConfigError(
            f"{path}: the data of a train recorder has no load and no torque, so it cannot be fitted "
            "as braking runs; use rollerrig explain"
        )

    toml_tables = _take_tables(content, path)
    missing = tables.take_missing(content, str(path))
    head = table.read(HEAD, content, str(path))
    sections = base_sections(head["vehicle_set"], toml_tables, str(path))
    dataset = Dataset(
        name=folder.name,
        kind=head["kind"],
        folder=folder,
        sample_time_s=head["sample_time_s"],
        sections=sections,
        accuracy=read_rows(ACCURACY, toml_tables.get("accuracy", {}), f"{path} [accuracy]"),
        axle_position_m=_axle_positions(toml_tables.get("axles", {}), sections, str(path)),
        runs=[],
        curve=None,
        warnings=[],
    )
    if head["note"]:
        dataset.warnings.append(head["note"])

    keys = ("time_s", *channels_of(dataset.axles))
    if head["kind"] == "creep_curve":
        keys = CURVE_CHANNELS
    reading = _Reading(
        form={
            "separator": head["separator"],
            "decimal": head["decimal"],
            "missing": missing,
        },
        sources=_read_sources(toml_tables.get("channels", {}), keys, f"{path} [channels]"),
        radius_m=sections["vehicle"]["wheel_radius_m"],
        axles=dataset.axles,
        are_even=head["stamps"] == "even",
    )
    if head["kind"] == "creep_curve":
        return dataset._replace(curve=_creep_curve(dataset, head, toml_tables, reading))
    _read_runs(dataset, toml_tables.get("run", []), path, reading)
    quality.check(dataset, str(path))
    return dataset


def _read_runs(
    dataset: Dataset, rows: Sequence[Mapping[str, Any]], path: Path, reading: "_Reading"
) -> None:
    """Read the runs of the tables [[run]] into the dataset, and check them. Raises ConfigError."""
    read = [_run(dataset, row, number, path, reading) for number, row in enumerate(rows, start=1)]
    runs = [one.run for one in read]
    pressures_Pa = [one.pressure_Pa for one in read if one.pressure_Pa is not None]
    if pressures_Pa:
        if len(pressures_Pa) < len(runs):
            raise ConfigError(
                f"{path}: some runs have brake torques and others have pressures only; give the same "
                "columns for all runs"
            )
        runs, gain = pressures.with_torques(runs, pressures_Pa, dataset.sections, str(path))
        dataset.warnings.append(
            "brake torques were not measured: they are the cylinder pressures above that of the "
            f"spring times {1e5 * gain.torque_Nm_Pa:.4g} N m per bar and wheelset (95 %: +- "
            f"{1e5 * gain.half_width_Nm_Pa:.2g}), which is what the lost momentum of the runs gives; "
            "a brake or a mass that is wrong by the same share in all runs cannot be seen"
        )
    for one, run in zip(read, runs, strict=True):
        quality.check_run(run, one.path, dataset, one.initial_speed_m_s)
        dataset.runs.append(run)


def _take_tables(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """Remove the tables from the content of dataset.toml and return them. Raises ConfigError."""
    names = [key for key, value in content.items() if isinstance(value, dict | list)]
    tables = {key: content.pop(key) for key in names}
    unknown = sorted(set(tables) - set(TABLES))
    if unknown:
        raise ConfigError(f"{path}: unknown table '{unknown[0]}'; allowed: {', '.join(TABLES)}")
    return tables


def parse(path: Path) -> dict[str, Any]:
    """Return dataset.toml as plain data. Raises ConfigError.

    A file may have both a key `vehicle = "name"` and a table [vehicle], which TOML forbids. The key
    is therefore renamed to `vehicle_set` before the text is parsed.
    """
    text = user_files.read_text(path, user_files.TOML, within=path.parent)
    # the key can only be above the first table, which begins with "[" at the start of a line
    top, bracket, rest = text.partition("\n[")
    top = re.sub(r"^vehicle(\s*=)", r"vehicle_set\1", top, flags=re.MULTILINE)
    content = toml_text.parse(top + bracket + rest, str(path))
    # the pattern above does not match an indented or a quoted key
    if isinstance(content.get("vehicle"), str):
        content["vehicle_set"] = content.pop("vehicle")
    return content


def find(folder: Path | str) -> Path:
    """Return the folder of a dataset, from a path or the name of a packaged dataset.

    Raises ConfigError where no dataset.toml is there.
    """
    packaged = store.ROOT / "datasets"
    for candidate in (Path(folder), packaged / str(folder)):
        if (candidate / "dataset.toml").is_file():
            return candidate
    names = [path.parent.name for path in packaged.glob("*/dataset.toml")]
    what = "this folder has no dataset.toml" if Path(folder).is_dir() else "there is no such folder"
    hint = table.nearest(Path(folder).name, names, "Packaged")
    raise ConfigError(f"{folder}: {what}{hint}; or give a folder that has a dataset.toml")


def base_sections(vehicle: str, tables: Mapping[str, Any], where: str) -> dict[str, dict[str, Any]]:
    """Return the parameter sections of the base model.

    The sections of a packaged vehicle come first. Then the contact of a rig is replaced by that of
    a rail. The tables of `tables` override both. Raises ConfigError.
    """
    packaged, vehicle_file = store.load("vehicles", vehicle)
    sections: dict[str, dict[str, Any]] = {key: dict(value) for key, value in packaged.items()}
    contact = sections.setdefault("contact", {})
    contact["lateral_radius_m"] = 0.3  # of the rail head
    contact["roller_radius_m"] = math.inf  # a rail is straight
    for key in MODEL_TABLES:
        overrides = tables.get(key, {})
        # checks keys and bounds only; the overrides themselves have no defaults filled in
        table.read(params.ROWS[key], overrides, f"{where} [{key}]")
        sections.setdefault(key, {}).update(overrides)
    params.check_initial_adhesion(sections, where)
    return params.check(sections, f"{where} with {vehicle_file.name}")


def read_rows(rows: tuple[Row, ...], content: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the value of each row, from `content` or by default. Raises ConfigError.

    Unlike `table.read`, it allows a default outside the bounds of its row, such as -1 for "not
    given". A value in `content` must be within the bounds.
    """
    not_given = {
        row.name: row.default
        for row in rows
        if isinstance(row.default, float) and not row.low <= row.default <= row.high
    }
    # `table.read` checks defaults too, so each of these gets a default within its bounds
    checkable = [row._replace(default=row.low) if row.name in not_given else row for row in rows]
    values = table.read(checkable, content, where)
    for name, default in not_given.items():
        if name not in content:
            values[name] = default
    return values


def _axle_positions(given: Any, sections: Mapping[str, Any], where: str) -> np.ndarray:
    """Return the distance in m of each wheelset behind the first one. Raises ConfigError."""
    default = tuple(float(x) for x in params.axle_positions(sections["vehicle"]))
    row = Row("positions_m", default, 0.0, 1000.0, "m")
    positions = np.array(table.read((row,), given, f"{where} [axles]")["positions_m"])
    if np.any(np.diff(positions) <= 0.0):
        raise ConfigError(
            f"{where} [axles]: positions_m = {positions.tolist()} must increase from the leading "
            "wheelset to the last; give the distance in metres behind the first wheelset"
        )
    return positions


# --- the columns of data files ---


class _Reading(NamedTuple):
    """How the data files of a dataset are read.

    form: the keys `separator` and `decimal` of dataset.toml.
    sources: of the channels in [channels], by key.
    radius_m: of the wheels, for wheel speeds that are given in m/s or km/h.
    axles: of the vehicle.
    are_even: the samples are even although their stamps are late.
    """

    form: dict[str, Any]
    sources: dict[str, Source]
    radius_m: float
    axles: int
    are_even: bool

    def column(self, key: str) -> str:
        """Return the name of the column of a channel."""
        if key in self.sources:
            return self.sources[key].column
        return key


class _DataFile(NamedTuple):
    """The table of a data file, and how it is read."""

    path: Path
    table: Table
    reading: _Reading

    def has(self, key: str) -> bool:
        """Return whether the file has a channel."""
        return self.reading.column(key) in self.table.names

    def channel(self, key: str) -> np.ndarray:
        """Return finite values (n,) in the unit of the key. Raises ConfigError."""
        source = self.reading.sources.get(key, Source(key, ""))
        if key == "time_s":
            stamps = channels.seconds(self.path, self.table, source)
            self._check_finite(source.column, stamps.time_s)
            if not np.any(np.abs(stamps.time_s) > LARGEST_TIME_S):
                return stamps.time_s
            return stamps.time_s - stamps.time_s[0]

        self._check_is_there(source.column)
        values = channels.values(self.path, self.table, source.column)
        self._check_finite(source.column, values)
        key_unit = _key_unit(key)
        found = self.table.units.get(source.column, "")
        channels.check_name(self.path, self.reading.sources, key, key_unit, found)
        factor = channels.factor(self.path, source, key, key_unit, found, self.reading.radius_m)
        return values if factor == 1.0 else factor * values

    def of_axles(self, quantity: str, unit: str) -> np.ndarray:
        """Return a quantity of all wheelsets, shape (samples, axles). Raises ConfigError."""
        keys = columns_of_axles(quantity, unit, self.reading.axles)
        return np.column_stack([self.channel(key) for key in keys])

    def _check_is_there(self, column: str) -> None:
        """Raise ConfigError if there is no column with this name.

        A column that is another channel already is no suggestion.
        """
        if column in self.table.names:
            return
        keys = ("time_s", *channels_of(self.reading.axles), *CURVE_CHANNELS)
        used = {self.reading.column(key) for key in keys}
        free = [name for name in self.table.names if name not in used]
        meant = [f"did you mean '{name}'? " for name in table.similar(column, free)[:1]]
        raise ConfigError(
            f"{self.path}: column '{column}' is missing; {''.join(meant)}give the channel, "
            "name its column in dataset.toml as `column` in [channels], or leave this run out of "
            f"dataset.toml. The file has: {', '.join(sorted(self.table.names))}"
        )

    def _check_finite(self, column: str, values: np.ndarray) -> None:
        """Raise ConfigError if a value is not a finite number."""
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size and bad.size == values.size:
            raise ConfigError(
                f"{self.path}: column '{column}' has no number in any of its {bad.size} rows; give the "
                "channel, or leave this run out of dataset.toml"
            )
        if bad.size > 0.5 * values.size:
            raise ConfigError(
                f"{self.path}: column '{column}' has a number in {values.size - bad.size} of its "
                f"{values.size} rows only: if its sensor is slower than the file, give all channels at "
                "the rate of the sensor; else give the channel, or leave this run out of dataset.toml"
            )
        if bad.size:
            raise ConfigError(
                f"{self.path}: column '{column}' is not a finite number in {bad.size} rows, the "
                f"first is {self.table.place(int(bad[0]))}; split the run at the gap into two runs, "
                "or repair it"
            )


def _key_unit(key: str) -> str:
    """Return the unit of a channel by its key; "" if it has none."""
    for ending, unit in KEY_UNITS.items():
        if key == ending or key.endswith(f"_{ending}"):
            return unit
    return ""


def _read_sources(content: Any, keys: tuple[str, ...], where: str) -> dict[str, Source]:
    """Return the sources of the channels of a table [channels]. Raises ConfigError."""
    if not isinstance(content, Mapping):
        raise ConfigError(f"{where}: is not a table; write [channels]")
    sources = {}
    for key, given in content.items():
        if key not in keys:
            raise ConfigError(
                f"{where}: {key} is no channel{table.nearest(key, keys)}; allowed: "
                f"{', '.join(name for name in keys if not re.search('_([2-9]|[0-9][0-9])_', name))}, and so on "
                "for each wheelset"
            )
        row = table.read(
            CHANNEL, {"column": given} if isinstance(given, str) else given, f"{where} {key}"
        )
        sources[key] = Source(row["column"] or key, row["unit"])
        if row["unit"] and units.find(row["unit"]) is None:
            raise ConfigError(
                f"{where} {key}: unit = '{row['unit']}' is not known; allowed: "
                f"{', '.join(channels.allowed_in(_key_unit(key)))}"
            )
    return sources


class _ReadRun(NamedTuple):
    """A run that is not checked yet.

    pressure_Pa: of the brake cylinders, (n, axles), if the file has no torques. Then the torques of
    the run are zero.
    """

    run: Run
    path: Path
    initial_speed_m_s: float
    pressure_Pa: np.ndarray | None


def _run(
    dataset: Dataset, row: Mapping[str, Any], number_of_run: int, toml: Path, reading: _Reading
) -> _ReadRun:
    """Return the run of a table [[run]]. Raises ConfigError."""
    where = f"{toml} [[run]] {number_of_run}"
    entry = read_rows(RUN, row, where)
    if not entry["file"]:
        raise ConfigError(f"{where}: file is missing; give the name of this run's data file")
    file = _open(dataset, dataset.folder / entry["file"], reading)
    path = file.path

    if entry["held"]:
        mass_kg = math.inf  # so that the forces of the wheels do not change the speed
    elif entry["mass_kg"] > 0:
        mass_kg = entry["mass_kg"]
    else:
        mass_kg = dataset.sections["vehicle"]["mass_kg"]

    position_m = file.channel("position_m") if file.has("position_m") else None
    surface_m_s = None
    if file.has("surface_speed_1_m_s"):
        surface_m_s = file.of_axles("surface_speed", "m_s")

    # the first missing column is reported, in the order of the documents
    time_s = file.channel("time_s")
    if reading.are_even:
        late_s = quality.lateness_s(time_s, dataset.sample_time_s)
        time_s = quality.even_stamps(time_s, path, dataset.sample_time_s)
        dataset.warnings.append(
            f"{path.name}: stamps that are up to {late_s or 0.0:.2g} s late were replaced by even ones"
        )
    speed_m_s = file.channel("vehicle_speed_m_s")
    wheel_speed_rad_s = file.of_axles("wheel_speed", "rad_s")
    load_N = file.of_axles("wheel_load", "N")
    pressure_Pa = None
    if file.has("brake_pressure_1_Pa") and not file.has("brake_torque_1_Nm"):
        pressure_Pa = file.of_axles("brake_pressure", "Pa")
        torque_Nm = np.zeros((time_s.size, dataset.axles))
    else:
        torque_Nm = file.of_axles("brake_torque", "Nm")

    run = Run(
        name=path.stem,
        group=entry["group"],
        mass_kg=mass_kg,
        mu_cd=entry["mu_cd"] if entry["mu_cd"] > 0 else None,
        time_s=time_s,
        speed_m_s=speed_m_s,
        wheel_speed_rad_s=wheel_speed_rad_s,
        load_N=load_N,
        torque_Nm=torque_Nm,
        position_m=position_m,
        surface_m_s=surface_m_s,
        date=entry["date"],
        rig=entry["rig"],
    )
    return _ReadRun(run, path, entry["initial_speed_m_s"], pressure_Pa)


def _open(dataset: Dataset, path: Path, reading: _Reading) -> _DataFile:
    """Return the table of a run's file; notes are added to the dataset. Raises ConfigError."""
    if path.suffix.lower() not in mdf.SUFFIXES:
        content = tables.read(path, dataset.folder, reading.form)
        dataset.warnings.extend(f"{path.name}: {note}" for note in content.notes)
        return _DataFile(path, content, reading)

    user_files.check(path, user_files.MDF, dataset.folder, tables.FILE_REMEDY)
    names = tuple(reading.column(key) for key in channels_of(dataset.axles))
    mapped = {source.column for source in reading.sources.values()}
    content = mdf.read(
        path,
        dataset.sample_time_s,
        names,
        dataset.warnings,
        lead=reading.column("wheel_speed_1_rad_s"),
        mapped=mapped,
    )
    # the stamps of MDF are part of the format
    sources = {key: source for key, source in reading.sources.items() if key != "time_s"}
    return _DataFile(path, content, reading._replace(sources=sources))


def _creep_curve(
    dataset: Dataset, head: Mapping[str, Any], toml_tables: Mapping[str, Any], reading: _Reading
) -> Curve:
    """Return the checked creep curve of a dataset. Raises ConfigError.

    Its points are in the file of the key `file`, else in the files of the tables [[run]]. Warnings
    are added to the dataset.
    """
    names = [row.get("file", "") for row in toml_tables.get("run", [])]
    if head["file"]:
        names = [head["file"]]
    if not names or not all(names):
        toml = dataset.folder / "dataset.toml"
        raise ConfigError(f'{toml}: no data file is given; write file = "curve.csv"')
    paths = [dataset.folder / name for name in names]
    files = [_open(dataset, path, reading) for path in paths]
    first_file = files[0].path

    creepage = _joined_columns(files, "creepage", None)
    adhesion = _joined_columns(files, "adhesion", None)
    if creepage.size < LEAST_CURVE_POINTS:
        raise ConfigError(
            f"{first_file}: {creepage.size} points are too few for five parameters; give at least "
            f"{LEAST_CURVE_POINTS}"
        )
    meaning = "sliding over speed (1 is a locked wheel)"
    _check_share(first_file, "creepage", creepage, LARGEST_CREEPAGE, meaning)
    _check_share(first_file, "adhesion", adhesion, LARGEST_ADHESION, "force over load")
    _check_signs(first_file, creepage, adhesion)

    _warn_of_default(
        dataset,
        files,
        "speed_m_s",
        DEFAULT_CURVE_SPEED_M_S,
        "the decrease of friction with sliding (gamma)",
    )
    speed_m_s = _joined_columns(files, "speed_m_s", DEFAULT_CURVE_SPEED_M_S)
    _warn_of_default(
        dataset, files, "wheel_load_N", DEFAULT_CURVE_LOAD_N, "the initial slope (k_A, k_S)"
    )
    load_N = _joined_columns(files, "wheel_load_N", DEFAULT_CURVE_LOAD_N)
    for name, values, least in (("wheel_load_N", load_N, 1e-6), ("speed_m_s", speed_m_s, 0.0)):
        if values.min() < least:
            raise ConfigError(
                f"{first_file}: column '{name}' is {values.min():g} in a point; it must be "
                f"{'above 0' if least else 'at least 0'}: correct or remove the point"
            )
    return Curve(
        creepage=creepage,
        adhesion=adhesion,
        speed_m_s=speed_m_s,
        load_N=load_N,
        series=_joined_columns(files, "series", 0.0),
        temperature_K=_optional_quantity(files, _TEMPERATURES),
        pressure_Pa=_optional_quantity(files, _PRESSURES),
    )


def _joined_columns(files: Sequence[_DataFile], name: str, default: float | None) -> np.ndarray:
    """Return a column of all files in one array.

    `default` fills files without the column. None: each file must have it.
    """
    parts = []
    for file in files:
        if file.has(name) or default is None:
            parts.append(file.channel(name))
        else:
            parts.append(np.full(len(file.table.data), default))
    return np.concatenate(parts)


def _warn_of_default(
    dataset: Dataset,
    files: Sequence[_DataFile],
    name: str,
    default: float,
    consequence: str,
) -> None:
    """Add a warning where files lack a column and `default` is used instead.

    `consequence` is what depends on the column.
    """
    without = [str(file.path) for file in files if not file.has(name)]
    if without:
        dataset.warnings.append(
            f"{', '.join(without)}: column '{name}' is missing, so {default:g} is used, and "
            f"{consequence} depends on it; give the column, or fill it with {default:g} if that is right"
        )


def _check_share(path: Path, name: str, values: np.ndarray, limit: float, meaning: str) -> None:
    """Raise ConfigError where values of a creep curve are too large, as percent are."""
    largest = np.max(np.abs(values))
    if largest > limit:
        raise ConfigError(
            f"{path}: {name} reaches {largest:.3g}; it is {meaning}, and at most {limit:g} is "
            "allowed: if these are percent, divide by 100"
        )


def _check_signs(path: Path, creepage: np.ndarray, adhesion: np.ndarray) -> None:
    """Raise ConfigError where adhesion has the other sign than creepage."""
    if np.median(adhesion * np.sign(creepage)) < 0.0:
        raise ConfigError(
            f"{path}: adhesion and creepage have opposite signs; both are positive in braking: flip "
            "the sign of one of them"
        )
    if not np.any(adhesion):
        raise ConfigError(f"{path}: adhesion is 0 in all points; give the measured force over load")


class _Unit(NamedTuple):
    """A column that gives a quantity in some unit: SI value = factor (value + offset)."""

    column: str
    factor: float
    offset: float


_TEMPERATURES = (_Unit("temperature_K", 1.0, 0.0), _Unit("temperature_degC", 1.0, 273.15))
_PRESSURES = (
    _Unit("pressure_Pa", 1.0, 0.0),
    _Unit("pressure_kPa", 1e3, 0.0),
    _Unit("pressure_bar", 1e5, 0.0),
    _Unit("pressure_MPa", 1e6, 0.0),
)


def _optional_quantity(files: Sequence[_DataFile], allowed: tuple[_Unit, ...]) -> np.ndarray | None:
    """Return an optional quantity of all files in SI units; None where no file has it.

    Raises ConfigError where only some files have it, or where a value is not above 0.
    """
    parts = []
    for file in files:
        for unit in allowed:
            if file.has(unit.column):
                values = unit.factor * (file.channel(unit.column) + unit.offset)
                if np.any(values <= 0.0):
                    raise ConfigError(
                        f"{file.path}: column '{unit.column}' has a value at or below 0 in SI "
                        f"units; allowed columns are {', '.join(row.column for row in allowed)}: "
                        "check the unit"
                    )
                parts.append(values)
                break
    if not parts:
        return None
    if len(parts) < len(files):
        names = ", ".join(unit.column for unit in allowed)
        raise ConfigError(
            f"{files[0].path.parent}: only some files of the creep curve have one of the columns "
            f"{names}; give it in all files, or in none"
        )
    return np.concatenate(parts)
