"""Contact point detection: where a wheel touches a rail or a roller.

Two smooth surfaces touch where their normals are parallel and the rail's normal is parallel to the
vector between the points: six equations in four unknowns. A wheel is a surface of revolution. So
for a given lateral coordinate y_w on it the other three unknowns follow in closed form, and one
scalar equation F(y_w) = 0 is left. Its rising roots are the places where the surfaces come closest.
All of them are found (tread, root and flange) and refined by Newton's method. From step to step,
`track` follows the known roots from their last places, and `detect` searches the wheel again when
it has moved. Both cost a bounded number of operations. No look-up table over positions is needed.

[G1] r_w = C + y_w e + w (rho), n_w = (rho - w' e) / sqrt(1 + w'^2): wheel point and outward normal,
     C the wheelset's centre, e its axis, rho a unit vector across e, w(y_w) the rolling radius
[G2] rail: n_r = -n_w has no x component: rho = alpha f1 + sqrt(1 - alpha^2) f2, alpha = w' e_x / s,
     s = sqrt(1 - e_x^2), f1 = (x - e_x e) / s, f2 = (x cross e) reversed, downwards
[G3] y_r: the one point of the convex head with the slope of n_r;  x_r = x_w
[G4] F = (r_w - r_r) cross n_r along x;  gap = (r_w - r_r) . n_r, negative where they interpenetrate
[G5] roller: the common normal meets both axes, at Q = C + (y_w + w w') e and at T on the roller's;
     T follows from (T - Q) . e = -w' / sqrt(1 + w'^2) |T - Q|, a quadratic equation
[G6] F = (t - y_r - (R + z_r) b') cos b, gap = (r_w - r_r) . n_r as on the rail
[G7] dF/dy_w = sqrt(1 + w'^2) (1 + kappa_w (R_r + gap)): Newton's slope

Source: paper eqs. 1 to 3 (n_w parallel n_r, n_r parallel to the distance), reduced here to F. Frame
of one side: x forwards, y outwards, z up; the rail's highest point is at z = 0, a roller's axis
under it. The other side is computed with y, roll and yaw reversed. Rail heads are convex ([Q4] of
`profiles`); two roots closer than 1 mm count as one.
"""

import math

import numpy as np

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import profiles
from rollerrig.rig.contact.profiles import Rail, Wheel

# columns of a contact: y_w, gap, point on the wheel relative to C (3), normal out of the rail (3),
# rolling radius, y_r, z_r, lateral curvature and longitudinal curvature of both together
(S, GAP, X, Y, Z, NX, NY, NZ, RADIUS, RAIL_Y, RAIL_Z, LATERAL, ROLLING) = range(13)
COLUMNS = 13
MOST = 4  # contacts of one wheel
KEEP_M = 0.004  # candidates with a larger gap are dropped
TOLERANCE_M = 5e-6  # F at which a root is accepted: the gap, stationary there, errs by 1e-10 m
NEWTON_STEPS = 8
SMALLEST_SLOPE = 0.05  # of F, below which Newton's step is not used
# bounds of the lateral curvature that Hertz is given
FLATTEST_1_M = 0.2
CURVEST_1_M = 200.0


@kernel_inlined
def axis(roll_rad, yaw_rad):
    """Return the wheelset's axis e, a unit vector outwards, after yaw about z and roll about x.

    Pitch turns the wheelset about this axis and does not change it.
    """
    c = math.cos(roll_rad)
    return -math.sin(yaw_rad) * c, math.cos(yaw_rad) * c, math.sin(roll_rad)


@kernel_inlined
def matched(u, w, slope, pose, axle, roller_m, rail):
    """Return the rail's point that matches a wheel's point, and how far both are from a contact.

    Parameters
    ----------
    u, w, slope : y_w on the wheel, its rolling radius w and the slope w'
    pose : (x, y, z) of the wheelset's centre, in m
    axle : its axis from `axis`
    roller_m : radius of the roller, inf for a rail
    rail : `Rail`

    Returns
    -------
    F, gap : misfit and distance in m [G4], [G6]
    radius : radius of curvature of the rail at its point, in m
    n_x, n_y, n_z : normal out of the rail [G2], [G5]
    y_r, z_r : the rail's point [G3]
    node : its node in the rail's table
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
        y, z, radius, node = on_rail(-ny, nz, rail)  # [G3]

        # the wheel's normal passes through its axis, w sqrt(1 + w'^2) from the wheel point [G1]
        q = u + w * slope
        py = pose[1] + q * ey - y
        pz = pose[2] + q * ez - z
        F = py * nz - pz * ny  # [G4]
        gap = py * ny + pz * nz - w / scale
        return F, gap, radius, nx, ny, nz, y, z, node

    # Q, where the common normal meets the wheel's axis; z from the roller's axis
    q = u + w * slope
    qx = pose[0] + q * ex
    qy = pose[1] + q * ey
    qz = pose[2] + q * ez + roller_m

    # [G5] with tau = t - q_y
    m = -qx * ex - qz * ez
    h2 = qx * qx + qz * qz
    k = 1.0 + slope * slope
    A = ey * ey * k - slope * slope
    tau = (-m * ey * k - slope * math.sqrt(max(k * m * m + A * h2, 0.0))) / A

    # normal out of the roller, and the head's point with its slope
    length = math.sqrt(h2 + tau * tau)
    nx = qx / length
    ny = -tau / length
    nz = qz / length
    radial = math.sqrt(nx * nx + nz * nz)
    y, z, radius, node = on_rail(-ny, radial, rail)

    out = (roller_m + z) / radial
    F = (tau + qy - y + out * ny) * radial  # [G6], as a distance from the common normal
    gap = qx * nx + (qy - y) * ny + qz * nz - out * radial * radial - w * math.sqrt(k)
    return F, gap, radius, nx, ny, nz, y, z, node


@kernel_inlined
def on_rail(sine, cosine, rail):
    """Return the head's point with a slope: (y, z, radius of curvature, node) [Q2 of `profiles`].

    `sine` and `cosine` are those of the slope; y, z and the radius are in m.
    """
    nodes = rail.nodes
    last = nodes.shape[0] - 2
    place = sine * rail.sines_per_node + 0.5 * (last + 1)
    i = min(max(int(place), 0), last)
    part = min(max(place - i, 0.0), 1.0)

    # the head is an arc between two nodes
    y = nodes[i, profiles.Y_M]
    fall = y - nodes[i + 1, profiles.Y_M]
    radius = fall * rail.sines_per_node
    z = nodes[i, profiles.Z_M] + radius * (cosine - nodes[i, profiles.COSINE])
    return y - fall * part, z, radius, i


@kernel
def refined(u, lower, upper, pose, axle, roller_m, wheel, rail, found, to):
    """Find a root of F by Newton's method and write it as a contact; return whether there is one.

    Parameters
    ----------
    u : start of the search, a coordinate s of the wheel in m
    lower, upper : the bracket of the root; a step that leaves it is replaced by bisection
    pose, axle, roller_m, rail : as for `matched`
    wheel : `Wheel`
    found : contacts (.., COLUMNS); row `to` is written
    to : the row
    """
    fine = wheel.fine
    last = fine.shape[0] - 2
    for _ in range(NEWTON_STEPS):
        # radius and slope of the wheel here [Q1 of `profiles`]
        i = min(max(int((u - wheel.start_m) / wheel.spacing_m), 0), last)
        t = u - wheel.start_m - i * wheel.spacing_m
        bend = (fine[i + 1, profiles.SLOPE] - fine[i, profiles.SLOPE]) / wheel.spacing_m
        slope = fine[i, profiles.SLOPE] + bend * t
        w = fine[i, profiles.RADIUS_M] + t * (fine[i, profiles.SLOPE] + 0.5 * bend * t)

        F, gap, radius, nx, ny, nz, y, z, node = matched(
            u + wheel.centre_m, w, slope, pose, axle, roller_m, rail
        )
        root = math.sqrt(1.0 + slope * slope)
        steep = root - bend * (radius + max(gap, 0.0)) / (root * root)  # [G7]
        # where F hardly rises, a place outside the bracket makes the search bisect
        move = u - F / steep if steep > SMALLEST_SLOPE else lower - 1.0

        if abs(F) < TOLERANCE_M:
            found[to, S] = move if steep > SMALLEST_SLOPE else u
            found[to, GAP] = gap
            # the point on the wheel: along the axis, then along the normal to the surface
            q = u + wheel.centre_m + w * slope
            reach = w * root
            found[to, X] = q * axle[0] - reach * nx
            found[to, Y] = q * axle[1] - reach * ny
            found[to, Z] = q * axle[2] - reach * nz
            found[to, NX] = nx
            found[to, NY] = ny
            found[to, NZ] = nz
            found[to, RADIUS] = w
            found[to, RAIL_Y] = y
            found[to, RAIL_Z] = z
            lateral = (
                fine[i, profiles.CURVATURE_1_M] + rail.nodes[node, profiles.RAIL_CURVATURE_1_M]
            )
            found[to, LATERAL] = min(max(lateral, FLATTEST_1_M), CURVEST_1_M)
            found[to, ROLLING] = 1.0 / reach
            if not math.isinf(roller_m):
                found[to, ROLLING] += math.sqrt(nx * nx + nz * nz) / (roller_m + z)
            return True

        # narrow the bracket: F rises through the root
        if F < 0.0:
            lower = u
        else:
            upper = u
        u = move if lower < move < upper else 0.5 * (lower + upper)
        if upper - lower < 1e-9:
            return False
    return False


@kernel_inlined
def misfits(F, row, pose, axle, roller_m, wheel, rail):
    """Write F of [G4] or [G6] at the coarse nodes of a wheel into F[row].

    A contact lies where F rises through 0. On rails this is accurate to second order in the yaw.
    Arguments as for `refined`; F has shape (.., coarse nodes).
    """
    ex, ey, ez = axle
    coarse = wheel.coarse
    if not math.isinf(roller_m):
        misfits_on_roller(F, row, pose, axle, roller_m, wheel, rail)
        return

    # [G2] as in `matched`, with everything that is the same for all nodes taken out of the loop
    s2 = 1.0 - ex * ex
    s = math.sqrt(s2)
    lean = ex / s
    leaning = ez / s
    upright = ey / s
    across = ey / s2
    up = ez / s2
    for i in range(coarse.shape[0]):
        slope = coarse[i, profiles.AT_SLOPE]
        scale = coarse[i, profiles.AT_COSINE]
        alpha = slope * lean
        beta = 1.0 - 0.5 * alpha * alpha  # sqrt(1 - alpha^2)
        ny = (slope * across - beta * leaning) * scale
        nz = (slope * up + beta * upright) * scale
        y, z, _, _ = on_rail(-ny, nz, rail)
        q = coarse[i, profiles.AT_NORMAL_M]
        F[row, i] = (pose[1] + q * ey - y) * nz - (pose[2] + q * ez - z) * ny


@kernel_inlined
def misfits_on_roller(F, row, pose, axle, roller_m, wheel, rail):
    """Write `misfits` on a roller by [G6], with n = (c q_x / h, n_y, c q_z / h).

    q is measured from the roller's axis.
    n . e is the sine of the wheel's slope, which gives n_y and c. The distance h and 1 - e_y^2 are
    taken to second order.
    """
    ex, ey, ez = axle
    coarse = wheel.coarse
    # the wheelset's centre from the roller's axis
    px = pose[0]
    pz = pose[2] + roller_m
    h0 = math.sqrt(px * px + pz * pz)
    unit = 1.0 / h0
    along = (px * ex + pz * ez) * unit
    sideways = ex * ex + ez * ez
    for i in range(coarse.shape[0]):
        q = coarse[i, profiles.AT_NORMAL_M]
        part = q * unit
        grown = part * (along + 0.5 * part * sideways)  # h / h0 - 1
        grown -= 0.5 * grown * grown
        # how far e leans along q
        lean = (along + part * sideways) * (1.0 - grown + grown * grown)
        rest = sideways - lean * lean
        more = 1.0 + rest + rest * rest
        cosine = coarse[i, profiles.AT_COSINE]
        sine = coarse[i, profiles.AT_SLOPE] * cosine
        upright = math.sqrt(max(cosine * cosine - rest, 0.0))
        ny = (sine * ey - lean * upright) * more
        c = (sine * lean + ey * upright) * more
        y, z, _, _ = on_rail(-ny, c, rail)
        F[row, i] = (roller_m + z - h0 * (1.0 + grown)) * ny + (pose[1] + q * ey - y) * c


@kernel
def track(found, begin, count, pose, axle, roller_m, wheel, rail):
    """Refine the contacts of the last step and return how many are left.

    Each costs a few evaluations of F.
    `found` (.., COLUMNS) has `count` contacts from row `begin` on; contacts that are lost, or too
    far from the rail, are removed. The other arguments are those of `refined`.
    """
    width = profiles.STRIDE * wheel.spacing_m
    lowest = wheel.start_m
    highest = lowest + (wheel.fine.shape[0] - 1) * wheel.spacing_m
    to = begin
    for c in range(begin, begin + count):
        u = found[c, S]
        lower = max(u - width, lowest)
        upper = min(u + width, highest)
        has_root = refined(u, lower, upper, pose, axle, roller_m, wheel, rail, found, to)
        if has_root and found[to, GAP] < KEEP_M:
            # two contacts may have run into the same root
            twin = to > begin and abs(found[to, S] - found[to - 1, S]) < 0.5 * width
            to += 0 if twin else 1
    return to - begin


@kernel
def detect(found, begin, count, F, row, pose, axle, roller_m, wheel, rail):
    """Search a whole wheel for contacts and near contacts; return how many there are.

    The `count` known contacts remain. Call this when a wheel has moved a little or has lost a
    contact.

    Parameters
    ----------
    found : (.., COLUMNS); rows begin .. begin + MOST - 1 belong to this wheel
    begin, count : first row of this wheel, and number of known contacts
    F, row : (.., coarse nodes), in which row `row` is written
    pose : (x, y, z) in m of the wheelset's centre in the frame of one side
    axle : its axis from `axis`
    roller_m : radius of the roller, inf for a rail
    wheel, rail : `Wheel`, `Rail`
    """
    misfits(F, row, pose, axle, roller_m, wheel, rail)
    width = profiles.STRIDE * wheel.spacing_m
    to = begin + count
    for i in range(1, wheel.coarse.shape[0]):
        # F rises through 0 between the nodes i - 1 and i
        if F[row, i - 1] < 0.0 <= F[row, i]:
            u = wheel.coarse[i, profiles.AT_M] - wheel.centre_m
            known = False
            for c in range(begin, to):
                known |= u - 2.0 * width <= found[c, S] <= u + width
            if not known and to < begin + MOST:
                has_root = refined(
                    u - 0.5 * width, u - width, u, pose, axle, roller_m, wheel, rail, found, to
                )
                if has_root and found[to, GAP] < KEEP_M:
                    to += 1
    return to - begin


def contacts(
    pose: tuple[float, float, float, float, float, float],
    wheel: Wheel,
    rail: Rail,
    roller_m: float = math.inf,
) -> np.ndarray:
    """Return all near contacts of one wheel as rows of shape (n, COLUMNS), deepest first.

    pose = (x, y, z, roll, pitch, yaw) of the wheelset's centre relative to the rail, in m and rad.
    Pitch turns a surface of revolution into itself. Raises ValueError where nothing is within
    KEEP_M: the wheel is off the rail.
    """
    found = np.zeros((MOST, COLUMNS))
    centre = (pose[0], pose[1], pose[2])
    axle = axis(pose[3], pose[5])
    F = np.zeros((1, wheel.coarse.shape[0]))
    count = detect(found, 0, 0, F, 0, centre, axle, float(roller_m), wheel, rail)
    if count == 0:
        raise ValueError(
            f"no contact within {KEEP_M * 1e3:g} mm: the wheelset at y = {pose[1] * 1e3:.3g} mm, "
            f"z = {pose[2] * 1e3:.5g} mm is off the rail; a centred wheelset has y = 0 and z near "
            "its rolling radius"
        )
    return found[:count][np.argsort(found[:count, GAP])].copy()
