"""The constants of the dynamic brake of a vehicle, and the checks that it can work as it is given.

The physics is in `dynamic_brake`, whose equations the names here follow.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES_OF_BOGIE, bodies, brake_torque_Nm_Pa

# what permits the share of an axle
NO_CONTROL, TRACTION_UNIT, BUS = 0, 1, 2
CONTROLS = {"none": NO_CONTROL, "traction_unit": TRACTION_UNIT, "bus": BUS}


class DynamicBrake(NamedTuple):
    """Section [dynamic_brake], and the programme of traction. Forces are at the rim of one axle.

    A share of a lag is the part of the difference that it closes in one step.
    """

    acts: bool  # False: the vehicle has none
    driven: np.ndarray  # bool, (axles,)
    blends_with: np.ndarray  # (axles,): number of the group of axles that blend together
    force_N: float
    brake_corner_speed_m_s: float
    corner_speed_m_s: float  # of traction
    fade_from_m_s: float
    fade_to_m_s: float
    traction_force_N: float
    lag_share: float
    largest_change_N: float  # in one step
    takeover_share: float
    demand_N_Pa: float  # demanded force of an axle for each Pa above the spring pressure
    friction_N_Pa: float  # force of its friction brake for each Pa above the spring pressure
    spring_pressure_Pa: float
    control: int
    slide_limit: float  # share of the speed of the vehicle
    slide_floor_m_s: float
    release_change: float  # of the share, in one step
    return_change: float
    traction_start_s: np.ndarray
    traction_share: np.ndarray


def axles_of(section: Mapping[str, Any]) -> list[int]:
    """Return the driven axles (from 1) of a section [dynamic_brake]; none without a brake."""
    return [int(axle) for axle in section.get("axles", ())]


def build(
    sections: Mapping[str, Mapping[str, Any]],
    step_s: float,
    traction: Sequence[Mapping[str, float]] = (),
) -> DynamicBrake:
    """Return the constants of the dynamic brake; it does not act in a vehicle without one.

    `sections` are checked sections, `traction` the steps of the scenario's programme of traction.
    Raises ConfigError for a brake that cannot work.
    """
    section = sections["dynamic_brake"]
    axles = axles_of(section)
    if axles:
        _check(section, sections, axles, traction)
    elif traction:
        raise ConfigError(
            "[[traction]] without driven axles: list them in [dynamic_brake] axles, or remove "
            "[[traction]]"
        )

    brake = sections["brake"]
    radius_m = sections["vehicle"]["wheel_radius_m"]
    friction_N_Pa = brake_torque_Nm_Pa(brake) / radius_m
    number = sections["vehicle"]["axles"]
    driven = np.zeros(number, dtype=np.bool_)
    for axle in axles:
        driven[axle - 1] = True
    size = AXLES_OF_BOGIE
    if section["blending"] == "car":
        size = number // bodies(sections["vehicle"])
    rate_N_s = section["force_rate_N_s"]
    return DynamicBrake(
        acts=bool(axles),
        driven=driven,
        blends_with=np.arange(number) // size,
        force_N=section["force_N"],
        brake_corner_speed_m_s=brake_corner_speed_m_s(section),
        corner_speed_m_s=section["corner_speed_m_s"],
        fade_from_m_s=section["fade_from_m_s"],
        fade_to_m_s=section["fade_to_m_s"],
        traction_force_N=section["traction_force_N"],
        lag_share=-math.expm1(-step_s / section["time_constant_s"]),
        largest_change_N=rate_N_s * step_s,
        takeover_share=-math.expm1(-step_s / section["takeover_time_constant_s"]),
        demand_N_Pa=section["demand_N_Pa"] or friction_N_Pa,
        friction_N_Pa=friction_N_Pa,
        spring_pressure_Pa=brake["spring_pressure_Pa"],
        control=CONTROLS[section["slide_control"]],
        slide_limit=section["slide_limit"],
        slide_floor_m_s=section["slide_floor_m_s"],
        release_change=section["release_rate_1_s"] * step_s,
        return_change=section["return_rate_1_s"] * step_s,
        traction_start_s=np.array([step["from_s"] for step in traction], dtype=np.float64),
        traction_share=np.array([step["share"] for step in traction], dtype=np.float64),
    )


def brake_corner_speed_m_s(section: Mapping[str, Any]) -> float:
    """Return the speed above which the power of the brake of a motor is constant.

    It is that of traction, if neither a speed nor a power is given for the brake.
    """
    if section["brake_power_W"] > 0.0:
        return float(section["brake_power_W"] / section["force_N"])
    return float(section["brake_corner_speed_m_s"] or section["corner_speed_m_s"])


def rotor_inertias_kgm2(sections: Mapping[str, Mapping[str, Any]]) -> np.ndarray:
    """Return the inertia of the motor on each wheelset, shape (axles,); 0 without a motor."""
    section = sections["dynamic_brake"]
    inertias = np.zeros(sections["vehicle"]["axles"])
    for axle in axles_of(section):
        inertias[axle - 1] = section["rotor_inertia_kgm2"]
    return inertias


def _check(
    section: Mapping[str, Any],
    sections: Mapping[str, Mapping[str, Any]],
    axles: list[int],
    traction: Sequence[Mapping[str, float]],
) -> None:
    """Raise ConfigError for a dynamic brake that cannot work."""
    where = "[dynamic_brake]"
    number = sections["vehicle"]["axles"]
    exact = all(axle == given for axle, given in zip(axles, section["axles"], strict=True))
    if not exact or len(set(axles)) < len(axles) or max(axles) > number:
        given = [f"{axle:g}" for axle in section["axles"]]
        raise ConfigError(
            f"{where} axles = [{', '.join(given)}]: the vehicle has {number} axles; list each "
            f"driven axle once, by its number from 1 to {number}"
        )
    if section["force_N"] == 0.0 or section["corner_speed_m_s"] == 0.0:
        raise ConfigError(
            f"{where} axles = {axles} without a curve; give force_N and corner_speed_m_s, both "
            "above 0, or remove the axles"
        )
    if section["brake_corner_speed_m_s"] > 0.0 and section["brake_power_W"] > 0.0:
        raise ConfigError(
            f"{where} brake_corner_speed_m_s = {section['brake_corner_speed_m_s']:g} and "
            f"brake_power_W = {section['brake_power_W']:g}: each gives the curve of the brake; keep "
            "one of them (the power is force_N times the corner speed)"
        )
    if section["fade_to_m_s"] >= section["fade_from_m_s"]:
        raise ConfigError(
            f"{where} fade_to_m_s = {section['fade_to_m_s']:g} is not below fade_from_m_s = "
            f"{section['fade_from_m_s']:g}; the brake fades out from the higher to the lower speed"
        )
    if sections["vehicle"]["model"] != "planar":
        raise ConfigError(
            f"{where} axles = {axles}: the coach in 3D has no motors; allowed is "
            'vehicle.model = "planar"'
        )
    if sections["rig"]["mode"] == "virtual_track":
        raise ConfigError(
            f"{where} axles = {axles}: a virtual track has no motors on its wheelsets; allowed is "
            'rig.mode = "track" or "contaminated_rollers"'
        )
    if traction and section["traction_force_N"] == 0.0:
        raise ConfigError(
            f"[[traction]] without a force; give {where} traction_force_N, above 0, or remove "
            "[[traction]]"
        )


def check_blending(brake: DynamicBrake, largest_Pa: float, limit_Pa: float) -> None:
    """Check that both brakes together have the force that the highest demand requests.

    largest_Pa: the highest demanded pressure. limit_Pa: the highest pressure of a cylinder.
    Raises ConfigError.
    """
    if not brake.acts:
        return
    demanded_N = brake.demand_N_Pa * max(0.0, largest_Pa - brake.spring_pressure_Pa)
    friction_N = brake.friction_N_Pa * max(0.0, limit_Pa - brake.spring_pressure_Pa)
    for group in range(int(brake.blends_with[-1]) + 1):
        members = brake.blends_with == group
        number = int(members.sum())
        motors_N = brake.force_N * int((members & brake.driven).sum())
        if number * demanded_N > (number * friction_N + motors_N) * (1.0 + 1e-9):
            first = int(np.flatnonzero(members)[0]) + 1
            raise ConfigError(
                f"[dynamic_brake] demand_N_Pa = {brake.demand_N_Pa:g}: a demand of "
                f"{1e-5 * largest_Pa:g} bar requests {1e-3 * number * demanded_N:.1f} kN of axles "
                f"{first} to {first + number - 1}, which have "
                f"{1e-3 * (number * friction_N + motors_N):.1f} kN: friction brake "
                f"{1e-3 * number * friction_N:.1f} kN at friction_pressure_Pa, dynamic brake "
                f"{1e-3 * motors_N:.1f} kN; lower the demand or demand_N_Pa, or raise force_N"
            )
