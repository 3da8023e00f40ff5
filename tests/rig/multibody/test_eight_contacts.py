"""Eight contacts at once against the models themselves, one by one."""

import math

import numpy as np
import pytest

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import creep_force
from rollerrig.rig.contact.adhesion import SPEED_FLOOR_M_S, Law, cleaning_share, law_for_contaminant
from rollerrig.rig.contact.patch import at, tabulate
from rollerrig.rig.multibody import eight_contacts as lanes

LAWS = tuple(
    Law(mu_cd, 0.28, 0.4, 0.4, 0.2, 0.6, 0.3, 0.1, 1.0, 0.4, tau_m_J, cleaning_creepage)
    for mu_cd in (0.01, 0.06, 0.25)
    for tau_m_J in (0.0, 1.9e-4, 5e-3)
    for cleaning_creepage in (0.5, math.inf)
)
INSIDE_N, LIGHT_N = (1.3e4, 1.9e5), (1.0, 1.2e4)


@kernel
def patch_at(rolling_1_m, lateral_1_m, patches):
    return at(rolling_1_m, lateral_1_m, patches)


@kernel
def put(w, lane, patch):
    lanes.put(w, lane, patch)


@kernel
def by_the_model(sx, sy, spin, surface, load_N, patch, mu_cd, mu_cr, law):
    per_speed, s = 1.0 / max(abs(surface), SPEED_FLOOR_M_S), math.sqrt(sx * sx + sy * sy)
    here = law_for_contaminant(
        mu_cd, mu_cr, cleaning_share(s, surface, law.cleaning_creepage)[0], law
    )
    return creep_force.creep_force(
        patch.model, sx * per_speed, sy * per_speed, spin * per_speed, s, load_N, patch, here
    )


def filled(rng, count, patches, loads_N):
    """Lanes of random contacts, from micro-slip to locked wheels, some without spin or lateral creepage."""
    w, given = np.full(lanes.SIZE, np.nan), []
    for lane in range(count):
        surface = 10.0 ** rng.uniform(-1.5, 1.9)
        sx, sy, spin = (
            surface * 10.0 ** rng.uniform(-6.0, [0.0, -1.0, 0.3]) * rng.choice([-1.0, 1.0], 3)
        )
        sy, spin = sy * rng.choice([0.0, 1.0, 1.0]), spin * rng.choice([0.0, 1.0, 1.0])
        patch = patch_at(rng.uniform(1.5, 4.0), 10.0 ** rng.uniform(-1.0, 1.5), patches)
        put(w, lane, patch)
        one = (sx, sy, spin, surface, 10.0 ** rng.uniform(*np.log10(loads_N)))
        mu = (rng.uniform(0.01, 0.2), rng.uniform(0.21, 0.4))
        for row, value in zip(
            (lanes.SX, lanes.SY, lanes.SPIN, lanes.SURFACE, lanes.LOAD, lanes.MU_CD, lanes.MU_CR),
            (*one, *mu),
            strict=True,
        ):
            w[row + lane] = value
        given.append((*one, patch, *mu))
    return w, given


def found(w, lane):
    return w[[lanes.FX + lane, lanes.FY + lane, lanes.MZ + lane]]


@pytest.mark.parametrize("model", creep_force.MODELS.values(), ids=creep_force.MODELS)
def test_eight_contacts_at_once_have_the_forces_that_each_has_alone(model):
    patches, rng, inside = tabulate(2.1e11, 8.0e10, 0.3, model, 6), np.random.default_rng(model), 0
    for law in LAWS * 10:
        w, given = filled(rng, lanes.TOGETHER, patches, INSIDE_N)
        lanes.forces(w, lanes.TOGETHER, patches, law)
        inside += np.sum(w[lanes.INSIDE : lanes.INSIDE + lanes.TOGETHER] == 1.0)
        for lane, one in enumerate(given):
            fx, fy, mz = by_the_model(*one, law)
            size_N = math.hypot(fx, fy)
            np.testing.assert_allclose(found(w, lane)[:2], (fx, fy), rtol=0.0, atol=1e-11 * size_N)
            np.testing.assert_allclose(found(w, lane)[2], mz, rtol=1e-10, atol=1e-13 * size_N)
    assert inside > 0.8 * len(LAWS) * 80 or model not in (creep_force.DEGRADED, creep_force.POLACH)


@pytest.mark.parametrize(("first", "loads_N"), [(0, LIGHT_N), (lanes.TOGETHER, INSIDE_N)])
def test_what_the_loop_cannot_tell_has_the_force_of_the_model_to_the_bit(first, loads_N):
    patches, rng = tabulate(2.1e11, 8.0e10, 0.3, creep_force.DEGRADED), np.random.default_rng(7)
    for law in LAWS:
        w, given = filled(rng, first + 3, patches, loads_N)
        lanes.forces(w, first + 3, patches, law)
        for lane in range(first, first + 3):
            assert tuple(found(w, lane)) == by_the_model(*given[lane], law)


def test_how_many_contacts_stand_beside_a_contact_changes_no_bit_of_it():
    patches, rng = tabulate(2.1e11, 8.0e10, 0.3, creep_force.DEGRADED), np.random.default_rng(9)
    w, _ = filled(rng, lanes.TOGETHER, patches, INSIDE_N)
    few, moved = w.copy(), w.reshape(-1, lanes.LANES).copy()
    moved[:, 5] = moved[:, 0]
    lanes.forces(w, lanes.TOGETHER, patches, LAWS[2])
    lanes.forces(few, 1, patches, LAWS[2])
    lanes.forces(moved.ravel(), lanes.TOGETHER, patches, LAWS[2])
    assert (found(w, 0) == found(few, 0)).all()
    assert (found(w, 0) == found(moved.ravel(), 5)).all()
