"""Electrodynamic brake and traction of driven wheelsets, and blending with the friction brake.

A motor brakes or drives its wheelset. Its force at the rim is constant up to a corner speed, and
its power is constant above [E1]. Braking and driving have separate forces and corner speeds.
Braking fades out at low speed [E2]. The force follows its demand with a lag and a limited rate
[E3]. The demanded brake force of a bogie or of a car comes first from its motors, and the friction
brake gives the rest [E4].

    [E1] F(v) = F_0 up to v_c, F_0 v_c / v above; v is the speed of the rim
    [E2] F(v) (v - v_to) / (v_from - v_to) from v_to to v_from, 0 below
    [E3] dF/dt = (F_demand - F) / T, at most the rate in magnitude
    [E4] p_f = p_spring + max(0, n k_d (p_d - p_spring) - sum F_c) / (n k_f) for n axles that blend
    [E5] ds_c/dt = (s - s_c) / T_c
    [E6] F_demand = q s F,  q = min(1, L / sum s F),
         L = n k_d (p_d - p_spring) - sum k_f (p_j - p_spring)

Slide control permits a share s of the force of an axle. Blending counts the force F_c that the
motors would give with the share s_c [E5]: the friction brake takes over slowly what slide control
releases, because it would slide the same wheels. What a motor lacks for another reason, the
friction brake gives without delay. The motors of the axles that blend give together what the
cylinder pressures p_j leave of the demand [E6]. So a motor that is permitted again returns as the
friction brake gives its share back, and both together exceed the demand only by the lag of the
motors. Source: general practice of blended brakes; every default is an assumption, not a
measurement of one brake.

The torque is positive when it brakes and negative when it drives.
"""

from rollerrig.rig import vehicle
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.dynamic_params import BUS, TRACTION_UNIT

NO_COMMAND = -1.0  # the bus demands no traction: the programme of the scenario does


@kernel
def curve_N(speed_m_s, force_N, corner_speed_m_s):
    """Return the largest force of a motor in N at a speed of its rim in m/s [E1]."""
    if speed_m_s <= corner_speed_m_s:
        return force_N
    return force_N * corner_speed_m_s / speed_m_s


@kernel
def fade_share(speed_m_s, brake):
    """Return the share of the brake force that is left at a speed of the rim [E2]."""
    share = (speed_m_s - brake.fade_to_m_s) / (brake.fade_from_m_s - brake.fade_to_m_s)
    return min(max(share, 0.0), 1.0)


@kernel
def begin(state, brake):
    """Permit all motors their whole force."""
    if brake.acts:
        state.traction_command[0] = NO_COMMAND
        for j in range(state.axles):
            state.dynamic_share[j] = 1.0
            state.dynamic_credit_share[j] = 1.0
            state.dynamic_permitted[j] = 1.0


@kernel
def prepare(state, brake):
    """Set the share of traction that is demanded in a tick: by the bus, or by the programme."""
    if brake.acts:
        traction = state.traction_command[0]
        if traction < 0.0:
            traction = 0.0
            for i in range(brake.traction_start_s.size):
                if state.time[0] >= brake.traction_start_s[i]:
                    traction = brake.traction_share[i]
        state.traction_target[0] = traction
        count_motors(state, brake)


@kernel
def count_motors(state, brake):
    """Count the axles that blend with each axle, and their motors that work."""
    for j in range(state.axles):
        state.blending_axles[j] = 0.0
        state.working_motors[j] = 0.0
        for i in range(state.axles):
            if brake.blends_with[i] == brake.blends_with[j]:
                state.blending_axles[j] += 1.0
                works = brake.driven[i] and state.dynamic_failed[i] == 0.0
                state.working_motors[j] += 1.0 if works else 0.0


@kernel
def advance(state, params):
    """Advance motors, slide control and blending of a rig by a step."""
    control_slide(state, params, params.dynamic)
    demand_motors(state, params, params.dynamic)
    blend(state, params.dynamic)


@kernel
def control_slide(state, params, brake):
    """Set the permitted share of each motor, and the share that blending counts [E5]."""
    for j in range(state.axles):
        share = 1.0
        if brake.control == BUS:
            share = state.dynamic_permitted[j]
        elif brake.control == TRACTION_UNIT:
            surface_m_s = state.vehicle_speed[0]
            if params.mode != 0:
                surface_m_s = params.drive.roller_radius_m * state.roller_speed[j]
            rim_m_s = params.wheels.table[vehicle.RADIUS_M, j] * state.wheel_speed[j]
            limit_m_s = brake.slide_limit * surface_m_s + brake.slide_floor_m_s
            slides = abs(surface_m_s - rim_m_s) > limit_m_s
            change = -brake.release_change if slides else brake.return_change
            share = min(max(state.dynamic_share[j] + change, 0.0), 1.0)
        state.dynamic_share[j] = share
        credit = state.dynamic_credit_share[j]
        state.dynamic_credit_share[j] = credit + (share - credit) * brake.takeover_share  # [E5]


@kernel
def demand_motors(state, params, brake):
    """Let the forces of all motors follow their demands [E1] to [E3], [E6]."""
    above_spring_Pa = max(0.0, state.brake_demand[0] - brake.spring_pressure_Pa)
    traction = 0.0
    if above_spring_Pa == 0.0:
        traction = state.traction_target[0]
    state.traction_demand[0] = traction

    for j in range(state.axles):
        state.dynamic_before[j] = state.dynamic_torque[j]
        state.dynamic_braking[j] = 0.0
        if brake.driven[j] and state.dynamic_failed[j] == 0.0:
            # what the axles that blend together demand, in equal shares from their motors
            share = state.blending_axles[j] / state.working_motors[j]
            wanted_N = above_spring_Pa * brake.demand_N_Pa * share
            rim_m_s = params.wheels.table[vehicle.RADIUS_M, j] * state.wheel_speed[j]
            largest_N = curve_N(rim_m_s, brake.force_N, brake.brake_corner_speed_m_s)
            state.dynamic_braking[j] = min(wanted_N, largest_N * fade_share(rim_m_s, brake))

    for j in range(state.axles):
        if not brake.driven[j]:
            continue
        if state.dynamic_failed[j] != 0.0:
            state.dynamic_torque[j] = 0.0
            state.dynamic_torque_demand[j] = 0.0
            state.dynamic_credit[j] = 0.0
            continue

        radius_m = params.wheels.table[vehicle.RADIUS_M, j]
        rim_m_s = radius_m * state.wheel_speed[j]
        braking_N = state.dynamic_braking[j]
        driving_N = traction * curve_N(rim_m_s, brake.traction_force_N, brake.corner_speed_m_s)
        request_N = braking_N * share_left(state, j, above_spring_Pa, brake) - driving_N
        state.dynamic_torque_demand[j] = request_N * radius_m

        force_N = state.dynamic_torque[j] / radius_m
        force_N = followed(force_N, request_N * state.dynamic_share[j], brake)
        if state.wheel_speed[j] <= 0.0:
            force_N = min(force_N, 0.0)  # a motor that does not turn cannot brake
        state.dynamic_torque[j] = force_N * radius_m
        counted_N = braking_N * state.dynamic_credit_share[j]
        state.dynamic_credit[j] = followed(state.dynamic_credit[j], counted_N, brake)


@kernel
def share_left(state, axle, above_spring_Pa, brake):
    """Return the share of their permitted forces that the friction brake leaves to motors [E6].

    The motors are those that blend with the axle.
    """
    left_N = state.blending_axles[axle] * brake.demand_N_Pa * above_spring_Pa
    permitted_N = 0.0
    for i in range(state.axles):
        if brake.blends_with[i] == brake.blends_with[axle]:
            pressed_Pa = max(0.0, state.cylinder_pressure[i] - brake.spring_pressure_Pa)
            left_N -= brake.friction_N_Pa * pressed_Pa
            permitted_N += state.dynamic_share[i] * state.dynamic_braking[i]
    if permitted_N <= left_N:
        return 1.0
    return max(0.0, left_N) / permitted_N


@kernel
def followed(force_N, demand_N, brake):
    """Return the force after a step in which it follows its demand [E3]."""
    change_N = (demand_N - force_N) * brake.lag_share
    return force_N + min(max(change_N, -brake.largest_change_N), brake.largest_change_N)


@kernel
def blend(state, brake):
    """Set the demanded pressure of the friction brake of each axle [E4]."""
    p_d = state.brake_demand[0]
    above_spring_Pa = max(0.0, p_d - brake.spring_pressure_Pa)
    for j in range(state.axles):
        if above_spring_Pa == 0.0:
            state.friction_demand[j] = p_d
            continue
        axles = state.blending_axles[j]
        counted_N = 0.0
        for i in range(state.axles):
            if brake.blends_with[i] == brake.blends_with[j]:
                counted_N += state.dynamic_credit[i]
        rest_N = max(0.0, axles * brake.demand_N_Pa * above_spring_Pa - counted_N)
        state.friction_demand[j] = brake.spring_pressure_Pa + rest_N / (
            axles * brake.friction_N_Pa
        )  # [E4]


@kernel
def torque(state, axle):
    """Return the mean torque in N m of an axle's motor in this step; 0 without a dynamic brake."""
    return 0.5 * (state.dynamic_before[axle] + state.dynamic_torque[axle])


@kernel
def settle(state):
    """Leave no torque on the wheelsets of a vehicle that stands, and demand none."""
    if state.standing[0] != 0.0:
        state.traction_demand[0] = 0.0
        for j in range(state.axles):
            state.dynamic_before[j] = 0.0
            state.dynamic_torque[j] = 0.0
            state.dynamic_torque_demand[j] = 0.0
            state.dynamic_credit[j] = 0.0
