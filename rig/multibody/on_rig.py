"""The coach as the plant's vehicle: what `vehicle` and `wheelset` are to the planar model.

Every function takes the coach last and is nothing at all where it is None: the planar model then
compiles to what it was. The plant's state stays the one that is seen and recorded; the coach's own
memory stands beside it in `state.coach`, its constants in `params.coach`.
"""

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.multibody import coach_state, compiled_coach
from rollerrig.rig.multibody.wheel_rail_forces import BRAKING_N, GIVEN, LOAD, SEEN, SLIP, TOUCHING

_V, _SEEN, _GIVEN = (coach_state.BEGIN[name] for name in ("v", "seen", "given"))
_SLIDING, _BRAKING, _RESISTING = (
    coach_state.BEGIN[name] for name in ("sliding_work", "brake_work", "resistance_work")
)
_TURNING = _V + 22  # pitch rate of the first wheelset; the others 6 apart


@kernel_inlined
def start(state, coach):
    """Set the coach rolling at the plant's vehicle speed, wheels without sliding on their contacts."""
    own = state.coach
    own[coach_state.ACTION], own[coach_state.SPEED_M_S] = (
        compiled_coach.START,
        state.vehicle_speed[0],
    )
    compiled_coach.run(own, coach.tape, coach.layout)
    for j in range(AXLES):
        state.wheel_speed[j] = own[_TURNING + 6 * j]


@kernel_inlined
def integrate(state, params, resistance_N, coach):
    """Advance coach, wheelsets and rollers by one step, as `wheelset.integrate` does, under this running resistance."""
    h, own = params.step_s, state.coach
    v = state.vehicle_speed[0]
    for j in range(AXLES):
        # torques are given at both ends of the step; the coach wants their means
        own[coach_state.MOTOR_NM + j] = 0.5 * (state.motor_before[j] + state.motor_torque[j])
        own[coach_state.BRAKE_NM + j] = 0.5 * (state.brake_capacity[j] + state.brake_torque[j])
        own[coach_state.ROLLER_RAD_S + j] = state.roller_speed[j]
    step(state, resistance_N, coach)
    for j in range(AXLES):
        turned_rad = 0.5 * h * (state.roller_speed[j] + own[coach_state.ROLLER_RAD_S + j])
        state.roller_speed[j] = own[coach_state.ROLLER_RAD_S + j]
        state.roller_angle[j] += turned_rad
        state.motor_work[j] += own[coach_state.MOTOR_NM + j] * turned_rad
        before = state.wheel_speed[j]
        state.wheel_speed[j] = max(0.0, own[_TURNING + 6 * j])
        state.wheel_angle[j] += 0.5 * h * (before + state.wheel_speed[j])
        state.sliding_work[j], state.brake_work[j] = own[_SLIDING + j], own[_BRAKING + j]
        state.contact_force[j] = own[_GIVEN + GIVEN * j + BRAKING_N]
        state.brake_mean[j] = own[coach_state.BRAKE_ACTS_NM + j]
        state.brake_capacity[j] = state.brake_torque[j]
        state.motor_before[j] = state.motor_torque[j]
    state.resistance_work[0] = own[_RESISTING]
    state.vehicle_speed[0] = max(0.0, own[coach_state.SPEED_M_S])
    state.vehicle_acceleration[0] = (state.vehicle_speed[0] - v) / h
    state.position[0] += 0.5 * h * (v + state.vehicle_speed[0])
    # rollers beside a virtual track take their loads from this, as from the planar vehicle
    felt = state.felt_acceleration[0]
    state.felt_acceleration[0] += (state.vehicle_acceleration[0] - felt) * min(
        h / params.vehicle.pitch_time_constant_s, 1.0
    )


@kernel_inlined
def rest(state, coach):
    """Let a coach whose wheels stand swing out on its springs, brakes as they are."""
    for j in range(AXLES):
        state.coach[coach_state.MOTOR_NM + j] = 0.0
        state.coach[coach_state.BRAKE_NM + j] = state.brake_capacity[j]
        state.coach[coach_state.ROLLER_RAD_S + j] = 0.0
    step(state, 0.0, coach)


@kernel_inlined
def step(state, resistance_N, coach):
    """Fill the other ports and let the coach step."""
    own = state.coach
    own[coach_state.ACTION], own[coach_state.RESISTANCE_N] = compiled_coach.STEP, resistance_N
    for j in range(AXLES):
        own[coach_state.MU_CD + j], own[coach_state.MU_CR + j] = (
            state.friction_degraded[j],
            state.friction_recovered[j],
        )
    compiled_coach.run(own, coach.tape, coach.layout)


@kernel_inlined
def load(axle, planar_N, state, coach):
    """Load in N of a wheelset: what its contacts carry, not below 0; planar_N where there is no coach."""
    if coach is None:
        return planar_N
    at = _SEEN + 2 * SEEN * axle + LOAD
    return max(state.coach[at] + state.coach[at + SEEN], 0.0)


@kernel_inlined
def slip(axle, planar_m_s, state, coach):
    """Sliding in m/s of a wheelset's contacts, on the radii on which they roll."""
    if coach is None:
        return planar_m_s
    at, seen = _SEEN + 2 * SEEN * axle, state.coach
    left, right = seen[at + TOUCHING], seen[at + SEEN + TOUCHING]
    if left + right <= 0.0:
        return planar_m_s
    return (left * seen[at + SLIP] + right * seen[at + SEEN + SLIP]) / (left + right)


@kernel_inlined
def adhesion(axle, planar, load_N, state, coach):
    """Adhesion of a wheelset: the braking force of its contacts over their load."""
    if coach is None:
        return planar
    return state.coach[_GIVEN + GIVEN * axle + BRAKING_N] / load_N if load_N > 0.0 else 0.0
