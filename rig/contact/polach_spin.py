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
[S7] M_z by `creep_moment`

Source: Polach, Vehicle System Dynamics Suppl. 33 (1999) 728-739; paper eqs. 14 and 18. Doubt: [S7]
is ours, and so is n, where Polach has (xi, eta) / e throughout. Limits: the sum of both parts may
exceed mu N a little; with spin the error against CONTACT is 0.10 mu N in the mean and reaches 0.33
(29 creepages, a/b = 1.3); q is Polach's for an isotropic patch.
"""

import math

from rollerrig.rig.contact import creep_moment, johnson_vermeulen, polach
from rollerrig.rig.kernel import kernel


@kernel
def force(xi, eta, phi_1_m, mu, load_N, patch, k_a, k_s):
    """Creep force and moment on the wheel (fx_N, fy_N, mz_Nm), against creepage and spin.

    `patch` an `adhesion.Patch`, phi_1_m the spin in 1/m. Without load or friction all three are 0.
    """
    limit = mu * load_N
    if not limit > 0.0 or (xi == 0.0 and eta == 0.0 and phi_1_m == 0.0):
        return 0.0, 0.0, 0.0
    growth = load_N ** (1.0 / 3.0)
    a, b = patch.a1 * growth, patch.b1 * growth
    fx, fy = within(xi, eta, phi_1_m, limit, a, b, patch, k_a, k_s)
    return fx, fy, creep_moment.moment(xi, eta, phi_1_m, limit, a, b, patch)  # [S7]


@kernel
def within(xi, eta, phi_1_m, limit_N, a_m, b_m, patch, k_a, k_s):
    """The force (fx_N, fy_N) alone, for limit_N = mu N > 0 and semi-axes a_m along and b_m across."""
    eta_c = corrected(eta, phi_1_m * a_m)
    e2, e_c = xi * xi + eta * eta, math.sqrt(xi * xi + eta_c * eta_c)
    fx, fy = 0.0, 0.0
    if e2 > 0.0:
        lx, ly = johnson_vermeulen.linear(xi, eta, 0.0, a_m, b_m, patch)
        u = math.sqrt(lx * lx + ly * ly) / limit_N
        e = math.sqrt(e2)
        size = limit_N * polach.shape(0.25 * math.pi * u * e_c / e, k_a, k_s)[0] * e / e_c  # [S2]
        nx, ny = johnson_vermeulen.direction(lx, ly, u, patch)
        fx, fy = size * nx, size * ny  # [S3]
    if phi_1_m != 0.0:
        fy -= math.copysign(spin_force(phi_1_m, eta_c, e_c, a_m, b_m, limit_N, patch), phi_1_m)
    return fx, fy


@kernel
def corrected(eta, spin):
    """Lateral creepage with spin a phi [S1], paper eq. 18."""
    return eta + spin if abs(eta + spin) > abs(eta) else eta


@kernel
def spin_force(phi_1_m, eta_c, e_c, a_m, b_m, limit_N, patch):
    """Size in N of the lateral force of spin [S4]; 0 without corrected creepage."""
    if e_c == 0.0:
        return 0.0
    slim = 1.0 - 6.3 * math.expm1(-a_m / b_m)
    q = (8.0 / 3.0 * patch.shear_Pa * b_m * math.sqrt(a_m * b_m) * patch.c23 * abs(eta_c)
         / (limit_N * slim))  # [S6]
    inverse = 1.0 / (q * q + 1.0)
    d, rest = (q * q - 1.0) * inverse, 2.0 * q * inverse  # rest = sqrt(1 - d^2)
    K = q * (d * d * (d / 3.0 - 0.5) + 1.0 / 6.0) - rest * rest * rest / 3.0  # [S5]
    return 0.5625 * a_m * limit_N * abs(K) * slim * abs(phi_1_m) / e_c
