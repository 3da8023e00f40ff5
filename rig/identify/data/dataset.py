"""Reads a dataset of measured data, and checks it: a folder with `dataset.toml` and data files.

Data files are CSV, Parquet or MDF4. Errors that would make every conclusion worthless raise
ConfigError, which states what is wrong and how to correct it. Flaws that only limit the conclusions
become warnings, which the report repeats. The format is described in the README, measured data.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from rollerrig.configs import store, table, toml_text, unpacking, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, flag, number
from rollerrig.rig import params
from rollerrig.rig.identify.data import mdf, quality
from rollerrig.rig.identify.data.runs import AXLES, Curve, Dataset, Run

# the keys of dataset.toml outside its tables
HEAD = (
    choice("kind", "braking_runs", ("braking_runs", "creep_curve", "recorder"), "what the data is"),
    # in the file the key is `vehicle`; `parse` renames it
    choice("vehicle_set", "uic_z1", (), "configs/vehicles; written `vehicle`"),
    number("sample_time_s", 0.01, 1e-4, 0.1, "s"),
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
    flag("held", False, "drives held the speed of the surface: no force balance of a vehicle"),
)
# The keys of the table [accuracy]. Each value is one standard deviation. The default -1 means "not
# given": the value is estimated from the data. The other two defaults are assumptions.
ACCURACY = (
    number("speed_m_s", -1.0, 1e-5, 5.0, "m/s"),
    number("wheel_speed_rad_s", -1.0, 1e-5, 10.0, "rad/s"),
    number("torque_fraction", -1.0, 1e-5, 0.5, "of the run's largest torque"),
    number("load_fraction", -1.0, 1e-5, 0.5, "of the static load"),
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


def columns_of_axles(quantity: str, unit: str) -> tuple[str, ...]:
    """Return the column names of a quantity, one for each wheelset."""
    return tuple(f"{quantity}_{axle}_{unit}" for axle in range(1, AXLES + 1))


CHANNELS = (
    "vehicle_speed_m_s",
    "position_m",
    *columns_of_axles("wheel_speed", "rad_s"),
    *columns_of_axles("wheel_load", "N"),
    *columns_of_axles("brake_torque", "Nm"),
    *columns_of_axles("surface_speed", "m_s"),
)
FILE_REMEDY = "correct `file` in dataset.toml"
MOST_COLUMNS = 10_000
MOST_TEXT_BYTES = 256_000_000  # of a column of texts
TABLES = ("vehicle", "adhesion", "contact", "brake", "accuracy", "axles", "run")
MODEL_TABLES = ("vehicle", "adhesion", "contact", "brake")

LEAST_CURVE_POINTS = 12  # a creep curve has five parameters to fit
LARGEST_CURVE_VALUE = 1.5  # creepage and adhesion are shares; larger values are probably percent
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

    tables = _take_tables(content, path)
    head = table.read(HEAD, content, str(path))
    sections = base_sections(head["vehicle_set"], tables, str(path))
    dataset = Dataset(
        name=folder.name,
        kind=head["kind"],
        folder=folder,
        sample_time_s=head["sample_time_s"],
        sections=sections,
        accuracy=read_rows(ACCURACY, tables.get("accuracy", {}), f"{path} [accuracy]"),
        axle_position_m=_axle_positions(tables.get("axles", {}), sections, str(path)),
        runs=[],
        curve=None,
        warnings=[],
    )
    if head["note"]:
        dataset.warnings.append(head["note"])

    if head["kind"] == "creep_curve":
        return dataset._replace(curve=_creep_curve(dataset, head, tables))
    for number_of_run, row in enumerate(tables.get("run", []), start=1):
        dataset.runs.append(_run(dataset, row, number_of_run, path))
    quality.check(dataset, str(path))
    return dataset


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
    names = sorted(path.parent.name for path in packaged.glob("*/dataset.toml"))
    raise ConfigError(
        f"{folder}: this folder has no dataset.toml; give a folder that has one, or one of: "
        f"{', '.join(names)}"
    )


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


def read_table(path: Path, folder: Path) -> pa.Table:
    """Return the table of a CSV or Parquet file of a dataset in a folder. Raises ConfigError."""
    try:
        if path.suffix.lower() == ".parquet":
            return _read_parquet(path, folder)
        content = user_files.read_bytes(path, user_files.CSV, folder, FILE_REMEDY)
        # skip the comment lines at the top of a CSV file
        while content.startswith(b"#"):
            content = content[content.index(b"\n") + 1 :]
        check_columns(path, content.partition(b"\n")[0].count(b",") + 1)
        return pyarrow.csv.read_csv(pa.BufferReader(content))
    except (pa.ArrowInvalid, ValueError, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as a table: {error}") from None


def check_columns(path: Path, count: int) -> None:
    """Raise ConfigError if a file has more columns than are allowed."""
    if count > MOST_COLUMNS:
        raise ConfigError(
            f"{path}: has {count} columns; at most {MOST_COLUMNS} are allowed: leave out what is not "
            "needed"
        )


def _read_parquet(path: Path, folder: Path) -> pa.Table:
    """Return the table of a Parquet file. Raises ConfigError, and what pyarrow raises."""
    user_files.check(path, user_files.PARQUET, folder, FILE_REMEDY)
    metadata = pyarrow.parquet.read_metadata(path)
    check_columns(path, metadata.num_columns)
    unpacking.check_parquet(path, metadata)

    texts = unpacking.text_columns(metadata)
    data = pyarrow.parquet.ParquetFile(path, read_dictionary=texts).read()
    for place, name in enumerate(data.column_names):
        values = data.column(place)
        if pa.types.is_dictionary(values.type):
            _check_text_size(path, name, values)
            data = data.set_column(place, name, values.cast(values.type.value_type))
    return data


def _check_text_size(path: Path, name: str, values: pa.ChunkedArray) -> None:
    """Raise ConfigError if a column of texts, read as dictionary, is too large as texts."""
    size = 0
    for chunk in values.chunks:
        lengths = pyarrow.compute.binary_length(chunk.dictionary)
        size += pyarrow.compute.sum(lengths.take(chunk.indices)).as_py() or 0
    if size > MOST_TEXT_BYTES:
        raise ConfigError(
            f"{path}: the texts of column '{name}' need {size / 1e6:.4g} MB; at most "
            f"{MOST_TEXT_BYTES / 1e6:.4g} MB are allowed: leave the column out"
        )


def column(data: pa.Table, name: str, path: Path) -> np.ndarray:
    """Return a column of finite numbers. Raises ConfigError with the column and the row."""
    count = data.column_names.count(name)
    if count == 0:
        similar = table.nearest(name, data.column_names)
        raise ConfigError(f"{path}: column '{name}' is missing{similar}")
    if count > 1:
        raise ConfigError(f"{path}: column '{name}' is there {count} times; keep one")

    try:
        values = np.asarray(data[name].to_numpy(zero_copy_only=False), dtype=float)
    except (ValueError, TypeError):
        raise ConfigError(
            f"{path}: column '{name}' does not hold numbers only; give one number in each row"
        ) from None
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        # row 1 of the file is its header, so sample 0 is in row 2
        raise ConfigError(
            f"{path}: column '{name}' is not a finite number in {bad.size} rows, the first is row "
            f"{bad[0] + 2}; split the run at the gap into two runs, or repair it"
        )
    return values


def _run(dataset: Dataset, row: Mapping[str, Any], number_of_run: int, toml: Path) -> Run:
    """Return the checked run of a table [[run]]. Raises ConfigError."""
    where = f"{toml} [[run]] {number_of_run}"
    entry = read_rows(RUN, row, where)
    if not entry["file"]:
        raise ConfigError(f"{where}: file is missing; give the name of this run's data file")
    path = dataset.folder / entry["file"]
    if path.suffix.lower() in mdf.SUFFIXES:
        user_files.check(path, user_files.MDF, dataset.folder, FILE_REMEDY)
        data = mdf.read(path, dataset.sample_time_s, CHANNELS, dataset.warnings)
    else:
        data = read_table(path, dataset.folder)

    if entry["held"]:
        mass_kg = math.inf  # so that the forces of the wheels do not change the speed
    elif entry["mass_kg"] > 0:
        mass_kg = entry["mass_kg"]
    else:
        mass_kg = dataset.sections["vehicle"]["mass_kg"]

    position_m = None
    if "position_m" in data.column_names:
        position_m = column(data, "position_m", path)
    surface_m_s = None
    if "surface_speed_1_m_s" in data.column_names:
        surface_m_s = _values_of_axles(data, "surface_speed", "m_s", path)

    run = Run(
        name=path.stem,
        group=entry["group"],
        mass_kg=mass_kg,
        mu_cd=entry["mu_cd"] if entry["mu_cd"] > 0 else None,
        time_s=column(data, "time_s", path),
        speed_m_s=column(data, "vehicle_speed_m_s", path),
        wheel_speed_rad_s=_values_of_axles(data, "wheel_speed", "rad_s", path),
        load_N=_values_of_axles(data, "wheel_load", "N", path),
        torque_Nm=_values_of_axles(data, "brake_torque", "Nm", path),
        position_m=position_m,
        surface_m_s=surface_m_s,
    )
    quality.check_run(run, path, dataset, entry["initial_speed_m_s"])
    return run


def _values_of_axles(data: pa.Table, quantity: str, unit: str, path: Path) -> np.ndarray:
    """Return a quantity of all wheelsets, shape (samples, AXLES). Raises ConfigError."""
    return np.column_stack([column(data, name, path) for name in columns_of_axles(quantity, unit)])


def _creep_curve(dataset: Dataset, head: Mapping[str, Any], tables: Mapping[str, Any]) -> Curve:
    """Return the checked creep curve of a dataset. Raises ConfigError.

    Its points are in the file of the key `file`, else in the files of the tables [[run]]. Warnings
    are added to the dataset.
    """
    names = [row.get("file", "") for row in tables.get("run", [])]
    if head["file"]:
        names = [head["file"]]
    if not names or not all(names):
        toml = dataset.folder / "dataset.toml"
        raise ConfigError(f'{toml}: no data file is given; write file = "curve.csv"')
    paths = [dataset.folder / name for name in names]
    files = [(path, read_table(path, dataset.folder)) for path in paths]
    first_file = files[0][0]

    creepage = _joined_columns(files, "creepage", None)
    adhesion = _joined_columns(files, "adhesion", None)
    if creepage.size < LEAST_CURVE_POINTS:
        raise ConfigError(
            f"{first_file}: {creepage.size} points are too few for five parameters; give at least "
            f"{LEAST_CURVE_POINTS}"
        )
    _check_share(first_file, "creepage", creepage, "sliding over speed (1 is a locked wheel)")
    _check_share(first_file, "adhesion", adhesion, "force over load, below 1")

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
    return Curve(
        creepage=creepage,
        adhesion=adhesion,
        speed_m_s=speed_m_s,
        load_N=load_N,
        series=_joined_columns(files, "series", 0.0),
    )


def _joined_columns(
    files: Sequence[tuple[Path, pa.Table]], name: str, default: float | None
) -> np.ndarray:
    """Return a column of all files in one array.

    `default` fills files without the column. None: each file must have it.
    """
    parts = []
    for path, data in files:
        if name in data.column_names or default is None:
            parts.append(column(data, name, path))
        else:
            parts.append(np.full(len(data), default))
    return np.concatenate(parts)


def _warn_of_default(
    dataset: Dataset,
    files: Sequence[tuple[Path, pa.Table]],
    name: str,
    default: float,
    consequence: str,
) -> None:
    """Add a warning where files lack a column and `default` is used instead.

    `consequence` is what depends on the column.
    """
    without = [str(path) for path, data in files if name not in data.column_names]
    if without:
        dataset.warnings.append(
            f"{', '.join(without)}: column '{name}' is missing, so {default:g} is used, and "
            f"{consequence} depends on it; give the column, or fill it with {default:g} if that is right"
        )


def _check_share(path: Path, name: str, values: np.ndarray, meaning: str) -> None:
    """Raise ConfigError where values of a creep curve are too large, as percent are."""
    largest = np.max(np.abs(values))
    if largest > LARGEST_CURVE_VALUE:
        raise ConfigError(
            f"{path}: {name} reaches {largest:.3g}; it is {meaning}: if these are percent, divide by "
            "100"
        )
