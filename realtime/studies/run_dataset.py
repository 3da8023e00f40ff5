"""Turns runs into a dataset in the format of measured data, so that tune, validate and explain read them.

Runs of the bench hold what the physics computed; sensors can be laid over them: noise and scale errors
of a declared size from a seed. The dataset says of itself that it is synthetic.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import records
from rollerrig.realtime.studies import run_sensors, velim
from rollerrig.rig import params
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import AXLES

PERFECT = {"speed_m_s": 0.0, "wheel_speed_rad_s": 0.0, "torque_fraction": 0.0, "load_fraction": 0.0,
           "calibration_fraction": 0.0}
# one standard deviation each: what sensors of a test train may reach (assumption)
SENSORS = {"speed_m_s": 0.03, "wheel_speed_rad_s": 0.067, "torque_fraction": 0.015,
           "load_fraction": 0.01, "calibration_fraction": 0.003}
# digits after the point: what is cut off is a tenth of the noise and less
_DIGITS = {"time_s": 2, "vehicle_speed_m_s": 2, "wheel_speed_rad_s": 2, "wheel_load_N": 0,
           "brake_torque_Nm": 0}
_VEHICLE = ("mass_kg", "wheel_radius_m", "wheelset_inertia_kgm2", "resistance_A_N",
            "resistance_B_N_s_m", "resistance_C_N_s2_m2")
_ADHESION_LEFT_OUT = ("mu_cd",)
_CONTACT = ("young_Pa", "shear_Pa", "poisson", "lateral_radius_m", "roller_radius_m")


class Course(NamedTuple):
    """One run: arrays (n,) or (n, 4); `group` tune or validate."""

    name: str
    group: str
    time_s: np.ndarray
    speed_m_s: np.ndarray
    wheel_speed_rad_s: np.ndarray
    load_N: np.ndarray
    torque_Nm: np.ndarray


def of_rows(name: str, group: str, rows: np.ndarray) -> Course:
    """A course from samples of all signals, shape (n, columns)."""
    return Course(name, group, rows[:, signals.column("time")], rows[:, signals.column("vehicle_speed")],
                  rows[:, signals.span("wheel_speed")], rows[:, signals.span("wheel_load")],
                  rows[:, signals.span("brake_torque")])


def measured(course: Course, sensors: Mapping[str, float], rng: np.random.Generator) -> Course:
    """The course as sensors of that accuracy would tell it."""
    n, axles = course.load_N.shape
    static = float(course.load_N.mean())
    scale = 1.0 + sensors["calibration_fraction"] * rng.standard_normal((2, axles))
    return course._replace(
        speed_m_s=course.speed_m_s + sensors["speed_m_s"] * rng.standard_normal(n),
        wheel_speed_rad_s=course.wheel_speed_rad_s
        + sensors["wheel_speed_rad_s"] * rng.standard_normal((n, axles)),
        load_N=course.load_N * scale[0] + sensors["load_fraction"] * static
        * rng.standard_normal((n, axles)),
        torque_Nm=course.torque_Nm * scale[1] + sensors["torque_fraction"]
        * float(course.torque_Nm.max()) * rng.standard_normal((n, axles)))


def write(out: Path, courses: Sequence[Course], resolved: Mapping[str, Any],
          sensors: Mapping[str, float], title: str, source: str) -> Path:
    """Write dataset.toml and a CSV for each course; `resolved` is the scenario they share.

    Raises ConfigError where the folder cannot be written.
    """
    step = float(np.median(np.diff(courses[0].time_s)))
    accuracy = {key: value for key, value in sensors.items() if value > 0.0}
    contact = {key: resolved["contact"][key] for key in _CONTACT}
    if resolved["rig"]["mode"] != "contaminated_rollers":
        contact["roller_radius_m"] = float("inf")
    head = {
        "title": title, "source": source, "kind": "braking_runs", "vehicle_set": "uic_z1",
        "sample_time_s": round(step, 6),
        "vehicle": {key: resolved["vehicle"][key] for key in _VEHICLE},
        "adhesion": {k: v for k, v in resolved["adhesion"].items() if k not in _ADHESION_LEFT_OUT},
        "contact": contact,
        **({"accuracy": accuracy} if accuracy else {}),
        "run": [{"file": f"runs/{c.name}.csv", "group": c.group,
                 "initial_speed_m_s": round(float(c.speed_m_s[:20].mean()), 2)} for c in courses],
    }
    try:
        (out / "runs").mkdir(parents=True, exist_ok=True)
        text = tomli_w.dumps(head).replace("vehicle_set = ", "vehicle = ", 1)
        (out / "dataset.toml").write_text(f"# SYNTHETIC: {title}\n{text}", encoding="utf-8")
        for course in courses:
            (out / "runs" / f"{course.name}.csv").write_text(_csv(course), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}; give another folder") from None
    return out


def _csv(course: Course) -> str:
    axles = range(1, AXLES + 1)
    names = ["time_s", "vehicle_speed_m_s", *(f"wheel_speed_{j}_rad_s" for j in axles),
             *(f"wheel_load_{j}_N" for j in axles), *(f"brake_torque_{j}_Nm" for j in axles)]
    values = np.column_stack(course[2:])
    digits = [_DIGITS["time_s"], _DIGITS["vehicle_speed_m_s"], *[_DIGITS["wheel_speed_rad_s"]] * AXLES,
              *[_DIGITS["wheel_load_N"]] * AXLES, *[_DIGITS["brake_torque_Nm"]] * AXLES]
    text = io.StringIO()
    np.savetxt(text, values, delimiter=",", fmt=[f"%.{d}f" for d in digits], header=",".join(names),
               comments="")
    return text.getvalue()


def from_folders(folders: Sequence[Path], out: Path, group: str, validate: Sequence[Path] = (),
                 noise: Mapping[str, float] = PERFECT, slowest_m_s: float = 0.01) -> Path:
    """A dataset of recorded run folders as their sensors tell them, those of `validate` in that group.

    The first run's config is the base model; its mechanisms and faults are not told. `noise` is laid
    over the channels and declared. Raises ConfigError for folders that hold no run, runs that are one
    and the same, or of different vehicles, rigs or adhesion.
    """
    runs = [records.load(folder) for folder in (*folders, *validate)]
    for run in runs:
        _same_base(run, runs[0])
    told = [run_sensors.of_run(run, slowest_m_s) for run in runs]
    _no_copies(runs, told)
    names = _names(runs)
    rng = np.random.default_rng(len(runs))
    told = [run_sensors.noisy(one, noise, rng)._replace(name=name)
            for one, name in zip(told, names, strict=True)]
    groups = [group] * len(folders) + ["validate"] * len(validate)
    head = _head(runs[0], told[0], noise) | {
        "title": "runs of the bench", "source": ", ".join(str(run.folder) for run in runs),
        "note": _notes(runs),
        "run": [{"file": f"runs/{one.name}.parquet", "group": belongs, "mass_kg": one.mass_kg,
                 "initial_speed_m_s": round(float(one.speed_m_s[:20].mean()), 2)}
                for one, belongs in zip(told, groups, strict=True)]}
    try:
        (out / "runs").mkdir(parents=True, exist_ok=True)
        text = tomli_w.dumps(head).replace("vehicle_set = ", "vehicle = ", 1)
        (out / "dataset.toml").write_text(f"# recorded by rollerrig run\n{text}", encoding="utf-8")
        for one in told:
            pq.write_table(_table(one), out / "runs" / f"{one.name}.parquet")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}; give another folder") from None
    return out


def _same_base(run: records.Run, first: records.Run) -> None:
    free = {"vehicle": ("mass_kg",), "adhesion": ("mu_cd",), "contact": (), "brake": (), "rig": ()}
    for table, left_out in free.items():
        mine, its = ({k: v for k, v in one.scenario.get(table, {}).items() if k not in left_out}
                     for one in (run, first))
        if mine != its:
            key = next(k for k in {**mine, **its} if mine.get(k) != its.get(k))
            raise ConfigError(
                f"{run.folder}: [{table}] {key} = {mine.get(key)!r} differs from {its.get(key)!r} in "
                f"{first.folder}; runs that are judged together need one vehicle, rig and adhesion law "
                "(vehicle.mass_kg and adhesion.mu_cd may differ): give them in separate calls")


def _no_copies(runs: Sequence[records.Run], told: Sequence[run_sensors.Told]) -> None:
    for i, one in enumerate(told):
        for k in range(i):
            if np.array_equal(one.wheel_speed_rad_s, told[k].wheel_speed_rad_s):
                raise ConfigError(f"{runs[i].folder} and {runs[k].folder} hold the same samples; a copy "
                                  "tells nothing new and cannot validate: brake from another speed or "
                                  "with another demand (free and lockstep runs repeat bit for bit)")


def _names(runs: Sequence[records.Run]) -> list[str]:
    names = [run.folder.resolve().name for run in runs]
    return [name if names.count(name) == 1 else f"{name}_{k}" for k, name in enumerate(names, start=1)]


def _notes(runs: Sequence[records.Run]) -> str:
    first = runs[0].scenario
    told = []
    if any(run.scenario.get("friction") for run in runs):
        told.append("the scenario changes friction by place or time, which the base model does not "
                    "know: it is looked for like a cause")
    if first["contact"].get("model", "degraded") != "degraded":
        told.append(f"the runs had contact.model = {first['contact']['model']!r}; the base model is the "
                    "degraded adhesion law")
    return "; ".join(told)


def _head(run: records.Run, told: run_sensors.Told, noise: Mapping[str, float]) -> dict[str, Any]:
    plan = run.scenario
    contact = {key: plan["contact"][key] for key in _CONTACT}
    if told.surface_m_s is None:
        contact["roller_radius_m"] = float("inf")
    accuracy = {key: value for key, value in noise.items() if value > 0.0}
    return {
        "kind": "braking_runs", "vehicle_set": "uic_z1",
        "sample_time_s": round(float(np.median(np.diff(told.time_s))), 6),
        "vehicle": {key: plan["vehicle"][key] for key in _VEHICLE},
        "adhesion": plan["adhesion"], "contact": contact,
        "axles": {"positions_m": params.axle_positions(plan["vehicle"]).tolist()},
        **({"accuracy": accuracy} if accuracy else {})}


def _table(told: run_sensors.Told) -> pa.Table:
    columns = {"time_s": told.time_s, "vehicle_speed_m_s": told.speed_m_s, "position_m": told.position_m}
    for name, values, unit in (("wheel_speed", told.wheel_speed_rad_s, "rad_s"),
                               ("wheel_load", told.load_N, "N"), ("brake_torque", told.torque_Nm, "Nm"),
                               ("surface_speed", told.surface_m_s, "m_s")):
        if values is not None:
            columns |= {f"{name}_{j}_{unit}": values[:, j - 1] for j in range(1, AXLES + 1)}
    return pa.table(columns)


def velim_synthetic(out: Path, seed: int = 1) -> Path:
    """The six Velim stops as this project simulates them, with sensors: a synthetic dataset."""
    found = velim.settings()
    rng = np.random.default_rng(seed)
    courses = []
    for test in velim.TESTS:
        rows = velim.stops.moving(velim.rows_of(test, found))
        group = "tune" if test in velim.GROUP_A else "validate"
        courses.append(measured(of_rows(test, group, rows), SENSORS, rng))
    return write(out, courses, velim.plan_of("a1", found).resolved, SENSORS,
                 "six stops as at Velim, simulated by this project; not the recordings of the paper",
                 "rollerrig tune velim --dataset; true tau 1.9e-4 m/J")
