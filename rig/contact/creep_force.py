"""Creep force in two directions with spin: four tangential models behind one interface.

Creepages, spin, sliding speed, load, patch and contaminant in; force and moment on the wheel out. Degraded adhesion
knows recovery; the three classical models take the contaminant as it lies there (friction mu_cd, A_d, gamma_d; Polach
also k_ad, k_sd), which is the paper's comparison without recovery. In the degraded model the clean and the contaminated
contact each have a creep force with spin (`polach_spin`). The work that the force between them does on a metre of rail
is the scalar product of force and creepage, so it lies between theirs in the same proportion, and one scalar equation
is left, the one of `adhesion` [A5] with the two works in place of f_d and f_r.

[D1] T = (1 - lambda) T_d + lambda T_r                                       paper eqs. 9, 18
[D2] W_sp = -(T_x xi + T_y eta), not below 0                                 paper eqs. 8, 17
[D3] W = W_r - (W_r - W_d) exp(-tau W), solved in closed form                paper eqs. 10, 15
[D4] M_z by `johnson_vermeulen.moment`, for the friction limit that lies between theirs likewise

Signs: xi > 0 where the wheel slides forward (braking), so f_x < 0; eta and phi likewise. Source:
Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, whose Table 8 compares the same four. Eqs. 8 and 17
against 20 differ in sign there; here work is positive. Limits: spin does no work in [D2], as in the
paper; with pure spin nothing recovers. Without lateral creepage and spin all is as in `adhesion`.
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion, fastsim, johnson_vermeulen, polach, polach_spin

DEGRADED, POLACH, FASTSIM, JOHNSON_VERMEULEN = range(4)
MODELS = {
    "degraded": DEGRADED,
    "polach": POLACH,
    "fastsim": FASTSIM,
    "johnson_vermeulen": JOHNSON_VERMEULEN,
}
LARGEST = 1e6  # creepage and spin count as no more: the contact slides fully long before


@kernel_inlined
def creep_force(model, xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """Creep force and moment on one wheel: (fx_N, fy_N, mz_Nm), against creepage and spin.

    `model` one of `MODELS`; longitudinal and lateral creepage xi and eta, spin phi_1_m in 1/m;
    sliding_m_s, the magnitude of the sliding speed, lowers friction; load_N on the wheel; `patch` a
    `patch.Patch` (its `cells` squared is FASTSIM's grid), `law` from `adhesion.law_for_contaminant`.
    """
    x, y, z = limited(xi), limited(eta), limited(phi_1_m)
    if model == DEGRADED:
        fx, fy, mz, _, _ = degraded_force(x, y, z, sliding_m_s, load_N, patch, law)
        return fx, fy, mz
    if load_N <= 0.0:
        return 0.0, 0.0, 0.0
    mu = polach.friction(sliding_m_s, law.mu_cd, law.A_d, law.gamma_d_s_m)
    if model == POLACH:
        return polach_spin.force(x, y, z, mu, load_N, patch, law.k_ad, law.k_sd)
    if model == FASTSIM:
        return fastsim.force(x, y, z, mu, load_N, patch, patch.cells, patch.cells)
    return johnson_vermeulen.force(x, y, z, mu, load_N, patch)


@kernel_inlined
def limited(creepage):
    """A creepage or spin within what the models can square."""
    return min(max(creepage, -LARGEST), LARGEST)


@kernel
def adhesion_of(sliding_m_s, creepage, load_N, patch, law):
    """Adhesion coefficient of a wheel that only slides along, by the patch's model; signed like it."""
    fx, _, _ = creep_force(patch.model, creepage, 0.0, 0.0, abs(sliding_m_s), load_N, patch, law)
    return -fx / load_N if load_N > 0.0 else 0.0


@kernel_inlined
def degraded_force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """(fx_N, fy_N, mz_Nm, lambda_, W_sp_J_m) of one wheel; forces act on it, against creepage.

    sliding_m_s is the speed of sliding in the contact that friction falls with, a magnitude;
    phi_1_m the spin in 1/m; `law` from `adhesion.law_for_contaminant`, with the share of its tau that cleans.
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
    limit = adhesion.between(limit_d, limit_r, lambda_)
    mz = johnson_vermeulen.moment(xi, eta, phi_1_m, limit, a, b, patch)  # [D4]
    return adhesion.between(dx, rx, lambda_), adhesion.between(dy, ry, lambda_), mz, lambda_, W
