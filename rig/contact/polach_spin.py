"""Polach's creep force in two directions, with spin.

The force of `polach` acts against a creepage whose lateral part is corrected for spin. Spin also
adds a lateral force, which is exact at small spin and vanishes at full sliding.

[S1] eta_c = eta + a phi where |eta + a phi| > |eta|, else eta;  e_c = hypot(xi, eta_c)
[S2] F = mu N 2/pi [...] by `polach` for eps = pi G a b c e_c / (4 mu N),
     c = hypot(c11 xi, c22 eta) / hypot(xi, eta)
[S3] F_x = -F n_x e / e_c,  F_y = -F n_y e / e_c - F_s sign(phi), n a unit vector from Kalker's
     direction to that of (xi, eta) by `johnson_vermeulen` [J3]
[S4] F_s = 9/16 a mu N |K| (1 + 6.3 (1 - exp(-a/b))) |phi| / e_c
[S5] K = |q| (d^3/3 - d^2/2 + 1/6) - (1 - d^2)^1.5 / 3,  d = (q^2 - 1) / (q^2 + 1)
[S6] q = 8/3 G b sqrt(a b) c23 / (mu N) eta_c / (1 + 6.3 (1 - exp(-a/b)))
[S7] M_z by `johnson_vermeulen.moment`

`approach` computes once what holds for any friction limit: degraded adhesion has two limits.
Source: Polach, Vehicle System Dynamics Suppl. 33 (1999) 728-739; paper eqs. 14 and 18. Doubt: [S7]
is ours, and so is n, where Polach has (xi, eta) / e throughout. Limits: the sum of both parts may
exceed mu N slightly. With spin the error against CONTACT is 0.10 mu N in the mean and reaches 0.33
(29 creepages, a/b = 1.3). q is Polach's for an isotropic patch.
"""

import math
from typing import NamedTuple

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import johnson_vermeulen, polach

QUARTER_PI = 0.25 * math.pi
MOST_TURN = 1e9  # a larger turn of the direction [S3] changes no digit


class Approach(NamedTuple):
    """The part of [S1] to [S6] that holds for any friction limit."""

    linear_x_N: float  # Kalker's force without spin, signed
    linear_y_N: float
    linear_N: float  # its magnitude
    linear_per_creepage_N: float  # the magnitude over e, 0 without creepage
    eps_limit_N: float  # eps mu N of [S2]
    creepage_share: float  # e / e_c, 0 without creepage
    spin_pull: float  # F_s of [S4] over mu N |K|, signed like the spin
    q_limit_N: float  # q mu N of [S6]


@kernel
def slimness(a_over_b):
    """Return 1 + 6.3 (1 - exp(-a/b)): how a patch's shape acts on the force of spin [S4] [S6]."""
    return 1.0 - 6.3 * math.expm1(-a_over_b)


@kernel_inlined
def force(xi, eta, phi_1_m, mu, load_N, patch, k_a, k_s):
    """Return creep force and moment on the wheel; all 0 without load, friction or creepage.

    Parameters
    ----------
    xi, eta : longitudinal and lateral creepage
    phi_1_m : spin
    mu : friction coefficient
    load_N : load on the wheel
    patch : `patch.Patch`
    k_a, k_s : reductions in the areas of adhesion and of slip

    Returns
    -------
    fx_N, fy_N, mz_Nm : against creepage and spin
    """
    limit = mu * load_N
    if not limit > 0.0 or (xi == 0.0 and eta == 0.0 and phi_1_m == 0.0):
        return 0.0, 0.0, 0.0
    growth = load_N ** (1.0 / 3.0)
    a = patch.a1 * growth
    b = patch.b1 * growth
    fx, fy = within(approach(xi, eta, phi_1_m, a, b, patch), xi, eta, limit, k_a, k_s)
    return fx, fy, johnson_vermeulen.moment(xi, eta, phi_1_m, limit, a, b, patch)  # [S7]


@kernel_inlined
def approach(xi, eta, phi_1_m, a_m, b_m, patch):
    """Return the `Approach` of a creepage and spin, for semi-axes a_m along and b_m across."""
    eta_c = corrected(eta, phi_1_m * a_m)
    e = math.sqrt(xi * xi + eta * eta)
    e_c = math.sqrt(xi * xi + eta_c * eta_c)

    # Kalker's force without spin
    stiff = patch.shear_Pa * a_m * b_m
    lx = -stiff * patch.c11 * xi
    ly = -stiff * patch.c22 * eta
    size = math.sqrt(lx * lx + ly * ly)

    size_per_e = 0.0
    eps_limit = 0.0
    part = 0.0
    if e > 0.0:
        size_per_e = size / e
        part = e * (1.0 / e_c)
        eps_limit = QUARTER_PI * size_per_e * e_c

    pull = 0.0
    q_limit = 0.0
    if phi_1_m != 0.0 and e_c > 0.0:
        q_limit = (
            8.0
            / 3.0
            * patch.shear_Pa
            * b_m
            * math.sqrt(a_m * b_m)
            * patch.c23
            * abs(eta_c)
            / patch.slim
        )
        pull = 0.5625 * a_m * patch.slim * phi_1_m * (1.0 / e_c)
    return Approach(lx, ly, size, size_per_e, eps_limit, part, pull, q_limit)


@kernel_inlined
def within(approached, xi, eta, limit_N, k_a, k_s):
    """Return the force (fx_N, fy_N) within a friction limit.

    `approached` is the `Approach` of the creepage (xi, eta), `limit_N` is mu N and above 0.
    """
    share, _ = polach.shape(approached.eps_limit_N * (1.0 / limit_N), k_a, k_s)
    return force_of_share(approached, xi, eta, limit_N, share)


@kernel_inlined
def force_of_share(approached, xi, eta, limit_N, share):
    """Return the force (fx_N, fy_N) of `within`, for a share of the limit from `polach.shape`."""
    lx = approached.linear_x_N
    ly = approached.linear_y_N
    inverse = 1.0 / limit_N
    fx = 0.0
    fy = 0.0
    if approached.creepage_share > 0.0:
        f = limit_N * approached.creepage_share * share  # [S2]
        if ly == 0.0:
            # without lateral creepage Kalker's direction is that of the creepage
            fx = f if lx > 0.0 else -f
        else:
            # from Kalker's direction towards that of the creepage [S3]
            turn = approached.linear_N * inverse * (1.0 / johnson_vermeulen.TURN)
            turn = min(turn * turn * turn, MOST_TURN) * approached.linear_per_creepage_N
            tx = lx - turn * xi
            ty = ly - turn * eta
            f /= math.sqrt(tx * tx + ty * ty)
            fx = f * tx
            fy = f * ty
    if approached.spin_pull != 0.0:
        fy -= limit_N * approached.spin_pull * spin_part(approached.q_limit_N * inverse)  # [S4]
    return fx, fy


@kernel_inlined
def corrected(eta, spin):
    """Return the lateral creepage corrected for `spin`, which is a phi [S1], paper eq. 18."""
    return eta + spin if abs(eta + spin) > abs(eta) else eta


@kernel_inlined
def spin_part(q):
    """Return |K| of [S5], for q >= 0."""
    inverse = 1.0 / (q * q + 1.0)
    d = (q * q - 1.0) * inverse
    rest = 2.0 * q * inverse  # sqrt(1 - d^2)
    return abs(q * (d * d * (d / 3.0 - 0.5) + 1.0 / 6.0) - rest * rest * rest / 3.0)
