"""Degraded adhesion in two directions, with spin.

The degraded and the recovered contact each have a creep force with spin (`polach_spin`). The work
that the force between them does on a metre of rail is the scalar product of force and creepage, so
it lies between theirs in the same proportion, and one scalar equation is left, the one of
`adhesion` [A5] with the two works in place of f_d and f_r.

[D1] T = (1 - lambda) T_d + lambda T_r                                       paper eqs. 9, 18
[D2] W_sp = -(T_x xi + T_y eta), not below 0                                 paper eqs. 8, 17
[D3] W = W_r - (W_r - W_d) exp(-tau W), solved in closed form                paper eqs. 10, 15
[D4] M_z by `creep_moment`, for the friction limit that lies between theirs likewise

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937. Eqs. 8 and 17 against 20 differ in sign
there; here work is positive. Limits: spin does no work in [D2], as in the paper; with pure spin
nothing recovers. Without lateral creepage and spin all is as in `adhesion.degraded`.
"""

from rollerrig.rig.contact import adhesion, creep_moment, polach, polach_spin
from rollerrig.rig.kernel import kernel_inlined


@kernel_inlined
def force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """(fx_N, fy_N, mz_Nm, lambda_, W_sp_J_m) of one wheel; forces act on it, against creepage.

    sliding_m_s is the speed of sliding in the contact that friction falls with, a magnitude;
    phi_1_m the spin in 1/m; `patch` an `adhesion.Patch`, `law` an `adhesion.Law`.
    """
    if load_N <= 0.0 or (xi == 0.0 and eta == 0.0 and phi_1_m == 0.0):
        return 0.0, 0.0, 0.0, 0.0, 0.0
    growth = load_N ** (1.0 / 3.0)
    a, b = patch.a1 * growth, patch.b1 * growth
    limit_d = load_N * polach.friction(sliding_m_s, law.mu_cd, law.A_d, law.gamma_d_s_m)
    limit_r = load_N * polach.friction(sliding_m_s, law.mu_cr, law.A_r, law.gamma_r_s_m)
    approached = polach_spin.approach(xi, eta, phi_1_m, a, b, patch)
    dx, dy = polach_spin.within(approached, xi, eta, limit_d, law.k_ad, law.k_sd)
    rx, ry = polach_spin.within(approached, xi, eta, limit_r, law.k_ar, law.k_sr)
    W_d = max(-(dx * xi + dy * eta), 0.0)  # [D2]
    W_r = max(-(rx * xi + ry * eta), 0.0)
    W, lambda_ = adhesion.recovery(W_d, W_r, law.tau_m_J)  # [D3]
    kept = 1.0 - lambda_
    limit = kept * limit_d + lambda_ * limit_r
    mz = creep_moment.moment(xi, eta, phi_1_m, limit, a, b, patch)  # [D4]
    return kept * dx + lambda_ * rx, kept * dy + lambda_ * ry, mz, lambda_, W
