"""Rail that the leading wheels clean for the following ones, for rigs in their lanes.

The mechanism `rail_cleaning` is part of the packaged low adhesion, so most stops have it. It needs
the work of each contact after each tick. Here this work and the friction that follows from it are
computed in the lanes, by the formulas of `mechanisms.applied` and `mechanisms.friction`. Results
agree with these to 1e-9. Other mechanisms of friction need the state of the rig (`is_alone`).
"""

from rollerrig.rig import wheelset
from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import vector_secant as law
from rollerrig.rig.contact.adhesion import SPEED_FLOOR_M_S
from rollerrig.rig.lanes import layout as row
from rollerrig.rig.lanes import step
from rollerrig.rig.mechanisms.applied import PLACE
from rollerrig.rig.mechanisms.mechanism import FRICTION
from rollerrig.rig.mechanisms.table import IN_PLANT
from rollerrig.rig.params import Params

# places in `Effects.values` of the sizes of all other mechanisms of friction
_OTHERS = [
    PLACE[key]
    for mechanism in IN_PLANT
    if mechanism.acts_on == FRICTION and mechanism.name != "rail_cleaning"
    for key in mechanism.coefficients
]


def is_alone(params: Params) -> bool:
    """Return whether rail cleaning is the only thing that changes the friction in a stop."""
    acts = params.effects.on_friction and params.friction.start.size == 0
    return acts and not params.effects.values[_OTHERS].any()


@kernel
def write_energy(w, lanes):
    """Write the specific work of one wheel [A3] in so many lanes, from their present state."""
    for j in range(lanes):
        roller_m_s = w[row.ROLLER_M + j] * w[row.ROLLER + j]
        surface = w[row.V + j] if w[row.ON_TRACK + j] != 0.0 else roller_m_s
        sliding = surface - w[row.WHEEL_M + j] * w[row.WHEEL + j]
        load = max(0.0, w[row.STATIC_N + j] - w[row.FELT + j] * w[row.TRANSFER_KG + j])
        w[row.SLIDING + j] = sliding
        w[row.SURFACE + j] = surface
        w[row.LOAD + j] = load

        slope_1_m_s, _, _, inside = law.secant_adhesion(
            max(abs(sliding), wheelset.SMALL_M_S),
            surface,
            0.5 * load,
            w[row.EPS1 + j],
            w[row.DECAY_D + j],
            w[row.DECAY_R + j],
            row.law_of_lane(w, j),
            w[row.SOLVED + j],
        )
        w[row.SLOPE + j] = slope_1_m_s * load
        w[row.INSIDE + j] = inside
    for j in range(lanes):
        if w[row.INSIDE + j] == 0.0 and w[row.MOVING + j] > 0.0:
            w[row.SLOPE + j] = step.exact_slope(w, j)
    for j in range(lanes):
        sliding = w[row.SLIDING + j]
        creepage = abs(sliding) / max(abs(w[row.SURFACE + j]), SPEED_FLOOR_M_S)
        w[row.ENERGY + j] = 0.5 * w[row.SLOPE + j] * abs(sliding) * creepage


@kernel
def clean(w, first, axles):
    """Set the friction under the axles of a rig for the coming tick [X1].

    `first` is its first lane.
    """
    for j in range(first, first + axles):
        # the share of the way to the next axle; 0 for the first one
        w[row.CLEANING + j] = -vector_math.expm1(
            -w[row.V + j] * w[row.TICK + j] / w[row.AHEAD_M + j]
        )
    work_J_m = 0.0
    for j in range(first, first + axles):
        w[row.RAIL_WORK + j] += (work_J_m - w[row.RAIL_WORK + j]) * w[row.CLEANING + j]
        work_J_m += max(w[row.ENERGY + j], 0.0)
    for j in range(first, first + axles):
        cleaned = -vector_math.expm1(-w[row.RAIL_WORK + j] / w[row.CLEANING_J_M + j])
        factor = vector_math.exp(w[row.CLEANING_GAIN + j] * cleaned)
        w[row.MU_CD + j] = w[row.BASE_CD + j] * factor
        alone = w[row.CONTAMINANT_ALONE + j] != 0.0
        w[row.MU_CR + j] = w[row.BASE_CR + j] * (1.0 if alone else factor)
