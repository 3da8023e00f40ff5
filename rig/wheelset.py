"""Wheelsets, rollers and vehicle in motion: one time step of the coupled rotations.

The contact force T = f N drives the wheelset on against its brake [W1]. It holds back the roller
that its motor drives [W2], and the vehicle. At low speed the creep slope makes wheel and roller
stiff. So the pair of each axle is stepped by a linearly implicit second-order method (ROS2, Verwer
et al. 1999, gamma = 1 - 1/sqrt 2), whose matrix has rank one and is inverted in closed form [W3].
The secant slope T / s is used for the derivative, which that method allows without loss of order.
The brake is dry friction: a wheel that stops stays locked while r T is below what the discs can
hold [W4].

    [W1] J domega/dt = r T - M - C, paper eq. 20 with the torque M of a dynamic brake or of traction
    [W2] J_R dOmega/dt = u - R T on rollers; on a plain track the surface is the vehicle's
    [W3] (I - gamma h p q')^-1 k = k + p gamma h (q'k) / (1 - gamma h q'p),
         p = (r / J, -R / J_R), q = g (-r, R), g = T / s
    [W4] C = min(C_max, r T - M) at omega = 0

Second order in the step while no wheel locks or leaves its lock within it. Rotation backwards does
not exist here: the vehicle brakes, or drives forwards.
"""

import math

from rollerrig.rig import dynamic_brake, track_brake
from rollerrig.rig import vehicle as body
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion, creep_force, vector_secant
from rollerrig.rig.mechanisms import wheel_flat

_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
LOCKED_BELOW_M_S = 0.1  # a wheel whose rim is slower counts as locked
SMALL_M_S = 1e-6  # sliding below which the secant slope is taken at this sliding


@kernel
def wheelset_adhesion(sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law):
    """Return the adhesion of a wheelset with the contaminant under it.

    Results are those of `adhesion.wheel_adhesion`. One wheel carries half of the wheelset's load.
    Another model of `creep_force` cleans nothing: then f_d, f_r and |f| are the same, and the slope
    is the secant.

    Parameters
    ----------
    sliding_m_s : sliding, of either sign
    surface_m_s : speed of the surface: the vehicle's or the roller's
    load_N : load on the wheelset
    mu_cd, mu_cr : kinematic friction of the contaminant, degraded and recovered
    patch, law : `patch.Patch`, `adhesion.Law`
    """
    law_here = adhesion.law_for_contaminant(mu_cd, mu_cr, 1.0, law)
    return adhesion_of_model(sliding_m_s, surface_m_s, 0.5 * load_N, patch, law_here, patch.model)


@kernel_inlined
def adhesion_of_model(sliding_m_s, surface_m_s, load_N, patch, law, model):
    """Return the adhesion of one wheel by the degraded law (`model` None) or by another model."""
    if model is None:
        return adhesion.wheel_adhesion(sliding_m_s, surface_m_s, load_N, patch, law)
    return without_recovery(sliding_m_s, surface_m_s, load_N, patch, law)


@kernel
def without_recovery(sliding_m_s, surface_m_s, load_N, patch, law):
    """Return the results of `adhesion.wheel_adhesion` by a model without recovery."""
    creepage = sliding_m_s / max(abs(surface_m_s), adhesion.SPEED_FLOOR_M_S)
    f = creep_force.adhesion_of(sliding_m_s, creepage, load_N, patch, law)
    slope = f / sliding_m_s if sliding_m_s != 0.0 else 0.0
    return f, abs(f), abs(f), 0.0, abs(f * creepage) * load_N, slope


@kernel
def contact_force(sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law, lagging, of_work):
    """Return the contact force of a wheelset and its secant slope.

    Parameters
    ----------
    sliding_m_s, surface_m_s, load_N, mu_cd, mu_cr, patch, law : as for `wheelset_adhesion`
    lagging : the remembered lambda by which the contact has recovered; `adhesion.NO_MEMORY` where
        it recovers without memory
    of_work : above 0, lambda_0 is the one of the work that this force does [A7 of `adhesion`]

    Returns
    -------
    T_N : force of both wheels
    secant_N_s_m : T / s, not below 0
    lambda_0 : transition without memory
    """
    at = sliding_m_s if abs(sliding_m_s) >= SMALL_M_S else SMALL_M_S
    law_here = adhesion.law_for_contaminant(mu_cd, mu_cr, 1.0, law)
    f, lambda_0 = lagging_adhesion(
        at, surface_m_s, load_N, patch, law_here, lagging, of_work, patch.model
    )
    slope = f * (load_N / at)
    return slope * sliding_m_s, max(slope, 0.0), lambda_0


@kernel_inlined
def lagging_adhesion(sliding_m_s, surface_m_s, load_N, patch, law, lagging, of_work, model):
    """Return the adhesion of a wheelset, and lambda without memory.

    `model` is None for the degraded law. Other arguments as for `contact_force`.
    """
    half_N = 0.5 * load_N
    if model is not None:
        return without_recovery(sliding_m_s, surface_m_s, half_N, patch, law)[0], 0.0
    if not load_N > 0.0:
        return 0.0, 0.0

    f_d, f_r, slope_d, slope_r, k, slope_k = adhesion.curves(
        min(abs(sliding_m_s), adhesion.LARGEST),
        surface_m_s,
        min(half_N, adhesion.LARGEST),
        patch.eps1,
        law,
    )
    f, lambda_0, _, _ = adhesion.f_and_lambda(
        f_d, f_r, slope_d, slope_r, k, slope_k, lagging, of_work
    )
    if lagging >= 0.0:
        f = adhesion.between(f_d, f_r, lagging)
    return math.copysign(f, sliding_m_s), lambda_0


@kernel
def lagged_transition(lagging, lambda_0, speed_m_s, step_s, effects):
    """Return a lagging lambda after a step in which lambda_0 is constant [A7 of `adhesion`].

    `effects` is `mechanisms.applied.Effects` with a memory length above 0.
    """
    rate_1_s = adhesion.lag_rate_1_s(speed_m_s, effects.memory_m, effects.memory_power)
    return lagging - (lambda_0 - lagging) * math.expm1(-step_s * rate_1_s)


@kernel
def wheel_acceleration(wheel_rad_s, T, brake_Nm, motor_Nm, axle, wheels):
    """Return a wheelset's acceleration in rad/s2 [W1], its brake torque, and whether it is locked.

    `T` is the contact force in N, `brake_Nm` the torque that the discs can hold, `motor_Nm` that of
    a dynamic brake, negative in traction.
    """
    drive_Nm = wheels.table[body.RADIUS_M, axle] * T - motor_Nm
    if wheel_rad_s <= 0.0 and drive_Nm <= brake_Nm:
        return 0.0, max(drive_Nm, 0.0), True  # [W4]
    return (drive_Nm - brake_Nm) / wheels.table[body.INERTIA_KGM2, axle], brake_Nm, False


@kernel
def roller_acceleration(motor_Nm, T, on_track, drive):
    """Return a roller's acceleration in rad/s2 [W2]; 0 on a track, where there is none."""
    if on_track:
        return 0.0
    return (motor_Nm - drive.roller_radius_m * T) / drive.roller_inertia_kgm2


@kernel
def implicit_slopes(wheel_k, roller_k, g, locked, on_track, step_s, axle, wheels, drive):
    """Return the slopes of a stage multiplied by (I - gamma h p q')^-1 [W3].

    Parameters
    ----------
    wheel_k, roller_k : explicit slopes in rad/s2
    g : secant slope T / s in N s/m
    locked, on_track : whether the wheel is locked, whether there is no roller
    step_s : step h
    axle, wheels, drive : number of the axle; `mechanisms.applied.Wheels`; `params.Drive`

    Returns
    -------
    wheel_k, roller_k : the slopes in rad/s2
    added_N : contact force that the implicit part adds
    """
    r = wheels.table[body.RADIUS_M, axle]
    R = drive.roller_radius_m
    p_wheel = 0.0 if locked else wheels.table[body.RESPONSE_1_KGM, axle]
    p_roller = 0.0 if on_track else -R / drive.roller_inertia_kgm2
    qk = g * (R * roller_k - r * wheel_k)
    share = _GAMMA * step_s * qk / (1.0 + _GAMMA * step_s * g * (r * p_wheel - R * p_roller))
    return wheel_k + p_wheel * share, roller_k + p_roller * share, share


@kernel_inlined
def load(axle, felt_m_s2, turned_rad, state, params):
    """Return the load in N of an axle at this pitch and angle of its wheels, round or not."""
    load_N = body.load(axle, felt_m_s2, params.vehicle)
    load_N = body.swinging_load(load_N, axle, turned_rad, params.wheels)
    if params.flats.wear_m3_J > 0.0:
        load_N *= wheel_flat.load_share(
            turned_rad - state.flat_angle[axle],
            state.flat_length[axle],
            params.wheels.table[body.RADIUS_M, axle],
            params.flats.load_1_m,
        )
    return load_N


@kernel
def contacts(state, params, v, felt_m_s2):
    """Compute sliding and secant slope T / s of each contact at a stage of a step.

    `v` and `felt_m_s2` are the speed of the vehicle in m/s and its felt acceleration at the stage.
    The speeds and angles of wheels and rollers there, and a remembered lambda, are in the state.
    """
    for j in range(state.axles):
        surface = v
        if params.mode != 0:
            surface = params.drive.roller_radius_m * state.stage_roller_speed[j]
        rim = params.wheels.table[body.RADIUS_M, j] * state.stage_wheel_speed[j]
        state.stage_surface[j] = surface
        state.stage_sliding[j] = surface - rim
        state.stage_load[j] = load(j, felt_m_s2, state.stage_angle[j], state, params)
    forces(state, params, params.patch.model)


@kernel
def forces(state, params, model):
    """Write the secant slope of each contact by the degraded law (`model` None) or another model.

    Where recovery has a memory, lambda without memory is written, too.
    """
    if model is None and params.effects.memory_m == 0.0:
        followed_forces(state, params)
        return
    for j in range(state.axles):
        lagging = adhesion.NO_MEMORY
        if params.effects.memory_m > 0.0:
            lagging = state.stage_transition[j]
        slope, lambda_0 = exact_slope(state, j, lagging, params)
        state.stage_slope[j] = slope
        state.instantaneous_transition[j] = lambda_0


@kernel
def followed_forces(state, params):
    """Write the secant slope of each contact by the degraded law, from the one of a moment before.

    The loop has no branch, so that a core computes several contacts with one instruction.
    """
    law = params.law
    decay_d = 1.0 / law.A_d - 1.0
    decay_r = 1.0 / law.A_r - 1.0
    for j in range(state.axles):
        solved = state.solved_work[j]
        slope_s_m, exponent, y, inside = vector_secant.secant_adhesion(
            max(abs(state.stage_sliding[j]), SMALL_M_S),
            state.stage_surface[j],
            0.5 * state.stage_load[j],
            params.patch.eps1,
            decay_d,
            decay_r,
            adhesion.law_for_contaminant(
                state.friction_degraded[j], state.friction_recovered[j], 1.0, law
            ),
            solved + state.work_change_before[j],
        )
        state.stage_slope[j] = slope_s_m * state.stage_load[j]
        state.stage_exponent[j] = exponent
        state.is_solved[j] = inside

        # The two stages of a step alternate. The change from one to the other differs little from
        # that in the step before, so the solution after the next one begins with this change.
        state.work_change_before[j] = state.work_change[j]
        state.work_change[j] = y - solved if inside != 0.0 else 0.0
        state.solved_work[j] = y if inside != 0.0 else solved

    # the few contacts outside the domain of this form
    for j in range(state.axles):
        if state.is_solved[j] == 0.0:
            slope, _ = exact_slope(state, j, adhesion.NO_MEMORY, params)
            state.stage_slope[j] = slope
            # the next solution begins with this one
            loaded = state.stage_load[j] > 0.0
            size = max(abs(state.stage_sliding[j]), SMALL_M_S)
            f = slope * size / state.stage_load[j] if loaded else 0.0
            state.solved_work[j] = state.stage_exponent[j] * f


@kernel
def exact_slope(state, axle, lagging, params):
    """Return the secant slope T / s of a contact in N s/m, and lambda_0, by `contact_force`."""
    at = max(abs(state.stage_sliding[axle]), SMALL_M_S)
    T, _, lambda_0 = contact_force(
        at,
        state.stage_surface[axle],
        state.stage_load[axle],
        state.friction_degraded[axle],
        state.friction_recovered[axle],
        params.patch,
        params.law,
        lagging,
        params.effects.memory_of_work,
    )
    return T / at, lambda_0


@kernel
def integrate(state, params):
    """Advance wheels, rollers and vehicle by one step.

    Torques of brakes and motors are given at both ends of the step: `brake_capacity` and
    `motor_before` at its beginning, `brake_torque` and `motor_torque` at its end. A memory of
    recovery is stepped exactly under the mean of lambda_0 at both stages.
    """
    vehicle = params.vehicle
    drive = params.drive
    effects = params.effects
    wheels = params.wheels
    h = params.step_s
    on_track = params.mode == 0
    remembers = effects.memory_m > 0.0
    v = state.vehicle_speed[0]
    felt = state.felt_acceleration[0]
    resistance_N = body.resistance(v, vehicle)
    resisting_N = 0.5 * resistance_N
    magnets_N = track_brake.force_N(state, v, params.track_brake)
    rubbing_N = 0.5 * magnets_N

    # first stage: slopes at the beginning of the step
    for j in range(state.axles):
        state.stage_wheel_speed[j] = state.wheel_speed[j]
        state.stage_roller_speed[j] = state.roller_speed[j]
        state.stage_angle[j] = state.wheel_angle[j]
        state.stage_transition[j] = state.lagged_transition[j]
    contacts(state, params, v, felt)
    total = resistance_N + magnets_N
    for j in range(state.axles):
        T = state.stage_slope[j] * state.stage_sliding[j]
        g = max(state.stage_slope[j], 0.0)
        electric_Nm = dynamic_brake.torque(state, j)
        wheel_k, brake_Nm, locked = wheel_acceleration(
            state.wheel_speed[j], T, state.brake_capacity[j], electric_Nm, j, wheels
        )
        roller_k = roller_acceleration(state.motor_before[j], T, on_track, drive)
        state.wheel_rate[j], state.roller_rate[j], added_N = implicit_slopes(
            wheel_k, roller_k, g, locked, on_track, h, j, wheels, drive
        )
        # the vehicle feels what wheel and roller feel, or momentum would be lost where they are
        # stiff
        total += T + added_N
        state.contact_force[j] = 0.5 * (T + added_N)
        state.brake_mean[j] = 0.5 * brake_Nm
    a1 = -total / vehicle.mass_kg
    f1 = (a1 - felt) / vehicle.pitch_time_constant_s

    # second stage: slopes at the end that the first one predicts
    v2 = v + h * a1
    felt2 = felt + h * f1
    resistance_N = body.resistance(v2, vehicle)
    resisting_N += 0.5 * resistance_N
    magnets_N = track_brake.force_N(state, v2, params.track_brake)
    rubbing_N += 0.5 * magnets_N
    for j in range(state.axles):
        state.stage_wheel_speed[j] = max(0.0, state.wheel_speed[j] + h * state.wheel_rate[j])
        state.stage_roller_speed[j] = state.roller_speed[j] + h * state.roller_rate[j]
        state.stage_angle[j] = state.wheel_angle[j] + h * state.wheel_speed[j]
    if remembers:
        for j in range(state.axles):
            state.transition_before[j] = state.instantaneous_transition[j]
            state.stage_transition[j] = lagged_transition(
                state.lagged_transition[j], state.transition_before[j], v, h, effects
            )
    contacts(state, params, v2, felt2)
    if remembers:
        for j in range(state.axles):
            mean = 0.5 * (state.transition_before[j] + state.instantaneous_transition[j])
            state.lagged_transition[j] = lagged_transition(
                state.lagged_transition[j], mean, 0.5 * (v + v2), h, effects
            )
    total = resistance_N + magnets_N
    for j in range(state.axles):
        wheel1 = state.wheel_rate[j]
        roller1 = state.roller_rate[j]
        motor_Nm = state.motor_torque[j]
        T = state.stage_slope[j] * state.stage_sliding[j]
        g = max(state.stage_slope[j], 0.0)
        electric_Nm = dynamic_brake.torque(state, j)
        wheel_k, brake_Nm, locked = wheel_acceleration(
            state.stage_wheel_speed[j], T, state.brake_torque[j], electric_Nm, j, wheels
        )
        roller_k = roller_acceleration(motor_Nm, T, on_track, drive)
        wheel_k, roller_k, added_N = implicit_slopes(
            wheel_k - 2.0 * wheel1,
            roller_k - 2.0 * roller1,
            g,
            locked,
            on_track,
            h,
            j,
            wheels,
            drive,
        )
        total += T + added_N
        state.contact_force[j] += 0.5 * (T + added_N)
        state.brake_mean[j] += 0.5 * brake_Nm
        turn(
            state,
            j,
            h * (1.5 * wheel1 + 0.5 * wheel_k),
            h * (1.5 * roller1 + 0.5 * roller_k),
            0.5 * (state.motor_before[j] + motor_Nm),
            params,
        )
        state.brake_capacity[j] = state.brake_torque[j]
        state.motor_before[j] = motor_Nm

    # the vehicle, by the mean of both stages
    a2 = -total / vehicle.mass_kg
    state.felt_acceleration[0] = felt + 0.5 * h * (
        f1 + (a2 - felt2) / vehicle.pitch_time_constant_s
    )
    state.vehicle_acceleration[0] = 0.5 * (a1 + a2)
    state.vehicle_speed[0] = max(0.0, v + h * state.vehicle_acceleration[0])
    way_m = 0.5 * h * (v + state.vehicle_speed[0])
    state.position[0] += way_m
    state.resistance_work[0] += resisting_N * way_m
    state.track_brake_work[0] += rubbing_N * way_m
    if on_track:
        # on a track the surface moves with the vehicle, not with a roller
        for j in range(state.axles):
            state.sliding_work[j] += state.contact_force[j] * way_m


@kernel
def turn(state, axle, wheel_change_rad_s, roller_change_rad_s, motor_Nm, params):
    """Add a step's change to the speeds of an axle and turn its angles; no wheel turns backwards.

    `motor_Nm` is the mean torque of the motor in the step. The works of sliding, brake and motor
    are added too.
    """
    wheel = state.wheel_speed[axle]
    roller = state.roller_speed[axle]
    state.wheel_speed[axle] = max(0.0, wheel + wheel_change_rad_s)
    state.roller_speed[axle] = roller + roller_change_rad_s
    wheel_rad = 0.5 * params.step_s * (wheel + state.wheel_speed[axle])
    roller_rad = 0.5 * params.step_s * (roller + state.roller_speed[axle])
    state.wheel_angle[axle] += wheel_rad
    state.roller_angle[axle] += roller_rad

    # mean force times way: the energy balance holds to rounding however stiff the contact
    slid_m = (
        params.drive.roller_radius_m * roller_rad
        - params.wheels.table[body.RADIUS_M, axle] * wheel_rad
    )
    state.sliding_work[axle] += state.contact_force[axle] * slid_m
    state.brake_work[axle] += state.brake_mean[axle] * wheel_rad
    dynamic_brake.count_work(state, axle, wheel_rad)
    state.motor_work[axle] += motor_Nm * roller_rad


@kernel
def lock_s(locked_s, longest_s, rim_m_s, vehicle_m_s, above_m_s, tick_s):
    """Return how long a wheelset is locked now, and its longest lock, after a tick.

    A lock counts while the vehicle is faster than `above_m_s`.
    """
    is_locked = (vehicle_m_s > above_m_s) & (rim_m_s < LOCKED_BELOW_M_S)
    locked_s = locked_s + tick_s if is_locked else 0.0
    return locked_s, max(longest_s, locked_s)
