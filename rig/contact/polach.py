"""Polach's creep force: from adhesion to full sliding in one closed formula.

At small creepage the patch sticks in front and slips behind, and the force grows in proportion to
the creepage. At large creepage the whole patch slips. Two factors k_A <= 1 and k_S <= k_A weaken
the sticking and the slipping part for contaminated surfaces. The friction falls with the sliding
speed.

[P1] mu = (mu_c / A - mu_c) exp(-gamma |s|) + mu_c: mu_c / A at rest, mu_c at large sliding s
[P2] eps = pi G a b c11 |e| / (4 mu N): gradient of the tangential stress, with creepage e
[P3] f = F / N = (2 mu / pi) [k_A eps / (1 + (k_A eps)^2) + atan(k_S eps)]

Source: Polach, Wear 258 (2005) 992-1000; paper eqs. 11 to 14 ([P1] is eq. 13; for longitudinal
creepage eq. 14 gives C = 3 G c11 / (8 a), hence [P2]). Limits: no spin. Against the half-space
program CONTACT, with k_A = k_S = 1, the formula errs by 0.018 mu N on average and 0.054 mu N at
most over 25 creepages on a rail (lateral radius 0.3 m).
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined

LARGEST_EPS = 1e150  # its square is still finite; the force is saturated long before


@kernel_inlined
def friction(sliding_m_s, mu_c, A, gamma_s_m):
    """Return the friction coefficient at a sliding speed of either sign [P1], paper eq. 13.

    Parameters
    ----------
    sliding_m_s : sliding speed
    mu_c : kinematic friction, at large sliding
    A : kinematic over static friction, above 0
    gamma_s_m : decay with the sliding speed
    """
    # without decay, infinite sliding would give 0 * inf
    decay = math.exp(-gamma_s_m * abs(sliding_m_s)) if gamma_s_m > 0.0 else 1.0
    return mu_c + (mu_c / A - mu_c) * decay


@kernel
def eps_per_creepage(a_m, b_m, c11, shear_Pa, load_N):
    """Return mu eps / |e| of [P2]: eps is this value times creepage over friction.

    Semi-axes `a_m` along and `b_m` across the rolling direction, `c11` of `kalker`, `shear_Pa` the
    shear modulus. Without load the result is 0.
    """
    if not load_N > 0.0:
        return 0.0
    return 0.25 * math.pi * shear_Pa * c11 * a_m * b_m / load_N


@kernel_inlined
def shape(eps, k_a, k_s):
    """Return adhesion over friction, f / mu of [P3], and its derivative to eps.

    The first is odd in eps and below 1 for k_s <= k_a; the second is even in eps.
    """
    x = min(max(eps, -LARGEST_EPS), LARGEST_EPS)
    stick = k_a * x
    slip = k_s * x
    bend = 1.0 / (1.0 + stick * stick)
    return (
        (2.0 / math.pi) * (stick * bend + math.atan(slip)),
        # derivative of stick / (1 + stick^2): (1 - stick^2) bend^2 = (2 bend - 1) bend
        (2.0 / math.pi) * (k_a * (2.0 * bend - 1.0) * bend + k_s / (1.0 + slip * slip)),
    )


@kernel
def curve(sliding_m_s, creepage, eps_unit, mu_c, A, gamma_s_m, k_a, k_s):
    """Return the adhesion coefficient with falling friction [P1] [P3], and its slopes.

    At a constant speed v the slope to the sliding is df_ds_s_m + df_de / v. Without friction all
    three results are 0.

    Parameters
    ----------
    sliding_m_s, creepage : magnitudes, not below 0
    eps_unit : from `eps_per_creepage`
    mu_c, A, gamma_s_m : as for `friction`
    k_a, k_s : reductions in the areas of adhesion and of slip

    Returns
    -------
    f : adhesion coefficient
    df_ds_s_m : its change with sliding, which acts through friction
    df_de : its change with creepage
    """
    mu = friction(sliding_m_s, mu_c, A, gamma_s_m)
    if not mu > 0.0:
        return 0.0, 0.0, 0.0
    eps = eps_unit * creepage / mu  # [P2]
    part, steepness = shape(eps, k_a, k_s)

    # mu is a factor of f and a divisor in eps; its slope to the sliding is -gamma (mu - mu_c)
    fall = -gamma_s_m * (mu - mu_c)
    return mu * part, (part - min(eps, LARGEST_EPS) * steepness) * fall, eps_unit * steepness
