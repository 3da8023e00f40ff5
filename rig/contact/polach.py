"""Polach's creep force: from adhesion to full sliding in one closed formula.

At small creepage the patch sticks in front and slips behind, and the force grows in proportion to
creepage; at large creepage all of it slips. Two factors k_A <= 1 and k_S <= k_A weaken the sticking
and the slipping part for contaminated surfaces, and the friction itself falls with sliding speed.

[P1] mu = (mu_c / A - mu_c) exp(-gamma |s|) + mu_c: mu_c / A at rest, mu_c at large sliding s
[P2] eps = pi G a b c11 |e| / (4 mu N): gradient of the tangential stress, with creepage e
[P3] f = F / N = (2 mu / pi) [k_A eps / (1 + (k_A eps)^2) + atan(k_S eps)]

Source: Polach, Wear 258 (2005) 992-1000; paper eqs. 11 to 14 ([P1] is eq. 13; for longitudinal creepage eq. 14 gives C
= 3 G c11 / (8 a), hence [P2]). Limits: no spin. Against the half-space program CONTACT, with k_A = k_S = 1, the formula
errs by 0.018 mu N on average and 0.054 mu N at most over 25 creepages on a rail (lateral radius 0.3 m).
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined

LARGEST_EPS = 1e150  # its square is still finite; the force is saturated long before


@kernel_inlined
def friction(sliding_m_s, mu_c, A, gamma_s_m):
    """Friction coefficient at a sliding speed of either sign [P1], paper eq. 13; 0 < A."""
    # without decay infinite sliding would give 0 * inf
    decay = math.exp(-gamma_s_m * abs(sliding_m_s)) if gamma_s_m > 0.0 else 1.0
    return mu_c + (mu_c / A - mu_c) * decay


@kernel
def eps_per_creepage(a_m, b_m, c11, shear_Pa, load_N):
    """mu eps / |e| of [P2], eps = this * creepage / mu, 0 without load; a_m along, b_m across, c11 of `kalker`."""
    if not load_N > 0.0:
        return 0.0
    return 0.25 * math.pi * shear_Pa * c11 * a_m * b_m / load_N


@kernel_inlined
def shape(eps, k_a, k_s):
    """Adhesion over friction, f / mu of [P3], below 1 for k_s <= k_a, and its derivative to eps: (odd, even) in eps."""
    x = min(max(eps, -LARGEST_EPS), LARGEST_EPS)
    stick, slip = k_a * x, k_s * x
    bend = 1.0 / (1.0 + stick * stick)  # (1 - stick^2) bend^2 = (2 bend - 1) bend
    return (
        (2.0 / math.pi) * (stick * bend + math.atan(slip)),
        (2.0 / math.pi) * (k_a * (2.0 * bend - 1.0) * bend + k_s / (1.0 + slip * slip)),
    )


@kernel
def curve(sliding_m_s, creepage, eps_unit, mu_c, A, gamma_s_m, k_a, k_s):
    """Adhesion coefficient with falling friction [P1] [P3], and its slopes: (f, df_ds_s_m, df_de).

    For magnitudes sliding_m_s >= 0 and creepage >= 0; eps_unit is `eps_per_creepage`. df_ds_s_m is
    the change with sliding through friction, df_de the one with creepage: at constant speed v the
    slope to sliding is df_ds_s_m + df_de / v. Without friction all three are 0.
    """
    mu = friction(sliding_m_s, mu_c, A, gamma_s_m)
    if not mu > 0.0:
        return 0.0, 0.0, 0.0
    eps = eps_unit * creepage / mu  # [P2]
    part, steepness = shape(eps, k_a, k_s)
    # mu is a factor of f and a divisor in eps; its own slope is -gamma (mu - mu_c)
    fall = -gamma_s_m * (mu - mu_c)
    return mu * part, (part - min(eps, LARGEST_EPS) * steepness) * fall, eps_unit * steepness
