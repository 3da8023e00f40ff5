"""The mechanisms of an extended model inside the plant: friction under a wheel, torque at a brake.

Effects that depend on time, place, speed or past work are computed here in each tick, by the
courses of the table. The memory of adhesion and the load on a wheel out of round are computed in
each step of `wheelset`. Constants of the model are changed once, where the parameters are built.
While all coefficients are 0 nothing is computed and no bit changes.

The work on a metre of rail reaches the next wheel after the distance between them, as a first-order
lag of that length: an approximation of the pure delay. For a train the field along the rail
replaces it (`train_rail`).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES_OF_BOGIE, wheelsets_of
from rollerrig.rig.compiled.generated import Term, conditional_sum, selection
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

# the place of each key of the section [mechanisms] in `Effects.values`
PLACE = {row.name: i for i, row in enumerate(rows())}
_LINEAR = PLACE["empirical_linear"]
_QUADRATIC = PLACE["empirical_quadratic"]
_COVARIATE = PLACE["empirical_covariate"]
_CENTRE = PLACE["empirical_centre"]
_SCALE = PLACE["empirical_scale"]
_PERIOD = PLACE["empirical_period"]


class Effects(NamedTuple):
    """The parts of an extended model that a tick and a step read."""

    on_friction: bool
    on_torque: bool
    values: np.ndarray  # the whole section [mechanisms], in the order of `table.rows`
    memory_m: float  # distance over which recovery lags at 20 m/s, 0: it does not lag
    memory_power: float
    memory_of_work: float


class Wheels(NamedTuple):
    """The wheels of each axle.

    `table` (4, axles) has the rows of `vehicle`: radius, inertia, radius over inertia, amplitude
    out of round.
    """

    table: np.ndarray
    swings: bool
    swing_phase_rad: float


def build(m: Mapping[str, Any]) -> Effects:
    """Return the effects of the checked section [mechanisms]."""
    acts_on = set()
    for mechanism in IN_PLANT:
        if any(m[key] != 0.0 for key in mechanism.coefficients):
            acts_on.add(mechanism.acts_on)
    return Effects(
        on_friction=FRICTION in acts_on,
        on_torque=TORQUE in acts_on,
        values=np.array([m[key] for key in PLACE]),
        memory_m=m["adhesion_memory_length_m"],
        memory_power=m["adhesion_memory_speed_power"],
        memory_of_work=m["adhesion_memory_of_work"],
    )


def extended(model: Mapping[str, Any], m: Mapping[str, Any]) -> dict[str, Any]:
    """Return the model's constants with the changes of [mechanisms] that hold for all axles."""
    changed = dict(model)
    for mechanism in IN_PLANT:
        has_constants = changed.keys() >= set(mechanism.changes)
        on_all_axles = m.get(f"{mechanism.name}_axle", 0.0) == 0.0
        if mechanism.constants and has_constants and on_all_axles:
            values = [m[f"{mechanism.name}_{row.name}"] for row in mechanism.formula_parameters]
            changed.update(mechanism.constants(changed, *values))
    return changed


def wheels(
    vehicle: Mapping[str, Any], m: Mapping[str, Any], rotors_kgm2: np.ndarray | float = 0.0
) -> Wheels:
    """Return the wheels of the checked sections [vehicle] (radius, inertia) and [mechanisms].

    `rotors_kgm2` are the inertias of the motors on the wheelsets, shape (axles,).
    """
    axles = vehicle["axles"]
    swing = _of_axles(m, axles, "wheel_out_of_round", "wheel_out_of_round_amplitude")
    radius_fraction = _of_axles(m, axles, "wheel_radius", "wheel_radius_fraction")
    inertia_fraction = _of_axles(m, axles, "wheel_inertia", "wheel_inertia_fraction")
    radius_m = constants.wheel_radius(vehicle, radius_fraction)["wheel_radius_m"]
    inertia_kgm2 = constants.wheel_inertia(vehicle, inertia_fraction)["wheelset_inertia_kgm2"]
    inertia_kgm2 = inertia_kgm2 + rotors_kgm2
    return Wheels(
        table=np.array([radius_m, inertia_kgm2, radius_m / inertia_kgm2, swing]),
        swings=bool(swing.any()),
        swing_phase_rad=m["wheel_out_of_round_phase_rad"],
    )


def _of_axles(m: Mapping[str, Any], axles: int, name: str, key: str) -> np.ndarray:
    """Return the value of a key on each axle, shape (axles,); 0 on one without the mechanism."""
    values = np.zeros(axles)
    for axle in wheelsets_of(int(m[f"{name}_axle"]), axles):
        values[axle - 1] = m[key]
    return values


# arguments of the generated kernels behind the value, as in `mechanism.Covariate.of_plant`
_ARGUMENTS = "state, axle, place_m, capacity_Nm, values, clean"


def _term(mechanism: Mechanism) -> Term:
    """Return what a mechanism adds to ln mu or to the torque, as source text.

    For example, with the places of the two parameters of rail_cleaning:
    if values[3] != 0.0: value += values[3] * rail_cleaning(state.rail_work[axle], values[4])
    """
    size = f"values[{PLACE[mechanism.coefficients[0]]}]"
    shape = [
        f"values[{PLACE[f'{mechanism.name}_{row.name}']}]"
        for row in mechanism.formula_parameters[mechanism.free :]
    ]
    in_plant = {covariate.name: covariate.of_plant for covariate in COVARIATES}
    covariates = [in_plant[name] for name in arguments(mechanism.courses[0], len(shape))]
    course = f"{mechanism.name}({', '.join([*covariates, *shape])})"

    condition = f"{size} != 0.0"
    if mechanism.acts_on == FRICTION:
        # on the clean rail, unless the mechanism acts on the contaminant alone
        alone = f"values[{PLACE[f'{mechanism.name}_{ALONE.name}']}]"
        condition += f" and not (clean and {alone} != 0.0)"
    elif mechanism.axlewise:
        # all wheelsets, this one, or those of its bogie
        place = f"values[{PLACE[f'{mechanism.name}_axle']}]"
        bogie = f"-1.0 - axle // {AXLES_OF_BOGIE}"
        condition += f" and {place} in (0.0, axle + 1.0, {bogie})"
    increment = f"{size} * {course}"
    if mechanism.share:
        increment = f"value * {increment}"
    return Term(condition, increment)


def _sum_of(name: str, mechanisms: Sequence[Mechanism]) -> Any:
    """Return a kernel that adds the effects of mechanisms to a value, one after another."""
    terms = [_term(mechanism) for mechanism in mechanisms]
    functions = {mechanism.name: mechanism.courses[0] for mechanism in mechanisms}
    return conditional_sum(name, _ARGUMENTS, terms, functions)


_changed_ln_friction = _sum_of(
    "changed_ln_friction", [m for m in IN_PLANT if m.acts_on == FRICTION and m.courses]
)
_changed_torque = _sum_of("changed_torque", [m for m in IN_PLANT if m.acts_on == TORQUE])
# the covariate of an empirical term, by its number
_covariate = selection(
    "empirical_covariate",
    "state, axle, place_m",
    [covariate.of_plant for covariate in COVARIATES if covariate.word],
)


@kernel
def friction_factor(state, axle, place_m, effects, clean):
    """Return the factor of the degraded friction of an axle, or of that of the clean rail [X1]."""
    values = effects.values
    ln_mu = _changed_ln_friction(0.0, state, axle, place_m, state.brake_torque[axle], values, clean)
    if values[_COVARIATE] > 0.0:
        # the code of a covariate counts from 1
        x = _covariate(state, axle, place_m, int(values[_COVARIATE]) - 1)
        ln_mu += friction.empirical(
            x,
            values[_LINEAR],
            values[_QUADRATIC],
            values[_CENTRE],
            values[_SCALE],
            values[_PERIOD],
        )
    return math.exp(ln_mu) if ln_mu != 0.0 else 1.0


@kernel
def torque(capacity_Nm, state, axle, place_m, effects):
    """Return the torque in N m of an axle whose brake would otherwise give `capacity_Nm` [X2]."""
    if capacity_Nm <= 0.0:
        return capacity_Nm
    changed_Nm = _changed_torque(
        capacity_Nm, state, axle, place_m, capacity_Nm, effects.values, False
    )
    return max(0.0, changed_Nm)


@kernel
def remember(state, positions_m, tick_s):
    """Advance sliding distance, angle turned under the brake and work of the wheels in front."""
    work_J_m = 0.0
    for j in range(state.axles):
        state.sliding_distance[j] += tick_s * abs(state.sliding[j])
        if state.brake_capacity[j] > 0.0:
            state.braked_angle[j] += tick_s * state.wheel_speed[j]
        if j > 0 and state.has_train_rail[0] == 0.0:
            length_m = positions_m[j] - positions_m[j - 1]
            share = -math.expm1(-state.vehicle_speed[0] * tick_s / length_m)
            state.rail_work[j] += (work_J_m - state.rail_work[j]) * share
        work_J_m += max(state.dissipated_energy[j], 0.0)
