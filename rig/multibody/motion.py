"""The coach in motion: one time step of 42 coordinates, four rollers and eight wheels.

Positions move half a step, forces are computed there, speeds move a whole step, positions move the
other half: second order for springs and contacts, whose 200 Hz need no more. Creep is stiffer the
slower the coach runs. Therefore its secant slopes enter the speeds linearly implicitly, with one
4x4 and one 3x3 system for each wheelset. The brake is dry friction, solved exactly: it stops a
wheel if it can, and holds.

[M1] q' = q + h/2 v, (M + h theta G) dv = h F(q', v), v += dv, q = q' + h/2 v
[M2] theta = 1/2 up to z = h max(G/M) = 1, beyond it 1 - 1/(2 z): no oscillation however stiff
[M3] along: (v_x, omega, yaw rate, roller speed); across: (v_y, v_z, roll rate) of each wheelset
[M4] wheelset as a gyroscope: I_x d(roll rate) = M_x + J omega yaw rate, I_z d(yaw rate) = M_z -
     J omega roll rate, moments across the axis
[M5] brake C = min(C_max, the torque that stops the wheel within the step); it turns the bogie frame
[M6] work of sliding with the creep force and the speeds in the middle of the step, exactly
[M7] on rollers the rig's restraint takes the force of the contacts along the rail except the
     creep force: a wheelset behind the crown of its roller leans on it with N n_x, which no motor
     of a roller feels, so it is no force on the virtual vehicle. It acts at the car's centre of
     mass (assumption)

Source: [M1] position Verlet with a W-method for the creep, Hairer and Wanner 1996, IV.7; the
paper's section 2. Below 0.1 m/s creepage is sliding over 0.1 m/s.
"""

import math

from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact.geometry import Z as CONTACT_Z
from rollerrig.rig.multibody import eight_contacts, links
from rollerrig.rig.multibody import wheel_rail_forces as forces
from rollerrig.rig.multibody.coordinates import (
    BEFORE_WHEELSETS,
    BODIES,
    COORDINATES,
    FIRST_WHEELSET,
    PER_BODY,
    PITCH,
    ROLL,
    YAW,
    X,
    Y,
    Z,
)

# least place on the track that is stored for a wheel that has left its rail; 0 means "on the rail"
LEAST_PLACE_M = 1e-3


@kernel
def start(motion, coach, speed_m_s):
    """Set a coach in equilibrium that rolls freely at a speed in m/s."""
    motion.q[:] = 0.0
    motion.v[:] = 0.0
    for body in range(BODIES):
        motion.v[PER_BODY * body + X] = speed_m_s
    for wheel in range(2 * COACH_AXLES):
        forces.follow(
            wheel,
            motion.q,
            0.0,
            motion.contacts,
            motion.contact_count,
            motion.misfit,
            motion.searched_at,
            coach.axle_height_m,
            coach.roller_m,
            coach.wheel,
            coach.rail,
            0,
        )
    for j in range(COACH_AXLES):
        # the first contact of the left wheel is below the axle by the rolling radius
        radius_m = -motion.contacts[2 * j * forces.MOST, CONTACT_Z]
        motion.v[PER_BODY * (FIRST_WHEELSET + j) + PITCH] = speed_m_s / radius_m
        # the values before the first step
        motion.wheelset_forces[j, :] = 0.0
        for wheel in range(2 * j, 2 * j + 2):
            motion.wheel_forces[wheel, :] = 0.0
            motion.wheel_forces[wheel, forces.LOAD] = coach.weight_N.sum() / (2 * COACH_AXLES)


@kernel
def mean_speed(v, coach):
    """Return the speed in m/s of the coach's centre of mass."""
    momentum = 0.0
    for body in range(BODIES):
        momentum += coach.inertia[PER_BODY * body + X] * v[PER_BODY * body + X]
    return momentum / coach.mass_kg


@kernel
def step(
    motion,
    coach,
    h,
    roller_rad_s,
    motor_Nm,
    roller_inertia_kgm2,
    brake_Nm,
    brake_acts_Nm,
    resistance_N,
    mu_cd,
    mu_cr,
    law,
):
    """Advance the coach by h seconds; arrays of shape (4,) belong to the wheelsets.

    `roller_rad_s` is advanced too (all 0 and unchanged on a track). `brake_Nm` is the largest
    torque of the brakes; the torque that acts is written to `brake_acts_Nm`.
    """
    hang(motion, coach, h, resistance_N)
    touch(motion, coach, roller_rad_s, mu_cd, mu_cr, law)
    respond(
        motion,
        coach,
        h,
        roller_rad_s,
        motor_Nm,
        roller_inertia_kgm2,
        brake_Nm,
        brake_acts_Nm,
        resistance_N,
    )


@kernel_inlined
def hang(motion, coach, h, resistance_N):
    """Move the positions by half a step, and compute weight, suspension and resistance there."""
    q = motion.q
    v = motion.v
    force = motion.force
    half = 0.5 * h
    for i in range(COORDINATES):
        q[i] += half * v[i]  # [M1]
        force[i] = -coach.weight_N[i]
    links.springs(q, force, coach.springs)
    motion.damper_work[0] += h * links.curves(q, v, force, coach.curves)
    force[X] -= resistance_N


@kernel_inlined
def touch(motion, coach, roller_rad_s, mu_cd, mu_cr, law):
    """Compute the contacts of all wheels, and their forces."""
    on_rollers = not math.isinf(coach.roller_m)
    speed = 0.0
    place = 0.0
    if on_rollers:
        speed = mean_speed(motion.v, coach)
        # the mean of the displacements, weighted with the masses as the mean speed is
        place = mean_speed(motion.q, coach)

    # another wheelset is first in each step, so that all get their searches
    first = int(motion.first_wheelset[0])
    motion.first_wheelset[0] = (first + 1) % COACH_AXLES
    searches_left = forces.SEARCHES
    lane = 0
    for k in range(COACH_AXLES):
        j = (first + k) % COACH_AXLES
        offset = motion.q[PER_BODY * (FIRST_WHEELSET + j) + X] - place if on_rollers else 0.0
        searches_left = follow(j, motion, coach, offset, searches_left)
        lane = forces.slide(
            j,
            motion.q,
            motion.v,
            speed,
            roller_rad_s[j],
            motion.contacts,
            motion.contact_count,
            mu_cd[j],
            mu_cr[j],
            coach.patches,
            coach.contact_damping_N_s_m,
            coach.roller_m,
            motion.lanes,
            lane,
        )
    eight_contacts.forces(motion.lanes, lane, coach.patches, law)

    # the same order, so that each contact finds its lane again
    lane = 0
    for k in range(COACH_AXLES):
        j = (first + k) % COACH_AXLES
        lane = forces.press(
            j,
            motion.contacts,
            motion.contact_count,
            coach.contact_damping_N_s_m,
            motion.wheelset_forces,
            motion.Gx[j],
            motion.Gy[j],
            motion.wheel_forces,
            motion.lanes,
            lane,
        )


@kernel_inlined
def respond(
    motion,
    coach,
    h,
    roller_rad_s,
    motor_Nm,
    roller_inertia_kgm2,
    brake_Nm,
    brake_acts_Nm,
    resistance_N,
):
    """Compute the speeds at the end of the step, and move the positions by the second half."""
    q = motion.q
    v = motion.v
    force = motion.force
    on_rollers = not math.isinf(coach.roller_m)
    half = 0.5 * h
    leaning_N = 0.0
    for j in range(COACH_AXLES):
        brake = along(
            j,
            motion,
            coach.inertia,
            h,
            roller_rad_s,
            motor_Nm[j],
            roller_inertia_kgm2,
            brake_Nm[j],
            on_rollers,
        )
        across(j, motion, coach.inertia, h)
        bogie = PER_BODY * coach.bogie_of[j]
        force[bogie + PITCH] += brake  # [M5]
        brake_acts_Nm[j] = brake
        motion.brake_work[j] -= h * brake * v[bogie + PITCH]
        motion.approach_work[0] += h * motion.wheelset_forces[j, forces.APPROACH_W]
        leaning_N += (
            motion.wheelset_forces[j, forces.FORCE] - motion.wheelset_forces[j, forces.ALONG]
        )
    if on_rollers:
        force[X] -= leaning_N  # [M7]

    # car and bogies have no contacts: their step is explicit
    for i in range(BEFORE_WHEELSETS):
        v[i] += h * force[i] / coach.inertia[i]
    motion.resistance_work[0] += (
        half * resistance_N * (v[X] + v[X] - h * force[X] / coach.inertia[X])
    )
    for i in range(COORDINATES):
        q[i] += half * v[i]


@kernel_inlined
def follow(j, motion, coach, offset_m, searches_left):
    """Move the contacts of wheelset j on; return how many searches are left in this step."""
    for wheel in range(2 * j, 2 * j + 2):
        searches_left = forces.follow(
            wheel,
            motion.q,
            offset_m,
            motion.contacts,
            motion.contact_count,
            motion.misfit,
            motion.searched_at,
            coach.axle_height_m,
            coach.roller_m,
            coach.wheel,
            coach.rail,
            searches_left,
        )
        if motion.contact_count[wheel] == 0.0 and motion.left[wheel] == 0.0:
            # no rail is within reach of the wheel any more: it will not come back
            motion.left[wheel] = max(motion.q[PER_BODY * (FIRST_WHEELSET + j) + X], LEAST_PLACE_M)
    return searches_left


@kernel_inlined
def along(j, motion, inertia, h, roller_rad_s, motor_Nm, roller_inertia_kgm2, brake_Nm, on_rollers):
    """Advance a wheelset along, in rotation and yaw, and its roller; return the brake torque."""
    v = motion.v
    force = motion.force
    G = motion.Gx[j]
    contact = motion.wheelset_forces
    i = PER_BODY * (FIRST_WHEELSET + j)
    ex, ey, ez = forces.axis(motion.q[i + ROLL], motion.q[i + YAW])
    # moment about the axis of the wheelset
    about = (
        contact[j, forces.MOMENT] * ex
        + contact[j, forces.MOMENT + 1] * ey
        + contact[j, forces.MOMENT + 2] * ez
    )
    gyro = inertia[i + PITCH] * v[i + PITCH]

    # generalised forces and inertias [M3]: 0 along, 1 rotation, 2 yaw, 3 roller
    f0 = force[i + X] + contact[j, forces.FORCE]
    f1 = about
    f2 = force[i + YAW] + contact[j, forces.MOMENT + 2] - about * ez - gyro * v[i + ROLL]  # [M4]
    f3 = (motor_Nm + contact[j, forces.ALONG + 3]) if on_rollers else 0.0
    m0 = inertia[i + X]
    m1 = inertia[i + PITCH]
    m2 = inertia[i + YAW]
    m3 = roller_inertia_kgm2
    w = theta(h * max(G[0, 0] / m0, G[1, 1] / m1, G[2, 2] / m2, G[3, 3] / m3)) * h

    # factors L D L' of M + h theta G [M3]
    d0 = m0 + w * G[0, 0]
    l10 = w * G[1, 0] / d0
    l20 = w * G[2, 0] / d0
    l30 = w * G[3, 0] / d0
    d1 = m1 + w * G[1, 1] - l10 * l10 * d0
    l21 = (w * G[2, 1] - l20 * l10 * d0) / d1
    l31 = (w * G[3, 1] - l30 * l10 * d0) / d1
    d2 = m2 + w * G[2, 2] - l20 * l20 * d0 - l21 * l21 * d1
    l32 = (w * G[3, 2] - l30 * l20 * d0 - l31 * l21 * d1) / d2
    d3 = m3 + w * G[3, 3] - l30 * l30 * d0 - l31 * l31 * d1 - l32 * l32 * d2

    # x: the accelerations by all forces without the brake
    y1 = f1 - l10 * f0
    y2 = f2 - l20 * f0 - l21 * y1
    x3 = (f3 - l30 * f0 - l31 * y1 - l32 * y2) / d3
    x2 = y2 / d2 - l32 * x3
    x1 = y1 / d1 - l21 * x2 - l31 * x3
    x0 = f0 / d0 - l10 * x1 - l20 * x2 - l30 * x3

    # u: the accelerations by 1 N m against the brake
    u2 = -l21
    u3 = (-l31 - l32 * u2) / d3
    u2 = u2 / d2 - l32 * u3
    u1 = 1.0 / d1 - l21 * u2 - l31 * u3
    u0 = -l10 * u1 - l20 * u2 - l30 * u3

    rotation_without_brake = v[i + PITCH] + h * x1
    stops_Nm = rotation_without_brake / (h * u1)
    brake = min(max(stops_Nm, -brake_Nm), brake_Nm)  # [M5]

    # changes of the speeds in the step
    s0 = h * (x0 - brake * u0)
    s1 = h * (x1 - brake * u1)
    s2 = h * (x2 - brake * u2)
    s3 = h * (x3 - brake * u3)
    contact[j, forces.BRAKING_N] = -contact[j, forces.ALONG] + w / h * (
        G[0, 0] * s0 + G[1, 0] * s1 + G[2, 0] * s2 + G[3, 0] * s3
    )

    # work of sliding and of the brake [M6]
    power_W = contact[j, forces.SLIDING_W] + middle(
        contact, j, forces.ALONG, forces.ALONG_GS, w / h, G, s0, s1, s2, s3
    )
    motion.sliding_work[j] += h * power_W
    motion.brake_work[j] += h * brake * (v[i + PITCH] + 0.5 * s1)

    v[i + X] += s0
    v[i + PITCH] = 0.0 if brake == stops_Nm else v[i + PITCH] + s1
    v[i + YAW] += s2
    if on_rollers:
        roller_rad_s[j] += s3
    return brake


@kernel_inlined
def middle(wheelset_forces, j, force_at, gs_at, weight, G, s0, s1, s2, s3):
    """Return the power of sliding that the changes s of the speeds add to the initial one [M6]."""
    s = (s0, s1, s2, s3)
    linear = 0.0
    quadratic = 0.0
    for k in range(4):
        linear += s[k] * (
            weight * wheelset_forces[j, gs_at + k] - 0.5 * wheelset_forces[j, force_at + k]
        )
        # G is symmetric and has its lower triangle only
        for m in range(k + 1):
            quadratic += s[k] * s[m] * G[k, m] * (1.0 if m == k else 2.0)
    return linear + 0.5 * weight * quadratic


@kernel_inlined
def across(j, motion, inertia, h):
    """Advance the speeds of a wheelset across the track, upwards and in roll."""
    v = motion.v
    force = motion.force
    G = motion.Gy[j]
    contact = motion.wheelset_forces
    i = PER_BODY * (FIRST_WHEELSET + j)
    ex, ey, ez = forces.axis(motion.q[i + ROLL], motion.q[i + YAW])
    about = (
        contact[j, forces.MOMENT] * ex
        + contact[j, forces.MOMENT + 1] * ey
        + contact[j, forces.MOMENT + 2] * ez
    )

    # generalised forces and inertias [M3]: 0 across, 1 upwards, 2 roll
    f0 = force[i + Y] + contact[j, forces.FORCE + 1]
    f1 = force[i + Z] + contact[j, forces.FORCE + 2]
    # the yaw rate is new by now: roll follows with it, which keeps the gyroscope's energy
    f2 = (
        force[i + ROLL]
        + contact[j, forces.MOMENT]
        - about * ex
        + inertia[i + PITCH] * v[i + PITCH] * v[i + YAW]
    )  # [M4]
    m0 = inertia[i + X]
    m2 = inertia[i + ROLL]
    w = theta(h * max(G[0, 0] / m0, G[1, 1] / m0, G[2, 2] / m2)) * h

    # L D L' of M + h theta G, and the changes s of the speeds
    d0 = m0 + w * G[0, 0]
    l10 = w * G[1, 0] / d0
    l20 = w * G[2, 0] / d0
    d1 = m0 + w * G[1, 1] - l10 * l10 * d0
    l21 = (w * G[2, 1] - l20 * l10 * d0) / d1
    d2 = m2 + w * G[2, 2] - l20 * l20 * d0 - l21 * l21 * d1
    y1 = f1 - l10 * f0
    x2 = (f2 - l20 * f0 - l21 * y1) / d2
    x1 = y1 / d1 - l21 * x2
    x0 = f0 / d0 - l10 * x1 - l20 * x2
    s0 = h * x0
    s1 = h * x1
    s2 = h * x2

    # work of sliding [M6]
    work = s0 * (w / h * contact[j, forces.ACROSS_GS] - 0.5 * contact[j, forces.ACROSS])
    work += s1 * (w / h * contact[j, forces.ACROSS_GS + 1] - 0.5 * contact[j, forces.ACROSS + 1])
    work += s2 * (w / h * contact[j, forces.ACROSS_GS + 2] - 0.5 * contact[j, forces.ACROSS + 2])
    work += (
        0.5
        * w
        / h
        * (
            G[0, 0] * s0 * s0
            + G[1, 1] * s1 * s1
            + G[2, 2] * s2 * s2
            + 2.0 * (G[1, 0] * s1 * s0 + G[2, 0] * s2 * s0 + G[2, 1] * s2 * s1)
        )
    )
    motion.sliding_work[j] += h * work

    v[i + Y] += s0
    v[i + Z] += s1
    v[i + ROLL] += s2


@kernel_inlined
def theta(z):
    """Return how implicit a step is, for its largest h G / M [M2]."""
    return 0.5 if z <= 1.0 else 1.0 - 0.5 / z
