"""The energy of the coach, for its balance: the energy in it, and the energy that has left it.

Kinetic energy, springs, weight and elastic contacts store energy. Sliding, brakes, dampers and
resistance dissipate it. The energy of rollers and their motors is not counted: they belong to the
plant.
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import patch as patches
from rollerrig.rig.contact.geometry import GAP, LATERAL, MOST, ROLLING
from rollerrig.rig.multibody.coach import WHEELS
from rollerrig.rig.multibody.coordinates import COORDINATES
from rollerrig.rig.multibody.links import (
    PRELOAD_N,
    STIFFNESS_N_M,
    STOP_BEND_M,
    STOP_GAP_M,
    STOP_N_M,
    elongation,
)


@kernel
def total_J(motion, coach):
    """Return the energy in the coach plus the energy that has left it, which is constant."""
    return stored_J(motion, coach) + dissipated_J(motion)


@kernel
def stored_J(motion, coach):
    """Return the energy in the coach: kinetic, springs and stops, weight, contacts.

    It is 0 for a coach at rest whose links are not deformed.
    """
    q = motion.q
    v = motion.v
    energy_J = links_J(q, coach.springs) + links_J(q, coach.curves)
    for i in range(COORDINATES):
        energy_J += 0.5 * coach.inertia[i] * v[i] * v[i] + coach.weight_N[i] * q[i]
    return energy_J + contacts_J(motion, coach)


@kernel
def dissipated_J(motion):
    """Return the energy that has left since the start: sliding, brakes, dampers, resistance."""
    return (
        motion.sliding_work.sum()
        + motion.brake_work.sum()
        + motion.damper_work[0]
        + motion.approach_work[0]
        + motion.resistance_work[0]
    )


@kernel
def contacts_J(motion, coach):
    """Return the elastic energy of all contacts of the last step, 2/5 k_h p^(5/2) each."""
    energy_J = 0.0
    for wheel in range(WHEELS):
        first = MOST * wheel
        for c in range(first, first + int(motion.contact_count[wheel])):
            contact = motion.contacts[c]
            patch = patches.at(contact[ROLLING], contact[LATERAL], coach.patches)
            p = max(-contact[GAP], 0.0)
            energy_J += 0.4 * patch.k_h_N_m32 * p * p * p**0.5
    return energy_J


@kernel_inlined
def links_J(q, links):
    """Return the energy of springs and stops, preload included."""
    energy_J = 0.0
    row = links.row
    for i in range(row.shape[0]):
        d = elongation(i, q, links)
        energy_J += 0.5 * row[i, STIFFNESS_N_M] * d * d - row[i, PRELOAD_N] * d
        e = abs(d) - row[i, STOP_GAP_M]
        if row[i, STOP_N_M] > 0.0 and e > 0.0:
            energy_J += row[i, STOP_N_M] * e * e * (0.5 + e / (3.0 * STOP_BEND_M))
    return energy_J
