"""Turns runs into a dataset in the format of measured data, so that tune, validate and explain read them.

Runs of the bench hold what the physics computed; sensors can be laid over them: noise and scale errors
of a declared size from a seed. The dataset says of itself that it is synthetic.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import records, velim
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


def from_folders(folders: Sequence[Path], out: Path, group: str) -> Path:
    """A dataset of recorded run folders, without sensor noise, all in one group.

    Raises ConfigError for folders that hold no run, or runs of different vehicles.
    """
    runs = [records.load(folder) for folder in folders]
    courses = []
    for run in runs:
        for table in ("vehicle", "contact", "rig"):
            if run.scenario.get(table) != runs[0].scenario.get(table):
                raise ConfigError(f"{run.folder}: [{table}] differs from that of {runs[0].folder}; runs "
                                  "that are tuned together need one vehicle and one rig")
        still = np.flatnonzero(run.column("vehicle_speed_m_s") <= 0.01)
        end = int(still[0]) if still.size and still[0] > 0 else len(run.table)

        def each(name: str, unit: str, run: records.Run = run, end: int = end) -> np.ndarray:
            return np.column_stack([run.column(f"{name}_{j}_{unit}")[:end] for j in range(1, AXLES + 1)])

        courses.append(Course(run.folder.name, group, run.column("time_s")[:end],
                              run.column("vehicle_speed_m_s")[:end], each("wheel_speed", "rad_s"),
                              each("wheel_load", "N"), each("brake_torque", "Nm")))
    return write(out, courses, runs[0].scenario, PERFECT, "runs of the bench",
                 ", ".join(str(run.folder) for run in runs))


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
