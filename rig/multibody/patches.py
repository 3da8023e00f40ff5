"""Contact patches over the ratio of their curvatures, tabulated once for the time loop.

Where a wheel touches, its curvatures change with every millimetre of shift, and Hertz' and Kalker's
numbers with them. They depend on the ratio lateral / rolling curvature alone, up to powers of the
sum, so one table over the logarithm of that ratio serves all contacts.

[T1] a1, b1 proportional to (A + B)^(-1/3), k_h to (A + B)^(-1/2); the c_ij not at all

Source: `contact.hertz`, `contact.kalker`. Linear between nodes: within 1e-4 of the exact values
where Kalker's own table has no kink. Ratios beyond 1e-3 .. 1e3 count as these.
"""

import math
from typing import NamedTuple

import numpy as np

from rollerrig.rig.contact import hertz, kalker, polach, polach_spin
from rollerrig.rig.contact.adhesion import Patch
from rollerrig.rig.kernel import kernel_inlined

_NODES, _REACH = 513, math.log(1e3)


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
    """The table of a material; `model` and `cells` choose the tangential model (`adhesion.Patch`)."""
    rows = np.empty((_NODES, 8))
    for i, log in enumerate(np.linspace(-_REACH, _REACH, _NODES)):
        A = 1.0 / (1.0 + math.exp(log))
        a1, b1, _, _ = hertz.semi_axes(A, 1.0 - A, 1.0, young_Pa, poisson)
        rows[i] = (a1, b1, hertz.stiffness(A, 1.0 - A, young_Pa, poisson),
                   *kalker.coefficients(a1 / b1, poisson), polach_spin.slimness(a1 / b1))
    return Patches((_NODES - 1) / (2.0 * _REACH), shear_Pa, model, cells, rows)


@kernel_inlined
def at(rolling_1_m, lateral_1_m, patches):
    """The `adhesion.Patch` of a contact, from the sums of both bodies' curvatures [T1]."""
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
        a1, b1, c11, patches.shear_Pa, (rows[i, 2] + (rows[i + 1, 2] - rows[i, 2]) * part) / root,
        polach.eps_per_creepage(a1, b1, c11, patches.shear_Pa, 1.0),
        rows[i, 4] + (rows[i + 1, 4] - rows[i, 4]) * part, rows[i, 5] + (rows[i + 1, 5] - rows[i, 5]) * part,
        rows[i, 6] + (rows[i + 1, 6] - rows[i, 6]) * part, patches.model, patches.cells,
        rows[i, 7] + (rows[i + 1, 7] - rows[i, 7]) * part)
