"""The coach in motion: one time step of 42 coordinates, four rollers and eight wheels.

Positions move half a step, forces are taken there, speeds move a whole step, positions the other
half: second order for springs and contacts, whose 200 Hz need no more. Creep is stiffer the slower
the coach runs, so its secant slopes enter the speeds linearly implicitly, one 4x4 and one 3x3
system a wheelset; the brake is dry friction, solved exactly: it stops a wheel if it can, and holds.

[M1] q' = q + h/2 v, (M + h theta G) dv = h F(q', v), v += dv, q = q' + h/2 v
[M2] theta = 1/2 up to z = h max(G/M) = 1, beyond it 1 - 1/(2 z): no oscillation however stiff
[M3] along: (v_x, omega, yaw rate, roller speed); across: (v_y, v_z, roll rate) of each wheelset
[M4] wheelset as a gyroscope: I_x d(roll rate) = M_x + J omega yaw rate, I_z d(yaw rate) = M_z -
     J omega roll rate, moments across the axis
[M5] brake C = min(C_max, what stops the wheel within the step); it turns the bogie frame
[M6] work of sliding with the creep force and the speeds in the middle of the step, exactly
[M7] on rollers the rig's restraint takes what contacts push along the rail beside the creep force: a
     wheelset that stands behind its roller's crown leans on it with N n_x, which no roller's motor
     feels, so it is no force on the virtual vehicle. It acts at the car's centre of mass (assumption)

Source: [M1] position Verlet with a W-method for the creep, Hairer and Wanner 1996, IV.7; the
paper's section 2. Below 0.1 m/s creepage is sliding over 0.1 m/s.
"""

import math

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.multibody import eight_contacts, links
from rollerrig.rig.multibody import wheel_rail_forces as forces

LEAST_PLACE_M = 1e-3  # where a wheel that was off its rail from the beginning has left it


@kernel
def start(motion, coach, speed_m_s):
    """Set a coach in equilibrium that rolls freely at a speed in m/s."""
    motion.q[:] = 0.0
    motion.v[:] = 0.0
    for body in range(7):
        motion.v[6 * body] = speed_m_s
    for wheel in range(2 * AXLES):
        forces.follow(
            wheel,
            motion.q,
            0.0,
            motion.contacts,
            motion.near,
            motion.misfit,
            motion.searched,
            coach.axle_height_m,
            coach.roller_m,
            coach.wheel,
            coach.rail,
            0,
        )
    for j in range(AXLES):
        radius = -motion.contacts[2 * j * forces.MOST, 4]
        motion.v[6 * (3 + j) + 4] = speed_m_s / radius
        # what will be seen before the first step
        motion.given[j, :] = 0.0
        for wheel in range(2 * j, 2 * j + 2):
            motion.seen[wheel, :] = 0.0
            motion.seen[wheel, forces.LOAD] = coach.weight_N.sum() / (2 * AXLES)


@kernel
def mean_speed(v, coach):
    """Speed in m/s of the coach's centre of mass."""
    momentum = 0.0
    for body in range(7):
        momentum += coach.inertia[6 * body] * v[6 * body]
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
    """Advance by h seconds; arrays of shape (4,) belong to the wheelsets.

    `roller_rad_s` is advanced too (all 0 and untouched on a track); `brake_Nm` is what the brakes
    can hold, `brake_acts_Nm` takes what acted.
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
    """First half of the way, and the forces of weight, suspension and resistance there."""
    q, v, force = motion.q, motion.v, motion.force
    half = 0.5 * h
    for i in range(42):
        q[i] += half * v[i]  # [M1]
        force[i] = -coach.weight_N[i]
    links.springs(q, force, coach.springs)
    motion.damper_work[0] += h * links.curves(q, v, force, coach.curves)
    force[0] -= resistance_N


@kernel_inlined
def touch(motion, coach, roller_rad_s, mu_cd, mu_cr, law):
    """The contacts of all wheels, and what they give."""
    speed, place, spare, lanes, first = 0.0, 0.0, forces.SEARCHES, 0, int(motion.turn[0])
    motion.turn[0] = (first + 1) % AXLES
    on_rollers = not math.isinf(coach.roller_m)
    if on_rollers:
        speed, place = mean_speed(motion.v, coach), mean_speed(motion.q, coach)
    for k in range(AXLES):
        # another wheelset is first each step, so that all get their searches
        j = (first + k) % AXLES
        offset = motion.q[6 * (3 + j)] - place if on_rollers else 0.0
        spare = follow(j, motion, coach, offset, spare)
        lanes = forces.slide(
            j,
            motion.q,
            motion.v,
            speed,
            roller_rad_s[j],
            motion.contacts,
            motion.near,
            mu_cd[j],
            mu_cr[j],
            coach.patches,
            coach.contact_damping_N_s_m,
            coach.roller_m,
            motion.lanes,
            lanes,
        )
    eight_contacts.forces(motion.lanes, lanes, coach.patches, law)
    lanes = 0
    for k in range(AXLES):
        j = (first + k) % AXLES
        lanes = forces.press(
            j,
            motion.contacts,
            motion.near,
            coach.contact_damping_N_s_m,
            motion.given,
            motion.Gx[j],
            motion.Gy[j],
            motion.seen,
            motion.lanes,
            lanes,
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
    """Speeds at the end of the step under all forces, and the second half of the way."""
    q, v, force = motion.q, motion.v, motion.force
    on_rollers, half, leaning_N = not math.isinf(coach.roller_m), 0.5 * h, 0.0
    for j in range(AXLES):
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
        bogie = 6 * coach.bogie_of[j]
        force[bogie + 4] += brake  # [M5]
        brake_acts_Nm[j] = brake
        motion.brake_work[j] -= h * brake * v[bogie + 4]
        motion.approach_work[0] += h * motion.given[j, forces.APPROACH_W]
        leaning_N += motion.given[j, 0] - motion.given[j, forces.ALONG]
    if on_rollers:
        force[0] -= leaning_N  # [M7]
    for i in range(18):
        v[i] += h * force[i] / coach.inertia[i]
    motion.resistance_work[0] += (
        half * resistance_N * (v[0] + v[0] - h * force[0] / coach.inertia[0])
    )
    for i in range(42):
        q[i] += half * v[i]


@kernel_inlined
def follow(j, motion, coach, offset_m, spare):
    """Move the contacts of wheelset j on, as `wheel_rail_forces.follow`. Returns what is left of `spare`."""
    for wheel in range(2 * j, 2 * j + 2):
        spare = forces.follow(
            wheel,
            motion.q,
            offset_m,
            motion.contacts,
            motion.near,
            motion.misfit,
            motion.searched,
            coach.axle_height_m,
            coach.roller_m,
            coach.wheel,
            coach.rail,
            spare,
        )
        if motion.near[wheel] == 0.0 and motion.left[wheel] == 0.0:
            # nothing within reach of it any more: it will not come back
            motion.left[wheel] = max(motion.q[6 * (3 + j)], LEAST_PLACE_M)
    return spare


@kernel_inlined
def along(j, motion, inertia, h, roller_rad_s, motor_Nm, roller_inertia_kgm2, brake_Nm, on_rollers):
    """Speeds of a wheelset along the track, of its rotation, yaw and roller; returns the brake."""
    v, force, G, given = motion.v, motion.force, motion.Gx[j], motion.given
    i = 6 * (3 + j)
    ex, ey, ez = forces.axis(motion.q[i + 3], motion.q[i + 5])
    about = given[j, 3] * ex + given[j, 4] * ey + given[j, 5] * ez
    gyro = inertia[i + 4] * v[i + 4]
    # generalised forces
    f0 = force[i] + given[j, 0]
    f1 = about
    f2 = force[i + 5] + given[j, 5] - about * ez - gyro * v[i + 3]  # [M4]
    f3 = (motor_Nm + given[j, forces.ALONG + 3]) if on_rollers else 0.0
    m0, m1, m2, m3 = inertia[i], inertia[i + 4], inertia[i + 5], roller_inertia_kgm2
    w = theta(h * max(G[0, 0] / m0, G[1, 1] / m1, G[2, 2] / m2, G[3, 3] / m3)) * h
    # L D L' of M + h theta G [M3]
    d0 = m0 + w * G[0, 0]
    l10, l20, l30 = w * G[1, 0] / d0, w * G[2, 0] / d0, w * G[3, 0] / d0
    d1 = m1 + w * G[1, 1] - l10 * l10 * d0
    l21 = (w * G[2, 1] - l20 * l10 * d0) / d1
    l31 = (w * G[3, 1] - l30 * l10 * d0) / d1
    d2 = m2 + w * G[2, 2] - l20 * l20 * d0 - l21 * l21 * d1
    l32 = (w * G[3, 2] - l30 * l20 * d0 - l31 * l21 * d1) / d2
    d3 = m3 + w * G[3, 3] - l30 * l30 * d0 - l31 * l31 * d1 - l32 * l32 * d2
    # what forces do, and what 1 N m of brake does
    y1 = f1 - l10 * f0
    y2 = f2 - l20 * f0 - l21 * y1
    x3 = (f3 - l30 * f0 - l31 * y1 - l32 * y2) / d3
    x2 = y2 / d2 - l32 * x3
    x1 = y1 / d1 - l21 * x2 - l31 * x3
    x0 = f0 / d0 - l10 * x1 - l20 * x2 - l30 * x3
    u2 = -l21
    u3 = (-l31 - l32 * u2) / d3
    u2 = u2 / d2 - l32 * u3
    u1 = 1.0 / d1 - l21 * u2 - l31 * u3
    u0 = -l10 * u1 - l20 * u2 - l30 * u3
    free = v[i + 4] + h * x1
    stops_Nm = free / (h * u1)
    brake = min(max(stops_Nm, -brake_Nm), brake_Nm)  # [M5]
    s0, s1 = h * (x0 - brake * u0), h * (x1 - brake * u1)
    s2, s3 = h * (x2 - brake * u2), h * (x3 - brake * u3)
    given[j, forces.BRAKING_N] = -given[j, forces.ALONG] + w / h * (
        G[0, 0] * s0 + G[1, 0] * s1 + G[2, 0] * s2 + G[3, 0] * s3
    )
    # [M6]
    work = given[j, forces.SLIDING_W] + middle(
        given, j, forces.ALONG, forces.ALONG_GS, w / h, G, s0, s1, s2, s3
    )
    motion.sliding_work[j] += h * work
    motion.brake_work[j] += h * brake * (v[i + 4] + 0.5 * s1)
    v[i] += s0
    v[i + 4] = 0.0 if brake == stops_Nm else v[i + 4] + s1
    v[i + 5] += s2
    if on_rollers:
        roller_rad_s[j] += s3
    return brake


@kernel_inlined
def middle(given, j, force, gs, weight, G, s0, s1, s2, s3):
    """Power of sliding that the change of speeds s adds to that at the step's beginning [M6]."""
    s = (s0, s1, s2, s3)
    power, quadratic = 0.0, 0.0
    for k in range(4):
        power += s[k] * (weight * given[j, gs + k] - 0.5 * given[j, force + k])
        for m in range(k + 1):
            quadratic += s[k] * s[m] * G[k, m] * (1.0 if m == k else 2.0)
    return power + 0.5 * weight * quadratic


@kernel_inlined
def across(j, motion, inertia, h):
    """Speeds of a wheelset across the track, upwards and in roll."""
    v, force, G, given = motion.v, motion.force, motion.Gy[j], motion.given
    i = 6 * (3 + j)
    ex, ey, ez = forces.axis(motion.q[i + 3], motion.q[i + 5])
    about = given[j, 3] * ex + given[j, 4] * ey + given[j, 5] * ez
    f0, f1 = force[i + 1] + given[j, 1], force[i + 2] + given[j, 2]
    # the yaw rate is new by now: roll follows with it, which keeps the gyroscope's energy
    f2 = force[i + 3] + given[j, 3] - about * ex + inertia[i + 4] * v[i + 4] * v[i + 5]  # [M4]
    m0, m2 = inertia[i], inertia[i + 3]
    w = theta(h * max(G[0, 0] / m0, G[1, 1] / m0, G[2, 2] / m2)) * h
    d0 = m0 + w * G[0, 0]
    l10, l20 = w * G[1, 0] / d0, w * G[2, 0] / d0
    d1 = m0 + w * G[1, 1] - l10 * l10 * d0
    l21 = (w * G[2, 1] - l20 * l10 * d0) / d1
    d2 = m2 + w * G[2, 2] - l20 * l20 * d0 - l21 * l21 * d1
    y1 = f1 - l10 * f0
    x2 = (f2 - l20 * f0 - l21 * y1) / d2
    x1 = y1 / d1 - l21 * x2
    x0 = f0 / d0 - l10 * x1 - l20 * x2
    s0, s1, s2 = h * x0, h * x1, h * x2
    work = s0 * (w / h * given[j, forces.ACROSS_GS] - 0.5 * given[j, forces.ACROSS])
    work += s1 * (w / h * given[j, forces.ACROSS_GS + 1] - 0.5 * given[j, forces.ACROSS + 1])
    work += s2 * (w / h * given[j, forces.ACROSS_GS + 2] - 0.5 * given[j, forces.ACROSS + 2])
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
    v[i + 1] += s0
    v[i + 2] += s1
    v[i + 3] += s2


@kernel_inlined
def theta(z):
    """How implicit a step is, for its largest h G / M [M2]."""
    return 0.5 if z <= 1.0 else 1.0 - 0.5 / z
