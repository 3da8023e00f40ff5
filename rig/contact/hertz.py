"""Normal contact of two elastic bodies: the elliptic patch of Hertz, exactly.

Wheel and rail (or roller) touch in one point and curve away from each other as A x^2 + B y^2, with
x along the rolling direction and y across it. Pressed together they flatten into an ellipse whose
shape depends on A/B alone, and whose size grows with the cube root of the load.

[H1] A = (1/r + 1/R) / 2, B = 1 / (2 R_y): wheel radius r, roller radius R (infinite for a rail),
     R_y the relative lateral radius of wheel and rail head
[H2] kappa = minor / major semi-axis, m = 1 - kappa^2, K and E the complete elliptic integrals,
     D = (K - E) / m:    larger / smaller curvature = (K - D) / (kappa^2 D)
[H3] 1/E* = 2 (1 - nu^2) / E for equal materials;  major^3 = 3 N D / (2 pi E* smaller curvature)
[H4] p_0 = 3 N / (2 pi a b);  approach = 3 N K / (2 pi E* major);  N = k_h approach^(3/2)

Source: Hertz 1881 as in Johnson, Contact Mechanics (1985), section 4.2; paper eq. 4. Smooth,
non-conformal surfaces and a half-space: not for worn, conforming profiles.
"""

import math

from rollerrig.rig.compiled.kernel import kernel

AGM_STEPS = 14  # 12 are enough down to kappa = 1e-110
NEWTON_STEPS = 6  # 4 are enough for curvature ratios up to 1e200


@kernel
def curvatures(wheel_radius_m, roller_radius_m, lateral_radius_m):
    """Relative half curvatures (A, B) in 1/m, along and across [H1]; radii positive, that of a rail is infinite."""
    return (0.5 * (1.0 / wheel_radius_m + 1.0 / roller_radius_m), 0.5 / lateral_radius_m)


@kernel
def elliptic_integrals(kappa):
    """Complete elliptic integrals (K, D) for the complementary modulus 0 < kappa <= 1.

    K of the first kind; D = (K - E) / (1 - kappa^2), kept free of cancellation up to kappa = 1 by summing the terms of
    the arithmetic-geometric mean divided by m = 1 - kappa^2. Source: Abramowitz and Stegun 17.6.
    """
    m = (1.0 - kappa) * (1.0 + kappa)
    mean, geometric = 1.0, kappa
    share, weight, total = 1.0, 0.5, 0.5  # share = c_n^2 / m, total = sum of 2^(n-1) c_n^2 / m
    for _ in range(AGM_STEPS):
        mean, geometric = 0.5 * (mean + geometric), math.sqrt(mean * geometric)
        share = share * share * m / (16.0 * mean * mean)
        weight *= 2.0
        total += weight * share
        if weight * share <= 1e-17 * total:
            break
    K = 0.5 * math.pi / mean
    return K, K * total


@kernel
def axis_ratio(curvature_ratio):
    """Minor over major semi-axis for larger over smaller curvature >= 1 [H2], with K and D there.

    Newton's method on the logarithms: the slope lies between -2 and -1.5, so it always converges.
    Ratios above 1e200 count as 1e200: no ellipse is that thin.
    """
    target = math.log(min(curvature_ratio, 1e200))
    kappa = math.exp(-0.6 * target)
    K, D = elliptic_integrals(kappa)
    for _ in range(NEWTON_STEPS):
        square, m = kappa * kappa, (1.0 - kappa) * (1.0 + kappa)
        misfit = math.log((K - D) / D) - 2.0 * math.log(kappa) - target
        # derivatives to m; near a circle the quotient is 0/0, its limit serves
        dK = 0.5 * (K - D) / square
        dD = (0.5 * ((K - D) / square - D)) / m if m > 1e-5 else 0.09375 * math.pi
        slope = -2.0 - 2.0 * square * ((dK - dD) / (K - D) - dD / D)
        step = misfit / slope
        kappa = min(kappa * math.exp(-step), 1.0)
        K, D = elliptic_integrals(kappa)
        if abs(step) < 1e-15:
            break
    return kappa, K, D


@kernel
def semi_axes(A_1_m, B_1_m, load_N, young_Pa, poisson):
    """The patch: (a_m, b_m, peak_pressure_Pa, approach_m) [H3] [H4].

    a along the rolling direction, b across it; A_1_m and B_1_m are the half curvatures of
    `curvatures`. Without load, or without curvature (no ellipse), all four are 0.
    """
    if not (load_N > 0.0 and A_1_m > 0.0 and B_1_m > 0.0):
        return 0.0, 0.0, 0.0, 0.0
    small, large = min(A_1_m, B_1_m), max(A_1_m, B_1_m)
    kappa, K, D = axis_ratio(large / small)
    pliancy = 3.0 * (1.0 - poisson * poisson) / (math.pi * young_Pa)  # 3 / (2 pi E*)
    unit = (pliancy * D / small) ** (1.0 / 3.0)  # major semi-axis under 1 N [H3]
    growth = load_N ** (1.0 / 3.0)
    major, minor = unit * growth, kappa * unit * growth
    pressure = 1.5 / (math.pi * kappa * unit * unit) * growth  # [H4]
    approach = pliancy * K / unit * growth * growth
    if A_1_m <= B_1_m:
        return major, minor, pressure, approach
    return minor, major, pressure, approach


@kernel
def stiffness(A_1_m, B_1_m, young_Pa, poisson):
    """k_h in N m^-1.5 of N = k_h approach^1.5 [H4], paper eq. 4; 0 without curvature."""
    if not (A_1_m > 0.0 and B_1_m > 0.0):
        return 0.0
    small, large = min(A_1_m, B_1_m), max(A_1_m, B_1_m)
    _, K, D = axis_ratio(large / small)
    pliancy = 3.0 * (1.0 - poisson * poisson) / (math.pi * young_Pa)
    return math.sqrt(D / (small * K)) / (pliancy * K)
