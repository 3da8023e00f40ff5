"""The mechanisms of an extended model inside the plant: friction under a wheel, torque at a brake.

What depends on time, place, speed or past work is computed here in each tick, by the courses of the table; the memory
of adhesion and the load on a wheel out of round in each step of `wheelset`; constants of the model are changed once,
where the parameters are built. While all coefficients are 0 nothing is computed and no bit changes.

The work on a metre of rail reaches the next wheel after the distance between them, as a first-order
lag of that length: an approximation of the pure delay.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.generated import kernel_from_source
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.mechanisms import constants, friction
from rollerrig.rig.mechanisms.mechanism import (
    ALONE,
    COVARIATES,
    FRICTION,
    TORQUE,
    Mechanism,
    arguments,
)
from rollerrig.rig.mechanisms.table import IN_PLANT, rows

PLACE = {row.name: i for i, row in enumerate(rows())}  # where `Effects.values` has what
_EMPIRICAL = PLACE["empirical_linear"]


class Effects(NamedTuple):
    """What a tick and a step read of an extended model."""

    on_friction: bool
    on_torque: bool
    values: np.ndarray  # all of the section `mechanisms`, in the order of `table.rows`
    memory_m: float  # way on which recovery lags at 20 m/s, 0: it does not
    memory_power: float
    memory_of_work: float


class Wheels(NamedTuple):
    """The wheels of each axle, `table` (16,) as in `vehicle`: an array more costs stops abreast 4 % of their time."""

    table: np.ndarray
    swings: bool
    swing_phase_rad: float


def build(m: Mapping[str, Any]) -> Effects:
    """From the checked section `mechanisms`."""
    acting = {
        mechanism.acts_on
        for mechanism in IN_PLANT
        if any(m[key] != 0.0 for key in mechanism.coefficients)
    }
    return Effects(
        on_friction=FRICTION in acting,
        on_torque=TORQUE in acting,
        values=np.array([m[key] for key in PLACE]),
        memory_m=m["adhesion_memory_length_m"],
        memory_power=m["adhesion_memory_speed_power"],
        memory_of_work=m["adhesion_memory_of_work"],
    )


def extended(model: Mapping[str, Any], m: Mapping[str, Any]) -> dict[str, Any]:
    """Constants of the model, those changed that an extended model changes for all axles alike."""
    found = dict(model)
    for one in IN_PLANT:
        if (
            one.constants
            and found.keys() >= set(one.changes)
            and m.get(f"{one.name}_axle", 0.0) == 0.0
        ):
            found |= one.constants(
                found, *(m[f"{one.name}_{row.name}"] for row in one.own_parameters)
            )
    return found


def wheels(vehicle: Mapping[str, Any], m: Mapping[str, Any]) -> Wheels:
    """From the checked sections `vehicle` (radius and inertia of all axles) and `mechanisms`."""
    swing, radius, inertia = (
        np.array([m[key] if m[f"{name}_axle"] in (0, j + 1) else 0.0 for j in range(AXLES)])
        for name, key in (
            ("wheel_out_of_round", "wheel_out_of_round_amplitude"),
            ("wheel_radius", "wheel_radius_fraction"),
            ("wheel_inertia", "wheel_inertia_fraction"),
        )
    )
    (radius_m,) = constants.wheel_radius(vehicle, radius).values()
    (inertia_kgm2,) = constants.wheel_inertia(vehicle, inertia).values()
    table = np.concatenate([radius_m, inertia_kgm2, radius_m / inertia_kgm2, swing])
    return Wheels(table, bool(swing.any()), m["wheel_out_of_round_phase_rad"])


def _sum_of(name: str, mechanisms: list[Mechanism]) -> Any:
    """A kernel that adds what mechanisms of the table make of a value, or of its share, one after another.

    It reads, for each: if values[3] != 0.0: value += values[3] * rail_cleaning(state.rail_work[axle], values[4])
    """
    of_plant = {c.name: c.of_plant for c in COVARIATES}
    lines = [
        f"def {name}(value, state, axle, place_m, capacity_Nm, effects, clean):",
        "    values = effects.values",
    ]
    for m in mechanisms:
        size = f"values[{PLACE[m.coefficients[0]]}]"
        shape = [f"values[{PLACE[f'{m.name}_{row.name}']}]" for row in m.own_parameters[m.free :]]
        course = f"{m.name}({', '.join([of_plant[c] for c in arguments(m.courses[0], len(shape))] + shape)})"
        own = f" and values[{PLACE[f'{m.name}_axle']}] in (0.0, axle + 1.0)" if m.axlewise else ""
        if m.acts_on == FRICTION:
            own = f" and not (clean and values[{PLACE[f'{m.name}_{ALONE.name}']}] != 0.0)"
        whole = "value * " if m.share else ""
        lines += [f"    if {size} != 0.0{own}:", f"        value += {whole}{size} * {course}"]
    space = {m.name: m.courses[0] for m in mechanisms}
    return kernel_from_source(name, [*lines, "    return value"], __file__, __name__, space)


_changed_log = _sum_of("_changed_log", [m for m in IN_PLANT if m.acts_on == FRICTION and m.courses])
_changed_torque = _sum_of("_changed_torque", [m for m in IN_PLANT if m.acts_on == TORQUE])
# what an empirical term depends on, by its code
_covariate = kernel_from_source(
    "_covariate",
    [
        "def _covariate(state, axle, place_m, code):",
        f"    return ({', '.join(c.of_plant for c in COVARIATES if c.word)})[code - 1]",
    ],
    __file__,
    __name__,
    {},
)


@kernel
def friction_factor(state, axle, place_m, effects, clean):
    """What the degraded friction of an axle is multiplied by, or that of the clean rail [X1]."""
    log_mu = _changed_log(0.0, state, axle, place_m, state.brake_torque[axle], effects, clean)
    v = effects.values[_EMPIRICAL:]
    if v[2] > 0.0:
        x = _covariate(state, axle, place_m, int(v[2]))
        log_mu += friction.empirical(x, v[0], v[1], v[3], v[4], v[5])
    return math.exp(log_mu)


@kernel
def torque(capacity_Nm, state, axle, place_m, effects):
    """Brake torque in N m of an axle whose brake would give `capacity_Nm` [X2]."""
    if capacity_Nm <= 0.0:
        return capacity_Nm
    return max(0.0, _changed_torque(capacity_Nm, state, axle, place_m, capacity_Nm, effects, False))


@kernel
def remember(state, positions_m, tick_s):
    """Advance sliding distance, angle turned under the brake and the work of the wheels before, by a tick."""
    before = 0.0
    for j in range(AXLES):
        state.sliding_distance[j] += tick_s * abs(state.sliding[j])
        if state.brake_capacity[j] > 0.0:
            state.braked_angle[j] += tick_s * state.wheel_speed[j]
        if j > 0:
            length = positions_m[j] - positions_m[j - 1]
            share = -math.expm1(-state.vehicle_speed[0] * tick_s / length)
            state.rail_work[j] += (before - state.rail_work[j]) * share
        before += max(state.dissipated_energy[j], 0.0)
