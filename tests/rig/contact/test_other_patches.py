"""The creep force models on patches, loads, rollers and combined creepages without a data file."""

import math

import half_space_table
import numpy as np
import pytest
from contact_program import contact_results
from half_space_table import CONTACTS, SPINNING, Contact
from halfspace import HalfSpace, extrapolated_force

from rollerrig.rig.contact import adhesion, creep_force
from rollerrig.rig.contact.creep_force import FASTSIM, JOHNSON_VERMEULEN, MODELS, POLACH

# Polach without falling friction, k_A = k_S = 1
LAW = adhesion.Law(
    mu_cd=0.3,
    mu_cr=0.3,
    A_d=1.0,
    A_r=1.0,
    gamma_d_s_m=0.0,
    gamma_r_s_m=0.0,
    k_ad=1.0,
    k_sd=1.0,
    k_ar=1.0,
    k_sr=1.0,
    tau_m_J=0.0,
)


each_contact = pytest.mark.parametrize(
    "contact", CONTACTS, ids=lambda c: f"{c.roller_m:g}-{c.lateral_m:g}"
)
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


class Judge:
    """A contact by the models."""

    def __init__(self, contact):
        self.contact = contact
        self.patch = contact.patch()
        self.law = LAW._replace(mu_cd=contact.mu, mu_cr=contact.mu)
        self.limit_N = contact.limit_N

    def in_units(self, xi, eta, phi=0.0):
        """Return creepages and spin (3,) of numbers in the units of `half_space_table`."""
        return np.array(half_space_table.in_units(self.contact, self.patch, (xi, eta, phi)))

    def force(self, model, creepages_and_spin):
        """Return force and moment (3,) of a model."""
        return np.array(
            creep_force.creep_force(
                model, *creepages_and_spin, 0.0, self.contact.load_N, self.patch, self.law
            )
        )


def force_of(model, row):
    """Return the force (2,) over mu N of a model in a row of the half-space table."""
    judge = Judge(row.contact)
    fx, fy, _ = judge.force(model, (row.xi, row.eta, row.phi_1_m))
    return fx / judge.limit_N, fy / judge.limit_N


def rows_of(series):
    """Return the rows of a series as parameters."""
    rows = half_space_table.rows(series)
    return pytest.mark.parametrize("row", rows, ids=range(len(rows)))


@pytest.mark.parametrize("model", [POLACH, FASTSIM, JOHNSON_VERMEULEN])
@rows_of("without spin")
def test_without_spin_every_model_stays_within_0_08_mu_N_of_the_half_space(row, model):
    assert row.distance(*force_of(model, row)) < 0.08


@rows_of("with spin")
def test_with_spin_fastsim_stays_within_0_075_mu_N_of_the_half_space(row):
    assert row.distance(*force_of(FASTSIM, row)) < 0.075


@rows_of("long or narrow")
def test_with_spin_fastsim_stays_within_0_075_mu_N_on_long_and_narrow_patches(row):
    assert row.distance(*force_of(FASTSIM, row)) < 0.075


def test_the_spin_force_of_fastsim_has_no_bulge_between_the_rows_of_kalkers_table():
    ratios = []
    for row in half_space_table.rows("spin alone"):
        _, fy = force_of(FASTSIM, row)
        ratios.append(fy / row.fy)
    assert ratios[1] == pytest.approx(ratios[0], rel=0.03)


# --- the half-space program ---


def test_the_half_space_table_is_complete_and_its_first_force_is_that_of_the_program():
    rows = [row for series in half_space_table.SERIES for row in half_space_table.rows(series)]
    assert len(rows) == 20 + 20 + 7 + 2
    assert rows[0].computed() == pytest.approx((rows[0].fx, rows[0].fy), abs=1e-9)
    for row in rows:
        patch = row.contact.patch()
        growth = row.contact.load_N ** (1.0 / 3.0)
        assert patch.a1 * growth == pytest.approx(row.a_m, rel=1e-9)
        assert patch.b1 * growth == pytest.approx(row.b_m, rel=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize("series", half_space_table.SERIES)
def test_the_half_space_table_is_that_of_the_program(series):
    for row in half_space_table.rows(series):
        assert row.computed() == pytest.approx((row.fx, row.fy), abs=1e-6)


def half_space_of_contact(elements):
    """Return the half-space of the results of CONTACT, and its friction limit."""
    contact = Contact(0.445, math.inf, 0.3, 52_700.0, 0.3)
    patch = contact.patch()
    growth = contact.load_N ** (1.0 / 3.0)
    a_m = patch.a1 * growth
    b_m = patch.b1 * growth
    half_space = HalfSpace(a_m, b_m, half_space_table.SHEAR_PA, half_space_table.POISSON, elements)
    return half_space, contact.limit_N


@pytest.mark.nightly
def test_the_half_space_agrees_with_contact():
    half_space, limit_N = half_space_of_contact(21)
    for result in contact_results()[1::3]:
        fx, fy = half_space.force(result.xi, result.eta, result.phi_1_m, limit_N)
        assert result.distance(fx, fy) < 0.045, result


@pytest.mark.nightly
def test_the_extrapolated_half_space_is_twice_as_near_to_contact():
    coarse, limit_N = half_space_of_contact(11)
    fine, _ = half_space_of_contact(15)
    for result in contact_results()[1::3]:
        force = extrapolated_force(coarse, fine, result.xi, result.eta, result.phi_1_m, limit_N)
        assert result.distance(*force) < 0.0225, result


# --- laws ---


@each_contact
@each_model
def test_a_mirrored_contact_gives_the_mirrored_force(contact, model):
    judge = Judge(contact)
    # a mirror in the plane along the rail, and the opposite motion
    for signs in ((1, -1, -1), (-1, -1, -1)):
        for creep in SPINNING:
            creepages_and_spin = judge.in_units(*creep)
            force = judge.force(model, creepages_and_spin)
            mirrored = judge.force(model, creepages_and_spin * signs)
            np.testing.assert_allclose(mirrored, force * signs, rtol=1e-9, atol=1e-6)


@each_contact
@each_model
def test_more_creepage_along_any_direction_never_gives_less_force(contact, model):
    judge = Judge(contact)
    for angle in (0.0, 0.6, 1.2):
        sizes_N = []
        for part in np.geomspace(0.05, 30.0, 40):
            creep = judge.in_units(part * math.cos(angle), part * math.sin(angle))
            fx, fy, _ = judge.force(model, creep)
            sizes_N.append(math.hypot(fx, fy))
        assert np.all(np.diff(sizes_N) > -2e-3 * judge.limit_N)
        assert max(sizes_N) <= judge.limit_N * (1.0 + 1e-9)


@each_model
@pytest.mark.parametrize("place", [0, 1, 2, 3, 4])
def test_a_nan_input_gives_no_finite_force(model, place):
    inputs = [1e-3, 1e-3, 0.2, 0.05, 5e4]
    inputs[place] = math.nan
    judge = Judge(CONTACTS[0])
    law = LAW._replace(gamma_d_s_m=0.2, gamma_r_s_m=0.2)
    forces = creep_force.creep_force(model, *inputs, judge.patch, law)
    assert np.isnan(forces).any() or tuple(forces) == (0.0, 0.0, 0.0)
