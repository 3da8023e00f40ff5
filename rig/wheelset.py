"""Wheelsets, rollers and vehicle in motion: one time step of the coupled rotations.

The contact force T = f N drives the wheelset on against its brake [W1]. It holds back the roller
that its motor drives [W2], and the vehicle. At low speed the creep slope makes wheel and roller
stiff. So the pair of each axle is stepped by a linearly implicit second-order method (ROS2, Verwer
et al. 1999, gamma = 1 - 1/sqrt 2), whose matrix has rank one and is inverted in closed form [W3].
The secant slope T / s is used for the derivative, which that method allows without loss of order.
The brake is dry friction: a wheel that stops stays locked while r T is below what the discs can
hold [W4].

    [W1] J domega/dt = r T - M - C, paper eq. 20 with the torque M of a dynamic brake or traction, C
         that of the discs
    [W2] J_R dOmega/dt = u - R T on rollers, u the torque of the motor; on a plain track the surface
         is the vehicle's
    [W3] (I - gamma h p q')^-1 k = k + p gamma h (q'k) / (1 - gamma h q'p),
         p = (r / J, -R / J_R), q = g (-r, R), g = T / s
    [W4] C = min(C_max, max(0, r T - M)) at omega = 0

Second order in the step while no wheel locks or leaves its lock within it. Rotation backwards does
not exist here: the vehicle brakes, or drives forwards.
"""

import math

from rollerrig.rig import dynamic_brake, track_brake
from rollerrig.rig import vehicle as body
from rollerrig.rig.compiled.generated import tuple_builder, tuple_writer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.state_type import rig_of
from rollerrig.rig.contact import adhesion, creep_force, vector_secant
from rollerrig.rig.contact.patch import Patch
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


# kernels: the adhesion law of an axle, and its writer, which leaves out the friction (`_`)
law_of = tuple_builder(
    adhesion.Law,
    "state, lane",
    [
        "state.friction_degraded[lane]",
        "state.friction_recovered[lane]",
        *(f"state.{name}[lane]" for name in adhesion.Law._fields[2:]),
    ],
)
_write_law = tuple_writer(
    "state, lane", ["_", "_", *(f"state.{name}[lane]" for name in adhesion.Law._fields[2:])]
)


@kernel
def begin(state, params):
    """Write the constants of each axle into the state of a rig."""
    on_track = params.mode == 0
    for j in range(state.axles):
        state.on_track[j] = 1.0 if on_track else 0.0
        state.radius[j] = params.wheels.table[body.RADIUS_M, j]
        state.per_inertia[j] = 1.0 / params.wheels.table[body.INERTIA_KGM2, j]
        state.roller_radius[j] = params.drive.roller_radius_m
        state.per_roller_inertia[j] = 0.0 if on_track else 1.0 / params.drive.roller_inertia_kgm2
        state.static_load[j] = params.vehicle.static_load_N
        state.transfer[j] = params.vehicle.transfer_kg[j]
        state.eps1[j] = params.patch.eps1
        state.decay_d[j] = 1.0 / params.law.A_d - 1.0
        state.decay_r[j] = 1.0 / params.law.A_r - 1.0
        _write_law(state, j, params.law)


@kernel_inlined
def wheel_acceleration(wheel_rad_s, T, brake_Nm, dynamic_Nm, radius_m, per_inertia):
    """Return a wheelset's acceleration in rad/s2 [W1], its brake torque, and whether it is locked.

    Parameters
    ----------
    wheel_rad_s : speed of the wheelset
    T : contact force in N
    brake_Nm : torque that the discs can hold
    dynamic_Nm : torque M of a dynamic brake on the wheelset, negative in traction
    radius_m, per_inertia : radius, and 1 / inertia in 1/(kg m2)
    """
    drive_Nm = radius_m * T - dynamic_Nm
    locked = (wheel_rad_s <= 0.0) & (drive_Nm <= brake_Nm)
    acts_Nm = max(drive_Nm, 0.0) if locked else brake_Nm  # [W4]
    return (0.0 if locked else (drive_Nm - brake_Nm) * per_inertia), acts_Nm, locked


@kernel_inlined
def roller_acceleration(motor_Nm, T, radius_m, per_inertia):
    """Return a roller's acceleration in rad/s2 under the torque u of its motor [W2].

    Other arguments as for `wheel_acceleration`; per_inertia is 0 on a track, where no roller turns.
    """
    return (motor_Nm - radius_m * T) * per_inertia


@kernel_inlined
def implicit_slopes(wheel_k, roller_k, g, p_wheel, p_roller, radius_m, roller_m, step_s):
    """Return the slopes of a stage multiplied by (I - gamma h p q')^-1 [W3].

    Parameters
    ----------
    wheel_k, roller_k : explicit slopes in rad/s2
    g : secant slope T / s in N s/m
    p_wheel, p_roller : p, the effect of 1 N in rad/s2; 0 for a locked wheel, and without a roller
    radius_m, roller_m : radii r and R
    step_s : step h

    Returns
    -------
    wheel_k, roller_k : the slopes in rad/s2
    added_N : contact force that the implicit part adds
    """
    qk = g * (roller_m * roller_k - radius_m * wheel_k)
    stiffness = radius_m * p_wheel - roller_m * p_roller
    added_N = _GAMMA * step_s * qk / (1.0 + _GAMMA * step_s * g * stiffness)
    return wheel_k + p_wheel * added_N, roller_k + p_roller * added_N, added_N


@kernel_inlined
def flat_share(state, axle, turned_rad, params):
    """Return the factor that the flat of an axle's wheels puts on its load at this angle."""
    return wheel_flat.load_share(
        turned_rad - state.flat_angle[axle],
        state.flat_length[axle],
        params.wheels.table[body.RADIUS_M, axle],
        params.flats.load_1_m,
    )


@kernel
def uneven_load(load_N, axle, turned_rad, state, params):
    """Return the load of an axle whose wheels may be out of round or have flats, at this angle."""
    load_N = body.swinging_load(load_N, axle, turned_rad, params.wheels)
    if params.flats.wear_m3_J > 0.0:
        load_N *= flat_share(state, axle, turned_rad, params)
    return load_N


@kernel
def contacts(state, plants, model):
    """Compute sliding, load and secant slope T / s of each contact at a stage of a step.

    Speeds and angles at the stage are in the state. `plants` are the parameters of all rigs.
    `model` is None for the degraded law.
    """
    place_contacts(state, plants)
    exact = 0
    for rig in range(len(plants)):
        exact += 1 if is_exact(plants[rig], model) else 0
    if exact < len(plants):
        followed_forces(state)
    for rig in range(len(plants)):
        if is_exact(plants[rig], model):
            exact_forces(rig_of(state, rig, plants[rig].axles), plants[rig])


@kernel_inlined
def is_exact(params, model):
    """Return whether contacts need `contact_force`: another model, or recovery with a memory."""
    return model is not None or params.effects.memory_m > 0.0


@kernel
def place_contacts(state, plants):
    """Compute surface speed, sliding and load of each contact at a stage of a step."""
    for j in range(state.axles):
        roller = state.roller_radius[j] * state.stage_roller_speed[j]
        surface = state.stage_vehicle_speed[j] if state.on_track[j] != 0.0 else roller
        state.stage_surface[j] = surface
        state.stage_sliding[j] = surface - state.radius[j] * state.stage_wheel_speed[j]
        transfer_N = state.stage_felt[j] * state.transfer[j]
        state.stage_load[j] = max(0.0, state.static_load[j] - transfer_N)
    for rig in range(len(plants)):
        params = plants[rig]
        if params.wheels.swings or params.flats.wear_m3_J > 0.0:
            mine = rig_of(state, rig, params.axles)
            for j in range(params.axles):
                mine.stage_load[j] = uneven_load(
                    mine.stage_load[j], j, mine.stage_angle[j], mine, params
                )


@kernel
def exact_forces(state, params):
    """Write the secant slope of each contact by `contact_force`, and lambda without memory."""
    for j in range(state.axles):
        remembers = params.effects.memory_m > 0.0
        lagging = state.stage_transition[j] if remembers else adhesion.NO_MEMORY
        slope, lambda_0 = exact_slope(state, j, lagging, params)
        state.stage_slope[j] = slope
        state.instantaneous_transition[j] = lambda_0


@kernel
def followed_forces(state):
    """Write the secant slope of each contact by the degraded law.

    The solution begins with that of the same contact at the last stage. The loop has no branch, so
    that a core computes several contacts with one instruction.
    """
    follow_curves(state)
    outside = 0
    for j in range(state.axles):
        solved = state.solved_work[j]
        f, y, inside = vector_secant.recovered(
            state.stage_degraded[j],
            state.stage_recovered[j],
            state.stage_exponent[j],
            0.5 * state.stage_load[j],
            solved + state.work_change_before[j],
        )
        state.stage_slope[j] = f * state.stage_per_sliding[j] * state.stage_load[j]
        state.is_solved[j] = inside
        outside += inside == 0.0

        # The two stages of a step alternate. The change from one to the other differs little from
        # that in the step before, so the solution after the next one begins with this change.
        state.work_change_before[j] = state.work_change[j]
        state.work_change[j] = y - solved if inside != 0.0 else 0.0
        state.solved_work[j] = y if inside != 0.0 else solved

    if outside != 0:
        follow_outside(state)


@kernel
def follow_outside(state):
    """Write the secant slope of the few contacts outside the domain of `vector_secant`."""
    for j in range(state.axles):
        if state.is_solved[j] == 0.0 and state.stage_step[j] != 0.0:
            slope = outside_slope(state, j)
            state.stage_slope[j] = slope
            # the next solution begins with this one
            loaded = state.stage_load[j] > 0.0
            size = max(abs(state.stage_sliding[j]), SMALL_M_S)
            f = slope * size / state.stage_load[j] if loaded else 0.0
            state.solved_work[j] = state.stage_exponent[j] * f


@kernel
def follow_curves(state):
    """Write Polach's curves of each contact, and k of [A5]."""
    for j in range(state.axles):
        mu_d, mu_r, eps_mu, k, per_size = vector_secant.frictions(
            max(abs(state.stage_sliding[j]), SMALL_M_S),
            state.stage_surface[j],
            0.5 * state.stage_load[j],
            state.eps1[j],
            state.decay_d[j],
            state.decay_r[j],
            law_of(state, j),
        )
        state.stage_degraded[j] = mu_d
        state.stage_recovered[j] = mu_r
        state.stage_gradient[j] = eps_mu
        state.stage_exponent[j] = k
        state.stage_per_sliding[j] = per_size
    for j in range(state.axles):
        state.stage_degraded[j], state.stage_recovered[j] = vector_secant.curves(
            state.stage_degraded[j],
            state.stage_recovered[j],
            state.stage_gradient[j],
            law_of(state, j),
        )


@kernel
def outside_slope(state, axle):
    """Return the secant slope of a contact in N s/m by the degraded law, without memory."""
    # the law of one wheel needs only eps1 of the patch
    patch = Patch(0.0, 0.0, 0.0, 0.0, 0.0, state.eps1[axle], 0.0, 0.0, 0.0, None, 0, 0.0)
    return slope_of(state, axle, adhesion.NO_MEMORY, patch, law_of(state, axle), 0.0)[0]


@kernel
def exact_slope(state, axle, lagging, params):
    """Return the secant slope T / s of a contact in N s/m, and lambda_0, by `contact_force`."""
    of_work = params.effects.memory_of_work
    return slope_of(state, axle, lagging, params.patch, params.law, of_work)


@kernel_inlined
def slope_of(state, axle, lagging, patch, law, of_work):
    """Return the secant slope T / s of a contact, and lambda_0; arguments as `contact_force`."""
    at = max(abs(state.stage_sliding[axle]), SMALL_M_S)
    _, secant_N_s_m, lambda_0 = contact_force(
        at,
        state.stage_surface[axle],
        state.stage_load[axle],
        state.friction_degraded[axle],
        state.friction_recovered[axle],
        patch,
        law,
        lagging,
        of_work,
    )
    return secant_N_s_m, lambda_0


@kernel
def observe_work(state, plants):
    """Write the specific work [A3] of the contacts of all rigs, as `plant.observe` does.

    For rigs with the degraded law without memory, to the accuracy of `vector_secant`.
    """
    place_stage(state, plants)
    place_contacts(state, plants)
    follow_curves(state)
    for j in range(state.axles):
        f, _, state.is_solved[j] = vector_secant.recovered(
            state.stage_degraded[j],
            state.stage_recovered[j],
            state.stage_exponent[j],
            0.5 * state.stage_load[j],
            state.solved_work[j],
        )
        state.stage_slope[j] = f * state.stage_per_sliding[j] * state.stage_load[j]
    for j in range(state.axles):
        if state.is_solved[j] == 0.0:
            state.stage_slope[j] = outside_slope(state, j)
    for j in range(state.axles):
        size = abs(state.stage_sliding[j])
        creepage = size / max(abs(state.stage_surface[j]), adhesion.SPEED_FLOOR_M_S)
        state.dissipated_energy[j] = 0.5 * state.stage_slope[j] * size * creepage


@kernel
def place_stage(state, plants):
    """Let a stage begin at the present speeds and angles."""
    for j in range(state.axles):
        state.stage_wheel_speed[j] = state.wheel_speed[j]
        state.stage_roller_speed[j] = state.roller_speed[j]
        state.stage_angle[j] = state.wheel_angle[j]
        state.stage_transition[j] = state.lagged_transition[j]
    for rig in range(len(plants)):
        mine = rig_of(state, rig, plants[rig].axles)
        for j in range(mine.axles):
            mine.stage_vehicle_speed[j] = mine.vehicle_speed[0]
            mine.stage_felt[j] = mine.felt_acceleration[0]


@kernel
def integrate(state, plants):
    """Advance wheels, rollers and vehicles by one step.

    `plants` are the parameters of all rigs. Torques of brakes and motors are given at both ends of
    the step: `brake_capacity` and `motor_before` at its beginning, `brake_torque` and
    `motor_torque` at its end.
    """
    to_first_stage(state, plants)
    for rig in range(len(plants)):
        predict(rig_of(state, rig, plants[rig].axles), plants[rig])
    to_second_stage(state, plants)
    for rig in range(len(plants)):
        move(rig_of(state, rig, plants[rig].axles), plants[rig])


@kernel
def to_first_stage(state, plants):
    """Compute the forces and slopes of all contacts at the beginning of a step."""
    place_stage(state, plants)
    contacts(state, plants, plants[0].patch.model)
    first_stage(state)


@kernel
def to_second_stage(state, plants):
    """Compute those at the predicted end of a step, and move wheels and rollers."""
    contacts(state, plants, plants[0].patch.model)
    second_stage(state)


@kernel_inlined
def stage(state, axle, wheel_rad_s, brake_Nm, motor_Nm, wheel_before, roller_before):
    """Return (wheel_k, roller_k, T_N, acts_Nm) of an axle at a stage of a step [W1] to [W4].

    Parameters
    ----------
    wheel_rad_s : speed of the wheelset at the stage
    brake_Nm, motor_Nm : torque that the discs can hold, and u of the roller's motor
    wheel_before, roller_before : subtracted from the slopes before the implicit part is added

    Returns
    -------
    wheel_k, roller_k : slopes in rad/s2
    T_N : contact force with the part that is implicit
    acts_Nm : acting torque of the brake
    """
    r = state.radius[axle]
    R = state.roller_radius[axle]
    T = state.stage_slope[axle] * state.stage_sliding[axle]
    g = max(state.stage_slope[axle], 0.0)
    wheel_k, acts_Nm, locked = wheel_acceleration(
        wheel_rad_s, T, brake_Nm, dynamic_brake.torque(state, axle), r, state.per_inertia[axle]
    )
    roller_k = roller_acceleration(motor_Nm, T, R, state.per_roller_inertia[axle])
    p_wheel = 0.0 if locked else r * state.per_inertia[axle]
    p_roller = -R * state.per_roller_inertia[axle]
    wheel_k, roller_k, added_N = implicit_slopes(
        wheel_k - wheel_before,
        roller_k - roller_before,
        g,
        p_wheel,
        p_roller,
        r,
        R,
        state.stage_step[axle],
    )
    # the vehicle feels what wheel and roller feel, or momentum would be lost where they are stiff
    return wheel_k, roller_k, T + added_N, acts_Nm


@kernel
def first_stage(state):
    """Compute the slopes of wheels and rollers at the beginning of a step, and predict its end."""
    for j in range(state.axles):
        h = state.stage_step[j]
        wheel_k, roller_k, T_N, acts_Nm = stage(
            state,
            j,
            state.wheel_speed[j],
            state.brake_capacity[j],
            state.motor_before[j],
            0.0,
            0.0,
        )
        state.wheel_rate[j] = wheel_k
        state.roller_rate[j] = roller_k
        state.stage_force[j] = T_N
        state.contact_force[j] = 0.5 * T_N
        state.brake_mean[j] = 0.5 * acts_Nm
        state.stage_wheel_speed[j] = max(0.0, state.wheel_speed[j] + h * wheel_k)
        state.stage_roller_speed[j] = state.roller_speed[j] + h * roller_k
        state.stage_angle[j] = state.wheel_angle[j] + h * state.wheel_speed[j]


@kernel
def second_stage(state):
    """Compute the slopes at the end that the first stage predicts; move wheels and rollers.

    They move by the mean of both stages; no wheel turns backwards. The works of sliding, brake and
    motor are mean force times way. So the energy balance holds to rounding however stiff the
    contact is, except in the step in which a wheel stops.
    """
    for j in range(state.axles):
        h = state.stage_step[j]
        wheel1 = state.wheel_rate[j]
        roller1 = state.roller_rate[j]
        motor_Nm = state.motor_torque[j]
        wheel_k, roller_k, T_N, acts_Nm = stage(
            state,
            j,
            state.stage_wheel_speed[j],
            state.brake_torque[j],
            motor_Nm,
            2.0 * wheel1,
            2.0 * roller1,
        )
        state.stage_force[j] = T_N
        state.contact_force[j] += 0.5 * T_N
        state.brake_mean[j] += 0.5 * acts_Nm

        wheel = state.wheel_speed[j]
        roller = state.roller_speed[j]
        state.wheel_speed[j] = max(0.0, wheel + h * (1.5 * wheel1 + 0.5 * wheel_k))
        state.roller_speed[j] = roller + h * (1.5 * roller1 + 0.5 * roller_k)
        wheel_rad = 0.5 * h * (wheel + state.wheel_speed[j])
        roller_rad = 0.5 * h * (roller + state.roller_speed[j])
        state.wheel_angle[j] += wheel_rad
        state.roller_angle[j] += roller_rad

        slid_m = state.roller_radius[j] * roller_rad - state.radius[j] * wheel_rad
        state.sliding_work[j] += state.contact_force[j] * slid_m
        state.brake_work[j] += state.brake_mean[j] * wheel_rad
        state.dynamic_work[j] += dynamic_brake.torque(state, j) * wheel_rad
        state.motor_work[j] += 0.5 * (state.motor_before[j] + motor_Nm) * roller_rad
        state.brake_capacity[j] = state.brake_torque[j]
        state.motor_before[j] = motor_Nm


@kernel
def predict(state, params):
    """Predict the vehicle of a rig for the end of a step, by the forces of the first stage.

    Where recovery has a memory, lambda is predicted too.
    """
    if state.standing[0] != 0.0:
        return
    h = params.step_s
    v = state.vehicle_speed[0]
    felt = state.felt_acceleration[0]
    resistance_N = body.resistance(v, params.vehicle)
    magnets_N = track_brake.force_N(state, v, params.track_brake)
    total = resistance_N + magnets_N + state.coupler_force[0]
    for j in range(state.axles):
        total += state.stage_force[j]
    a1 = -total / params.vehicle.mass_kg  # [V1] of `vehicle`
    f1 = (a1 - felt) / params.vehicle.pitch_time_constant_s
    state.rate_before[0] = a1
    state.felt_rate_before[0] = f1
    state.resistance_before[0] = resistance_N
    state.magnets_before[0] = magnets_N
    for j in range(state.axles):
        state.stage_vehicle_speed[j] = v + h * a1
        state.stage_felt[j] = felt + h * f1
    if params.effects.memory_m > 0.0:
        for j in range(state.axles):
            state.transition_before[j] = state.instantaneous_transition[j]
            state.stage_transition[j] = lagged_transition(
                state.lagged_transition[j], state.transition_before[j], v, h, params.effects
            )


@kernel
def move(state, params):
    """Move the vehicle of a rig by the mean of both stages.

    A memory of recovery is stepped exactly under the mean of lambda_0 at both stages.
    """
    if state.standing[0] != 0.0:
        return
    h = params.step_s
    v = state.vehicle_speed[0]
    v2 = state.stage_vehicle_speed[0]
    felt = state.felt_acceleration[0]
    felt2 = state.stage_felt[0]
    if params.effects.memory_m > 0.0:
        for j in range(state.axles):
            mean = 0.5 * (state.transition_before[j] + state.instantaneous_transition[j])
            state.lagged_transition[j] = lagged_transition(
                state.lagged_transition[j], mean, 0.5 * (v + v2), h, params.effects
            )

    resistance_N = body.resistance(v2, params.vehicle)
    magnets_N = track_brake.force_N(state, v2, params.track_brake)
    total = resistance_N + magnets_N + state.coupler_force[0]
    for j in range(state.axles):
        total += state.stage_force[j]
    a2 = -total / params.vehicle.mass_kg
    f2 = (a2 - felt2) / params.vehicle.pitch_time_constant_s
    state.felt_acceleration[0] = felt + 0.5 * h * (state.felt_rate_before[0] + f2)
    state.vehicle_acceleration[0] = 0.5 * (state.rate_before[0] + a2)
    state.vehicle_speed[0] = max(0.0, v + h * state.vehicle_acceleration[0])
    way_m = 0.5 * h * (v + state.vehicle_speed[0])
    state.position[0] += way_m
    state.resistance_work[0] += 0.5 * (state.resistance_before[0] + resistance_N) * way_m
    state.track_brake_work[0] += 0.5 * (state.magnets_before[0] + magnets_N) * way_m
    if params.mode == 0:
        # on a track the surface moves with the vehicle, not with a roller
        for j in range(state.axles):
            state.sliding_work[j] += state.contact_force[j] * way_m


@kernel
def lock_s(locked_s, longest_s, rim_m_s, vehicle_m_s, above_m_s, tick_s):
    """Return how long a wheelset is locked now, and its longest lock, after a tick.

    A lock counts while the vehicle is faster than `above_m_s`.
    """
    is_locked = (vehicle_m_s > above_m_s) & (rim_m_s < LOCKED_BELOW_M_S)
    locked_s = locked_s + tick_s if is_locked else 0.0
    return locked_s, max(longest_s, locked_s)
