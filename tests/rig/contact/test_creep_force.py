"""The one interface to four tangential models: laws that hold for each of them."""

import math
import re
from functools import partial

import numpy as np
import pytest
from contact_program import (
    CONTACT_PATCH,
    contact_results,
    results_with_spin,
    results_without_spin,
)
from paper_law import TABLE_4

from rollerrig.realtime.bench import scenario
from rollerrig.rig import wheelset
from rollerrig.rig.contact import adhesion, creep_force, polach_spin
from rollerrig.rig.contact.creep_force import DEGRADED, FASTSIM, MODELS, POLACH
from rollerrig.rig.contact.patch import patch_for

near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small
LAW = TABLE_4
# constant friction, and Polach's force without a reduction of the slope
MU = 0.3
CLEAN = LAW._replace(mu_cd=MU, A_d=1.0, k_ad=1.0, k_sd=1.0, mu_cr=MU, A_r=1.0, k_sr=1.0)
LOAD_N = 52_700.0
LIMIT_N = MU * LOAD_N


def patch_of(roller_m, lateral_m):
    """Return the patch of a wheel on a roller, or on a rail with an infinite radius."""
    return patch_for(
        wheel_radius_m=0.445,
        roller_radius_m=roller_m,
        lateral_radius_m=lateral_m,
        young_Pa=2.1e11,
        shear_Pa=8.0e10,
        poisson=0.3,
        cells=20,
    )


RAIL_PATCH = patch_of(math.inf, 0.3)
PATCHES = (RAIL_PATCH, patch_of(0.5, 0.3), patch_of(math.inf, 0.05), patch_of(1.0, 2.0))
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
each_patch = pytest.mark.parametrize("patch", PATCHES)


def force(model, xi, eta, phi_1_m, patch=RAIL_PATCH, law=CLEAN, sliding_m_s=0.0, load_N=LOAD_N):
    """Return force and moment (3,) of a model."""
    return np.array(
        creep_force.creep_force(model, xi, eta, phi_1_m, sliding_m_s, load_N, patch, law)
    )


def size_m(patch):
    """Return the geometric mean of the semi-axes under the load."""
    return math.sqrt(patch.a1 * patch.b1) * LOAD_N ** (1 / 3)


@each_model
def test_without_spin_each_model_stays_within_0_08_mu_N_of_contact(model):
    for result in results_without_spin():
        fx, fy, _ = force(model, result.xi, result.eta, 0.0, CONTACT_PATCH) / LIMIT_N
        assert result.distance(fx, fy) < 0.08, result


@each_model
@each_patch
def test_at_vanishing_creepage_every_force_is_kalkers(model, patch):
    unit_N = patch.shear_Pa * size_m(patch) ** 2
    along, _, _ = force(model, 1e-8, 0, 0, patch)
    _, across, _ = force(model, 0, 1e-8, 0, patch)
    _, by_spin, _ = force(model, 0, 0, 1e-5, patch)
    assert along == near(-unit_N * patch.c11 * 1e-8, rel=0.02)
    assert across == near(-unit_N * patch.c22 * 1e-8, rel=0.02)
    assert by_spin == near(-unit_N * size_m(patch) * patch.c23 * 1e-5, rel=0.02)


@each_model
@each_patch
def test_large_creepage_slides_at_the_friction_limit(model, patch):
    # Polach's arctangent approaches the limit only as 1 / eps
    fx, fy, mz = force(model, 0.3, 0.4, 0.0, patch)
    assert math.hypot(fx, fy) == near(LIMIT_N, rel=0.02)
    assert fy / fx == near(4 / 3, rel=0.03)
    assert abs(mz) < 0.1 * LIMIT_N * size_m(patch)


@each_model
def test_the_moment_stays_near_contacts(model):
    unit_Nm = LIMIT_N * size_m(CONTACT_PATCH)
    errors = []
    for result in contact_results():
        _, _, mz = force(model, result.xi, result.eta, result.phi_1_m, CONTACT_PATCH)
        errors.append(abs(mz / unit_Nm - result.mz))
    assert np.mean(errors) < 0.035
    assert max(errors) < 0.19


@each_model
def test_the_force_opposes_the_creepage_and_mirrors_with_it(model):
    rng = np.random.default_rng(1)
    for xi, eta, phi_1_m in rng.normal(0.0, (3e-3, 3e-3, 0.3), (60, 3)):
        with_spin = force(model, xi, eta, phi_1_m)
        mirrored = force(model, -xi, -eta, -phi_1_m)
        assert mirrored == pytest.approx(-with_spin, rel=1e-9, abs=1e-9)
        # Polach's two parts may exceed the limit a little
        assert math.hypot(*with_spin[:2]) <= LIMIT_N * 1.12
        fx, fy, _ = force(model, xi, eta, 0.0)
        assert fx * xi + fy * eta < 0.0


@each_model
def test_friction_falls_with_sliding(model):
    law = LAW._replace(tau_m_J=0.0)
    pulls_N = []
    for sliding_m_s in (0.0, 1.0, 5.0, 50.0):
        fx, _, _ = force(model, 0.2, 0, 0, law=law, sliding_m_s=sliding_m_s)
        pulls_N.append(-fx)
    assert pulls_N == sorted(pulls_N, reverse=True)
    assert pulls_N[-1] == near(law.mu_cd * LOAD_N, rel=0.1)


@each_model
def test_nothing_acts_without_load_or_creepage(model):
    assert tuple(force(model, 0, 0, 0)) == (0.0, 0.0, 0.0)
    assert tuple(force(model, 1e-3, 1e-3, 1, load_N=0.0)) == (0.0, 0.0, 0.0)
    assert tuple(force(model, 1e-3, 1e-3, 1, load_N=-5.0)) == (0.0, 0.0, 0.0)
    assert np.all(np.isfinite(force(model, math.inf, -math.inf, 1e300)))


@pytest.mark.parametrize("sliding_m_s", [1e-6, 0.01, 0.3, 2.0, 8.0, 39.0])
@each_patch
def test_degraded_adhesion_along_the_rail_is_the_scalar_law(sliding_m_s, patch):
    speed_m_s = 40.0
    f, _, _, lambda_, work, _ = adhesion.wheel_adhesion(sliding_m_s, speed_m_s, LOAD_N, patch, LAW)
    fx, fy, mz, recovered, its_work = creep_force.recovering_force(
        sliding_m_s / speed_m_s, 0, 0, sliding_m_s, LOAD_N, patch, LAW
    )
    assert fx == near(-f * LOAD_N, rel=1e-12)
    assert (fy, mz) == (0.0, 0.0)
    assert recovered == pytest.approx(lambda_, rel=1e-10, abs=1e-15)
    assert its_work == near(work, rel=1e-12)


def test_in_two_directions_and_with_spin_the_energy_equation_holds():
    speed_m_s = 30.0
    rng = np.random.default_rng(7)
    for xi, eta, phi_1_m in rng.normal(0.0, (0.1, 0.05, 0.3), (200, 3)):
        sliding_m_s = speed_m_s * math.hypot(xi, eta)
        fx, fy, _, lambda_, work = creep_force.recovering_force(
            xi, eta, phi_1_m, sliding_m_s, LOAD_N, RAIL_PATCH, LAW
        )
        assert lambda_ == pytest.approx(1.0 - math.exp(-LAW.tau_m_J * work), abs=1e-12)
        assert work == pytest.approx(-(fx * xi + fy * eta), rel=1e-9, abs=1e-9)
        assert 0.0 <= lambda_ <= 1.0


def test_polach_with_spin_stays_as_close_to_contact_as_in_its_source():
    distances = []
    for result in results_with_spin():
        fx, fy, _ = polach_spin.force(
            result.xi, result.eta, result.phi_1_m, MU, LOAD_N, CONTACT_PATCH, 1.0, 1.0
        )
        distances.append(result.distance(fx / LIMIT_N, fy / LIMIT_N))
    assert np.mean(distances) < 0.10
    assert max(distances) < 0.47


def test_spin_that_reduces_the_creepage_is_not_added():
    assert polach_spin.corrected(0.01, -0.005) == 0.01
    assert polach_spin.corrected(0.01, 0.005) == near(0.015)
    assert polach_spin.corrected(-0.01, -0.005) == near(-0.015)


@each_model
def test_a_scenario_chooses_the_model_of_the_plant(model):
    name = next(key for key, number in MODELS.items() if number == model)
    plan = scenario.load("velim_a1", settings=(f"contact.model={name}",))
    patch = plan.params.patch
    law = plan.params.law
    assert patch.model == (None if model == DEGRADED else model)

    sliding_m_s = 4.0
    speed_m_s = 40.0
    f, f_d, f_r, lambda_, work, _ = wheelset.wheelset_adhesion(
        sliding_m_s, speed_m_s, 2 * LOAD_N, 0.06, 0.28, patch, law
    )
    if model == DEGRADED:
        assert f_d < f < f_r
        assert lambda_ > 0.1
    else:
        assert f == f_d == f_r
        assert lambda_ == 0.0
        assert work == near(f * LOAD_N * sliding_m_s / speed_m_s, rel=1e-12)
    if model == POLACH:
        without_recovery = law._replace(tau_m_J=0.0)
        expected, *_ = adhesion.wheel_adhesion(
            sliding_m_s, speed_m_s, LOAD_N, patch, without_recovery
        )
        assert f == near(expected, rel=1e-12)


def test_an_unknown_model_is_refused_with_the_allowed_ones():
    with pytest.raises(Exception, match=re.escape("fastsim")):
        scenario.load("velim_a1", settings=("contact.model=fastsimm",))


def test_the_patch_has_the_grid_of_fastsim():
    coarse = RAIL_PATCH._replace(cells=4)
    fine = RAIL_PATCH._replace(cells=60)
    coarse_force = force(FASTSIM, 2e-3, 0, 1.0, coarse)
    fine_force = force(FASTSIM, 2e-3, 0, 1.0, fine)
    assert coarse_force[0] != fine_force[0]
