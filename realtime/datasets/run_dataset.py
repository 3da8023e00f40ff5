"""Turns runs into a dataset in the format of measured data, which tune, validate and explain read.

Runs of the bench hold what the physics computed. Noise and scale errors of sensors can be added to
them: their sizes are declared in the dataset, and they are drawn from a seed. A dataset of runs
that no bench has recorded is marked as synthetic.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, replaced, write_text, writing
from rollerrig.configs.vehicle import EQUIPMENT_KEYS, equipment_of
from rollerrig.realtime.datasets import run_sensors
from rollerrig.realtime.record import records
from rollerrig.rig import params
from rollerrig.rig.identify.data.runs import Run

# keys of [contact] that a dataset has
_CONTACT = ("young_Pa", "shear_Pa", "poisson", "lateral_radius_m", "roller_radius_m")
# Below this speed, wheels slide by more than half the speed. Adhesion falls so steeply there that a
# replay gives no information.
SLOWEST_M_S = 6.0
# samples from which the initial speed of a run is averaged
_INITIAL_SAMPLES = 20


class _Quantity(NamedTuple):
    """A quantity of a data file.

    `digits` are those behind the point where sensors are as rough as `run_sensors.TRAIN`: the
    rounding error is a tenth of the noise or less.
    """

    name: str
    unit: str
    field: str  # of Run
    digits: int


_QUANTITIES = (
    _Quantity("time", "s", "time_s", 2),
    _Quantity("vehicle_speed", "m_s", "speed_m_s", 2),
    _Quantity("position", "m", "position_m", 3),
    _Quantity("wheel_speed", "rad_s", "wheel_speed_rad_s", 2),
    _Quantity("wheel_load", "N", "load_N", 0),
    _Quantity("brake_torque", "Nm", "torque_Nm", 0),
    _Quantity("surface_speed", "m_s", "surface_m_s", 3),
)
# tables that runs of one dataset must share, with the keys that may differ
_SHARED_TABLES: Mapping[str, tuple[str, ...]] = {
    "vehicle": ("mass_kg",),
    "adhesion": ("mu_cd",),
    "contact": (),
    "brake": (),
    "rig": ("speed",),
}


def write(
    out: Path,
    runs: Sequence[Run],
    resolved: Mapping[str, Any],
    accuracy: Mapping[str, float],
    rounded: bool = False,
    **head: str,
) -> Path:
    """Write dataset.toml and a CSV file for each run; return the folder.

    `resolved` is the scenario whose model the runs share. `head` may have title, source and note.
    Raises ConfigError if the folder cannot be written.
    """
    content = _content(runs, resolved, accuracy, head)
    # in the file, [vehicle] and the name of the vehicle have one key
    text = tomli_w.dumps(content).replace("vehicle_set = ", "vehicle = ", 1)
    with writing(out, "give another folder"):
        make_folder(out, "runs")
        write_text(out / "dataset.toml", f"# {head['title']}\n{text}")
        for run in runs:
            _write_csv(out / "runs" / f"{run.name}.csv", run, rounded)
    return out


def _content(
    runs: Sequence[Run],
    resolved: Mapping[str, Any],
    accuracy: Mapping[str, float],
    head: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of dataset.toml; the order of the keys is that of the file."""
    contact = {key: resolved["contact"][key] for key in _CONTACT}
    if resolved["rig"]["mode"] != "contaminated_rollers":
        contact["roller_radius_m"] = float("inf")

    content: dict[str, Any] = {**head, "kind": "braking_runs"}
    # The values of the vehicle are all written below. The name of a user's file is left out, since
    # the file may not be found later.
    if resolved["vehicle_set"] in store.names("vehicles"):
        content["vehicle_set"] = resolved["vehicle_set"]
    content["sample_time_s"] = round(float(np.median(np.diff(runs[0].time_s))), 6)
    # the base model of data is the planar vehicle, also for runs of a multibody coach
    vehicle = resolved["vehicle"]
    content["vehicle"] = {key: value for key, value in vehicle.items() if key != "model"}
    content["brake"] = resolved["brake"]
    content["adhesion"] = resolved["adhesion"]
    content["contact"] = contact
    content["axles"] = {"positions_m": params.axle_positions(vehicle).tolist()}
    content["accuracy"] = {key: value for key, value in accuracy.items() if value > 0.0}
    # the runs were made with the laws of the causes themselves
    content["accuracy"]["form_fraction"] = 0.0
    content["run"] = [_run_table(run) for run in runs]
    return content


def _run_table(run: Run) -> dict[str, Any]:
    """Return the table [[run]] of a run."""
    content: dict[str, Any] = {"file": f"runs/{run.name}.csv", "group": run.group}
    if np.isfinite(run.mass_kg):
        content["mass_kg"] = run.mass_kg
    else:
        content["held"] = True
    initial_speed_m_s = float(run.speed_m_s[:_INITIAL_SAMPLES].mean())
    content["initial_speed_m_s"] = round(initial_speed_m_s, 2)
    return content


def _write_csv(path: Path, run: Run, rounded: bool) -> None:
    names: list[str] = []
    formats: list[str] = []
    columns: list[np.ndarray] = []
    for quantity in _QUANTITIES:
        values = getattr(run, quantity.field)
        if values is None:
            continue
        stems = [quantity.name]
        if values.ndim > 1:
            stems = [f"{quantity.name}_{axle}" for axle in range(1, run.axles + 1)]
        for stem in stems:
            names.append(f"{stem}_{quantity.unit}")
            formats.append(f"%.{quantity.digits}f" if rounded else "%.17g")
        columns.append(values)
    with replaced(path) as new:
        np.savetxt(
            new,
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
    slowest_m_s: float = 1.0,
    longest_s: float = np.inf,
) -> Path:
    """Write a dataset of recorded runs, as their sensors measure them; return its folder.

    The runs in `validate` get that group. The config of the first run is the base model; its
    mechanisms and faults stay hidden. `noise` is added to the channels and declared. A run ends
    when it is slower than `slowest_m_s`, or after `longest_s`.

    Raises ConfigError for folders without a run, runs that are not valid, copies of a run, and runs
    of different vehicles, rigs or adhesion.
    """
    all_folders = (*folders, *validate)
    recorded = [records.load(folder) for folder in all_folders]
    not_valid = records.not_valid(all_folders)
    if not_valid:
        raise ConfigError(f"{not_valid[0]}; leave it out, or brake again")
    for recording in recorded:
        _check_same_base(recording, recorded[0])
    runs = [run_sensors.of_run(recording, slowest_m_s, longest_s) for recording in recorded]
    _check_no_copies(runs, recorded)

    names = [run.name for run in runs]
    rng = np.random.default_rng(len(runs))
    noisy = []
    for number, run in enumerate(runs, start=1):
        is_unique = names.count(run.name) == 1
        noisy.append(
            run_sensors.noisy(run, noise, rng)._replace(
                name=run.name if is_unique else f"{run.name}_{number}",
                group="tune" if number <= len(folders) else "validate",
            )
        )
    return write(
        out,
        noisy,
        recorded[0].scenario,
        noise,
        title="runs recorded by the bench",
        source=", ".join(str(recording.folder) for recording in recorded),
        note=_note(recorded),
    )


def _cleaning_of_adhesion(scenario: Mapping[str, Any]) -> str:
    """Return the note on an adhesion of the package that includes cleaning of the rail, or "".

    What else a scenario hides in [mechanisms] is not mentioned.
    """
    name = scenario["adhesion_set"]
    if name not in store.names("adhesion"):
        return ""
    content, _ = store.load("adhesion", name)
    gain = content.get("mechanisms", {}).get("rail_cleaning_gain", 0.0)
    if not gain:
        return ""
    return (
        f"the adhesion '{name}' of these runs includes cleaning of the rail (gain {gain:g}), which "
        "the base model does not include: it is reported as the cause rail_cleaning, and a further "
        "cause beside it, such as load_transfer, may be due to its form"
    )


def _check_no_copies(runs: Sequence[Run], recorded: Sequence[records.Run]) -> None:
    """Raise ConfigError if two runs have the same wheel speeds."""
    pairs = itertools.combinations(zip(runs, recorded, strict=True), 2)
    for (first, first_recording), (second, second_recording) in pairs:
        if np.array_equal(first.wheel_speed_rad_s, second.wheel_speed_rad_s):
            raise ConfigError(
                f"{second_recording.folder} and {first_recording.folder} hold the same samples; "
                "a copy adds no information and cannot validate: brake from another speed or with "
                "another demand (free and lockstep runs repeat bit for bit)"
            )


def _check_same_base(run: records.Run, first: records.Run) -> None:
    """Raise ConfigError if the base model of a run differs from that of the first run."""
    for name in run.table.column_names:
        if name.startswith("sand_rate") and (run.column(name) > 0.0).any():
            raise ConfigError(
                f"{run.folder}: sand was used, which the base model does not include; "
                "brake without sanders"
            )
    equipment = equipment_of(run.scenario)
    if equipment:
        names = " and a ".join(name.replace("_", " ") for name in sorted(equipment))
        isolated = " and ".join(f"{name}.{EQUIPMENT_KEYS[name]}=[]" for name in sorted(equipment))
        raise ConfigError(
            f"{run.folder}: the vehicle has a {names}, which the base model does not include; "
            f"brake with {isolated}"
        )
    for table, may_differ in _SHARED_TABLES.items():
        values = _without(run.scenario.get(table, {}), may_differ)
        first_values = _without(first.scenario.get(table, {}), may_differ)
        if values == first_values:
            continue
        for key in {**values, **first_values}:
            value = values.get(key)
            first_value = first_values.get(key)
            if value != first_value:
                raise ConfigError(
                    f"{run.folder}: [{table}] {key} = {value!r} differs from {first_value!r} in "
                    f"{first.folder}; runs in one dataset need the same vehicle, rig and "
                    "adhesion law (vehicle.mass_kg and adhesion.mu_cd may differ): give them in "
                    "separate calls"
                )


def _without(table: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in keys}


def _note(recorded: Sequence[records.Run]) -> str:
    """Return the properties of the runs that the base model lacks; empty if there are none."""
    notes = []
    if any(run.scenario.get("friction") for run in recorded):
        notes.append(
            "the scenario changes friction by place or time, which the base model does not "
            "include: the explanation searches for it as for a cause"
        )
    model = recorded[0].scenario["contact"].get("model", "degraded")
    if model != "degraded":
        notes.append(
            f"the runs had contact.model = {model!r}; the base model is the degraded adhesion law"
        )
    cleaning = _cleaning_of_adhesion(recorded[0].scenario)
    if cleaning:
        notes.append(cleaning)
    return "; ".join(notes)
