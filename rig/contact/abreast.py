"""The creep forces of `adhesion` and `creep_force`, written so that a processor computes several wheels at once.

A compiler turns a loop over wheels into vector instructions only where every wheel goes the same way, so there are no
library calls here and no branches but choices between two values: exp, log, arc tangent and cube root are polynomials
or rationals, and the root of [A5] is Lambert's function to 3e-4 (the same Pade approximant as in `adhesion`) followed
by one Householder step of third order on the equation itself. A wheel beyond the domain is told by `inside` = 0; the
caller then asks `adhesion` or `creep_force`.

    [V1] y = k f_d + k D (1 - exp(-y)),  y = k f = tau W_sp      adhesion [A5]
    [V2] f = f_d + D (1 - exp(-y))                               adhesion [A1], [A2]

Source: Cody and Waite 1980 (reduction of exp), Moshier, Cephes 2.9 (atan). Within the domain f agrees
with `adhesion.recovering` to 2e-12, forces with `creep_force` to 1e-11 (tests). Domain: loads of 12.5 to
200 kN on a wheel, contaminants that clean (f_r >= f_d), roots that are not double.
"""

import math

import numpy as np

from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import johnson_vermeulen, polach_spin
from rollerrig.rig.contact.adhesion import SPEED_FLOOR_M_S, between

_ROUND = 6755399441055744.0  # adding it rounds to an integer, which then stands in the low bits
_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_P0, _P1, _P2, _P3, _P4 = (
    -8.750608600031904122785e-01,
    -1.615753718733365076637e01,
    -7.500855792314704667340e01,
    -1.228866684490136173410e02,
    -6.485021904942025371773e01,
)
_Q0, _Q1, _Q2, _Q3, _Q4 = (
    2.485846490142306297962e01,
    1.650270098316988542046e02,
    4.328810604912902668951e02,
    4.853903996359136964868e02,
    1.945506571482613964425e02,
)
_TAN_3_8_PI, _PI_4_REST = 2.41421356237309504880, 3.061616997868383e-17
LOAD_N, LIGHTER, HEAVIER = 5.0e4, 0.25, 4.0
_PER_ROOT = LOAD_N ** (-1.0 / 3.0)


@kernel_inlined
def exponential(x):
    """exp(x) within two units of the last digit; x counts as at least -700 and at most 700."""
    x = min(max(x, -700.0), 700.0)
    shifted = x * 1.4426950408889634 + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LN2) - n * _LN2_REST
    r2 = r * r
    r4 = r2 * r2
    p = 1.0 + (
        r
        + r2
        * (
            ((1 / 2 + r * (1 / 6)) + r2 * (1 / 24 + r * (1 / 120)))
            + r4
            * (
                ((1 / 720 + r * (1 / 5040)) + r2 * (1 / 40320 + r * (1 / 362880)))
                + r4 * ((1 / 3628800 + r * (1 / 39916800)) + r2 * (1 / 479001600))
            )
        )
    )
    # n is added to the exponent of p
    exponent = np.float64(shifted).view(np.int64) << np.int64(52)
    return np.int64(np.float64(p).view(np.int64) + exponent).view(np.float64)


@kernel_inlined
def logarithm(x):
    """log(x) within 1e-15, absolute where x is near 1, for normal x > 0."""
    bits = np.float64(x).view(np.int64)
    exponent = np.int64((bits >> np.int64(52)) | np.int64(0x4330000000000000)).view(np.float64) - (
        2.0**52 + 1023.0
    )
    m = np.int64((bits & np.int64(0xFFFFFFFFFFFFF)) | np.int64(0x3FF0000000000000)).view(np.float64)
    high = m > 1.4142135623730951
    m, exponent = 0.5 * m if high else m, exponent + 1.0 if high else exponent
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    z4 = z2 * z2
    p = ((1 / 3 + z * (1 / 5)) + z2 * (1 / 7 + z * (1 / 9))) + z4 * (
        ((1 / 11 + z * (1 / 13)) + z2 * (1 / 15 + z * (1 / 17))) + z4 * (1 / 19 + z * (1 / 21))
    )
    return exponent * _LN2 + (exponent * _LN2_REST + 2.0 * (s + s * (z * p)))


@kernel_inlined
def arc_tangent(x):
    """atan(x) for x >= 0 within two units of the last digit."""
    far, middle = x > _TAN_3_8_PI, x > 0.66
    above = -1.0 if far else (x - 1.0 if middle else x)
    below = x if far else (x + 1.0 if middle else 1.0)
    t = above / below
    base = 0.5 * math.pi if far else (0.25 * math.pi if middle else 0.0)
    rest = 2.0 * _PI_4_REST if far else (_PI_4_REST if middle else 0.0)
    z = t * t
    z *= ((((_P0 * z + _P1) * z + _P2) * z + _P3) * z + _P4) / (
        ((((z + _Q0) * z + _Q1) * z + _Q2) * z + _Q3) * z + _Q4
    )
    return base + ((t * z + t) + rest)


@kernel_inlined
def inverse_cube_root(u):
    """u^(-1/3) to 1e-14 for u = 0.25 .. 4."""
    z = (2.0 + u) / (1.0 + 2.0 * u)
    z = _nearer_root(z, 1.0 - u * z * z * z)
    return _nearer_root(z, 1.0 - u * z * z * z)


@kernel_inlined
def _nearer_root(z, rest):
    return z * (1.0 + rest * (1 / 3 + rest * (2 / 9 + rest * (14 / 81))))


@kernel_inlined
def curve(sliding_m_s, eps_mu, mu_c, A, gamma_s_m, k_a, k_s):
    """Polach's adhesion coefficient; `eps_mu` is the tangential stress gradient times the friction."""
    mu = friction(sliding_m_s, mu_c, A, gamma_s_m)
    return mu * shape(eps_mu / mu, k_a, k_s)


@kernel_inlined
def friction(sliding_m_s, mu_c, A, gamma_s_m):
    """`polach.friction` for a magnitude of sliding."""
    return mu_c * (1.0 + (1.0 / A - 1.0) * exponential(-gamma_s_m * sliding_m_s))


@kernel_inlined
def shape(eps, k_a, k_s):
    """`polach.shape` without its derivative, for eps >= 0."""
    stick = k_a * eps
    return (2.0 / math.pi) * (stick / (1.0 + stick * stick) + arc_tangent(k_s * eps))


@kernel_inlined
def eps_mu(sliding_m_s, speed_m_s, load_N, eps1):
    """What `curve` wants to know of creepage and load (on one wheel); nonsense outside the domain."""
    creepage = sliding_m_s / max(abs(speed_m_s), SPEED_FLOOR_M_S)
    return eps1 * _PER_ROOT * inverse_cube_root(load_N / LOAD_N) * creepage


@kernel_inlined
def recovered(f_d, f_r, k):
    """(f, lambda, inside) of [V1], [V2] between f_d and f_r for k = tau N |e|; inside 0: do not trust f."""
    D = f_r - f_d
    drive, most, least = k * D, k * f_r, k * f_d
    argument = -drive * exponential(-most)
    p2 = 2.0 + 2.0 * math.e * argument
    p = math.sqrt(max(p2, 0.0))
    y = most + math.e * argument * (360.0 + 96.0 * p) / (
        360.0 + p * (456.0 + p * (156.0 + p * 11.0))
    )
    kept = exponential(-y)
    g, h = y - least - drive * (1.0 - kept), drive * kept
    g1 = 1.0 - h
    step = -g * (6.0 * g1 * g1 - 3.0 * g * h) / (6.0 * g1 * g1 * g1 - 6.0 * g * g1 * h - g * g * h)
    kept *= 1.0 - step * (1.0 - step * (0.5 - step / 6.0))
    inside = (p2 > 1e-8) & (D >= 0.0) & (abs(step) < 1e-3)
    return f_d + D * (1.0 - kept), 1.0 - kept, (1.0 if inside else 0.0)


@kernel_inlined
def polach_force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """`creep_force.creep_force` by Polach's model: (fx_N, fy_N, mz_Nm, inside)."""
    a, b, inside = semi_axes(load_N, patch)
    approached = polach_spin.approach(xi, eta, phi_1_m, a, b, patch)
    limit, fx, fy = limited(
        approached,
        xi,
        eta,
        sliding_m_s,
        load_N,
        law.mu_cd,
        law.A_d,
        law.gamma_d_s_m,
        law.k_ad,
        law.k_sd,
    )
    return fx, fy, moment(approached[2], eta, phi_1_m, limit, a, b, patch), inside


@kernel_inlined
def recovering_force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """`creep_force.recovering`: (fx_N, fy_N, mz_Nm, inside)."""
    a, b, inside = semi_axes(load_N, patch)
    approached = polach_spin.approach(xi, eta, phi_1_m, a, b, patch)
    limit_d, dx, dy = limited(
        approached,
        xi,
        eta,
        sliding_m_s,
        load_N,
        law.mu_cd,
        law.A_d,
        law.gamma_d_s_m,
        law.k_ad,
        law.k_sd,
    )
    limit_r, rx, ry = limited(
        approached,
        xi,
        eta,
        sliding_m_s,
        load_N,
        law.mu_cr,
        law.A_r,
        law.gamma_r_s_m,
        law.k_ar,
        law.k_sr,
    )
    _, lambda_, solved = recovered(
        max(-(dx * xi + dy * eta), 0.0), max(-(rx * xi + ry * eta), 0.0), law.tau_m_J
    )
    return (
        between(dx, rx, lambda_),
        between(dy, ry, lambda_),
        moment(approached[2], eta, phi_1_m, between(limit_d, limit_r, lambda_), a, b, patch),
        inside * solved,
    )


@kernel_inlined
def semi_axes(load_N, patch):
    """Semi-axes in m along and across, and whether the load is within the domain (1 or 0)."""
    u = load_N * (1.0 / LOAD_N)
    root = inverse_cube_root(u)
    growth = u * root * root * (1.0 / _PER_ROOT)
    return patch.a1 * growth, patch.b1 * growth, (1.0 if (u > LIGHTER) & (u < HEAVIER) else 0.0)


@kernel_inlined
def limited(approached, xi, eta, sliding_m_s, load_N, mu_c, A, gamma_s_m, k_a, k_s):
    """The friction limit in N and the force (fx_N, fy_N) within it."""
    limit_N = load_N * friction(sliding_m_s, mu_c, A, gamma_s_m)
    fx, fy = polach_spin.shared(
        approached, xi, eta, limit_N, shape(approached[4] * (1.0 / limit_N), k_a, k_s)
    )
    return limit_N, fx, fy


@kernel_inlined
def moment(linear_N, eta, phi_1_m, limit_N, a_m, b_m, patch):
    """`johnson_vermeulen.moment`, where Kalker's force without spin has the size linear_N."""
    linear = linear_N / limit_N
    rest = max(1.0 - linear * (1.0 / 3.0), 1e-300)
    faded = exponential(3.0 * johnson_vermeulen.FADE * logarithm(rest)) if linear < 3.0 else 0.0
    return johnson_vermeulen.moment_of(linear, faded, eta, phi_1_m, limit_N, a_m, b_m, patch)
