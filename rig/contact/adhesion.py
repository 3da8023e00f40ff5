"""Degraded adhesion: a contaminated contact that is cleaned by the work of sliding.

Between wheel and rail lies a contaminant (water, leaves, oil) that sliding destroys. Without any
work the contact follows a degraded creep curve f_d. A fully cleaned contact follows a recovered
curve f_r. Both curves are Polach's, each with its own friction. The specific work W_sp is the work
of sliding on each metre of rail. It moves the contact from one curve to the other. Since the work
depends on the adhesion itself, f is the root of an equation. Lambert's function W0 gives this root
in closed form, so every step has a bounded cost. The plant, the coach in 3D, the stops that run in
lanes and the replay of measured runs all use this law.

[A1] f = (1 - lambda) f_d + lambda f_r                                      paper eq. 9
[A2] lambda = 1 - exp(-tau W_sp)                                            paper eq. 10
[A3] W_sp = f N |e|, in J/m, for one wheel                                  paper eq. 8
[A4] f_d, f_r: `polach` with (mu_cd, A_d, gamma_d), (mu_cr, A_r, gamma_r)   paper eqs. 11 to 13
[A5] with D = f_r - f_d and k = tau N |e|:  f = f_r - D exp(-k f), paper eq. 15, solved by
     f = f_r + W0(-k D exp(-k f_r)) / k
[A6] tau |e| -> tau |e| (1 - x^2 (3 - 2 x)), x = (|s / v| - e_v) / (1 - e_c), from 0 to 1, with
     1 / e_v = 1 / e_c + v / s_c, and e_v times v / (v + v_h). Up to a creepage e_v this is the
     paper's law, to the bit; beyond it cleaning fades, and a locked wheel cleans nothing. e_c
     limits the creepage: a turning tread carries the loosened contaminant out of the contact, a
     locked one leaves it there. s_c limits the sliding speed, which matters at high speed: where
     the paper's law was validated, a WSP held it at 4 to 6 m/s. Without a limit a locked wheel on
     soap has the whole recovered adhesion, 0.26 at 40 m/s. v_h, 0 in the packaged sets, lowers the
     limit at low speed, where the paper's data do not decide. Form and numbers: assumption
     (docs/paper.md has the evidence). e_c of 1 or more, the default, is the paper's law throughout
[A7] d lambda/dx = (lambda_0 - lambda) / (L (v / 20 m/s)^p), where an extended model gives recovery
     a memory L. lambda_0 is the transition of [A2], either for the work that [A5] has done or for
     the work that the f of the remembered lambda does: assumption

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937; mu_cs of its section 4 is read as mu_cr.
Limits: longitudinal creepage only; below SPEED_FLOOR_M_S of vehicle speed creepage is sliding over
that floor.
"""

import math
from typing import NamedTuple

from rollerrig.configs.vehicle import MIDDLE_SPEED_M_S
from rollerrig.rig.compiled.generated import tuple_builder
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import polach

SPEED_FLOOR_M_S = 0.1  # smallest speed by which sliding is divided
STILL_M_S = 1e-9  # smallest speed for [A6]: a wheel on a slower surface counts as locked
NO_MEMORY = -1.0  # value of a remembered lambda where recovery does not lag [A7]
# sliding, load and k beyond it count as this value, so that infinity makes no NaN
LARGEST = 1e30
# energy exponents k f below it count as 0, before they lose digits
SMALLEST = 1e-290
# 1/e as the sum of two doubles
INVERSE_E = 0.36787944117144233
INVERSE_E_REST = -1.2428753672788363e-17
# p^2 of `_shrink` below which the argument of W0 has lost digits near the branch point
NEAR_BRANCH_POINT = 0.02
# energy exponents k f below it have lost digits in a difference; above it, none of 12
FEW_DIGITS = 0.02


class Law(NamedTuple):
    """Parameters of the adhesion law (paper Table 4): degraded _d, recovered _r.

    This is the one list of the law's fields: parameters, contaminants, lanes and replay follow it.
    A new field needs its row in `parameters.toml`, section [adhesion], and a place in the formulas.
    """

    mu_cd: float  # kinematic friction, degraded
    mu_cr: float  # kinematic friction, recovered
    A_d: float  # kinematic over static friction
    A_r: float
    gamma_d_s_m: float  # decay of friction with sliding
    gamma_r_s_m: float
    k_ad: float  # reduction in the area of adhesion
    k_sd: float  # reduction in the area of slip
    k_ar: float
    k_sr: float
    tau_m_J: float  # recovery for each J/m of specific work
    cleaning_creepage: float = math.inf  # e_c of [A6]
    cleaning_half_speed_m_s: float = 0.0  # v_h of [A6]
    cleaning_sliding_m_s: float = math.inf  # s_c of [A6]


@kernel_inlined
def creepage_of(sliding_m_s, speed_m_s):
    """Return the magnitude of creepage: sliding over speed, for both signs of each, paper eq. 7."""
    return abs(sliding_m_s) / max(abs(speed_m_s), SPEED_FLOOR_M_S)


# fields that `law_for_contaminant` sets from its arguments; it copies every other field
_OF_CONTAMINANT = {
    "mu_cd": "mu_cd",
    "mu_cr": "mu_cr",
    "tau_m_J": "cleaning_share * law.tau_m_J",
}
# A kernel (mu_cd, mu_cr, cleaning_share, law) -> Law: the law with the friction of the contaminant
# under a wheel. Only `cleaning_share` of the work cleans [A6]; it is 1 where `curves` applies [A6].
law_for_contaminant = tuple_builder(
    Law,
    "mu_cd, mu_cr, cleaning_share, law",
    (_OF_CONTAMINANT.get(name, f"law.{name}") for name in Law._fields),
)


@kernel_inlined
def cleaning_share(sliding_m_s, speed_m_s, law):
    """Return the share of the work that cleans, and its derivative to the sliding [A6].

    Parameters
    ----------
    sliding_m_s : magnitude of the sliding
    speed_m_s : speed of the surface, of either sign
    law : `Law`; with `cleaning_creepage` from 1 on, cleaning never fades

    Returns
    -------
    share : 1 up to the creepage e_v, 0 for a locked wheel
    slope_s_m : d share / d sliding, in s/m, not above 0
    """
    speed = min(max(abs(speed_m_s), STILL_M_S), LARGEST)
    fades = law.cleaning_creepage < 1.0
    creepage = law.cleaning_creepage if fades else 0.5
    begin = creepage / (1.0 + creepage * speed / law.cleaning_sliding_m_s)
    begin *= speed / (speed + law.cleaning_half_speed_m_s)  # e_v
    range_m_s = (1.0 - creepage) * speed if fades else math.inf

    x = min(max(sliding_m_s - begin * speed, 0.0) / range_m_s, 1.0)
    return 1.0 - x * x * (3.0 - 2.0 * x), -6.0 * x * (1.0 - x) / range_m_s


@kernel_inlined
def curves(sliding_m_s, speed_m_s, load_N, eps1, law):
    """Return the two limits of a contact's adhesion and the energy factor of recovery.

    Slopes are derivatives to the magnitude of sliding, at constant speed and load.

    Parameters
    ----------
    sliding_m_s : sliding of either sign
    speed_m_s : speed of the surface, of either sign
    load_N : load on one wheel, above 0
    eps1 : the field of a `patch.Patch`, N^(1/3)
    law : `Law` from `law_for_contaminant`

    Returns
    -------
    f_d, f_r : degraded and recovered adhesion [A4]
    slope_d_s_m, slope_r_s_m : their slopes
    k : exponent of [A5] for f = 1, with the fading of [A6]
    slope_k_s_m : its slope
    """
    speed = max(abs(speed_m_s), SPEED_FLOOR_M_S)
    sliding = abs(sliding_m_s)
    creepage = sliding / speed

    # stress gradient for this load: eps1 N^(-1/3)
    eps_unit = eps1 * math.exp(math.log(load_N) / -3.0)
    f_d, ds_d, de_d = polach.curve(  # [A4]
        sliding, creepage, eps_unit, law.mu_cd, law.A_d, law.gamma_d_s_m, law.k_ad, law.k_sd
    )
    f_r, ds_r, de_r = polach.curve(
        sliding, creepage, eps_unit, law.mu_cr, law.A_r, law.gamma_r_s_m, law.k_ar, law.k_sr
    )

    share, share_slope = cleaning_share(sliding, speed_m_s, law)
    work = law.tau_m_J * load_N
    return (
        f_d,
        f_r,
        ds_d + de_d / speed,
        ds_r + de_r / speed,
        work * share * creepage,
        work * (share / speed + share_slope * creepage),
    )


@kernel_inlined
def between(degraded, recovered, lambda_):
    """Return the value between a degraded and a recovered one, by the transition lambda [A1]."""
    return (1.0 - lambda_) * degraded + lambda_ * recovered


@kernel_inlined
def f_and_lambda(f_d, f_r, slope_d, slope_r, k, slope_k, lagging, of_work):
    """Return adhesion and transition with their derivatives to the sliding.

    Parameters
    ----------
    f_d, f_r, slope_d, slope_r, k, slope_k : from `curves`
    lagging : the remembered lambda where recovery lags, else NO_MEMORY [A7]
    of_work : above 0, lambda_0 is the one of the work that f does at the remembered lambda [A7];
        otherwise, and without memory, f is the root of [A5]

    Returns
    -------
    f, lambda_0 : adhesion and transition
    slope_f_s_m, slope_lambda_s_m : their derivatives to the sliding
    """
    if lagging >= 0.0 and of_work > 0.0:
        f = between(f_d, f_r, lagging)
        rise = between(slope_d, slope_r, lagging)
        lambda_ = -math.expm1(-k * f)  # [A2]
        kept = 1.0 - lambda_
    else:
        f, lambda_ = recovery(f_d, f_r, k)
        # [A1] and [A2], differentiated together
        kept = 1.0 - lambda_
        freed = (f_r - f_d) * kept
        rise = (between(slope_d, slope_r, lambda_) + freed * f * slope_k) / max(
            1.0 - freed * k, 1e-9
        )
    return f, lambda_, rise, kept * (slope_k * f + k * rise)


@kernel_inlined
def lag_rate_1_s(speed_m_s, length_m, power):
    """Return the rate in 1/s at which lambda follows lambda_0 [A7].

    `length_m` is the memory L and `power` the exponent p. Finite at standstill for p up to 1.
    """
    return (
        MIDDLE_SPEED_M_S / length_m * math.pow(max(speed_m_s, 0.0) / MIDDLE_SPEED_M_S, 1.0 - power)
    )


@kernel
def lambert_w0(x):
    """Return the principal branch W0 of Lambert's function: w exp(w) = x with w >= -1.

    Accurate to 1e-14, with a bounded number of iterations. For x < -1/e, where no real branch
    exists, the result is -1.
    """
    if x <= 0.0:
        p2 = 2.0 * math.e * ((x + INVERSE_E) + INVERSE_E_REST)
        return max(math.e * x * _shrink(math.sqrt(max(p2, 0.0))), -1.0)
    if x == math.inf:
        return x

    # Winitzki's approximation is within 2 %: two steps of fourth order are enough
    L = math.log1p(x)
    w = L * (1.0 - math.log1p(L) / (2.0 + L))
    for _ in range(2):
        w = _refined(w, math.log(x / w))
    return w


@kernel_inlined
def _shrink(p):
    """Return exp(-1 - W0(x)) for -1/e <= x <= 0, given p = sqrt(2 (1 + e x)).

    Then W0(x) = e x times the result. This rational function meets the exact one at 13 Chebyshev
    nodes and is within 7e-17 of it.
    """
    q = p * p
    above = (
        1.0
        + q * (0.6418430424881612 + q * (7.234738250119583e-3 - q * 4.459593750671883e-7))
        + p * (1.3747358298298924 + q * (0.11803369785050472 + q * 5.000513759881882e-5))
    )
    below = (
        1.0
        + q * (2.183245538984029 + q * (0.21685242692459342 + q * 7.218824756350326e-4))
        + p * (2.3747358298299095 + q * (0.9751104897662368 + q * 2.1803135892675286e-2))
    )
    return above / below


@kernel
def _refined(w, log_x_over_w):
    """Return a better solution w of w exp(w) = x by one step of fourth order.

    Source: Fritsch, Shafer and Crowley 1973.
    """
    z = log_x_over_w - w
    q = 2.0 * (1.0 + w) * (1.0 + w + 2.0 / 3.0 * z)
    return w + w * z * (q - z) / ((1.0 + w) * (q - 2.0 * z))


@kernel_inlined
def recovery(f_d, f_r, k):
    """Return the pair (f, lambda) of [A5] and [A2]; without energy (k = 0) exactly (f_d, 0).

    Also valid for f_r < f_d (sliding that spoils the contact), and for any large k. For f_d = 0 no
    work is done at the beginning: f stays 0 up to k f_r = 1; beyond it the positive root is
    returned. The units of f_d and f_r are free, if k f_d and k f_r have none.
    """
    k = min(k, LARGEST)
    most = k * f_r
    least = k * f_d
    if most <= SMALLEST and least <= SMALLEST:
        return f_d, 0.0

    D = f_r - f_d
    drive = k * D
    if D <= 0.0:
        # the contact is spoiled: [A5] is a sum of positive terms and loses no digits
        f = min(f_r + lambert_w0(-drive * math.exp(-most)) / k, f_d)  # [A5]
        return f, -math.expm1(-k * f)
    if least == 0.0 and most <= 1.0:
        return 0.0, 0.0

    # W0's argument is -drive exp(-most), and p2 = 2 (1 + e times it)
    fall = math.exp(1.0 - most)
    p2 = 2.0 - 2.0 * drive * fall
    if p2 < NEAR_BRANCH_POINT:
        # the argument has lost the digits that `most` and `least` still have
        rise = math.expm1(1.0 - most)
        p2 = -2.0 * (rise + (most - 1.0 - least) * (1.0 + rise))
    shrink = fall * _shrink(math.sqrt(max(p2, 0.0)))  # exp(-y)
    y = most - drive * shrink  # y = k f = tau W_sp [A5]

    if y > FEW_DIGITS:
        done = 1.0 - shrink
    else:
        # y has few digits left: one step of Newton on y = least + drive (1 - exp(-y))
        done = -math.expm1(-y)
        steep = 1.0 - drive * (1.0 - done)
        if steep > 1e-9:
            done += (1.0 - done) * (least + drive * done - y) / steep
    lambda_ = min(max(done, 0.0), 1.0)
    return min(f_d + D * lambda_, f_r), lambda_  # [A1]


@kernel
def wheel_adhesion(sliding_m_s, speed_m_s, load_N, patch, law):
    """Return the adhesion of one wheel, with its limits and the work of sliding.

    Without load all results are 0.

    Parameters
    ----------
    sliding_m_s : sliding of either sign
    speed_m_s : speed of the vehicle, or of the roller's surface
    load_N : load on one wheel
    patch : `patch.Patch`
    law : `Law`

    Returns
    -------
    f : adhesion, signed like the sliding; the contact force is f load_N
    f_d, f_r : magnitudes of the degraded and the recovered adhesion
    lambda_ : transition [A2]
    W_sp_J_m : specific work of this wheel [A3]
    slope_s_m : df/dsliding at constant speed and load, negative where adhesion falls
    """
    if load_N <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    load = min(load_N, LARGEST)
    sliding = min(abs(sliding_m_s), LARGEST)
    f_d, f_r, slope_d, slope_r, k, slope_k = curves(sliding, speed_m_s, load, patch.eps1, law)
    f, lambda_, rise, _ = f_and_lambda(f_d, f_r, slope_d, slope_r, k, slope_k, NO_MEMORY, 0.0)
    return (
        math.copysign(f, sliding_m_s),
        f_d,
        f_r,
        lambda_,
        f * load * creepage_of(sliding, speed_m_s),
        rise,
    )
