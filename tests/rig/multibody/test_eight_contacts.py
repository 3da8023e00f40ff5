"""Eight contacts that one loop computes, against the models themselves, one contact at a time."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import creep_force
from rollerrig.rig.contact.adhesion import SPEED_FLOOR_M_S, Law, cleaning_share, law_for_contaminant
from rollerrig.rig.contact.patch import Patch, at, tabulate
from rollerrig.rig.multibody import eight_contacts as lanes

YOUNG_PA = 2.1e11
SHEAR_PA = 8.0e10
POISSON = 0.3

# laws from extreme contamination to dry, without and with strong recovery
LAWS = []
for _mu_cd in (0.01, 0.06, 0.25):
    for _tau_m_J in (0.0, 1.9e-4, 5e-3):
        for _limits in ((0.5, math.inf), (0.5, 8.0), (math.inf, math.inf)):
            LAWS.append(
                Law(
                    mu_cd=_mu_cd,
                    mu_cr=0.28,
                    A_d=0.4,
                    A_r=0.4,
                    gamma_d_s_m=0.2,
                    gamma_r_s_m=0.6,
                    k_ad=0.3,
                    k_sd=0.1,
                    k_ar=1.0,
                    k_sr=0.4,
                    tau_m_J=_tau_m_J,
                    cleaning_creepage=_limits[0],
                    cleaning_sliding_m_s=_limits[1],
                )
            )

# loads of a contact: within the domain of `vector_law`, and too small for it
INSIDE_N = (1.3e4, 1.9e5)
LIGHT_N = (1.0, 1.2e4)

# models that the loop computes; it leaves the others to `creep_force`
IN_THE_LOOP = (creep_force.DEGRADED, creep_force.POLACH)


class Contact(NamedTuple):
    """The inputs of one contact."""

    sx_m_s: float  # sliding along
    sy_m_s: float  # sliding across
    spin_1_s: float
    surface_m_s: float  # speed of the rail's surface
    load_N: float
    patch: Patch
    mu_cd: float
    mu_cr: float


@kernel
def patch_at(rolling_1_m, lateral_1_m, patches):
    return at(rolling_1_m, lateral_1_m, patches)


@kernel
def put(w, lane, patch):
    lanes.put(w, lane, patch)


@kernel
def force_of_model(contact, law):
    """Return the force (fx, fy, mz) of a contact by its model."""
    sliding_m_s = math.sqrt(contact.sx_m_s * contact.sx_m_s + contact.sy_m_s * contact.sy_m_s)
    per_speed = 1.0 / max(abs(contact.surface_m_s), SPEED_FLOOR_M_S)
    share = cleaning_share(sliding_m_s, contact.surface_m_s, law)[0]
    return creep_force.creep_force(
        contact.patch.model,
        contact.sx_m_s * per_speed,
        contact.sy_m_s * per_speed,
        contact.spin_1_s * per_speed,
        sliding_m_s,
        contact.load_N,
        contact.patch,
        law_for_contaminant(contact.mu_cd, contact.mu_cr, share, law),
    )


def table_of_patches(model, cells=10):
    return tabulate(YOUNG_PA, SHEAR_PA, POISSON, model, cells)


def random_contact(rng, patches, loads_N):
    """Return a contact from micro-slip to a lock; some have no spin or lateral creepage."""
    surface_m_s = 10.0 ** rng.uniform(-1.5, 1.9)
    largest_creepage = 10.0 ** rng.uniform(-6.0, [0.0, -1.0, 0.3])
    signs = rng.choice([-1.0, 1.0], 3)
    sx, sy, spin = surface_m_s * largest_creepage * signs
    sy = sy * rng.choice([0.0, 1.0, 1.0])
    spin = spin * rng.choice([0.0, 1.0, 1.0])
    patch = patch_at(rng.uniform(1.5, 4.0), 10.0 ** rng.uniform(-1.0, 1.5), patches)
    return Contact(
        sx_m_s=sx,
        sy_m_s=sy,
        spin_1_s=spin,
        surface_m_s=surface_m_s,
        load_N=10.0 ** rng.uniform(*np.log10(loads_N)),
        patch=patch,
        mu_cd=rng.uniform(0.01, 0.2),
        mu_cr=rng.uniform(0.21, 0.4),
    )


def filled_lanes(rng, count, patches, loads_N):
    """Return lanes with so many random contacts, and the contacts."""
    w = np.full(lanes.SIZE, np.nan)
    contacts = []
    for lane in range(count):
        contact = random_contact(rng, patches, loads_N)
        put(w, lane, contact.patch)
        w[lanes.SX + lane] = contact.sx_m_s
        w[lanes.SY + lane] = contact.sy_m_s
        w[lanes.SPIN + lane] = contact.spin_1_s
        w[lanes.SURFACE + lane] = contact.surface_m_s
        w[lanes.LOAD + lane] = contact.load_N
        w[lanes.MU_CD + lane] = contact.mu_cd
        w[lanes.MU_CR + lane] = contact.mu_cr
        contacts.append(contact)
    return w, contacts


def force_in(w, lane):
    """Return the force (fx, fy, mz) in a lane, shape (3,)."""
    return w[[lanes.FX + lane, lanes.FY + lane, lanes.MZ + lane]]


@pytest.mark.parametrize("model", creep_force.MODELS.values(), ids=creep_force.MODELS)
def test_each_of_eight_contacts_has_the_force_of_its_model(model):
    patches = table_of_patches(model, cells=6)
    rng = np.random.default_rng(model)
    repetitions = 10
    inside = 0
    for law in LAWS * repetitions:
        w, contacts = filled_lanes(rng, lanes.TOGETHER, patches, INSIDE_N)
        lanes.forces(w, lanes.TOGETHER, patches, law)
        inside += np.sum(w[lanes.INSIDE : lanes.INSIDE + lanes.TOGETHER] == 1.0)
        for lane, contact in enumerate(contacts):
            fx, fy, mz = force_of_model(contact, law)
            size_N = math.hypot(fx, fy)
            computed = force_in(w, lane)
            np.testing.assert_allclose(computed[:2], (fx, fy), rtol=0.0, atol=1e-11 * size_N)
            np.testing.assert_allclose(computed[2], mz, rtol=1e-10, atol=1e-13 * size_N)

    # the loop itself must have computed most of them
    if model in IN_THE_LOOP:
        assert inside > 0.8 * len(LAWS) * repetitions * lanes.TOGETHER


@pytest.mark.parametrize(("first", "loads_N"), [(0, LIGHT_N), (lanes.TOGETHER, INSIDE_N)])
def test_a_contact_that_the_loop_cannot_compute_has_the_force_of_the_model_to_the_bit(
    first, loads_N
):
    patches = table_of_patches(creep_force.DEGRADED)
    rng = np.random.default_rng(7)
    count = first + 3
    for law in LAWS:
        w, contacts = filled_lanes(rng, count, patches, loads_N)
        lanes.forces(w, count, patches, law)
        for lane in range(first, count):
            assert tuple(force_in(w, lane)) == force_of_model(contacts[lane], law)


def test_neither_the_number_of_contacts_nor_the_lane_changes_a_bit_of_the_force():
    patches = table_of_patches(creep_force.DEGRADED)
    law = LAWS[2]
    rng = np.random.default_rng(9)
    w, _ = filled_lanes(rng, lanes.TOGETHER, patches, INSIDE_N)
    only_one = w.copy()
    # the contact of lane 0 also in lane 5
    in_lane_5 = w.copy()
    rows = in_lane_5.reshape(-1, lanes.LANES)
    rows[:, 5] = rows[:, 0]

    lanes.forces(w, lanes.TOGETHER, patches, law)
    lanes.forces(only_one, 1, patches, law)
    lanes.forces(in_lane_5, lanes.TOGETHER, patches, law)
    assert (force_in(w, 0) == force_in(only_one, 0)).all()
    assert (force_in(w, 0) == force_in(in_lane_5, 5)).all()
