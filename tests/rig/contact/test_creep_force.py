"""The one interface to four tangential models: laws that hold for each of them."""

import math
import re
from functools import partial

import numpy as np
import pytest
from contact_program import contact_curves
from paper_law import TABLE_4

from rollerrig.realtime.bench import scenario
from rollerrig.rig import wheelset
from rollerrig.rig.contact import adhesion, creep_force, polach_spin
from rollerrig.rig.contact.creep_force import DEGRADED, FASTSIM, MODELS, POLACH
from rollerrig.rig.contact.patch import patch_for

near = partial(pytest.approx, abs=0.0)
LAW = TABLE_4
CLEAN = LAW._replace(mu_cd=0.3, A_d=1.0, k_ad=1.0, k_sd=1.0, mu_cr=0.3, A_r=1.0, k_sr=1.0)
N = 52_700.0
PATCHES = tuple(
    patch_for(0.445, R, lateral, 2.1e11, 8.0e10, 0.3, 0, 20)
    for R, lateral in ((math.inf, 0.3), (0.5, 0.3), (math.inf, 0.05), (1.0, 2.0))
)
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
each_patch = pytest.mark.parametrize("patch", PATCHES)


def force(model, xi, eta, phi, patch=PATCHES[0], law=CLEAN, sliding=0.0, load_N=N):
    return np.array(creep_force.creep_force(model, xi, eta, phi, sliding, load_N, patch, law))


@each_model
def test_without_spin_each_model_stays_within_0_08_mu_N_of_contact(model):
    patch = patch_for(0.445, math.inf, 0.3, 2.1e11, 2.1e11 / 2.6, 0.3)
    for row in contact_curves():
        if row["phi_1_per_m"] == 0.0:
            fx, fy, _ = force(model, row["xi"], row["eta"], 0.0, patch) / (0.3 * N)
            assert math.hypot(fx - row["CONTACT_fx"], fy - row["CONTACT_fy"]) < 0.08, row


@each_model
@each_patch
def test_at_vanishing_creepage_every_force_is_kalkers(model, patch):
    size = math.sqrt(patch.a1 * patch.b1) * N ** (1 / 3)
    unit = patch.shear_Pa * size**2
    assert force(model, 1e-8, 0, 0, patch)[0] == near(-unit * patch.c11 * 1e-8, rel=0.02)
    assert force(model, 0, 1e-8, 0, patch)[1] == near(-unit * patch.c22 * 1e-8, rel=0.02)
    assert force(model, 0, 0, 1e-5, patch)[1] == near(-unit * size * patch.c23 * 1e-5, rel=0.02)


@each_model
@each_patch
def test_large_creepage_slides_at_the_friction_limit(model, patch):
    # Polach's arctangent approaches the limit only as 1 / eps
    fx, fy, mz = force(model, 0.3, 0.4, 0.0, patch)
    size = math.sqrt(patch.a1 * patch.b1) * N ** (1 / 3)
    assert math.hypot(fx, fy) == near(0.3 * N, rel=0.02)
    assert fy / fx == near(4 / 3, rel=0.03)
    assert abs(mz) < 0.1 * 0.3 * N * size


@each_model
def test_the_moment_stays_near_contacts(model):
    patch = patch_for(0.445, math.inf, 0.3, 2.1e11, 2.1e11 / 2.6, 0.3)
    unit = 0.3 * N * math.sqrt(patch.a1 * patch.b1) * N ** (1 / 3)
    errors = [
        abs(
            force(model, row["xi"], row["eta"], row["phi_1_per_m"], patch)[2] / unit
            - row["CONTACT_mz"]
        )
        for row in contact_curves()
    ]
    assert np.mean(errors) < 0.035
    assert max(errors) < 0.19


@each_model
def test_the_force_opposes_the_creepage_and_mirrors_with_it(model):
    rng = np.random.default_rng(1)
    for xi, eta, phi in rng.normal(0.0, (3e-3, 3e-3, 0.3), (60, 3)):
        f = force(model, xi, eta, phi)
        assert force(model, -xi, -eta, -phi) == pytest.approx(-f, rel=1e-9, abs=1e-9)
        fx, fy, _ = force(model, xi, eta, 0.0)
        assert fx * xi + fy * eta < 0.0
        assert math.hypot(f[0], f[1]) <= 0.3 * N * 1.12  # Polach's two parts may exceed it a little


@each_model
def test_friction_falls_with_sliding(model):
    law = LAW._replace(tau_m_J=0.0)
    pull = [-force(model, 0.2, 0, 0, law=law, sliding=s)[0] for s in (0.0, 1.0, 5.0, 50.0)]
    assert pull == sorted(pull, reverse=True)
    assert pull[-1] == near(0.06 * N, rel=0.1)


@each_model
def test_nothing_acts_without_load_or_creepage(model):
    assert tuple(force(model, 0, 0, 0)) == (0.0, 0.0, 0.0)
    assert tuple(force(model, 1e-3, 1e-3, 1, load_N=0.0)) == (0.0, 0.0, 0.0)
    assert tuple(force(model, 1e-3, 1e-3, 1, load_N=-5.0)) == (0.0, 0.0, 0.0)
    assert np.all(np.isfinite(force(model, math.inf, -math.inf, 1e300)))


@pytest.mark.parametrize("s_m_s", [1e-6, 0.01, 0.3, 2.0, 8.0, 39.0])
def test_degraded_adhesion_along_the_rail_is_the_scalar_law(s_m_s):
    for patch in PATCHES:
        f, _, _, lambda_, W, _ = adhesion.wheel_adhesion(s_m_s, 40.0, N, patch, LAW)
        fx, fy, mz, recovered, work = creep_force.recovering_force(
            s_m_s / 40, 0, 0, s_m_s, N, patch, LAW
        )
        assert fx == near(-f * N, rel=1e-12)
        assert (fy, mz) == (0.0, 0.0)
        assert recovered == pytest.approx(lambda_, rel=1e-10, abs=1e-15)
        assert work == near(W, rel=1e-12)


def test_in_two_directions_and_with_spin_the_energy_equation_holds():
    rng = np.random.default_rng(7)
    for xi, eta, phi in rng.normal(0.0, (0.1, 0.05, 0.3), (200, 3)):
        sliding = 30.0 * math.hypot(xi, eta)
        fx, fy, _, lambda_, W = creep_force.recovering_force(
            xi, eta, phi, sliding, N, PATCHES[0], LAW
        )
        assert pytest.approx(1.0 - math.exp(-LAW.tau_m_J * W), abs=1e-12) == lambda_
        assert pytest.approx(-(fx * xi + fy * eta), rel=1e-9, abs=1e-9) == W
        assert 0.0 <= lambda_ <= 1.0


def test_polach_with_spin_stays_as_close_to_contact_as_in_its_source():
    patch = patch_for(0.445, math.inf, 0.3, 2.1e11, 2.1e11 / 2.6, 0.3)
    distances = []
    for row in contact_curves():
        if row["phi_1_per_m"]:
            fx, fy, _ = polach_spin.force(
                row["xi"], row["eta"], row["phi_1_per_m"], 0.3, N, patch, 1.0, 1.0
            )
            distances.append(
                math.hypot(fx / (0.3 * N) - row["CONTACT_fx"], fy / (0.3 * N) - row["CONTACT_fy"])
            )
    assert np.mean(distances) < 0.10
    assert max(distances) < 0.47


def test_spin_that_reduces_the_creepage_is_not_added():
    assert polach_spin.corrected(0.01, -0.005) == 0.01
    assert polach_spin.corrected(0.01, 0.005) == near(0.015)
    assert polach_spin.corrected(-0.01, -0.005) == near(-0.015)


@each_model
def test_a_scenario_chooses_the_model_of_the_plant(model):
    name = next(key for key, value in MODELS.items() if value == model)
    plan = scenario.load("velim_a1", settings=(f"contact.model={name}",))
    p = plan.params
    assert p.patch.model == model
    f, f_d, f_r, lambda_, W, _ = wheelset.wheelset_adhesion(
        4.0, 40.0, 2 * N, 0.06, 0.28, p.patch, p.law
    )
    if model == DEGRADED:
        assert f_d < f < f_r
        assert lambda_ > 0.1
    else:
        assert f == f_d == f_r
        assert lambda_ == 0.0
        assert near(f * N * 0.1, rel=1e-12) == W
    if model == POLACH:
        tau_0 = adhesion.wheel_adhesion(4.0, 40.0, N, p.patch, p.law._replace(tau_m_J=0.0))[0]
        assert f == near(tau_0, rel=1e-12)


def test_an_unknown_model_is_refused_with_the_allowed_ones():
    with pytest.raises(Exception, match=re.escape("fastsim")):
        scenario.load("velim_a1", settings=("contact.model=fastsimm",))


def test_the_patch_has_the_grid_of_fastsim():
    coarse = PATCHES[0]._replace(cells=4)
    fine = PATCHES[0]._replace(cells=60)
    assert force(FASTSIM, 2e-3, 0, 1.0, coarse)[0] != force(FASTSIM, 2e-3, 0, 1.0, fine)[0]
