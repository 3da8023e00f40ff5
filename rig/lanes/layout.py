"""Several rigs in the vector lanes of a core: the layout of the array that a step works on.

A campaign needs many stops and does not need them in real time. Therefore the axles of several rigs
are computed together. They are the lanes of one array, in which each quantity is a row with one
number for each lane. The arithmetic of `brake`, `motor` and `wheelset` runs along the rows, which
the compiler turns into vector instructions. The state of a rig is scattered into its lanes before a
tick with a sample, a cycle of its unit or another change, and gathered from them after the tick
before the next such one. The ticks in between are `quiet_tick`s, which know only the lanes.

The equations are those of brake [B1] to [B4], motor [M1], wheelset [W1] to [W4], adhesion [A1] to
[A6], vehicle [V1] to [V3] and heat [H1], [H2], written without branches. Results agree with
`plant.advance` to rounding, not to the last bit. A test compares every kernel with its counterpart
in the plant.

Limits (`fits`): planar vehicle, one plant, degraded adhesion without memory, round wheels, brake
torque without effects, pads without variation, no limit of the air supply, no flats, no sand,
rollers that stay as they were prepared, no dynamic brake and no magnets.
"""

import math
from typing import NamedTuple

from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.rig.brake import NORMAL_PRESSURE_PA
from rollerrig.rig.compiled.generated import tuple_builder, tuple_writer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.mechanisms import applied
from rollerrig.rig.mechanisms.mechanism import ALONE
from rollerrig.rig.params import ROLLERS, TRACK, Params
from rollerrig.rig.vehicle import INERTIA_KGM2, RADIUS_M

# The rigs that are computed together have the same number of axles. They are as many as fit into
# LANES_WANTED, at least two. With fewer lanes the latency of divisions is not hidden, with more the
# rows leave the nearest cache.
LANES_WANTED = 16
# places for lanes in a row
LANES = 2 * MOST_AXLES


def rigs_of(axles: int) -> int:
    """Return the number of rigs with so many axles that are computed together."""
    return max(2, LANES_WANTED // axles)


# Rows of the array, in SI units; each name is the place of the first lane of its row.
(
    # the state of an axle
    WHEEL,  # rad/s
    ROLLER,  # rad/s
    WHEEL_RAD,
    ROLLER_RAD,
    PRESSURE,  # of the cylinder
    VALVE,  # FILL, HOLD or VENT
    CAPACITY,  # largest brake torque at the beginning of the step
    BRAKE,  # largest brake torque at the end of the step
    BRAKE_WORK,
    SLIDING_WORK,
    MOTOR,  # torque of the roller's motor
    MOTOR_DEMAND,
    MOTOR_BEFORE,  # torque of the motor at the beginning of the step
    MOTOR_WORK,
    FORCE,  # mean of the contact in the step
    BRAKE_MEAN,  # mean torque of the brake in the step
    AIR_NL,  # normal litres in this tick
    AIR_SUM_NL,  # of all axles so far; only the first lane of a rig is used
    OBSERVER,  # of the rig control, N m
    DISC_K,  # temperatures
    MOTOR_K,
    HEATED_J,  # work of the brake up to the last tick
    LOCKED_S,  # length of the present lock
    LONGEST_S,  # longest lock
    ENERGY,  # of one wheel, J/m, at the end of the last tick; only where the rail is cleaned
    RAIL_WORK,  # of the wheels in front on a metre of rail, J/m
    # the state of its vehicle, the same in all its lanes
    V,
    FELT,  # lagged acceleration, which the pitch of the vehicle and the loads follow
    RATE,  # acceleration
    PLACE,
    RESISTANCE_WORK,
    DEMAND,  # pressure of the brake demand
    TARGET,  # pressure that the demand approaches
    MOVING,  # 1, or 0 at standstill
    # values within a step; ..._END: as predicted for the end of the step, ..._K: rate of change
    SLIDING,
    SURFACE,  # speed of the rail's or roller's surface
    LOAD,
    SLOPE,  # secant slope of the contact force, T / s
    INSIDE,  # 1 where `vector_law` is valid, else 0
    CLEANING,  # k of [A5]: tau W_sp for f = 1
    SOLVED,  # the last solution y = tau W_sp of [A5]
    CHANGE,  # change of SOLVED in the last solution
    CHANGE_BEFORE,  # change of SOLVED in the solution before; the next one begins with it
    WHEEL_K,
    ROLLER_K,
    PULL,  # contact force
    PULL_BEFORE,  # of the first stage
    BRAKE_BEFORE,  # torque of the brake in the first stage
    WHEEL_END,
    ROLLER_END,
    V_END,
    FELT_END,
    RATE_BEFORE,  # acceleration of the first stage
    FELT_RATE,
    RESISTING,  # half of the resistance at the beginning of the step
    # constants
    STEP,  # s
    ON_TRACK,  # 1 on a track, 0 on rollers
    WHEEL_M,  # radius
    PER_WHEEL_KGM2,  # 1 / inertia
    ROLLER_M,
    PER_ROLLER_KGM2,
    STATIC_N,
    TRANSFER_KG,  # change of the load with the deceleration
    TORQUE_PER_PA,
    SPRING_PA,  # pressure of the cylinder's spring
    NL_PER_PA,
    FILLS,  # shares of the way in a step: demand up and down, valve filling and venting
    RELEASES,
    VALVE_FILLS,
    VALVE_VENTS,
    MOTOR_MOST,  # largest torque
    MOTOR_W,  # largest power
    MOTOR_FASTEST,  # speed above which the motor does not drive
    MOTOR_SHARE,  # share of the way to its demand in a step
    EPS1,  # of `patch.Patch`
    DECAY_D,  # 1 / A - 1 of the degraded and of the recovered friction
    DECAY_R,
    TICK,  # s
    ROLLER_KGM2,
    SPEED_LOOP,  # of the rig control, rad/s
    OBSERVER_LOOP,  # rad/s
    AIR_K,
    DISC_J_K,
    DISC_SHARE,  # share of the cooling in a tick
    RATED_NM,  # torque of the motor
    MOTOR_RISE_K,
    MOTOR_HEAT_SHARE,
    LOCK_ABOVE,  # speed of the vehicle above which a lock counts
    MASS_KG,
    PITCH_S,  # time constant of the pitch
    RESISTANCE_A,
    RESISTANCE_B,
    RESISTANCE_C,
    CLEANING_GAIN,  # of the mechanism `rail_cleaning`; 0: the wheels do not clean the rail
    CLEANING_J_M,
    CONTAMINANT_ALONE,  # 1: the clean rail keeps its friction
    AHEAD_M,  # distance of the axle in front; infinite for the first one
    BASE_CD,  # friction of the contaminant on a rail that no wheel has cleaned
    BASE_CR,
    _LAW,
) = range(0, 100 * LANES, LANES)
# the adhesion law: one row for each field of `Law`, in its order
_LAW_ROWS = {name: _LAW + LANES * i for i, name in enumerate(Law._fields)}
# friction of the contaminant: the state has it, not the constants
MU_CD = _LAW_ROWS["mu_cd"]
MU_CR = _LAW_ROWS["mu_cr"]
SIZE = _LAW + LANES * len(Law._fields)

# places in `Effects.values`
_GAIN = applied.PLACE["rail_cleaning_gain"]
_ENERGY_J_M = applied.PLACE["rail_cleaning_energy_J_m"]
_ALONE = applied.PLACE[f"rail_cleaning_{ALONE.name}"]

# kernels: the adhesion law of a lane, and its writer
law_of_lane = tuple_builder(Law, "w, lane", (f"w[{row} + lane]" for row in _LAW_ROWS.values()))
_write_law = tuple_writer("w, lane", [f"w[{row} + lane]" for row in _LAW_ROWS.values()])


class Resisted(NamedTuple):
    """The fields of `params.Vehicle` that its running resistance needs."""

    resistance_A_N: float
    resistance_B_N_s_m: float
    resistance_C_N_s2_m2: float


# kernel: the running resistance of the vehicle of a lane
resisted = tuple_builder(
    Resisted,
    "w, lane",
    (f"w[{row} + lane]" for row in (RESISTANCE_A, RESISTANCE_B, RESISTANCE_C)),
)


def fits(params: Params) -> bool:
    """Return whether rigs with these parameters may run in lanes."""
    return (
        params.coach is None
        and params.patch.model is None
        and params.mode in (TRACK, ROLLERS)
        and not params.effects.on_torque
        and not params.wheels.swings
        and params.effects.memory_m == 0.0
        and params.brake.air.reservoir_L == 0.0
        and not params.pads.vary
        and params.flats.wear_m3_J == 0.0
        and params.sanders.axles == 0
        and not params.dynamic.acts
        and not params.track_brake.acts
        and not params.film.acts
    )


@kernel
def load_constants(w, rig, params):
    """Write the constants of a rig, counted from 0, into its lanes."""
    vehicle = params.vehicle
    brake = params.brake
    drive = params.drive
    heat = params.heat
    for j in range(params.axles):
        at = rig * params.axles + j

        w[STEP + at] = params.step_s
        w[ON_TRACK + at] = 1.0 if params.mode == TRACK else 0.0
        w[WHEEL_M + at] = params.wheels.table[RADIUS_M, j]
        w[PER_WHEEL_KGM2 + at] = 1.0 / params.wheels.table[INERTIA_KGM2, j]
        w[ROLLER_M + at] = drive.roller_radius_m
        w[PER_ROLLER_KGM2 + at] = 1.0 / drive.roller_inertia_kgm2

        # load transfer: from the rear to the front bogie, from the rear to the front axle of each
        w[STATIC_N + at] = vehicle.static_load_N
        w[TRANSFER_KG + at] = vehicle.transfer_kg[j]

        w[TORQUE_PER_PA + at] = brake.torque_Nm_Pa
        w[SPRING_PA + at] = brake.spring_pressure_Pa
        w[NL_PER_PA + at] = brake.volume_L / NORMAL_PRESSURE_PA
        w[FILLS + at] = brake.demand_fill_share
        w[RELEASES + at] = brake.demand_release_share
        w[VALVE_FILLS + at] = brake.valve_fill_share
        w[VALVE_VENTS + at] = brake.valve_vent_share

        w[MOTOR_MOST + at] = drive.max_torque_Nm
        w[MOTOR_W + at] = drive.max_power_W
        w[MOTOR_FASTEST + at] = drive.max_speed_rad_s
        w[MOTOR_SHARE + at] = drive.torque_share

        w[EPS1 + at] = params.patch.eps1
        w[DECAY_D + at] = 1.0 / params.law.A_d - 1.0
        w[DECAY_R + at] = 1.0 / params.law.A_r - 1.0

        w[TICK + at] = params.tick_s
        w[ROLLER_KGM2 + at] = drive.roller_inertia_kgm2
        w[SPEED_LOOP + at] = drive.speed_loop_rad_s
        w[OBSERVER_LOOP + at] = drive.observer_rad_s
        w[AIR_K + at] = heat.air_K
        w[DISC_J_K + at] = heat.disc_J_K
        w[DISC_SHARE + at] = heat.disc_share
        w[RATED_NM + at] = heat.rated_torque_Nm
        w[MOTOR_RISE_K + at] = heat.motor_rise_K
        w[MOTOR_HEAT_SHARE + at] = heat.motor_share
        w[LOCK_ABOVE + at] = params.lock_above_m_s

        w[MASS_KG + at] = vehicle.mass_kg
        w[PITCH_S + at] = vehicle.pitch_time_constant_s
        w[RESISTANCE_A + at] = vehicle.resistance_A_N
        w[RESISTANCE_B + at] = vehicle.resistance_B_N_s_m
        w[RESISTANCE_C + at] = vehicle.resistance_C_N_s2_m2

        w[CLEANING_GAIN + at] = params.effects.values[_GAIN]
        w[CLEANING_J_M + at] = params.effects.values[_ENERGY_J_M]
        w[CONTAMINANT_ALONE + at] = params.effects.values[_ALONE]
        w[AHEAD_M + at] = math.inf
        if j > 0:
            w[AHEAD_M + at] = params.axle_position_m[j] - params.axle_position_m[j - 1]
        w[BASE_CD + at] = params.law.mu_cd
        w[BASE_CR + at] = params.law.mu_cr
        _write_law(w, at, params.law)

        # a result must not depend on the stop that had this place before
        w[SOLVED + at] = 0.0
        w[CHANGE + at] = 0.0
        w[CHANGE_BEFORE + at] = 0.0


@kernel_inlined
def scatter(w, rig, state, target_Pa):
    """Write the state of a rig into its lanes; target_Pa is the demanded brake pressure."""
    for j in range(state.axles):
        at = rig * state.axles + j
        w[WHEEL + at] = state.wheel_speed[j]
        w[ROLLER + at] = state.roller_speed[j]
        w[WHEEL_RAD + at] = state.wheel_angle[j]
        w[ROLLER_RAD + at] = state.roller_angle[j]
        w[PRESSURE + at] = state.cylinder_pressure[j]
        w[VALVE + at] = state.valve[j]
        w[MU_CD + at] = state.friction_degraded[j]
        w[MU_CR + at] = state.friction_recovered[j]
        w[CAPACITY + at] = state.brake_capacity[j]
        w[BRAKE + at] = state.brake_torque[j]
        w[BRAKE_WORK + at] = state.brake_work[j]
        w[SLIDING_WORK + at] = state.sliding_work[j]
        w[MOTOR + at] = state.motor_torque[j]
        w[MOTOR_DEMAND + at] = state.motor_torque_demand[j]
        w[MOTOR_BEFORE + at] = state.motor_before[j]
        w[MOTOR_WORK + at] = state.motor_work[j]
        w[FORCE + at] = state.contact_force[j]
        w[BRAKE_MEAN + at] = state.brake_mean[j]
        w[OBSERVER + at] = state.observer[j]
        w[DISC_K + at] = state.disc_temperature[j]
        w[MOTOR_K + at] = state.motor_temperature[j]
        w[HEATED_J + at] = state.brake_work_before[j]
        w[LOCKED_S + at] = state.locked_since[j]
        w[LONGEST_S + at] = state.longest_lock[j]
        w[RAIL_WORK + at] = state.rail_work[j]

        # the quantities of the vehicle, the same in all its lanes
        w[V + at] = state.vehicle_speed[0]
        w[FELT + at] = state.felt_acceleration[0]
        w[RATE + at] = state.vehicle_acceleration[0]
        w[PLACE + at] = state.position[0]
        w[RESISTANCE_WORK + at] = state.resistance_work[0]
        w[DEMAND + at] = state.brake_demand[0]
        w[TARGET + at] = target_Pa
        w[MOVING + at] = 1.0 - state.standing[0]
        w[AIR_NL + at] = 0.0
        w[AIR_SUM_NL + at] = state.air_consumption[0]


@kernel_inlined
def gather(w, rig, state):
    """Write the lanes of a rig into its state."""
    for j in range(state.axles):
        at = rig * state.axles + j
        state.wheel_speed[j] = w[WHEEL + at]
        state.roller_speed[j] = w[ROLLER + at]
        state.wheel_angle[j] = w[WHEEL_RAD + at]
        state.roller_angle[j] = w[ROLLER_RAD + at]
        state.cylinder_pressure[j] = w[PRESSURE + at]
        state.brake_capacity[j] = w[CAPACITY + at]
        state.brake_torque[j] = w[BRAKE + at]
        state.brake_work[j] = w[BRAKE_WORK + at]
        state.sliding_work[j] = w[SLIDING_WORK + at]
        state.motor_torque[j] = w[MOTOR + at]
        state.motor_before[j] = w[MOTOR_BEFORE + at]
        state.motor_work[j] = w[MOTOR_WORK + at]
        state.contact_force[j] = w[FORCE + at]
        state.brake_mean[j] = w[BRAKE_MEAN + at]
        state.motor_torque_demand[j] = w[MOTOR_DEMAND + at]
        state.observer[j] = w[OBSERVER + at]
        state.disc_temperature[j] = w[DISC_K + at]
        state.motor_temperature[j] = w[MOTOR_K + at]
        state.brake_work_before[j] = w[HEATED_J + at]
        state.locked_since[j] = w[LOCKED_S + at]
        state.longest_lock[j] = w[LONGEST_S + at]
        state.rail_work[j] = w[RAIL_WORK + at]
        state.friction_degraded[j] = w[MU_CD + at]
        state.friction_recovered[j] = w[MU_CR + at]

    # the quantities of the vehicle are the same in all its lanes; the first one is read
    at = rig * state.axles
    state.air_consumption[0] = air_NL(w, at, state.axles)
    state.vehicle_speed[0] = w[V + at]
    state.felt_acceleration[0] = w[FELT + at]
    state.vehicle_acceleration[0] = w[RATE + at]
    state.position[0] = w[PLACE + at]
    state.resistance_work[0] = w[RESISTANCE_WORK + at]
    state.brake_demand[0] = w[DEMAND + at]
    state.standing[0] = 1.0 - w[MOVING + at]


@kernel_inlined
def air_NL(w, first, axles):
    """Return the air that a rig has used so far, with that of the present tick.

    `first` is its first lane.
    """
    total_NL = w[AIR_SUM_NL + first]
    for j in range(first, first + axles):
        total_NL += w[AIR_NL + j]
    return total_NL
