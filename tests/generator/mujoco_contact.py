"""Wheel on rail for `mujoco_stops`: Hertz, Kalker, and the paper's adhesion solved by iteration.

One wheel carries half of a wheelset's load. Its adhesion is a mean of a degraded and a recovered
one, each by Polach. The weight depends on the energy that sliding dissipates, and this depends on
the adhesion: an implicit equation.

    f = (1 - lambda) f_d + lambda f_r                                                 [1] (9)
    lambda = 1 - exp(-tau W), W = f N e                                               [2] (10), (8)
    f_d, f_r = 2 mu / pi [k_A eps / (1 + (k_A eps)^2) + atan(k_S eps)]                [3] (11), (12)
    eps = (2/3) C pi a^2 b e / (N mu), C = 3 G c11 / (8 a)                            [4] (14)
    mu = (mu_c / A - mu_c) exp(-gamma s) + mu_c                                       [5] (13)

Sliding s in m/s and creepage e = s / v are positive in braking; N is the load of the wheel in N.
[1] and [2] are iterated from the f of the last step; an iteration shortens the distance to the root
by at least 0.6.

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, its equations in brackets, its Table 4.
"""

import math

import numpy as np
from numba import njit
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

# the adhesion law of Table 4: degraded (D) and recovered (R) curve; gamma in s/m, tau in m/J
MU_CD = 0.06
MU_CR = 0.28
A_D = 0.4
A_R = 0.4
GAMMA_D = 0.2
GAMMA_R = 0.6
K_AD = 0.3
K_SD = 0.1
K_AR = 1.0
K_SR = 0.4
TAU_M_J = 1.9e-4
# steel
YOUNG_PA = 2.1e11
SHEAR_PA = 8.0e10
POISSON = 0.3
# of the gap across the rail
LATERAL_RADIUS_M = 0.3

# Kalker's c11 at Poisson's ratio 0, 0.25, 0.5 (Kalker 1990, Table E3): rows of a/b 0.1 to 1, then
# of b/a 1 to 0.1
_C11_SHORT = np.array(
    [
        [2.51, 3.31, 4.85],
        [2.59, 3.37, 4.81],
        [2.68, 3.44, 4.80],
        [2.78, 3.53, 4.82],
        [2.88, 3.62, 4.83],
        [2.98, 3.72, 4.91],
        [3.09, 3.81, 4.97],
        [3.19, 3.91, 5.05],
        [3.29, 4.01, 5.12],
        [3.40, 4.12, 5.20],
    ]
)
_C11_LONG = np.array(
    [
        [3.40, 4.12, 5.20],
        [3.51, 4.22, 5.30],
        [3.65, 4.36, 5.42],
        [3.82, 4.54, 5.58],
        [4.06, 4.78, 5.80],
        [4.37, 5.10, 6.11],
        [4.84, 5.57, 6.57],
        [5.57, 6.34, 7.34],
        [6.96, 7.78, 8.82],
        [10.70, 11.70, 12.90],
    ]
)


def patch(curvature_1_m: float) -> tuple[float, float]:
    """Return the half axes (a along the rail, b across) in m of the patch under a load of 1 N.

    They grow as the third root of the load (Hertz). `curvature_1_m` is that of the gap along the
    rail in 1/m, which is 1 / wheel radius on a rail; that across is 1 / LATERAL_RADIUS_M.
    """
    across = 1.0 / LATERAL_RADIUS_M

    def ratio(k: float) -> tuple[float, float]:
        """Return the ratio of curvatures of an ellipse with short over long axis k, and E(m).

        The curvature is that on the long axis over that on the short axis.
        """
        m = 1.0 - k * k
        K = ellipk(m)
        E = ellipe(m)
        return (K - E) / (E / (k * k) - K), E

    flat, steep = sorted((curvature_1_m, across))
    if steep > flat * (1.0 + 1e-6):
        k = brentq(lambda k: ratio(k)[0] - flat / steep, 1e-3, 1.0 - 1e-6)
    else:
        k = 1.0 - 1e-6  # a circle
    stiff = YOUNG_PA / (2.0 * (1.0 - POISSON**2))
    # Johnson 1985, equation 4.26, written with the sum of both curvatures
    long = (3.0 * ratio(k)[1] / (math.pi * k * k * stiff * (flat + steep))) ** (1.0 / 3.0)
    if curvature_1_m < across:
        return long, k * long
    return k * long, long


def c11(a_over_b: float) -> float:
    """Return Kalker's coefficient of a patch.

    It is linear in the ratio of the axes (at least 0.1); 1 / c11 is quadratic in Poisson's ratio.
    """
    g = max(min(a_over_b, 1.0 / a_over_b), 0.1)
    table = _C11_SHORT if a_over_b <= 1.0 else _C11_LONG[::-1]
    inverse = [1.0 / np.interp(g, np.arange(1, 11) / 10.0, table[:, k]) for k in range(3)]
    return 1.0 / float(np.polyval(np.polyfit([0.0, 0.25, 0.5], inverse, 2), POISSON))


def stiffness(wheel_radius_m: float, roller_curvature_1_m: float = 0.0) -> float:
    """Return K of eps = K N^(-1/3) e / mu in N^(1/3): [4], where a b grows as N^(2/3)."""
    a, b = patch(1.0 / wheel_radius_m + roller_curvature_1_m)
    return math.pi / 4.0 * SHEAR_PA * a * b * c11(a / b)


@njit(cache=True)
def polach(mu, k_a, k_s, eps_mu):
    """Return [3]; `eps_mu` is eps times mu."""
    eps = eps_mu / mu
    return 2.0 * mu / math.pi * (k_a * eps / (1.0 + (k_a * eps) ** 2) + math.atan(k_s * eps))


@njit(cache=True)
def adhesion(sliding_m_s, speed_m_s, load_N, mu_cd, K, cleaned, f):
    """Return the adhesion of a wheel under load_N, with the sign of the sliding.

    `f` is a first guess of its magnitude. `cleaned` is tau W where earlier energy counts instead of
    that of now; otherwise it is negative.
    """
    s = abs(sliding_m_s)
    e = s / speed_m_s
    if e < 1e-12 or load_N <= 0.0:
        return 0.0
    eps_mu = K * load_N ** (-1.0 / 3.0) * e  # [4]
    mu_d = mu_cd + (mu_cd / A_D - mu_cd) * math.exp(-GAMMA_D * s)  # [5]
    mu_r = MU_CR + (MU_CR / A_R - MU_CR) * math.exp(-GAMMA_R * s)
    f_d = polach(mu_d, K_AD, K_SD, eps_mu)  # [3]
    f_r = polach(mu_r, K_AR, K_SR, eps_mu)
    if cleaned >= 0.0:
        f = f_r - (f_r - f_d) * math.exp(-cleaned)
    else:
        for _ in range(100):
            share = 1.0 - math.exp(-TAU_M_J * f * load_N * e)  # [2]
            before = f
            f = (1.0 - share) * f_d + share * f_r  # [1]
            if abs(f - before) < 1e-10:
                break
    return math.copysign(f, sliding_m_s)
