"""The parameters of the physics: the rows of `parameters.toml`, and the constant structures built from them.

A value comes from a TOML file, from a program that identified it or from its default; all pass the
same check. The structures are nested named tuples that kernels read and nobody can write.
"""

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, integer, number, read
from rollerrig.configs.vehicle import AXLES, GRAVITY_M_S2, brake_torque_Nm_Pa
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.contact.patch import Patch, patch_for
from rollerrig.rig.mechanisms import applied as effects
from rollerrig.rig.mechanisms import table
from rollerrig.rig.mechanisms.mechanism import ALL_AXLES_ALIKE, NOT
from rollerrig.rig.multibody import coach as coaches
from rollerrig.rig.multibody import compiled_coach
from rollerrig.rig.multibody.compiled_coach import Packed

# how a plant's wheels run; a virtual track is a plant on the track and one on dry rollers beside it
TRACK, ROLLERS = 0, 1
VIRTUAL_TRACK = "virtual_track"
MODES = {"track": TRACK, "contaminated_rollers": ROLLERS, VIRTUAL_TRACK: TRACK}


def _row(name: str, given: list[Any]) -> Row:
    default, *allowed, source = given
    if isinstance(default, str):
        return choice(name, default, tuple(allowed[0]), source)
    low, high = allowed
    return (integer if isinstance(default, int) else number)(name, default, low, high, source)


ROWS: dict[str, tuple[Row, ...]] = {
    section: tuple(_row(name, given) for name, given in rows.items()) for section, rows in
    tomllib.loads(Path(__file__).with_name("parameters.toml").read_text(encoding="utf-8")).items()}
ROWS["mechanisms"] = table.rows()


class Vehicle(NamedTuple):
    """The vehicle: units in their names; transfers are N of wheelset load for each m/s2 of braking."""

    mass_kg: float
    wheel_radius_m: float
    wheelset_inertia_kgm2: float
    resistance_A_N: float
    resistance_B_N_s_m: float
    resistance_C_N_s2_m2: float
    pitch_time_constant_s: float
    static_load_N: float
    body_transfer_kg: float
    bogie_transfer_kg: float


class Brake(NamedTuple):
    """Pneumatics and disc brake of a wheelset.

    A share is what a first-order lag closes of its gap in one step: 1 - exp(-step / T).
    """

    torque_Nm_Pa: float
    spring_pressure_Pa: float
    volume_L: float
    demand_fill_share: float
    demand_release_share: float
    valve_fill_share: float
    valve_vent_share: float
    dead_time_ticks: int


class Drive(NamedTuple):
    """Roller and its motor: units in their names."""

    roller_radius_m: float
    roller_inertia_kgm2: float
    max_torque_Nm: float
    max_power_W: float
    max_speed_rad_s: float
    torque_share: float
    speed_loop_rad_s: float
    observer_rad_s: float


class Heat(NamedTuple):
    """Discs of a wheelset and a motor as bodies that warm up; shares are those of a tick."""

    air_K: float
    disc_J_K: float
    disc_share: float
    rated_torque_Nm: float
    motor_rise_K: float
    motor_share: float


class Friction(NamedTuple):
    """Changes of the contaminant, in the order in which they apply; arrays of one length.

    `by_place` 1: from `start` metres along the track (each axle where it stands), else from
    `start` seconds. `axles` is a bit mask, bit 0 the leading axle.
    """

    by_place: np.ndarray
    start: np.ndarray
    mu_cd: np.ndarray
    mu_cr: np.ndarray
    axles: np.ndarray


class Demand(NamedTuple):
    """Brake demand: from each time in s on, the pressure in Pa that the cylinders shall reach."""

    start_s: np.ndarray
    pressure_Pa: np.ndarray


class Params(NamedTuple):
    """All that the plant needs and never changes."""

    mode: int
    tick_s: float
    step_s: float
    substeps: int
    teeth: int
    lock_above_m_s: float
    patch: Patch
    law: Law
    vehicle: Vehicle
    brake: Brake
    drive: Drive
    axle_position_m: np.ndarray
    friction: Friction
    demand: Demand
    effects: effects.Effects
    wheels: effects.Wheels
    heat: Heat
    coach: Packed | None = None


def check(sections: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, dict[str, Any]]:
    """Every physics section with all its values, checked.

    Raises ConfigError naming file, section, key, value and what is allowed.
    """
    checked = {
        name: read(rows, sections.get(name, {}), f"{where} [{name}]") for name, rows in ROWS.items()
    }
    check_recovery(checked["adhesion"], f"{where} [adhesion]")
    return checked


def check_recovery(law: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError where an adhesion law's recovered friction is below its degraded one."""
    recovered, degraded = law["mu_cr"] / law["A_r"], law["mu_cd"] / law["A_d"]
    if recovered < degraded:
        raise ConfigError(
            f"{where}: recovered friction mu_cr/A_r = {recovered:.3g} is below the degraded "
            f"mu_cd/A_d = {degraded:.3g}; recovery needs mu_cr/A_r at or above mu_cd/A_d")


def build(
    sections: Mapping[str, Mapping[str, Any]],
    friction: Friction,
    demand: Demand,
    tick_s: float,
    substeps: int,
) -> Params:
    """The constant structures from checked sections, a programme, and the rates of the loop."""
    contact, brake, valve = (sections[k] for k in ("contact", "brake", "valve"))
    extra = sections["mechanisms"]
    if sections["vehicle"]["model"] != "planar":
        check_coach(extra)
    vehicle = effects.extended(sections["vehicle"], extra)
    mode = MODES[sections["rig"]["mode"]]
    roller_radius_m = math.inf if mode == TRACK else contact["roller_radius_m"]
    patch = patch_for(vehicle["wheel_radius_m"], roller_radius_m, contact["lateral_radius_m"],
                      contact["young_Pa"], contact["shear_Pa"], contact["poisson"],
                      MODELS[contact["model"]], contact["fastsim_cells"])
    patch = patch._replace(**effects.extended({"eps1": patch.eps1}, extra))
    law, step_s = Law(**effects.extended(sections["adhesion"], extra)), tick_s / substeps
    return Params(
        mode=mode, tick_s=tick_s, step_s=step_s, substeps=substeps, teeth=sections["sensor"]["teeth"],
        lock_above_m_s=sections["rig"]["lock_above_m_s"], patch=patch, law=law,
        vehicle=_vehicle(vehicle, extra), brake=_brake(brake, valve, tick_s, substeps),
        drive=_drive(sections["drive"], contact["roller_radius_m"], step_s),
        axle_position_m=axle_positions(vehicle), friction=friction, demand=demand,
        effects=effects.build(extra), wheels=effects.wheels(sections["vehicle"], extra),
        heat=_heat(sections, tick_s),
        coach=_coach({**sections, "vehicle": vehicle}, roller_radius_m, law, step_s))


def check_coach(extra: Mapping[str, float]) -> None:
    """Raise ConfigError where an extended model has a mechanism that the coach in 3D does not know."""
    for known in table.IN_PLANT:
        if known.in_coach == NOT or (known.in_coach == ALL_AXLES_ALIKE and extra[f"{known.name}_axle"] != 0.0):
            for key in known.coefficients:
                if extra[key] != 0.0:
                    raise ConfigError(
                        f"[mechanisms] {key} = {extra[key]:g}: the coach in 3D does not know that {known.text}; "
                        "allowed is 0, or the planar vehicle, vehicle.model = \"planar\"")


def _coach(sections: Mapping[str, Mapping[str, Any]], roller_radius_m: float, law: Law, step_s: float,
           ) -> Packed | None:
    if sections["vehicle"]["model"] == "planar":
        return None
    contact = sections["contact"]
    compiled_coach.prepare()
    coach = coaches.build(sections, roller_radius_m, MODELS[contact["model"]], contact["fastsim_cells"])
    return compiled_coach.packed(coach, law, step_s, sections["drive"]["roller_inertia_kgm2"])


def build_rollers(
    sections: Mapping[str, Mapping[str, Any]], demand: Demand, tick_s: float, substeps: int
) -> Params:
    """The plant that runs beside a virtual track: the same wheelsets on dry, clean rollers."""
    dry = sections["dry_roller"]
    keys = {"mu_c": "mu_c{}", "A": "A_{}", "gamma_s_m": "gamma_{}_s_m", "k_a": "k_a{}", "k_s": "k_s{}"}
    adhesion = {key.format(which): dry[name] for name, key in keys.items() for which in "dr"}
    adhesion |= {"tau_m_J": 0.0, "cleaning_creepage": math.inf}
    none = Friction(*(np.zeros(0, dtype) for dtype in (np.bool_, float, float, float, np.int64)))
    rollers = {**sections, "adhesion": adhesion,
               "vehicle": {**sections["vehicle"], "model": "planar"},
               "rig": {**sections["rig"], "mode": "contaminated_rollers"}}
    return build(rollers, none, demand, tick_s, substeps)


def axle_positions(vehicle: Mapping[str, float]) -> np.ndarray:
    """Distance in m of each wheelset behind the first."""
    base, pivots = vehicle["bogie_wheelbase_m"], vehicle["bogie_distance_m"]
    return np.array([0.0, base, pivots, pivots + base])


def _vehicle(v: Mapping[str, float], extra: Mapping[str, float]) -> Vehicle:
    body_kg = v["mass_kg"] - 2.0 * v["bogie_mass_kg"] - 4.0 * v["wheelset_mass_kg"]
    if body_kg <= 0.0:
        raise ConfigError(f"[vehicle] mass_kg = {v['mass_kg']:g} is not more than its bogies and "
                          f"wheelsets weigh ({v['mass_kg'] - body_kg:g} kg); raise it")
    # moments about the pivots, then about the rail under each bogie [V2, V3 of vehicle.py]
    body = body_kg * (v["body_height_m"] - v["pivot_height_m"]) / v["bogie_distance_m"]
    bogie = (0.5 * body_kg * v["pivot_height_m"] + v["bogie_mass_kg"] * v["bogie_height_m"]
             + 2.0 * v["wheelset_mass_kg"] * v["wheel_radius_m"]) / v["bogie_wheelbase_m"]
    static_N = GRAVITY_M_S2 * v["mass_kg"] / AXLES
    return Vehicle(
        **{name: v[name] for name in Vehicle._fields if name in v}, static_load_N=static_N,
        body_transfer_kg=body + 2.0 * static_N * extra["load_transfer_body_s2_m"],
        bogie_transfer_kg=bogie + static_N * extra["load_transfer_bogie_s2_m"])


def _share(step_s: float, time_constant_s: float) -> float:
    return -math.expm1(-step_s / time_constant_s)


def _brake(
    b: Mapping[str, float], valve: Mapping[str, float], tick_s: float, substeps: int
) -> Brake:
    lags_s = (b["fill_time_constant_s"], b["release_time_constant_s"],
              valve["fill_time_constant_s"], valve["vent_time_constant_s"])
    fill, release, valve_fill, valve_vent = (_share(tick_s / substeps, lag_s) for lag_s in lags_s)
    return Brake(
        torque_Nm_Pa=brake_torque_Nm_Pa(b), spring_pressure_Pa=b["spring_pressure_Pa"],
        volume_L=b["cylinder_volume_L"], demand_fill_share=fill, demand_release_share=release,
        valve_fill_share=valve_fill, valve_vent_share=valve_vent,
        dead_time_ticks=round(valve["dead_time_s"] / tick_s))


def _heat(sections: Mapping[str, Mapping[str, Any]], tick_s: float) -> Heat:
    brake, drive = sections["brake"], sections["drive"]
    return Heat(sections["rig"]["air_temperature_K"], brake["disc_heat_capacity_J_K"],
                _share(tick_s, brake["disc_cooling_time_s"]), drive["rated_torque_Nm"],
                drive["rated_temperature_rise_K"], _share(tick_s, drive["thermal_time_constant_s"]))


def _drive(d: Mapping[str, float], roller_radius_m: float, step_s: float) -> Drive:
    if math.isinf(roller_radius_m):
        roller_radius_m = 1.0
    return Drive(**{name: d[name] for name in Drive._fields if name in d}, roller_radius_m=roller_radius_m,
                 torque_share=_share(step_s, d["torque_time_constant_s"]))
