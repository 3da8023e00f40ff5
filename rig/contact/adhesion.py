"""Degraded adhesion: a contaminated contact that cleans itself by the work of sliding.

Between wheel and rail lies a contaminant (water, leaves, oil) that sliding destroys. Without any work done the contact
follows a degraded creep curve f_d, fully cleaned a recovered one f_r; both are Polach's, with their own friction. The
specific work W_sp done on each metre of rail moves the contact from one to the other; and since the work depends on the
adhesion itself, f is the root of an equation, which Lambert's function W0 gives in closed form: a bounded cost at every
step. The plant, the coach in 3D, stops abreast and the replay of measured runs all take the law from here.

[A1] f = (1 - lambda) f_d + lambda f_r                                      paper eq. 9
[A2] lambda = 1 - exp(-tau W_sp)                                            paper eq. 10
[A3] W_sp = f N |e|, in J/m, for one wheel                                  paper eq. 8
[A4] f_d, f_r: `polach` with (mu_cd, A_d, gamma_d), (mu_cr, A_r, gamma_r)   paper eqs. 11 to 13
[A5] with D = f_r - f_d and k = tau N |e|:  f = f_r - D exp(-k f), paper eq. 15, solved by
     f = f_r + W0(-k D exp(-k f_r)) / k
[A6] tau |e| -> tau |e| (1 - x^2 (3 - 2 x)), x = (|s / v| - e_c) / (1 - e_c), from 0 to 1. Up to a
     creepage e_c this is the paper's law, to the bit. A locked wheel would have the whole recovered
     adhesion at once by it (0.26 on soap at 40 m/s), which no rail gives: what sliding loosens leaves
     the contact on the tread that turns out of it, and a locked wheel keeps it there. So cleaning
     fades with the turning, and a locked wheel stays on f_d. Reason, form and e_c: assumption; e_c of
     1 or more, as by default, is the paper's law throughout
[A7] d lambda/dx = (lambda_0 - lambda) / (L (v / 20 m/s)^p), where an extended model gives recovery a
     memory L; lambda_0 is the transition of [A2]: of the work that [A5] has done, or of the one done
     by the f that lambda gives: assumption

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937; mu_cs of its section 4 is read as mu_cr.
Limits: longitudinal creepage only; below SPEED_FLOOR_M_S of vehicle speed creepage is sliding over
that floor.
"""

import math
from typing import NamedTuple

from rollerrig.configs.vehicle import MIDDLE_SPEED_M_S
from rollerrig.rig.compiled.kernel import constructor, kernel, kernel_inlined
from rollerrig.rig.contact import polach

SPEED_FLOOR_M_S = 0.1
STILL_M_S = 1e-9  # a wheel on a slower surface counts as locked
NO_MEMORY = -1.0
LARGEST = 1e30  # sliding, load and k beyond it count as it, so that infinity makes no NaN
SMALLEST = 1e-290  # energy exponents k f below it count as 0, before they lose digits
INVERSE_E, INVERSE_E_REST = 0.36787944117144233, -1.2428753672788363e-17  # 1/e in two doubles
FEW_DIGITS = (
    0.02  # energy exponents k f below it have lost digits in a difference, above it none of 12
)


class Law(NamedTuple):
    """Parameters of the adhesion law (paper Table 4): degraded _d, recovered _r, recovery tau, e_c [A6]."""

    mu_cd: float
    mu_cr: float
    A_d: float
    A_r: float
    gamma_d_s_m: float
    gamma_r_s_m: float
    k_ad: float
    k_sd: float
    k_ar: float
    k_sr: float
    tau_m_J: float
    cleaning_creepage: float = math.inf


@kernel_inlined
def creepage_of(sliding_m_s, speed_m_s):
    """Magnitude of creepage, sliding over speed."""
    return abs(sliding_m_s) / max(abs(speed_m_s), SPEED_FLOOR_M_S)


# what `law_for_contaminant` takes from its arguments; it copies every other field from the law
_OF_CONTAMINANT = {
    "mu_cd": "mu_cd",
    "mu_cr": "mu_cr",
    "tau_m_J": "cleaning_share * law.tau_m_J",
}
# A kernel (mu_cd, mu_cr, cleaning_share, law) -> Law: the law with the friction of the contaminant
# under a wheel. Only `cleaning_share` of the work cleans [A6]; it is 1 where `curves` applies [A6].
law_for_contaminant = constructor(
    Law,
    "mu_cd, mu_cr, cleaning_share, law",
    (_OF_CONTAMINANT.get(name, f"law.{name}") for name in Law._fields),
)


@kernel_inlined
def cleaning_share(sliding_m_s, speed_m_s, cleaning_creepage):
    """Share of the work that cleans, at a magnitude of sliding, and its slope to the sliding in s/m [A6]."""
    speed, fades = max(abs(speed_m_s), STILL_M_S), cleaning_creepage < 1.0
    least = cleaning_creepage * speed if fades else math.inf
    room = (1.0 - cleaning_creepage) * speed if fades else 1.0
    x = min(max(sliding_m_s - least, 0.0) / room, 1.0)
    return 1.0 - x * x * (3.0 - 2.0 * x), -6.0 * x * (1.0 - x) / room


@kernel_inlined
def curves(sliding_m_s, speed_m_s, load_N, eps1, law):
    """What a contact can give at |sliding|: (f_d, f_r, slope_d_s_m, slope_r_s_m, k, slope_k_s_m).

    For one wheel with 0 < load_N and sliding, `law` from `law_for_contaminant`, eps1 of a `patch.Patch`; slopes are
    derivatives to sliding at constant speed and load, k is that of [A5], by [A6].
    """
    speed = max(abs(speed_m_s), SPEED_FLOOR_M_S)
    sliding = abs(sliding_m_s)
    creepage = sliding / speed
    eps_unit = eps1 * math.exp(math.log(load_N) / -3.0)
    f_d, ds_d, de_d = polach.curve(  # [A4]
        sliding, creepage, eps_unit, law.mu_cd, law.A_d, law.gamma_d_s_m, law.k_ad, law.k_sd
    )
    f_r, ds_r, de_r = polach.curve(
        sliding, creepage, eps_unit, law.mu_cr, law.A_r, law.gamma_r_s_m, law.k_ar, law.k_sr
    )
    share, share_slope = cleaning_share(sliding, speed_m_s, law.cleaning_creepage)
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
    """What lies between its degraded and its recovered value, by lambda [A1]."""
    return (1.0 - lambda_) * degraded + lambda_ * recovered


@kernel_inlined
def f_and_lambda(f_d, f_r, slope_d, slope_r, k, slope_k, lagging, of_work):
    """(f, lambda_0, df/ds, dlambda_0/ds) of [A5], from what `curves` gives; of the work done at once.

    Where recovery lags (`lagging` lambda, else NO_MEMORY) and of_work > 0, of the work that f does at this lambda [A7].
    """
    if lagging >= 0.0 and of_work > 0.0:
        f, rise = between(f_d, f_r, lagging), between(slope_d, slope_r, lagging)
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
    """How fast lambda follows lambda_0 [A7], in 1/s; finite at standstill for a power up to 1."""
    return (
        MIDDLE_SPEED_M_S / length_m * math.pow(max(speed_m_s, 0.0) / MIDDLE_SPEED_M_S, 1.0 - power)
    )


@kernel
def lambert_w0(x):
    """Principal branch of Lambert's function: w exp(w) = x, w >= -1, to 1e-14; -1 for x < -1/e. Bounded iterations."""
    if x <= 0.0:
        p2 = 2.0 * math.e * ((x + INVERSE_E) + INVERSE_E_REST)
        return max(math.e * x * _shrink(math.sqrt(max(p2, 0.0))), -1.0)
    if x == math.inf:
        return x
    L = math.log1p(x)
    w = L * (1.0 - math.log1p(L) / (2.0 + L))  # Winitzki, within 2 %: two steps are enough
    for _ in range(2):
        w = _refined(w, math.log(x / w))
    return w


@kernel_inlined
def _shrink(p):
    """exp(-1 - W0(x)) for x in -1/e .. 0, given p = sqrt(2 (1 + e x)): W0 = e x times it.

    A rational function that meets the exact one at 13 Chebyshev nodes, within 7e-17 of it.
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
    """A better w of w exp(w) = x, of fourth order; source: Fritsch, Shafer and Crowley 1973."""
    z = log_x_over_w - w
    q = 2.0 * (1.0 + w) * (1.0 + w + 2.0 / 3.0 * z)
    return w + w * z * (q - z) / ((1.0 + w) * (q - 2.0 * z))


@kernel_inlined
def recovery(f_d, f_r, k):
    """The pair (f, lambda) of [A5] and [A2]; without energy (k = 0) exactly (f_d, 0).

    Also for f_r < f_d (sliding that spoils the contact), and for any large k. For f_d = 0 there is
    no work to begin with: f stays 0 up to k f_r = 1, beyond it the positive root is given.
    """
    k = min(k, LARGEST)
    most = k * f_r
    least = k * f_d
    if most <= SMALLEST and least <= SMALLEST:
        return f_d, 0.0
    D = f_r - f_d
    drive = k * D
    if D <= 0.0:
        f = min(f_r + lambert_w0(-drive * math.exp(-most)) / k, f_d)  # [A5], a sum of positives
        return f, -math.expm1(-k * f)
    if least == 0.0 and most <= 1.0:
        return 0.0, 0.0
    fall = math.exp(1.0 - most)
    p2 = 2.0 - 2.0 * drive * fall
    if p2 < 0.02:  # near the branch point the argument has lost what most and least still know
        rise = math.expm1(1.0 - most)
        p2 = -2.0 * (rise + (most - 1.0 - least) * (1.0 + rise))
    shrink = fall * _shrink(math.sqrt(max(p2, 0.0)))  # exp(-y)
    y = most - drive * shrink  # y = k f = tau W_sp [A5]
    if y > FEW_DIGITS:
        done = 1.0 - shrink
    else:  # few digits of y are left: one step of Newton on y = least + drive (1 - exp(-y))
        done = -math.expm1(-y)
        steep = 1.0 - drive * (1.0 - done)
        if steep > 1e-9:
            done += (1.0 - done) * (least + drive * done - y) / steep
    lambda_ = min(max(done, 0.0), 1.0)
    return min(f_d + D * lambda_, f_r), lambda_  # [A1]


@kernel
def wheel_adhesion(sliding_m_s, speed_m_s, load_N, patch, law):
    """Adhesion of one wheel between its degraded and its recovered limit: (f, f_d, f_r, lambda_, W_sp_J_m, slope_s_m).

    sliding_m_s of either sign, speed_m_s of the vehicle, load_N on one wheel, a `patch.Patch`, a `Law`. f is signed
    like the sliding (the contact force is f load_N), all else are magnitudes. slope_s_m is df/dsliding at constant
    speed and load, negative where adhesion falls. Without load all is 0.
    """
    if load_N <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    load, sliding = min(load_N, LARGEST), min(abs(sliding_m_s), LARGEST)
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
