"""The coach as bodies, degrees of freedom and links: constant arrays that the time loop reads.

Degrees of freedom, declared and derived. With separate axleboxes and links there would be 23 rigid
bodies (car 1, bogies 2, wheelsets 4, axleboxes 8, links 8), that is 138. A revolute joint between
axlebox and wheelset takes 5 from each of 8 axleboxes (-40) and leaves its pitch. The link is rigid
with its axlebox (-48). Its trailing arm is long compared with the play of the primary spring, so
both turn in pitch with the bogie frame (-8). This leaves 138 - 40 - 48 - 8 = 42 = 7 bodies (car,
two bogies, four wheelsets) of 6. The masses and the roll and yaw inertias of axleboxes and links
belong to the wheelset, their pitch inertia to the frame. (The paper counts 40, which cannot be
derived from the joints that it names.)

[C1] a link's elongation d = c . q over six coordinates, three of either body; a force f pulls them
     with c f: springs, dampers, bump-stops, traction rods and anti-roll bars are all such rows
[C2] preload of vertical links: the weight that rests on them, so that q = 0 is the equilibrium
[C3] axle height z_0 at which the contacts of a wheelset carry its share of the weight
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import COACH_AXLES, GRAVITY_M_S2
from rollerrig.rig.contact import patch as patch_table
from rollerrig.rig.contact import profiles
from rollerrig.rig.multibody import wheel_rail_forces
from rollerrig.rig.multibody.coordinates import (
    BODIES,
    BOGIES,
    CAR,
    COORDINATES,
    FIRST_WHEELSET,
    PER_BODY,
    PITCH,
    ROLL,
    WHEELSETS,
    YAW,
    X,
    Y,
    Z,
)

Section = Mapping[str, Any]
Place = tuple[float, float, float]

WHEELS = 2 * COACH_AXLES
# force in N that a damper without a limit never reaches
_NO_LIMIT_N = 1e9


class Links(NamedTuple):
    """Rows of [C1]: `at` (n, 6) coordinates; `row` (n, 12) six factors, then columns of `links`."""

    at: np.ndarray
    row: np.ndarray


class Coach(NamedTuple):
    """All constants of the coach."""

    inertia: np.ndarray  # (42,) kg, kg m2, by coordinate
    weight_N: np.ndarray  # (42,) by coordinate
    mass_kg: float
    springs: Links  # linear: stiffness and preload alone
    curves: Links  # nonlinear: dampers, bump-stops, traction rods
    axle_height_m: float  # z_0 of [C3]
    wheel: profiles.Wheel
    rail: profiles.Rail
    patches: patch_table.Patches
    contact_damping_N_s_m: float
    roller_m: float  # radius of the rollers, inf on a rail
    bogie_of: np.ndarray  # (4,) the bogie of each wheelset


class _Joint(NamedTuple):
    """Two bodies and the place of the link on each, from its centre of mass."""

    a: int
    at_a: Place
    b: int
    at_b: Place


class _Row(NamedTuple):
    """One link: its direction, its joint and its values."""

    axis: int
    joint: _Joint
    stiffness: float = 0.0
    preload: float = 0.0
    damping: float = 0.0
    damping_max: float = 1.0
    gap: float = math.inf
    stop: float = 0.0


def build(
    sections: Mapping[str, Section],
    roller_m: float = math.inf,
    model: int = 0,
    cells: int = 10,
) -> Coach:
    """Return the coach of the checked sections `vehicle`, `contact` and `multibody`.

    roller_m is the radius of the rollers, inf on a rail; `model` and `cells` as in `patch.Patch`.
    Raises ConfigError or ValueError for profiles that cannot be used.
    """
    vehicle = sections["vehicle"]
    multibody = sections["multibody"]
    contact = sections["contact"]

    wheel = profiles.wheel_named(
        multibody["wheel_profile"],
        vehicle["wheel_radius_m"],
        0.5 * multibody["running_circles_m"],
        multibody["profile_smoothing_m"],
    )
    rail = profiles.rail_named(
        multibody["rail_profile"],
        multibody["laying"],
        multibody["gauge_m"],
        multibody["profile_smoothing_m"],
    )
    patches = patch_table.tabulate(
        contact["young_Pa"], contact["shear_Pa"], contact["poisson"], model, cells
    )

    mass = masses(vehicle)
    inertia = np.zeros(COORDINATES)
    weight = np.zeros(COORDINATES)
    for body in range(BODIES):
        first = PER_BODY * body
        inertia[first : first + ROLL] = mass[body]
        inertia[first + ROLL : first + PER_BODY] = _rotary_inertia(body, vehicle, multibody)
        weight[first + Z] = GRAVITY_M_S2 * mass[body]

    total_kg = float(mass.sum())
    axle_height_m = wheel_rail_forces.axle_height(
        total_kg * GRAVITY_M_S2 / WHEELS, wheel, rail, patches, roller_m
    )
    return Coach(
        inertia=inertia,
        weight_N=weight,
        mass_kg=total_kg,
        springs=_links(_springs(vehicle, multibody, mass)),
        curves=_links(_curves(vehicle, multibody)),
        axle_height_m=axle_height_m,
        wheel=wheel,
        rail=rail,
        patches=patches,
        contact_damping_N_s_m=multibody["contact_damping_N_s_m"],
        roller_m=roller_m,
        bogie_of=np.array([_bogie_of(wheelset) for wheelset in WHEELSETS]),
    )


def masses(vehicle: Section) -> np.ndarray:
    """Return the masses in kg of car, bogies and wheelsets, shape (7,)."""
    bogie = vehicle["bogie_mass_kg"]
    wheelset = vehicle["wheelset_mass_kg"]
    car = vehicle["mass_kg"] - 2.0 * bogie - 4.0 * wheelset
    return np.array([car, bogie, bogie, wheelset, wheelset, wheelset, wheelset])


def _bogie_of(wheelset: int) -> int:
    """Return the body number of the bogie of a wheelset."""
    return BOGIES[(wheelset - FIRST_WHEELSET) // 2]


def _rotary_inertia(body: int, vehicle: Section, m: Section) -> tuple[float, float, float]:
    """Return the inertias in kg m2 of a body in roll, pitch and yaw; `m` is [multibody]."""
    if body == CAR:
        return m["body_inertia_x_kgm2"], m["body_inertia_y_kgm2"], m["body_inertia_z_kgm2"]
    if body in BOGIES:
        # axleboxes and links of two wheelsets pitch with the frame
        pitch = 4.0 * (m["axlebox_inertia_y_kgm2"] + m["link_inertia_y_kgm2"])
        return (
            m["bogie_inertia_x_kgm2"],
            m["bogie_inertia_y_kgm2"] + pitch,
            m["bogie_inertia_z_kgm2"],
        )
    # two axleboxes and two links at the ends of the axle
    arm = 2.0 * (m["axlebox_mass_kg"] + m["link_mass_kg"]) * m["primary_half_width_m"] ** 2
    roll = 2.0 * (m["axlebox_inertia_x_kgm2"] + m["link_inertia_x_kgm2"])
    yaw = 2.0 * (m["axlebox_inertia_z_kgm2"] + m["link_inertia_z_kgm2"])
    return (
        m["wheelset_inertia_x_kgm2"] + arm + roll,
        vehicle["wheelset_inertia_kgm2"],
        m["wheelset_inertia_z_kgm2"] + arm + yaw,
    )


def places(vehicle: Section) -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal x in m and the height in m above the rail of the seven bodies."""
    half = 0.5 * vehicle["bogie_distance_m"]
    base = 0.5 * vehicle["bogie_wheelbase_m"]
    x = np.array([0.0, half, -half, half + base, half - base, -half + base, -half - base])
    body_m = vehicle["body_height_m"]
    bogie_m = vehicle["bogie_height_m"]
    axle_m = vehicle["wheel_radius_m"]
    height = np.array([body_m, bogie_m, bogie_m, axle_m, axle_m, axle_m, axle_m])
    return x, height


def _springs(vehicle: Section, m: Section, mass: np.ndarray) -> list[_Row]:
    """Return the linear links; `m` is the section [multibody]."""
    x, height = places(vehicle)
    rows = []
    on_secondary_N = mass[CAR] * GRAVITY_M_S2 / 4.0  # [C2]
    on_primary_N = (mass[CAR] / 2.0 + mass[1]) * GRAVITY_M_S2 / 4.0
    for wheelset in WHEELSETS:
        bogie = _bogie_of(wheelset)
        for side in (1.0, -1.0):
            y = side * m["primary_half_width_m"]
            up = height[wheelset] - height[bogie]
            joint = _Joint(bogie, (x[wheelset] - x[bogie], y, up), wheelset, (0.0, y, 0.0))
            rows += [
                _Row(X, joint, stiffness=m["primary_x_N_m"]),
                _Row(Y, joint, stiffness=m["primary_y_N_m"]),
                _Row(Z, joint, stiffness=m["primary_z_N_m"], preload=on_primary_N),
                _Row(ROLL, joint, stiffness=m["primary_roll_Nm_rad"]),
            ]
    for bogie in BOGIES:
        for side in (1.0, -1.0):
            y = side * m["secondary_half_width_m"]
            joint = _secondary(bogie, y, m["secondary_height_m"], vehicle)
            rows += [
                _Row(X, joint, stiffness=m["secondary_x_N_m"]),
                _Row(Y, joint, stiffness=m["secondary_y_N_m"]),
                _Row(Z, joint, stiffness=m["secondary_z_N_m"], preload=on_secondary_N),
            ]
        anti_roll_bar = _secondary(bogie, 0.0, 0.0, vehicle)
        rows.append(_Row(ROLL, anti_roll_bar, stiffness=m["anti_roll_bar_Nm_rad"]))
    return rows


def _curves(vehicle: Section, m: Section) -> list[_Row]:
    """Return the nonlinear links; `m` is the section [multibody]."""
    x, _ = places(vehicle)
    rows = []
    for wheelset in WHEELSETS:
        bogie = _bogie_of(wheelset)
        for side in (1.0, -1.0):
            y = side * m["primary_half_width_m"]
            primary_damper = _Row(
                Z,
                _Joint(bogie, (x[wheelset] - x[bogie], y, 0.0), wheelset, (0.0, y, 0.0)),
                damping=m["primary_damper_N_s_m"],
                damping_max=m["primary_damper_max_N"],
            )
            rows.append(primary_damper)
    for bogie in BOGIES:
        for side in (1.0, -1.0):
            vertical = _Row(
                Z,
                _secondary(
                    bogie, side * m["secondary_half_width_m"], m["secondary_height_m"], vehicle
                ),
                damping=m["secondary_damper_N_s_m"],
                damping_max=m["secondary_damper_max_N"],
                gap=m["vertical_stop_gap_m"],
                stop=m["vertical_stop_N_m"],
            )
            yaw_damper = _Row(
                X,
                _secondary(
                    bogie, side * m["yaw_damper_half_width_m"], m["yaw_damper_height_m"], vehicle
                ),
                damping=m["yaw_damper_N_s_m"],
                damping_max=m["yaw_damper_max_N"],
            )
            rows += [vertical, yaw_damper]
        lateral = _Row(
            Y,
            _secondary(bogie, 0.0, m["lateral_damper_height_m"], vehicle),
            damping=m["lateral_damper_N_s_m"],
            damping_max=m["lateral_damper_max_N"],
            gap=m["lateral_stop_gap_m"],
            stop=m["lateral_stop_N_m"],
        )
        traction_rod = _Row(
            X,
            _secondary(bogie, 0.0, vehicle["pivot_height_m"], vehicle),
            stiffness=m["traction_rod_N_m"],
            damping=m["traction_rod_damping_N_s_m"],
            damping_max=_NO_LIMIT_N,
            gap=m["traction_rod_stop_gap_m"],
            stop=m["traction_rod_stop_N_m"],
        )
        rows += [lateral, traction_rod]
    return rows


def _secondary(bogie: int, y: float, level_m: float, vehicle: Section) -> _Joint:
    """Return the joint of car and bogie above the bogie's middle, level_m above the rail."""
    x, height = places(vehicle)
    on_car = (x[bogie], y, level_m - height[CAR])
    on_bogie = (0.0, y, level_m - height[bogie])
    return _Joint(CAR, on_car, bogie, on_bogie)


def _links(rows: list[_Row]) -> Links:
    """Return the links as arrays [C1]."""
    at = np.zeros((len(rows), 6), dtype=np.int64)
    factors = np.zeros((len(rows), 6))
    for i, row in enumerate(rows):
        joint = row.joint
        ends = ((0, joint.a, joint.at_a, 1.0), (3, joint.b, joint.at_b, -1.0))
        for first, body, place, sign in ends:
            for k, (coordinate, factor) in enumerate(_levers(row.axis, place)):
                at[i, first + k] = PER_BODY * body + coordinate
                factors[i, first + k] = sign * factor
    values = [
        (row.stiffness, row.preload, row.damping, row.damping_max, row.gap, row.stop)
        for row in rows
    ]
    return Links(at, np.column_stack((factors, np.array(values))))


def _levers(axis: int, place: Place) -> tuple[tuple[int, float], ...]:
    """Return coordinates and factors that move a point of a turning body along an axis."""
    x, y, z = place
    if axis == X:
        return (X, 1.0), (PITCH, z), (YAW, -y)
    if axis == Y:
        return (Y, 1.0), (YAW, x), (ROLL, -z)
    if axis == Z:
        return (Z, 1.0), (ROLL, y), (PITCH, -x)
    # in roll the place has no effect; the factors 0 fill the row
    return (ROLL, 1.0), (PITCH, 0.0), (YAW, 0.0)
