"""Normal contact of two elastic bodies: the elliptic patch of Hertz, exactly.

Wheel and rail (or roller) touch in one point and curve away from each other as A x^2 + B y^2, with
x along the rolling direction and y across it. Under load they flatten into an ellipse. Its shape
depends only on A/B, and its size grows with the cube root of the load.

[H1] A = (1/r + 1/R) / 2, B = 1 / (2 R_y): wheel radius r, roller radius R (infinite for a rail),
     R_y the relative lateral radius of wheel and rail head
[H2] kappa = minor / major semi-axis, m = 1 - kappa^2, K and E the complete elliptic integrals,
     D = (K - E) / m:    larger / smaller curvature = (K - D) / (kappa^2 D)
[H3] 1/E* = 2 (1 - nu^2) / Y for equal materials of Young's modulus Y and Poisson's ratio nu;
     major^3 = 3 N D / (2 pi E* smaller curvature), N the load
[H4] p_0 = 3 N / (2 pi a b);  approach = 3 N K / (2 pi E* major);  N = k_h approach^(3/2)

The curvatures of [H2] and [H3] are A and B. a and b are the semi-axes along x and y.

Source: Hertz 1881 as in Johnson, Contact Mechanics (1985), section 4.2; paper eq. 5. Smooth,
non-conformal surfaces and a half-space: not for worn, conforming profiles.
"""

import math

AGM_STEPS = 14  # 12 are enough down to kappa = 1e-110
NEWTON_STEPS = 6  # 4 are enough for curvature ratios up to 1e200
LARGEST_RATIO = 1e200  # larger ratios of curvatures count as this: no ellipse is that thin


def curvatures(
    wheel_radius_m: float, roller_radius_m: float, lateral_radius_m: float
) -> tuple[float, float]:
    """Return the relative half curvatures (A, B) in 1/m, along and across [H1].

    All radii are positive; that of a rail along the rolling direction is infinite.
    """
    return (0.5 * (1.0 / wheel_radius_m + 1.0 / roller_radius_m), 0.5 / lateral_radius_m)


def elliptic_integrals(kappa: float) -> tuple[float, float]:
    """Return the complete elliptic integrals (K, D) for the complementary modulus 0 < kappa <= 1.

    K is the integral of the first kind. D is (K - E) / m with m = 1 - kappa^2 [H2].

    The arithmetic-geometric mean gives K = pi / (2 a_n) and K - E = K sum 2^(n-1) c_n^2. Near
    kappa = 1 a division of K - E by m would lose digits. Therefore the sum is of c_n^2 / m, which
    follows from c_0^2 = m and c_(n+1) = c_n^2 / (4 a_(n+1)). Source: Abramowitz and Stegun 17.6.
    """
    m = (1.0 - kappa) * (1.0 + kappa)
    # a_n and b_n, the arithmetic and the geometric mean
    arithmetic, geometric = 1.0, kappa
    c_squared_over_m = 1.0  # c_n^2 / m
    weight = 0.5  # 2^(n-1)
    total = 0.5  # sum of 2^(n-1) c_n^2 / m
    for _ in range(AGM_STEPS):
        arithmetic, geometric = 0.5 * (arithmetic + geometric), math.sqrt(arithmetic * geometric)
        c_squared_over_m = (
            c_squared_over_m * c_squared_over_m * m / (16.0 * arithmetic * arithmetic)
        )
        weight *= 2.0
        total += weight * c_squared_over_m
        if weight * c_squared_over_m <= 1e-17 * total:
            break
    K = 0.5 * math.pi / arithmetic
    return K, K * total


def axis_ratio(curvature_ratio: float) -> tuple[float, float, float]:
    """Return (kappa, K, D): minor over major semi-axis [H2], and `elliptic_integrals(kappa)`.

    `curvature_ratio` is the larger over the smaller curvature, at least 1. Newton's method solves
    [H2] for ln kappa. The slope of ln(curvature ratio) over ln kappa lies between -2 and -1.5, so
    the method always converges.
    """
    target = math.log(min(curvature_ratio, LARGEST_RATIO))
    # first estimate: a constant slope of -1 / 0.6, which lies between these limits
    kappa = math.exp(-0.6 * target)
    K, D = elliptic_integrals(kappa)
    for _ in range(NEWTON_STEPS):
        square = kappa * kappa
        m = (1.0 - kappa) * (1.0 + kappa)
        misfit = math.log((K - D) / D) - 2.0 * math.log(kappa) - target

        # derivatives of K and D to m; near a circle dD is 0/0, and its limit 3 pi / 32 is used
        dK = 0.5 * (K - D) / square
        dD = (0.5 * ((K - D) / square - D)) / m if m > 1e-5 else 0.09375 * math.pi
        # derivative of the misfit to ln kappa, with dm / d(ln kappa) = -2 kappa^2
        slope = -2.0 - 2.0 * square * ((dK - dD) / (K - D) - dD / D)

        step = misfit / slope
        kappa = min(kappa * math.exp(-step), 1.0)
        K, D = elliptic_integrals(kappa)
        if abs(step) < 1e-15:
            break
    return kappa, K, D


def semi_axes(
    A_1_m: float, B_1_m: float, load_N: float, young_Pa: float, poisson: float
) -> tuple[float, float, float, float]:
    """Return size, peak pressure and approach of the patch [H3] [H4].

    All four results are 0 unless the load and both curvatures are positive: then there is no
    ellipse. NaN counts as not positive.

    Parameters
    ----------
    A_1_m, B_1_m : half curvatures along and across, from `curvatures`
    load_N : normal load
    young_Pa, poisson : elastic constants of both bodies

    Returns
    -------
    a_m, b_m : semi-axes along and across the rolling direction
    peak_pressure_Pa : p_0
    approach_m : by how much the bodies approach each other
    """
    # not (x > 0.0) instead of x <= 0.0, because it is also true for NaN
    if not (load_N > 0.0 and A_1_m > 0.0 and B_1_m > 0.0):
        return 0.0, 0.0, 0.0, 0.0
    small = min(A_1_m, B_1_m)
    large = max(A_1_m, B_1_m)
    kappa, K, D = axis_ratio(large / small)

    compliance = 3.0 * (1.0 - poisson * poisson) / (math.pi * young_Pa)  # 3 / (2 pi E*)
    # major semi-axis under a load of 1 N [H3]
    major_of_1_N = (compliance * D / small) ** (1.0 / 3.0)
    # the semi-axes and the pressure grow with this factor
    growth = load_N ** (1.0 / 3.0)
    major = major_of_1_N * growth
    minor = kappa * major_of_1_N * growth
    pressure = 1.5 / (math.pi * kappa * major_of_1_N * major_of_1_N) * growth  # [H4]
    approach = compliance * K / major_of_1_N * growth * growth  # [H4]

    # the ellipse is longer where the bodies are less curved
    if A_1_m <= B_1_m:
        return major, minor, pressure, approach
    return minor, major, pressure, approach


def stiffness(A_1_m: float, B_1_m: float, young_Pa: float, poisson: float) -> float:
    """Return k_h in N m^-1.5 of N = k_h approach^1.5 [H4], paper eq. 5; 0 without curvature.

    The arguments are those of `semi_axes`.
    """
    if not (A_1_m > 0.0 and B_1_m > 0.0):
        return 0.0
    small = min(A_1_m, B_1_m)
    large = max(A_1_m, B_1_m)
    _, K, D = axis_ratio(large / small)
    compliance = 3.0 * (1.0 - poisson * poisson) / (math.pi * young_Pa)  # 3 / (2 pi E*)
    return math.sqrt(D / (small * K)) / (compliance * K)
