"""One interface to the four tangential models, chosen by a number.

Creepages, spin, sliding speed, load, patch and contaminant in; force and moment on the wheel out.
Degraded adhesion knows recovery; the three classical models take the contaminant as it lies there
(friction mu_cd, A_d, gamma_d; Polach also k_ad, k_sd), which is the paper's comparison without
recovery.

Signs: xi > 0 where the wheel slides forward (braking), so f_x < 0; eta and phi likewise. Source: the
paper's Table 8 compares the same four.
"""

from rollerrig.rig.contact import degraded_force, fastsim, johnson_vermeulen, polach, polach_spin
from rollerrig.rig.kernel import kernel, kernel_inlined

DEGRADED, POLACH, FASTSIM, JOHNSON_VERMEULEN = range(4)
MODELS = {"degraded": DEGRADED, "polach": POLACH, "fastsim": FASTSIM,
          "johnson_vermeulen": JOHNSON_VERMEULEN}
LARGEST = 1e6  # creepage and spin count as no more: the contact slides fully long before


@kernel_inlined
def creep_force(model, xi, eta, phi_1_m, sliding_m_s, load_N, patch, law):
    """Creep force and moment on one wheel: (fx_N, fy_N, mz_Nm), against creepage and spin.

    `model` one of `MODELS`; longitudinal and lateral creepage xi and eta, spin phi_1_m in 1/m;
    sliding_m_s, the magnitude of the sliding speed, lowers friction; load_N on the wheel; `patch` an
    `adhesion.Patch` (its `cells` squared is FASTSIM's grid), `law` an `adhesion.Law`.
    """
    x, y, z = limited(xi), limited(eta), limited(phi_1_m)
    if model == DEGRADED:
        fx, fy, mz, _, _ = degraded_force.force(x, y, z, sliding_m_s, load_N, patch, law)
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
