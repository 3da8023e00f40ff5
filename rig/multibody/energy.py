"""Energy of the coach, for its balance: what it holds, and what has left it.

Kinetic energy, springs, weight and the elastic contacts hold energy; sliding, brakes, dampers and
resistance take it. Rollers and their motors are the plant's affair: their energy is not counted.
"""

from rollerrig.rig.contact.geometry import GAP, LATERAL, MOST, ROLLING
from rollerrig.rig.kernel import kernel
from rollerrig.rig.multibody import links, patches


@kernel
def held(motion, coach):
    """Energy in J: kinetic, springs and stops, weight, contacts; 0 for a standing, unloaded coach."""
    q, v = motion.q, motion.v
    energy = links.stored(q, coach.springs) + links.stored(q, coach.curves)
    for i in range(42):
        energy += 0.5 * coach.inertia[i] * v[i] * v[i] + coach.weight_N[i] * q[i]
    return energy + pressed(motion, coach)


@kernel
def pressed(motion, coach):
    """Elastic energy in J of all contacts, 2/5 k_h p^(5/2), where the last step saw them."""
    energy = 0.0
    for wheel in range(8):
        for c in range(MOST * wheel, MOST * wheel + int(motion.near[wheel])):
            p = max(-motion.contacts[c, GAP], 0.0)
            patch = patches.at(motion.contacts[c, ROLLING], motion.contacts[c, LATERAL],
                               coach.patches)
            energy += 0.4 * patch.k_h_N_m32 * p * p * p**0.5
    return energy


@kernel
def taken(motion):
    """Energy in J that has left since the start: sliding, brakes, dampers, contacts, resistance."""
    return (motion.sliding_work.sum() + motion.brake_work.sum() + motion.damper_work[0]
            + motion.approach_work[0] + motion.resistance_work[0])
