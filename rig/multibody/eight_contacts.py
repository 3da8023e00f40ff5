"""Creep forces of all contacts of the coach: eight simultaneously, in the vector lanes of a core.

`wheel_rail_forces` writes the sliding and the load of the contacts of all wheels into the lanes of
one array, in which each quantity is a row. One loop then computes the creep forces of the first
eight, with recovery or Polach's, by `contact.vector_law`. `contact.creep_force` computes the rest
one by one: contacts outside the domain of `vector_law`, a ninth contact (a flange that touches) and
the other models.
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion, creep_force, vector_law
from rollerrig.rig.contact.patch import Patch

TOGETHER = 8  # contacts that one loop computes
LANES = 32
# Rows of the array; each name is the place of the first lane of its row.
(
    # input: sliding along and across m/s, spin 1/s, speed of the rail's surface m/s, load N
    SX,
    SY,
    SPIN,
    SURFACE,
    LOAD,
    # input: the fields of `Patch`, and friction
    A1,
    B1,
    C11,
    C22,
    C23,
    C33,
    SLIM,
    MU_CD,
    MU_CR,
    # result: forces along and across N, moment N m, 1 if the loop could compute them
    FX,
    FY,
    MZ,
    INSIDE,
    # stored for `wheel_rail_forces`: speed of approach m/s, cosine and sine of the tangent along,
    # arm of the roller m
    APPROACH,
    COS,
    SIN,
    ARM,
    _ROWS,
) = range(0, 23 * LANES, LANES)
SIZE = _ROWS


@kernel_inlined
def put(w, lane, patch):
    """Write the patch of a contact into its lane."""
    w[A1 + lane] = patch.a1
    w[B1 + lane] = patch.b1
    w[SLIM + lane] = patch.slim
    w[C11 + lane] = patch.c11
    w[C22 + lane] = patch.c22
    w[C23 + lane] = patch.c23
    w[C33 + lane] = patch.c33


@kernel_inlined
def contact(w, j, patches, law):
    """Return the arguments of the models for lane j.

    They are (xi, eta, phi_1_m, sliding_m_s, load_N, patch, law).
    """
    sx = w[SX + j]
    sy = w[SY + j]
    surface = w[SURFACE + j]
    per_speed = 1.0 / max(abs(surface), adhesion.SPEED_FLOOR_M_S)
    sliding = math.sqrt(sx * sx + sy * sy)
    patch = Patch(
        w[A1 + j],
        w[B1 + j],
        w[C11 + j],
        patches.shear_Pa,
        0.0,  # k_h and eps1: not needed here
        0.0,
        w[C22 + j],
        w[C23 + j],
        w[C33 + j],
        patches.model,
        patches.cells,
        w[SLIM + j],
    )
    share = adhesion.cleaning_share(sliding, surface, law)[0]
    xi = sx * per_speed
    eta = sy * per_speed
    phi_1_m = w[SPIN + j] * per_speed
    return (
        creep_force.limited(xi),
        creep_force.limited(eta),
        creep_force.limited(phi_1_m),
        sliding,
        w[LOAD + j],
        patch,
        adhesion.law_for_contaminant(w[MU_CD + j], w[MU_CR + j], share, law),
    )


@kernel
def degraded(w, patches, law):
    """Compute the creep forces with recovery of the first lanes."""
    for j in range(TOGETHER):
        xi, eta, phi_1_m, sliding, N, patch, law_here = contact(w, j, patches, law)
        w[FX + j], w[FY + j], w[MZ + j], w[INSIDE + j] = vector_law.recovering_force(
            xi, eta, phi_1_m, sliding, N, patch, law_here
        )


@kernel
def polach(w, patches, law):
    """Compute Polach's creep forces of the first lanes."""
    for j in range(TOGETHER):
        xi, eta, phi_1_m, sliding, N, patch, law_here = contact(w, j, patches, law)
        w[FX + j], w[FY + j], w[MZ + j], w[INSIDE + j] = vector_law.polach_force(
            xi, eta, phi_1_m, sliding, N, patch, law_here
        )


@kernel
def forces(w, count, patches, law):
    """Compute the creep forces of the first `count` lanes by the model of `patch.Patches`."""
    computed = 0
    if patches.model == creep_force.DEGRADED:
        degraded(w, patches, law)
        computed = TOGETHER
    elif patches.model == creep_force.POLACH:
        polach(w, patches, law)
        computed = TOGETHER
    for j in range(count):
        if j >= computed or w[INSIDE + j] == 0.0:
            xi, eta, phi_1_m, sliding, N, patch, law_here = contact(w, j, patches, law)
            w[FX + j], w[FY + j], w[MZ + j] = creep_force.creep_force(
                patches.model, xi, eta, phi_1_m, sliding, N, patch, law_here
            )
