"""Several rigs abreast: the steps of one tick, computed for four stops at a time.

A campaign wants many stops and no single one soon. The axles of four rigs then stand side by side
in the lanes of one array, each quantity a row of sixteen, and the arithmetic of `brake`, `motor` and
`wheelset` runs along the rows, which a compiler turns into vector instructions. The state of a rig is
scattered into its lanes before a tick and gathered after it, so all else stays the plant's own code.

The equations are those of brake [B1] to [B4], motor [M1], wheelset [W1] to [W4], adhesion [A1] to
[A6] and vehicle [V1] to [V3], written without branches. Limits: planar vehicle, one plant, degraded
adhesion without memory, round wheels, torque as the discs give it, pads that do not vary, air that never runs
out, no flats, no sand, rollers that stay as they were prepared (`fits` tells). Results agree with `plant.advance`
to rounding, not to the last bit: a test holds every kernel to its twin in the plant.
"""

from rollerrig.rig.brake import NORMAL_PRESSURE_PA
from rollerrig.rig.compiled.generated import tuple_builder, tuple_writer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import creep_force
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.params import ROLLERS, TRACK, Params
from rollerrig.rig.state import AXLES
from rollerrig.rig.vehicle import INERTIA_KGM2, RADIUS_M

RIGS = 4
LANES = RIGS * AXLES

# rows of the lanes, SI: the state of an axle ...
(
    WHEEL,
    ROLLER,
    WHEEL_RAD,
    ROLLER_RAD,
    PRESSURE,
    VALVE,
    CAPACITY,
    BRAKE,
    BRAKE_WORK,
    SLIDING_WORK,
    MOTOR,
    MOTOR_ASKED,
    MOTOR_BEFORE,
    MOTOR_WORK,
    FORCE,
    BRAKE_MEAN,
    AIR_NL,
    # ... of its vehicle, the same in all four lanes ...
    V,
    FELT,
    RATE,
    PLACE,
    RESISTANCE_WORK,
    DEMAND,
    TARGET,
    MOVING,
    # ... what a step works with ...
    SLIDING,
    SURFACE,
    LOAD,
    SLOPE,
    INSIDE,
    WHEEL_K,
    ROLLER_K,
    PULL,
    PULL_BEFORE,
    BRAKE_BEFORE,
    WHEEL_END,
    ROLLER_END,
    V_END,
    FELT_END,
    RATE_BEFORE,
    FELT_RATE,
    RESISTING,
    # ... and constants
    STEP,
    ON_TRACK,
    WHEEL_M,
    WHEEL_KGM2,
    ROLLER_M,
    ROLLER_KGM2,
    STATIC_N,
    TRANSFER_KG,
    TORQUE_PER_PA,
    SPRING_PA,
    NL_PER_PA,
    FILLS,
    RELEASES,
    VALVE_FILLS,
    VALVE_VENTS,
    MOTOR_MOST,
    MOTOR_W,
    MOTOR_FASTEST,
    MOTOR_SHARE,
    EPS1,
    _LAW,
) = range(0, 63 * LANES, LANES)
# ... among them the adhesion law: one row for each field of `Law`, in its order, from row _LAW on
_LAW_ROWS = {name: _LAW + LANES * i for i, name in enumerate(Law._fields)}
MU_CD, MU_CR = _LAW_ROWS["mu_cd"], _LAW_ROWS["mu_cr"]  # of the contaminant, from the state
SIZE = _LAW + LANES * len(Law._fields)

# kernels: the adhesion law of a lane, and its writer
law_of_lane = tuple_builder(Law, "w, lane", (f"w[{row} + lane]" for row in _LAW_ROWS.values()))
_write_law = tuple_writer("w, lane", [f"w[{row} + lane]" for row in _LAW_ROWS.values()])


def fits(params: Params) -> bool:
    """Whether rigs with these parameters may run abreast."""
    return (
        params.coach is None
        and params.patch.model == creep_force.DEGRADED
        and params.mode in (TRACK, ROLLERS)
        and not params.effects.on_torque
        and not params.wheels.swings
        and params.effects.memory_m == 0.0
        and params.brake.air.reservoir_L == 0.0
        and not params.pads.vary
        and params.flats.wear_m3_J == 0.0
        and params.sanders.axles == 0
        and not params.film.acts
    )


@kernel
def load_constants(w, rig, params):
    """Write the constants of a rig (0 to 3) into its lanes."""
    vehicle, brake, drive = params.vehicle, params.brake, params.drive
    wheels = params.wheels
    for j in range(AXLES):
        at = rig * AXLES + j
        w[STEP + at], w[ON_TRACK + at] = params.step_s, (1.0 if params.mode == 0 else 0.0)
        w[WHEEL_M + at], w[WHEEL_KGM2 + at] = (
            wheels.table[RADIUS_M + j],
            wheels.table[INERTIA_KGM2 + j],
        )
        w[ROLLER_M + at], w[ROLLER_KGM2 + at] = drive.roller_radius_m, drive.roller_inertia_kgm2
        w[STATIC_N + at] = vehicle.static_load_N
        w[TRANSFER_KG + at] = (0.5 if j < 2 else -0.5) * vehicle.body_transfer_kg + (
            1.0 if j % 2 == 0 else -1.0
        ) * vehicle.bogie_transfer_kg
        w[TORQUE_PER_PA + at], w[SPRING_PA + at] = brake.torque_Nm_Pa, brake.spring_pressure_Pa
        w[NL_PER_PA + at] = brake.volume_L / NORMAL_PRESSURE_PA
        w[FILLS + at], w[RELEASES + at] = brake.demand_fill_share, brake.demand_release_share
        w[VALVE_FILLS + at], w[VALVE_VENTS + at] = brake.valve_fill_share, brake.valve_vent_share
        w[MOTOR_MOST + at], w[MOTOR_W + at] = drive.max_torque_Nm, drive.max_power_W
        w[MOTOR_FASTEST + at], w[MOTOR_SHARE + at] = drive.max_speed_rad_s, drive.torque_share
        w[EPS1 + at] = params.patch.eps1
        _write_law(w, at, params.law)


@kernel_inlined
def scatter(w, rig, state, target_Pa):
    """Write the state of a rig into its lanes."""
    for j in range(AXLES):
        at = rig * AXLES + j
        w[WHEEL + at], w[ROLLER + at] = state.wheel_speed[j], state.roller_speed[j]
        w[WHEEL_RAD + at], w[ROLLER_RAD + at] = state.wheel_angle[j], state.roller_angle[j]
        w[PRESSURE + at], w[VALVE + at] = state.cylinder_pressure[j], state.valve[j]
        w[MU_CD + at], w[MU_CR + at] = state.friction_degraded[j], state.friction_recovered[j]
        w[CAPACITY + at], w[BRAKE + at] = state.brake_capacity[j], state.brake_torque[j]
        w[BRAKE_WORK + at], w[SLIDING_WORK + at] = state.brake_work[j], state.sliding_work[j]
        w[MOTOR + at], w[MOTOR_ASKED + at] = state.motor_torque[j], state.motor_torque_demand[j]
        w[MOTOR_BEFORE + at], w[MOTOR_WORK + at] = state.motor_before[j], state.motor_work[j]
        w[FORCE + at], w[BRAKE_MEAN + at] = state.contact_force[j], state.brake_mean[j]
        w[V + at], w[FELT + at] = state.vehicle_speed[0], state.felt_acceleration[0]
        w[RATE + at], w[PLACE + at] = state.vehicle_acceleration[0], state.position[0]
        w[RESISTANCE_WORK + at], w[DEMAND + at] = state.resistance_work[0], state.brake_demand[0]
        w[TARGET + at], w[MOVING + at] = target_Pa, 1.0 - state.standing[0]
        w[AIR_NL + at] = 0.0


@kernel_inlined
def gather(w, rig, state):
    """Write the lanes of a rig into its state."""
    for j in range(AXLES):
        at = rig * AXLES + j
        state.wheel_speed[j], state.roller_speed[j] = w[WHEEL + at], w[ROLLER + at]
        state.wheel_angle[j], state.roller_angle[j] = w[WHEEL_RAD + at], w[ROLLER_RAD + at]
        state.cylinder_pressure[j] = w[PRESSURE + at]
        state.brake_capacity[j], state.brake_torque[j] = w[CAPACITY + at], w[BRAKE + at]
        state.brake_work[j], state.sliding_work[j] = w[BRAKE_WORK + at], w[SLIDING_WORK + at]
        state.motor_torque[j], state.motor_before[j] = w[MOTOR + at], w[MOTOR_BEFORE + at]
        state.motor_work[j] = w[MOTOR_WORK + at]
        state.contact_force[j], state.brake_mean[j] = w[FORCE + at], w[BRAKE_MEAN + at]
        state.air_consumption[0] += w[AIR_NL + at]
    at = rig * AXLES
    state.vehicle_speed[0], state.felt_acceleration[0] = w[V + at], w[FELT + at]
    state.vehicle_acceleration[0], state.position[0] = w[RATE + at], w[PLACE + at]
    state.resistance_work[0], state.brake_demand[0] = w[RESISTANCE_WORK + at], w[DEMAND + at]
    state.standing[0] = 1.0 - w[MOVING + at]
