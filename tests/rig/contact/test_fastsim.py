"""FASTSIM against the half-space program CONTACT, Kalker's limits and finer grids."""

import math
from functools import partial

import numpy as np
import pytest
from contact_program import CONTACT_PATCH, contact_results

from rollerrig.rig.contact import fastsim, johnson_vermeulen
from rollerrig.rig.contact.patch import patch_for

near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small
MU = 0.3
LOAD_N = 52_700.0
LONG_PATCH = patch_for(0.625, math.inf, 0.1, 2.1e11, 8.2e10, 0.28)  # a/b = 2.3
ROLLER_PATCH = patch_for(0.445, 0.5, 0.3, 2.1e11, 8.0e10, 0.3)  # a/b = 0.85
each_patch = pytest.mark.parametrize(
    "patch", [CONTACT_PATCH, LONG_PATCH, ROLLER_PATCH], ids=["rail", "long", "roller"]
)


def force_over_limit(xi, eta, phi_1_m, cells, patch=CONTACT_PATCH):
    """Return the force over mu N and the moment over mu N sqrt(a b), shape (3,)."""
    fx, fy, mz = fastsim.force(xi, eta, phi_1_m, MU, LOAD_N, patch, cells, cells)
    size_m = math.sqrt(patch.a1 * patch.b1) * LOAD_N ** (1.0 / 3.0)
    return np.array((fx, fy, mz / size_m)) / (MU * LOAD_N)


@pytest.mark.parametrize("cells", [10, 20, 50, 100])
def test_every_result_stays_within_0_08_mu_N_of_contact(cells):
    with_spin = []
    without_spin = []
    for result in contact_results():
        fx, fy, mz = force_over_limit(result.xi, result.eta, result.phi_1_m, cells)
        assert abs(mz - result.mz) < 0.081, result
        if result.phi_1_m:
            with_spin.append(result.distance(fx, fy))
        else:
            without_spin.append(result.distance(fx, fy))
    assert len(without_spin) == 25
    assert len(with_spin) == 29
    assert max(without_spin) < 0.04
    assert max(with_spin) < 0.08
    # CONTACT's FASTSIM reaches this mean
    assert np.mean(with_spin) < 0.025


@each_patch
@pytest.mark.parametrize(
    "creepages_and_spin",
    [
        (1e-7, 0, 0),
        (0, 1e-7, 0),
        (0, 0, 1e-5),
        (1e-7, -2e-7, 3e-5),
    ],
)
def test_at_vanishing_creepage_the_force_is_kalkers(patch, creepages_and_spin):
    fx, fy, _ = fastsim.force(*creepages_and_spin, MU, LOAD_N, patch, 100, 100)
    growth = LOAD_N ** (1.0 / 3.0)
    linear_x, linear_y = johnson_vermeulen.linear(
        *creepages_and_spin, patch.a1 * growth, patch.b1 * growth, patch
    )
    distance_N = math.hypot(fx - linear_x, fy - linear_y)
    assert distance_N < 0.005 * math.hypot(linear_x, linear_y)


@pytest.mark.parametrize("cells", [2, 7, 10, 40])
def test_full_sliding_gives_the_friction_limit_against_the_slip_on_any_grid(cells):
    creepage = 0.3
    for angle in np.linspace(0.0, 2.0 * math.pi, 9):
        along = math.cos(angle)
        across = math.sin(angle)
        fx, fy, _ = force_over_limit(creepage * along, creepage * across, 0.0, cells)
        assert math.hypot(fx, fy) == near(1.0, rel=1e-3)
        assert fx * along + fy * across == near(-1.0, rel=2e-3)


def test_without_spin_longitudinal_force_follows_the_exact_sum_over_strips():
    # independent: stick up to the parabola of the limit, the limit behind it, integrated over y
    result = next(r for r in contact_results() if r.xi == 0.001 and r.eta == 0.0)
    patch_m2 = math.pi * result.a_m * result.b_m
    stress = 0.375 * result.shear_Pa * result.c11 * result.xi
    slope = stress * patch_m2 / (2 * MU * result.load_N)
    y = np.linspace(-1.0, 1.0, 20001)
    edge = np.sqrt(1.0 - y * y)
    # where stick meets the limit: slope (edge - x) = edge^2 - x^2
    meet = np.clip(slope - edge, -edge, edge)
    stick = 0.5 * slope * (edge - meet) ** 2
    slip = edge**2 * (meet + edge) - (meet**3 + edge**3) / 3.0
    exact = np.trapezoid(stick + slip, y) / (math.pi / 2.0)
    fx, _, _ = force_over_limit(result.xi, 0, 0, cells=400)
    assert -fx == near(exact, rel=2e-3)


@each_patch
@pytest.mark.parametrize(
    "creepages_and_spin",
    [
        (2e-3, 0, 0),
        (1e-3, -1e-3, 0.3),
        (0, 0, 2.0),
        (2e-3, 1e-3, 1.0),
    ],
)
def test_halving_the_cells_converges(patch, creepages_and_spin):
    def force(cells):
        return force_over_limit(*creepages_and_spin, cells, patch)[:2]

    fine = force(320)
    coarsest_error = np.hypot(*(force(10) - fine))
    finest_error = np.hypot(*(force(80) - fine))
    assert coarsest_error < 0.05
    assert finest_error < 0.006


def test_mirrored_creepages_give_mirrored_forces():
    force = force_over_limit(1e-3, 5e-4, 0.4, 20)
    turned = force_over_limit(-1e-3, -5e-4, -0.4, 20)
    assert turned == pytest.approx(-force, rel=1e-12)
    mirrored = force_over_limit(1e-3, -5e-4, -0.4, 20)
    assert mirrored == pytest.approx(force * (1, -1, -1), rel=1e-12)


def test_without_spin_more_creepage_never_gives_less_force():
    pull = [-force_over_limit(xi, 0, 0, 20)[0] for xi in np.geomspace(1e-5, 0.1, 60)]
    assert np.all(np.diff(pull) >= -1e-12)
    assert pull[-1] <= 1.0 + 1e-12


@pytest.mark.parametrize(
    ("xi", "mu", "load_N"),
    [
        (0, MU, LOAD_N),
        (1e-3, 0.0, LOAD_N),
        (1e-3, MU, 0.0),
        (1e-3, MU, -1.0),
    ],
)
def test_there_is_no_force_without_creepage_friction_or_load(xi, mu, load_N):
    assert fastsim.force(xi, 0, 0, mu, load_N, CONTACT_PATCH, 10, 10) == (0.0, 0.0, 0.0)
