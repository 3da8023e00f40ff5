"""The coach as bodies, degrees of freedom and links: constant arrays that the time loop reads.

Degrees of freedom, declared and derived: 15 rigid bodies would be 23 with the axleboxes and links apart (car 1, bogies
2, wheelsets 4, axleboxes 8, links 8): 138. A revolute joint between axlebox and wheelset takes 5 from each of 8
axleboxes (-40) and leaves its pitch; the link is rigid with its axlebox (-48), and its trailing arm, long against the
play of the primary spring, makes both turn in pitch with the bogie frame (-8): 138 - 40 - 48 - 8 = 42 = 7 bodies (car,
two bogies, four wheelsets) of 6. The masses, roll and yaw inertias of axleboxes and links are the wheelset's, their
pitch inertia the frame's. (The paper counts 40, which cannot be derived from the joints it names.)

[C1] a link's elongation d = c . q over six coordinates, three of either body; force f pulls them
     with c f: springs, dampers, bump-stops, traction rods and anti-roll bars are all rows of it
[C2] preload of vertical links: the weight that rests on them, so that q = 0 is the equilibrium
[C3] axle height z_0 at which the contacts of a wheelset carry its share of the weight

Coordinates: displacements from the nominal place, small rotations (linear kinematics, no geometric
stiffness of preloaded springs). A wheelset's pitch coordinate is the angle it has turned.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig.contact import patch as patch_table
from rollerrig.rig.contact import profiles
from rollerrig.rig.multibody import wheel_rail_forces

BODIES, COORDINATES = 7, 42
CAR, BOGIES, WHEELSETS = 0, (1, 2), (3, 4, 5, 6)
X, Y, Z, ROLL, PITCH, YAW = range(6)


class Links(NamedTuple):
    """Rows of [C1]: `at` (n, 6) coordinates; `row` (n, 12): six factors, then `links` columns."""

    at: np.ndarray
    row: np.ndarray


class Coach(NamedTuple):
    """All constants of the coach. inertia and weight_N (42,) by coordinate; z_0 in m."""

    inertia: np.ndarray
    weight_N: np.ndarray
    mass_kg: float
    springs: Links  # linear: stiffness and preload alone
    curves: Links  # nonlinear: dampers, stops, traction rods
    axle_height_m: float
    wheel: profiles.Wheel
    rail: profiles.Rail
    patches: patch_table.Patches
    contact_damping_N_s_m: float
    roller_m: float
    bogie_of: np.ndarray


class _Row(NamedTuple):
    """One link: direction, bodies, where it stands on each (from its centre of mass), values."""

    axis: int
    a: int
    at_a: tuple[float, float, float]
    b: int
    at_b: tuple[float, float, float]
    k: float = 0.0
    preload: float = 0.0
    c: float = 0.0
    c_max: float = 1.0
    gap: float = math.inf
    stop: float = 0.0


def build(
    sections: Mapping[str, Mapping[str, Any]],
    roller_m: float = math.inf,
    model: int = 0,
    cells: int = 10,
) -> Coach:
    """The coach of checked sections `vehicle`, `contact` and `multibody`.

    roller_m is the rollers' radius, inf on a rail; `model` and `cells` as in `patch.Patch`.
    Raises ConfigError or ValueError for profiles that cannot be used.
    """
    v, m, c = sections["vehicle"], sections["multibody"], sections["contact"]
    wheel = profiles.wheel_named(
        m["wheel_profile"],
        v["wheel_radius_m"],
        0.5 * m["running_circles_m"],
        m["profile_smoothing_m"],
    )
    rail = profiles.rail_named(
        m["rail_profile"], m["laying"], m["gauge_m"], m["profile_smoothing_m"]
    )
    patches = patch_table.tabulate(c["young_Pa"], c["shear_Pa"], c["poisson"], model, cells)
    mass = masses(v)
    inertia = np.concatenate(
        [[*3 * (mass[body],), *_inertia(body, v, m)] for body in range(BODIES)]
    )
    weight = np.zeros(COORDINATES)
    weight[Z::6] = GRAVITY_M_S2 * mass
    total = float(mass.sum())
    height = wheel_rail_forces.axle_height(
        total * GRAVITY_M_S2 / 8.0, wheel, rail, patches, roller_m
    )
    springs, curves = _springs(v, m, mass), _curves(v, m)
    return Coach(
        inertia,
        weight,
        total,
        _links(springs),
        _links(curves),
        height,
        wheel,
        rail,
        patches,
        m["contact_damping_N_s_m"],
        roller_m,
        np.array((1, 1, 2, 2)),
    )


def masses(v: Mapping[str, Any]) -> np.ndarray:
    """Masses in kg of car, bogies and wheelsets, shape (7,)."""
    bogie, wheelset = v["bogie_mass_kg"], v["wheelset_mass_kg"]
    car = v["mass_kg"] - 2.0 * bogie - 4.0 * wheelset
    return np.array([car, bogie, bogie, wheelset, wheelset, wheelset, wheelset])


def _inertia(body: int, v: Mapping[str, Any], m: Mapping[str, Any]) -> tuple[float, float, float]:
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
    arm = 2.0 * (m["axlebox_mass_kg"] + m["link_mass_kg"]) * m["primary_half_width_m"] ** 2
    return (
        m["wheelset_inertia_x_kgm2"]
        + arm
        + 2.0 * (m["axlebox_inertia_x_kgm2"] + m["link_inertia_x_kgm2"]),
        v["wheelset_inertia_kgm2"],
        m["wheelset_inertia_z_kgm2"]
        + arm
        + 2.0 * (m["axlebox_inertia_z_kgm2"] + m["link_inertia_z_kgm2"]),
    )


def places(v: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Nominal x in m and height in m above the rail of the seven bodies."""
    half, base = 0.5 * v["bogie_distance_m"], 0.5 * v["bogie_wheelbase_m"]
    x = np.array([0.0, half, -half, half + base, half - base, -half + base, -half - base])
    r = v["wheel_radius_m"]
    return x, np.array([v["body_height_m"], *2 * (v["bogie_height_m"],), *4 * (r,)])


def _springs(v: Mapping[str, Any], m: Mapping[str, Any], mass: np.ndarray) -> list[_Row]:
    x, height = places(v)
    rows = []
    on_secondary = mass[CAR] * GRAVITY_M_S2 / 4.0
    on_primary = (mass[CAR] / 2.0 + mass[1]) * GRAVITY_M_S2 / 4.0
    for wheelset in WHEELSETS:
        bogie = 1 + (wheelset - 3) // 2
        for side in (1.0, -1.0):
            y, up = side * m["primary_half_width_m"], height[wheelset] - height[bogie]
            at: Any = (bogie, (x[wheelset] - x[bogie], y, up), wheelset, (0.0, y, 0.0))
            rows += [
                _Row(X, *at, k=m["primary_x_N_m"]),
                _Row(Y, *at, k=m["primary_y_N_m"]),
                _Row(Z, *at, k=m["primary_z_N_m"], preload=on_primary),
                _Row(ROLL, *at, k=m["primary_roll_Nm_rad"]),
            ]
    for bogie in BOGIES:
        for side in (1.0, -1.0):
            at = _secondary(bogie, side * m["secondary_half_width_m"], m["secondary_height_m"], v)
            rows += [
                _Row(X, *at, k=m["secondary_x_N_m"]),
                _Row(Y, *at, k=m["secondary_y_N_m"]),
                _Row(Z, *at, k=m["secondary_z_N_m"], preload=on_secondary),
            ]
        rows.append(_Row(ROLL, *_secondary(bogie, 0.0, 0.0, v), k=m["anti_roll_bar_Nm_rad"]))
    return rows


def _curves(v: Mapping[str, Any], m: Mapping[str, Any]) -> list[_Row]:
    x, _ = places(v)
    rows = []
    for wheelset in WHEELSETS:
        bogie = 1 + (wheelset - 3) // 2
        for side in (1.0, -1.0):
            y = side * m["primary_half_width_m"]
            rows.append(
                _Row(
                    Z,
                    bogie,
                    (x[wheelset] - x[bogie], y, 0.0),
                    wheelset,
                    (0.0, y, 0.0),
                    c=m["primary_damper_N_s_m"],
                    c_max=m["primary_damper_max_N"],
                )
            )
    for bogie in BOGIES:
        for side in (1.0, -1.0):
            at = _secondary(bogie, side * m["secondary_half_width_m"], m["secondary_height_m"], v)
            rows.append(
                _Row(
                    Z,
                    *at,
                    c=m["secondary_damper_N_s_m"],
                    c_max=m["secondary_damper_max_N"],
                    gap=m["vertical_stop_gap_m"],
                    stop=m["vertical_stop_N_m"],
                )
            )
            at = _secondary(bogie, side * m["yaw_damper_half_width_m"], m["yaw_damper_height_m"], v)
            rows.append(_Row(X, *at, c=m["yaw_damper_N_s_m"], c_max=m["yaw_damper_max_N"]))
        at = _secondary(bogie, 0.0, m["lateral_damper_height_m"], v)
        rows.append(
            _Row(
                Y,
                *at,
                c=m["lateral_damper_N_s_m"],
                c_max=m["lateral_damper_max_N"],
                gap=m["lateral_stop_gap_m"],
                stop=m["lateral_stop_N_m"],
            )
        )
        at = _secondary(bogie, 0.0, v["pivot_height_m"], v)
        rows.append(
            _Row(
                X,
                *at,
                k=m["traction_rod_N_m"],
                c=m["traction_rod_damping_N_s_m"],
                c_max=1e9,
                gap=m["traction_rod_stop_gap_m"],
                stop=m["traction_rod_stop_N_m"],
            )
        )
    return rows


def _secondary(bogie: int, y: float, level: float, v: Mapping[str, Any]) -> Any:
    """Car and bogie, and the place over the bogie's middle at a height above the rail, on each."""
    x, height = places(v)
    return (CAR, (x[bogie], y, level - height[CAR]), bogie, (0.0, y, level - height[bogie]))


def _links(rows: list[_Row]) -> Links:
    at, by = np.zeros((len(rows), 6), dtype=np.int64), np.zeros((len(rows), 6))
    for i, row in enumerate(rows):
        for first, body, (rx, ry, rz), sign in (
            (0, row.a, row.at_a, 1.0),
            (3, row.b, row.at_b, -1.0),
        ):
            lever = {  # displacement of a point of a turning body along the link
                X: ((X, 1.0), (PITCH, rz), (YAW, -ry)),
                Y: ((Y, 1.0), (YAW, rx), (ROLL, -rz)),
                Z: ((Z, 1.0), (ROLL, ry), (PITCH, -rx)),
                ROLL: ((ROLL, 1.0), (PITCH, 0.0), (YAW, 0.0)),
            }[row.axis]
            for j, (coordinate, factor) in enumerate(lever):
                at[i, first + j], by[i, first + j] = 6 * body + coordinate, sign * factor
    values = [(row.k, row.preload, row.c, row.c_max, row.gap, row.stop) for row in rows]
    return Links(at, np.column_stack((by, np.array(values))))
