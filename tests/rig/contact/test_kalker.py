"""Kalker's coefficients against his table, and beyond its ends."""

import csv
import math
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rollerrig.rig.contact import kalker

DATA = Path(__file__).parents[2] / "data"
near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small


class TableRow(NamedTuple):
    """A row of Kalker's table."""

    ratio: str  # "a/b" or "b/a": the ratio whose value is g
    g: float
    nu: float
    coefficients: tuple[float, ...]  # c11, c22, c23, c33

    @property
    def a_over_b(self):
        return self.g if self.ratio == "a/b" else 1.0 / self.g


def table_rows():
    with (DATA / "kalker_coefficients.csv").open() as file:
        lines = [line for line in file if not line.startswith("#")]
    for ratio, g, nu, *coefficients in list(csv.reader(lines))[1:]:
        yield TableRow(ratio, float(g), float(nu), tuple(map(float, coefficients)))


@pytest.mark.parametrize(
    "row", list(table_rows()), ids=lambda row: f"{row.ratio}={row.g},nu={row.nu}"
)
def test_every_row_of_kalkers_table_is_met(row):
    assert kalker.coefficients(row.a_over_b, row.nu) == near(row.coefficients, rel=1e-13)


def test_between_the_rows_the_patch_of_contact_is_met():
    # c11, c22, c23 given to CONTACT for a = 5.6919, b = 4.3771 mm, nu = 0.3
    c11, c22, c23, _ = kalker.coefficients(5.6919 / 4.3771, 0.3)
    assert (c11, c22, c23) == near((4.59274, 4.13637, 1.85024), rel=3e-6)


def test_the_published_c11_of_a_wide_patch_is_met():
    # "about 3.79" for the tractcurv case of CONTACT
    c11, *_ = kalker.coefficients(6.304 / 12.61, 0.28)
    assert c11 == near(3.79, rel=0.02)


def test_c11_follows_the_fit_of_the_literature_in_its_range():
    for ratio in np.linspace(0.2, 3.5, 34):
        fit = 3.2893 + 0.975 * ratio - 0.012 * ratio * ratio
        c11, *_ = kalker.coefficients(ratio, 0.27)
        assert c11 == near(fit, rel=0.03)


def test_halfway_between_two_rows_the_coefficient_is_their_mean():
    one_row = kalker.coefficients(1.0 / 0.5, 0.25)
    next_row = kalker.coefficients(1.0 / 0.4, 0.25)
    mean = np.mean([one_row, next_row], axis=0)
    assert kalker.coefficients(1.0 / 0.45, 0.25) == near(mean, rel=1e-13)


@pytest.mark.parametrize("end", [0.1, 0.2, 0.3])
def test_between_the_rows_of_long_patches_the_coefficients_are_powers_of_the_ratio(end):
    one_row, next_row = np.array(
        [kalker.coefficients(1.0 / slimness, 0.25)[:3] for slimness in (end, end + 0.1)]
    )
    exponents = np.log(next_row / one_row) / math.log((end + 0.1) / end)
    for slimness in np.linspace(end, end + 0.1, 11):
        on_the_curve = one_row * (slimness / end) ** exponents
        c11, c22, c23, _ = kalker.coefficients(1.0 / slimness, 0.25)
        assert (c11, c22, c23) == near(on_the_curve, rel=0.012)


def test_the_compliance_is_quadratic_in_poissons_ratio():
    ratios_of_poisson = np.linspace(0.0, 0.5, 7)
    coefficients = np.array([kalker.coefficients(0.85, nu) for nu in ratios_of_poisson])
    third_differences = np.diff(1.0 / coefficients, n=3, axis=0)
    assert third_differences == pytest.approx(np.zeros((4, 4)), abs=1e-14)


@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.3, 0.9, 1.0, 1 / 0.9, 2.5, 5.0, 10.0])
def test_the_coefficients_are_continuous_over_rows_and_ends(ratio):
    below = kalker.coefficients(ratio * (1.0 - 1e-9), 0.3)
    above = kalker.coefficients(ratio * (1.0 + 1e-9), 0.3)
    assert below == near(above, rel=1e-7)


def test_slender_patches_follow_kalkers_asymptotes():
    nu = 0.3
    g = 2e-6
    c11, c22, c23, c33 = kalker.coefficients(g, nu)
    _, _, c23_of_asymptote, _ = kalker._asymptote(g, False, nu)
    assert c11 == near(math.pi**2 / 4.0 / (1.0 - nu), rel=1e-4)
    assert c22 == near(math.pi**2 / 4.0, rel=1e-4)
    assert c33 == near(math.pi**2 / 16.0 / (1.0 - nu) / g, rel=1e-4)
    assert c23 == near(c23_of_asymptote, rel=1e-4)

    long_patch = kalker.coefficients(1.0 / g, nu)
    assert long_patch == near(kalker._asymptote(g, True, nu), rel=1e-4)


@pytest.mark.parametrize("nu", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("long_patch", [False, True])
def test_the_asymptotes_meet_the_ends_of_the_table_within_seven_percent(nu, long_patch):
    table = kalker.coefficients(10.0 if long_patch else 0.1, nu)
    asymptote = np.array(kalker._asymptote(0.1, long_patch, nu))
    assert (np.abs(asymptote / table - 1.0) < (0.045, 0.035, 0.065, 0.07)).all()


@pytest.mark.parametrize("nu", [0.0, 0.28, 0.5])
def test_c11_c22_and_c23_grow_with_the_length_of_the_patch(nu):
    ratios = np.geomspace(0.1, 100.0, 200)
    c11, c22, c23, _ = np.array([kalker.coefficients(ratio, nu) for ratio in ratios]).T
    # at nu = 1/2 Kalker's c11 dips at the narrow end
    assert (np.diff(c11[ratios > 0.35]) > 0.0).all()
    assert (np.diff(c22) > 0.0).all()
    assert (np.diff(c23) > 0.0).all()


@pytest.mark.parametrize("ratio", [0.0, 5e-324, 1e-9, 1e12, 1e308, math.inf])
@pytest.mark.parametrize("nu", [-1.0, 0.0, 0.3, 0.5, 1.0])
def test_extreme_patches_give_finite_positive_coefficients(ratio, nu):
    coefficients = np.array(kalker.coefficients(ratio, nu))
    assert np.isfinite(coefficients).all()
    assert (coefficients > 0.0).all()
