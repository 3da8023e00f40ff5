"""FASTSIM: the contact patch in strips, traction carried from the leading edge to the trailing one.

A particle of the wheel enters at the leading edge without traction. As it rolls through, creepage
and spin strain it until the traction meets the friction limit. From there on it slips, and the
traction turns towards the direction against the slip. Three flexibilities, for longitudinal,
lateral and spin creepage, make the sum correct at small creepage.

[F1] L1 = 8 a / (3 G c11), L2 = 8 a / (3 G c22), L3 = pi a sqrt(a/b) / (4 G c23)
[F2] stick: dp_x/dx = xi / L1 - phi y / L4,  dp_y/dx = eta / L2 + phi x / L3,
     1/L4 = 1/L3 + m (1/L1 - 1/L3),  m = max(1 - a/b, 0)
[F3] limit: g = 2 mu N / (pi a b) (1 - x^2/a^2 - y^2/b^2)
[F4] slip: |p| = g, and d(theta)/dx = |w| / (L g) sin(theta - theta_w), theta_w against
     w = (xi - phi y, eta + phi x), which holds exactly over a step with constant w, L and g
[F5] 1/L = S (|xi| + |eta| + l |phi|) / (L1 |xi| + L2 |eta| + L3 l |phi|),  l = sqrt(a b),
     S = 1 + 0.9 r - 0.35 u - 3 r u v,  r = min(b/a, 1),
     u = |xi| / (|xi| + |eta| + l |phi|),  v = l |phi| / (|xi| + |eta| + l |phi|)

Source: Kalker 1982; 1990, section 3.7. Departures: in slip the traction follows the true slip
(three flexibilities would shift its pole) with one mean flexibility [F5], by an exact step [F4].
Kalker cuts the traction back radially, which is first order in the step only. S: traction that
turns within the patch meets a stiffer half-space than traction that grows over all of it. The
effect is smaller in long patches, and where longitudinal creepage acts, above all with spin. S was
found (not derived) on 54 CONTACT results for a/b = 1.3 and on 1,000 results of our half-space
solution for a/b = 0.3 to 6, extrapolated to infinitely small elements. L4: in a narrow patch phi y
hardly differs from longitudinal creepage along a strip, so it meets the flexibility L1.
Kalker uses L3, which makes the longitudinal force too small there. At small creepage L4 changes the
moment only. Sums are divided by the sum of the limit, so that full sliding gives mu N on any grid.
Limits: the error reaches 0.065 mu N on long patches with spin.
"""

import math

from rollerrig.rig.compiled.kernel import kernel

# S of [F5]: of a very long patch; more for a round one; less for longitudinal creepage, and less
# where it comes with spin
STIFFENING = 1.0
STIFFENING_ROUND = 0.9
STIFFENING_ALONG = 0.35
STIFFENING_ALONG_AND_SPIN = 3.0
# cosine between the traction and its goal below which the direction of the turn is not defined
OPPOSITE = -0.999999


@kernel
def force(xi, eta, phi_1_m, mu, load_N, patch, along, across):
    """Return creep force and moment on the wheel; all 0 without load or friction.

    Parameters
    ----------
    xi, eta, phi_1_m : longitudinal and lateral creepage, spin
    mu : friction coefficient
    load_N : load on the wheel
    patch : `patch.Patch`
    along, across : `across` strips of `along` cells each

    Returns
    -------
    fx_N, fy_N, mz_Nm : against creepage and spin
    """
    limit = mu * load_N
    if not limit > 0.0:
        return 0.0, 0.0, 0.0
    growth = load_N ** (1.0 / 3.0)
    a = patch.a1 * growth
    b = patch.b1 * growth
    s1, s2, s3, s4, s = stiffnesses(xi, eta, phi_1_m, a, b, limit, patch)

    fx = 0.0
    fy = 0.0
    mz = 0.0
    full = 0.0  # the sum of the limit over all cells
    for j in range(across):
        # the strip's middle and its half length, in units of b and a
        y = (2.0 * j + 1.0) / across - 1.0
        edge = math.sqrt(1.0 - y * y)
        # slip per unit of x/a, in units of the largest traction: as stick and as slip see it
        spin = phi_1_m * a
        px, py, mp, top = strip(
            s1 * xi - s4 * phi_1_m * b * y,
            s2 * eta,
            s3 * spin,
            s * (xi - phi_1_m * b * y),
            s * eta,
            s * spin,
            edge,
            along,
        )
        fx += px
        fy += py
        mz += a * mp - b * y * px
        full += top
    unit = limit / full
    return fx * unit, fy * unit, mz * unit


@kernel
def stiffnesses(xi, eta, phi_1_m, a_m, b_m, limit_N, patch):
    """Return a/L1 to a/L4 of [F1], [F2] and a/L of [F5], over the largest traction of [F3].

    Creepages and spin xi, eta, phi_1_m; semi-axes a_m along and b_m across; limit_N = mu N.
    """
    unit = patch.shear_Pa * math.pi * a_m * b_m / (2.0 * limit_N)
    slimness = b_m / a_m
    s1 = 0.375 * unit * patch.c11  # [F1], also the next two lines
    s2 = 0.375 * unit * patch.c22
    s3 = 4.0 / math.pi * unit * patch.c23 * math.sqrt(slimness)
    s4 = s3
    if a_m < b_m:
        s4 += (1.0 - a_m / b_m) * (s1 - s3)  # [F2]

    # the mean flexibility, weighted with the parts of the creepage
    x = abs(xi)
    y = abs(eta)
    z = abs(phi_1_m) * math.sqrt(a_m * b_m)
    whole = x + y + z
    if whole == 0.0:
        return s1, s2, s3, s4, s1
    along = x / whole
    spin = z / whole
    roundness = min(slimness, 1.0)
    stiffening = (
        STIFFENING
        + STIFFENING_ROUND * roundness
        - STIFFENING_ALONG * along
        - STIFFENING_ALONG_AND_SPIN * roundness * along * spin
    )
    return s1, s2, s3, s4, stiffening * whole / (x / s1 + y / s2 + z / s3)


@kernel
def strip(stick_x, stick_y, stick_spin, slip_x, slip_y, slip_spin, edge, cells):
    """Return the sums of p_x, p_y, x p_y and of the limit over a strip, times the width of a cell.

    The strip runs from x = edge to -edge, in units of a. Traction is taken at the middle of each
    cell.

    Parameters
    ----------
    stick_x, stick_y, stick_spin : growth of the traction while it sticks [F2]
    slip_x, slip_y, slip_spin : slip, scaled by the mean flexibility [F4]
    edge : half length of the strip
    cells : number of cells
    """
    width = 2.0 * edge / cells
    top = edge * edge
    px = 0.0
    py = 0.0
    x = edge
    h = 0.5 * width  # from the edge to the middle of the first cell
    fx = 0.0
    fy = 0.0
    mz = 0.0
    full = 0.0
    slipping = False
    for _ in range(cells):
        middle = x - 0.5 * h
        x -= h
        limit = top - x * x  # [F3]
        # the traction if the particle sticks [F2]
        tx = px - stick_x * h
        ty = py - (stick_y + stick_spin * middle) * h
        square = tx * tx + ty * ty
        if square <= limit * limit:
            px = tx
            py = ty
            slipping = False
        elif slipping:
            wy = -(slip_y + slip_spin * middle)
            px, py = turned(px, py, -slip_x, wy, h / (top - middle * middle), limit)  # [F4]
        else:
            # the first cell that slips: cut back to the limit
            cut = limit / math.sqrt(square)
            px = tx * cut
            py = ty * cut
            slipping = True
        fx += px
        fy += py
        mz += x * py
        full += limit
        h = width
    return fx * width, fy * width, mz * width, full * width


@kernel
def turned(px, py, wx, wy, step, limit):
    """Return a traction of size `limit`, turned from the direction of (px, py) towards (wx, wy).

    The tangent of half the angle between them decays with exp(-|w| step) [F4]; the inverse of its
    series is used.
    """
    speed = math.sqrt(wx * wx + wy * wy)
    size = math.sqrt(px * px + py * py)
    if speed == 0.0 or size == 0.0:
        share = limit / size if size > 0.0 else 0.0
        return px * share, py * share

    # the angle between traction and goal
    nx = wx / speed
    ny = wy / speed
    cosine = (px * nx + py * ny) / size
    sine = (px * ny - py * nx) / size
    if cosine < OPPOSITE:
        cosine = OPPOSITE
        sine = math.copysign(math.sqrt(1.0 - OPPOSITE * OPPOSITE), sine)

    z = speed * step
    half = sine / (1.0 + cosine) / (1.0 + z * (1.0 + z * (0.5 + z / 6.0)))

    # back from the tangent of the half angle to the traction's components
    rest = limit / (1.0 + half * half)
    cosine = rest * (1.0 - half * half)
    sine = rest * 2.0 * half
    return nx * cosine + ny * sine, ny * cosine - nx * sine
