"""The vectorised law against the law itself."""

import numpy as np
import pytest
from paper_law import TABLE_4

from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact import vector_law as fast
from rollerrig.rig.contact.patch import patch_for

PATCH = patch_for(0.445, 1.0, 0.3, 2.1e11, 8.0e10, 0.3)


@kernel
def exponential(x):
    return vector_math.exp(x)


@kernel
def arc_tangent(x):
    return vector_math.atan(x)


@kernel
def logarithm(x):
    return vector_math.log(x)


@kernel
def inverse_cube_root(u):
    return vector_math.inverse_cube_root(u)


@kernel
def adhesion_of(sliding, speed, load, patch, law):
    at = fast.eps_mu(sliding, speed, load, patch.eps1)
    f_d = fast.curve(sliding, at, law.mu_cd, law.A_d, law.gamma_d_s_m, law.k_ad, law.k_sd)
    f_r = fast.curve(sliding, at, law.mu_cr, law.A_r, law.gamma_r_s_m, law.k_ar, law.k_sr)
    creepage = sliding / max(abs(speed), adhesion.SPEED_FLOOR_M_S)
    return fast.recovered(f_d, f_r, law.tau_m_J * load * creepage)


def laws():
    for mu_cd in (0.01, 0.03, 0.06, 0.12, 0.25):
        for tau_m_J in (0.0, 1e-6, 1.9e-4, 5e-3):
            yield TABLE_4._replace(mu_cd=mu_cd, tau_m_J=tau_m_J)


def contacts():
    rng = np.random.default_rng(5)
    for _ in range(400):
        speed = 10.0 ** rng.uniform(-1.0, 2.0)
        yield speed * 10.0 ** rng.uniform(-7.0, 0.0), speed, 10.0 ** rng.uniform(4.2, 5.2)


@pytest.mark.parametrize("law", list(laws()))
def test_within_its_domain_the_fast_law_is_the_law(law):
    inside = 0
    for sliding, speed, load in contacts():
        f, _, trusted = adhesion_of(sliding, speed, load, PATCH, law)
        if trusted:
            inside += 1
            expected = adhesion.wheel_adhesion(sliding, speed, load, PATCH, law)[0]
            assert f == pytest.approx(expected, rel=2e-12)
    assert inside > 300


def test_a_contaminant_that_sliding_makes_worse_is_outside_the_domain():
    law = TABLE_4._replace(
        mu_cd=0.28, mu_cr=0.06, gamma_r_s_m=0.2, k_ad=1.0, k_sd=0.4, k_ar=0.3, k_sr=0.1
    )
    assert adhesion_of(1.0, 30.0, 5e4, PATCH, law)[2] == 0.0


def test_nan_is_outside_the_domain():
    law = next(laws())
    assert adhesion_of(np.nan, 30.0, 5e4, PATCH, law)[2] == 0.0


@pytest.mark.parametrize(
    ("function", "reference", "x"),
    [
        (
            exponential,
            np.exp,
            np.concatenate([-np.logspace(-9, 2.8, 3000), np.linspace(-3.0, 3.0, 3001)]),
        ),
        (arc_tangent, np.arctan, np.logspace(-12, 12, 4000)),
        (
            logarithm,
            np.log,
            np.concatenate([np.logspace(-300, -0.001, 3000), np.logspace(0.001, 300, 3000)]),
        ),
    ],
)
def test_the_functions_agree_with_the_library_to_the_last_digits(function, reference, x):
    values = np.array([function(float(value)) for value in x])
    assert np.abs(values / reference(x) - 1.0).max() < 5e-16


def test_the_cube_root_holds_over_its_range():
    u = np.linspace(fast.LIGHTER, fast.HEAVIER, 3000)
    roots = np.array([inverse_cube_root(float(value)) for value in u])
    assert np.abs(roots * np.cbrt(u) - 1.0).max() < 1e-14
