"""Wheelsets, rollers and vehicle in motion: one time step of the coupled rotations.

The contact force T = f N drives the wheelset on against its brake [W1], holds back the roller that
its motor drives [W2] and holds back the vehicle. At low speed the creep slope makes wheel and
roller stiff, so the pair of each axle is stepped by a linearly implicit second-order method (ROS2,
Verwer et al. 1999, gamma = 1 - 1/sqrt 2) whose matrix has rank one and is inverted in closed form
[W3]; the secant slope T / s stands for the derivative, which that method allows without loss of
order. The brake is dry friction: a wheel that stops stays locked while r T is below what the discs
can hold [W4].

    [W1] J domega/dt = r T - C
    [W2] J_R dOmega/dt = u - R T on rollers; on a plain track the surface is the vehicle's
    [W3] (I - gamma h p q')^-1 k = k + p gamma h (q'k) / (1 - gamma h q'p),
         p = (r / J, -R / J_R), q = g (-r, R), g = T / s
    [W4] C = min(C_max, r T) at omega = 0
    [W5] tau |e| -> tau min(|e|, e_c): the paper tuned its law on sliding wheels; for locked ones it
         would give the whole recovered adhesion at once (0.26 on soap at 40 m/s), which no rail
         does. e_c is a parameter, infinite by default; where a scenario sets it, it is an assumption
    [W6] d lambda/dx = (lambda_0 - lambda) / (L (v / 20 m/s)^p), f = f_d + lambda (f_r - f_d), where an
         extended model gives recovery a memory L: a state of each axle, whose lag is stepped exactly
         under the mean of lambda_0 at both stages
    [W7] lambda_0 = 1 - exp(-tau W) = 1 - (1 - lambda_b)^(f / f_b), W and f as they are, b of the base law,
         where the memory is one of the work done

Second order in the step while no wheel locks or leaves its lock within it. Rotation backwards does
not exist here: the vehicle only brakes.
"""

import math

from rollerrig.configs.vehicle import MIDDLE_SPEED_M_S
from rollerrig.rig import vehicle as body
from rollerrig.rig.contact import adhesion, creep_force
from rollerrig.rig.kernel import kernel, kernel_inlined
from rollerrig.rig.state import AXLES

_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
# sliding in m/s below which the secant slope is taken at this sliding
_SMALL_M_S = 1e-6
NO_MEMORY = -1.0
# lambda_0 counts no nearer to 1
_WHOLE = 1.0 - 1e-12


@kernel
def adhesion_under(sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law, cleaning_creepage):
    """Adhesion of a wheelset: what `adhesion.degraded` returns, for the contaminant under it.

    Beyond `cleaning_creepage` the energy of sliding cleans no better than at it [W5]. With another
    model of `creep_force` nothing is cleaned: f_d, f_r and |f| are the same, the slope is secant.
    """
    tau = law.tau_m_J
    creepage = abs(sliding_m_s) / max(abs(surface_m_s), adhesion.SPEED_FLOOR_M_S)
    if creepage > cleaning_creepage:
        tau *= cleaning_creepage / creepage  # [W5]
    here = adhesion.Law(mu_cd, mu_cr, law.A_d, law.A_r, law.gamma_d_s_m, law.gamma_r_s_m, law.k_ad,
                        law.k_sd, law.k_ar, law.k_sr, tau)
    if patch.model != creep_force.DEGRADED:
        return classic(sliding_m_s, surface_m_s, 0.5 * load_N, patch, here)
    # one wheel carries half of the wheelset's load
    return adhesion.degraded(sliding_m_s, surface_m_s, 0.5 * load_N, patch, here)


@kernel
def classic(sliding_m_s, surface_m_s, load_N, patch, law):
    """What `adhesion.degraded` returns, by a model without recovery, for one wheel."""
    creepage = sliding_m_s / max(abs(surface_m_s), adhesion.SPEED_FLOOR_M_S)
    f = creep_force.adhesion_of(sliding_m_s, creepage, load_N, patch, law)
    slope = f / sliding_m_s if sliding_m_s != 0.0 else 0.0
    return f, abs(f), abs(f), 0.0, abs(f * creepage) * load_N, slope


@kernel
def force(sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law, cleaning_creepage):
    """Contact force T in N of both wheels, and its secant slope g = T / s in N s/m, not negative."""
    return late_force(sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law, cleaning_creepage,
                      NO_MEMORY, 0.0)[:2]


@kernel
def late_force(sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law, cleaning_creepage, lagged,
               of_work):
    """What `force` returns, and lambda_0, where the contact has recovered by `lagged`, 0 to 1 [W6].

    NO_MEMORY: it has recovered by lambda_0. `of_work` above 0: lambda_0 is that of the work done [W7].
    """
    at = sliding_m_s
    if abs(at) < _SMALL_M_S:
        at = _SMALL_M_S
    slope, f_d, f_r, instantaneous, _, _ = adhesion_under(at, surface_m_s, load_N, mu_cd, mu_cr, patch, law,
                                          cleaning_creepage)
    if lagged >= 0.0:
        base, slope = slope, recovered(slope, f_d, f_r, lagged)
        if of_work > 0.0 and base != 0.0:
            instantaneous = -math.expm1(math.log1p(-min(instantaneous, _WHOLE)) * slope / base)
    slope *= load_N / at
    return slope * sliding_m_s, max(slope, 0.0), instantaneous


@kernel
def recovered(f, f_d, f_r, lagged):
    """Adhesion of the sign of f between its limits, recovered by `lagged` [W6]."""
    return math.copysign((1.0 - lagged) * f_d + lagged * f_r, f)


@kernel
def relaxed(lagged, instantaneous, speed_m_s, step_s, effects):
    """What a wheel remembers of its recovery a step later, while lambda_0 is `instantaneous` [W6].

    Written so that it is finite at standstill: v / (v / 20)^p = 20 (v / 20)^(1 - p).
    """
    rate_1_s = MIDDLE_SPEED_M_S / effects.memory_m * math.pow(
        max(speed_m_s, 0.0) / MIDDLE_SPEED_M_S, 1.0 - effects.memory_power)
    return lagged - (instantaneous - lagged) * math.expm1(-step_s * rate_1_s)


@kernel
def wheel_acceleration(wheel_rad_s, T, brake_Nm, axle, wheels):
    """A wheelset's acceleration in rad/s2 [W1], its brake torque in N m, and whether it is locked."""
    drive_Nm = wheels.table[body.RADIUS_M + axle] * T
    if wheel_rad_s <= 0.0 and drive_Nm <= brake_Nm:
        return 0.0, max(drive_Nm, 0.0), True  # [W4]
    return (drive_Nm - brake_Nm) / wheels.table[body.INERTIA_KGM2 + axle], brake_Nm, False


@kernel
def roller_rate(motor_Nm, T, on_track, drive):
    """A roller's acceleration in rad/s2 [W2]."""
    if on_track:
        return 0.0
    return (motor_Nm - drive.roller_radius_m * T) / drive.roller_inertia_kgm2


@kernel
def implicit_slopes(wheel_k, roller_k, g, locked, on_track, step_s, axle, wheels, drive):
    """The two slopes of a stage times (I - gamma h p q')^-1 [W3], and the force in N that this adds."""
    r, R = wheels.table[body.RADIUS_M + axle], drive.roller_radius_m
    p_wheel = 0.0 if locked else wheels.table[body.ANSWER_1_KGM + axle]
    p_roller = 0.0 if on_track else -R / drive.roller_inertia_kgm2
    qk = g * (R * roller_k - r * wheel_k)
    share = _GAMMA * step_s * qk / (1.0 + _GAMMA * step_s * g * (r * p_wheel - R * p_roller))
    return wheel_k + p_wheel * share, roller_k + p_roller * share, share


@kernel_inlined
def integrate(state, params):
    """Advance wheels, rollers and vehicle by one step.

    Torques of brakes and motors are given at both ends of the step: `brake_capacity` and
    `motor_before` at its beginning, `brake_torque` and `motor_torque` at its end.
    """
    vehicle, drive, patch, law = params.vehicle, params.drive, params.patch, params.law
    wheels, remembers = params.wheels, params.effects.memory_m > 0.0
    h, on_track, pitch_s = params.step_s, params.mode == 0, vehicle.pitch_time_constant_s
    v, felt = state.vehicle_speed[0], state.felt_acceleration[0]
    resistance_N = body.resistance(v, vehicle)
    resisting_N = 0.5 * resistance_N

    # first stage: slopes at the beginning of the step
    total = resistance_N
    for j in range(AXLES):
        wheel, roller, motor_Nm = state.wheel_speed[j], state.roller_speed[j], state.motor_before[j]
        surface = v if on_track else drive.roller_radius_m * roller
        sliding = surface - wheels.table[body.RADIUS_M + j] * wheel
        load_N = body.swung(body.load(j, felt, vehicle), j, state.wheel_angle[j], wheels)
        lagged = state.lagged_transition[j] if remembers else NO_MEMORY
        T, g, instantaneous = late_force(
            sliding, surface, load_N, state.friction_degraded[j], state.friction_recovered[j], patch,
            law, params.cleaning_creepage, lagged, params.effects.memory_of_work)
        if remembers:
            state.instantaneous_transition[j] = instantaneous
        wheel_k, brake_Nm, locked = wheel_acceleration(wheel, T, state.brake_capacity[j], j, wheels)
        roller_k = roller_rate(motor_Nm, T, on_track, drive)
        state.wheel_rate[j], state.roller_rate[j], added_N = implicit_slopes(
            wheel_k, roller_k, g, locked, on_track, h, j, wheels, drive)
        # the vehicle feels what wheel and roller feel, or momentum would be lost where they are stiff
        total += T + added_N
        state.contact_force[j], state.brake_mean[j] = 0.5 * (T + added_N), 0.5 * brake_Nm
    a1 = -total / vehicle.mass_kg
    f1 = (a1 - felt) / pitch_s

    # second stage: slopes at the end that the first one predicts
    v2, felt2 = v + h * a1, felt + h * f1
    resistance_N = body.resistance(v2, vehicle)
    resisting_N += 0.5 * resistance_N
    total = resistance_N
    for j in range(AXLES):
        wheel1, roller1, motor_Nm = state.wheel_rate[j], state.roller_rate[j], state.motor_torque[j]
        wheel = max(0.0, state.wheel_speed[j] + h * wheel1)
        roller = state.roller_speed[j] + h * roller1
        surface = v2 if on_track else drive.roller_radius_m * roller
        sliding = surface - wheels.table[body.RADIUS_M + j] * wheel
        turned_rad = state.wheel_angle[j] + h * state.wheel_speed[j]
        load_N = body.swung(body.load(j, felt2, vehicle), j, turned_rad, wheels)
        lagged = NO_MEMORY
        if remembers:
            lagged = relaxed(state.lagged_transition[j], state.instantaneous_transition[j], v, h, params.effects)
        T, g, instantaneous = late_force(
            sliding, surface, load_N, state.friction_degraded[j], state.friction_recovered[j], patch,
            law, params.cleaning_creepage, lagged, params.effects.memory_of_work)
        if remembers:
            mean = 0.5 * (state.instantaneous_transition[j] + instantaneous)
            state.lagged_transition[j] = relaxed(state.lagged_transition[j], mean, 0.5 * (v + v2), h,
                                                 params.effects)
        wheel_k, brake_Nm, locked = wheel_acceleration(wheel, T, state.brake_torque[j], j, wheels)
        roller_k = roller_rate(motor_Nm, T, on_track, drive)
        wheel_k, roller_k, added_N = implicit_slopes(wheel_k - 2.0 * wheel1, roller_k - 2.0 * roller1, g,
                                            locked, on_track, h, j, wheels, drive)
        total += T + added_N
        state.contact_force[j] += 0.5 * (T + added_N)
        state.brake_mean[j] += 0.5 * brake_Nm
        turn(state, j, h * (1.5 * wheel1 + 0.5 * wheel_k), h * (1.5 * roller1 + 0.5 * roller_k),
             0.5 * (state.motor_before[j] + motor_Nm), params)
        state.brake_capacity[j] = state.brake_torque[j]
        state.motor_before[j] = motor_Nm

    a2 = -total / vehicle.mass_kg
    state.felt_acceleration[0] = felt + 0.5 * h * (f1 + (a2 - felt2) / pitch_s)
    state.vehicle_acceleration[0] = 0.5 * (a1 + a2)
    state.vehicle_speed[0] = max(0.0, v + h * state.vehicle_acceleration[0])
    way_m = 0.5 * h * (v + state.vehicle_speed[0])
    state.position[0] += way_m
    state.resistance_work[0] += resisting_N * way_m
    if on_track:
        for j in range(AXLES):
            state.sliding_work[j] += state.contact_force[j] * way_m


@kernel_inlined
def turn(state, axle, wheel_change_rad_s, roller_change_rad_s, motor_Nm, params):
    """Add a step's change to the speeds of an axle (no wheel turns backwards) and turn its angles.

    Work is mean force times way, so the energy balance holds to rounding however stiff the contact.
    """
    wheel, roller = state.wheel_speed[axle], state.roller_speed[axle]
    state.wheel_speed[axle] = max(0.0, wheel + wheel_change_rad_s)
    state.roller_speed[axle] = roller + roller_change_rad_s
    wheel_rad = 0.5 * params.step_s * (wheel + state.wheel_speed[axle])
    roller_rad = 0.5 * params.step_s * (roller + state.roller_speed[axle])
    state.wheel_angle[axle] += wheel_rad
    state.roller_angle[axle] += roller_rad
    slid_m = params.drive.roller_radius_m * roller_rad - params.wheels.table[body.RADIUS_M + axle] * wheel_rad
    state.sliding_work[axle] += state.contact_force[axle] * slid_m
    state.brake_work[axle] += state.brake_mean[axle] * wheel_rad
    state.motor_work[axle] += motor_Nm * roller_rad
