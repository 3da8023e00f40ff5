"""The contact patch under a wheel: Hertz' semi-axes and stiffness and Kalker's coefficients, for any load.

A cone on a rail or roller has one patch (`patch_for`). Where profiles touch, curvatures change with every
millimetre of shift, and Hertz' and Kalker's numbers with them; they depend on the ratio lateral /
rolling curvature alone, up to powers of the sum, so one table over the logarithm of that ratio
serves all contacts of the coach in 3D (`tabulate`, `at`).

[T1] a1, b1 proportional to (A + B)^(-1/3), k_h to (A + B)^(-1/2); the c_ij not at all

Source: `hertz`, `kalker`. The table is linear between nodes: within 1e-4 of the exact values where
Kalker's own table has no kink. Ratios beyond 1e-3 .. 1e3 count as these.
"""

import math
from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import hertz, kalker, polach, polach_spin

_NODES, _REACH = 513, math.log(1e3)


class Patch(NamedTuple):
    """A contact patch of a given wheel, roller and material, for any load N.

    Semi-axes a = a1 N^(1/3) along and b = b1 N^(1/3) across the rolling direction, a1 and b1 in m N^(-1/3); c11 to c33
    are Kalker's, constant as a/b is; mu eps / |e| = eps1 N^(-1/3) [P2]. `model` and `cells` choose the tangential model
    (`creep_force.MODELS`) and FASTSIM's grid; `slim` is `polach_spin.slimness`.
    """

    a1: float
    b1: float
    c11: float
    shear_Pa: float
    k_h_N_m32: float
    eps1: float
    c22: float
    c23: float
    c33: float
    model: int
    cells: int
    slim: float


def patch_for(
    wheel_radius_m: float,
    roller_radius_m: float,
    lateral_radius_m: float,
    young_Pa: float,
    shear_Pa: float,
    poisson: float,
    model: int = 0,
    cells: int = 10,
) -> Patch:
    """The constants of a patch, on a rail for an infinite roller. Raises ValueError for what lies out of range."""
    given = {
        "wheel_radius_m": wheel_radius_m,
        "roller_radius_m": roller_radius_m,
        "lateral_radius_m": lateral_radius_m,
        "young_Pa": young_Pa,
        "shear_Pa": shear_Pa,
    }
    for name, value in given.items():
        endless = math.isinf(value) and name != "roller_radius_m"
        if not value > 0.0 or endless:
            raise ValueError(
                f"contact patch: {name} = {value!r}; must be positive and finite (only roller_radius_m "
                "may be inf, a rail); correct the contact parameters"
            )
    if not 0.0 <= poisson <= 0.5:
        raise ValueError(
            f"contact patch: poisson = {poisson!r}; must be 0 .. 0.5 (steel 0.3); correct the contact "
            "parameters"
        )
    A, B = hertz.curvatures(wheel_radius_m, roller_radius_m, lateral_radius_m)
    a1, b1, _, _ = hertz.semi_axes(A, B, 1.0, young_Pa, poisson)
    c11, c22, c23, c33 = kalker.coefficients(a1 / b1, poisson)
    return Patch(
        a1,
        b1,
        c11,
        shear_Pa,
        hertz.stiffness(A, B, young_Pa, poisson),
        polach.eps_per_creepage(a1, b1, c11, shear_Pa, 1.0),
        c22,
        c23,
        c33,
        model,
        cells,
        polach_spin.slimness(a1 / b1),
    )


class Patches(NamedTuple):
    """Rows over log(B / A), (nodes, 8): a1, b1, k_h for A + B = 1 1/m, c11, c22, c23, c33, slim."""

    nodes_per_log: float
    shear_Pa: float
    model: int
    cells: int
    rows: np.ndarray


def tabulate(
    young_Pa: float, shear_Pa: float, poisson: float, model: int = 0, cells: int = 10
) -> Patches:
    """The table of a material; `model` and `cells` choose the tangential model (`Patch`)."""
    rows = np.empty((_NODES, 8))
    for i, log in enumerate(np.linspace(-_REACH, _REACH, _NODES)):
        A = 1.0 / (1.0 + math.exp(log))
        a1, b1, _, _ = hertz.semi_axes(A, 1.0 - A, 1.0, young_Pa, poisson)
        rows[i] = (
            a1,
            b1,
            hertz.stiffness(A, 1.0 - A, young_Pa, poisson),
            *kalker.coefficients(a1 / b1, poisson),
            polach_spin.slimness(a1 / b1),
        )
    return Patches((_NODES - 1) / (2.0 * _REACH), shear_Pa, model, cells, rows)


@kernel_inlined
def at(rolling_1_m, lateral_1_m, patches):
    """The `Patch` of a contact, from the sums of both bodies' curvatures [T1]."""
    place = (math.log(lateral_1_m / rolling_1_m) + _REACH) * patches.nodes_per_log
    i = min(max(int(place), 0), _NODES - 2)
    part = min(max(place - i, 0.0), 1.0)
    rows = patches.rows
    half = 0.5 * (rolling_1_m + lateral_1_m)
    root = math.sqrt(half)
    shrink = 1.0 / math.exp(math.log(half) / 3.0)
    a1 = (rows[i, 0] + (rows[i + 1, 0] - rows[i, 0]) * part) * shrink
    b1 = (rows[i, 1] + (rows[i + 1, 1] - rows[i, 1]) * part) * shrink
    c11 = rows[i, 3] + (rows[i + 1, 3] - rows[i, 3]) * part
    return Patch(
        a1,
        b1,
        c11,
        patches.shear_Pa,
        (rows[i, 2] + (rows[i + 1, 2] - rows[i, 2]) * part) / root,
        polach.eps_per_creepage(a1, b1, c11, patches.shear_Pa, 1.0),
        rows[i, 4] + (rows[i + 1, 4] - rows[i, 4]) * part,
        rows[i, 5] + (rows[i + 1, 5] - rows[i, 5]) * part,
        rows[i, 6] + (rows[i + 1, 6] - rows[i, 6]) * part,
        patches.model,
        patches.cells,
        rows[i, 7] + (rows[i + 1, 7] - rows[i, 7]) * part,
    )
