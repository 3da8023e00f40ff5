"""Reads measured data: a folder with `dataset.toml` and CSV, Parquet or MDF4 files, and checks it.

Whatever would make a finding worthless is refused here with what is wrong and how to mend it; what
only narrows what can be concluded becomes a warning that the report repeats.
Format: README, measured data.
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
from rollerrig.configs.table import Row, choice, number
from rollerrig.rig import params
from rollerrig.rig.identify.data import mdf, quality
from rollerrig.rig.identify.data.runs import AXLES, Curve, Dataset, Run

HEAD = (
    choice("kind", "braking_runs", ("braking_runs", "creep_curve"), "what the data is"),
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
)
# one standard deviation; estimated where not given (calibration: assumed)
ACCURACY = (
    number("speed_m_s", -1.0, 1e-5, 5.0, "m/s"),
    number("wheel_speed_rad_s", -1.0, 1e-5, 10.0, "rad/s"),
    number("torque_fraction", -1.0, 1e-5, 0.5, "of the run's largest torque"),
    number("load_fraction", -1.0, 1e-5, 0.5, "of the static load"),
    number("calibration_fraction", 0.003, 0.0, 0.2, "of torque, load and mass"),
)
VEHICLE_KEYS = ("mass_kg", "wheel_radius_m", "wheelset_inertia_kgm2", "resistance_A_N",
                "resistance_B_N_s_m", "resistance_C_N_s2_m2")
CHANNELS = ("vehicle_speed_m_s", "position_m", *(
    f"{name}_{j}_{unit}" for name, unit in (("wheel_speed", "rad_s"), ("wheel_load", "N"),
                                            ("brake_torque", "Nm"), ("surface_speed", "m_s"))
    for j in range(1, AXLES + 1)))


def load(folder: Path | str) -> Dataset:
    """A dataset's folder (or the name of a packaged one). Raises ConfigError saying how to mend it."""
    folder = _find(folder)
    path = folder / "dataset.toml"
    given = parse(path)
    tables = {key: given.pop(key) for key in list(given) if isinstance(given[key], dict | list)}
    head = table.read(HEAD, given, str(path))
    unknown = set(tables) - {"vehicle", "adhesion", "contact", "brake", "accuracy", "axles", "run"}
    if unknown:
        raise ConfigError(f"{path}: unknown table '{sorted(unknown)[0]}'; allowed: vehicle, "
                          "adhesion, contact, brake, accuracy, axles, run")
    sections = base_sections(head["vehicle_set"], tables, str(path))
    accuracy = _given(ACCURACY, tables.get("accuracy", {}), f"{path} [accuracy]")
    positions = _positions(tables.get("axles", {}), sections, str(path))
    warnings: list[str] = [head["note"]] if head["note"] else []
    if head["kind"] == "creep_curve":
        curve = _creep_curve(folder, head, tables)
        return Dataset(folder.name, head["kind"], folder, head["sample_time_s"], sections, accuracy,
                       positions, [], curve, warnings)
    runs = [_run(folder, row, i, sections, head["sample_time_s"], path, warnings)
            for i, row in enumerate(tables.get("run", []), start=1)]
    found = Dataset(folder.name, head["kind"], folder, head["sample_time_s"], sections, accuracy,
                    positions, runs, None, warnings)
    quality.check(found, str(path))
    return found


def parse(path: Path) -> dict[str, Any]:
    """dataset.toml as plain data; `vehicle = "name"` may stand beside a table [vehicle].

    TOML itself forbids a key and a table of one name, the format of datasets wants both.
    """
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


def _find(folder: Path | str) -> Path:
    given = Path(folder)
    packaged = store.ROOT / "datasets" / str(folder)
    for candidate in (given, packaged):
        if (candidate / "dataset.toml").is_file():
            return candidate
    names = sorted(p.parent.name for p in (store.ROOT / "datasets").glob("*/dataset.toml"))
    raise ConfigError(f"{folder}: no dataset.toml in there; give a folder that has one, or one of: "
                      f"{', '.join(names)}")


def base_sections(vehicle: str, tables: Mapping[str, Any], where: str) -> dict[str, dict[str, Any]]:
    """The parameters of the base model: a packaged vehicle, Table 4 and a rail, then overrides."""
    packaged, at = store.load("vehicles", vehicle)
    merged: dict[str, dict[str, Any]] = {k: dict(v) for k, v in packaged.items()}
    merged.setdefault("contact", {}).update(lateral_radius_m=0.3, roller_radius_m=math.inf)
    for key in ("vehicle", "adhesion", "contact", "brake"):
        content = tables.get(key, {})
        if not isinstance(content, dict):
            raise ConfigError(f"{where}: {key} must be a table [{key}]")
        table.read(params.ROWS[key], content, f"{where} [{key}]")
        merged.setdefault(key, {}).update(content)
    return params.check(merged, f"{where} with {at.name}")


def _given(rows: tuple[Row, ...], content: Mapping[str, Any], where: str) -> dict[str, Any]:
    # a default outside the bounds stands for "not given" and is not checked
    if not isinstance(content, Mapping):
        return table.read(rows, content, where)  # refuses it
    known = {row.name for row in rows}
    checked = table.read([r for r in rows if r.name in content or r.low <= _size(r) <= r.high],
                         {k: v for k, v in content.items() if k in known}, where)
    for key in content:
        if key not in known:
            raise ConfigError(f"{where}: unknown key '{key}'{table.nearest(key, known)}")
    return {row.name: row.default for row in rows} | checked


def _size(row: Row) -> float:
    return row.default if isinstance(row.default, float) else row.low


def _positions(given: Any, sections: Mapping[str, Any], where: str) -> np.ndarray:
    default = params.axle_positions(sections["vehicle"])
    row = Row("positions_m", tuple(float(x) for x in default), 0.0, 1000.0, "m")
    positions = np.array(table.read((row,), given, f"{where} [axles]")["positions_m"])
    if np.any(np.diff(positions) <= 0.0):
        raise ConfigError(f"{where} [axles]: positions_m = {positions.tolist()} must rise from the "
                          "leading wheelset on; give metres behind the first")
    return positions


def read_table(path: Path) -> pa.Table:
    """A CSV or Parquet file. Raises ConfigError."""
    try:
        if path.suffix == ".parquet":
            return pyarrow.parquet.read_table(path)
        lines = path.read_bytes()
        skip = 0
        while lines.startswith(b"#"):
            lines = lines[lines.index(b"\n") + 1:]
            skip += 1
        return pyarrow.csv.read_csv(pa.BufferReader(lines))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; correct `file` in dataset.toml") from None
    except (pa.ArrowInvalid, ValueError, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as a table: {error}") from None


def column(data: pa.Table, name: str, path: Path) -> np.ndarray:
    """One column as floats, finite. Raises ConfigError naming row and column."""
    if name not in data.column_names:
        raise ConfigError(f"{path}: column '{name}' is missing"
                          f"{table.nearest(name, data.column_names)}")
    try:
        values = np.asarray(data[name].to_numpy(zero_copy_only=False), dtype=float)
    except (ValueError, TypeError):
        raise ConfigError(f"{path}: column '{name}' is not all numbers; one number a row is wanted"
                          ) from None
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ConfigError(f"{path}: column '{name}' is not a finite number in {bad.size} rows, the "
                          f"first is row {bad[0] + 2}; cut the gap out into two runs or repair it")
    return values


def _run(folder: Path, row: Mapping[str, Any], index: int, sections: Mapping[str, Any],
         sample_time_s: float, toml: Path, warnings: list[str]) -> Run:
    given = _given(RUN, row, f"{toml} [[run]] {index}")
    if not given["file"]:
        raise ConfigError(f"{toml} [[run]] {index}: file is missing; name the data of this run")
    path = folder / given["file"]
    data = (mdf.read(path, sample_time_s, CHANNELS, warnings) if path.suffix in mdf.SUFFIXES
            else read_table(path))

    def each(prefix: str, unit: str) -> np.ndarray:
        return np.column_stack([column(data, f"{prefix}_{j}_{unit}", path)
                                for j in range(1, AXLES + 1)])

    def maybe(name: str) -> np.ndarray | None:
        return column(data, name, path) if name in data.column_names else None

    mass = given["mass_kg"] if given["mass_kg"] > 0 else sections["vehicle"]["mass_kg"]
    run = Run(Path(given["file"]).stem, given["group"], mass,
              given["mu_cd"] if given["mu_cd"] > 0 else None, column(data, "time_s", path),
              column(data, "vehicle_speed_m_s", path), each("wheel_speed", "rad_s"),
              each("wheel_load", "N"), each("brake_torque", "Nm"), maybe("position_m"),
              each("surface_speed", "m_s") if "surface_speed_1_m_s" in data.column_names else None)
    quality.check_run(run, path, dict(sections), sample_time_s, given["initial_speed_m_s"], warnings)
    return run


def _creep_curve(folder: Path, head: Mapping[str, Any], tables: Mapping[str, Any]) -> Curve:
    rows = tables.get("run", [])
    files = [head["file"]] if head["file"] else [row.get("file", "") for row in rows]
    if not files or not all(files):
        raise ConfigError(f"{folder / 'dataset.toml'}: no data; write file = \"curve.csv\"")
    parts = [(folder / name, read_table(folder / name)) for name in files]

    def joined(name: str, default: float | None) -> np.ndarray:
        return np.concatenate([
            column(data, name, path) if name in data.column_names or default is None
            else np.full(len(data), default) for path, data in parts])

    creepage, adhesion = joined("creepage", None), joined("adhesion", None)
    if creepage.size < 12:
        raise ConfigError(f"{parts[0][0]}: {creepage.size} points are too few for five parameters; "
                          "give at least 12")
    if np.max(np.abs(creepage)) > 1.5:
        raise ConfigError(f"{parts[0][0]}: creepage reaches {np.max(np.abs(creepage)):.3g}; it is "
                          "sliding over speed (1 is a locked wheel): are these percent? Divide by 100")
    if np.max(np.abs(adhesion)) > 1.5:
        raise ConfigError(f"{parts[0][0]}: adhesion reaches {np.max(np.abs(adhesion)):.3g}; it is "
                          "force over load, below 1: are these percent? Divide by 100")
    return Curve(creepage, adhesion, joined("speed_m_s", 10.0),
                 joined("wheel_load_N", 52700.0), joined("series", 0.0))
