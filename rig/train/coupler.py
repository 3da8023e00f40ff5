"""Couplers: the force between two cars, by the displacement and its rate.

A coupler pulls when the cars are further apart than its slack allows, and pushes when they are
nearer [K1]. Each direction has a gear with a curve of force by displacement, as the makers of draw
gear and buffers print it. A gear gives back only a share of its force when it relaxes [K2]. A
rigid coupler has no displacement, and its force is what keeps both cars at one speed (`motion`).

    [K1] d = x - s_draw, or -x - s_buff; d > 0: the gear acts, with its rate w = dd/dt
    [K2] F = F_load(d) ((1 + q) / 2 + (1 - q) / 2 blend(w / w_0)) + c w, not below 0,
         blend limited to -1 to 1

Symbols: x displacement (positive: stretched), s slack, F_load curve of loading, q share of return,
w_0 speed of the blend, c damping. F is positive in tension.

Source: a curve of loading, a curve of unloading and a transition between them by the relative speed
are the usual form in longitudinal dynamics, as in TrainDy (Cantone 2011): recollection. Doubt:
friction that holds a gear at standstill is replaced by the blend, so a loaded gear creeps to the
middle of both curves within w_0.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, choice, number, read
from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined

# the table of a file in configs/couplers
SECTION = "coupler"
RIGID = "rigid"
GEAR = "gear"
# points of a curve at most; the point (0 m, 0 N) is not among them
MOST_POINTS = 8

ROWS = (
    choice("kind", GEAR, (GEAR, RIGID), "rigid: a bar without displacement"),
    Row("draw_displacement_m", (), 1e-6, 1.0, "draw gear: displacements beyond the slack, rising"),
    Row("draw_force_N", (), 0.0, 1e8, "draw gear: force while loading at each displacement"),
    number("draw_slack_m", 0.0, 0.0, 0.2, "stretched by so much, the draw gear begins to act"),
    number("draw_return", 1.0, 0.0, 1.0, "draw gear: share of the force while unloading"),
    Row("buff_displacement_m", (), 1e-6, 1.0, "buffers: displacements beyond the slack, rising"),
    Row("buff_force_N", (), 0.0, 1e8, "buffers: force of both while loading at each displacement"),
    number("buff_slack_m", 0.0, 0.0, 0.2, "pushed by so much, the buffers begin to act"),
    number("buff_return", 1.0, 0.0, 1.0, "buffers: share of the force while unloading"),
    number("damping_N_s_m", 0.0, 0.0, 1e8, "viscous damping while a gear acts"),
    number("blend_speed_m_s", 0.02, 1e-4, 1.0, "assumption; from unloading to loading"),
)


class Couplers(NamedTuple):
    """The couplers of a train, from the front to the rear; all shapes begin with (couplers,).

    Of two values the first is that of the draw gear, the second that of the buffers.
    """

    rigid: np.ndarray  # 1: a rigid bar
    slack_m: np.ndarray  # (couplers, 2)
    returned: np.ndarray  # (couplers, 2): share of the force while unloading
    curve_m: np.ndarray  # (couplers, 2, MOST_POINTS + 1), the first point is 0
    curve_N: np.ndarray  # likewise
    points: np.ndarray  # int64 (couplers, 2): points that a curve has
    damping_N_s_m: np.ndarray
    blend_m_s: np.ndarray


record_type.register(Couplers)


def check(given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the checked values of one coupler. Raises ConfigError."""
    found = read(ROWS, given, where)
    for gear in ("draw", "buff"):
        places = found[f"{gear}_displacement_m"]
        forces = found[f"{gear}_force_N"]
        if found["kind"] == RIGID:
            if places or forces:
                raise ConfigError(
                    f"{where}: kind = '{RIGID}' with a curve of the {gear} gear; remove the curve, or "
                    f"write kind = '{GEAR}'"
                )
            continue
        if len(places) != len(forces) or not 1 <= len(places) <= MOST_POINTS:
            raise ConfigError(
                f"{where}: {gear}_displacement_m has {len(places)} numbers and {gear}_force_N "
                f"{len(forces)}; allowed are 1 to {MOST_POINTS}, the same number in both"
            )
        if any(np.diff([0.0, *places]) <= 0.0) or any(np.diff([0.0, *forces]) < 0.0):
            raise ConfigError(
                f"{where}: the curve of the {gear} gear must rise from point to point: "
                f"{list(places)} m, {list(forces)} N"
            )
    return found


def build(checked: Sequence[Mapping[str, Any]]) -> Couplers:
    """Return the couplers of a train from the checked values of each."""
    count = len(checked)
    curve_m = np.zeros((count, 2, MOST_POINTS + 1))
    curve_N = np.zeros((count, 2, MOST_POINTS + 1))
    points = np.ones((count, 2), dtype=np.int64)
    slack_m = np.zeros((count, 2))
    returned = np.ones((count, 2))
    for i, one in enumerate(checked):
        for gear, name in enumerate(("draw", "buff")):
            places = one[f"{name}_displacement_m"]
            points[i, gear] = len(places) + 1
            curve_m[i, gear, 1 : len(places) + 1] = places
            curve_N[i, gear, 1 : len(places) + 1] = one[f"{name}_force_N"]
            slack_m[i, gear] = one[f"{name}_slack_m"]
            returned[i, gear] = one[f"{name}_return"]
    return Couplers(
        rigid=np.array([float(one["kind"] == RIGID) for one in checked]),
        slack_m=slack_m,
        returned=returned,
        curve_m=curve_m,
        curve_N=curve_N,
        points=points,
        damping_N_s_m=np.array([one["damping_N_s_m"] for one in checked]),
        blend_m_s=np.array([one["blend_speed_m_s"] for one in checked]),
    )


@kernel_inlined
def loading(displacement_m, places_m, forces_N, points):
    """Return the force in N of a curve at a displacement, and its slope in N/m.

    Behind its last point a curve goes on with its last slope.
    """
    i = 1
    while i < points - 1 and displacement_m > places_m[i]:
        i += 1
    slope = (forces_N[i] - forces_N[i - 1]) / (places_m[i] - places_m[i - 1])
    return forces_N[i - 1] + slope * (displacement_m - places_m[i - 1]), slope


@kernel
def force(displacement_m, rate_m_s, couplers, i):
    """Return the force of coupler i in N (tension positive), and its slopes in N/m and N s/m.

    Parameters
    ----------
    displacement_m, rate_m_s : displacement of the cars, positive where stretched, and its rate
    couplers : `Couplers`
    """
    sign = 1.0 if displacement_m > 0.0 else -1.0
    gear = 0 if displacement_m > 0.0 else 1
    d = sign * displacement_m - couplers.slack_m[i, gear]  # [K1]
    if d <= 0.0:
        return 0.0, 0.0, 0.0
    w = sign * rate_m_s
    load_N, stiffness = loading(
        d, couplers.curve_m[i, gear], couplers.curve_N[i, gear], couplers.points[i, gear]
    )
    q = couplers.returned[i, gear]
    per_speed = 1.0 / couplers.blend_m_s[i]
    blend = min(max(w * per_speed, -1.0), 1.0)
    factor = 0.5 * (1.0 + q) + 0.5 * (1.0 - q) * blend
    damping = couplers.damping_N_s_m[i]
    F = load_N * factor + damping * w  # [K2]
    if F <= 0.0:
        return 0.0, 0.0, 0.0
    if abs(blend) < 1.0:
        damping += load_N * 0.5 * (1.0 - q) * per_speed
    return sign * F, stiffness * factor, damping


@kernel
def stored(displacement_m, couplers, i):
    """Return the elastic energy in J of coupler i: the work of the mean of both curves [K2]."""
    gear = 0 if displacement_m > 0.0 else 1
    d = abs(displacement_m) - couplers.slack_m[i, gear]
    if d <= 0.0 or couplers.rigid[i] != 0.0:
        return 0.0
    places_m = couplers.curve_m[i, gear]
    forces_N = couplers.curve_N[i, gear]
    points = couplers.points[i, gear]
    energy_J = 0.0
    k = 1
    while k < points - 1 and d > places_m[k]:
        energy_J += 0.5 * (forces_N[k] + forces_N[k - 1]) * (places_m[k] - places_m[k - 1])
        k += 1
    last_N = loading(d, places_m, forces_N, points)[0]
    energy_J += 0.5 * (forces_N[k - 1] + last_N) * (d - places_m[k - 1])
    return 0.5 * (1.0 + couplers.returned[i, gear]) * energy_J
