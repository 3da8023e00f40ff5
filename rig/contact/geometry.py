"""Contact point detection: where a wheel touches a rail or a roller, in closed form but for one root.

Two smooth surfaces touch where their normals are parallel and the rail's normal is parallel to the
vector between the points: six equations in four unknowns. A wheel is a surface of revolution, so
for a given lateral coordinate y_w on it the other three unknowns follow in closed form, and one
scalar equation F(y_w) = 0 is left. Its rising roots are the places where the surfaces come closest;
all of them are found (tread, root and flange), refined by Newton's method and, from step to step,
followed with a fixed number of operations. No look-up table over positions is needed.

[G1] r_w = C + y_w e + w (rho), n_w = (rho - w' e) / sqrt(1 + w'^2): wheel point and outward normal,
     C the wheelset's centre, e its axis, rho a unit vector across e, w(y_w) the rolling radius
[G2] rail: n_r = -n_w has no x component: rho = alpha f1 + sqrt(1 - alpha^2) f2, alpha = w' e_x / s,
     s = sqrt(1 - e_x^2), f1 = (x - e_x e) / s, f2 = (x cross e) reversed, downwards
[G3] y_r: the one point of the convex head with the slope of n_r;  x_r = x_w
[G4] F = (r_w - r_r) cross n_r along x;  gap = (r_w - r_r) . n_r, negative where they interpenetrate
[G5] roller: the common normal meets both axes, at Q = C + (y_w + w w') e and at T on the roller's;
     T follows from (T - Q) . e = -w' / sqrt(1 + w'^2) |T - Q|, a quadratic equation
[G6] F = t - y_r - (R + z_r) b', gap = |Q - T| - w sqrt(1 + w'^2) - (R + z_r) sqrt(1 + b'^2)
[G7] dF/dy_w = sqrt(1 + w'^2) (1 + kappa_w (R_r + gap)): Newton's slope

Source: paper eqs. 1 to 3 (n_w parallel n_r, n_r parallel to the distance), reduced here to F.
Frame of one side: x forwards, y outwards, z up; the rail's highest point at z = 0, a roller's axis
under it. The mirrored side is computed with y, roll and yaw reversed. Rail heads are convex
(`profiles` [Q4]); two roots closer than 1 mm count as one.
"""

import math

import numpy as np

from rollerrig.rig.contact import profiles
from rollerrig.rig.kernel import kernel

# columns of a contact: y_w, gap, point on the wheel relative to C (3), normal out of the rail (3),
# rolling radius, y_r, z_r, lateral curvature and longitudinal curvature of both together
(S, GAP, X, Y, Z, NX, NY, NZ, RADIUS, RAIL_Y, RAIL_Z, LATERAL, ROLLING) = range(13)
COLUMNS = 13
MOST = 4  # contacts of one wheel
KEEP_M = 0.004  # candidates farther apart are forgotten
TOLERANCE_M = 5e-6  # F at which a root is accepted: the gap, stationary there, errs by 1e-10 m
NEWTON_STEPS = 8
FLATTEST_1_M, CURVEST_1_M = 0.2, 200.0  # bounds of the lateral curvature that Hertz is given


@kernel
def axis(roll_rad, yaw_rad):
    """The wheelset's axis e, outwards, after yaw about z and roll about x; pitch turns about it."""
    c = math.cos(roll_rad)
    return -math.sin(yaw_rad) * c, math.cos(yaw_rad) * c, math.sin(roll_rad)


@kernel
def matched(u, w, slope, pose, axle, roller_m, rail):
    """For y_w = u: (F, gap, rail radius of curvature, n_x, n_y, n_z, y_r, z_r, node) [G1 to G6].

    pose (x, y, z) of the wheelset's centre, axle = `axis`, roller_m its radius, inf for a rail.
    """
    ex, ey, ez = axle
    if math.isinf(roller_m):
        # normal out of the rail [G2]
        s2 = 1.0 - ex * ex
        s = math.sqrt(s2)
        alpha = slope * ex / s
        beta = math.sqrt(max(1.0 - alpha * alpha, 0.0))
        scale = 1.0 / math.sqrt(1.0 + slope * slope)
        nx = 0.0
        ny = (slope * ey / s2 - beta * ez / s) * scale
        nz = (slope * ez / s2 + beta * ey / s) * scale
        y, z, cosine, radius, node = on_rail(-ny, nz, rail)
        # wheel point: normals through the axis [G1]
        q = u + w * slope
        py = pose[1] + q * ey - y
        pz = pose[2] + q * ez - z
        return (py * nz - pz * ny, py * ny + pz * nz - w / scale, radius, nx, ny, nz, y, z,
                node)
    q = u + w * slope
    qx, qy, qz = pose[0] + q * ex, pose[1] + q * ey, pose[2] + q * ez + roller_m
    # [G5] with tau = t - q_y
    m = -qx * ex - qz * ez
    h2 = qx * qx + qz * qz
    k = 1.0 + slope * slope
    A = ey * ey * k - slope * slope
    tau = (-m * ey * k - slope * math.sqrt(max(k * m * m + A * h2, 0.0))) / A
    length = math.sqrt(h2 + tau * tau)
    nx, ny, nz = qx / length, -tau / length, qz / length
    radial = math.sqrt(nx * nx + nz * nz)
    y, z, cosine, radius, node = on_rail(-ny, radial, rail)
    out = (roller_m + z) / radial
    F = (tau + qy - y + out * ny) * radial  # [G6], as a distance from the common normal
    return F, length - w * math.sqrt(k) - out, radius, nx, ny, nz, y, z, node


@kernel
def on_rail(sine, cosine, rail):
    """The head's point with a slope: (y, z, cosine, radius of curvature, node) [Q2 of profiles]."""
    last = rail.y_m.size - 2
    place = (sine + (last + 1) / (2.0 * rail.sines_per_node)) * rail.sines_per_node
    i = min(max(int(place), 0), last)
    part = min(max(place - i, 0.0), 1.0)
    y = rail.y_m[i] + (rail.y_m[i + 1] - rail.y_m[i]) * part
    radius = (rail.y_m[i] - rail.y_m[i + 1]) * rail.sines_per_node
    z = rail.z_m[i] + radius * (cosine - rail.cosine[i])
    return y, z, cosine, radius, i


@kernel
def refined(u, lower, upper, pose, axle, roller_m, wheel, rail, out):
    """Newton from u within [lower, upper]; writes the contact to `out`, False if there is no root."""
    last = wheel.slope.size - 2
    for _ in range(NEWTON_STEPS):
        place = (u - wheel.start_m) / wheel.spacing_m
        i = min(max(int(place), 0), last)
        t = u - wheel.start_m - i * wheel.spacing_m
        bend = (wheel.slope[i + 1] - wheel.slope[i]) / wheel.spacing_m
        slope = wheel.slope[i] + bend * t
        w = wheel.radius_m[i] + t * (wheel.slope[i] + 0.5 * bend * t)
        F, gap, radius, nx, ny, nz, y, z, node = matched(
            u + wheel.centre_m, w, slope, pose, axle, roller_m, rail)
        if abs(F) < TOLERANCE_M:
            root = math.sqrt(1.0 + slope * slope)
            steep = root - bend * (radius + max(gap, 0.0)) / (root * root)
            out[S], out[GAP] = u - (F / steep if steep > 0.05 else 0.0), gap
            q = u + wheel.centre_m + w * slope
            reach = w * root
            out[X] = q * axle[0] - reach * nx
            out[Y] = q * axle[1] - reach * ny
            out[Z] = q * axle[2] - reach * nz
            out[NX], out[NY], out[NZ] = nx, ny, nz
            out[RADIUS], out[RAIL_Y], out[RAIL_Z] = w, y, z
            lateral = wheel.curvature_1_m[i] + rail.curvature_1_m[node]
            out[LATERAL] = min(max(lateral, FLATTEST_1_M), CURVEST_1_M)
            out[ROLLING] = 1.0 / reach
            if not math.isinf(roller_m):
                out[ROLLING] += math.sqrt(nx * nx + nz * nz) / (roller_m + z)
            return True
        if F < 0.0:
            lower = u
        else:
            upper = u
        root = math.sqrt(1.0 + slope * slope)
        steep = root - bend * (radius + max(gap, 0.0)) / (root * root)  # [G7]
        move = u - F / steep if steep > 0.05 else lower - 1.0
        u = move if lower < move < upper else 0.5 * (lower + upper)
        if upper - lower < 1e-9:
            return False
    return False


@kernel
def misfits(F, first, step, pose, axle, roller_m, wheel, rail):
    """F of [G4] or [G6] at the coarse nodes first, first + step .. of the wheel, into `F` (n,).

    Roots lie where it turns from negative to positive; returns how many nodes there are.
    """
    ex, ey, ez = axle
    nodes = wheel.coarse_slope.size
    if not math.isinf(roller_m):
        for i in range(first, nodes, step):
            F[i] = matched(wheel.coarse_m[i], wheel.coarse_radius_m[i], wheel.coarse_slope[i],
                           pose, axle, roller_m, rail)[0]
        return nodes
    s2 = 1.0 - ex * ex
    s = math.sqrt(s2)
    lean, leaning, upright = ex / s, ez / s, ey / s
    across, up = ey / s2, ez / s2
    last = rail.y_m.size - 2
    middle = 0.5 * (last + 1)
    for i in range(first, nodes, step):
        slope, scale = wheel.coarse_slope[i], wheel.coarse_cosine[i]
        alpha = slope * lean
        beta = 1.0 - 0.5 * alpha * alpha
        ny = (slope * across - beta * leaning) * scale
        nz = (slope * up + beta * upright) * scale
        place = middle - ny * rail.sines_per_node
        k = min(max(int(place), 0), last)
        y_k = rail.y_m[k]
        step_y = rail.y_m[k + 1] - y_k
        y = y_k + step_y * min(max(place - k, 0.0), 1.0)
        z = rail.z_m[k] - step_y * rail.sines_per_node * (nz - rail.cosine[k])
        q = wheel.coarse_q_m[i]
        F[i] = (pose[1] + q * ey - y) * nz - (pose[2] + q * ez - z) * ny
    return nodes


@kernel
def added(found, count, u, width, pose, axle, roller_m, wheel, rail):
    """Refine a root between u - width and u and keep it if it is near; returns the new count."""
    if count < MOST and refined(u - 0.5 * width, u - width, u, pose, axle, roller_m, wheel, rail,
                                found[count]) and found[count, GAP] < KEEP_M:
        return count + 1
    return count


@kernel
def detect(found, F, pose, axle, roller_m, wheel, rail):
    """All contacts and near contacts of one wheel, from nothing; returns their number.

    found (MOST, COLUMNS) and F (coarse nodes,) are written; pose (x, y, z) in m of the wheelset's
    centre in the frame of one side; axle from `axis`; roller_m inf for a rail.
    """
    nodes = misfits(F, 0, 1, pose, axle, roller_m, wheel, rail)
    count = 0
    for i in range(1, nodes):
        if F[i - 1] < 0.0 <= F[i]:
            u = wheel.coarse_m[i] - wheel.centre_m
            count = added(found, count, u, profiles.STRIDE * wheel.spacing_m, pose, axle, roller_m, wheel,
                          rail)
    return count


@kernel
def follow(found, count, F, turn, turns, pose, axle, roller_m, wheel, rail):
    """Contacts of the next time step: those known, refined, and new ones of a share of the wheel.

    Each call renews every `turns`-th value of F, `turn` = 0 .. turns - 1 one after the other, so the
    work of a call is bounded; at the last of them, new roots are taken up. Returns the number of
    contacts in `found`.
    """
    width = profiles.STRIDE * wheel.spacing_m
    lowest = wheel.start_m
    highest = lowest + (wheel.slope.size - 1) * wheel.spacing_m
    kept = 0
    for c in range(count):
        u = found[c, S]
        if (refined(u, max(u - width, lowest), min(u + width, highest), pose, axle, roller_m,
                    wheel, rail, found[kept]) and found[kept, GAP] < KEEP_M):
            twin = kept > 0 and abs(found[kept, S] - found[kept - 1, S]) < 0.5 * width
            kept += 0 if twin else 1
    nodes = misfits(F, turn, turns, pose, axle, roller_m, wheel, rail)
    if turn == turns - 1:
        for i in range(1, nodes):
            if F[i - 1] < 0.0 <= F[i]:
                u = wheel.coarse_m[i] - wheel.centre_m
                known = False
                for c in range(kept):
                    known |= u - 2.0 * width <= found[c, S] <= u + width
                if not known:
                    kept = added(found, kept, u, width, pose, axle, roller_m, wheel, rail)
    return kept


def contacts(
    pose: tuple[float, float, float, float, float, float], wheel, rail, roller_m: float = math.inf
) -> np.ndarray:
    """All near contacts of one wheel as rows of shape (n, COLUMNS), deepest first.

    pose = (x, y, z, roll, pitch, yaw) of the wheelset's centre against the rail, in m and rad;
    pitch turns a surface of revolution into itself. Raises ValueError where nothing is within
    KEEP_M: the wheel is off the rail.
    """
    found = np.zeros((MOST, COLUMNS))
    axle = axis(pose[3], pose[5])
    F = np.zeros(wheel.coarse_m.size)
    count = detect(found, F, (pose[0], pose[1], pose[2]), axle, float(roller_m), wheel, rail)
    if count == 0:
        raise ValueError(
            f"no contact within {KEEP_M * 1e3:g} mm: the wheelset at y = {pose[1] * 1e3:.3g} mm, "
            f"z = {pose[2] * 1e3:.5g} mm is off the rail; a centred one stands at y = 0 and z near "
            "its rolling radius")
    return found[:count][np.argsort(found[:count, GAP])].copy()
