"""The mechanisms of an extended model inside the plant: friction under a wheel, torque at a brake.

Resistance, load transfer, contact stiffness, radii and inertias are changed once, where the
parameters are built; what depends on time, place, speed or past work is computed here in each
tick, the memory of adhesion and the load on a wheel out of round in each step of `wheelset`. While
all coefficients are 0 nothing is computed and no bit changes.

    [X1] mu_cd, mu_cr *= exp(sum of terms), terms as `mechanisms.TABLE` writes them
    [X2] C = (1 + gain) C_0 (1 - fade H0 (1 - e^(-H / H0))) + offset while the brake is applied, not below 0

The work on a metre of rail reaches the next wheel after the distance between them, as a first-order
lag of that length: an approximation of the pure delay.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.kernel import kernel

AXLES = 4
MIDDLE_SPEED_M_S = 20.0
GAIN, OFFSET_NM = 0, AXLES  # where `own` has what
CONDITIONS = ("rail_cleaning_gain", "speed_dependent_friction_slope_per_m_s",
              "negative_conditioning_loss", "contaminated_patch_depth", "friction_trend_rate_1_s",
              "sanding_gain", "empirical_linear", "empirical_quadratic")
TORQUES = ("brake_gain_gain", "pad_fade_fade_1_MJ", "torque_offset_offset_Nm")


class Effects(NamedTuple):
    """Coefficients of the extended model; `own` (8,) has gain and offset of the torque for each axle."""

    on_friction: bool
    on_torque: bool
    cleaning: float
    cleaning_J_m: float
    speed_slope_s_m: float
    speed_knee_m_s: float
    conditioning: float
    conditioning_m: float
    patch: float
    patch_from_m: float
    patch_to_m: float
    patch_edge_m: float
    trend_1_s: float
    trend_s: float
    sand: float
    sand_from_s: float
    sand_to_s: float
    sand_first: int  # first wheelset that runs on sand, from 0
    own: np.ndarray
    fade_1_J: float
    heat_J: float
    offset_from_Nm: float
    empirical: int  # covariate by its code in `mechanisms.EMPIRICAL`, 0: none
    linear: float
    quadratic: float
    centre: float
    scale: float
    period: float
    memory_m: float  # way on which recovery lags at 20 m/s, 0: it does not
    memory_power: float
    memory_of_work: float


class Wheels(NamedTuple):
    """The wheels of each axle, `table` (16,) as `vehicle` lays it out.

    One array: each that goes from kernel to kernel costs stops abreast some 4 % of their time.
    """

    table: np.ndarray
    swings: bool
    swing_phase_rad: float


def build(m: Mapping[str, Any]) -> Effects:
    """From the checked section `mechanisms`."""
    return Effects(
        any(m[name] != 0.0 for name in CONDITIONS), any(m[name] != 0.0 for name in TORQUES),
        m["rail_cleaning_gain"], m["rail_cleaning_energy_J_m"],
        m["speed_dependent_friction_slope_per_m_s"], m["speed_dependent_friction_knee_m_s"],
        m["negative_conditioning_loss"], m["negative_conditioning_distance_m"],
        m["contaminated_patch_depth"],
        m["contaminated_patch_start_m"],
        m["contaminated_patch_start_m"] + m["contaminated_patch_length_m"],
        0.5 * m["contaminated_patch_ramp"] * m["contaminated_patch_length_m"],
        m["friction_trend_rate_1_s"], m["friction_trend_time_s"], m["sanding_gain"], m["sanding_start_s"],
        m["sanding_start_s"] + m["sanding_duration_s"], int(m["sanding_behind"] >= 0.5),
        np.concatenate([_by_axle(m["brake_gain_gain"], m["brake_gain_axle"]),
                        _by_axle(m["torque_offset_offset_Nm"], m["torque_offset_axle"])]),
        1e-6 * m["pad_fade_fade_1_MJ"], 1e6 * m["pad_fade_heat_MJ"], m["torque_offset_from_Nm"],
        int(m["empirical_covariate"]),
        *(m[name] for name in ("empirical_linear", "empirical_quadratic", "empirical_centre",
                               "empirical_scale", "empirical_period", "adhesion_memory_length_m",
                               "adhesion_memory_speed_power", "adhesion_memory_of_work")))


def wheels(vehicle: Mapping[str, Any], m: Mapping[str, Any]) -> Wheels:
    """From the checked sections `vehicle` (radius and inertia of all axles) and `mechanisms`."""
    swing = _by_axle(m["wheel_out_of_round_amplitude"], m["wheel_out_of_round_axle"])
    radius_m = vehicle["wheel_radius_m"] * (
        1.0 + _by_axle(m["wheel_radius_fraction"], m["wheel_radius_axle"]))
    inertia_kgm2 = vehicle["wheelset_inertia_kgm2"] * (
        1.0 + _by_axle(m["wheel_inertia_fraction"], m["wheel_inertia_axle"]))
    table = np.concatenate([radius_m, inertia_kgm2, radius_m / inertia_kgm2, swing])
    return Wheels(table, bool(swing.any()), m["wheel_out_of_round_phase_rad"])


def _by_axle(value: float, axle: float) -> np.ndarray:
    return np.array([value if axle in (0, j + 1) else 0.0 for j in range(AXLES)])


@kernel
def friction_factor(state, axle, place_m, effects):
    """What the friction of an axle is multiplied by [X1]."""
    log_mu = effects.cleaning * -math.expm1(-state.rail_work[axle] / effects.cleaning_J_m)
    log_mu -= effects.speed_slope_s_m * effects.speed_knee_m_s * math.expm1(
        (MIDDLE_SPEED_M_S - state.vehicle_speed[0]) / effects.speed_knee_m_s)
    log_mu += effects.conditioning * math.expm1(-state.slid[axle] / effects.conditioning_m)
    if effects.patch_from_m <= place_m < effects.patch_to_m:
        inside = min(place_m - effects.patch_from_m, effects.patch_to_m - place_m)
        risen = 1.0
        if inside < effects.patch_edge_m:
            risen = math.sin(0.5 * math.pi * inside / effects.patch_edge_m) ** 2
        log_mu -= effects.patch * risen
    log_mu -= effects.trend_1_s * effects.trend_s * math.expm1(-state.time[0] / effects.trend_s)
    if axle >= effects.sand_first and effects.sand_from_s <= state.time[0] < effects.sand_to_s:
        log_mu += effects.sand
    if effects.empirical > 0:
        log_mu += empirical(covariate(state, axle, place_m, effects.empirical), effects)
    return math.exp(log_mu)


@kernel
def covariate(state, axle, place_m, code):
    """What an empirical term depends on; the codes of `mechanisms.EMPIRICAL`."""
    return (state.vehicle_speed[0], state.time[0], place_m, state.sliding[axle],
            state.wheel_load[axle], state.dissipated_energy[axle], 1e-6 * state.brake_work[axle],
            state.slid[axle], state.wheel_angle[axle])[code - 1]


@kernel
def empirical(x, effects):
    """Change of ln mu by the empirical term."""
    if effects.period > 0.0:
        turn = 2.0 * math.pi * x / effects.period
        return effects.linear * math.cos(turn) + effects.quadratic * math.sin(turn)
    z = (x - effects.centre) / effects.scale
    return effects.linear * z + effects.quadratic * z * z


@kernel
def remember(state, positions_m, tick_s):
    """Advance sliding distance and the work of the wheels before, by a tick."""
    before = 0.0
    for j in range(AXLES):
        state.slid[j] += tick_s * abs(state.sliding[j])
        if j > 0:
            length = positions_m[j] - positions_m[j - 1]
            share = -math.expm1(-state.vehicle_speed[0] * tick_s / length)
            state.rail_work[j] += (before - state.rail_work[j]) * share
        before += max(state.dissipated_energy[j], 0.0)


@kernel
def torque(capacity_Nm, axle, work_J, effects):
    """Brake torque in N m of an axle that has done an amount of brake work [X2]."""
    if capacity_Nm <= 0.0:
        return capacity_Nm
    faded = -effects.fade_1_J * effects.heat_J * math.expm1(-work_J / effects.heat_J)
    changed = capacity_Nm * (1.0 + effects.own[GAIN + axle]) * (1.0 - faded)
    if capacity_Nm > effects.offset_from_Nm:
        changed += effects.own[OFFSET_NM + axle]
    return max(0.0, changed)
