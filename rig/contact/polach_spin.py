"""Polach's creep force in two directions, with spin.

The force of `polach` acts against a creepage whose lateral part has been corrected for spin; spin
adds a lateral force of its own, exact at small spin and gone at full sliding.

[S1] eta_c = eta + a phi where |eta + a phi| > |eta|, else eta;  e_c = hypot(xi, eta_c)
[S2] F = mu N 2/pi [...] by `polach` for eps = pi G a b c e_c / (4 mu N),
     c = hypot(c11 xi, c22 eta) / hypot(xi, eta)
[S3] F_x = -F n_x e / e_c,  F_y = -F n_y e / e_c - F_s sign(phi), n a unit vector from Kalker's
     direction to that of (xi, eta) by `johnson_vermeulen` [J3]
[S4] F_s = 9/16 a mu N |K| (1 + 6.3 (1 - exp(-a/b))) |phi| / e_c
[S5] K = |q| (d^3/3 - d^2/2 + 1/6) - (1 - d^2)^1.5 / 3,  d = (q^2 - 1) / (q^2 + 1)
[S6] q = 8/3 G b sqrt(a b) c23 / (mu N) eta_c / (1 + 6.3 (1 - exp(-a/b)))
[S7] M_z by `johnson_vermeulen.moment`

What holds for any friction limit is computed once (`approach`): degraded adhesion has two limits. Source: Polach,
Vehicle System Dynamics Suppl. 33 (1999) 728-739; paper eqs. 14 and 18. Doubt: [S7] is ours, and so is n, where Polach
has (xi, eta) / e throughout. Limits: the sum of both parts may exceed mu N a little; with spin the error against
CONTACT is 0.10 mu N in the mean and reaches 0.33 (29 creepages, a/b = 1.3); q is Polach's for an isotropic patch.
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import johnson_vermeulen, polach

QUARTER_PI = 0.25 * math.pi


@kernel
def slimness(a_over_b):
    """What the shape of a patch does to the force of spin, in [S4] and [S6]."""
    return 1.0 - 6.3 * math.expm1(-a_over_b)


@kernel_inlined
def force(xi, eta, phi_1_m, mu, load_N, patch, k_a, k_s):
    """Creep force and moment on the wheel (fx_N, fy_N, mz_Nm), spin phi_1_m in 1/m; all 0 without load or friction."""
    limit = mu * load_N
    if not limit > 0.0 or (xi == 0.0 and eta == 0.0 and phi_1_m == 0.0):
        return 0.0, 0.0, 0.0
    growth = load_N ** (1.0 / 3.0)
    a, b = patch.a1 * growth, patch.b1 * growth
    fx, fy = within(approach(xi, eta, phi_1_m, a, b, patch), xi, eta, limit, k_a, k_s)
    return fx, fy, johnson_vermeulen.moment(xi, eta, phi_1_m, limit, a, b, patch)  # [S7]


@kernel_inlined
def approach(xi, eta, phi_1_m, a_m, b_m, patch):
    """All of [S1] to [S6] that holds for any friction limit: (lx, ly, size, size_e, eps, part, pull, q).

    Kalker's force and its size in N; the size over e, eps mu N and e / e_c (0 without creepage); of
    the spin's force [S4] its share of mu N |K|, signed, and q mu N. Semi-axes a_m along, b_m across.
    """
    eta_c = corrected(eta, phi_1_m * a_m)
    e, e_c = math.sqrt(xi * xi + eta * eta), math.sqrt(xi * xi + eta_c * eta_c)
    stiff = patch.shear_Pa * a_m * b_m
    lx, ly = -stiff * patch.c11 * xi, -stiff * patch.c22 * eta
    size = math.sqrt(lx * lx + ly * ly)
    size_e, eps_limit, part, pull, q_limit = 0.0, 0.0, 0.0, 0.0, 0.0
    if e > 0.0:
        size_e, part = size / e, e * (1.0 / e_c)
        eps_limit = QUARTER_PI * size_e * e_c
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
    return lx, ly, size, size_e, eps_limit, part, pull, q_limit


@kernel_inlined
def within(approached, xi, eta, limit_N, k_a, k_s):
    """The force (fx_N, fy_N) for limit_N = mu N > 0; `approached` by `approach`, for this creepage."""
    return shared(
        approached, xi, eta, limit_N, polach.shape(approached[4] * (1.0 / limit_N), k_a, k_s)[0]
    )


@kernel_inlined
def shared(approached, xi, eta, limit_N, share):
    """What `within` gives, for the share of the limit by `polach.shape`."""
    lx, ly, size, size_e, _, part, pull, q_limit = approached
    inverse = 1.0 / limit_N
    fx, fy = 0.0, 0.0
    if part > 0.0:
        f = limit_N * part * share  # [S2]
        if ly == 0.0:
            fx = f if lx > 0.0 else -f
        else:
            # towards the creepage's own direction [S3]
            turn = size * inverse * (1.0 / johnson_vermeulen.TURN)
            turn = min(turn * turn * turn, 1e9) * size_e
            tx, ty = lx - turn * xi, ly - turn * eta
            f /= math.sqrt(tx * tx + ty * ty)
            fx, fy = f * tx, f * ty
    if pull != 0.0:
        fy -= limit_N * pull * spin_part(q_limit * inverse)  # [S4]
    return fx, fy


@kernel_inlined
def corrected(eta, spin):
    """Lateral creepage with spin a phi [S1], paper eq. 18."""
    return eta + spin if abs(eta + spin) > abs(eta) else eta


@kernel_inlined
def spin_part(q):
    """|K| of [S5], for q >= 0."""
    inverse = 1.0 / (q * q + 1.0)
    d, rest = (q * q - 1.0) * inverse, 2.0 * q * inverse  # rest = sqrt(1 - d^2)
    return abs(q * (d * d * (d / 3.0 - 0.5) + 1.0 / 6.0) - rest * rest * rest / 3.0)
