"""Turns runs into a dataset in the format of measured data, so that tune, validate and explain read them.

Runs of the bench hold what the physics computed; sensors can be laid over them: noise and scale errors of a declared
size from a seed. A dataset of runs that no bench has recorded says that it is synthetic.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.datasets import run_sensors
from rollerrig.realtime.record import records
from rollerrig.realtime.record.files import writing
from rollerrig.rig import params
from rollerrig.rig.identify.data.runs import Run
from rollerrig.wsp_interface.signals import AXLES

_CONTACT = ("young_Pa", "shear_Pa", "poisson", "lateral_radius_m", "roller_radius_m")
# below, wheels slide by more than half the speed, where adhesion falls so steeply that a replay tells nothing
SLOWEST_M_S = 6.0
# quantities of a data file: name, unit, field of Run, digits behind the point where a sensor is as
# rough as `run_sensors.TRAIN` (what is cut off is a tenth of the noise and less)
_QUANTITIES = (
    ("time", "s", "time_s", 2),
    ("vehicle_speed", "m_s", "speed_m_s", 2),
    ("position", "m", "position_m", 3),
    ("wheel_speed", "rad_s", "wheel_speed_rad_s", 2),
    ("wheel_load", "N", "load_N", 0),
    ("brake_torque", "Nm", "torque_Nm", 0),
    ("surface_speed", "m_s", "surface_m_s", 3),
)


def write(
    out: Path,
    runs: Sequence[Run],
    resolved: Mapping[str, Any],
    accuracy: Mapping[str, float],
    rounded: bool = False,
    **head: str,
) -> Path:
    """Write dataset.toml and a CSV for each run; `resolved` is the scenario whose model they share.

    `head` may have title, source, note. Raises ConfigError where the folder cannot be written.
    """
    contact = {key: resolved["contact"][key] for key in _CONTACT}
    if resolved["rig"]["mode"] != "contaminated_rollers":
        contact["roller_radius_m"] = float("inf")
    # every value of the vehicle is written out below: a file of the user's own need not be found again
    named = (
        {"vehicle_set": name}
        if (name := resolved["vehicle_set"]) in store.names("vehicles")
        else {}
    )
    content = head | {
        "kind": "braking_runs",
        **named,
        "sample_time_s": round(float(np.median(np.diff(runs[0].time_s))), 6),
        # the base model of data is the planar vehicle, whatever the runs had
        "vehicle": {key: value for key, value in resolved["vehicle"].items() if key != "model"},
        "brake": resolved["brake"],
        "adhesion": resolved["adhesion"],
        "contact": contact,
        "axles": {"positions_m": params.axle_positions(resolved["vehicle"]).tolist()},
        # the causes' laws are those that the runs were made with
        "accuracy": {key: value for key, value in accuracy.items() if value > 0.0}
        | {"form_fraction": 0.0},
        "run": [
            {
                "file": f"runs/{run.name}.csv",
                "group": run.group,
                **({"mass_kg": run.mass_kg} if np.isfinite(run.mass_kg) else {"held": True}),
                "initial_speed_m_s": round(float(run.speed_m_s[:20].mean()), 2),
            }
            for run in runs
        ],
    }
    text = tomli_w.dumps(content).replace("vehicle_set = ", "vehicle = ", 1)
    with writing(out, "give another folder"):
        (out / "runs").mkdir(parents=True, exist_ok=True)
        (out / "dataset.toml").write_text(f"# {head['title']}\n{text}", encoding="utf-8")
        for run in runs:
            _write_csv(out / "runs" / f"{run.name}.csv", run, rounded)
    return out


def _write_csv(path: Path, run: Run, rounded: bool) -> None:
    names, formats, columns = [], [], []
    for name, unit, field, digits in _QUANTITIES:
        if (values := getattr(run, field)) is not None:
            own = [name] if values.ndim == 1 else [f"{name}_{j}" for j in range(1, AXLES + 1)]
            names += [f"{one}_{unit}" for one in own]
            formats += [f"%.{digits}f" if rounded else "%.17g"] * len(own)
            columns.append(values)
    np.savetxt(
        path,
        np.column_stack(columns),
        delimiter=",",
        fmt=formats,
        header=",".join(names),
        comments="",
    )


def from_folders(
    folders: Sequence[Path],
    out: Path,
    validate: Sequence[Path] = (),
    noise: Mapping[str, float] = run_sensors.PERFECT,
    slowest_m_s: float = 0.01,
    longest_s: float = np.inf,
) -> Path:
    """A dataset of recorded run folders as their sensors tell them, those of `validate` in that group.

    The first run's config is the base model; its mechanisms and faults stay hidden. `noise` is laid over the channels
    and declared; runs end at a speed or after a time. Raises ConfigError for folders that hold no run, runs that
    are not valid, one and the same, or of different vehicles, rigs or adhesion.
    """
    recorded = [records.load(folder) for folder in (*folders, *validate)]
    if not_valid := records.not_valid((*folders, *validate)):
        raise ConfigError(f"{not_valid[0]}; leave it out, or brake again")
    for recording in recorded:
        _same_base(recording, recorded[0])
    runs = [run_sensors.of_run(one, slowest_m_s, longest_s) for one in recorded]
    for (one, its), (other, their) in itertools.combinations(zip(runs, recorded, strict=True), 2):
        if np.array_equal(one.wheel_speed_rad_s, other.wheel_speed_rad_s):
            raise ConfigError(
                f"{their.folder} and {its.folder} hold the same samples; a copy tells nothing new and "
                "cannot validate: brake from another speed or with another demand (free and lockstep "
                "runs repeat bit for bit)"
            )
    names = [run.name for run in runs]
    rng = np.random.default_rng(len(runs))
    runs = [
        run_sensors.noisy(run, noise, rng)._replace(
            name=run.name if names.count(run.name) == 1 else f"{run.name}_{k}",
            group="tune" if k <= len(folders) else "validate",
        )
        for k, run in enumerate(runs, start=1)
    ]
    return write(
        out,
        runs,
        recorded[0].scenario,
        noise,
        title="runs recorded by the bench",
        source=", ".join(str(one.folder) for one in recorded),
        note=_note(recorded),
    )


def _same_base(run: records.Run, first: records.Run) -> None:
    if any(
        (run.column(name) > 0.0).any()
        for name in run.table.column_names
        if name.startswith("sand_rate")
    ):
        raise ConfigError(
            f"{run.folder}: sand was strewn, which the base model does not know; brake without sanders"
        )
    free = {
        "vehicle": ("mass_kg",),
        "adhesion": ("mu_cd",),
        "contact": (),
        "brake": (),
        "rig": ("speed",),
    }
    for table, left_out in free.items():
        mine, its = (
            {k: v for k, v in one.scenario.get(table, {}).items() if k not in left_out}
            for one in (run, first)
        )
        if mine != its:
            key = next(k for k in {**mine, **its} if mine.get(k) != its.get(k))
            raise ConfigError(
                f"{run.folder}: [{table}] {key} = {mine.get(key)!r} differs from {its.get(key)!r} in "
                f"{first.folder}; runs that are judged together need one vehicle, rig and adhesion law "
                "(vehicle.mass_kg and adhesion.mu_cd may differ): give them in separate calls"
            )


def _note(recorded: Sequence[records.Run]) -> str:
    """What the base model does not know of the runs."""
    notes = (
        [
            "the scenario changes friction by place or time, which the base model does not know: it is looked for "
            "like a cause"
        ]
        if any(run.scenario.get("friction") for run in recorded)
        else []
    )
    model = recorded[0].scenario["contact"].get("model", "degraded")
    if model != "degraded":
        notes.append(
            f"the runs had contact.model = {model!r}; the base model is the degraded adhesion law"
        )
    return "; ".join(notes)
