"""Polach's creep force: its laws, and its distance to the half-space program CONTACT."""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from contact_program import results_without_spin

from rollerrig.rig.contact import polach

near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small


class Friction(NamedTuple):
    """The parameters of falling friction, in the order of the kernels."""

    mu_c: float
    A: float
    gamma_s_m: float


CLEAN = Friction(mu_c=0.28, A=0.4, gamma_s_m=0.6)
CONTAMINATED = Friction(mu_c=0.06, A=0.4, gamma_s_m=0.2)

# a patch, its material and its load
A_M = 5.7e-3
B_M = 4.4e-3
C11 = 4.59
SHEAR_PA = 8e10
LOAD_N = 5e4

# creepage and sliding m/s of some contacts
CONTACTS = [(1e-4, 1e-3), (0.01, 0.1), (0.05, 1.0), (0.9, 8.0)]
EPS_PER_CREEPAGE = 140.0


def adhesion(eps, mu, k_a, k_s):
    """Return the force over the load at a stress gradient."""
    shape, _ = polach.shape(eps, k_a, k_s)
    return mu * shape


def slope(eps, mu, k_a, k_s):
    """Return the derivative of `adhesion` to eps."""
    _, shape_slope = polach.shape(eps, k_a, k_s)
    return mu * shape_slope


def difference_quotient(function, x, h):
    return (function(x + h) - function(x - h)) / (2.0 * h)


def test_without_spin_the_force_stays_within_0_08_mu_N_of_contact():
    distances = []
    for result in results_without_spin():
        pull = np.array((result.c11 * result.xi, result.c22 * result.eta))
        size = np.hypot(*pull)
        eps_mu = polach.eps_per_creepage(
            result.a_m, result.b_m, size, result.shear_Pa, result.load_N
        )
        eps = eps_mu / result.mu
        force = -adhesion(eps, result.mu, 1.0, 1.0) / result.mu * pull / size
        distances.append(result.distance(*force))
    assert len(distances) == 25
    assert max(distances) < 0.055  # 0.08 is required
    assert np.mean(distances) < 0.018


def test_at_vanishing_creepage_the_force_is_kalkers():
    mu = 0.3
    creepage = 1e-9
    eps = polach.eps_per_creepage(A_M, B_M, C11, SHEAR_PA, LOAD_N) * creepage / mu
    kalker_N = SHEAR_PA * A_M * B_M * C11 * creepage
    assert adhesion(eps, mu, 1.0, 1.0) * LOAD_N == near(kalker_N, rel=1e-6)


def test_eps_follows_from_the_papers_contact_stiffness():
    # paper eqs. 12 and 14: eps = 2 C pi a^2 b e / (3 mu N), C = 3 G c11 / (8 a)
    stiffness = 3.0 * SHEAR_PA * C11 / (8.0 * A_M)
    paper = 2.0 / 3.0 * stiffness * math.pi * A_M * A_M * B_M / LOAD_N
    assert polach.eps_per_creepage(A_M, B_M, C11, SHEAR_PA, LOAD_N) == near(paper, rel=1e-14)


def test_friction_falls_from_the_static_to_the_sliding_value_in_both_directions():
    static = CONTAMINATED.mu_c / CONTAMINATED.A
    assert polach.friction(0.0, *CONTAMINATED) == near(static, rel=1e-15)
    assert polach.friction(math.inf, *CONTAMINATED) == CONTAMINATED.mu_c
    values = [polach.friction(sliding, *CLEAN) for sliding in np.linspace(0.0, 30.0, 100)]
    assert values == sorted(values, reverse=True)
    assert polach.friction(-3.0, *CLEAN) == polach.friction(3.0, *CLEAN)


@pytest.mark.parametrize("sliding_m_s", [0.0, 1.0, -40.0, math.inf])
def test_friction_without_decay_does_not_change(sliding_m_s):
    without_decay = CONTAMINATED._replace(gamma_s_m=0.0)
    at_rest = polach.friction(0.0, *without_decay)
    assert polach.friction(sliding_m_s, *without_decay) == at_rest
    equal_ends = CONTAMINATED._replace(A=1.0)
    assert polach.friction(sliding_m_s, *equal_ends) == CONTAMINATED.mu_c


def test_the_force_is_odd_and_bounded_by_friction():
    for eps in np.geomspace(1e-12, 1e12, 97):
        f = adhesion(eps, 0.2, 1.0, 0.4)
        assert adhesion(-eps, 0.2, 1.0, 0.4) == -f
        assert 0.0 < f <= 0.2


@pytest.mark.parametrize(("k_a", "k_s"), [(1.0, 1.0), (1.0, 0.4), (0.3, 0.1)])
def test_the_force_rises_steadily_to_full_sliding(k_a, k_s):
    values = [adhesion(eps, 0.2, k_a, k_s) for eps in np.geomspace(1e-4, 1e3, 400)]
    assert (np.diff(values) > 0.0).all()
    assert adhesion(1e20, 0.2, k_a, k_s) == near(0.2, rel=1e-15)


@pytest.mark.parametrize("eps", [-30.0, -1.0, 0.0, 1e-3, 0.7, 5.0, 300.0])
def test_the_slopes_are_the_derivatives(eps):
    def force(x):
        return adhesion(x, 0.2, 0.3, 0.1)

    expected = difference_quotient(force, eps, 1e-5 * max(abs(eps), 1e-3))
    assert slope(eps, 0.2, 0.3, 0.1) == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(("creepage", "sliding_m_s"), CONTACTS)
def test_the_curve_gives_the_force_and_its_slopes_to_sliding_and_creepage(creepage, sliding_m_s):
    def force(sliding, creep):
        return polach.curve(sliding, creep, EPS_PER_CREEPAGE, *CLEAN, 1.0, 0.4)[0]

    f, by_sliding, by_creepage = polach.curve(
        sliding_m_s, creepage, EPS_PER_CREEPAGE, *CLEAN, 1.0, 0.4
    )
    mu = polach.friction(sliding_m_s, *CLEAN)
    assert f == near(adhesion(EPS_PER_CREEPAGE * creepage / mu, mu, 1.0, 0.4), rel=1e-14)

    expected = difference_quotient(lambda x: force(x, creepage), sliding_m_s, 1e-5 * sliding_m_s)
    assert by_sliding == pytest.approx(expected, rel=1e-6, abs=1e-9)
    expected = difference_quotient(lambda x: force(sliding_m_s, x), creepage, 1e-5 * creepage)
    assert by_creepage == near(expected, rel=1e-6)


def test_a_frictionless_contact_transmits_nothing():
    frictionless = CLEAN._replace(mu_c=0.0)
    assert polach.curve(1.0, 0.1, EPS_PER_CREEPAGE, *frictionless, 1.0, 0.4) == (0.0, 0.0, 0.0)
    assert adhesion(5.0, 0.0, 1.0, 0.4) == 0.0


@pytest.mark.parametrize("load_N", [0.0, -1.0])
def test_an_unloaded_contact_has_no_stress_gradient(load_N):
    assert polach.eps_per_creepage(A_M, B_M, C11, SHEAR_PA, load_N) == 0.0


@pytest.mark.parametrize("eps", [0.0, 5e-324, 1e154, 1e308, math.inf, -math.inf])
@pytest.mark.parametrize(("k_a", "k_s"), [(0.0, 0.0), (1.0, 0.4), (1e10, 1e10)])
def test_infinite_and_zero_inputs_give_no_nan(eps, k_a, k_s):
    assert not math.isnan(adhesion(eps, 0.3, k_a, k_s))
    assert not math.isnan(slope(eps, 0.3, k_a, k_s))
    assert not np.isnan(polach.curve(math.inf, abs(eps), 1.0, 0.3, 0.4, 0.6, k_a, k_s)).any()


@pytest.mark.parametrize(("creepage", "sliding_m_s"), [(0.0, 0.0), (1e-4, 1e-3), *CONTACTS[2:]])
def test_plain_python_agrees_with_the_compiled_kernels(creepage, sliding_m_s):
    inputs = (sliding_m_s, creepage, EPS_PER_CREEPAGE, *CLEAN, 1.0, 0.4)
    assert polach.curve.py_func(*inputs) == near(polach.curve(*inputs), rel=1e-14)
