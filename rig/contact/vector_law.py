"""The creep forces of `adhesion` and `creep_force`, written so that a processor computes several wheels at once.

A compiler turns a loop over wheels into vector instructions only where every wheel goes the same way, so there are no
library calls here and no branches but choices between two values: exp, log, arc tangent and cube root are polynomials
or rationals, and the root of [A5] is Lambert's function to 3e-4 (the same Pade approximant as in `adhesion`) followed
by one Householder step of third order on the equation itself. A wheel beyond the domain is told by `inside` = 0; the
caller then asks `adhesion` or `creep_force`.

    [V1] y = k f_d + k D (1 - exp(-y)),  y = k f = tau W_sp      adhesion [A5]
    [V2] f = f_d + D (1 - exp(-y))                               adhesion [A1], [A2]

Source: Cody and Waite 1980 (reduction of exp), Moshier, Cephes 2.9 (atan). Within the domain f agrees
with `adhesion.wheel_adhesion` to 2e-12, forces with `creep_force` to 1e-11 (tests). Domain: loads of 12.5 to
200 kN on a wheel, contaminants that clean (f_r >= f_d), roots that are not double.
"""

import math

from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import johnson_vermeulen, polach_spin
from rollerrig.rig.contact.adhesion import SPEED_FLOOR_M_S, between

LOAD_N, LIGHTER, HEAVIER = 5.0e4, 0.25, 4.0
_PER_ROOT = LOAD_N ** (-1.0 / 3.0)


@kernel_inlined
def curve(sliding_m_s, eps_mu, mu_c, A, gamma_s_m, k_a, k_s):
    """Polach's adhesion coefficient; `eps_mu` is the tangential stress gradient times the friction."""
    mu = friction(sliding_m_s, mu_c, A, gamma_s_m)
    return mu * shape(eps_mu / mu, k_a, k_s)


@kernel_inlined
def friction(sliding_m_s, mu_c, A, gamma_s_m):
    """`polach.friction` for a magnitude of sliding."""
    return mu_c * (1.0 + (1.0 / A - 1.0) * vector_math.exp(-gamma_s_m * sliding_m_s))


@kernel_inlined
def shape(eps, k_a, k_s):
    """`polach.shape` without its derivative, for eps >= 0."""
    stick = k_a * eps
    return (2.0 / math.pi) * (stick / (1.0 + stick * stick) + vector_math.atan(k_s * eps))


@kernel_inlined
def eps_mu(sliding_m_s, speed_m_s, load_N, eps1):
    """What `curve` wants to know of creepage and load (on one wheel); nonsense outside the domain."""
    creepage = sliding_m_s / max(abs(speed_m_s), SPEED_FLOOR_M_S)
    return eps1 * _PER_ROOT * vector_math.inverse_cube_root(load_N / LOAD_N) * creepage


@kernel_inlined
def recovered(f_d, f_r, k):
    """(f, lambda, inside) of [V1], [V2] between f_d and f_r for k = tau N |e|; inside 0: do not trust f."""
    D = f_r - f_d
    drive, most, least = k * D, k * f_r, k * f_d
    argument = -drive * vector_math.exp(-most)
    p2 = 2.0 + 2.0 * math.e * argument
    p = math.sqrt(max(p2, 0.0))
    y = most + math.e * argument * (360.0 + 96.0 * p) / (
        360.0 + p * (456.0 + p * (156.0 + p * 11.0))
    )
    kept = vector_math.exp(-y)
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
    return fx, fy, moment(approached.linear_N, eta, phi_1_m, limit, a, b, patch), inside


@kernel_inlined
def recovering_force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """`creep_force.degraded_force`: (fx_N, fy_N, mz_Nm, inside)."""
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
        moment(approached.linear_N, eta, phi_1_m, between(limit_d, limit_r, lambda_), a, b, patch),
        inside * solved,
    )


@kernel_inlined
def semi_axes(load_N, patch):
    """Semi-axes in m along and across, and whether the load is within the domain (1 or 0)."""
    u = load_N * (1.0 / LOAD_N)
    root = vector_math.inverse_cube_root(u)
    growth = u * root * root * (1.0 / _PER_ROOT)
    return patch.a1 * growth, patch.b1 * growth, (1.0 if (u > LIGHTER) & (u < HEAVIER) else 0.0)


@kernel_inlined
def limited(approached, xi, eta, sliding_m_s, load_N, mu_c, A, gamma_s_m, k_a, k_s):
    """The friction limit in N and the force (fx_N, fy_N) within it."""
    limit_N = load_N * friction(sliding_m_s, mu_c, A, gamma_s_m)
    fx, fy = polach_spin.force_of_share(
        approached, xi, eta, limit_N, shape(approached.eps_limit_N * (1.0 / limit_N), k_a, k_s)
    )
    return limit_N, fx, fy


@kernel_inlined
def moment(linear_N, eta, phi_1_m, limit_N, a_m, b_m, patch):
    """`johnson_vermeulen.moment`, where Kalker's force without spin has the size linear_N."""
    linear = linear_N / limit_N
    rest = max(1.0 - linear * (1.0 / 3.0), 1e-300)
    faded = (
        vector_math.exp(3.0 * johnson_vermeulen.FADE * vector_math.log(rest))
        if linear < 3.0
        else 0.0
    )
    return johnson_vermeulen.moment_of(linear, faded, eta, phi_1_m, limit_N, a_m, b_m, patch)
