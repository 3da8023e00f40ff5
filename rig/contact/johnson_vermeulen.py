"""Kalker's linear creep force, bent over to full sliding by Johnson and Vermeulen's cubic.

At small creepage force and moment are linear in creepage and spin. The linear force F is then
reduced so that it reaches the friction limit, with a horizontal tangent, at three times that limit.
Beyond it, the force turns from Kalker's direction to the one against the creepage, which a patch
that slides as a whole must have. The spin moment also serves the other models that give only a
force. At small creepage it is Kalker's. One part comes from lateral creepage, because traction
grows towards the trailing edge; it vanishes as the patch changes to full sliding. Another part
comes from spin; it approaches that of a patch that turns on the spot, and falls with creepage.

[J1] F_x = -G a b c11 xi,  F_y = -G a b (c22 eta + sqrt(a b) c23 phi)
[J2] u = |F| / (mu N):  |F'| = mu N (u - u^2 / 3 + u^3 / 27) for u < 3, else mu N
[J3] direction: F + (u / 2.8)^3 |F| w / |w|, with w = -(xi, eta + sqrt(a b) phi c23 / c22)
[Z1] M = m_eta (1 - F_jv / (mu N))^0.7 - m_phi / sqrt(1 + (m_phi / m_max)^2 + (F_lin / (mu N))^2)
[Z2] m_eta = G (a b)^1.5 c23 eta, m_phi = G (a b)^2 c33 phi, m_max = 0.58 mu N sqrt(a b)
[Z3] F_lin = G a b hypot(c11 xi, c22 eta), F_jv the force that [J2] makes of it

xi, eta longitudinal and lateral creepage, phi spin in 1/m; forces act on the wheel, against
creepage. Source: Kalker 1967; Vermeulen and Johnson 1964; Shen, Hedrick and Elkins 1983 (with
spin). [J3] is ours, read off results of CONTACT: the sources keep Kalker's direction, 8 degrees off
in a patch with c11 / c22 = 1.3. [Z1] is ours too, read off 54 results for a/b = 1.3 (mean error
0.026, largest 0.18 mu N sqrt(a b)); it is not checked for other shapes. Limits: spin beyond about
sqrt(a b) |phi| = mu is poorly modelled; there the error reaches 0.76 mu N.
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined

TURN = 2.8  # linear force, in units of the limit, at which half of the turn is done [J3]
MOST_TURN = 1e9  # a larger turn changes no digit of the direction
TURNING = 0.58  # m_max over mu N sqrt(a b); 0.589 for a Hertzian circle on the spot (3 pi / 16)
FADE = 0.7  # exponent of the lateral part in [Z1]
SMALLEST_N2 = 1e-290  # the square of a force that counts as none: below it digits are lost


@kernel
def force(xi, eta, phi_1_m, mu, load_N, patch):
    """Return creep force and moment on the wheel; all 0 without load or friction.

    Parameters
    ----------
    xi, eta, phi_1_m : longitudinal and lateral creepage, spin
    mu : friction coefficient
    load_N : load on the wheel
    patch : `patch.Patch`

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
    fx, fy = linear(xi, eta, phi_1_m, a, b, patch)
    u = math.sqrt(fx * fx + fy * fy) / limit
    ux, uy = direction(fx, fy, u, patch)
    size = limit * u * reduction(u)  # [J2]
    return size * ux, size * uy, moment(xi, eta, phi_1_m, limit, a, b, patch)


@kernel
def linear(xi, eta, phi_1_m, a_m, b_m, patch):
    """Return Kalker's linear (fx_N, fy_N) on the wheel [J1].

    Semi-axes a_m along and b_m across the rolling direction.
    """
    stiff = patch.shear_Pa * a_m * b_m
    # the usual case, without spin, costs no square root
    spin = 0.0 if phi_1_m == 0.0 else math.sqrt(a_m * b_m) * patch.c23 * phi_1_m
    return -stiff * patch.c11 * xi, -stiff * (patch.c22 * eta + spin)


@kernel
def direction(fx, fy, u, patch):
    """Return the unit vector of the force whose linear one is (fx, fy) [J3]; (0, 0) for no force.

    `u` is the size of the linear force over the friction limit.
    """
    if fy == 0.0:
        return (math.copysign(1.0, fx), 0.0) if fx != 0.0 else (0.0, 0.0)
    if fx * fx + fy * fy < SMALLEST_N2:
        return 0.0, 0.0

    # w of [J3], times G a b: the linear force without Kalker's coefficients
    wx = fx / patch.c11
    wy = fy / patch.c22
    part = u / TURN
    turn = min(part * part * part, MOST_TURN)
    turn = turn * math.sqrt((fx * fx + fy * fy) / (wx * wx + wy * wy))
    ux = fx + turn * wx
    uy = fy + turn * wy
    unit = 1.0 / math.sqrt(ux * ux + uy * uy)
    return ux * unit, uy * unit


@kernel
def reduction(u):
    """Return force over linear force, for a linear force of u friction limits [J2]."""
    if u >= 3.0:
        return 1.0 / u
    return 1.0 - u / 3.0 + u * u / 27.0


@kernel_inlined
def moment(xi, eta, phi_1_m, limit_N, a_m, b_m, patch):
    """Return the moment in N m on the wheel [Z1].

    Parameters
    ----------
    xi, eta, phi_1_m : longitudinal and lateral creepage, spin
    limit_N : mu N, above 0
    a_m, b_m : semi-axes along and across
    patch : `patch.Patch`
    """
    if eta == 0.0 and phi_1_m == 0.0:
        return 0.0
    x = patch.c11 * xi
    y = patch.c22 * eta
    linear = patch.shear_Pa * (a_m * b_m) / limit_N * math.sqrt(x * x + y * y)  # [Z3]
    # 1 - (u - u^2 / 3 + u^3 / 27) = (1 - u / 3)^3
    faded = (1.0 - linear / 3.0) ** (3.0 * FADE) if linear < 3.0 and eta != 0.0 else 0.0
    return moment_of(linear, faded, eta, phi_1_m, limit_N, a_m, b_m, patch)


@kernel_inlined
def moment_of(linear, faded, eta, phi_1_m, limit_N, a_m, b_m, patch):
    """Return the moment of [Z1] in N m from its two shares.

    `linear` is F_lin / (mu N) of [Z3], `faded` is (1 - F_jv / (mu N))^0.7; the others are those of
    `moment`.
    """
    ab = a_m * b_m
    size = math.sqrt(ab)
    stiff = patch.shear_Pa * ab
    from_spin = stiff * ab * patch.c33 * phi_1_m  # m_phi [Z2]
    turning = from_spin / (TURNING * limit_N * size)
    return stiff * size * patch.c23 * eta * faded - from_spin / math.sqrt(
        1.0 + turning * turning + linear * linear
    )
