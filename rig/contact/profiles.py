"""Wheel and rail profiles: the ORE S1002 wheel, the UIC60 head, and any other from a CSV file.

A profile comes as points or as a formula, is freed of measuring noise and turned into tables that a
kernel reads in a few nanoseconds: a wheel's radius over its lateral coordinate, a rail's point over
the sine of its slope (arcs are exactly linear there). What smoothing and convexity changed is told
in `Told`, never hidden.

[Q1] wheel: slope linear between nodes, radius its integral
[Q2] rail: y = y_i - R (sin b - sin b_i), z = z_i + R (cos b - cos b_i), exact on an arc of radius R
[Q3] point curvature, for Hertz: the change of slope over +-`smoothing_m`, for the patch is as wide
[Q4] a rail head is taken as convex: slopes that rise are pooled (isotonic regression), and told

Coordinates of one side, the other is its mirror image: y outwards (to the field), z up; a wheel's s
is 0 on the nominal running circle and negative towards the flange. Lengths in m.
Source: UIC 510-2 / EN 13715 (S1002, seven analytic sections), UIC 861-3 (UIC60 head: arcs R300,
R80, R13, side 1:20; breakpoints 10.5 and 26.0 mm). S1002 steps by 1.2e-4 mm at s = -35 mm.
"""

from typing import NamedTuple

import numpy as np

SPACING_M = 1e-4  # of a wheel's table
SINES = 2049  # nodes of a rail's table
STEEPEST = 0.9995  # largest sine of a slope that is kept
FLANGE_END_M, FIELD_END_M = -0.0560, 0.0600  # what of a wheel can meet a rail head

# section by section: from s_mm on, polynomial coefficients of z(s), s in mm
_B = (0.0, -3.358537058e-2, 1.565681624e-3, -2.810427944e-5, 5.844240864e-8, -1.562379023e-8,
      5.309217349e-15, -5.957839843e-12, 2.646656573e-13)
_C = (-4.320221063e3, -1.038384026e3, -1.065501873e2, -6.051367875, -2.054332446e-1,
      -4.169739389e-3, -4.687195829e-5, -2.252755540e-7)
# section from s_mm on: kind, then coefficients, or centre s, centre z, radius, side of the arc
S1002 = (
    (-70.0, "arc", (-49.5, 9.519259302, 20.5, 1.0)),
    (-62.764705882, "arc", (-55.0, 16.0, 12.0, 1.0)),
    (-49.662510381, "arc", (-58.558326413, 8.834924130, 20.0, 1.0)),
    (-39.764473993, "polynomial", (-93.576667419, -2.747477419)),
    (-38.426669071, "arc", (-26.210665, 16.446, 13.0, -1.0)),
    (-35.0, "polynomial", _C),
    (-26.0, "polynomial", _B),
    (32.15796, "polynomial", (1.364323640, -0.066666667)),
)


class Wheel(NamedTuple):
    """A wheel's profile in nodes `start_m` + i `spacing_m`; arrays of shape (n,).

    radius_m: rolling radius; slope: its derivative to s; curvature_1_m: convex positive [Q3];
    `centre_m`: from the middle of the wheelset to s = 0.
    """

    start_m: float
    spacing_m: float
    centre_m: float
    radius_m: np.ndarray
    slope: np.ndarray
    curvature_1_m: np.ndarray


class Rail(NamedTuple):
    """A rail head, laid in the track, over sines of slope -STEEPEST .. STEEPEST; shape (SINES,).

    y_m from the middle of the track, z_m below the highest point (<= 0), cosine of the slope,
    curvature_1_m convex positive [Q3].
    """

    sines_per_node: float
    y_m: np.ndarray
    z_m: np.ndarray
    cosine: np.ndarray
    curvature_1_m: np.ndarray


class Told(NamedTuple):
    """What preparing a profile changed: largest shift in m by smoothing and by convexity [Q4]."""

    smoothing_m: float
    moved_by_smoothing_m: float
    moved_by_convexity_m: float


def s1002_height(s_m: np.ndarray) -> np.ndarray:
    """Height in m of S1002 over the nominal radius, at s_m in -0.07 .. 0.06. Source: EN 13715."""
    s = np.asarray(s_m, dtype=float) * 1e3
    starts = np.array([section[0] for section in S1002])
    which = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(S1002) - 1)
    z = np.empty_like(s)
    for i, (_, kind, c) in enumerate(S1002):
        here = s[which == i]
        if kind == "polynomial":
            z[which == i] = np.polynomial.polynomial.polyval(here, c)
        else:
            z[which == i] = c[1] + c[3] * np.sqrt(np.maximum(c[2] ** 2 - (here - c[0]) ** 2, 0.0))
    return z * 1e-3


def uic60_depth(y_m: np.ndarray) -> np.ndarray:
    """Depth in m of the UIC60 head under its top, at |y_m| <= 0.0365, rail upright.

    Arcs R300, R80 and R13 join tangentially at 10.5 and 26.0 mm; the side runs at 1:20 from the
    vertical.
    """
    y = np.abs(np.asarray(y_m, dtype=float)) * 1e3
    ends, radii = (10.5, 26.0), (300.0, 80.0, 13.0)
    depth = np.empty_like(y)
    sine, at, level, begin = 0.0, 0.0, 0.0, 0.0
    for radius, end in zip(radii, (*ends, np.inf), strict=True):
        centre = at - radius * sine
        if np.isinf(end):
            end = centre + radius * 20.0 / np.hypot(20.0, 1.0)
        top = level + radius * np.sqrt(1.0 - sine * sine)
        here = (y >= begin) & (y <= end)
        depth[here] = -(top - radius - level) - radius + (top - level) + level + radius - np.sqrt(
            radius**2 - (y[here] - centre) ** 2) - (radius - np.sqrt(1.0 - sine * sine) * radius)
        sine, at = (end - centre) / radius, end
        level, begin = top - radius * np.sqrt(1.0 - sine * sine), end
    depth[y > begin] = level + 20.0 * (y[y > begin] - begin)
    return depth * 1e-3
