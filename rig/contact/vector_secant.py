"""The adhesion law of `vector_law` with few divisions, for wheels that are followed step by step.

A division takes a core ten times as long as a product, and the law as it is written has twenty of
them for each wheel. Here independent quotients share one division [D1], and the root of [A5] begins
with that of the step before instead of with Lambert's function. Four divisions are left.

    [D1] 1 / a = b (1 / (a b)),  1 / b = a (1 / (a b))
    [D2] g(y) = y - k f_d - k D (1 - exp(-y)) = 0, where y = k f = tau W_sp     [L1] of `vector_law`
    [D3] one Householder step of third order on g from the last root

For D >= 0 and f_d > 0, g is convex and below 0 at y = 0, so it has one positive root, and a step
that is small cannot lead to another one.

Within the domain the adhesion agrees with `adhesion.wheel_adhesion` to 1e-9 (tests). The domain is
that of `vector_law`; in addition the last root must be near. Elsewhere `inside` is 0, and the
caller then uses `adhesion` and begins the next step with its root.
"""

import math

from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact.adhesion import SPEED_FLOOR_M_S, STILL_M_S
from rollerrig.rig.contact.vector_law import HEAVIER, LIGHTER, LOAD_N

_PER_ROOT = LOAD_N ** (-1.0 / 3.0)
_PER_LOAD_N = 1.0 / LOAD_N
# the largest Householder step [D3]
_LARGEST_STEP = 1e-3
# The largest step times the curvature of g, over its slope g1. The error of a step is about the
# step times the cube of this: with both limits it is below 1e-10. Near a double root g1 is small.
_LARGEST_TURN = 0.003
# a sliding speed that stands for infinity and can still be multiplied
_NEVER_M_S = 1e18


@kernel_inlined
def frictions(size_m_s, surface_m_s, load_N, eps1, decay_d, decay_r, law):
    """Return both frictions, their product with the gradient of the stress, k and 1 / sliding.

    Parameters
    ----------
    size_m_s : magnitude of the sliding, above 0
    surface_m_s : speed of the surface, of either sign
    load_N : load on one wheel
    eps1 : the field of a `patch.Patch`, N^(1/3)
    decay_d, decay_r : 1 / A - 1 of the degraded and of the recovered friction
    law : `adhesion.Law`

    Returns
    -------
    mu_d, mu_r : degraded and recovered friction at this sliding
    eps_mu : gradient of the stress times friction
    k : exponent of [A5] for f = 1, with the fading of [A6]
    per_size : 1 / size_m_s
    """
    u = load_N * _PER_LOAD_N
    speed = max(abs(surface_m_s), SPEED_FLOOR_M_S)

    # numerator and denominator of x in [A6], both times (v + v_h) (s_c + e_c v) v
    slow = max(abs(surface_m_s), STILL_M_S)
    fades = law.cleaning_creepage < 1.0
    creepage = law.cleaning_creepage if fades else 0.5
    most = min(law.cleaning_sliding_m_s, _NEVER_M_S)
    begin = creepage * slow
    reach = (slow + law.cleaning_half_speed_m_s) * (most + begin)
    fading_range = (slow - begin) * reach
    faded = size_m_s * reach - begin * slow * most

    # 1 / speed, 1 / (1 + 2 u), 1 / size, 1 / fading_range [D1]
    light = 1.0 + 2.0 * u
    first = speed * light
    second = size_m_s * fading_range
    one = 1.0 / (first * second)
    per_first = one * second
    per_second = one * first
    per_size = per_second * fading_range
    e = size_m_s * (per_first * light)
    root = vector_math.inverse_cube_root_near(u, (2.0 + u) * (per_first * speed))
    x = min(max(faded * (per_second * size_m_s), 0.0), 1.0)
    share = 1.0 - x * x * (3.0 - 2.0 * x) if fades else 1.0

    mu_d = law.mu_cd * (1.0 + decay_d * vector_math.exp(-law.gamma_d_s_m * size_m_s))
    mu_r = law.mu_cr * (1.0 + decay_r * vector_math.exp(-law.gamma_r_s_m * size_m_s))
    eps_mu = eps1 * _PER_ROOT * root * e
    return mu_d, mu_r, eps_mu, law.tau_m_J * load_N * e * share, per_size


@kernel_inlined
def curves(mu_d, mu_r, eps_mu, law):
    """Return Polach's curves f_d and f_r [A4]; arguments are results of `frictions`.

    Both share their divisions [D1].
    """
    stick_d = law.k_ad * eps_mu
    stick_r = law.k_ar * eps_mu
    base_d, rest_d, above_d, below_d = vector_math.atan_parts(law.k_sd * eps_mu, mu_d)
    base_r, rest_r, above_r, below_r = vector_math.atan_parts(law.k_sr * eps_mu, mu_r)
    square_d = mu_d * mu_d + stick_d * stick_d
    square_r = mu_r * mu_r + stick_r * stick_r
    of_d = below_d * square_d
    of_r = below_r * square_r
    one = 1.0 / (of_d * of_r)
    per_d = one * of_r
    per_r = one * of_d
    t_d = above_d * (per_d * square_d)
    t_r = above_r * (per_r * square_r)
    z_d = t_d * t_d
    z_r = t_r * t_r
    under_d = vector_math.atan_denominator(z_d)
    under_r = vector_math.atan_denominator(z_r)
    one = 1.0 / (under_d * under_r)
    part_d = z_d * vector_math.atan_numerator(z_d) * (one * under_r)
    part_r = z_r * vector_math.atan_numerator(z_r) * (one * under_d)
    slip_d = base_d + ((t_d * part_d + t_d) + rest_d)
    slip_r = base_r + ((t_r * part_r + t_r) + rest_r)
    f_d = (2.0 / math.pi) * mu_d * (stick_d * mu_d * (per_d * below_d) + slip_d)
    f_r = (2.0 / math.pi) * mu_r * (stick_r * mu_r * (per_r * below_r) + slip_r)
    return f_d, f_r


@kernel_inlined
def recovered(f_d, f_r, k, load_N, y_near):
    """Return the adhesion f, and the root [D2] that it comes from.

    Parameters
    ----------
    f_d, f_r : results of `curves`
    k, load_N : a result and an argument of `frictions`
    y_near : the root of a moment before

    Returns
    -------
    f : adhesion
    y : the root
    inside : 1 if both are valid, else 0
    """
    D = f_r - f_d
    drive = k * D
    kept = vector_math.exp(-y_near)
    g = y_near - k * f_d - drive * (1.0 - kept)
    h = drive * kept
    g1 = 1.0 - h
    square = g1 * g1
    step = -g * (6.0 * square - 3.0 * g * h) / (6.0 * g1 * (square - g * h) - g * g * h)
    # exp(-step), by its series
    kept *= 1.0 - step * (1.0 - step * (0.5 - step * (1.0 / 6.0)))
    f = f_d + D * (1.0 - kept)

    u = load_N * _PER_LOAD_N
    inside = (
        (u > LIGHTER)
        & (u < HEAVIER)
        & (D >= 0.0)
        & (abs(step) < _LARGEST_STEP)
        & (abs(step) * h < _LARGEST_TURN * g1)
    )
    return f, y_near + step, (1.0 if inside else 0.0)
