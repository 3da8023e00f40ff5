"""Polach's creep force: its laws, and its distance to the half-space program CONTACT."""

import math
from functools import partial

import numpy as np
import pytest
from contact_program import contact_curves

from rollerrig.rig.contact import polach

near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small


def adhesion(eps, mu, k_a, k_s):
    return mu * polach.shape(eps, k_a, k_s)[0]


def slope_of(eps, mu, k_a, k_s):
    return mu * polach.shape(eps, k_a, k_s)[1]


def test_without_spin_the_force_stays_within_0_08_mu_N_of_contact():
    distances = []
    for row in contact_curves():
        if row["phi_1_per_m"] != 0.0:
            continue
        pull = np.array((row["c11"] * row["xi"], row["c22"] * row["eta"]))
        a_m = row["a_mm"] * 1e-3
        b_m = row["b_mm"] * 1e-3
        shear_Pa = row["G_GPa"] * 1e9
        eps = polach.eps_per_creepage(a_m, b_m, np.hypot(*pull), shear_Pa, row["N"]) / row["mu"]
        force = -adhesion(eps, row["mu"], 1.0, 1.0) / row["mu"] * pull / np.hypot(*pull)
        distances.append(np.hypot(*(force - (row["CONTACT_fx"], row["CONTACT_fy"]))))
    assert len(distances) == 25
    assert max(distances) < 0.055  # 0.08 is required
    assert np.mean(distances) < 0.018


def test_at_vanishing_creepage_the_force_is_kalkers():
    a, b, c11, shear, load, creepage = 5.7e-3, 4.4e-3, 4.59, 8e10, 5e4, 1e-9
    eps = polach.eps_per_creepage(a, b, c11, shear, load) * creepage / 0.3
    kalker_force = shear * a * b * c11 * creepage
    assert adhesion(eps, 0.3, 1.0, 1.0) * load == near(kalker_force, rel=1e-6)


def test_eps_follows_from_the_papers_contact_stiffness():
    # paper eqs. 12 and 14: eps = 2 C pi a^2 b e / (3 mu N), C = 3 G c11 / (8 a)
    a, b, c11, shear, load = 5.7e-3, 4.4e-3, 4.59, 8e10, 5e4
    stiffness = 3.0 * shear * c11 / (8.0 * a)
    paper = 2.0 / 3.0 * stiffness * math.pi * a * a * b / load
    assert polach.eps_per_creepage(a, b, c11, shear, load) == near(paper, rel=1e-14)


def test_friction_falls_from_the_static_to_the_sliding_value_in_both_directions():
    assert polach.friction(0.0, 0.06, 0.4, 0.2) == near(0.15, rel=1e-15)
    assert polach.friction(math.inf, 0.06, 0.4, 0.2) == 0.06
    values = [polach.friction(s, 0.28, 0.4, 0.6) for s in np.linspace(0.0, 30.0, 100)]
    assert values == sorted(values, reverse=True)
    assert polach.friction(-3.0, 0.28, 0.4, 0.6) == polach.friction(3.0, 0.28, 0.4, 0.6)


def test_friction_without_decay_does_not_change():
    for sliding in (0.0, 1.0, -40.0, math.inf):
        assert polach.friction(sliding, 0.06, 0.4, 0.0) == polach.friction(0.0, 0.06, 0.4, 0.0)
        assert polach.friction(sliding, 0.06, 1.0, 0.2) == 0.06


def test_the_force_is_odd_and_bounded_by_friction():
    for eps in np.geomspace(1e-12, 1e12, 97):
        f = adhesion(eps, 0.2, 1.0, 0.4)
        assert adhesion(-eps, 0.2, 1.0, 0.4) == -f
        assert 0.0 < f <= 0.2


def test_the_force_rises_steadily_to_full_sliding():
    for k_a, k_s in ((1.0, 1.0), (1.0, 0.4), (0.3, 0.1)):
        values = [adhesion(eps, 0.2, k_a, k_s) for eps in np.geomspace(1e-4, 1e3, 400)]
        assert (np.diff(values) > 0.0).all()
        assert adhesion(1e20, 0.2, k_a, k_s) == near(0.2, rel=1e-15)


def test_the_slopes_are_the_derivatives():
    for eps in (-30.0, -1.0, 0.0, 1e-3, 0.7, 5.0, 300.0):
        h = 1e-5 * max(abs(eps), 1e-3)
        ends = [adhesion(eps + d, 0.2, 0.3, 0.1) for d in (-h, h)]
        slope = slope_of(eps, 0.2, 0.3, 0.1)
        assert slope == pytest.approx((ends[1] - ends[0]) / (2.0 * h), rel=1e-6, abs=1e-12)


def test_the_curve_gives_the_force_and_its_slopes_to_sliding_and_creepage():
    unit = 140.0
    law = (0.28, 0.4, 0.6, 1.0, 0.4)
    for sliding, creepage in ((1e-3, 1e-4), (0.1, 0.01), (1.0, 0.05), (8.0, 0.9)):
        f, by_sliding, by_creepage = polach.curve(sliding, creepage, unit, *law)
        mu = polach.friction(sliding, *law[:3])
        assert f == near(adhesion(unit * creepage / mu, mu, 1.0, 0.4), rel=1e-14)
        h = 1e-5 * sliding
        d = 1e-5 * creepage
        ends = [polach.curve(sliding + x, creepage, unit, *law)[0] for x in (-h, h)]
        assert by_sliding == pytest.approx((ends[1] - ends[0]) / (2.0 * h), rel=1e-6, abs=1e-9)
        ends = [polach.curve(sliding, creepage + x, unit, *law)[0] for x in (-d, d)]
        assert by_creepage == near((ends[1] - ends[0]) / (2.0 * d), rel=1e-6)


def test_a_frictionless_contact_transmits_nothing():
    assert polach.curve(1.0, 0.1, 140.0, 0.0, 0.4, 0.6, 1.0, 0.4) == (0.0, 0.0, 0.0)
    assert adhesion(5.0, 0.0, 1.0, 0.4) == 0.0


@pytest.mark.parametrize("load", [0.0, -1.0])
def test_an_unloaded_contact_has_no_stress_gradient(load):
    assert polach.eps_per_creepage(5e-3, 4e-3, 4.0, 8e10, load) == 0.0


@pytest.mark.parametrize("eps", [0.0, 5e-324, 1e154, 1e308, math.inf, -math.inf])
@pytest.mark.parametrize(("k_a", "k_s"), [(0.0, 0.0), (1.0, 0.4), (1e10, 1e10)])
def test_infinite_and_zero_inputs_give_no_nan(eps, k_a, k_s):
    assert not math.isnan(adhesion(eps, 0.3, k_a, k_s))
    assert not math.isnan(slope_of(eps, 0.3, k_a, k_s))
    assert not np.isnan(polach.curve(math.inf, abs(eps), 1.0, 0.3, 0.4, 0.6, k_a, k_s)).any()


def test_plain_python_agrees_with_the_compiled_kernels():
    for sliding, creepage in ((0.0, 0.0), (1e-3, 1e-4), (1.0, 0.05), (8.0, 0.9)):
        inputs = (sliding, creepage, 140.0, 0.28, 0.4, 0.6, 1.0, 0.4)
        assert polach.curve.py_func(*inputs) == near(polach.curve(*inputs), rel=1e-14)
