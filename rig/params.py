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
from rollerrig.configs.vehicle import AXLES, GRAVITY_M_S2, brake_torque_Nm_Pa, weighed_share
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.contact.patch import Patch, patch_for
from rollerrig.rig.mechanisms import applied as effects
from rollerrig.rig.mechanisms import table
from rollerrig.rig.mechanisms.mechanism import AXLES_ALIKE, NOT
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
    section: tuple(_row(name, given) for name, given in rows.items())
    for section, rows in tomllib.loads(
        Path(__file__).with_name("parameters.toml").read_text(encoding="utf-8")
    ).items()
}
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


class Air(NamedTuple):
    """The coach's air: conductances in NL/(s Pa), `reservoir_L` 0 where it never runs out."""

    reservoir_L: float
    begin_Pa: float
    supply_Pa: float
    supply: float
    fill: float
    vent: float
    critical_ratio: float
    step_s: float


class Brake(NamedTuple):
    """Pneumatics and disc brake of a wheelset; a share is what a lag closes in one step: 1 - exp(-step / T)."""

    torque_Nm_Pa: float
    spring_pressure_Pa: float
    volume_L: float
    demand_fill_share: float
    demand_release_share: float
    valve_fill_share: float
    valve_vent_share: float
    dead_time_ticks: int
    weighed_share: float
    air: Air


class Pads(NamedTuple):
    """Section [pads]; `vary` False: friction is constant and the clamp follows the pressure."""

    vary: bool
    speed_loss: float
    speed_scale_m_s: float
    pressure_loss: float
    pressure_scale_Pa: float
    fade_loss: float
    fade_from_K: float
    fade_scale_K: float
    clamp_hysteresis: float


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


class Flats(NamedTuple):
    """Section [flats]; `wear_m3_J` 0: wheels stay round."""

    wear_m3_J: float
    width_m: float
    load_1_m: float


class Sanders(NamedTuple):
    """Section [sanders]; `axles` is a bit mask, bit 0 the leading axle, 0 where none has a sander."""

    axles: int
    rate_kg_s: float
    dose_kg_m: float
    from_s: float
    until_s: float
    hose_delay_s: float
    ahead_m: float
    box_kg: float
    lost_share: float
    used_share: float
    gain: float
    dose_scale_kg_m: float


class RollerFilm(NamedTuple):
    """Section [roller_film]; `acts` False on a track, and where nothing thins it."""

    acts: bool
    thinning: float
    spray_1_s: float
    gain: float


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
    pads: Pads
    flats: Flats
    sanders: Sanders
    film: RollerFilm
    coach: Packed | None = None


def check(sections: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, dict[str, Any]]:
    """Every physics section, all values. Raises ConfigError naming file, section, key, value and what is allowed."""
    checked = {
        name: read(rows, sections.get(name, {}), f"{where} [{name}]") for name, rows in ROWS.items()
    }
    check_recovery(checked["adhesion"], f"{where} [adhesion]")
    if checked["adhesion"]["initial_adhesion"] > 0.0:
        checked["adhesion"]["mu_cd"] = initial_mu_cd(checked, f"{where} [adhesion]")
    return checked


def law_of(section: Mapping[str, Any]) -> Law:
    """The adhesion law of a checked section [adhesion], which also says what its mu_cd follows from."""
    return Law(**{name: section[name] for name in Law._fields})


def initial_mu_cd(sections: Mapping[str, Mapping[str, Any]], where: str) -> float:
    """The mu_cd with which a wheel on the rail has `initial_adhesion`, recovery by its own sliding counted.

    Under the static load, at the speed and the sliding that [adhesion] names. Raises ConfigError where none has it.
    """
    contact, vehicle, told = (sections[key] for key in ("contact", "vehicle", "adhesion"))
    patch = patch_for(
        vehicle["wheel_radius_m"],
        math.inf,
        contact["lateral_radius_m"],
        contact["young_Pa"],
        contact["shear_Pa"],
        contact["poisson"],
    )
    law, load_N = law_of(told), 0.5 * GRAVITY_M_S2 * vehicle["mass_kg"] / AXLES
    speed, sliding = told["initial_at_speed_m_s"], told["initial_at_sliding_m_s"]

    def adhesion_of(mu_cd: float) -> float:
        return float(
            adhesion.wheel_adhesion(sliding, speed, load_N, patch, law._replace(mu_cd=mu_cd))[0]
        )

    low, high, wanted = 1e-4, law.mu_cr * law.A_d / law.A_r, told["initial_adhesion"]
    below, above = low, high
    for _ in range(60):
        middle = 0.5 * (below + above)
        below, above = (middle, above) if adhesion_of(middle) < wanted else (below, middle)
    if (
        abs(adhesion_of(above) - wanted) < 1e-9
    ):  # where recovery leaps, what lies within the leap has no mu_cd
        return above
    raise ConfigError(
        f"{where}: initial_adhesion = {wanted:g}: no mu_cd gives it at {speed:g} m/s and a sliding of "
        f"{sliding:g} m/s; allowed is {adhesion_of(low):.3g} to {adhesion_of(high):.3g} there; mend it, "
        "or initial_at_speed_m_s and initial_at_sliding_m_s"
    )


def check_recovery(law: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError where an adhesion law's recovered friction is below its degraded one."""
    recovered, degraded = law["mu_cr"] / law["A_r"], law["mu_cd"] / law["A_d"]
    if recovered < degraded:
        raise ConfigError(
            f"{where}: recovered friction mu_cr/A_r = {recovered:.3g} is below the degraded mu_cd/A_d = "
            f"{degraded:.3g}; recovery needs mu_cr/A_r at or above mu_cd/A_d"
        )


def build(
    sections: Mapping[str, Mapping[str, Any]],
    friction: Friction,
    demand: Demand,
    tick_s: float,
    substeps: int,
) -> Params:
    """The constant structures from checked sections, a programme, and the rates of the loop."""
    contact = sections["contact"]
    extra = sections["mechanisms"]
    if sections["vehicle"]["model"] != "planar":
        check_coach(extra)
    vehicle = effects.extended(sections["vehicle"], extra)
    mode = MODES[sections["rig"]["mode"]]
    roller_radius_m = math.inf if mode == TRACK else contact["roller_radius_m"]
    patch = patch_for(
        vehicle["wheel_radius_m"],
        roller_radius_m,
        contact["lateral_radius_m"],
        contact["young_Pa"],
        contact["shear_Pa"],
        contact["poisson"],
        MODELS[contact["model"]],
        contact["fastsim_cells"],
    )
    patch = patch._replace(**effects.extended({"eps1": patch.eps1}, extra))
    law, step_s = law_of(effects.extended(sections["adhesion"], extra)), tick_s / substeps
    return Params(
        mode=mode,
        tick_s=tick_s,
        step_s=step_s,
        substeps=substeps,
        teeth=sections["sensor"]["teeth"],
        lock_above_m_s=sections["rig"]["lock_above_m_s"],
        patch=patch,
        law=law,
        vehicle=_vehicle(vehicle, extra, sections["rig"]),
        brake=_brake(sections, tick_s, substeps),
        drive=_drive(sections["drive"], contact["roller_radius_m"], step_s),
        axle_position_m=axle_positions(vehicle),
        friction=friction,
        demand=demand,
        effects=effects.build(extra),
        wheels=effects.wheels(sections["vehicle"], extra),
        heat=_heat(sections, tick_s),
        pads=_pads(sections["pads"]),
        flats=_flats(sections),
        sanders=_sanders(sections["sanders"]),
        film=RollerFilm(
            mode == ROLLERS and sections["roller_film"]["thinning"] > 0.0, **sections["roller_film"]
        ),
        coach=_coach({**sections, "vehicle": vehicle}, roller_radius_m, law, step_s),
    )


def check_coach(extra: Mapping[str, float]) -> None:
    """Raise ConfigError where an extended model has a mechanism that the coach in 3D does not know."""
    for known in table.IN_PLANT:
        if known.in_coach == NOT or (
            known.in_coach == AXLES_ALIKE and extra[f"{known.name}_axle"] != 0.0
        ):
            for key in known.coefficients:
                if extra[key] != 0.0:
                    raise ConfigError(
                        f"[mechanisms] {key} = {extra[key]:g}: the coach in 3D does not know that {known.text}; "
                        'allowed is 0, or the planar vehicle, vehicle.model = "planar"'
                    )


def _coach(
    sections: Mapping[str, Mapping[str, Any]], roller_radius_m: float, law: Law, step_s: float
) -> Packed | None:
    if sections["vehicle"]["model"] == "planar":
        return None
    contact = sections["contact"]
    compiled_coach.prepare()
    coach = coaches.build(
        sections, roller_radius_m, MODELS[contact["model"]], contact["fastsim_cells"]
    )
    return compiled_coach.packed(coach, law, step_s, sections["drive"]["roller_inertia_kgm2"])


def build_rollers(
    sections: Mapping[str, Mapping[str, Any]], demand: Demand, tick_s: float, substeps: int
) -> Params:
    """The plant that runs beside a virtual track: the same wheelsets on dry, clean rollers."""
    dry = sections["dry_roller"]
    # dry and clean: the degraded curve is the recovered one, and nothing is cleaned
    adhesion = {
        **sections["adhesion"],
        "mu_cd": dry["mu_c"],
        "mu_cr": dry["mu_c"],
        "A_d": dry["A"],
        "A_r": dry["A"],
        "gamma_d_s_m": dry["gamma_s_m"],
        "gamma_r_s_m": dry["gamma_s_m"],
        "k_ad": dry["k_a"],
        "k_ar": dry["k_a"],
        "k_sd": dry["k_s"],
        "k_sr": dry["k_s"],
        "tau_m_J": 0.0,
        "cleaning_creepage": math.inf,
    }
    none = Friction(*(np.zeros(0, dtype) for dtype in (np.bool_, float, float, float, np.int64)))
    rollers = {
        **sections,
        "adhesion": adhesion,
        "vehicle": {**sections["vehicle"], "model": "planar"},
        "rig": {**sections["rig"], "mode": "contaminated_rollers"},
        # sand lies on the virtual track, and its wheels have the flats
        "sanders": {**sections["sanders"], "axle": 0, "second_axle": 0},
        "flats": {**sections["flats"], "wear_mm3_J": 0.0},
        "roller_film": {**sections["roller_film"], "thinning": 0.0},
    }
    return build(rollers, none, demand, tick_s, substeps)


def axle_positions(vehicle: Mapping[str, float]) -> np.ndarray:
    """Distance in m of each wheelset behind the first."""
    base, pivots = vehicle["bogie_wheelbase_m"], vehicle["bogie_distance_m"]
    return np.array([0.0, base, pivots, pivots + base])


def _vehicle(v: Mapping[str, float], extra: Mapping[str, float], rig: Mapping[str, Any]) -> Vehicle:
    body_kg = v["mass_kg"] - 2.0 * v["bogie_mass_kg"] - 4.0 * v["wheelset_mass_kg"]
    if body_kg <= 0.0:
        raise ConfigError(
            f"[vehicle] mass_kg = {v['mass_kg']:g} is not more than its bogies and "
            f"wheelsets weigh ({v['mass_kg'] - body_kg:g} kg); raise it"
        )
    # moments about the pivots, then about the rail under each bogie [V2, V3 of vehicle.py]
    body = body_kg * (v["body_height_m"] - v["pivot_height_m"]) / v["bogie_distance_m"]
    bogie = (
        0.5 * body_kg * v["pivot_height_m"]
        + v["bogie_mass_kg"] * v["bogie_height_m"]
        + 2.0 * v["wheelset_mass_kg"] * v["wheel_radius_m"]
    ) / v["bogie_wheelbase_m"]
    static_N = GRAVITY_M_S2 * v["mass_kg"] / AXLES
    told = {name: v[name] for name in Vehicle._fields if name in v}
    # where the drives hold the speed, nothing can slow the vehicle that they simulate
    return Vehicle(
        **told | ({"mass_kg": math.inf} if rig["speed"] == "held" else {}),
        static_load_N=static_N,
        body_transfer_kg=body + 2.0 * static_N * extra["load_transfer_body_s2_m"],
        bogie_transfer_kg=bogie + static_N * extra["load_transfer_bogie_s2_m"],
    )


def _share(step_s: float, time_constant_s: float) -> float:
    return -math.expm1(-step_s / time_constant_s)


def _air(a: Mapping[str, float], step_s: float) -> Air:
    hose = a["hose_NL_s_bar"]
    # two conductances in series: 1/C^3 is the sum of theirs, Eckersten's rule (recollection)
    fill, vent = (
        (a[f"{way}_valve_NL_s_bar"] ** -3 + hose**-3) ** (-1.0 / 3.0) / 1e5
        for way in ("fill", "vent")
    )
    return Air(
        a["reservoir_volume_L"],
        a["reservoir_pressure_Pa"],
        a["supply_pressure_Pa"],
        a["supply_NL_s_bar"] / 1e5,
        fill,
        vent,
        a["critical_ratio"],
        step_s,
    )


def _brake(sections: Mapping[str, Mapping[str, Any]], tick_s: float, substeps: int) -> Brake:
    b, valve = sections["brake"], sections["valve"]
    lags_s = (
        b["fill_time_constant_s"],
        b["release_time_constant_s"],
        valve["fill_time_constant_s"],
        valve["vent_time_constant_s"],
    )
    fill, release, valve_fill, valve_vent = (_share(tick_s / substeps, lag_s) for lag_s in lags_s)
    return Brake(
        torque_Nm_Pa=brake_torque_Nm_Pa(b),
        spring_pressure_Pa=b["spring_pressure_Pa"],
        volume_L=b["cylinder_volume_L"],
        demand_fill_share=fill,
        demand_release_share=release,
        valve_fill_share=valve_fill,
        valve_vent_share=valve_vent,
        dead_time_ticks=round(valve["dead_time_s"] / tick_s),
        weighed_share=weighed_share(sections["air"], sections["vehicle"]),
        air=_air(sections["air"], tick_s / substeps),
    )


def _pads(p: Mapping[str, float]) -> Pads:
    vary = any(
        p[key] != 0.0 for key in ("speed_loss", "pressure_loss", "fade_loss", "clamp_hysteresis")
    )
    return Pads(vary, *(p[name] for name in Pads._fields[1:]))


def _flats(sections: Mapping[str, Mapping[str, Any]]) -> Flats:
    given = sections["flats"]
    if (
        given["wear_mm3_J"] > 0.0
        and given["load_1_m"] > 0.0
        and sections["vehicle"]["model"] != "planar"
    ):
        raise ConfigError(
            f"[flats] load_1_m = {given['load_1_m']:g}: the coach in 3D knows no load that swings over a "
            "flat; allowed is 0 (flats grow and disturb sensors all the same), or the planar vehicle"
        )
    return Flats(1e-9 * given["wear_mm3_J"], given["width_m"], given["load_1_m"])


def _sanders(s: Mapping[str, Any]) -> Sanders:
    axles = {s["axle"], s["second_axle"]} - {0}
    return Sanders(
        sum(1 << (axle - 1) for axle in axles), *(s[name] for name in Sanders._fields[1:])
    )


def _heat(sections: Mapping[str, Mapping[str, Any]], tick_s: float) -> Heat:
    brake, drive = sections["brake"], sections["drive"]
    return Heat(
        sections["rig"]["air_temperature_K"],
        brake["disc_heat_capacity_J_K"],
        _share(tick_s, brake["disc_cooling_time_s"]),
        drive["rated_torque_Nm"],
        drive["rated_temperature_rise_K"],
        _share(tick_s, drive["thermal_time_constant_s"]),
    )


def _drive(d: Mapping[str, float], roller_radius_m: float, step_s: float) -> Drive:
    if math.isinf(roller_radius_m):
        roller_radius_m = 1.0
    return Drive(
        **{name: d[name] for name in Drive._fields if name in d},
        roller_radius_m=roller_radius_m,
        torque_share=_share(step_s, d["torque_time_constant_s"]),
    )
