"""The coach as the vehicle of the plant, in the place of the planar `vehicle` and `wheelset`.

Every function takes the coach as its last argument and does nothing where it is None: the compiled
code of the planar model is then the same as without a coach. The state of the plant remains the one
that is observed and recorded. The memory of the coach is `state.coach`, its constants are
`params.coach`.
"""

from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.multibody import coach_state, compiled_coach
from rollerrig.rig.multibody.coordinates import BEFORE_WHEELSETS, PER_BODY, PITCH
from rollerrig.rig.multibody.wheel_rail_forces import (
    BRAKING_N,
    LOAD,
    SLIP,
    TOUCHING,
    WHEEL_COLUMNS,
    WHEELSET_COLUMNS,
)

# places in the memory of the coach
_WHEEL_FORCES = coach_state.BEGIN["wheel_forces"]
_WHEELSET_FORCES = coach_state.BEGIN["wheelset_forces"]
_SLIDING_WORK = coach_state.BEGIN["sliding_work"]
_BRAKE_WORK = coach_state.BEGIN["brake_work"]
_RESISTANCE_WORK = coach_state.BEGIN["resistance_work"]
# the pitch rate of the first wheelset; the others follow at intervals of PER_BODY
_WHEEL_SPEED = coach_state.BEGIN["v"] + BEFORE_WHEELSETS + PITCH


@kernel
def start(state, coach):
    """Set the coach rolling at the vehicle speed of the plant, the wheels without sliding."""
    memory = state.coach
    memory[coach_state.ACTION] = compiled_coach.START
    memory[coach_state.SPEED_M_S] = state.vehicle_speed[0]
    compiled_coach.run(memory, coach.tape, coach.layout)
    for j in range(COACH_AXLES):
        state.wheel_speed[j] = memory[_WHEEL_SPEED + PER_BODY * j]


@kernel
def integrate(state, params, resistance_N, coach):
    """Advance coach, wheelsets and rollers by one step under this running resistance."""
    h = params.step_s
    memory = state.coach
    v = state.vehicle_speed[0]
    for j in range(COACH_AXLES):
        # the torques are known at both ends of the step; the coach takes their means
        memory[coach_state.MOTOR_NM + j] = 0.5 * (state.motor_before[j] + state.motor_torque[j])
        memory[coach_state.BRAKE_NM + j] = 0.5 * (state.brake_capacity[j] + state.brake_torque[j])
        memory[coach_state.ROLLER_RAD_S + j] = state.roller_speed[j]
    step(state, resistance_N, coach)
    for j in range(COACH_AXLES):
        turned_rad = 0.5 * h * (state.roller_speed[j] + memory[coach_state.ROLLER_RAD_S + j])
        state.roller_speed[j] = memory[coach_state.ROLLER_RAD_S + j]
        state.roller_angle[j] += turned_rad
        state.motor_work[j] += memory[coach_state.MOTOR_NM + j] * turned_rad
        before_rad_s = state.wheel_speed[j]
        state.wheel_speed[j] = max(0.0, memory[_WHEEL_SPEED + PER_BODY * j])
        state.wheel_angle[j] += 0.5 * h * (before_rad_s + state.wheel_speed[j])
        state.sliding_work[j] = memory[_SLIDING_WORK + j]
        state.brake_work[j] = memory[_BRAKE_WORK + j]
        state.contact_force[j] = memory[_WHEELSET_FORCES + WHEELSET_COLUMNS * j + BRAKING_N]
        state.brake_mean[j] = memory[coach_state.BRAKE_ACTS_NM + j]
        state.brake_capacity[j] = state.brake_torque[j]
        state.motor_before[j] = state.motor_torque[j]
    state.resistance_work[0] = memory[_RESISTANCE_WORK]
    state.vehicle_speed[0] = max(0.0, memory[coach_state.SPEED_M_S])
    state.vehicle_acceleration[0] = (state.vehicle_speed[0] - v) / h
    state.position[0] += 0.5 * h * (v + state.vehicle_speed[0])
    # the rollers of a virtual track take their loads from this, as from the planar vehicle
    felt = state.felt_acceleration[0]
    state.felt_acceleration[0] += (state.vehicle_acceleration[0] - felt) * min(
        h / params.vehicle.pitch_time_constant_s, 1.0
    )


@kernel
def rest(state, coach):
    """Let a coach at rest swing out on its springs, with the brakes as they are."""
    for j in range(COACH_AXLES):
        state.coach[coach_state.MOTOR_NM + j] = 0.0
        state.coach[coach_state.BRAKE_NM + j] = state.brake_capacity[j]
        state.coach[coach_state.ROLLER_RAD_S + j] = 0.0
    step(state, 0.0, coach)


@kernel
def step(state, resistance_N, coach):
    """Write the other ports and advance the coach by one step."""
    memory = state.coach
    memory[coach_state.ACTION] = compiled_coach.STEP
    memory[coach_state.RESISTANCE_N] = resistance_N
    for j in range(COACH_AXLES):
        memory[coach_state.MU_CD + j] = state.friction_degraded[j]
        memory[coach_state.MU_CR + j] = state.friction_recovered[j]
    compiled_coach.run(memory, coach.tape, coach.layout)


@kernel
def load(axle, planar_N, state, coach):
    """Return the load in N on a wheelset's contacts, not below 0; planar_N without a coach."""
    if coach is None:
        return planar_N
    left = _WHEEL_FORCES + 2 * WHEEL_COLUMNS * axle + LOAD
    return max(state.coach[left] + state.coach[left + WHEEL_COLUMNS], 0.0)


@kernel
def slip(axle, planar_m_s, state, coach):
    """Return the sliding in m/s of a wheelset's contacts, at the radii on which they roll."""
    if coach is None:
        return planar_m_s
    memory = state.coach
    left = _WHEEL_FORCES + 2 * WHEEL_COLUMNS * axle
    right = left + WHEEL_COLUMNS
    left_N = memory[left + TOUCHING]
    right_N = memory[right + TOUCHING]
    if left_N + right_N <= 0.0:
        return planar_m_s
    return (left_N * memory[left + SLIP] + right_N * memory[right + SLIP]) / (left_N + right_N)


@kernel
def adhesion(axle, planar, load_N, state, coach):
    """Return the adhesion of a wheelset: the braking force of its contacts over their load."""
    if coach is None:
        return planar
    if not load_N > 0.0:
        return 0.0
    return state.coach[_WHEELSET_FORCES + WHEELSET_COLUMNS * axle + BRAKING_N] / load_N
