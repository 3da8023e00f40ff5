"""The vectorised law and its mathematics, compared with the law itself and with the C library."""

import numpy as np
import pytest
from paper_law import TABLE_4

from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import adhesion, vector_law, vector_secant
from rollerrig.rig.contact.patch import patch_for

PATCH = patch_for(0.445, 1.0, 0.3, 2.1e11, 8.0e10, 0.3)
# of 400 random contacts so many are inside the domain
MOST = 300


# inlined kernels can be called by kernels only
@kernel
def exp(x):
    return vector_math.exp(x)


@kernel
def expm1(x):
    return vector_math.expm1(x)


@kernel
def atan(x):
    return vector_math.atan(x)


@kernel
def log(x):
    return vector_math.log(x)


@kernel
def sin(x):
    return vector_math.sin(x)


@kernel
def cos(x):
    return vector_math.cos(x)


@kernel
def inverse_cube_root(u):
    return vector_math.inverse_cube_root(u)


@kernel
def recovered_adhesion(sliding, speed, load, patch, law):
    """Return (f, lambda, inside) of one wheel by `vector_secant` and `vector_law`."""
    decay_d = 1.0 / law.A_d - 1.0
    decay_r = 1.0 / law.A_r - 1.0
    mu_d, mu_r, eps_mu, k, _ = vector_secant.frictions(
        sliding, speed, load, patch.eps1, decay_d, decay_r, law
    )
    f_d, f_r = vector_secant.curves(mu_d, mu_r, eps_mu, law)
    return vector_law.recovered(f_d, f_r, k)


def laws():
    for mu_cd in (0.01, 0.03, 0.06, 0.12, 0.25):
        for tau_m_J in (0.0, 1e-6, 1.9e-4, 5e-3):
            yield TABLE_4._replace(mu_cd=mu_cd, tau_m_J=tau_m_J)


def contacts():
    """Yield random contacts (sliding m/s, speed m/s, load N), from micro-slip to a lock."""
    rng = np.random.default_rng(5)
    for _ in range(400):
        speed = 10.0 ** rng.uniform(-1.0, 2.0)
        sliding = speed * 10.0 ** rng.uniform(-7.0, 0.0)
        yield sliding, speed, 10.0 ** rng.uniform(4.2, 5.2)


@pytest.mark.parametrize("law", list(laws()))
def test_within_its_domain_the_vectorised_law_is_the_law(law):
    inside = 0
    for sliding, speed, load in contacts():
        f, _, is_inside = recovered_adhesion(sliding, speed, load, PATCH, law)
        if is_inside:
            inside += 1
            exact = adhesion.wheel_adhesion(sliding, speed, load, PATCH, law)[0]
            assert f == pytest.approx(exact, rel=2e-12)
    assert inside > MOST


def test_a_contaminant_that_sliding_makes_worse_is_outside_the_domain():
    law = TABLE_4._replace(
        mu_cd=0.28, mu_cr=0.06, gamma_r_s_m=0.2, k_ad=1.0, k_sd=0.4, k_ar=0.3, k_sr=0.1
    )
    assert recovered_adhesion(1.0, 30.0, 5e4, PATCH, law)[2] == 0.0


def test_nan_is_outside_the_domain():
    law = next(laws())
    assert recovered_adhesion(np.nan, 30.0, 5e4, PATCH, law)[2] == 0.0


NEAR_ZERO = np.logspace(-9, 2.8, 3000)
ANGLES = np.linspace(-1.5, 1.5, 3001)


@pytest.mark.parametrize(
    ("ours", "librarys", "x"),
    [
        (exp, np.exp, np.concatenate([-NEAR_ZERO, np.linspace(-3.0, 3.0, 3001)])),
        (atan, np.arctan, np.concatenate([np.logspace(-12, 12, 4000), -np.logspace(-12, 12, 500)])),
        (
            log,
            np.log,
            np.concatenate([np.logspace(-300, -0.001, 3000), np.logspace(0.001, 300, 3000)]),
        ),
    ],
    ids=["exp", "atan", "log"],
)
def test_a_function_agrees_with_the_library_to_the_last_digits(ours, librarys, x):
    found = np.array([ours(float(value)) for value in x])
    assert np.abs(found / librarys(x) - 1.0).max() < 5e-16


def test_expm1_agrees_with_the_library_to_the_last_digits():
    x = np.concatenate([-NEAR_ZERO, np.linspace(0.001, 3.0, 3001)])
    found = np.array([expm1(float(value)) for value in x])
    np.testing.assert_allclose(found, np.expm1(x), rtol=1e-15)


@pytest.mark.parametrize(
    ("ours", "librarys", "tolerance"),
    # the first term that the series of cos leaves out is 1.5**18 / 18!
    [(sin, np.sin, 1e-13), (cos, np.cos, 3e-13)],
    ids=["sin", "cos"],
)
def test_sine_and_cosine_agree_with_the_library_up_to_a_quarter_turn(ours, librarys, tolerance):
    found = np.array([ours(float(value)) for value in ANGLES])
    np.testing.assert_allclose(found, librarys(ANGLES), rtol=0.0, atol=tolerance)


def test_an_angle_beyond_a_quarter_turn_is_no_number():
    assert np.isnan(sin(1.6))
    assert np.isnan(cos(-1.6))


def test_the_inverse_cube_root_is_exact_over_its_range():
    u = np.linspace(vector_law.LIGHTER, vector_law.HEAVIER, 3000)
    found = np.array([inverse_cube_root(float(value)) for value in u])
    assert np.abs(found * np.cbrt(u) - 1.0).max() < 1e-14
