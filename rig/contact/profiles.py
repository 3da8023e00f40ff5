"""Wheel and rail profiles: the ORE S1002 wheel, the UIC60 head, and any other from a CSV file.

A profile comes as points or as a formula. It is freed of measuring noise and turned into tables
that a kernel reads in a few nanoseconds: a wheel's radius over its lateral coordinate, a rail's
point over the sine of its slope (arcs are exactly linear there). `Changes` reports what smoothing
and convexity changed.

[Q1] wheel: slope linear between nodes, radius its integral
[Q2] rail: y = y_i - R (sin b - sin b_i), z = z_i + R (cos b - cos b_i), exact on an arc of radius R
[Q3] point curvature, for Hertz: the change of slope over +-`smoothing_m`, for the patch is as wide
[Q4] a rail head is taken as convex: slopes that rise are pooled (isotonic regression), and
     `Changes` reports it

Coordinates are those of one side; the other side is its mirror image. y points outwards (to the
field), z up; a wheel's s is 0 on the nominal running circle and negative towards the flange.
Lengths are in m. Source: UIC 510-2 / EN 13715 (S1002, seven analytic sections), UIC 861-3 (UIC60
head: arcs R300, R80, R13, side 1:20; breakpoints 10.5 and 26.0 mm). S1002 steps by 1.2e-4 mm at s =
-35 mm.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.contact import profile_csv

# columns of `Wheel.fine`, of `Wheel.coarse` and of `Rail.nodes`
RADIUS_M, SLOPE, CURVATURE_1_M = range(3)
AT_M, AT_RADIUS_M, AT_SLOPE, AT_COSINE, AT_NORMAL_M = range(5)
Y_M, Z_M, COSINE, RAIL_CURVATURE_1_M = range(4)

SPACING_M = 1e-4  # of a wheel's table
STRIDE = 10  # nodes between those that a search for contacts visits (1 mm)
# nodes of a rail's table: between two of them a joint of arcs is cut short by 0.013 mm at most
SINES = 8193
STEEPEST = 0.9995  # largest sine of a slope in a rail's table
RAIL_STEP_M = 2e-5  # along a rail head, while its table is prepared
# the part of a wheel that can meet a rail head
FLANGE_END_M = -0.0560
FIELD_END_M = 0.0600
GAUGE_DEPTH_M = 0.014  # under the top of the head, where the gauge is measured
TOUCHED_SINE = 0.9  # a wheel touches no steeper part of a head

# polynomial coefficients of z(s) in two sections of S1002, s and z in mm
_B = (
    0.0,
    -3.358537058e-2,
    1.565681624e-3,
    -2.810427944e-5,
    5.844240864e-8,
    -1.562379023e-8,
    5.309217349e-15,
    -5.957839843e-12,
    2.646656573e-13,
)
_C = (
    -4.320221063e3,
    -1.038384026e3,
    -1.065501873e2,
    -6.051367875,
    -2.054332446e-1,
    -4.169739389e-3,
    -4.687195829e-5,
    -2.252755540e-7,
)
# S1002 by sections: first s_mm, kind, and its numbers in mm: coefficients of z(s), or centre s,
# centre z, radius and side of an arc
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
    """A wheel's profile in nodes `start_m` + i `spacing_m`."""

    start_m: float
    spacing_m: float
    centre_m: float  # from the middle of the wheelset to s = 0
    # (n, 3): RADIUS_M, the rolling radius; SLOPE, its derivative to s; CURVATURE_1_M, convex
    # positive [Q3]
    fine: np.ndarray
    # (m, 5), every STRIDE-th node: AT_M from the wheelset's middle, radius, slope, its cosine, and
    # the place where the normal meets the axis
    coarse: np.ndarray


class Rail(NamedTuple):
    """A rail head, laid in the track, over sines of slope -STEEPEST .. STEEPEST."""

    sines_per_node: float
    # (SINES, 4): Y_M from the middle of the track, Z_M below the highest point (<= 0), COSINE of
    # the slope, RAIL_CURVATURE_1_M convex positive [Q3]
    nodes: np.ndarray


class Changes(NamedTuple):
    """What the preparation of a profile changed."""

    smoothing_m: float  # width of the moving mean
    moved_by_smoothing_m: float  # largest shift by smoothing
    moved_by_convexity_m: float  # largest shift by convexity [Q4]


def s1002_height(s_m: np.ndarray) -> np.ndarray:
    """Return the height of S1002 over the nominal radius in m, at s_m in -0.07 .. 0.06.

    Source: EN 13715.
    """
    s = np.asarray(s_m, dtype=float) * 1e3
    starts = np.array([section[0] for section in S1002])
    section_of = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(S1002) - 1)

    z = np.empty_like(s)
    for i, (_, kind, numbers) in enumerate(S1002):
        inside = section_of == i
        here = s[inside]
        if kind == "polynomial":
            z[inside] = np.polynomial.polynomial.polyval(here, numbers)
        else:
            centre_s, centre_z, radius, side = numbers
            square = np.maximum(radius**2 - (here - centre_s) ** 2, 0.0)
            z[inside] = centre_z + side * np.sqrt(square)
    return z * 1e-3


def uic60_depth(y_m: np.ndarray) -> np.ndarray:
    """Return the depth of the UIC60 head under its top in m, at |y_m| <= 0.0365, upright.

    Three tangential arcs are followed by the side 1:20.
    """
    y = np.abs(np.asarray(y_m, dtype=float)) * 1e3
    depth = np.empty_like(y)
    # where an arc begins, its sine of slope and its depth there, in mm
    begin = 0.0
    sine = 0.0
    level = 0.0
    for radius, end in ((300.0, 10.5), (80.0, 26.0), (13.0, np.inf)):
        centre = begin - radius * sine
        centre_depth = level + radius * np.sqrt(1.0 - sine * sine)
        # the last arc ends where it is as steep as the side
        steepest = 20.0 / np.hypot(20.0, 1.0)
        end = min(end, centre + radius * steepest)
        here = (y >= begin) & (y <= end)
        depth[here] = centre_depth - np.sqrt(radius * radius - (y[here] - centre) ** 2)
        begin = end
        sine = (end - centre) / radius
        level = centre_depth - radius * np.sqrt(1.0 - sine * sine)
    side = y > begin
    depth[side] = level + 20.0 * (y[side] - begin)
    return depth * 1e-3


def wheel(
    s_m: np.ndarray,
    z_m: np.ndarray,
    nominal_radius_m: float = 0.445,
    centre_m: float = 0.75,
    smoothing_m: float = 0.0,
    patch_m: float = 0.003,
) -> tuple[Wheel, Changes]:
    """Return the tables of a wheel from points, and the changes by their preparation.

    Parameters
    ----------
    s_m, z_m : points, s rising; z over the nominal radius
    nominal_radius_m : rolling radius at s = 0 where z is 0
    centre_m : from the middle of the wheelset to s = 0
    smoothing_m : width of a moving mean over the slope
    patch_m : half of the width over which curvature is taken [Q3]
    """
    first = max(s_m[0], FLANGE_END_M)
    last = min(s_m[-1], FIELD_END_M)
    count = int((last - first) / SPACING_M) + 1
    nodes = first + SPACING_M * np.arange(count)
    z = np.interp(nodes, s_m, z_m)

    # the radius is the integral of the smoothed slope, so both agree exactly
    slope = _mean(np.gradient(z, SPACING_M), smoothing_m / SPACING_M)
    steps = 0.5 * SPACING_M * (slope[1:] + slope[:-1])  # [Q1]
    height = np.concatenate(([0.0], np.cumsum(steps)))
    height += np.interp(0.0, nodes, z - height)
    curvature = -_mean_change(slope, patch_m / SPACING_M) / SPACING_M / (1.0 + slope**2) ** 1.5
    changes = Changes(smoothing_m, float(np.abs(height - z).max()), 0.0)

    fine = np.column_stack((nominal_radius_m + height, slope, curvature))
    at = centre_m + nodes[::STRIDE]
    radius = fine[::STRIDE, RADIUS_M]
    slope = slope[::STRIDE]
    coarse = np.column_stack(
        (at, radius, slope, 1.0 / np.sqrt(1.0 + slope**2), at + radius * slope)
    )
    return Wheel(float(first), SPACING_M, centre_m, fine, coarse), changes


def rail(
    y_m: np.ndarray,
    z_m: np.ndarray,
    laying: float = 1.0 / 20.0,
    gauge_m: float = 1.435,
    smoothing_m: float = 0.0,
    patch_m: float = 0.003,
) -> tuple[Rail, Changes]:
    """Return the tables of a rail from points of the upright head, and the changes by preparation.

    Parameters
    ----------
    y_m, z_m : points, y rising from the gauge to the field side, z up
    laying : inclination of the head towards the middle of the track
    gauge_m : twice the distance from the middle to the gauge face, 14 mm under the head's top
    smoothing_m : width of a moving mean over the slope
    patch_m : half of the width over which curvature is taken [Q3]
    """
    # the head at equal steps along its surface, and its slope angle
    tilt = np.arctan(laying)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(y_m), np.diff(z_m)))))
    fine = np.linspace(0.0, along[-1], int(along[-1] / RAIL_STEP_M) + 1)
    y0 = np.interp(fine, along, y_m)
    z0 = np.interp(fine, along, z_m)
    angle = np.unwrap(np.arctan2(np.gradient(z0), np.gradient(y0)))
    angle = _mean(angle, smoothing_m / RAIL_STEP_M)

    # the convex curve, inclined, through the given top
    convex = _falling(angle) + tilt  # [Q4]
    step = fine[1] - fine[0]
    y, z = _curve_of_slopes(convex, step)
    y_given = y0 * np.cos(tilt) - z0 * np.sin(tilt)
    z_given = y0 * np.sin(tilt) + z0 * np.cos(tilt)
    top = int(np.argmin(np.abs(convex)))
    y = y + y_given[top] - y[top]
    z = z + z_given[top] - z[top]

    # how far smoothing alone, and all of it, moved the head where a wheel can touch it
    y_smooth, z_smooth = _curve_of_slopes(angle + tilt, step)
    touched = np.abs(np.sin(convex)) < TOUCHED_SINE
    smoothed = np.hypot(
        y_smooth - y_smooth[top] + y[top] - y_given, z_smooth - z_smooth[top] + z[top] - z_given
    )
    moved = np.hypot(y - y_given, z - z_given)
    changes = Changes(
        smoothing_m, float(smoothed[touched].max()), float(np.abs(moved - smoothed)[touched].max())
    )

    # the highest point at z = 0, the gauge face half of the gauge from the middle of the track
    z = z - z.max()
    gauge_side = slice(None, top + 1)
    face = np.interp(-GAUGE_DEPTH_M, z[gauge_side], y[gauge_side])
    return _rail_table(y + 0.5 * gauge_m - face, z, convex, patch_m, step), changes


def _curve_of_slopes(angle: np.ndarray, step_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the curve (y, z) from the origin with these slope angles at equal steps along it."""
    middle = 0.5 * (angle[1:] + angle[:-1])
    return (
        np.concatenate(([0.0], np.cumsum(step_m * np.cos(middle)))),
        np.concatenate(([0.0], np.cumsum(step_m * np.sin(middle)))),
    )


def _rail_table(
    y: np.ndarray, z: np.ndarray, angle: np.ndarray, patch_m: float, step_m: float
) -> Rail:
    """Return the table of a convex head from its points and slope angles at equal steps."""
    # a straight stretch has one slope: bent by 1e-12 rad a step its points keep an order
    falling = np.sin(angle) - 1e-12 * np.arange(angle.size)
    sines = np.linspace(-STEEPEST, STEEPEST, SINES)
    place = np.interp(sines, falling[::-1], np.arange(angle.size)[::-1])
    at = np.arange(angle.size)

    cosine = np.sqrt(1.0 - sines * sines)
    y_nodes = np.interp(place, at, y)
    radius = -np.diff(y_nodes) / np.diff(sines)
    z_nodes = np.concatenate(([0.0], np.cumsum(radius * np.diff(cosine))))  # [Q2]
    z_nodes -= np.interp(0.0, sines, z_nodes)
    curvature = -_mean_change(angle, patch_m / step_m) / step_m
    return Rail(
        (SINES - 1) / (2.0 * STEEPEST),
        np.column_stack((y_nodes, z_nodes, cosine, np.interp(place, at, curvature))),
    )


def _mean(values: np.ndarray, width: float) -> np.ndarray:
    """Return the moving mean over an odd number of nodes, about `width`; narrower at the ends."""
    half = int(0.5 * width)
    if half < 1:
        return values
    total = np.concatenate(([0.0], np.cumsum(values)))
    at = np.arange(values.size)
    reach = np.minimum(np.minimum(at, values.size - 1 - at), half)
    return (total[at + reach + 1] - total[at - reach]) / (2 * reach + 1)


def _mean_change(values: np.ndarray, half_width: float) -> np.ndarray:
    """Return the mean change from node to node over +-half_width nodes [Q3]."""
    half = max(int(half_width), 1)
    at = np.arange(values.size)
    low = np.maximum(at - half, 0)
    high = np.minimum(at + half, values.size - 1)
    return (values[high] - values[low]) / (high - low)


def _falling(values: np.ndarray) -> np.ndarray:
    """Return the nearest falling sequence: neighbours that rise are pooled to their mean [Q4]."""
    if np.all(np.diff(values) <= 0.0):
        return values
    # pools of neighbours: their means, which fall, and their sizes
    means: list[float] = []
    sizes: list[int] = []
    for value in values:
        mean = float(value)
        size = 1
        while means and means[-1] < mean:
            mean = (mean * size + means[-1] * sizes[-1]) / (size + sizes[-1])
            size += sizes.pop()
            means.pop()
        means.append(mean)
        sizes.append(size)
    return np.repeat(means, sizes)


def s1002(nominal_radius_m: float = 0.445, centre_m: float = 0.75) -> Wheel:
    """Return the new ORE S1002 wheel; its running circles are 2 centre_m apart."""
    # from beyond the flange's tip to 60 mm, at the nodes of the table: nothing is interpolated
    s = FLANGE_END_M + SPACING_M * np.arange(round((FIELD_END_M - FLANGE_END_M) / SPACING_M) + 1)
    return wheel(s, s1002_height(s), nominal_radius_m, centre_m)[0]


def uic60(laying: float = 1.0 / 20.0, gauge_m: float = 1.435) -> Rail:
    """Return the new UIC60 rail, laid at an inclination and gauge."""
    y = np.linspace(-0.0365, 0.0365, 20001)
    return rail(y, -uic60_depth(y), laying, gauge_m)[0]


def wheel_named(name: str, nominal_radius_m: float, centre_m: float, smoothing_m: float) -> Wheel:
    """Return the wheel called s1002, or the one in a CSV file. Raises ConfigError."""
    if name == "s1002":
        return s1002(nominal_radius_m, centre_m)
    s, z = profile_csv.read(name, profile_csv.WHEEL)
    return wheel(s, z, nominal_radius_m, centre_m, smoothing_m)[0]


def rail_named(name: str, laying: float, gauge_m: float, smoothing_m: float) -> Rail:
    """Return the rail called uic60, or the one in a CSV file, laid. Raises ConfigError."""
    if name == "uic60":
        return uic60(laying, gauge_m)
    y, z = profile_csv.read(name, profile_csv.RAIL)
    return rail(y, z, laying, gauge_m, smoothing_m)[0]
