"""FASTSIM against the half-space program CONTACT, Kalker's limits and finer grids."""

import math
from functools import partial

import numpy as np
import pytest
from contact_program import contact_curves

from rollerrig.rig.contact import fastsim, johnson_vermeulen
from rollerrig.rig.contact.patch import patch_for

near = partial(pytest.approx, abs=0.0)
MU = 0.3
LOAD_N = 52_700.0
PATCH = patch_for(0.445, math.inf, 0.3, 2.1e11, 2.1e11 / 2.6, 0.3)
LONG = patch_for(0.625, math.inf, 0.1, 2.1e11, 8.2e10, 0.28)  # a/b = 2.3
ROLLER = patch_for(0.445, 0.5, 0.3, 2.1e11, 8.0e10, 0.3)  # a/b = 0.85


def normal(xi, eta, phi, cells, patch=PATCH, mu=MU, load_N=LOAD_N):
    fx, fy, mz = fastsim.force(xi, eta, phi, mu, load_N, patch, cells, cells)
    size = math.sqrt(patch.a1 * patch.b1) * load_N ** (1.0 / 3.0)
    return np.array((fx, fy, mz / size)) / (mu * load_N)


@pytest.mark.parametrize("cells", [10, 20, 50, 100])
def test_every_row_stays_within_0_08_mu_N_of_contact(cells):
    with_spin = []
    without = []
    for row in contact_curves():
        f = normal(row["xi"], row["eta"], row["phi_1_per_m"], cells)
        distance = math.hypot(f[0] - row["CONTACT_fx"], f[1] - row["CONTACT_fy"])
        if row["phi_1_per_m"]:
            with_spin.append(distance)
        else:
            without.append(distance)
        assert abs(f[2] - row["CONTACT_mz"]) < 0.081, row
    assert len(without) == 25
    assert len(with_spin) == 29
    assert max(without) < 0.04
    assert max(with_spin) < 0.08
    # CONTACT's FASTSIM reaches this mean
    assert np.mean(with_spin) < 0.025


@pytest.mark.parametrize("patch", [PATCH, LONG, ROLLER])
@pytest.mark.parametrize("creep", [(1e-7, 0, 0), (0, 1e-7, 0), (0, 0, 1e-5), (1e-7, -2e-7, 3e-5)])
def test_at_vanishing_creepage_the_force_is_kalkers(patch, creep):
    fx, fy, _ = fastsim.force(*creep, MU, LOAD_N, patch, 100, 100)
    growth = LOAD_N ** (1.0 / 3.0)
    lx, ly = johnson_vermeulen.linear(*creep, patch.a1 * growth, patch.b1 * growth, patch)
    assert math.hypot(fx - lx, fy - ly) < 0.005 * math.hypot(lx, ly)


@pytest.mark.parametrize("cells", [2, 7, 10, 40])
def test_full_sliding_gives_the_friction_limit_against_the_slip_on_any_grid(cells):
    for angle in np.linspace(0.0, 2.0 * math.pi, 9):
        f = normal(0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.0, cells)
        assert math.hypot(f[0], f[1]) == near(1.0, rel=1e-3)
        assert f[0] * math.cos(angle) + f[1] * math.sin(angle) == near(-1.0, rel=2e-3)


def test_without_spin_longitudinal_force_follows_the_exact_sum_over_strips():
    # independent: stick up to the parabola of the limit, the limit behind it, integrated over y
    row = next(r for r in contact_curves() if r["xi"] == 0.001 and r["eta"] == 0.0)
    a = row["a_mm"] * 1e-3
    b = row["b_mm"] * 1e-3
    N = row["N"]
    slope = 0.375 * row["G_GPa"] * 1e9 * row["c11"] * row["xi"] * math.pi * a * b / (2 * MU * N)
    y = np.linspace(-1.0, 1.0, 20001)
    edge = np.sqrt(1.0 - y * y)
    meet = np.clip(slope - edge, -edge, edge)  # slope (edge - x) = edge^2 - x^2
    stick = 0.5 * slope * (edge - meet) ** 2
    slip = edge**2 * (meet + edge) - (meet**3 + edge**3) / 3.0
    exact = np.trapezoid(stick + slip, y) / (math.pi / 2.0)
    assert -normal(row["xi"], 0, 0, 400)[0] == near(exact, rel=2e-3)


@pytest.mark.parametrize("patch", [PATCH, LONG, ROLLER])
def test_halving_the_cells_converges(patch):
    for creep in ((2e-3, 0, 0), (1e-3, -1e-3, 0.3), (0, 0, 2.0), (2e-3, 1e-3, 1.0)):
        fine = normal(*creep, 320, patch)[:2]
        errors = [np.hypot(*(normal(*creep, n, patch)[:2] - fine)) for n in (10, 20, 40, 80)]
        assert errors[0] < 0.05
        assert errors[3] < 0.006


def test_mirrored_creepages_give_mirrored_forces():
    f = normal(1e-3, 5e-4, 0.4, 20)
    assert normal(-1e-3, -5e-4, -0.4, 20) == pytest.approx(-f, rel=1e-12)
    g = normal(1e-3, -5e-4, -0.4, 20)
    assert g == pytest.approx(f * (1, -1, -1), rel=1e-12)


def test_without_spin_more_creepage_never_gives_less_force():
    pull = [-normal(xi, 0, 0, 20)[0] for xi in np.geomspace(1e-5, 0.1, 60)]
    assert np.all(np.diff(pull) >= -1e-12)
    assert pull[-1] <= 1.0 + 1e-12


@pytest.mark.parametrize(
    "inputs",
    [
        (0, 0, 0, MU, LOAD_N),
        (1e-3, 0, 0, 0.0, LOAD_N),
        (1e-3, 0, 0, MU, 0.0),
        (1e-3, 0, 0, MU, -1.0),
    ],
)
def test_there_is_no_force_without_creepage_friction_or_load(inputs):
    assert fastsim.force(*inputs, PATCH, 10, 10) == (0.0, 0.0, 0.0)
