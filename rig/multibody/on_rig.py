"""The coach as the plant's vehicle: what `vehicle` and `wheelset` are to the planar model.

Every function takes the coach last and is nothing at all where it is None: the planar model then
compiles to what it was. The plant's state stays the one that is seen and recorded; the coach's own
42 coordinates stand beside it in `state.coach`.
"""

from rollerrig.rig.kernel import kernel, kernel_inlined
from rollerrig.rig.multibody import motion
from rollerrig.rig.multibody.treads import BRAKING_N, LOAD, SLIP, TOUCHING

AXLES = 4


@kernel
def start(state, params, coach):
    """Set the coach rolling at the plant's vehicle speed, wheels without sliding on their contacts."""
    motion.start(state.coach, coach, state.vehicle_speed[0])
    for j in range(AXLES):
        state.wheel_speed[j] = state.coach.v[22 + 6 * j]
    see_loads(state, coach)


@kernel
def see_loads(state, coach):
    """Before the first step every wheelset carries the static load."""
    seen = state.coach.seen
    for wheel in range(2 * AXLES):
        seen[wheel, LOAD] = coach.weight_N.sum() / (2 * AXLES)
        seen[wheel, SLIP] = 0.0


@kernel_inlined
def integrate(state, params, resistance_N, coach):
    """Advance coach, wheelsets and rollers by one step, as `wheelset.integrate` does.

    resistance_N is the running resistance at the present speed.
    """
    h, own = params.step_s, state.coach
    v = state.vehicle_speed[0]
    for j in range(AXLES):
        # torques are given at both ends of the step; the coach wants their means
        state.wheel_rate[j] = 0.5 * (state.motor_before[j] + state.motor_torque[j])
        state.roller_rate[j] = state.roller_speed[j]
        state.brake_capacity[j] = 0.5 * (state.brake_capacity[j] + state.brake_torque[j])
    motion.step(own, coach, h, state.roller_speed, state.wheel_rate,
                params.drive.roller_inertia_kgm2, state.brake_capacity, state.brake_mean,
                resistance_N, state.friction_degraded, state.friction_recovered, params.law,
                params.cleaning_creepage)
    for j in range(AXLES):
        state.contact_force[j] = own.given[j, BRAKING_N]
        before = state.wheel_speed[j]
        state.wheel_speed[j] = max(0.0, own.v[22 + 6 * j])
        state.wheel_angle[j] += 0.5 * h * (before + state.wheel_speed[j])
        turned_rad = 0.5 * h * (state.roller_rate[j] + state.roller_speed[j])
        state.roller_angle[j] += turned_rad
        state.motor_work[j] += state.wheel_rate[j] * turned_rad
        state.sliding_work[j] = own.sliding_work[j]
        state.brake_work[j] = own.brake_work[j]
        state.brake_capacity[j] = state.brake_torque[j]
        state.motor_before[j] = state.motor_torque[j]
    state.resistance_work[0] = own.resistance_work[0]
    state.vehicle_speed[0] = max(0.0, motion.mean_speed(own.v, coach))
    state.vehicle_acceleration[0] = (state.vehicle_speed[0] - v) / h
    state.position[0] += 0.5 * h * (v + state.vehicle_speed[0])
    # rollers beside a virtual track take their loads from this, as from the planar vehicle
    felt = state.felt_acceleration[0]
    state.felt_acceleration[0] += (state.vehicle_acceleration[0] - felt) * min(
        h / params.vehicle.pitch_time_constant_s, 1.0)


@kernel_inlined
def rest(state, params, coach):
    """Let a coach whose wheels stand swing out on its springs, brakes as they are."""
    own = state.coach
    for j in range(AXLES):
        state.wheel_rate[j] = 0.0
        state.roller_rate[j] = 0.0
    motion.step(own, coach, params.step_s, state.roller_rate, state.wheel_rate,
                params.drive.roller_inertia_kgm2, state.brake_capacity, state.brake_mean, 0.0,
                state.friction_degraded, state.friction_recovered, params.law,
                params.cleaning_creepage)


@kernel_inlined
def load(axle, planar_N, state, coach):
    """Load in N of a wheelset: what its contacts carry, not below 0; planar_N where there is no coach."""
    if coach is None:
        return planar_N
    seen = state.coach.seen
    return max(seen[2 * axle, LOAD] + seen[2 * axle + 1, LOAD], 0.0)


@kernel_inlined
def slip(axle, planar_m_s, state, coach):
    """Sliding in m/s of a wheelset's contacts, on the radii on which they roll."""
    if coach is None:
        return planar_m_s
    seen = state.coach.seen
    left, right = seen[2 * axle, TOUCHING], seen[2 * axle + 1, TOUCHING]
    if left + right <= 0.0:
        return planar_m_s
    return (left * seen[2 * axle, SLIP] + right * seen[2 * axle + 1, SLIP]) / (left + right)


@kernel_inlined
def adhesion(axle, planar, load_N, state, coach):
    """Adhesion of a wheelset: the braking force of its contacts over their load."""
    if coach is None:
        return planar
    return state.coach.given[axle, BRAKING_N] / load_N if load_N > 0.0 else 0.0
