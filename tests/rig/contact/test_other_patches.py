"""The creep force models on patches, loads, rollers and combined creepages without a data file."""

import math

import numpy as np
import pytest
from contact_program import contact_curves
from halfspace import HalfSpace

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
# wheel, roller and lateral radius in m, load in N, friction: a/b from 0.37 to 4.8
CONTACTS = (
    (0.445, math.inf, 2.0, 52_700.0, 0.10),
    (0.445, 1.0, 1.2, 80_000.0, 0.35),
    (0.445, 0.5, 0.3, 30_000.0, 0.25),
    (0.625, math.inf, 0.3, 106_700.0, 0.30),
    (0.445, math.inf, 0.04, 40_000.0, 0.30),
)
# creepages and spin, in units of those at which the linear force is the friction limit
SIDEWAYS = ((0.5, 0.0), (0.9, -0.9), (-0.4, 1.6), (2.5, 1.0))
SPINNING = ((0.4, -0.1, 1.0), (-0.9, -1.2, 1.3), (0.0, 0.0, -0.8), (-1.7, 1.5, 0.7))
each_contact = pytest.mark.parametrize("contact", CONTACTS, ids=lambda c: f"{c[1]:g}-{c[2]:g}")


class Judge:
    """The half-space solution of a contact, and the distance of a model from it."""

    def __init__(self, r, R, lateral, load_N, mu, elements=15):
        self.patch = patch_for(r, R, lateral, E_PA, G_PA, NU, 0, 30)
        growth = load_N ** (1.0 / 3.0)
        a = self.patch.a1 * growth
        b = self.patch.b1 * growth
        self.half_space = HalfSpace(a, b, G_PA, NU, elements)
        self.size = math.sqrt(a * b)
        self.unit = mu * load_N / (G_PA * a * b * self.patch.c11)
        self.load_N = load_N
        self.limit_N = mu * load_N
        self.law = LAW._replace(mu_cd=mu, mu_cr=mu)

    def force(self, model, creep):
        """Return force and moment (3,) of a model for creepages and spin (3,)."""
        return np.array(
            creep_force.creep_force(model, *creep, 0.0, self.load_N, self.patch, self.law)
        )

    def distance(self, model, xi, eta, phi=0.0):
        """Return |dF| / (mu N) between a model and the half-space."""
        creep = (self.unit * xi, self.unit * eta, self.unit * phi / self.size)
        fx, fy, _ = self.force(model, creep)
        exact = self.half_space.force(*creep, self.limit_N)
        return math.hypot(fx / self.limit_N - exact[0], fy / self.limit_N - exact[1])


def test_the_half_space_agrees_with_contact():
    judge = Judge(0.445, math.inf, 0.3, 52_700.0, 0.3, elements=21)
    for row in contact_curves()[1::3]:
        fx, fy = judge.half_space.force(row["xi"], row["eta"], row["phi_1_per_m"], judge.limit_N)
        assert math.hypot(fx - row["CONTACT_fx"], fy - row["CONTACT_fy"]) < 0.045, row


@each_contact
def test_without_spin_every_model_stays_within_0_08_mu_N_of_the_half_space(contact):
    judge = Judge(*contact)
    for xi, eta in SIDEWAYS:
        for model in (POLACH, FASTSIM, JOHNSON_VERMEULEN):
            assert judge.distance(model, xi, eta) < 0.08, (model, xi, eta)


@each_contact
def test_with_spin_fastsim_stays_within_0_08_mu_N_of_the_half_space(contact):
    judge = Judge(*contact, elements=21)
    for creep in SPINNING:
        assert judge.distance(FASTSIM, *creep) < 0.08, creep


@pytest.mark.parametrize("lateral_m", [0.08, 0.04], ids=["a/b = 3.1", "a/b = 4.8"])
def test_with_spin_and_longitudinal_creepage_fastsim_stays_within_0_08_mu_N_on_long_patches(
    lateral_m,
):
    judge = Judge(0.445, math.inf, lateral_m, 45_000.0, 0.3, elements=21)
    for creep in ((1.5, 0.0, 2.0), (0.8, 0.0, 1.6), (1.2, 0.2, -2.0), (1.5, 0.5, -1.6)):
        assert judge.distance(FASTSIM, *creep) < 0.08, creep


@each_contact
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_mirrored_contact_gives_the_mirrored_force(contact, model):
    judge = Judge(*contact)
    for xi, eta, phi in SPINNING:
        creep = np.array([judge.unit * xi, judge.unit * eta, judge.unit * phi / judge.size])
        for signs, force_signs in (((1, -1, -1), (1, -1, -1)), ((-1, -1, -1), (-1, -1, -1))):
            force = judge.force(model, creep)
            mirrored = judge.force(model, creep * signs)
            np.testing.assert_allclose(mirrored, force * force_signs, rtol=1e-9, atol=1e-6)


@each_contact
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_more_creepage_along_any_direction_never_gives_less_force(contact, model):
    judge = Judge(*contact)
    for angle in (0.0, 0.6, 1.2):
        sizes = []
        for part in np.geomspace(0.05, 30.0, 40):
            xi = judge.unit * part * math.cos(angle)
            eta = judge.unit * part * math.sin(angle)
            fx, fy, _ = creep_force.creep_force(
                model, xi, eta, 0.0, 0.0, judge.load_N, judge.patch, judge.law
            )
            sizes.append(math.hypot(fx, fy))
        assert np.all(np.diff(sizes) > -2e-3 * judge.limit_N)
        assert max(sizes) <= judge.limit_N * (1.0 + 1e-9)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("place", [0, 1, 2, 3, 4])
def test_a_nan_input_gives_no_finite_force(model, place):
    inputs = [1e-3, 1e-3, 0.2, 0.05, 5e4]
    inputs[place] = math.nan
    judge = Judge(*CONTACTS[0])
    law = LAW._replace(gamma_d_s_m=0.2, gamma_r_s_m=0.2)
    forces = creep_force.creep_force(model, *inputs, judge.patch, law)
    assert np.isnan(forces).any() or tuple(forces) == (0.0, 0.0, 0.0)
