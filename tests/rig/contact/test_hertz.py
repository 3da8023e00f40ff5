"""Hertz contact against exact integrals, published patches and the laws of similarity."""

import math
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipkm1

from rollerrig.rig.contact import hertz

DATA = Path(__file__).parents[2] / "data"
# a relative tolerance only: many values here are smaller than the absolute one of pytest.approx
near = partial(pytest.approx, abs=0.0)
E_PA = 2.1e11  # Young's modulus
NU = 0.3
LOAD_N = 5e4

# curvatures along and across in 1/m, of round and of slender patches in both directions
CURVATURES = [
    (1.1, 1.7),
    (1.7, 1.1),
    (0.5, 40.0),
    (40.0, 0.5),
    (1.0, 1.0 + 1e-9),
    (3e-4, 9e3),
]


class Reference(NamedTuple):
    """A row of the reference table: its columns, in their order."""

    wheel_m: float
    roller_m: float
    lateral_m: float
    load_N: float
    A_1_m: float
    B_1_m: float
    a_mm: float
    b_mm: float
    pressure_GPa: float
    approach_um: float
    stiffness_N_m32: float  # N / m^(3/2)


REFERENCES = [
    Reference(*row) for row in np.genfromtxt(DATA / "hertz.csv", delimiter=",", skip_header=1)
]


def patch(A, B, load_N=LOAD_N):
    """Return semi-axes along and across, largest pressure and approach of a patch."""
    return hertz.semi_axes(A, B, load_N, E_PA, NU)


@pytest.mark.parametrize("row", REFERENCES)
def test_the_patch_agrees_with_the_reference_table_to_its_printed_digits(row):
    curvatures = hertz.curvatures(row.wheel_m, row.roller_m, row.lateral_m)
    assert curvatures == near((row.A_1_m, row.B_1_m), rel=6e-8)

    a, b, pressure, approach = patch(*curvatures, row.load_N)
    assert a * 1e3 == near(row.a_mm, rel=6e-8)
    assert b * 1e3 == near(row.b_mm, rel=6e-8)
    assert pressure * 1e-9 == near(row.pressure_GPa, rel=6e-8)
    assert approach * 1e6 == near(row.approach_um, rel=6e-8)
    stiffness = hertz.stiffness(*curvatures, E_PA, NU)
    assert stiffness == near(row.stiffness_N_m32, rel=6e-8)


def test_a_patch_of_another_material_agrees_with_a_published_case_of_the_program_contact():
    # case "tractcurv" of CONTACT: 106.7 kN, r = 0.625 m on a rail, G = 82 GPa, nu = 0.28
    nu = 0.28
    young_Pa = 2.0 * 82e9 * (1.0 + nu)
    a_mm = 6.304
    b_mm = 12.61

    def published_patch(B):
        return hertz.semi_axes(0.5 / 0.625, B, 106.7e3, young_Pa, nu)

    def excess(B):
        a, b, _, _ = published_patch(B)
        return a / b - a_mm / b_mm

    # the lateral curvature is not published; it follows from the ratio of the semi-axes
    a, b, pressure, _ = published_patch(brentq(excess, 0.01, 0.79))
    assert a * 1e3 == near(a_mm, rel=1e-3)
    assert b * 1e3 == near(b_mm, rel=1e-3)
    assert pressure * 1e-6 == near(640.7, rel=1e-3)


@pytest.mark.parametrize(("A", "B"), CURVATURES)
def test_the_shape_of_the_ellipse_satisfies_hertz_equation_for_the_curvatures(A, B):
    a, b, pressure, _ = patch(A, B)
    major = max(a, b)
    minor = min(a, b)
    small = min(A, B)
    large = max(A, B)
    square = (minor / major) ** 2
    K = ellipkm1(square)
    E = ellipe(1.0 - square)
    # scipy's K - E loses digits where the patch is round
    is_round = 1.0 - square <= 1e-2
    tolerance = 1e-5 if is_round else 1e-11

    # Hertz's equations for both curvatures, for semi-axes major > minor and p_0 = pressure:
    #   smaller = scale (K - E), larger = scale (E / square - K),
    #   scale = p_0 / E* minor / (major^2 - minor^2)    (Johnson 1985, section 4.2)
    scale = pressure * 2.0 * (1.0 - NU**2) / E_PA * minor / (major**2 - minor**2)
    assert scale * (K - E) == near(small, rel=tolerance)
    assert scale * (E / square - K) == near(large, rel=tolerance)


@pytest.mark.parametrize("kappa", [1e-8, 1e-3, 0.3, 0.9, 1.0 - 1e-9, 1.0])
def test_the_elliptic_integrals_agree_with_scipy(kappa):
    first_kind, d_integral = hertz.elliptic_integrals(kappa)
    m = (1.0 - kappa) * (1.0 + kappa)
    assert first_kind == near(ellipkm1(kappa**2), rel=1e-14)
    # scipy has no D, but E = K - m D
    assert first_kind - m * d_integral == near(ellipe(m), rel=1e-14)


def test_the_integral_D_keeps_its_digits_where_the_patch_is_nearly_round():
    for kappa in (1.0, 1.0 - 1e-12, 1.0 - 1e-7, 1.0 - 1e-5):
        m = (1.0 - kappa) * (1.0 + kappa)
        # the beginning of the power series of D in m
        series = math.pi / 4.0 * (1.0 + 3.0 / 8.0 * m + 15.0 / 64.0 * m * m)
        _, d_integral = hertz.elliptic_integrals(kappa)
        assert d_integral == near(series, rel=1e-14)


@pytest.mark.parametrize("ratio", [1.0, 1.0 + 1e-14, 1.0 + 1e-7, 1.4839, 50.0, 1e6, 1e12, 1e100])
def test_the_axis_ratio_solves_its_equation_for_any_ratio_of_curvatures(ratio):
    kappa, K, D = hertz.axis_ratio(ratio)
    assert 0.0 < kappa <= 1.0
    assert (K - D) / D / kappa / kappa == near(ratio, rel=1e-12)


def test_equal_curvatures_give_the_circle_of_the_closed_form():
    load_N = 6e4
    half_curvature_1_m = 1.25
    radius_m = 0.5 / half_curvature_1_m
    effective_modulus_Pa = E_PA / 2.0 / (1.0 - NU**2)  # E* of [H3]
    a, b, pressure, approach = patch(half_curvature_1_m, half_curvature_1_m, load_N)
    assert a == b
    assert a == near((0.75 * load_N * radius_m / effective_modulus_Pa) ** (1.0 / 3.0), rel=1e-14)
    assert approach == near(a * a / radius_m, rel=1e-14)
    assert pressure == near(1.5 * load_N / (math.pi * a * a), rel=1e-14)


@pytest.mark.parametrize(("A", "B"), CURVATURES)
def test_exchanging_the_directions_exchanges_the_semi_axes(A, B):
    a, b, pressure, approach = patch(A, B)
    assert patch(B, A) == (b, a, pressure, approach)
    assert (a > b) == (A < B)


@pytest.mark.parametrize(("A", "B"), CURVATURES)
@pytest.mark.parametrize("load_N", [1e-6, 1.0, 5.27e4, 1e7])
def test_pressure_carries_the_load_and_the_approach_follows_the_stiffness(A, B, load_N):
    a, b, pressure, approach = patch(A, B, load_N)
    # the pressure is a half ellipsoid over the patch; its integral is the load
    assert 2.0 / 3.0 * math.pi * a * b * pressure == near(load_N, rel=1e-13)
    assert hertz.stiffness(A, B, E_PA, NU) * approach**1.5 == near(load_N, rel=1e-13)


def test_the_semi_axes_grow_with_the_cube_root_of_the_load():
    a, b, pressure, approach = patch(1.1, 1.7, 1e4)
    heavy = patch(1.1, 1.7, 8e4)
    assert heavy == near((2.0 * a, 2.0 * b, 2.0 * pressure, 4.0 * approach), rel=1e-14)


def test_a_roller_of_infinite_radius_is_a_rail_bit_for_bit():
    wheel_m = 0.445
    lateral_m = 0.3
    rail = (0.5 * (1.0 / wheel_m), 0.5 / lateral_m)
    assert hertz.curvatures(wheel_m, math.inf, lateral_m) == rail
    # the curvature of such a large roller is below the last digit of the wheel's
    assert hertz.curvatures(wheel_m, 1e300, lateral_m) == rail


def test_a_smaller_roller_shortens_the_patch_and_raises_the_pressure():
    patches = []
    for roller_m in (math.inf, 2.0, 1.0, 0.5, 0.25):
        A, B = hertz.curvatures(0.445, roller_m, 0.3)
        patches.append(patch(A, B, 52.7e3))
    # arrays over the rollers, from the rail to the smallest one
    a, b, pressure, _ = np.array(patches).T
    assert (np.diff(a) <= 0.0).all()
    assert (np.diff(b) >= 0.0).all()
    assert (np.diff(pressure) >= 0.0).all()


@pytest.mark.parametrize("load_N", [0.0, -0.0, -1.0, -math.inf])
def test_without_load_there_is_no_patch(load_N):
    assert patch(1.1, 1.7, load_N) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("A", "B"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (math.nan, 1.0)])
def test_without_curvature_there_is_no_ellipse(A, B):
    assert patch(A, B) == (0.0, 0.0, 0.0, 0.0)
    assert hertz.stiffness(A, B, E_PA, NU) == 0.0


@pytest.mark.parametrize("load_N", [5e-324, 1.0, math.inf])
@pytest.mark.parametrize(("A", "B"), [(1e-300, 1.0), (1e-12, 1e12), (1.0, 1.0)])
def test_extreme_inputs_give_no_nan(A, B, load_N):
    assert not np.isnan(patch(A, B, load_N)).any()
    assert not math.isnan(hertz.stiffness(A, B, E_PA, NU))
