"""The parameters of the physics: one table of rows, and the constant structures built from it.

A value comes from a TOML file, from a program that identified it or from its default; all pass the
same check. The structures are nested named tuples that kernels read and nobody can write.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, integer, number, read
from rollerrig.configs.vehicle import AXLES, GRAVITY_M_S2, brake_torque_Nm_Pa
from rollerrig.rig.contact.adhesion import Law, Patch, patch_for
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.mechanisms import plant as effects
from rollerrig.rig.mechanisms import table
from rollerrig.rig.mechanisms.mechanism import ALL_AXLES_ALIKE, NOT
from rollerrig.rig.multibody import coach as coaches
from rollerrig.rig.multibody import port
from rollerrig.rig.multibody import table as coach_table
from rollerrig.rig.multibody.port import Packed

_T1, _T2, _T4 = "paper Table 1", "paper Table 2", "paper Table 4"
_A = "assumption"

# how a plant's wheels run; a virtual track is a plant on the track and one on dry rollers beside it
TRACK, ROLLERS = 0, 1
VIRTUAL_TRACK = "virtual_track"
MODES = {"track": TRACK, "contaminated_rollers": ROLLERS, VIRTUAL_TRACK: TRACK}

ROWS: dict[str, tuple[Row, ...]] = {
    "contact": (
        number("young_Pa", 2.1e11, 1e9, 1e12, _T4),
        number("shear_Pa", 8.0e10, 1e9, 1e12, _T4),
        number("poisson", 0.3, 0.0, 0.5, _T4),
        number("lateral_radius_m", 0.3, 0.01, 10.0, "rail head R300, wheel taken as a cone"),
        number("roller_radius_m", 1.0, 0.1, math.inf, _A + "; inf is a rail"),
        choice("model", "degraded", tuple(MODELS), "paper Table 8; all but degraded know no recovery"),
        integer("fastsim_cells", 10, 2, 200, "strips of FASTSIM, and cells in each"),
    ),
    "adhesion": (
        number("mu_cd", 0.06, 1e-4, 1.0, _T4),
        number("mu_cr", 0.28, 1e-4, 1.0, _T4),
        number("A_d", 0.40, 0.01, 1.0, _T4),
        number("A_r", 0.40, 0.01, 1.0, _T4),
        number("gamma_d_s_m", 0.20, 0.0, 100.0, _T4),
        number("gamma_r_s_m", 0.60, 0.0, 100.0, _T4),
        number("k_ad", 0.3, 0.001, 10.0, _T4),
        number("k_sd", 0.1, 0.001, 10.0, _T4),
        number("k_ar", 1.0, 0.001, 10.0, _T4),
        number("k_sr", 0.4, 0.001, 10.0, _T4),
        number("tau_m_J", 1.9e-4, 0.0, 1.0, "paper section 4, tuned"),
        number("cleaning_creepage", math.inf, 1e-3, math.inf,
               "creepage beyond which sliding cleans no better; inf is the paper's law"),
    ),
    "vehicle": (
        choice("model", "planar", ("planar", "multibody"),
               "planar: load transfer alone; multibody: 42 coordinates, table [multibody]"),
        number("mass_kg", 43000.0, 1000.0, 200000.0, _T1),
        number("wheel_radius_m", 0.445, 0.1, 1.0, _T1),
        number("wheelset_inertia_kgm2", 160.0, 1.0, 2000.0, _T2),
        number("wheelset_mass_kg", 1820.0, 100.0, 5000.0, _T2 + ": wheelset, axleboxes, links"),
        number("bogie_mass_kg", 3000.0, 100.0, 20000.0, _T2),
        number("bogie_wheelbase_m", 2.56, 0.5, 5.0, _T1),
        number("bogie_distance_m", 19.0, 2.0, 40.0, _T1),
        number("body_height_m", 1.8, 0.2, 4.0, _A + "; centre of mass above the rail"),
        number("bogie_height_m", 0.6, 0.1, 2.0, _A + "; centre of mass above the rail"),
        number("pivot_height_m", 0.9, 0.1, 3.0, _A + "; where the bogie pulls the body"),
        number("pitch_time_constant_s", 0.1, 0.001, 10.0, _A + "; load transfer builds up"),
        number("resistance_A_N", 600.0, 0.0, 1e5, _A + "; 14 N/t"),
        number("resistance_B_N_s_m", 0.0, 0.0, 1e4, _A),
        number("resistance_C_N_s2_m2", 0.9375, 0.0, 100.0, _A + "; drag area 1.56 m2"),
    ),
    "brake": (
        number("cylinder_area_m2", 0.0324, 1e-4, 1.0, _A + "; 203 mm, all cylinders of a wheelset act alike"),
        number("cylinder_volume_L", 4.0, 0.01, 100.0, _A + "; cylinders and pipes of a wheelset"),
        number("spring_pressure_Pa", 0.3e5, 0.0, 2e5, _A + "; pressure that moves the pads"),
        number("lever_ratio", 2.1, 0.1, 20.0, _A),
        number("efficiency", 0.95, 0.1, 1.0, "EN 14531 example"),
        number("pad_friction", 0.35, 0.01, 1.0, "EN 14531 example"),
        number("disc_radius_m", 0.247, 0.05, 0.5, _A + "; mean friction radius"),
        integer("discs", 2, 1, 8, _A),
        number("fill_time_constant_s", 1.3, 0.01, 20.0, "3 to 5 s to 95 %; memory"),
        number("release_time_constant_s", 6.0, 0.01, 60.0, "15 to 20 s to 95 %; memory"),
        number("disc_heat_capacity_J_K", 1.15e5, 1e3, 1e7, _A + "; both discs: 2 x 120 kg, 480 J/(kg K)"),
        number("disc_cooling_time_s", 600.0, 1.0, 1e5, _A + "; ventilated disc, mean over a stop"),
    ),
    "valve": (
        number("dead_time_s", 0.04, 0.0, 0.25, "20 to 60 ms; memory"),
        number("vent_time_constant_s", 0.2, 0.005, 5.0, "0.1 to 0.3 s; memory"),
        number("fill_time_constant_s", 0.3, 0.005, 5.0, "0.15 to 0.5 s; memory"),
    ),
    "drive": (
        number("roller_inertia_kgm2", 1200.0, 1.0, 1e5, _A + "; both rollers, shaft, gear"),
        number("rated_torque_Nm", 15000.0, 1.0, 1e6, _A),
        number("max_torque_Nm", 30000.0, 1.0, 1e6, _A),
        number("max_power_W", 1.2e6, 1.0, 1e8, _A),
        number("max_speed_rad_s", 80.0, 1.0, 1e4, _A),
        number("torque_time_constant_s", 0.005, 1e-4, 1.0, _A),
        number("speed_loop_rad_s", 40.0, 0.1, 1000.0, _A + "; bandwidth of the roller speed loop"),
        number("observer_rad_s", 100.0, 0.1, 1000.0, _A + "; bandwidth of the contact torque observer"),
        number("thermal_time_constant_s", 1200.0, 1.0, 1e5, _A + "; winding and iron as one body"),
        number("rated_temperature_rise_K", 105.0, 1.0, 300.0, "IEC 60034-1, class F by resistance"),
    ),
    "sensor": (
        choice("model", "ideal", ("ideal", "pole_wheel"), "pole_wheel: speed from pulses"),
        integer("teeth", 100, 1, 1000, "80 to 120; memory"),
        number("window_s", 0.01, 1e-3, 1.0, _A + "; the speed is measured anew this often"),
        number("dropout_rad_s", 1.0, 0.0, 100.0, _A + "; slower wheels give no pulses"),
        number("timer_Hz", 1e6, 1e3, 1e9, _A + "; resolution of pulse times"),
    ),
    "dry_roller": (
        number("mu_c", 0.28, 1e-4, 1.0, _T4 + ", recovered"),
        number("A", 0.40, 0.01, 1.0, _T4 + ", recovered"),
        number("gamma_s_m", 0.60, 0.0, 100.0, _T4 + ", recovered"),
        number("k_a", 1.0, 0.001, 10.0, _T4 + ", recovered"),
        number("k_s", 0.4, 0.001, 10.0, _T4 + ", recovered"),
    ),
    "mechanisms": table.rows(),
    "rig": (
        choice("mode", "contaminated_rollers", tuple(MODES), "how the rig is run"),
        choice("drives", "rig", ("rig", "bus"), "who has the drives: the rig control or a bus master"),
        number("air_temperature_K", 293.15, 223.0, 323.0, _A + "; 20 degrees Celsius in the hall"),
        number("lock_above_m_s", 3.0, 0.5, 20.0, _A + "; slower than this a lock is not counted"),
    ),
    "multibody": coach_table.ROWS,
}


class Vehicle(NamedTuple):
    """The vehicle: units in `ROWS`; transfers are N of wheelset load for each m/s2 of braking."""

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
    """Roller and its motor: units in `ROWS`."""

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
    cleaning_creepage: float
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
    adhesion = effects.extended(sections["adhesion"], extra)
    cleaning_creepage = adhesion.pop("cleaning_creepage")
    law = Law(**adhesion)
    return Params(
        mode, tick_s, tick_s / substeps, substeps, sections["sensor"]["teeth"],
        sections["rig"]["lock_above_m_s"], patch,
        law, cleaning_creepage, _transfers(_vehicle(vehicle), extra), _brake(brake, valve, tick_s, substeps),
        _drive(sections["drive"], contact["roller_radius_m"], tick_s / substeps),
        axle_positions(vehicle), friction, demand, effects.build(extra),
        effects.wheels(sections["vehicle"], extra), _heat(sections, tick_s),
        _coach({**sections, "vehicle": vehicle}, roller_radius_m),
    )


def check_coach(extra: Mapping[str, float]) -> None:
    """Raise ConfigError where an extended model has a mechanism that the coach in 3D does not know."""
    for known in table.IN_PLANT:
        if known.in_coach == NOT or (known.in_coach == ALL_AXLES_ALIKE and extra[f"{known.name}_axle"] != 0.0):
            for key in known.coefficients:
                if extra[key] != 0.0:
                    raise ConfigError(
                        f"[mechanisms] {key} = {extra[key]:g}: the coach in 3D does not know that {known.text}; "
                        "allowed is 0, or the planar vehicle, vehicle.model = \"planar\"")


def _transfers(vehicle: Vehicle, extra: Mapping[str, float]) -> Vehicle:
    return vehicle._replace(
        body_transfer_kg=vehicle.body_transfer_kg
        + 2.0 * vehicle.static_load_N * extra["load_transfer_body_s2_m"],
        bogie_transfer_kg=vehicle.bogie_transfer_kg
        + vehicle.static_load_N * extra["load_transfer_bogie_s2_m"])


def _coach(sections: Mapping[str, Mapping[str, Any]], roller_radius_m: float) -> Packed | None:
    if sections["vehicle"]["model"] == "planar":
        return None
    contact = sections["contact"]
    port.prepare()
    return port.packed(coaches.build(
        sections, roller_radius_m, MODELS[contact["model"]], contact["fastsim_cells"]))


def build_rollers(
    sections: Mapping[str, Mapping[str, Any]], demand: Demand, tick_s: float, substeps: int
) -> Params:
    """The plant that runs beside a virtual track: the same wheelsets on dry, clean rollers."""
    dry = sections["dry_roller"]
    adhesion = {**sections["adhesion"], "tau_m_J": 0.0, "cleaning_creepage": math.inf}
    for name, value in dry.items():
        stem, _, unit = name.partition("_")
        tail = f"_{unit}" if stem == "gamma" else ""
        keys = {"mu_c": ("mu_cd", "mu_cr"), "k_a": ("k_ad", "k_ar"), "k_s": ("k_sd", "k_sr")}
        adhesion |= dict.fromkeys(keys.get(name, (f"{stem}_d{tail}", f"{stem}_r{tail}")), value)
    none = Friction(*(np.zeros(0, dtype) for dtype in (np.bool_, float, float, float, np.int64)))
    rollers = {**sections, "adhesion": adhesion,
               "vehicle": {**sections["vehicle"], "model": "planar"},
               "rig": {**sections["rig"], "mode": "contaminated_rollers"}}
    return build(rollers, none, demand, tick_s, substeps)


def axle_positions(vehicle: Mapping[str, float]) -> np.ndarray:
    """Distance in m of each wheelset behind the first."""
    base, pivots = vehicle["bogie_wheelbase_m"], vehicle["bogie_distance_m"]
    return np.array([0.0, base, pivots, pivots + base])


def _vehicle(v: Mapping[str, float]) -> Vehicle:
    body_kg = v["mass_kg"] - 2.0 * v["bogie_mass_kg"] - 4.0 * v["wheelset_mass_kg"]
    if body_kg <= 0.0:
        raise ConfigError(f"[vehicle] mass_kg = {v['mass_kg']:g} is not more than its bogies and "
                          f"wheelsets weigh ({v['mass_kg'] - body_kg:g} kg); raise it")
    # moments about the pivots, then about the rail under each bogie [V2, V3 of vehicle.py]
    body = body_kg * (v["body_height_m"] - v["pivot_height_m"]) / v["bogie_distance_m"]
    bogie = (0.5 * body_kg * v["pivot_height_m"] + v["bogie_mass_kg"] * v["bogie_height_m"]
             + 2.0 * v["wheelset_mass_kg"] * v["wheel_radius_m"]) / v["bogie_wheelbase_m"]
    return Vehicle(
        v["mass_kg"], v["wheel_radius_m"], v["wheelset_inertia_kgm2"], v["resistance_A_N"],
        v["resistance_B_N_s_m"], v["resistance_C_N_s2_m2"], v["pitch_time_constant_s"],
        GRAVITY_M_S2 * v["mass_kg"] / AXLES, body, bogie)


def _share(step_s: float, time_constant_s: float) -> float:
    return -math.expm1(-step_s / time_constant_s)


def _brake(
    b: Mapping[str, float], valve: Mapping[str, float], tick_s: float, substeps: int
) -> Brake:
    lags_s = (b["fill_time_constant_s"], b["release_time_constant_s"],
              valve["fill_time_constant_s"], valve["vent_time_constant_s"])
    fill, release, valve_fill, valve_vent = (_share(tick_s / substeps, lag_s) for lag_s in lags_s)
    return Brake(brake_torque_Nm_Pa(b), b["spring_pressure_Pa"], b["cylinder_volume_L"], fill, release,
                 valve_fill, valve_vent, round(valve["dead_time_s"] / tick_s))


def _heat(sections: Mapping[str, Mapping[str, Any]], tick_s: float) -> Heat:
    brake, drive = sections["brake"], sections["drive"]
    return Heat(sections["rig"]["air_temperature_K"], brake["disc_heat_capacity_J_K"],
                _share(tick_s, brake["disc_cooling_time_s"]), drive["rated_torque_Nm"],
                drive["rated_temperature_rise_K"], _share(tick_s, drive["thermal_time_constant_s"]))


def _drive(d: Mapping[str, float], roller_radius_m: float, step_s: float) -> Drive:
    if math.isinf(roller_radius_m):
        roller_radius_m = 1.0
    return Drive(roller_radius_m, d["roller_inertia_kgm2"], d["max_torque_Nm"], d["max_power_W"],
                 d["max_speed_rad_s"], _share(step_s, d["torque_time_constant_s"]),
                 d["speed_loop_rad_s"], d["observer_rad_s"])
