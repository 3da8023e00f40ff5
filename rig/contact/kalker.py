"""Kalker's linear creep coefficients of an elliptic patch.

At vanishing creepage the whole patch sticks, and the creep force is proportional to creepage and
spin:

    F_x = -G a b c11 xi
    F_y = -G a b (c22 eta + sqrt(a b) c23 phi)
    M_z = G (a b)^1.5 c23 eta - G (a b)^2 c33 phi

Here a and b are the semi-axes of the patch along and across the rolling direction, and G is the
shear modulus. xi, eta and phi are longitudinal creepage, lateral creepage and spin.

Kalker tabulated the four factors over the shape of the patch and Poisson's ratio. This module
interpolates between his rows. Beyond them (slender patches) it follows his asymptotes.

[K1] linear in g = min(a/b, b/a) along a row of one Poisson's ratio
[K2] 1/c quadratic in Poisson's ratio through 0, 1/4 and 1/2
[K3] g < 0.1: c = asymptote(g) [1 + (c(0.1) / asymptote(0.1) - 1) g / 0.1], continuous at g = 0.1
[K4] long patches, s = b/a = 0.1 .. 0.4: c = c' / (1 + k q), with c' of [K1] and [K2] and
     q = (s - s1) (s2 - s) / (s1 s2) between the rows s1 and s2; k = 0.45, 0.52 and 1.2 for c11, c22
     and c23

[K4]: the coefficients of a long patch grow as (b/a)^-n. The chord between two rows is above that
curve by the fraction k q, with k = n (n + 1) / 2. At a/b = 6 this is 14 % of c23. n = 0.57, 0.64
and 1.13 are the slopes between the table's last rows.

Source: Kalker 1967; Three-Dimensional Elastic Bodies in Rolling Contact (1990), Table E3.
c23(a/b = 0.8, nu = 1/4) is 1.25; some codes carry the misprint 1.15.
Limits: c33 for a > b is not verified. The asymptotes are quoted from memory; they meet the ends of
the table within 7 %.
"""

import math

# One row for each shape of the patch, from narrow (a/b = 0.1) to long (b/a = 0.1). In it are three
# quadruples (c11, c22, c23, c33), for the Poisson's ratios 0, 1/4 and 1/2.
# fmt: off
TABLE = (
    ((2.51, 2.51, 0.334, 6.42), (3.31, 2.52, 0.473, 8.28), (4.85, 2.53, 0.731, 11.7)),  # a/b = 0.1
    ((2.59, 2.59, 0.483, 3.46), (3.37, 2.63, 0.603, 4.27), (4.81, 2.66, 0.809, 5.66)),  # a/b = 0.2
    ((2.68, 2.68, 0.607, 2.49), (3.44, 2.75, 0.715, 2.96), (4.8, 2.81, 0.889, 3.72)),  # a/b = 0.3
    ((2.78, 2.78, 0.72, 2.02), (3.53, 2.88, 0.823, 2.32), (4.82, 2.98, 0.977, 2.77)),  # a/b = 0.4
    ((2.88, 2.88, 0.827, 1.74), (3.62, 3.01, 0.929, 1.93), (4.83, 3.14, 1.07, 2.22)),  # a/b = 0.5
    ((2.98, 2.98, 0.93, 1.56), (3.72, 3.14, 1.03, 1.68), (4.91, 3.31, 1.18, 1.86)),  # a/b = 0.6
    ((3.09, 3.09, 1.03, 1.43), (3.81, 3.28, 1.14, 1.5), (4.97, 3.48, 1.29, 1.6)),  # a/b = 0.7
    ((3.19, 3.19, 1.13, 1.34), (3.91, 3.41, 1.25, 1.37), (5.05, 3.65, 1.4, 1.42)),  # a/b = 0.8
    ((3.29, 3.29, 1.23, 1.27), (4.01, 3.54, 1.36, 1.27), (5.12, 3.82, 1.51, 1.27)),  # a/b = 0.9
    ((3.4, 3.4, 1.33, 1.21), (4.12, 3.67, 1.47, 1.19), (5.2, 3.98, 1.63, 1.16)),  # a/b = 1.0
    ((3.51, 3.51, 1.44, 1.16), (4.22, 3.81, 1.59, 1.11), (5.3, 4.16, 1.77, 1.06)),  # b/a = 0.9
    ((3.65, 3.65, 1.58, 1.1), (4.36, 3.99, 1.75, 1.04), (5.42, 4.39, 1.94, 0.954)),  # b/a = 0.8
    ((3.82, 3.82, 1.76, 1.05), (4.54, 4.21, 1.95, 0.965), (5.58, 4.67, 2.18, 0.852)),  # b/a = 0.7
    ((4.06, 4.06, 2.01, 1.01), (4.78, 4.5, 2.23, 0.892), (5.8, 5.04, 2.5, 0.751)),  # b/a = 0.6
    ((4.37, 4.37, 2.35, 0.958), (5.1, 4.9, 2.62, 0.819), (6.11, 5.56, 2.96, 0.65)),  # b/a = 0.5
    ((4.84, 4.84, 2.88, 0.912), (5.57, 5.48, 3.24, 0.747), (6.57, 6.31, 3.7, 0.549)),  # b/a = 0.4
    ((5.57, 5.57, 3.79, 0.868), (6.34, 6.4, 4.32, 0.674), (7.34, 7.51, 5.01, 0.446)),  # b/a = 0.3
    ((6.96, 6.96, 5.72, 0.828), (7.78, 8.14, 6.63, 0.601), (8.82, 9.79, 7.89, 0.341)),  # b/a = 0.2
    ((10.7, 10.7, 12.2, 0.795), (11.7, 12.8, 14.6, 0.526), (12.9, 16.0, 18.0, 0.228)),  # b/a = 0.1
)
# fmt: on
END = 0.1  # smallest g = min(a/b, b/a) of the table
SPACING = 0.1  # change of g from row to row
LAST_ROW = len(TABLE) - 1
SLENDEREST = 1e-6  # smallest g; a more slender patch counts as this one
# k of [K4] for c11, c22 and c23, and the b/a above which the chord is within 1.2 % of the curve
CHORD_C11 = 0.45
CHORD_C22 = 0.52
CHORD_C23 = 1.2
CHORD_END = 0.4
# columns of the coefficients in TABLE, and layers of the Poisson's ratios
_C11, _C22, _C23, _C33 = range(4)
_NU_0, _NU_QUARTER, _NU_HALF = range(3)

# c11, c22, c23 and c33
Coefficients = tuple[float, float, float, float]


def coefficients(a_over_b: float, poisson: float) -> Coefficients:
    """Return Kalker's (c11, c22, c23, c33) of an elliptic patch.

    `a_over_b` is the semi-axis along the rolling direction over the one across it. Values beyond
    1e-6 .. 1e6, and a `poisson` beyond 0 .. 0.5, are replaced by the nearest limit.
    """
    nu = min(max(poisson, 0.0), 0.5)
    ratio = min(max(a_over_b, SLENDEREST), 1.0 / SLENDEREST)
    long_patch = ratio > 1.0
    g = 1.0 / ratio if long_patch else ratio

    # one coordinate over all rows of the table: 0.1 .. 1 is a/b, 1 .. 1.9 is 2 - b/a
    coordinate = max(g, END)
    if long_patch:
        coordinate = 2.0 - coordinate
    # a fractional row; that of the first or last row where the patch is more slender than these
    place = (coordinate - END) / SPACING
    c11, c22, c23, c33 = _interpolated(place, nu)
    if g >= END:
        excess = _chord_excess(g) if long_patch else 0.0
        return (
            c11 / (1.0 + CHORD_C11 * excess),  # [K4], also the next two lines
            c22 / (1.0 + CHORD_C22 * excess),
            c23 / (1.0 + CHORD_C23 * excess),
            c33,
        )

    # more slender than the table: the asymptote at g, corrected by how far table and asymptote
    # differ at the end of the table, with a weight that falls to 0 with g
    end11, end22, end23, end33 = _asymptote(END, long_patch, nu)
    g11, g22, g23, g33 = _asymptote(g, long_patch, nu)
    weight = g / END
    return (
        g11 * (1.0 + (c11 / end11 - 1.0) * weight),  # [K3], also the next three lines
        g22 * (1.0 + (c22 / end22 - 1.0) * weight),
        g23 * (1.0 + (c23 / end23 - 1.0) * weight),
        g33 * (1.0 + (c33 / end33 - 1.0) * weight),
    )


def _chord_excess(slimness: float) -> float:
    """Return q of [K4] for b/a: 0 at the rows of the table, and outside 0.1 .. 0.4."""
    if not END < slimness < CHORD_END:
        return 0.0
    row = int(slimness / SPACING)
    low = row * SPACING
    high = low + SPACING
    return (slimness - low) * (high - slimness) / (low * high)


def _interpolated(place: float, nu: float) -> Coefficients:
    """Return the four coefficients at a fractional row `place` of TABLE and a Poisson's ratio."""
    row = min(max(int(place), 0), LAST_ROW - 1)
    share = place - row
    return (
        _coefficient(row, share, nu, _C11),
        _coefficient(row, share, nu, _C22),
        _coefficient(row, share, nu, _C23),
        _coefficient(row, share, nu, _C33),
    )


def _coefficient(row: int, share: float, nu: float, column: int) -> float:
    """Return the coefficient of a column of TABLE, `share` of the way from `row` to the next."""
    # at the three tabulated Poisson's ratios [K1]
    low = TABLE[row][_NU_0][column] * (1.0 - share) + TABLE[row + 1][_NU_0][column] * share
    mid = (
        TABLE[row][_NU_QUARTER][column] * (1.0 - share)
        + TABLE[row + 1][_NU_QUARTER][column] * share
    )
    top = TABLE[row][_NU_HALF][column] * (1.0 - share) + TABLE[row + 1][_NU_HALF][column] * share
    # Lagrange's parabola through the three inverses [K2]
    return 1.0 / (
        (1.0 - 4.0 * nu) * (1.0 - 2.0 * nu) / low
        + 8.0 * nu * (1.0 - 2.0 * nu) / mid
        + 2.0 * nu * (4.0 * nu - 1.0) / top
    )


def _asymptote(g: float, long_patch: bool, nu: float) -> Coefficients:
    """Return (c11, c22, c23, c33) of a slender patch: Kalker's formulas for g -> 0.

    g is min(a/b, b/a). `long_patch` is true for a > b.
    """
    # abbreviations for terms that the formulas repeat; L is Kalker's Lambda
    L = math.log(16.0 / (g * g))
    s = (1.0 - nu) * L
    tail = 3.0 - math.log(4.0)
    if long_patch:
        return (
            2.0 * math.pi / ((L - 2.0 * nu) * g) * (1.0 + tail / (L - 2.0 * nu)),
            2.0 * math.pi / ((s + 2.0 * nu) * g) * (1.0 + (1.0 - nu) * tail / (s + 2.0 * nu)),
            2.0 * math.pi / (3.0 * g * math.sqrt(g) * (s - 2.0 + 4.0 * nu)),
            0.25 * math.pi * (1.0 - nu * (L - 2.0) / (s - 2.0 + 4.0 * nu)),
        )
    return (
        0.25 * math.pi**2 / (1.0 - nu),
        0.25 * math.pi**2,
        math.pi * math.sqrt(g) / (3.0 * (1.0 - nu)) * (1.0 + nu * (0.5 * L + math.log(4.0) - 5.0)),
        math.pi**2 / (16.0 * (1.0 - nu) * g),
    )
