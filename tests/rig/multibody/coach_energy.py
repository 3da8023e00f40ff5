"""Energy of the coach, for its balance: what it holds, and what has left it.

Kinetic energy, springs, weight and the elastic contacts hold energy; sliding, brakes, dampers and
resistance take it. Rollers and their motors are the plant's affair: their energy is not counted.
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import patch as patches
from rollerrig.rig.contact.geometry import GAP, LATERAL, MOST, ROLLING
from rollerrig.rig.multibody.links import (
    PRELOAD_N,
    STIFFNESS_N_M,
    STOP_BEND_M,
    STOP_GAP_M,
    STOP_N_M,
    elongation,
)


@kernel
def held(motion, coach):
    """Energy in J: kinetic, springs and stops, weight, contacts; 0 for a standing, unloaded coach."""
    q, v = motion.q, motion.v
    energy = stored(q, coach.springs) + stored(q, coach.curves)
    for i in range(42):
        energy += 0.5 * coach.inertia[i] * v[i] * v[i] + coach.weight_N[i] * q[i]
    return energy + pressed(motion, coach)


@kernel
def pressed(motion, coach):
    """Elastic energy in J of all contacts, 2/5 k_h p^(5/2), where the last step saw them."""
    energy = 0.0
    for wheel in range(8):
        for c in range(MOST * wheel, MOST * wheel + int(motion.contact_count[wheel])):
            p = max(-motion.contacts[c, GAP], 0.0)
            patch = patches.at(
                motion.contacts[c, ROLLING], motion.contacts[c, LATERAL], coach.patches
            )
            energy += 0.4 * patch.k_h_N_m32 * p * p * p**0.5
    return energy


@kernel
def taken(motion):
    """Energy in J that has left since the start: sliding, brakes, dampers, contacts, resistance."""
    return (
        motion.sliding_work.sum()
        + motion.brake_work.sum()
        + motion.damper_work[0]
        + motion.approach_work[0]
        + motion.resistance_work[0]
    )


@kernel_inlined
def stored(q, links):
    """Energy in J that springs and stops hold, preload included."""
    energy = 0.0
    row = links.row
    for i in range(row.shape[0]):
        d = elongation(i, q, links)
        energy += 0.5 * row[i, STIFFNESS_N_M] * d * d - row[i, PRELOAD_N] * d
        e = abs(d) - row[i, STOP_GAP_M]
        if row[i, STOP_N_M] > 0.0 and e > 0.0:
            energy += row[i, STOP_N_M] * e * e * (0.5 + e / (3.0 * STOP_BEND_M))
    return energy
