"""Wheel and rail (or roller) under a wheelset: contact points, normal and creep forces.

The contacts of each wheel are followed from step to step. Where wheel and rail interpenetrate,
Hertz' spring and a damper press them apart, and the creep force of the chosen model acts against
the sliding of the wheel's material on the rail's, spin included. The time step also gets the secant
slopes of the forces, which it needs at low speed.

[N1] N = k_h p^(3/2) + c max(dp/dt, 0), p = -gap > 0                             paper eqs. 4, 5
[N2] s = (v + Omega x rho) along t1, t2, spin = Omega . n, on a roller with its surface's motion
[N3] F = N n + f_x t1 + f_y t2 at rho, and m_z n
[N4] g = |f| / (|s| + a |spin|), a = 5 mm: f is about -g s, so its Jacobian is taken as -g J'J

t1 lies along the track, t2 across, n out of the rail; rho from the wheelset's centre to the
contact. Eq. 5 of the paper prints p = max(..., 0) for a quantity that is negative in contact; read
as above.
"""

import math

import numpy as np

from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import geometry
from rollerrig.rig.contact import patch as patch_table
from rollerrig.rig.contact.geometry import GAP, LATERAL, MOST, NX, NY, NZ, RAIL_Z, ROLLING, X, Y, Z
from rollerrig.rig.contact.profiles import Rail, Wheel
from rollerrig.rig.multibody import coordinates
from rollerrig.rig.multibody import eight_contacts as lanes
from rollerrig.rig.multibody.coordinates import FIRST_WHEELSET, PER_BODY, PITCH, ROLL, YAW

# A wheel is searched for new contacts when it has moved by this distance since its last search, but
# at most so many wheels in a step.
MOVED_M = 5e-5
SEARCHES = 2
# lever arms that turn a rotation of the wheelset into a distance, for the comparison with MOVED_M
ROLL_ARM_M = 0.75
YAW_ARM_M = 0.1

# arm of the spin in [N4]
_SPIN_ARM_M = 0.005
# keeps [N4] finite for a contact without sliding
_LEAST_M_S = 1e-9

# Columns of what the contacts of one wheelset give. Each name is the first of several columns:
FORCE = 0  # force in N along, across and up
MOMENT = 3  # moment in N m in roll, pitch and yaw
ALONG = 6  # generalised force of sliding along, over (v_x, omega, yaw rate, roller speed)
ACROSS = 10  # generalised force of sliding across, over (v_y, v_z, roll rate)
ALONG_GS = 13  # g s J of [N4] along (4)
ACROSS_GS = 17  # g s J of [N4] across (3)
SLIDING_W = 20  # power of sliding
APPROACH_W = 21  # power of the dampers of the contacts
BRAKING_N = 22  # mean braking force in the time step, which the time step writes
WHEELSET_COLUMNS = 23

# columns of one wheel: vertical load N, longitudinal and lateral force N, sliding along m/s (its
# mean over the contacts, weighted with their normal forces), sum of the normal forces N
LOAD, PULL, SIDE, SLIP, TOUCHING = range(5)
WHEEL_COLUMNS = 5

# columns of `searched_at`
_SEARCHED_Y, _SEARCHED_Z, _SEARCHED_ROLL, _SEARCHED_YAW = range(4)


@kernel_inlined
def axis(roll_rad, yaw_rad):
    """Return a wheelset's axis, a unit vector to the left, for small rotations."""
    return -yaw_rad, math.sqrt(1.0 - roll_rad * roll_rad - yaw_rad * yaw_rad), roll_rad


@kernel_inlined
def follow(
    wheel,
    q,
    offset_m,
    contacts,
    contact_count,
    misfit,
    searched_at,
    axle_height_m,
    roller_m,
    profile,
    rail,
    searches_left,
):
    """Move the contacts of a wheel on; return how many searches are left in this step.

    Wheel 2 j is the left one of wheelset j, 2 j + 1 the right one. q (42,); offset_m of the
    wheelset in front of a roller's crown. The wheel is searched again if it has lost a contact, or
    if it has moved since `searched_at` (8, 4) and searches are left.
    """
    first = PER_BODY * (FIRST_WHEELSET + wheel // 2)
    side = 1.0 - 2.0 * (wheel % 2)  # 1 left, -1 right
    y = q[first + coordinates.Y]
    z = axle_height_m + q[first + coordinates.Z]
    roll = q[first + ROLL]
    yaw = q[first + YAW]
    # a right wheel is seen in a mirror
    pose = (offset_m, side * y, z)
    ex, ey, ez = axis(roll, yaw)
    axle = (side * ex, ey, side * ez)

    begin = MOST * wheel
    before = int(contact_count[wheel])
    count = geometry.track(contacts, begin, before, pose, axle, roller_m, profile, rail)
    moved_m = (
        abs(y - searched_at[wheel, _SEARCHED_Y])
        + abs(z - searched_at[wheel, _SEARCHED_Z])
        + ROLL_ARM_M * abs(roll - searched_at[wheel, _SEARCHED_ROLL])
        + YAW_ARM_M * abs(yaw - searched_at[wheel, _SEARCHED_YAW])
    )
    lost = count < before or count == 0
    if lost or (searches_left > 0 and moved_m > MOVED_M):
        count = geometry.detect(
            contacts, begin, count, misfit, wheel, pose, axle, roller_m, profile, rail
        )
        searched_at[wheel, _SEARCHED_Y] = y
        searched_at[wheel, _SEARCHED_Z] = z
        searched_at[wheel, _SEARCHED_ROLL] = roll
        searched_at[wheel, _SEARCHED_YAW] = yaw
        if not lost:
            searches_left -= 1
    contact_count[wheel] = count
    return searches_left


@kernel_inlined
def slide(
    j,
    q,
    v,
    base_m_s,
    roller_rad_s,
    contacts,
    contact_count,
    mu_cd,
    mu_cr,
    patches,
    damping_N_s_m,
    roller_m,
    w,
    lane,
):
    """Write load and sliding of wheelset j's contacts into the lanes `w`; return the next lane.

    The first contact goes to `lane` of `eight_contacts`. base_m_s is the vehicle's speed on
    rollers, 0 on a track; roller_rad_s is 0 on a track.
    """
    i = PER_BODY * (FIRST_WHEELSET + j)
    ex, ey, ez = axis(q[i + ROLL], q[i + YAW])
    # angular velocity of the wheelset
    spin_rate = v[i + PITCH]
    wx = v[i + ROLL] + spin_rate * ex
    wy = spin_rate * ey
    wz = v[i + YAW] + spin_rate * ez
    for wheel in range(2):
        side = 1.0 - 2.0 * wheel
        at = 2 * j + wheel
        for c in range(MOST * at, MOST * at + int(contact_count[at])):
            p = -contacts[c, GAP]
            if p <= 0.0:
                continue
            # rho, and the normal out of the rail
            x = contacts[c, X]
            y = side * contacts[c, Y]
            z = contacts[c, Z]
            nx = contacts[c, NX]
            ny = side * contacts[c, NY]
            nz = contacts[c, NZ]
            # tangent along: horizontal on a track, inclined off the crown of a roller
            cos = 1.0
            sin = 0.0
            arm_m = 0.0
            if roller_rad_s != 0.0:
                up = math.sqrt(nx * nx + nz * nz)
                cos = nz / up
                sin = -nx / up
                arm_m = roller_m + contacts[c, RAIL_Z]
            # [N2]
            vx = v[i + coordinates.X] - base_m_s + wy * z - wz * y
            vy = v[i + coordinates.Y] + wz * x - wx * z
            vz = v[i + coordinates.Z] + wx * y - wy * x
            t2x = ny * sin
            t2y = nz * cos - nx * sin
            t2z = -ny * cos
            approach_m_s = max(-(vx * nx + vy * ny + vz * nz), 0.0)

            patch = patch_table.at(contacts[c, ROLLING], contacts[c, LATERAL], patches)
            lanes.put(w, lane, patch)
            w[lanes.SX + lane] = vx * cos + vz * sin + arm_m * roller_rad_s
            w[lanes.SY + lane] = vx * t2x + vy * t2y + vz * t2z
            w[lanes.SPIN + lane] = wx * nx + wy * ny + wz * nz + roller_rad_s * ny
            w[lanes.SURFACE + lane] = v[i + coordinates.X] - base_m_s + arm_m * roller_rad_s
            w[lanes.LOAD + lane] = (
                patch.k_h_N_m32 * p * math.sqrt(p) + damping_N_s_m * approach_m_s
            )  # [N1]
            w[lanes.MU_CD + lane] = mu_cd
            w[lanes.MU_CR + lane] = mu_cr
            w[lanes.APPROACH + lane] = approach_m_s
            w[lanes.COS + lane] = cos
            w[lanes.SIN + lane] = sin
            w[lanes.ARM + lane] = arm_m
            lane += 1
    return lane


@kernel_inlined
def press(
    j, contacts, contact_count, damping_N_s_m, wheelset_forces, Gx, Gy, wheel_forces, w, lane
):
    """Write the forces of both wheels of wheelset j, after `slide`; return the next lane.

    They go into row j of `wheelset_forces`, the slopes `Gx` (4, 4) and `Gy` (3, 3) of [N4], and two
    rows of `wheel_forces`.
    """
    wheelset_forces[j, :] = 0.0
    Gx[:, :] = 0.0
    Gy[:, :] = 0.0
    for wheel in range(2):
        side = 1.0 - 2.0 * wheel
        at = 2 * j + wheel
        wheel_forces[at, :] = 0.0
        for c in range(MOST * at, MOST * at + int(contact_count[at])):
            if -contacts[c, GAP] <= 0.0:
                continue
            # rho, normal and tangents as in `slide`
            x = contacts[c, X]
            y = side * contacts[c, Y]
            z = contacts[c, Z]
            nx = contacts[c, NX]
            ny = side * contacts[c, NY]
            nz = contacts[c, NZ]
            cos = w[lanes.COS + lane]
            sin = w[lanes.SIN + lane]
            arm_m = w[lanes.ARM + lane]
            t2x = ny * sin
            t2y = nz * cos - nx * sin
            t2z = -ny * cos
            sx = w[lanes.SX + lane]
            sy = w[lanes.SY + lane]
            spin = w[lanes.SPIN + lane]
            fx = w[lanes.FX + lane]
            fy = w[lanes.FY + lane]
            mz = w[lanes.MZ + lane]
            N = w[lanes.LOAD + lane]
            approach_m_s = w[lanes.APPROACH + lane]
            lane += 1

            # [N4]
            reach = _SPIN_ARM_M * abs(spin)
            g = math.sqrt(fx * fx + fy * fy) / (math.sqrt(sx * sx + sy * sy) + reach + _LEAST_M_S)
            # [N3]
            Fx = N * nx + fx * cos + fy * t2x
            Fy = N * ny + fy * t2y
            Fz = N * nz + fx * sin + fy * t2z
            wheelset_forces[j, FORCE] += Fx
            wheelset_forces[j, FORCE + 1] += Fy
            wheelset_forces[j, FORCE + 2] += Fz
            wheelset_forces[j, MOMENT] += y * Fz - z * Fy + mz * nx
            wheelset_forces[j, MOMENT + 1] += z * Fx - x * Fz + mz * ny
            wheelset_forces[j, MOMENT + 2] += x * Fy - y * Fx + mz * nz
            J_along = (cos, z * cos - x * sin, -y * cos, arm_m)
            slopes(wheelset_forces, j, ALONG, ALONG_GS, Gx, 4, J_along, fx, g, sx)
            # the 0 fills the tuple, so that both calls have one type
            J_across = (t2y, t2z, y * t2z - z * t2y, 0.0)
            slopes(wheelset_forces, j, ACROSS, ACROSS_GS, Gy, 3, J_across, fy, g, sy)
            wheelset_forces[j, SLIDING_W] -= fx * sx + fy * sy + mz * spin
            wheelset_forces[j, APPROACH_W] += damping_N_s_m * approach_m_s * approach_m_s

            wheel_forces[at, LOAD] += Fz
            wheel_forces[at, PULL] += fx
            wheel_forces[at, SIDE] += Fy
            wheel_forces[at, SLIP] += sx * N
            wheel_forces[at, TOUCHING] += N
        if wheel_forces[at, TOUCHING] > 0.0:
            wheel_forces[at, SLIP] /= wheel_forces[at, TOUCHING]
    return lane


@kernel_inlined
def slopes(wheelset_forces, j, force_at, gs_at, G, size, J, f, g, s):
    """Add f J, g s J and g J'J (lower triangle) of a contact to the sums of wheelset j [N4]."""
    for k in range(size):
        wheelset_forces[j, force_at + k] += f * J[k]
        gJ = g * J[k]
        wheelset_forces[j, gs_at + k] += s * gJ
        for m in range(k + 1):
            G[k, m] += gJ * J[m]


# axle_height: the search begins this far outside the radii of the profile, and ends within this
_BEYOND_M = 0.03
_BISECTIONS = 80
_TOLERANCE_M = 1e-9


def axle_height(
    load_N: float, wheel: Wheel, rail: Rail, patches: patch_table.Patches, roller_m: float
) -> float:
    """Return the height in m of a centred wheelset's axle at which each wheel carries load_N.

    Raises ValueError where there is no such height.
    """
    radius = wheel.fine[:, 0]
    low = float(radius.min()) - _BEYOND_M
    high = float(radius.max()) + _BEYOND_M
    for _ in range(_BISECTIONS):
        z = 0.5 * (low + high)
        contacts = np.zeros((geometry.MOST, geometry.COLUMNS))
        misfit = np.zeros((1, wheel.coarse.shape[0]))
        pose = (0.0, 0.0, z)
        axle = (0.0, 1.0, 0.0)
        count = geometry.detect(contacts, 0, 0, misfit, 0, pose, axle, roller_m, wheel, rail)
        carried_N = 0.0
        for row in contacts[:count]:
            if row[GAP] < 0.0:
                patch = patch_table.at(row[ROLLING], row[LATERAL], patches)
                carried_N += patch.k_h_N_m32 * (-row[GAP]) ** 1.5 * row[NZ]
        # so low that the search finds no contact any more: the wheel would be inside the rail
        if count == 0 and z < 0.5 * (radius.min() + radius.max()):
            carried_N = math.inf
        if carried_N > load_N:
            low = z
        else:
            high = z
    if high - low > _TOLERANCE_M or carried_N <= 0.0:
        raise ValueError(
            f"a wheelset under {2.0 * load_N:g} N finds no height at which both wheels carry load: the "
            "profiles of wheel and rail do not meet; check their units (mm), gauge_m and "
            "running_circles_m"
        )
    return z
