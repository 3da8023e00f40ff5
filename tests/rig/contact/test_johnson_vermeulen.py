"""Kalker's linear force with Johnson and Vermeulen's saturation."""

import math
from functools import partial

import numpy as np
import pytest
from contact_program import contact_curves

from rollerrig.rig.contact import johnson_vermeulen
from rollerrig.rig.contact.patch import patch_for

near = partial(pytest.approx, abs=0.0)
PATCH = patch_for(0.445, math.inf, 0.3, 2.1e11, 2.1e11 / 2.6, 0.3)


def test_without_spin_the_force_stays_within_0_08_mu_N_of_contact():
    distances = []
    for row in contact_curves():
        if row["phi_1_per_m"] != 0.0:
            continue
        fx, fy, _ = johnson_vermeulen.force(row["xi"], row["eta"], 0.0, row["mu"], row["N"], PATCH)
        unit = row["mu"] * row["N"]
        distances.append(math.hypot(fx / unit - row["CONTACT_fx"], fy / unit - row["CONTACT_fy"]))
    assert len(distances) == 25
    assert max(distances) < 0.05  # 0.08 is required
    assert np.mean(distances) < 0.011


def test_the_linear_force_is_kalkers_with_the_patch_growing_with_load():
    # a load of 8 kN, the cube of 20
    a = PATCH.a1 * 20.0
    b = PATCH.b1 * 20.0
    G = PATCH.shear_Pa
    ab = a * b
    fx, fy = johnson_vermeulen.linear(1e-4, -2e-4, 0.05, a, b, PATCH)
    assert fx == near(-G * ab * PATCH.c11 * 1e-4, rel=1e-12)
    assert fy == near(-G * ab * (-PATCH.c22 * 2e-4 + math.sqrt(ab) * PATCH.c23 * 0.05), rel=1e-12)
    mz = johnson_vermeulen.force(1e-8, -2e-8, 5e-6, 0.3, 8000.0, PATCH)[2]
    linear = -G * ab**1.5 * PATCH.c23 * 2e-8 - G * ab**2 * PATCH.c33 * 5e-6
    assert mz == near(linear, rel=1e-3)


def test_the_cubic_meets_the_limit_with_its_value_and_slope():
    u = np.array((3.0 - 1e-6, 3.0, 3.0 + 1e-6))
    whole = [v * johnson_vermeulen.reduction(v) for v in u]
    assert whole == pytest.approx([1.0] * 3, abs=1e-12)
    assert johnson_vermeulen.reduction(0.0) == 1.0


def test_the_force_never_exceeds_the_friction_limit():
    rng = np.random.default_rng(4)
    for xi, eta, phi in rng.normal(0.0, (5e-3, 5e-3, 1.0), (300, 3)):
        fx, fy, _ = johnson_vermeulen.force(xi, eta, phi, 0.2, 4e4, PATCH)
        assert math.hypot(fx, fy) <= 0.2 * 4e4 * (1.0 + 1e-12)


@pytest.mark.parametrize("tiny", [1e-300, 1e-160, 5e-324])
def test_creepage_too_small_to_be_squared_gives_no_force_and_no_nan(tiny):
    for creep in ((tiny, tiny, 0.0), (0.0, tiny, 0.0), (tiny, 0.0, tiny), (-tiny, -tiny, tiny)):
        assert np.abs(johnson_vermeulen.force(*creep, 0.3, 8000.0, PATCH)).max() < 1e-140


def test_there_is_no_force_without_load_or_friction():
    assert johnson_vermeulen.force(1e-3, 0, 0, 0.3, 0.0, PATCH) == (0.0, 0.0, 0.0)
    assert johnson_vermeulen.force(1e-3, 0, 0, 0.0, 1e4, PATCH) == (0.0, 0.0, 0.0)
