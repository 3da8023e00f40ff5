"""The creep force models on patches, loads, rollers and combined creepages without a data file."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from contact_program import contact_results
from halfspace import HalfSpace, extrapolated_force

from rollerrig.rig.contact import adhesion, creep_force
from rollerrig.rig.contact.creep_force import FASTSIM, JOHNSON_VERMEULEN, MODELS, POLACH
from rollerrig.rig.contact.patch import patch_for

E_PA = 2.1e11
NU = 0.3
G_PA = E_PA / (2.0 + 2.0 * NU)
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


class Contact(NamedTuple):
    """A wheel on a roller, or on a rail with an infinite radius."""

    wheel_m: float
    roller_m: float
    lateral_m: float
    load_N: float
    mu: float


# a/b from 0.37 to 4.8
CONTACTS = (
    Contact(0.445, math.inf, 2.0, 52_700.0, 0.10),
    Contact(0.445, 1.0, 1.2, 80_000.0, 0.35),
    Contact(0.445, 0.5, 0.3, 30_000.0, 0.25),
    Contact(0.625, math.inf, 0.3, 106_700.0, 0.30),
    Contact(0.445, math.inf, 0.04, 40_000.0, 0.30),
)
# creepages along and across, and spin; in units of those at which the linear force is the limit
SIDEWAYS = ((0.5, 0.0), (0.9, -0.9), (-0.4, 1.6), (2.5, 1.0))
SPINNING = ((0.4, -0.1, 1.0), (-0.9, -1.2, 1.3), (0.0, 0.0, -0.8), (-1.7, 1.5, 0.7))
# the worst cases of FASTSIM on long and narrow patches, in the same units
LONG = Contact(0.445, math.inf, 0.0536, 45_000.0, 0.30)  # a/b = 4
LONGEST = Contact(0.445, math.inf, 0.0281, 45_000.0, 0.30)  # a/b = 6
NARROW = Contact(0.445, math.inf, 2.777, 45_000.0, 0.30)  # a/b = 0.3
WORST = (
    (LONG, ((1.3, -0.85, 2.25), (0.1, -2.25, 2.2))),
    (LONGEST, ((1.55, -0.85, 1.75), (0.7, 0.05, 1.1), (-0.15, 0.2, -0.95))),
    (NARROW, ((2.6, 0.0, 2.4), (-2.3, -0.3, -2.0))),
)
each_contact = pytest.mark.parametrize(
    "contact", CONTACTS, ids=lambda c: f"{c.roller_m:g}-{c.lateral_m:g}"
)
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


class Judge:
    """The half-space solution of a contact, and the distance of a model from it.

    With `fine_elements`, the solution is extrapolated from both grids.
    """

    def __init__(self, contact, elements=15, fine_elements=None):
        self.patch = patch_for(
            wheel_radius_m=contact.wheel_m,
            roller_radius_m=contact.roller_m,
            lateral_radius_m=contact.lateral_m,
            young_Pa=E_PA,
            shear_Pa=G_PA,
            poisson=NU,
            cells=30,
        )
        self.load_N = contact.load_N
        self.limit_N = contact.mu * contact.load_N
        self.law = LAW._replace(mu_cd=contact.mu, mu_cr=contact.mu)

        growth = contact.load_N ** (1.0 / 3.0)
        a_m = self.patch.a1 * growth
        b_m = self.patch.b1 * growth
        self.half_space = HalfSpace(a_m, b_m, G_PA, NU, elements)
        self.fine = None
        if fine_elements is not None:
            self.fine = HalfSpace(a_m, b_m, G_PA, NU, fine_elements)
        # creepage and spin at which the linear force is the friction limit
        self.creepage_unit = self.limit_N / (G_PA * a_m * b_m * self.patch.c11)
        self.spin_unit_1_m = self.creepage_unit / math.sqrt(a_m * b_m)

    def in_units(self, xi, eta, phi=0.0):
        """Return creepages and spin (3,) of numbers in the units above."""
        return np.array(
            [self.creepage_unit * xi, self.creepage_unit * eta, self.spin_unit_1_m * phi]
        )

    def force(self, model, creepages_and_spin):
        """Return force and moment (3,) of a model."""
        return np.array(
            creep_force.creep_force(
                model, *creepages_and_spin, 0.0, self.load_N, self.patch, self.law
            )
        )

    def exact(self, creepages_and_spin):
        """Return the half-space's force over mu N (2,)."""
        if self.fine is None:
            return self.half_space.force(*creepages_and_spin, self.limit_N)
        return extrapolated_force(self.half_space, self.fine, *creepages_and_spin, self.limit_N)

    def distance(self, model, xi, eta, phi=0.0):
        """Return |dF| / (mu N) between a model and the half-space; inputs as in `in_units`."""
        creepages_and_spin = self.in_units(xi, eta, phi)
        fx, fy, _ = self.force(model, creepages_and_spin)
        exact_x, exact_y = self.exact(creepages_and_spin)
        return math.hypot(fx / self.limit_N - exact_x, fy / self.limit_N - exact_y)


def test_the_half_space_agrees_with_contact():
    judge = Judge(Contact(0.445, math.inf, 0.3, 52_700.0, 0.3), elements=21)
    for result in contact_results()[1::3]:
        fx, fy = judge.half_space.force(result.xi, result.eta, result.phi_1_m, judge.limit_N)
        assert result.distance(fx, fy) < 0.045, result


@each_contact
def test_without_spin_every_model_stays_within_0_08_mu_N_of_the_half_space(contact):
    judge = Judge(contact)
    for xi, eta in SIDEWAYS:
        for model in (POLACH, FASTSIM, JOHNSON_VERMEULEN):
            assert judge.distance(model, xi, eta) < 0.08, (model, xi, eta)


def test_the_extrapolated_half_space_is_twice_as_near_to_contact():
    judge = Judge(Contact(0.445, math.inf, 0.3, 52_700.0, 0.3), elements=11, fine_elements=15)
    for result in contact_results()[1::3]:
        creepages_and_spin = (result.xi, result.eta, result.phi_1_m)
        assert result.distance(*judge.exact(creepages_and_spin)) < 0.0225, result


@each_contact
def test_with_spin_fastsim_stays_within_0_075_mu_N_of_the_half_space(contact):
    judge = Judge(contact, elements=15, fine_elements=21)
    for creep in SPINNING:
        assert judge.distance(FASTSIM, *creep) < 0.075, creep


@pytest.mark.parametrize(("contact", "creeps"), WORST, ids=["a/b = 4", "a/b = 6", "a/b = 0.3"])
def test_with_spin_fastsim_stays_within_0_075_mu_N_on_long_and_narrow_patches(contact, creeps):
    judge = Judge(contact, elements=15, fine_elements=21)
    for creep in creeps:
        assert judge.distance(FASTSIM, *creep) < 0.075, creep


def test_the_spin_force_of_fastsim_has_no_bulge_between_the_rows_of_kalkers_table():
    # a/b = 5 is a row of the table, a/b = 6 lies between two rows
    ratios = []
    for lateral_m in (0.03763, 0.0281):
        judge = Judge(Contact(0.445, math.inf, lateral_m, 45_000.0, 0.3))
        creepages_and_spin = judge.in_units(0.0, 0.0, 1e-4)
        _, fy, _ = judge.force(FASTSIM, creepages_and_spin)
        _, exact = judge.exact(creepages_and_spin)
        ratios.append(fy / (judge.limit_N * exact))
    assert ratios[1] == pytest.approx(ratios[0], rel=0.03)


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
