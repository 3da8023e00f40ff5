"""Mechanisms of friction: a course is the change of ln mu by one unit of the coefficient."""

import math

from rollerrig.configs.vehicle import MIDDLE_SPEED_M_S
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.mechanisms.mechanism import ALONE, FRICTION, WIDE, number, row_of, saturating


@kernel
def rail_cleaning(cleaned_J_m, energy_J_m):
    """ln mu += gain (1 - exp(-W / energy)), W: work on this metre of rail by the wheels before"""
    return -math.expm1(-cleaned_J_m / energy_J_m)


@kernel
def speed_dependent_friction(speed_m_s, knee_m_s):
    """ln mu += slope knee (1 - exp(-(v - 20 m/s) / knee)), slope (v - 20 m/s) for a wide knee"""
    return saturating(speed_m_s - MIDDLE_SPEED_M_S, knee_m_s)


@kernel
def friction_trend(time_s, scale_s):
    """ln mu += rate time (1 - exp(-t / time)), rate t for a long time"""
    return saturating(time_s, scale_s)


@kernel
def negative_conditioning(slid_m, distance_m):
    """ln mu -= loss (1 - exp(-S / distance)), S: sliding distance of the wheel so far"""
    return math.expm1(-slid_m / distance_m)


@kernel
def contaminated_patch(place_m, start_m, length_m, ramp):
    """ln mu -= depth for start <= place < start + length; over the share ramp of the length, half
    at either end, it rises and falls as sin^2
    """
    if not start_m <= place_m < start_m + length_m:
        return 0.0
    inside_m = min(place_m - start_m, start_m + length_m - place_m)
    edge_m = 0.5 * ramp * length_m
    if inside_m >= edge_m:
        return -1.0
    return -(math.sin(0.5 * math.pi * inside_m / edge_m) ** 2)


@kernel
def sanding(time_s, axle, start_s, duration_s, behind):
    """ln mu += gain for start <= t < start + duration, each run with its own window; behind = 1:
    not under the first wheelset
    """
    on_this_axle = axle > 0 or behind < 0.5
    return 1.0 if start_s <= time_s < start_s + duration_s and on_this_axle else 0.0


@kernel
def dose_share(dose_kg_m, scale_kg_m):
    """ln mu += gain (1 - exp(-D / D_0)), D: sand that the wheel meets on a metre of track"""
    return -math.expm1(-dose_kg_m / scale_kg_m)


@kernel
def film_share(film):
    """ln mu += gain (1 - h), h: film of contaminant under the wheel, of what was prepared"""
    return 1.0 - film


@kernel
def empirical(x, linear, quadratic, centre, scale, period):
    """ln mu += linear z + quadratic z^2, z = (x - centre) / scale; with a period linear cos(2 pi x
    / period) + quadratic sin(2 pi x / period); x = 1 speed m/s, 2 time s, 3 place m, 4 sliding m/s,
    5 load N, 6 energy J/m, 7 disc heat MJ, 8 sliding distance m, 9 wheel angle rad
    """
    if period > 0.0:
        turn = 2.0 * math.pi * x / period
        return linear * math.cos(turn) + quadratic * math.sin(turn)
    z = (x - centre) / scale
    return linear * z + quadratic * z * z


ROWS = tuple(
    row._replace(parameters=(*row.parameters, ALONE))
    for row in (
        row_of(
            FRICTION,
            rail_cleaning,
            (number("gain", 0.0, 1.0, "-"), number("energy_J_m", 1.0, 5000.0, "J/m", 150.0)),
            "leading wheels clean the rail for the following ones",
            "Allotta et al. 2014; form: assumption",
        ),
        row_of(
            FRICTION,
            speed_dependent_friction,
            (
                number("slope_per_m_s", -0.05, 0.05, "s/m"),
                number("knee_m_s", 2.0, WIDE, "m/s", WIDE),
            ),
            "friction depends on the vehicle's speed",
            "Curtius and Kniffler 1950; form: assumption",
        ),
        row_of(
            FRICTION,
            friction_trend,
            (number("rate_1_s", -0.2, 0.2, "1/s"), number("time_s", 0.1, WIDE, "s", WIDE)),
            "friction drifts with time in a stop",
            "assumption",
        ),
        row_of(
            FRICTION,
            negative_conditioning,
            (number("loss", 0.0, 0.9, "-"), number("distance_m", 1.0, 500.0, "m", 30.0)),
            "sliding destroys adhesion",
            "oil paste: Beagley and Pritchard 1975; form: assumption",
        ),
        row_of(
            FRICTION,
            contaminated_patch,
            (
                number("depth", 0.0, 1.0, "-"),
                number("start_m", -100.0, 1e5, "m"),
                number("length_m", 0.0, 1e4, "m"),
                number("ramp", 0.0, 1.0, "-"),
            ),
            "friction depends on the place",
            "assumption",
        ),
        row_of(
            FRICTION,
            sanding,
            (
                number("gain", 0.0, 2.0, "-"),
                number("start_s", 0.0, 1e4, "s"),
                number("duration_s", 0.0, 1e4, "s"),
                number("behind", 0.0, 1.0, "-"),
            ),
            "sand raises friction for a while",
            "assumption",
        ),
    )
)
# the formula that `explain` reports when no mechanism of the table explains the data; it is not a
# cause
EMPIRICAL = row_of(
    FRICTION,
    empirical,
    (
        number("linear", -1e4, 1e4, "-"),
        number("quadratic", -1e4, 1e4, "-"),
        number("covariate", 0.0, 9.0, "-"),
        number("centre", -1e6, 1e6, "of the covariate"),
        number("scale", 1e-6, 1e6, "of the covariate", 1.0),
        number("period", 0.0, 1e4, "of the covariate"),
    ),
    "an empirical term of one covariate",
    "fitted, no physics",
    free=2,
    courses=(),
)
