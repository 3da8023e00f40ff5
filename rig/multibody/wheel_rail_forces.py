"""Wheel and rail (or roller) under a wheelset: contact points, normal and creep forces.

Each wheel's contacts are followed from step to step; where wheel and rail interpenetrate, Hertz'
spring and a damper press them apart, and the creep force of the chosen model acts against the
sliding of the wheel's material on the rail's, spin included. Beside the forces, their secant slopes
are handed to the time step, which needs them at low speed.

[N1] N = k_h p^(3/2) + c max(dp/dt, 0), p = -gap > 0                             paper eqs. 4, 5
[N2] s = (v + Omega x rho) along t1, t2, spin = Omega . n, on a roller with its surface's motion
[N3] F = N n + f_x t1 + f_y t2 at rho, and m_z n
[N4] g = |f| / (|s| + a |spin|), a = 5 mm: f is about -g s, so its Jacobian is taken as -g J'J

t1 lies along the track, t2 across, n out of the rail; rho from the wheelset's centre to the contact.
Eq. 5 of the paper prints p = max(..., 0) for a quantity that is negative in contact; read as above.
"""

import math

import numpy as np

from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import geometry
from rollerrig.rig.contact import patch as patch_table
from rollerrig.rig.contact.geometry import GAP, LATERAL, MOST, NX, NY, NZ, RAIL_Z, ROLLING, X, Y, Z
from rollerrig.rig.contact.profiles import Rail, Wheel
from rollerrig.rig.multibody import eight_contacts as lanes

# a wheel that has moved by this since it was searched is searched again, so many a step at most
MOVED_M, SEARCHES = 5e-5, 2
ROLL_ARM_M, YAW_ARM_M = 0.75, 0.1
# slots of what one wheelset's contacts give: force and moment (6), generalised force of sliding
# along over (v_x, omega, yaw rate, roller) (4) and across over (v_y, v_z, roll rate) (3), their
# g s J (4, 3), and power of sliding and of the approach damper
FORCE, ALONG, ACROSS, ALONG_GS, ACROSS_GS, SLIDING_W, APPROACH_W = 0, 6, 10, 13, 17, 20, 21
BRAKING_N = 22  # and, written by the time step, the mean braking force in N of the wheelset in it
GIVEN = 23
# per wheel: vertical load N, longitudinal and lateral force N, sliding along m/s, touching contacts
LOAD, PULL, SIDE, SLIP, TOUCHING = range(5)
SEEN = 5


@kernel_inlined
def axis(roll_rad, yaw_rad):
    """A wheelset's axis, to the left, for the small rotations of the coach."""
    return -yaw_rad, math.sqrt(1.0 - roll_rad * roll_rad - yaw_rad * yaw_rad), roll_rad


@kernel_inlined
def follow(
    wheel, q, offset_m, contacts, count, F, searched, axle_height_m, roller_m, profile, rail, spare
):
    """Move the contacts of a wheel on: wheel 2 j the left one of wheelset j, 2 j + 1 the right one.

    q (42,); offset_m of the wheelset before a roller's crown. The wheel is searched anew if it has lost a contact, or
    has moved since `searched` (8, 4) and `spare` searches are left in this step; returns what is left of them.
    """
    first, side = 6 * (3 + wheel // 2), 1.0 - 2.0 * (wheel % 2)
    pose = (offset_m, side * q[first + 1], axle_height_m + q[first + 2])
    roll, yaw = q[first + 3], q[first + 5]
    ex, ey, ez = axis(roll, yaw)
    axle = (side * ex, ey, side * ez)
    begin, before = MOST * wheel, int(count[wheel])
    left = geometry.track(contacts, begin, before, pose, axle, roller_m, profile, rail)
    moved = (
        abs(q[first + 1] - searched[wheel, 0])
        + abs(pose[2] - searched[wheel, 1])
        + ROLL_ARM_M * abs(roll - searched[wheel, 2])
        + YAW_ARM_M * abs(yaw - searched[wheel, 3])
    )
    lost = left < before or left == 0
    if lost or (spare > 0 and moved > MOVED_M):
        left = geometry.detect(contacts, begin, left, F, wheel, pose, axle, roller_m, profile, rail)
        searched[wheel, 0], searched[wheel, 1] = q[first + 1], pose[2]
        searched[wheel, 2], searched[wheel, 3] = roll, yaw
        spare -= 0 if lost else 1
    count[wheel] = left
    return spare


@kernel_inlined
def slide(
    j,
    q,
    v,
    base_m_s,
    roller_rad_s,
    contacts,
    count,
    mu_cd,
    mu_cr,
    patches,
    damping_N_s_m,
    roller_m,
    w,
    lane,
):
    """Load and sliding of all contacts of wheelset j into the lanes `w` of `eight_contacts`, from `lane` on.

    base_m_s is the vehicle's speed on rollers, 0 on a track; roller_rad_s 0 on a track. Returns the next lane.
    """
    i = 6 * (3 + j)
    ex, ey, ez = axis(q[i + 3], q[i + 5])
    spin_rate = v[i + 4]
    wx, wy, wz = v[i + 3] + spin_rate * ex, spin_rate * ey, v[i + 5] + spin_rate * ez
    for wheel in range(2):
        side = 1.0 - 2.0 * wheel
        at = 2 * j + wheel
        for c in range(MOST * at, MOST * at + int(count[at])):
            p = -contacts[c, GAP]
            if p <= 0.0:
                continue
            x, y, z = contacts[c, X], side * contacts[c, Y], contacts[c, Z]
            nx, ny, nz = contacts[c, NX], side * contacts[c, NY], contacts[c, NZ]
            cos, sin, arm = 1.0, 0.0, 0.0
            if roller_rad_s != 0.0:
                up = math.sqrt(nx * nx + nz * nz)
                cos, sin, arm = nz / up, -nx / up, roller_m + contacts[c, RAIL_Z]
            # [N2]
            vx = v[i] - base_m_s + wy * z - wz * y
            vy = v[i + 1] + wz * x - wx * z
            vz = v[i + 2] + wx * y - wy * x
            t2x, t2y, t2z = ny * sin, nz * cos - nx * sin, -ny * cos
            approach = max(-(vx * nx + vy * ny + vz * nz), 0.0)
            patch = patch_table.at(contacts[c, ROLLING], contacts[c, LATERAL], patches)
            lanes.put(w, lane, patch)
            w[lanes.SX + lane] = vx * cos + vz * sin + arm * roller_rad_s
            w[lanes.SY + lane] = vx * t2x + vy * t2y + vz * t2z
            w[lanes.SPIN + lane] = wx * nx + wy * ny + wz * nz + roller_rad_s * ny
            w[lanes.SURFACE + lane] = v[i] - base_m_s + arm * roller_rad_s
            w[lanes.LOAD + lane] = (
                patch.k_h_N_m32 * p * math.sqrt(p) + damping_N_s_m * approach
            )  # [N1]
            w[lanes.MU_CD + lane], w[lanes.MU_CR + lane], w[lanes.APPROACH + lane] = (
                mu_cd,
                mu_cr,
                approach,
            )
            w[lanes.COS + lane], w[lanes.SIN + lane], w[lanes.ARM + lane] = cos, sin, arm
            lane += 1
    return lane


@kernel_inlined
def press(j, contacts, count, damping_N_s_m, given, Gx, Gy, seen, w, lane):
    """Forces of both wheels of wheelset j into row j of `given`, `Gx` (4, 4), `Gy` (3, 3), `seen`; as `slide`."""
    given[j, :] = 0.0
    Gx[:, :] = 0.0
    Gy[:, :] = 0.0
    for wheel in range(2):
        side = 1.0 - 2.0 * wheel
        at = 2 * j + wheel
        seen[at, :] = 0.0
        for c in range(MOST * at, MOST * at + int(count[at])):
            if -contacts[c, GAP] <= 0.0:
                continue
            x, y, z = contacts[c, X], side * contacts[c, Y], contacts[c, Z]
            nx, ny, nz = contacts[c, NX], side * contacts[c, NY], contacts[c, NZ]
            cos, sin, arm = w[lanes.COS + lane], w[lanes.SIN + lane], w[lanes.ARM + lane]
            t2x, t2y, t2z = ny * sin, nz * cos - nx * sin, -ny * cos
            sx, sy, spin = w[lanes.SX + lane], w[lanes.SY + lane], w[lanes.SPIN + lane]
            fx, fy, mz, N = (
                w[lanes.FX + lane],
                w[lanes.FY + lane],
                w[lanes.MZ + lane],
                w[lanes.LOAD + lane],
            )
            approach = w[lanes.APPROACH + lane]
            lane += 1
            # [N4]
            reach = 0.005 * abs(spin)
            g = math.sqrt(fx * fx + fy * fy) / (math.sqrt(sx * sx + sy * sy) + reach + 1e-9)
            # [N3]
            Fx = N * nx + fx * cos + fy * t2x
            Fy = N * ny + fy * t2y
            Fz = N * nz + fx * sin + fy * t2z
            given[j, 0] += Fx
            given[j, 1] += Fy
            given[j, 2] += Fz
            given[j, 3] += y * Fz - z * Fy + mz * nx
            given[j, 4] += z * Fx - x * Fz + mz * ny
            given[j, 5] += x * Fy - y * Fx + mz * nz
            slopes(
                given, j, ALONG, ALONG_GS, Gx, 4, (cos, z * cos - x * sin, -y * cos, arm), fx, g, sx
            )
            slopes(
                given, j, ACROSS, ACROSS_GS, Gy, 3, (t2y, t2z, y * t2z - z * t2y, 0.0), fy, g, sy
            )
            given[j, SLIDING_W] -= fx * sx + fy * sy + mz * spin
            given[j, APPROACH_W] += damping_N_s_m * approach * approach
            seen[at, LOAD] += Fz
            seen[at, PULL] += fx
            seen[at, SIDE] += Fy
            seen[at, SLIP] += sx * N
            seen[at, TOUCHING] += N
        if seen[at, TOUCHING] > 0.0:
            seen[at, SLIP] /= seen[at, TOUCHING]
    return lane


@kernel_inlined
def slopes(given, j, force_at, gs_at, G, size, J, f, g, s):
    """Add a contact's f J, g s J and g J'J (lower triangle) to what the time step is given [N4]."""
    for k in range(size):
        given[j, force_at + k] += f * J[k]
        gJ = g * J[k]
        given[j, gs_at + k] += s * gJ
        for m in range(k + 1):
            G[k, m] += gJ * J[m]


def axle_height(
    load_N: float, wheel: Wheel, rail: Rail, patches: patch_table.Patches, roller_m: float
) -> float:
    """Height in m of a centred wheelset's axle where each wheel bears load_N. Raises ValueError where there is none."""
    radius = wheel.fine[:, 0]
    low, high = float(radius.min()) - 0.03, float(radius.max()) + 0.03
    for _ in range(80):
        z = 0.5 * (low + high)
        found = np.zeros((geometry.MOST, geometry.COLUMNS))
        F = np.zeros((1, wheel.coarse.shape[0]))
        n = geometry.detect(
            found, 0, 0, F, 0, (0.0, 0.0, z), (0.0, 1.0, 0.0), roller_m, wheel, rail
        )
        total = 0.0
        for row in found[:n]:
            if row[GAP] < 0.0:
                patch = patch_table.at(row[ROLLING], row[LATERAL], patches)
                total += patch.k_h_N_m32 * (-row[GAP]) ** 1.5 * row[NZ]
        if n == 0 and z < 0.5 * (radius.min() + radius.max()):
            total = math.inf
        if total > load_N:
            low = z
        else:
            high = z
    if high - low > 1e-9 or total <= 0.0:
        raise ValueError(
            f"a wheelset under {2.0 * load_N:g} N finds no height on which both wheels bear: wheel and "
            "rail profile do not meet; check their units (mm), gauge_m and running_circles_m"
        )
    return z
