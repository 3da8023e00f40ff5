"""Creep force in two directions with spin: four tangential models behind one interface.

Inputs are creepages, spin, sliding speed, load, patch and contaminant; outputs are force and moment
on the wheel. Only degraded adhesion knows recovery. The three classical models take the contaminant
as it is (friction mu_cd, A_d, gamma_d; Polach also k_ad, k_sd), which is the paper's comparison
without recovery. In the degraded model the clean and the contaminated contact each have a creep
force with spin (`polach_spin`), and the force lies between them. Its work on a metre of rail is the
scalar product of force and creepage, so it lies between their works in the same proportion. One
scalar equation is left: the one of `adhesion` [A5] with the two works in place of f_d and f_r.

[D1] T = (1 - lambda) T_d + lambda T_r                                       paper eqs. 9, 18
[D2] W_sp = -(T_x xi + T_y eta), not below 0                                 paper eqs. 8, 17
[D3] W = W_r - (W_r - W_d) exp(-tau W), solved in closed form                paper eqs. 10, 15
[D4] M_z by `johnson_vermeulen.moment`, for the friction limit that lies between theirs likewise

Signs: xi > 0 where the wheel slides forward (braking), so f_x < 0; eta and phi likewise. Source:
Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, whose Table 8 compares the same four. Eqs. 8 and
17 against 20 differ in sign there; here work is positive. Limits: spin does no work in [D2], as in
the paper; with pure spin nothing recovers. Without lateral creepage and spin all is as in
`adhesion`.
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion, fastsim, johnson_vermeulen, polach, polach_spin

# numbers of the tangential models, and their names in [contact] model
DEGRADED, POLACH, FASTSIM, JOHNSON_VERMEULEN = range(4)
MODELS = {
    "degraded": DEGRADED,
    "polach": POLACH,
    "fastsim": FASTSIM,
    "johnson_vermeulen": JOHNSON_VERMEULEN,
}
LARGEST = 1e6  # larger creepages and spins count as this: the contact slides fully long before


@kernel_inlined
def creep_force(model, xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """Return creep force and moment on one wheel by the chosen model.

    Parameters
    ----------
    model : one of `MODELS`
    xi, eta : longitudinal and lateral creepage
    phi_1_m : spin
    sliding_m_s : magnitude of the sliding speed, with which friction falls
    load_N : load on the wheel
    patch : `patch.Patch`; FASTSIM's grid is its `cells` squared
    law : `adhesion.Law` from `adhesion.law_for_contaminant`

    Returns
    -------
    fx_N, fy_N, mz_Nm : against creepage and spin
    """
    x = limited(xi)
    y = limited(eta)
    z = limited(phi_1_m)
    if model == DEGRADED:
        fx, fy, mz, _, _ = recovering_force(x, y, z, sliding_m_s, load_N, patch, law)
        return fx, fy, mz
    if load_N <= 0.0:
        return 0.0, 0.0, 0.0

    # the classical models see the contaminant as it is
    mu = polach.friction(sliding_m_s, law.mu_cd, law.A_d, law.gamma_d_s_m)
    if model == POLACH:
        return polach_spin.force(x, y, z, mu, load_N, patch, law.k_ad, law.k_sd)
    if model == FASTSIM:
        return fastsim.force(x, y, z, mu, load_N, patch, patch.cells, patch.cells)
    return johnson_vermeulen.force(x, y, z, mu, load_N, patch)


@kernel_inlined
def limited(creepage):
    """Return a creepage or spin within the range that the models can square."""
    return min(max(creepage, -LARGEST), LARGEST)


@kernel
def adhesion_of(sliding_m_s, creepage, load_N, patch, law):
    """Return the adhesion coefficient of a wheel that slides only along the rail.

    The patch names the model. The result has the sign of the creepage; without load it is 0.
    """
    fx, _, _ = creep_force(patch.model, creepage, 0.0, 0.0, abs(sliding_m_s), load_N, patch, law)
    return -fx / load_N if load_N > 0.0 else 0.0


@kernel_inlined
def recovering_force(xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """Return force and moment of one wheel in a contact that is cleaned by sliding.

    Parameters
    ----------
    xi, eta, phi_1_m : longitudinal and lateral creepage, spin
    sliding_m_s : magnitude of the sliding speed in the contact, with which friction falls
    load_N : load on the wheel
    patch : `patch.Patch`
    law : `adhesion.Law` from `adhesion.law_for_contaminant`, with the share of its work that cleans

    Returns
    -------
    fx_N, fy_N, mz_Nm : force and moment on the wheel, against creepage and spin
    lambda_ : transition from the degraded to the recovered contact
    W_sp_J_m : specific work
    """
    if load_N <= 0.0 or (xi == 0.0 and eta == 0.0 and phi_1_m == 0.0):
        return 0.0, 0.0, 0.0, 0.0, 0.0
    growth = load_N ** (1.0 / 3.0)
    a = patch.a1 * growth
    b = patch.b1 * growth

    # the forces of the contaminated and of the clean contact
    limit_d = load_N * polach.friction(sliding_m_s, law.mu_cd, law.A_d, law.gamma_d_s_m)
    limit_r = load_N * polach.friction(sliding_m_s, law.mu_cr, law.A_r, law.gamma_r_s_m)
    approached = polach_spin.approach(xi, eta, phi_1_m, a, b, patch)
    dx, dy = polach_spin.within(approached, xi, eta, limit_d, law.k_ad, law.k_sd)
    rx, ry = polach_spin.within(approached, xi, eta, limit_r, law.k_ar, law.k_sr)

    # the work that lies between theirs, and with it lambda
    W_d = max(-(dx * xi + dy * eta), 0.0)  # [D2]
    W_r = max(-(rx * xi + ry * eta), 0.0)
    W, lambda_ = adhesion.recovery(W_d, W_r, law.tau_m_J)  # [D3]

    fx = adhesion.between(dx, rx, lambda_)  # [D1]
    fy = adhesion.between(dy, ry, lambda_)
    limit = adhesion.between(limit_d, limit_r, lambda_)
    mz = johnson_vermeulen.moment(xi, eta, phi_1_m, limit, a, b, patch)  # [D4]
    return fx, fy, mz, lambda_, W
