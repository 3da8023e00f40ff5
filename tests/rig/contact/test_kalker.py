"""Kalker's coefficients against his table, and beyond its ends."""

import csv
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rollerrig.rig.contact import kalker

DATA = Path(__file__).parents[2] / "data"
near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small
with (DATA / "kalker_coefficients.csv").open() as file:
    ROWS = list(csv.reader(line for line in file if not line.startswith("#")))[1:]


def a_over_b(ratio, g):
    return float(g) if ratio == "a/b" else 1.0 / float(g)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row[0]}={row[1]},nu={row[2]}")
def test_every_row_of_kalkers_table_is_met(row):
    expected = [float(value) for value in row[3:]]
    coefficients = kalker.coefficients(a_over_b(*row[:2]), float(row[2]))
    assert coefficients == near(expected, rel=1e-13)


def test_between_the_rows_the_patch_of_contact_is_met():
    # c11, c22, c23 given to CONTACT for a = 5.6919, b = 4.3771 mm, nu = 0.3
    coefficients = kalker.coefficients(5.6919 / 4.3771, 0.3)
    assert coefficients[:3] == near((4.59274, 4.13637, 1.85024), rel=3e-6)


def test_the_published_c11_of_a_wide_patch_is_met():
    # "about 3.79" for the tractcurv case of CONTACT
    assert kalker.coefficients(6.304 / 12.61, 0.28)[0] == near(3.79, rel=0.02)


def test_c11_follows_the_fit_of_the_literature_in_its_range():
    for x in np.linspace(0.2, 3.5, 34):
        fit = 3.2893 + 0.975 * x - 0.012 * x * x
        assert kalker.coefficients(x, 0.27)[0] == near(fit, rel=0.03)


def test_halfway_between_two_rows_the_coefficient_is_their_mean():
    ends = [kalker.coefficients(1.0 / g, 0.25) for g in (0.3, 0.4)]
    assert kalker.coefficients(1.0 / 0.35, 0.25) == near(np.mean(ends, axis=0), rel=1e-13)


def test_the_compliance_is_quadratic_in_poissons_ratio():
    nu = np.linspace(0.0, 0.5, 7)
    for which in range(4):
        compliance = [1.0 / kalker.coefficients(0.85, value)[which] for value in nu]
        assert np.diff(compliance, 3) == pytest.approx(np.zeros(4), abs=1e-14)


@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.3, 0.9, 1.0, 1 / 0.9, 2.5, 5.0, 10.0])
def test_the_coefficients_are_continuous_over_rows_and_ends(ratio):
    below = kalker.coefficients(ratio * (1.0 - 1e-9), 0.3)
    above = kalker.coefficients(ratio * (1.0 + 1e-9), 0.3)
    assert below == near(above, rel=1e-7)


def test_slender_patches_follow_kalkers_asymptotes():
    nu = 0.3
    g = 2e-6
    c11, c22, c23, c33 = kalker.coefficients(g, nu)
    assert c11 == near(math.pi**2 / 4.0 / (1.0 - nu), rel=1e-4)
    assert c22 == near(math.pi**2 / 4.0, rel=1e-4)
    assert c33 == near(math.pi**2 / 16.0 / (1.0 - nu) / g, rel=1e-4)
    assert c23 == near(kalker._asymptote(g, False, nu)[2], rel=1e-4)
    assert kalker.coefficients(1.0 / g, nu) == near(kalker._asymptote(g, True, nu), rel=1e-4)


@pytest.mark.parametrize("nu", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("long_patch", [False, True])
def test_the_asymptotes_meet_the_ends_of_the_table_within_seven_percent(nu, long_patch):
    table = kalker.coefficients(10.0 if long_patch else 0.1, nu)
    limits = np.array(kalker._asymptote(0.1, long_patch, nu)) / table - 1.0
    assert (np.abs(limits) < (0.045, 0.035, 0.065, 0.07)).all()


def test_c11_and_c22_grow_with_the_length_of_the_patch():
    ratios = np.geomspace(0.1, 100.0, 200)
    for nu in (0.0, 0.28, 0.5):
        rows = np.array([kalker.coefficients(ratio, nu) for ratio in ratios])
        # at nu = 1/2 Kalker's c11 dips at the narrow end
        start = ratios > 0.35
        assert (np.diff(rows[start, 0]) > 0.0).all()
        assert (np.diff(rows[:, 1]) > 0.0).all()
        assert (np.diff(rows[:, 2]) > 0.0).all()


@pytest.mark.parametrize("ratio", [0.0, 5e-324, 1e-9, 1e12, 1e308, math.inf])
@pytest.mark.parametrize("nu", [-1.0, 0.0, 0.3, 0.5, 1.0])
def test_extreme_patches_give_finite_positive_coefficients(ratio, nu):
    coefficients = np.array(kalker.coefficients(ratio, nu))
    assert np.isfinite(coefficients).all()
    assert (coefficients > 0.0).all()


def test_plain_python_agrees_with_the_compiled_kernel():
    for ratio in (0.01, 0.1, 0.77, 1.0, 1.3, 9.99, 50.0):
        plain = kalker.coefficients.py_func(ratio, 0.3)
        assert plain == near(kalker.coefficients(ratio, 0.3), rel=1e-14)
