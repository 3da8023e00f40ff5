"""Reads measured data: a folder with `dataset.toml` and CSV, Parquet or MDF4 files, and checks it.

Whatever would make a finding worthless is refused here with what is wrong and how to mend it; what only narrows what
can be concluded becomes a warning that the report repeats. Format: README, measured data.
"""

import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from rollerrig.configs import store, table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, flag, number
from rollerrig.rig import params
from rollerrig.rig.identify.data import mdf, quality
from rollerrig.rig.identify.data.runs import AXLES, Curve, Dataset, Run

HEAD = (
    choice("kind", "braking_runs", ("braking_runs", "creep_curve", "recorder"), "what the data is"),
    choice("vehicle_set", "uic_z1", (), "configs/vehicles; written `vehicle`"),
    number("sample_time_s", 0.01, 1e-4, 0.1, "s"),
    choice("file", "", (), "the file of a creep curve"),
    choice("title", "", (), "a sentence"),
    choice("source", "", (), "where the data is from"),
    choice("note", "", (), "what the reader of a report must know; the report repeats it"),
)
RUN = (
    choice("file", "", (), "CSV, Parquet or MDF4"),
    choice("group", "tune", ("tune", "validate"), "validate: never fitted, only judged"),
    number("initial_speed_m_s", -1.0, 0.0, 150.0, "m/s"),
    number("mu_cd", -1.0, 1e-4, 1.0, "estimated where not given"),
    number("mass_kg", -1.0, 1000.0, 200000.0, "kg"),
    flag("held", False, "drives held the speed of the surface: no force balance of a vehicle"),
)
# one standard deviation; estimated where not given (calibration and form: assumed)
ACCURACY = (
    number("speed_m_s", -1.0, 1e-5, 5.0, "m/s"),
    number("wheel_speed_rad_s", -1.0, 1e-5, 10.0, "rad/s"),
    number("torque_fraction", -1.0, 1e-5, 0.5, "of the run's largest torque"),
    number("load_fraction", -1.0, 1e-5, 0.5, "of the static load"),
    number("calibration_fraction", 0.003, 0.0, 0.2, "of torque, load and mass"),
    number(
        "form_fraction",
        0.07,
        0.0,
        0.5,
        "of what a cause explains: how far its law may be another in truth",
    ),
)
CHANNELS = (
    "vehicle_speed_m_s",
    "position_m",
    *(
        f"{name}_{j}_{unit}"
        for name, unit in (
            ("wheel_speed", "rad_s"),
            ("wheel_load", "N"),
            ("brake_torque", "Nm"),
            ("surface_speed", "m_s"),
        )
        for j in range(1, AXLES + 1)
    ),
)


def load(folder: Path | str) -> Dataset:
    """A dataset's folder (or the name of a packaged one). Raises ConfigError saying how to mend it."""
    folder = find(folder)
    path = folder / "dataset.toml"
    given = parse(path)
    if given.get("kind") == "recorder":
        raise ConfigError(
            f"{path}: a recorder's data has no load and no torque to fit; use rollerrig explain"
        )
    tables = {key: given.pop(key) for key in list(given) if isinstance(given[key], dict | list)}
    head = table.read(HEAD, given, str(path))
    unknown = set(tables) - {"vehicle", "adhesion", "contact", "brake", "accuracy", "axles", "run"}
    if unknown:
        raise ConfigError(
            f"{path}: unknown table '{sorted(unknown)[0]}'; allowed: vehicle, "
            "adhesion, contact, brake, accuracy, axles, run"
        )
    sections = base_sections(head["vehicle_set"], tables, str(path))
    found = Dataset(
        name=folder.name,
        kind=head["kind"],
        folder=folder,
        sample_time_s=head["sample_time_s"],
        sections=sections,
        accuracy=read_rows(ACCURACY, tables.get("accuracy", {}), f"{path} [accuracy]"),
        axle_position_m=_positions(tables.get("axles", {}), sections, str(path)),
        runs=[],
        curve=None,
        warnings=[head["note"]] if head["note"] else [],
    )
    if head["kind"] == "creep_curve":
        return found._replace(curve=_creep_curve(found, head, tables))
    found.runs.extend(
        _run(found, row, i, path) for i, row in enumerate(tables.get("run", []), start=1)
    )
    quality.check(found, str(path))
    return found


def parse(path: Path) -> dict[str, Any]:
    """dataset.toml as plain data; `vehicle = "name"` may stand beside a table [vehicle], which TOML itself forbids."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    top, bracket, rest = text.partition("\n[")
    top = re.sub(r"^vehicle(\s*=)", r"vehicle_set\1", top, flags=re.MULTILINE)
    try:
        given = tomllib.loads(top + bracket + rest)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    if isinstance(given.get("vehicle"), str):
        given["vehicle_set"] = given.pop("vehicle")
    return given


def find(folder: Path | str) -> Path:
    """The folder of a dataset, given as such or by the name of a packaged one. Raises ConfigError."""
    for candidate in (Path(folder), store.ROOT / "datasets" / str(folder)):
        if (candidate / "dataset.toml").is_file():
            return candidate
    names = sorted(p.parent.name for p in (store.ROOT / "datasets").glob("*/dataset.toml"))
    raise ConfigError(
        f"{folder}: no dataset.toml in there; give a folder that has one, or one of: {', '.join(names)}"
    )


def base_sections(vehicle: str, tables: Mapping[str, Any], where: str) -> dict[str, dict[str, Any]]:
    """The parameters of the base model: a packaged vehicle, Table 4 and a rail, then overrides."""
    packaged, at = store.load("vehicles", vehicle)
    merged: dict[str, dict[str, Any]] = {k: dict(v) for k, v in packaged.items()}
    merged.setdefault("contact", {}).update(lateral_radius_m=0.3, roller_radius_m=math.inf)
    for key in ("vehicle", "adhesion", "contact", "brake"):
        table.read(params.ROWS[key], tables.get(key, {}), f"{where} [{key}]")
        merged.setdefault(key, {}).update(tables.get(key, {}))
    return params.check(merged, f"{where} with {at.name}")


def read_rows(rows: tuple[Row, ...], content: Mapping[str, Any], where: str) -> dict[str, Any]:
    """As `table.read`, of rows whose default may lie outside their bounds."""
    # a default outside the bounds stands for "not given" and is not checked
    absent = {
        r.name: r.default
        for r in rows
        if isinstance(r.default, float) and not r.low <= r.default <= r.high
    }
    checked = table.read(
        [r._replace(default=r.low) if r.name in absent else r for r in rows], content, where
    )
    return checked | {name: value for name, value in absent.items() if name not in content}


def _positions(given: Any, sections: Mapping[str, Any], where: str) -> np.ndarray:
    default = params.axle_positions(sections["vehicle"])
    row = Row("positions_m", tuple(float(x) for x in default), 0.0, 1000.0, "m")
    positions = np.array(table.read((row,), given, f"{where} [axles]")["positions_m"])
    if np.any(np.diff(positions) <= 0.0):
        raise ConfigError(
            f"{where} [axles]: positions_m = {positions.tolist()} must rise from the "
            "leading wheelset on; give metres behind the first"
        )
    return positions


def read_table(path: Path) -> pa.Table:
    """A CSV or Parquet file. Raises ConfigError."""
    try:
        if path.suffix.lower() == ".parquet":
            return pyarrow.parquet.ParquetFile(path).read()
        lines = path.read_bytes()
        while lines.startswith(b"#"):
            lines = lines[lines.index(b"\n") + 1 :]
        return pyarrow.csv.read_csv(pa.BufferReader(lines))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; correct `file` in dataset.toml") from None
    except (pa.ArrowInvalid, ValueError, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as a table: {error}") from None


def column(data: pa.Table, name: str, path: Path) -> np.ndarray:
    """One column as floats, finite. Raises ConfigError naming row and column."""
    if (times := data.column_names.count(name)) != 1:
        why = (
            f"is there {times} times; keep one"
            if times
            else f"is missing{table.nearest(name, data.column_names)}"
        )
        raise ConfigError(f"{path}: column '{name}' {why}")
    try:
        values = np.asarray(data[name].to_numpy(zero_copy_only=False), dtype=float)
    except (ValueError, TypeError):
        raise ConfigError(
            f"{path}: column '{name}' is not all numbers; one number a row is wanted"
        ) from None
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ConfigError(
            f"{path}: column '{name}' is not a finite number in {bad.size} rows, the "
            f"first is row {bad[0] + 2}; cut the gap out into two runs or repair it"
        )
    return values


def _run(found: Dataset, row: Mapping[str, Any], index: int, toml: Path) -> Run:
    given = read_rows(RUN, row, f"{toml} [[run]] {index}")
    if not given["file"]:
        raise ConfigError(f"{toml} [[run]] {index}: file is missing; name the data of this run")
    path = found.folder / given["file"]
    data = (
        mdf.read(path, found.sample_time_s, CHANNELS, found.warnings)
        if path.suffix.lower() in mdf.SUFFIXES
        else read_table(path)
    )

    def each(prefix: str, unit: str) -> np.ndarray:
        return np.column_stack(
            [column(data, f"{prefix}_{j}_{unit}", path) for j in range(1, AXLES + 1)]
        )

    run = Run(
        name=path.stem,
        group=given["group"],
        mass_kg=(
            math.inf
            if given["held"]
            else given["mass_kg"]
            if given["mass_kg"] > 0
            else found.sections["vehicle"]["mass_kg"]
        ),
        mu_cd=given["mu_cd"] if given["mu_cd"] > 0 else None,
        time_s=column(data, "time_s", path),
        speed_m_s=column(data, "vehicle_speed_m_s", path),
        wheel_speed_rad_s=each("wheel_speed", "rad_s"),
        load_N=each("wheel_load", "N"),
        torque_Nm=each("brake_torque", "Nm"),
        position_m=column(data, "position_m", path) if "position_m" in data.column_names else None,
        surface_m_s=each("surface_speed", "m_s")
        if "surface_speed_1_m_s" in data.column_names
        else None,
    )
    quality.check_run(run, path, found, given["initial_speed_m_s"])
    return run


def _creep_curve(found: Dataset, head: Mapping[str, Any], tables: Mapping[str, Any]) -> Curve:
    folder, rows = found.folder, tables.get("run", [])
    files = [head["file"]] if head["file"] else [row.get("file", "") for row in rows]
    if not files or not all(files):
        raise ConfigError(f'{folder / "dataset.toml"}: no data; write file = "curve.csv"')
    parts = [(folder / name, read_table(folder / name)) for name in files]

    def joined(name: str, default: float | None, matters: str = "") -> np.ndarray:
        if matters and (
            without := [str(path) for path, data in parts if name not in data.column_names]
        ):
            found.warnings.append(
                f"{', '.join(without)}: no column '{name}', so {default:g} is taken, and {matters} "
                f"rests on it; give the column, or say that {default:g} is right by writing it there"
            )
        return np.concatenate(
            [
                column(data, name, path)
                if name in data.column_names or default is None
                else np.full(len(data), default)
                for path, data in parts
            ]
        )

    creepage, adhesion = joined("creepage", None), joined("adhesion", None)
    if creepage.size < 12:
        raise ConfigError(
            f"{parts[0][0]}: {creepage.size} points are too few for five parameters; give at least 12"
        )
    for name, values, what in (
        ("creepage", creepage, "sliding over speed (1 is a locked wheel)"),
        ("adhesion", adhesion, "force over load, below 1"),
    ):
        if (most := np.max(np.abs(values))) > 1.5:
            raise ConfigError(
                f"{parts[0][0]}: {name} reaches {most:.3g}; it is {what}: are these percent? Divide by "
                "100"
            )
    return Curve(
        creepage,
        adhesion,
        joined("speed_m_s", 10.0, "how friction falls with sliding (gamma)"),
        joined("wheel_load_N", 52700.0, "the initial slope (k_A, k_S)"),
        joined("series", 0.0),
    )
