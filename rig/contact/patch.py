"""The contact patch under a wheel, for any load: size, stiffness and creep coefficients.

A cone on a rail or roller has one patch (`patch_for`). Where profiles touch, curvatures change with
every millimetre of lateral shift, and the numbers of Hertz and Kalker change with them. Up to
powers of the sum of both curvatures, these numbers depend only on the ratio lateral / rolling
curvature. So one table over the logarithm of that ratio serves all contacts of the coach in 3D
(`tabulate`, `at`).

[T1] a1, b1 proportional to (A + B)^(-1/3), k_h to (A + B)^(-1/2); the c_ij not at all

Source: `hertz`, `kalker`. The table is linear between nodes: within 1e-4 of the exact values where
Kalker's table has no kink. Ratios outside 1e-3 .. 1e3 count as these limits.
"""

import math
from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled.kernel import kernel_inlined, uncompiled
from rollerrig.rig.contact import hertz, kalker, polach, polach_spin
from rollerrig.rig.contact.creep_force import DEGRADED

_NODES = 513
_REACH = math.log(1e3)  # largest logarithm of the curvature ratio in the table
# a patch is computed once for a run, in less time than a kernel takes to compile
_eps_per_creepage = uncompiled(polach.eps_per_creepage)
_slimness = uncompiled(polach_spin.slimness)
# columns of the table
_A1, _B1, _K_H, _C11, _C22, _C23, _C33, _SLIM = range(8)
_COLUMNS = 8


class Patch(NamedTuple):
    """A contact patch of a given wheel, roller and material, for any load N.

    The semi-axes are a = a1 N^(1/3) along and b = b1 N^(1/3) across the rolling direction. Kalker's
    coefficients c11 to c33 are constant because a/b is.
    """

    a1: float  # m N^(-1/3)
    b1: float  # m N^(-1/3)
    c11: float
    shear_Pa: float
    k_h_N_m32: float  # Hertz' stiffness
    eps1: float  # N^(1/3): mu eps / |e| = eps1 N^(-1/3) [P2 of `polach`]
    c22: float
    c23: float
    c33: float
    # tangential model, of `creep_force.MODELS`; None: the degraded law without spin. Then kernels
    # contain, and compile, no other model
    model: int | None
    cells: int  # strips of FASTSIM's grid, and cells in each strip
    slim: float  # `polach_spin.slimness`


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
    """Return the constants of a patch; an infinite roller is a rail.

    Raises ValueError for values out of range.
    """
    given = {
        "wheel_radius_m": wheel_radius_m,
        "roller_radius_m": roller_radius_m,
        "lateral_radius_m": lateral_radius_m,
        "young_Pa": young_Pa,
        "shear_Pa": shear_Pa,
    }
    for name, value in given.items():
        wrongly_infinite = math.isinf(value) and name != "roller_radius_m"
        if not value > 0.0 or wrongly_infinite:
            raise ValueError(
                f"contact patch: {name} = {value!r}; must be positive and finite (only "
                "roller_radius_m may be inf, a rail); correct the contact parameters"
            )
    if not 0.0 <= poisson <= 0.5:
        raise ValueError(
            f"contact patch: poisson = {poisson!r}; must be 0 .. 0.5 (steel 0.3); correct the "
            "contact parameters"
        )

    A, B = hertz.curvatures(wheel_radius_m, roller_radius_m, lateral_radius_m)
    a1, b1, k_h, c11, c22, c23, c33, slim = _of_curvatures(A, B, young_Pa, poisson)
    return Patch(
        a1=a1,
        b1=b1,
        c11=c11,
        shear_Pa=shear_Pa,
        k_h_N_m32=k_h,
        eps1=_eps_per_creepage(a1, b1, c11, shear_Pa, 1.0),
        c22=c22,
        c23=c23,
        c33=c33,
        model=None if model == DEGRADED else model,
        cells=cells,
        slim=slim,
    )


def _of_curvatures(
    A_1_m: float, B_1_m: float, young_Pa: float, poisson: float
) -> tuple[float, ...]:
    """Return the numbers of Hertz and Kalker for half curvatures along and across.

    They are (a1, b1, k_h, c11, c22, c23, c33, slim), named as in `Patch`.
    """
    a1, b1, _, _ = hertz.semi_axes(A_1_m, B_1_m, 1.0, young_Pa, poisson)
    k_h = hertz.stiffness(A_1_m, B_1_m, young_Pa, poisson)
    return a1, b1, k_h, *kalker.coefficients(a1 / b1, poisson), _slimness(a1 / b1)


class Patches(NamedTuple):
    """A table of patches of one material over log(B / A), for curvatures of sum A + B = 1 1/m."""

    nodes_per_log: float
    shear_Pa: float
    model: int
    cells: int
    rows: np.ndarray  # (nodes, 8): a1, b1, k_h, c11, c22, c23, c33, slim


def tabulate(
    young_Pa: float, shear_Pa: float, poisson: float, model: int = 0, cells: int = 10
) -> Patches:
    """Return the table of a material; `model` and `cells` choose the tangential model (`Patch`)."""
    rows = np.empty((_NODES, _COLUMNS))
    for i, log in enumerate(np.linspace(-_REACH, _REACH, _NODES)):
        A = 1.0 / (1.0 + math.exp(log))
        rows[i] = _of_curvatures(A, 1.0 - A, young_Pa, poisson)
    return Patches((_NODES - 1) / (2.0 * _REACH), shear_Pa, model, cells, rows)


@kernel_inlined
def at(rolling_1_m, lateral_1_m, patches):
    """Return the `Patch` of a contact from the table of its material [T1].

    `rolling_1_m` and `lateral_1_m` are the sums of both bodies' curvatures, `patches` a `Patches`.
    """
    place = (math.log(lateral_1_m / rolling_1_m) + _REACH) * patches.nodes_per_log
    i = min(max(int(place), 0), _NODES - 2)
    part = min(max(place - i, 0.0), 1.0)

    # the sum A + B of Hertz' half curvatures scales lengths and stiffness
    half = 0.5 * (rolling_1_m + lateral_1_m)
    root = math.sqrt(half)
    shrink = 1.0 / math.exp(math.log(half) / 3.0)

    rows = patches.rows
    a1 = (rows[i, _A1] + (rows[i + 1, _A1] - rows[i, _A1]) * part) * shrink
    b1 = (rows[i, _B1] + (rows[i + 1, _B1] - rows[i, _B1]) * part) * shrink
    k_h = (rows[i, _K_H] + (rows[i + 1, _K_H] - rows[i, _K_H]) * part) / root
    c11 = rows[i, _C11] + (rows[i + 1, _C11] - rows[i, _C11]) * part
    eps1 = polach.eps_per_creepage(a1, b1, c11, patches.shear_Pa, 1.0)
    c22 = rows[i, _C22] + (rows[i + 1, _C22] - rows[i, _C22]) * part
    c23 = rows[i, _C23] + (rows[i + 1, _C23] - rows[i, _C23]) * part
    c33 = rows[i, _C33] + (rows[i + 1, _C33] - rows[i, _C33]) * part
    slim = rows[i, _SLIM] + (rows[i + 1, _SLIM] - rows[i, _SLIM]) * part
    return Patch(
        a1,
        b1,
        c11,
        patches.shear_Pa,
        k_h,
        eps1,
        c22,
        c23,
        c33,
        patches.model,
        patches.cells,
        slim,
    )
