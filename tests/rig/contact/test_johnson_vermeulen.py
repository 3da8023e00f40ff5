"""Kalker's linear force with Johnson and Vermeulen's saturation."""

import math
from functools import partial

import numpy as np
import pytest
from contact_program import CONTACT_PATCH as PATCH
from contact_program import results_without_spin

from rollerrig.rig.contact import johnson_vermeulen

near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small


def test_without_spin_the_force_stays_within_0_08_mu_N_of_contact():
    distances = []
    for result in results_without_spin():
        fx, fy, _ = johnson_vermeulen.force(
            result.xi, result.eta, 0.0, result.mu, result.load_N, PATCH
        )
        limit_N = result.mu * result.load_N
        distances.append(result.distance(fx / limit_N, fy / limit_N))
    assert len(distances) == 25
    assert max(distances) < 0.05  # 0.08 is required
    assert np.mean(distances) < 0.011


def test_the_linear_force_is_kalkers_with_the_patch_growing_with_load():
    load_N = 8000.0
    growth = 20.0  # the cube root of the load
    a_m = PATCH.a1 * growth
    b_m = PATCH.b1 * growth
    G_ab = PATCH.shear_Pa * a_m * b_m
    size_m = math.sqrt(a_m * b_m)

    fx, fy = johnson_vermeulen.linear(1e-4, -2e-4, 0.05, a_m, b_m, PATCH)
    assert fx == near(-G_ab * PATCH.c11 * 1e-4, rel=1e-12)
    assert fy == near(-G_ab * (-PATCH.c22 * 2e-4 + size_m * PATCH.c23 * 0.05), rel=1e-12)

    _, _, mz = johnson_vermeulen.force(1e-8, -2e-8, 5e-6, 0.3, load_N, PATCH)
    by_creepage = -G_ab * size_m * PATCH.c23 * 2e-8
    by_spin = -G_ab * size_m**2 * PATCH.c33 * 5e-6
    assert mz == near(by_creepage + by_spin, rel=1e-3)


@pytest.mark.parametrize("u", [3.0 - 1e-6, 3.0, 3.0 + 1e-6])
def test_the_cubic_meets_the_limit_with_its_value_and_slope(u):
    assert u * johnson_vermeulen.reduction(u) == pytest.approx(1.0, abs=1e-12)
    assert johnson_vermeulen.reduction(0.0) == 1.0


def test_the_force_never_exceeds_the_friction_limit():
    rng = np.random.default_rng(4)
    limit_N = 0.2 * 4e4
    for xi, eta, phi_1_m in rng.normal(0.0, (5e-3, 5e-3, 1.0), (300, 3)):
        fx, fy, _ = johnson_vermeulen.force(xi, eta, phi_1_m, 0.2, 4e4, PATCH)
        assert math.hypot(fx, fy) <= limit_N * (1.0 + 1e-12)


@pytest.mark.parametrize("tiny", [1e-300, 1e-160, 5e-324])
def test_creepage_too_small_to_be_squared_gives_no_force_and_no_nan(tiny):
    for creepages_and_spin in (
        (tiny, tiny, 0.0),
        (0.0, tiny, 0.0),
        (tiny, 0.0, tiny),
        (-tiny, -tiny, tiny),
    ):
        force = johnson_vermeulen.force(*creepages_and_spin, 0.3, 8000.0, PATCH)
        assert np.abs(force).max() < 1e-140


def test_there_is_no_force_without_load_or_friction():
    assert johnson_vermeulen.force(1e-3, 0, 0, 0.3, 0.0, PATCH) == (0.0, 0.0, 0.0)
    assert johnson_vermeulen.force(1e-3, 0, 0, 0.0, 1e4, PATCH) == (0.0, 0.0, 0.0)
