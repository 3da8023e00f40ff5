"""Degraded adhesion: a contaminated contact that cleans itself by the work of sliding.

Between wheel and rail lies a contaminant (water, leaves, oil) that sliding destroys. Without any
work done the contact follows a degraded creep curve f_d, fully cleaned a recovered one f_r; both
are Polach's, with their own friction. The specific work W_sp done on each metre of rail moves the
contact from one to the other; and since the work depends on the adhesion itself, f is the root of
an equation, which Lambert's function W0 gives in closed form: a bounded cost at every step.

[A1] f = (1 - lambda) f_d + lambda f_r                                      paper eq. 9
[A2] lambda = 1 - exp(-tau W_sp)                                            paper eq. 10
[A3] W_sp = f N |e|, in J/m, for one wheel                                  paper eq. 8
[A4] f_d, f_r: `polach` with (mu_cd, A_d, gamma_d), (mu_cr, A_r, gamma_r)   paper eqs. 11 to 13
[A5] with D = f_r - f_d and k = tau N |e|:  f = f_r - D exp(-k f), paper eq. 15, solved by
     f = f_r + W0(-k D exp(-k f_r)) / k

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937; mu_cs of its section 4 is read as mu_cr.
Limits: longitudinal creepage only; no memory along the rail; below SPEED_FLOOR_M_S of vehicle speed
creepage is sliding over that floor. Doubt: a locked wheel (e = 1) recovers; the model says so.
"""

import math
from typing import NamedTuple

from rollerrig.rig.contact import hertz, kalker, polach, polach_spin
from rollerrig.rig.kernel import kernel, kernel_inlined

SPEED_FLOOR_M_S = 0.1
LARGEST = 1e30  # sliding, load and k beyond it count as it, so that infinity makes no NaN
SMALLEST = 1e-290  # energy exponents k f below it count as 0, before they lose digits
INVERSE_E, INVERSE_E_REST = 0.36787944117144233, -1.2428753672788363e-17  # 1/e in two doubles
FEW_DIGITS = 0.02  # energy exponents k f below it have lost digits in a difference, above it none of 12


class Patch(NamedTuple):
    """A contact patch of a given wheel, roller and material, for any load N.

    Semi-axes a = a1 N^(1/3) along and b = b1 N^(1/3) across the rolling direction, a1 and b1 in
    m N^(-1/3); c11 to c33 are Kalker's, constant as a/b is; mu eps / |e| = eps1 N^(-1/3) [P2].
    `model` and `cells` choose the tangential model (`creep_force.MODELS`) and FASTSIM's grid; `slim`
    is `polach_spin.slimness`.
    """

    a1: float
    b1: float
    c11: float
    shear_Pa: float
    k_h_N_m32: float
    eps1: float
    c22: float
    c23: float
    c33: float
    model: int
    cells: int
    slim: float


class Law(NamedTuple):
    """Parameters of the adhesion law (paper Table 4): degraded _d, recovered _r, recovery tau."""

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


def patch_for(
    wheel_radius_m: float,
    roller_radius_m: float,
    lateral_radius_m: float,
    young_Pa: float,
    shear_Pa: float,
    poisson: float,
    model: int = 0,
    cells: int = 10,
) -> Patch:
    """The constants of a contact patch; roller_radius_m = inf is a rail.

    Raises ValueError for a radius or modulus that is not positive, or Poisson's ratio outside
    0 .. 0.5.
    """
    given = {
        "wheel_radius_m": wheel_radius_m, "roller_radius_m": roller_radius_m,
        "lateral_radius_m": lateral_radius_m, "young_Pa": young_Pa, "shear_Pa": shear_Pa,
    }
    for name, value in given.items():
        endless = math.isinf(value) and name != "roller_radius_m"
        if not value > 0.0 or endless:
            raise ValueError(
                f"contact patch: {name} = {value!r}; must be positive and finite (only "
                "roller_radius_m may be inf, a rail); correct the contact parameters"
            )
    if not 0.0 <= poisson <= 0.5:
        raise ValueError(
            f"contact patch: poisson = {poisson!r}; must be 0 .. 0.5 (steel 0.3); "
            "correct the contact parameters"
        )
    A, B = hertz.curvatures(wheel_radius_m, roller_radius_m, lateral_radius_m)
    a1, b1, _, _ = hertz.semi_axes(A, B, 1.0, young_Pa, poisson)
    c11, c22, c23, c33 = kalker.coefficients(a1 / b1, poisson)
    return Patch(
        a1, b1, c11, shear_Pa, hertz.stiffness(A, B, young_Pa, poisson),
        polach.eps_per_creepage(a1, b1, c11, shear_Pa, 1.0), c22, c23, c33, model, cells,
        polach_spin.slimness(a1 / b1),
    )


@kernel
def lambert_w0(x):
    """Principal branch of Lambert's function: w exp(w) = x, w >= -1, to 1e-14 for x >= -1/e.

    Below -1/e, where no real value is, it gives the nearest one, -1. Bounded iterations.
    """
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
    above = (1.0 + q * (0.6418430424881612 + q * (7.234738250119583e-3 - q * 4.459593750671883e-7))
             + p * (1.3747358298298924 + q * (0.11803369785050472 + q * 5.000513759881882e-5)))
    below = (1.0 + q * (2.183245538984029 + q * (0.21685242692459342 + q * 7.218824756350326e-4))
             + p * (2.3747358298299095 + q * (0.9751104897662368 + q * 2.1803135892675286e-2)))
    return above / below


@kernel
def _refined(w, log_x_over_w):
    """A better w of w exp(w) = x, of fourth order; source: Fritsch, Shafer and Crowley 1973."""
    z = log_x_over_w - w
    q = 2.0 * (1.0 + w) * (1.0 + w + 2.0 / 3.0 * z)
    return w + w * z * (q - z) / ((1.0 + w) * (q - 2.0 * z))


@kernel
def recover(f_d, f_r, k):
    """The adhesion coefficient between f_d >= 0 and f_r >= 0 for k = tau N |e| >= 0 [A5]."""
    return recovery(f_d, f_r, k)[0]


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
def degraded(sliding_m_s, speed_m_s, load_N, patch, law):
    """Degraded adhesion of one wheel: (f, f_d, f_r, lambda_, W_sp_J_m, slope_s_m).

    sliding_m_s of either sign, speed_m_s of the vehicle, load_N on one wheel, a `Patch`, a `Law`.
    f is signed like the sliding (the contact force is f load_N), all else are magnitudes.
    slope_s_m is df/dsliding at constant speed and load, negative where adhesion falls. Without
    load all is 0.
    """
    if load_N <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    load = min(load_N, LARGEST)
    sliding = min(abs(sliding_m_s), LARGEST)
    speed = max(abs(speed_m_s), SPEED_FLOOR_M_S)
    creepage = sliding / speed
    eps_unit = patch.eps1 * math.exp(math.log(load) / -3.0)
    f_d, ds_d, de_d = polach.curve(  # [A4]
        sliding, creepage, eps_unit, law.mu_cd, law.A_d, law.gamma_d_s_m, law.k_ad, law.k_sd)
    f_r, ds_r, de_r = polach.curve(
        sliding, creepage, eps_unit, law.mu_cr, law.A_r, law.gamma_r_s_m, law.k_ar, law.k_sr)
    k = law.tau_m_J * load * creepage
    f, lambda_ = recovery(f_d, f_r, k)
    # [A1] and [A2], differentiated together
    kept = 1.0 - lambda_
    freed = (f_r - f_d) * kept
    rise = (
        kept * ds_d + lambda_ * ds_r
        + (kept * de_d + lambda_ * de_r + freed * f * law.tau_m_J * load) / speed
    ) / max(1.0 - freed * k, 1e-9)
    return math.copysign(f, sliding_m_s), f_d, f_r, lambda_, f * load * creepage, rise


@kernel
def slope(sliding_m_s, speed_m_s, load_N, patch, law):
    """df/dsliding in s/m, never negative: a damping that an implicit step may rely on."""
    return max(degraded(sliding_m_s, speed_m_s, load_N, patch, law)[5], 0.0)
