"""The parameters of the physics: the rows of `parameters.toml`, and the constants built from them.

A value comes from a TOML file, from a program that identified it, or from its default. All values
pass the same check. The constants are nested named tuples that kernels read and nobody can write.
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, integer, number, read
from rollerrig.configs.vehicle import (
    AXLES_OF_BOGIE,
    COACH_AXLES,
    GRAVITY_M_S2,
    axle_positions_m,
    bodies,
    brake_factors,
    brake_torque_Nm_Pa,
    kind_of,
    weighed_share,
)
from rollerrig.rig import dynamic_params, track_brake_params
from rollerrig.rig.compiled import record_type
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.contact.patch import Patch, patch_for
from rollerrig.rig.mechanisms import applied as effects
from rollerrig.rig.mechanisms import table
from rollerrig.rig.mechanisms.mechanism import MODELLED_ON_ALL_AXLES, NOT_MODELLED
from rollerrig.rig.multibody import coach as coaches
from rollerrig.rig.multibody import compiled_coach
from rollerrig.rig.multibody.compiled_coach import Packed

# How the wheels of a plant run. A virtual track has two plants: one on the track and one on dry
# rollers that runs at the same time.
TRACK, ROLLERS = 0, 1
VIRTUAL_TRACK = "virtual_track"
MODES = {"track": TRACK, "contaminated_rollers": ROLLERS, VIRTUAL_TRACK: TRACK}

BISECTIONS = 60  # halve the range of mu_cd to the last digit
PA_PER_BAR = 1e5


def _row(name: str, entry: list[Any]) -> Row:
    """Return the row of an entry of `parameters.toml`, whose comment explains its order."""
    default, *allowed, source = entry
    if isinstance(default, str):
        (choices,) = allowed
        return choice(name, default, tuple(choices), source)
    low, high = allowed
    if isinstance(default, list):
        return Row(name, tuple(default), low, high, source)
    if isinstance(default, int):
        return integer(name, default, low, high, source)
    return number(name, default, low, high, source)


def _rows_of_file() -> dict[str, tuple[Row, ...]]:
    """Return the rows of `parameters.toml` by section."""
    text = Path(__file__).with_name("parameters.toml").read_text(encoding="utf-8")
    rows: dict[str, tuple[Row, ...]] = {}
    for section, entries in tomllib.loads(text).items():
        rows[section] = tuple(_row(name, entry) for name, entry in entries.items())
    return rows


ROWS = _rows_of_file()
ROWS["mechanisms"] = table.rows()


class Vehicle(NamedTuple):
    """The vehicle. A transfer is in N of wheelset load for each m/s2 of braking, shape (axles,)."""

    mass_kg: float
    wheel_radius_m: float
    wheelset_inertia_kgm2: float
    resistance_A_N: float
    resistance_B_N_s_m: float
    resistance_C_N_s2_m2: float
    pitch_time_constant_s: float
    static_load_N: float
    transfer_kg: np.ndarray


class Air(NamedTuple):
    """The air of the coach. Conductances are in NL/(s Pa)."""

    reservoir_L: float  # 0: air is unlimited
    begin_Pa: float
    supply_Pa: float
    supply: float
    fill: float
    vent: float
    critical_ratio: float
    step_s: float


class Brake(NamedTuple):
    """Pneumatics and disc brake of a wheelset.

    A share is the part of the difference that a lag closes in one step: 1 - exp(-step / T).
    torque_Nm_Pa: (axles,).
    """

    torque_Nm_Pa: np.ndarray
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
    """Section [pads]."""

    vary: bool  # False: friction is constant and the clamp follows the pressure
    speed_loss: float
    speed_scale_m_s: float
    pressure_loss: float
    pressure_scale_Pa: float
    fade_loss: float
    fade_from_K: float
    fade_scale_K: float
    clamp_hysteresis: float


class Drive(NamedTuple):
    """A roller and its motor; its share is the one of a step, as in `Brake`."""

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
    """Section [flats]."""

    wear_m3_J: float  # 0: wheels stay round
    width_m: float
    load_1_m: float


class Sanders(NamedTuple):
    """Section [sanders]."""

    axles: int  # bit mask, bit 0 the leading axle; 0 where none has a sander
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
    """Section [roller_film]."""

    acts: bool  # False on a track, and where nothing thins the film
    thinning: float
    spray_1_s: float
    gain: float


class Friction(NamedTuple):
    """Changes of the contaminant, in the order in which they apply; arrays of one length."""

    by_place: np.ndarray  # bool: `start` is a place, which each axle passes, else a time
    start: np.ndarray  # m along the track, or s
    mu_cd: np.ndarray
    mu_cr: np.ndarray
    axles: np.ndarray  # bit mask, bit 0 the leading axle


class Demand(NamedTuple):
    """Brake demand: from each time on, the pressure that the cylinders shall reach."""

    start_s: np.ndarray
    pressure_Pa: np.ndarray


class Params(NamedTuple):
    """Everything that the plant needs and never changes."""

    axles: int
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
    dynamic: dynamic_params.DynamicBrake
    track_brake: track_brake_params.MagneticTrackBrake
    coach: Packed | None = None


record_type.register(Params)


def check(sections: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, dict[str, Any]]:
    """Return every section of the physics with all values, given or default.

    Raises ConfigError with file, section, key, value and the allowed values.
    """
    axles = kind_of(sections, where).axles
    rows_of_vehicle = ROWS | {"mechanisms": table.rows(axles)}
    checked = {
        name: read(rows, sections.get(name, {}), f"{where} [{name}]")
        for name, rows in rows_of_vehicle.items()
    }
    check_recovery(checked["adhesion"], f"{where} [adhesion]")
    if checked["adhesion"]["initial_adhesion"] > 0.0:
        checked["adhesion"]["mu_cd"] = initial_mu_cd(checked, f"{where} [adhesion]")
    return checked


def law_of(section: Mapping[str, Any]) -> Law:
    """Return the adhesion law of a checked section [adhesion].

    The section also has the keys of the initial adhesion, which the law does not need.
    """
    return Law(**{name: section[name] for name in Law._fields})


def initial_mu_cd(sections: Mapping[str, Mapping[str, Any]], where: str) -> float:
    """Return the mu_cd with which a wheel on the rail has `initial_adhesion`.

    This counts the recovery by the sliding itself, under the static load, at the speed and the
    sliding in [adhesion]. Raises ConfigError where no mu_cd gives this adhesion.
    """
    contact = sections["contact"]
    vehicle = sections["vehicle"]
    section = sections["adhesion"]
    patch = patch_for(
        vehicle["wheel_radius_m"],
        math.inf,
        contact["lateral_radius_m"],
        contact["young_Pa"],
        contact["shear_Pa"],
        contact["poisson"],
    )
    law = law_of(section)
    load_N = 0.5 * GRAVITY_M_S2 * vehicle["mass_kg"] / vehicle["axles"]
    speed = section["initial_at_speed_m_s"]
    sliding = section["initial_at_sliding_m_s"]
    wanted = section["initial_adhesion"]

    def adhesion_of(mu_cd: float) -> float:
        law_here = law._replace(mu_cd=mu_cd)
        return float(adhesion.wheel_adhesion(sliding, speed, load_N, patch, law_here)[0])

    # bisection between hardly any friction and that of the recovered contact
    low = 1e-4
    high = law.mu_cr * law.A_d / law.A_r
    below = low
    above = high
    for _ in range(BISECTIONS):
        middle = 0.5 * (below + above)
        if adhesion_of(middle) < wanted:
            below = middle
        else:
            above = middle

    # recovery may leap: then no mu_cd gives an adhesion within the leap
    if abs(adhesion_of(above) - wanted) < 1e-9:
        return above
    raise ConfigError(
        f"{where}: initial_adhesion = {wanted:g}: no mu_cd gives it at {speed:g} m/s and a sliding "
        f"of {sliding:g} m/s; allowed is {adhesion_of(low):.3g} to {adhesion_of(high):.3g} there; "
        "change it, or initial_at_speed_m_s and initial_at_sliding_m_s"
    )


# mu_cd beside an initial adhesion may differ from the one that follows by this share: a file of an
# earlier run has both
_AGREES = 0.01


def check_initial_adhesion(sections: Mapping[str, Mapping[str, Any]], where: str) -> None:
    """Raise ConfigError where [adhesion] gives a mu_cd and another initial adhesion.

    The other values, of the wheel, its load and the law, are those of `sections` or the defaults.
    """
    given = sections.get("adhesion", {})
    stated = given.get("initial_adhesion", 0.0)
    if not stated or "mu_cd" not in given:
        return
    checked = {
        name: read(ROWS[name], sections.get(name, {}), f"{where} [{name}]")
        for name in ("adhesion", "contact", "vehicle")
    }
    follows = initial_mu_cd(checked, f"{where} [adhesion]")
    if abs(given["mu_cd"] - follows) > _AGREES * follows:
        raise ConfigError(
            f"{where} [adhesion]: initial_adhesion = {stated:g} and mu_cd = {given['mu_cd']:g} "
            f"contradict each other, because mu_cd follows from the initial adhesion ({follows:.4g}); "
            "allowed is one of them: remove the other"
        )


def check_recovery(law: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError where an adhesion law's recovered friction is below its degraded one."""
    recovered = law["mu_cr"] / law["A_r"]
    degraded = law["mu_cd"] / law["A_d"]
    if recovered < degraded:
        raise ConfigError(
            f"{where}: recovered friction mu_cr/A_r = {recovered:.3g} is below the degraded "
            f"mu_cd/A_d = {degraded:.3g}; recovery needs mu_cr/A_r at or above mu_cd/A_d"
        )


def build(
    sections: Mapping[str, Mapping[str, Any]],
    friction: Friction,
    demand: Demand,
    tick_s: float,
    substeps: int,
    traction: Sequence[Mapping[str, float]] = (),
) -> Params:
    """Return the constants of a plant.

    Parameters
    ----------
    sections : checked sections, from `check`
    friction, demand : the programme
    tick_s, substeps : length of a tick, and steps of the physics in it
    traction : steps of the programme of traction, each with from_s and share
    """
    contact = sections["contact"]
    extra = sections["mechanisms"]
    if sections["vehicle"]["model"] != "planar":
        check_coach(extra)
        if sections["vehicle"]["axles"] != COACH_AXLES:
            raise ConfigError(
                f"[vehicle] model = 'multibody' with {sections['vehicle']['axles']} axles: the "
                f'coach in 3D has {COACH_AXLES}; allowed is model = "planar"'
            )
    step_s = tick_s / substeps

    # constants of the model, as an extended model changes them
    vehicle = effects.extended(sections["vehicle"], extra)
    law = law_of(effects.extended(sections["adhesion"], extra))
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

    # checks the driven axles, which the inertias of the wheelsets need
    dynamic = dynamic_params.build(sections, step_s, traction)
    return Params(
        axles=vehicle["axles"],
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
        wheels=effects.wheels(
            sections["vehicle"],
            extra,
            dynamic_params.rotor_inertias_kgm2(sections),
        ),
        heat=_heat(sections, tick_s),
        pads=_pads(sections["pads"]),
        flats=_flats(sections),
        sanders=_sanders(sections["sanders"]),
        film=_film(sections["roller_film"], mode),
        dynamic=dynamic,
        track_brake=track_brake_params.build(sections, tick_s),
        coach=_coach({**sections, "vehicle": vehicle}, roller_radius_m, law, step_s),
    )


def check_coach(extra: Mapping[str, float]) -> None:
    """Raise ConfigError where an extended model has a mechanism that the coach in 3D does not know.

    `extra` is the checked section [mechanisms].
    """
    for mechanism in table.IN_PLANT:
        unknown = mechanism.in_coach == NOT_MODELLED
        if mechanism.in_coach == MODELLED_ON_ALL_AXLES:
            # only one axle has it
            unknown = extra[f"{mechanism.name}_axle"] != 0.0
        if not unknown:
            continue
        for key in mechanism.coefficients:
            if extra[key] != 0.0:
                raise ConfigError(
                    f"[mechanisms] {key} = {extra[key]:g}: the coach in 3D does not know that "
                    f"{mechanism.text}; allowed is 0, or the planar vehicle, "
                    'vehicle.model = "planar"'
                )


def _coach(
    sections: Mapping[str, Mapping[str, Any]], roller_radius_m: float, law: Law, step_s: float
) -> Packed | None:
    """Return the constants of the coach in 3D; None for the planar vehicle."""
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
    """Return the constants of the plant of a virtual track's rollers.

    It has the same wheelsets on dry, clean rollers, and runs at the same time as the track.
    Arguments as for `build`.
    """
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
        "cleaning_half_speed_m_s": 0.0,
        "cleaning_sliding_m_s": math.inf,
    }
    rollers = {
        **sections,
        "adhesion": adhesion,
        "vehicle": {**sections["vehicle"], "model": "planar"},
        "rig": {**sections["rig"], "mode": "contaminated_rollers"},
        # sand lies on the virtual track, and its wheels have the flats
        "sanders": {**sections["sanders"], "axle": 0, "second_axle": 0},
        "flats": {**sections["flats"], "wear_mm3_J": 0.0},
        "roller_film": {**sections["roller_film"], "thinning": 0.0},
        "magnetic_track_brake": {**sections["magnetic_track_brake"], "bogies": ()},
    }
    no_friction = Friction(
        by_place=np.zeros(0, np.bool_),
        start=np.zeros(0),
        mu_cd=np.zeros(0),
        mu_cr=np.zeros(0),
        axles=np.zeros(0, np.int64),
    )
    return build(rollers, no_friction, demand, tick_s, substeps)


def axle_positions(vehicle: Mapping[str, Any]) -> np.ndarray:
    """Return the distance in m of each wheelset behind the first, shape (axles,)."""
    return np.array(axle_positions_m(vehicle))


def _transfers(
    v: Mapping[str, Any], body_kg: float, static_N: float, extra: Mapping[str, float]
) -> np.ndarray:
    """Return the load transfer of each wheelset in N for each m/s2 of braking [V2, V3].

    `body_kg` is the mass of all bodies, `static_N` the static load of a wheelset. A body is rigid:
    the forces on its bogies vary with their distance from its middle. A body on one bogie does not
    pitch here, because nothing holds it but the rest of its train.
    """
    bogies = v["bogies_per_body"]
    number_of_bodies = bodies(v)
    one_body_kg = body_kg / number_of_bodies
    # Moments about the pivots. The weights are 1 and -1 where a body has two bogies.
    distance_m = v["bogie_distance_m"]
    behind_first_m = distance_m * np.arange(bogies)
    levers_m = behind_first_m[-1] / 2.0 - behind_first_m
    weights = np.zeros(bogies)
    if bogies > 1:
        weights = levers_m * distance_m / np.sum(levers_m**2)
    body = one_body_kg * (v["body_height_m"] - v["pivot_height_m"]) / distance_m
    body += 2.0 * static_N * extra["load_transfer_body_s2_m"]

    # moments about the rail under each bogie
    bogie = (
        one_body_kg / bogies * v["pivot_height_m"]
        + v["bogie_mass_kg"] * v["bogie_height_m"]
        + 2.0 * v["wheelset_mass_kg"] * v["wheel_radius_m"]
    ) / v["bogie_wheelbase_m"]
    bogie += static_N * extra["load_transfer_bogie_s2_m"]
    of_bogies = 0.5 * body * weights
    of_body = np.column_stack([of_bogies + bogie, of_bogies - bogie]).ravel()
    return np.tile(of_body, number_of_bodies)


def _vehicle(v: Mapping[str, Any], extra: Mapping[str, float], rig: Mapping[str, Any]) -> Vehicle:
    """Return the vehicle from its sections [vehicle], [mechanisms] and [rig]."""
    axles = v["axles"]
    bogies = axles // AXLES_OF_BOGIE
    body_kg = v["mass_kg"] - bogies * v["bogie_mass_kg"] - axles * v["wheelset_mass_kg"]
    if body_kg <= 0.0:
        raise ConfigError(
            f"[vehicle] mass_kg = {v['mass_kg']:g} is not more than its bogies and "
            f"wheelsets weigh ({v['mass_kg'] - body_kg:g} kg); raise it"
        )

    static_N = GRAVITY_M_S2 * v["mass_kg"] / axles

    # where the drives hold the speed, nothing can slow the vehicle that they simulate
    mass_kg = math.inf if rig["speed"] == "held" else v["mass_kg"]
    return Vehicle(
        mass_kg=mass_kg,
        wheel_radius_m=v["wheel_radius_m"],
        wheelset_inertia_kgm2=v["wheelset_inertia_kgm2"],
        resistance_A_N=v["resistance_A_N"],
        resistance_B_N_s_m=v["resistance_B_N_s_m"],
        resistance_C_N_s2_m2=v["resistance_C_N_s2_m2"],
        pitch_time_constant_s=v["pitch_time_constant_s"],
        static_load_N=static_N,
        transfer_kg=_transfers(v, body_kg, static_N, extra),
    )


def _share(step_s: float, time_constant_s: float) -> float:
    """Return the part of the difference that a lag closes in a step."""
    return -math.expm1(-step_s / time_constant_s)


def _in_series(valve_NL_s_bar: float, hose_NL_s_bar: float) -> float:
    """Return the conductance in NL/(s Pa) of a valve and a hose in series.

    1/C^3 is the sum of theirs: Eckersten's rule (recollection).
    """
    return (valve_NL_s_bar**-3 + hose_NL_s_bar**-3) ** (-1.0 / 3.0) / PA_PER_BAR


def _air(a: Mapping[str, float], step_s: float) -> Air:
    """Return the air of the coach from its section [air]."""
    hose = a["hose_NL_s_bar"]
    return Air(
        reservoir_L=a["reservoir_volume_L"],
        begin_Pa=a["reservoir_pressure_Pa"],
        supply_Pa=a["supply_pressure_Pa"],
        supply=a["supply_NL_s_bar"] / PA_PER_BAR,
        fill=_in_series(a["fill_valve_NL_s_bar"], hose),
        vent=_in_series(a["vent_valve_NL_s_bar"], hose),
        critical_ratio=a["critical_ratio"],
        step_s=step_s,
    )


def _brake(sections: Mapping[str, Mapping[str, Any]], tick_s: float, substeps: int) -> Brake:
    """Return the brake from its sections [brake], [valve], [air] and [vehicle]."""
    b = sections["brake"]
    valve = sections["valve"]
    step_s = tick_s / substeps
    return Brake(
        torque_Nm_Pa=brake_torque_Nm_Pa(b) * np.array(brake_factors(sections)),
        spring_pressure_Pa=b["spring_pressure_Pa"],
        volume_L=b["cylinder_volume_L"],
        demand_fill_share=_share(step_s, b["fill_time_constant_s"]),
        demand_release_share=_share(step_s, b["release_time_constant_s"]),
        valve_fill_share=_share(step_s, valve["fill_time_constant_s"]),
        valve_vent_share=_share(step_s, valve["vent_time_constant_s"]),
        dead_time_ticks=round(valve["dead_time_s"] / tick_s),
        weighed_share=weighed_share(sections["air"], sections["vehicle"]),
        air=_air(sections["air"], step_s),
    )


def _pads(p: Mapping[str, float]) -> Pads:
    """Return the pads from their section [pads]."""
    losses = ("speed_loss", "pressure_loss", "fade_loss", "clamp_hysteresis")
    vary = any(p[key] != 0.0 for key in losses)
    return Pads(vary, *(p[name] for name in Pads._fields[1:]))


def _flats(sections: Mapping[str, Mapping[str, Any]]) -> Flats:
    """Return the flats; raise ConfigError where their load meets the coach in 3D."""
    f = sections["flats"]
    load_varies = f["wear_mm3_J"] > 0.0 and f["load_1_m"] > 0.0
    if load_varies and sections["vehicle"]["model"] != "planar":
        raise ConfigError(
            f"[flats] load_1_m = {f['load_1_m']:g}: the coach in 3D knows no load that varies over "
            "a flat; allowed is 0 (flats still grow and disturb sensors), or the planar vehicle"
        )
    return Flats(1e-9 * f["wear_mm3_J"], f["width_m"], f["load_1_m"])


def _sanders(s: Mapping[str, Any]) -> Sanders:
    """Return the sanders from their section [sanders]."""
    axles = {s["axle"], s["second_axle"]} - {0}
    mask = sum(1 << (axle - 1) for axle in axles)
    return Sanders(mask, *(s[name] for name in Sanders._fields[1:]))


def _film(f: Mapping[str, Any], mode: int) -> RollerFilm:
    """Return the film on the rollers from its section [roller_film]."""
    acts = mode == ROLLERS and f["thinning"] > 0.0
    return RollerFilm(acts, **f)


def _heat(sections: Mapping[str, Mapping[str, Any]], tick_s: float) -> Heat:
    """Return the heat of discs and motors from its sections [rig], [brake] and [drive]."""
    brake = sections["brake"]
    drive = sections["drive"]
    return Heat(
        air_K=sections["rig"]["air_temperature_K"],
        disc_J_K=brake["disc_heat_capacity_J_K"],
        disc_share=_share(tick_s, brake["disc_cooling_time_s"]),
        rated_torque_Nm=drive["rated_torque_Nm"],
        motor_rise_K=drive["rated_temperature_rise_K"],
        motor_share=_share(tick_s, drive["thermal_time_constant_s"]),
    )


def _drive(d: Mapping[str, float], roller_radius_m: float, step_s: float) -> Drive:
    """Return the drives from their section [drive]; on a rail the radius does not matter."""
    if math.isinf(roller_radius_m):
        roller_radius_m = 1.0
    return Drive(
        roller_radius_m=roller_radius_m,
        roller_inertia_kgm2=d["roller_inertia_kgm2"],
        max_torque_Nm=d["max_torque_Nm"],
        max_power_W=d["max_power_W"],
        max_speed_rad_s=d["max_speed_rad_s"],
        torque_share=_share(step_s, d["torque_time_constant_s"]),
        speed_loop_rad_s=d["speed_loop_rad_s"],
        observer_rad_s=d["observer_rad_s"],
    )
