"""Creep forces of all contacts of the coach, side by side: eight at once in the vector lanes of a core.

`wheel_rail_forces` writes what the contacts of all wheels do into the lanes of one array, a row a quantity; one loop
then computes the creep forces of the first eight, degraded or Polach's, by `contact.vector_law`. What lies outside its
domain, a ninth contact (a flange that touches) and the other models go by `contact.creep_force`, one by one.
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion, creep_force, vector_law
from rollerrig.rig.contact.patch import Patch

ABREAST, LANES = 8, 32
# sliding along and across m/s, spin 1/s, speed of the rail's surface m/s, load N; `Patch` and friction;
# what comes of them: forces along and across N, moment N m, and whether the loop could tell
(
    SX,
    SY,
    SPIN,
    SURFACE,
    LOAD,
    A1,
    B1,
    C11,
    C22,
    C23,
    C33,
    SLIM,
    MU_CD,
    MU_CR,
    FX,
    FY,
    MZ,
    INSIDE,
    # what is only kept: speed of approach m/s, cosine and sine of the tangent along, arm of the roller m
    APPROACH,
    COS,
    SIN,
    ARM,
    _ROWS,
) = range(0, 23 * LANES, LANES)
SIZE = _ROWS


@kernel_inlined
def put(w, lane, patch):
    """Write a contact's patch into its lane."""
    w[A1 + lane], w[B1 + lane], w[SLIM + lane] = patch.a1, patch.b1, patch.slim
    w[C11 + lane], w[C22 + lane], w[C23 + lane], w[C33 + lane] = (
        patch.c11,
        patch.c22,
        patch.c23,
        patch.c33,
    )


@kernel_inlined
def contact(w, j, patches, law):
    """What the models want to know of a lane: (xi, eta, phi_1_m, sliding_m_s, load_N, patch, law)."""
    sx, sy, surface = w[SX + j], w[SY + j], w[SURFACE + j]
    per_speed, s = 1.0 / max(abs(surface), adhesion.SPEED_FLOOR_M_S), math.sqrt(sx * sx + sy * sy)
    patch = Patch(
        w[A1 + j],
        w[B1 + j],
        w[C11 + j],
        patches.shear_Pa,
        0.0,
        0.0,
        w[C22 + j],
        w[C23 + j],
        w[C33 + j],
        patches.model,
        patches.cells,
        w[SLIM + j],
    )
    share = adhesion.cleaning_share(s, surface, law.cleaning_creepage)[0]
    xi, eta, phi_1_m = sx * per_speed, sy * per_speed, w[SPIN + j] * per_speed
    return (
        creep_force.limited(xi),
        creep_force.limited(eta),
        creep_force.limited(phi_1_m),
        s,
        w[LOAD + j],
        patch,
        adhesion.law_for_contaminant(w[MU_CD + j], w[MU_CR + j], share, law),
    )


@kernel
def degraded(w, patches, law):
    """Creep forces with recovery of the first lanes."""
    for j in range(ABREAST):
        xi, eta, phi_1_m, s, N, patch, here = contact(w, j, patches, law)
        w[FX + j], w[FY + j], w[MZ + j], w[INSIDE + j] = vector_law.recovering_force(
            xi, eta, phi_1_m, s, N, patch, here
        )


@kernel
def polach(w, patches, law):
    """Polach's creep forces of the first lanes."""
    for j in range(ABREAST):
        xi, eta, phi_1_m, s, N, patch, here = contact(w, j, patches, law)
        w[FX + j], w[FY + j], w[MZ + j], w[INSIDE + j] = vector_law.polach_force(
            xi, eta, phi_1_m, s, N, patch, here
        )


@kernel
def forces(w, count, patches, law):
    """Creep forces of the first `count` lanes by the model of `patches` (`patch.Patches`)."""
    done = 0
    if patches.model == creep_force.DEGRADED:
        degraded(w, patches, law)
        done = ABREAST
    elif patches.model == creep_force.POLACH:
        polach(w, patches, law)
        done = ABREAST
    for j in range(count):
        if j >= done or w[INSIDE + j] == 0.0:
            xi, eta, phi_1_m, s, N, patch, here = contact(w, j, patches, law)
            w[FX + j], w[FY + j], w[MZ + j] = creep_force.creep_force(
                patches.model, xi, eta, phi_1_m, s, N, patch, here
            )
