"""Hertz contact against exact integrals, published patches and the laws of similarity."""

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipkm1

from rollerrig.rig.contact import hertz

DATA = Path(__file__).parents[2] / "data"
near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small
E = 2.1e11
NU = 0.3
CURVATURES = [(1.1, 1.7), (1.7, 1.1), (0.5, 40.0), (40.0, 0.5), (1.0, 1.0 + 1e-9), (3e-4, 9e3)]


@pytest.mark.parametrize("row", np.genfromtxt(DATA / "hertz.csv", delimiter=",", skip_header=1))
def test_the_patch_agrees_with_the_reference_table_to_its_printed_digits(row):
    A, B = hertz.curvatures(*row[:3])
    a, b, pressure, approach = hertz.semi_axes(A, B, row[3], E, NU)
    k_h = hertz.stiffness(A, B, E, NU)
    results = (A, B, a * 1e3, b * 1e3, pressure * 1e-9, approach * 1e6, k_h)
    assert results == near(tuple(row[4:]), rel=6e-8)


def test_a_patch_of_another_material_agrees_with_the_case_published_with_contact():
    # case "tractcurv" of CONTACT: 106.7 kN, r = 0.625 m on a rail, G = 82 GPa, nu = 0.28
    young = 2.0 * 82e9 * 1.28
    nu = 0.28

    def excess(B):
        a, b, _, _ = hertz.semi_axes(0.8, B, 106.7e3, young, nu)
        return a / b - 6.304 / 12.61

    B = brentq(excess, 0.01, 0.79)
    a, b, pressure, _ = hertz.semi_axes(0.8, B, 106.7e3, young, nu)
    assert (a * 1e3, b * 1e3, pressure * 1e-6) == near((6.304, 12.61, 640.7), rel=1e-3)


@pytest.mark.parametrize(("A", "B"), CURVATURES)
def test_the_shape_of_the_ellipse_satisfies_hertz_equation_for_the_curvatures(A, B):
    a, b, pressure, _ = hertz.semi_axes(A, B, 5e4, E, NU)
    major = max(a, b)
    minor = min(a, b)
    small = min(A, B)
    large = max(A, B)
    square = (minor / major) ** 2
    K = ellipkm1(square)
    second = ellipe(1.0 - square)
    scale = pressure * 2.0 * (1.0 - NU**2) / E * minor / (major**2 - minor**2)
    # scipy's K - E cancels where the patch is round
    loss = 1e-11 if 1.0 - square > 1e-2 else 1e-5
    assert scale * (K - second) == near(small, rel=loss)
    assert scale * (second / square - K) == near(large, rel=loss)


@pytest.mark.parametrize("kappa", [1e-8, 1e-3, 0.3, 0.9, 1.0 - 1e-9, 1.0])
def test_the_elliptic_integrals_agree_with_scipy(kappa):
    first, difference = hertz.elliptic_integrals(kappa)
    m = (1.0 - kappa) * (1.0 + kappa)
    assert first == near(ellipkm1(kappa**2), rel=1e-14)
    assert first - m * difference == near(ellipe(m), rel=1e-14)


def test_the_second_integral_keeps_its_digits_where_the_patch_is_nearly_round():
    for kappa in (1.0, 1.0 - 1e-12, 1.0 - 1e-7, 1.0 - 1e-5):
        m = (1.0 - kappa) * (1.0 + kappa)
        series = math.pi / 4.0 * (1.0 + 3.0 / 8.0 * m + 15.0 / 64.0 * m * m)
        assert hertz.elliptic_integrals(kappa)[1] == near(series, rel=1e-14)


@pytest.mark.parametrize("ratio", [1.0, 1.0 + 1e-14, 1.0 + 1e-7, 1.4839, 50.0, 1e6, 1e12, 1e100])
def test_the_axis_ratio_solves_its_equation_for_any_ratio_of_curvatures(ratio):
    kappa, K, D = hertz.axis_ratio(ratio)
    assert 0.0 < kappa <= 1.0
    assert (K - D) / D / kappa / kappa == near(ratio, rel=1e-12)


def test_equal_curvatures_give_the_circle_of_the_closed_form():
    a, b, pressure, approach = hertz.semi_axes(1.25, 1.25, 6e4, E, NU)
    radius = 0.4
    modulus = E / 2.0 / (1.0 - NU**2)
    assert a == b
    assert a == near((0.75 * 6e4 * radius / modulus) ** (1.0 / 3.0), rel=1e-14)
    assert approach == near(a * a / radius, rel=1e-14)
    assert pressure == near(1.5 * 6e4 / (math.pi * a * a), rel=1e-14)


@pytest.mark.parametrize(("A", "B"), CURVATURES)
def test_exchanging_the_directions_exchanges_the_semi_axes(A, B):
    a, b, pressure, approach = hertz.semi_axes(A, B, 5e4, E, NU)
    assert hertz.semi_axes(B, A, 5e4, E, NU) == (b, a, pressure, approach)
    assert (a > b) == (A < B)


@pytest.mark.parametrize(("A", "B"), CURVATURES)
@pytest.mark.parametrize("load", [1e-6, 1.0, 5.27e4, 1e7])
def test_pressure_carries_the_load_and_the_approach_follows_the_stiffness(A, B, load):
    a, b, pressure, approach = hertz.semi_axes(A, B, load, E, NU)
    assert 2.0 / 3.0 * math.pi * a * b * pressure == near(load, rel=1e-13)
    assert hertz.stiffness(A, B, E, NU) * approach**1.5 == near(load, rel=1e-13)


def test_the_semi_axes_grow_with_the_cube_root_of_the_load():
    light = hertz.semi_axes(1.1, 1.7, 1e4, E, NU)
    heavy = hertz.semi_axes(1.1, 1.7, 8e4, E, NU)
    assert heavy[:3] == near([2.0 * value for value in light[:3]], rel=1e-14)
    assert heavy[3] == near(4.0 * light[3], rel=1e-14)


def test_a_roller_of_infinite_radius_is_a_rail_bit_for_bit():
    rail = (0.5 * (1.0 / 0.445), 0.5 / 0.3)
    assert hertz.curvatures(0.445, math.inf, 0.3) == rail
    assert hertz.curvatures(0.445, 1e300, 0.3) == rail


def test_a_smaller_roller_shortens_the_patch_and_raises_the_pressure():
    patches = [
        hertz.semi_axes(*hertz.curvatures(0.445, radius, 0.3), 52.7e3, E, NU)
        for radius in (math.inf, 2.0, 1.0, 0.5, 0.25)
    ]
    a, b, pressure, _ = np.array(patches).T
    assert (np.diff(a) <= 0.0).all()
    assert (np.diff(b) >= 0.0).all()
    assert (np.diff(pressure) >= 0.0).all()


@pytest.mark.parametrize("load", [0.0, -0.0, -1.0, -math.inf])
def test_without_load_there_is_no_patch(load):
    assert hertz.semi_axes(1.1, 1.7, load, E, NU) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("A", "B"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (math.nan, 1.0)])
def test_without_curvature_there_is_no_ellipse(A, B):
    assert hertz.semi_axes(A, B, 5e4, E, NU) == (0.0, 0.0, 0.0, 0.0)
    assert hertz.stiffness(A, B, E, NU) == 0.0


@pytest.mark.parametrize("load", [5e-324, 1.0, math.inf])
@pytest.mark.parametrize(("A", "B"), [(1e-300, 1.0), (1e-12, 1e12), (1.0, 1.0)])
def test_extreme_inputs_give_no_nan(A, B, load):
    assert not np.isnan(hertz.semi_axes(A, B, load, E, NU)).any()
    assert not math.isnan(hertz.stiffness(A, B, E, NU))


@pytest.mark.parametrize(("A", "B"), CURVATURES)
def test_plain_python_agrees_with_the_compiled_kernels(A, B):
    plain = hertz.semi_axes.py_func(A, B, 5e4, E, NU)
    assert plain == near(hertz.semi_axes(A, B, 5e4, E, NU), rel=1e-14)
    ratio = max(A, B) / min(A, B)
    assert hertz.axis_ratio.py_func(ratio) == near(hertz.axis_ratio(ratio), rel=1e-14)
