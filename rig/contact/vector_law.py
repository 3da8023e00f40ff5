"""The creep forces of `adhesion` and `creep_force`, for several wheels in the vector lanes of a
core.

A compiler turns a loop over wheels into vector instructions only where the same operations are done
for every wheel. Therefore there is no call of a library here and no branch except a choice between
two values: the elementary functions come from `vector_math`, and the root of [A5] is Lambert's
function to 3e-4 (the same Pade approximant as in `adhesion`), followed by one Householder step of
third order on the equation. For a wheel outside the domain `inside` is 0; the caller then uses
`adhesion` or `creep_force`.

    [L1] y = k f_d + k D (1 - exp(-y)),  y = k f = tau W_sp      adhesion [A5]
    [L2] f = f_d + D (1 - exp(-y))                               adhesion [A1], [A2]

Within the domain f agrees with `adhesion.wheel_adhesion` to 2e-12, forces with `creep_force` to
1e-11 (tests). Domain: loads of 12.5 to 200 kN on a wheel, contaminants that clean (f_r >= f_d),
roots that are not double.
"""

import math

from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import johnson_vermeulen, polach_spin
from rollerrig.rig.contact.adhesion import between

# the domain of loads on a wheel: from LIGHTER to HEAVIER times LOAD_N
LOAD_N = 5.0e4
LIGHTER = 0.25
HEAVIER = 4.0
_PER_ROOT = LOAD_N ** (-1.0 / 3.0)
# below this 2 (1 + e x) of Lambert's function the root is nearly double
_SIMPLE_ROOT = 1e-8
# a Householder step larger than this did not start near enough to the root
_LARGEST_STEP = 1e-3


@kernel_inlined
def friction(sliding_m_s, mu_c, A, gamma_s_m):
    """Return `polach.friction` for a magnitude of sliding."""
    return mu_c * (1.0 + (1.0 / A - 1.0) * vector_math.exp(-gamma_s_m * sliding_m_s))


@kernel_inlined
def shape(eps, k_a, k_s):
    """Return `polach.shape` without its derivative, for eps >= 0."""
    stick = k_a * eps
    return (2.0 / math.pi) * (stick / (1.0 + stick * stick) + vector_math.atan(k_s * eps))


@kernel_inlined
def recovered(f_d, f_r, k):
    """Return (f, lambda, inside) of [L1], [L2] between f_d and f_r for k = tau N |e|.

    `inside` is 0 where f is not valid, else 1.
    """
    D = f_r - f_d
    drive = k * D
    most = k * f_r
    least = k * f_d
    # start: Lambert's function
    argument = -drive * vector_math.exp(-most)
    p2 = 2.0 + 2.0 * math.e * argument
    p = math.sqrt(max(p2, 0.0))
    y = most + math.e * argument * (360.0 + 96.0 * p) / (
        360.0 + p * (456.0 + p * (156.0 + p * 11.0))
    )
    # one Householder step on g(y) = y - least - drive (1 - exp(-y)), with h = drive exp(-y)
    kept = vector_math.exp(-y)
    g = y - least - drive * (1.0 - kept)
    h = drive * kept
    g1 = 1.0 - h
    step = -g * (6.0 * g1 * g1 - 3.0 * g * h) / (6.0 * g1 * g1 * g1 - 6.0 * g * g1 * h - g * g * h)
    # exp(-step), by its series
    kept *= 1.0 - step * (1.0 - step * (0.5 - step / 6.0))
    inside = (p2 > _SIMPLE_ROOT) & (D >= 0.0) & (abs(step) < _LARGEST_STEP)
    return f_d + D * (1.0 - kept), 1.0 - kept, (1.0 if inside else 0.0)


@kernel_inlined
def polach_force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """Return (fx_N, fy_N, mz_Nm, inside): `creep_force.creep_force` by Polach's model."""
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
    """Return (fx_N, fy_N, mz_Nm, inside): `creep_force.recovering_force`."""
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
    # the power of sliding, over the speed, at both limits
    power_d = max(-(dx * xi + dy * eta), 0.0)
    power_r = max(-(rx * xi + ry * eta), 0.0)
    _, lambda_, solved = recovered(power_d, power_r, law.tau_m_J)
    limit = between(limit_d, limit_r, lambda_)
    return (
        between(dx, rx, lambda_),
        between(dy, ry, lambda_),
        moment(approached.linear_N, eta, phi_1_m, limit, a, b, patch),
        inside * solved,
    )


@kernel_inlined
def semi_axes(load_N, patch):
    """Return the semi-axes in m along and across, and 1 if the load is within the domain, else
    0.
    """
    u = load_N * (1.0 / LOAD_N)
    root = vector_math.inverse_cube_root(u)
    growth = u * root * root * (1.0 / _PER_ROOT)
    inside = 1.0 if (u > LIGHTER) & (u < HEAVIER) else 0.0
    return patch.a1 * growth, patch.b1 * growth, inside


@kernel_inlined
def limited(approached, xi, eta, sliding_m_s, load_N, mu_c, A, gamma_s_m, k_a, k_s):
    """Return the friction limit in N and the force (fx_N, fy_N) within it."""
    limit_N = load_N * friction(sliding_m_s, mu_c, A, gamma_s_m)
    share = shape(approached.eps_limit_N * (1.0 / limit_N), k_a, k_s)
    fx, fy = polach_spin.force_of_share(approached, xi, eta, limit_N, share)
    return limit_N, fx, fy


@kernel_inlined
def moment(linear_N, eta, phi_1_m, limit_N, a_m, b_m, patch):
    """Return `johnson_vermeulen.moment`, where linear_N is the size of Kalker's force without
    spin.
    """
    linear = linear_N / limit_N
    rest = max(1.0 - linear * (1.0 / 3.0), 1e-300)
    # rest^(3 FADE)
    power = vector_math.exp(3.0 * johnson_vermeulen.FADE * vector_math.log(rest))
    faded = power if linear < 3.0 else 0.0
    return johnson_vermeulen.moment_of(linear, faded, eta, phi_1_m, limit_N, a_m, b_m, patch)
