"""Degraded adhesion: the paper's values, independent solvers, and the laws of energy recovery."""

import csv
import math
import os
import subprocess
import sys
from decimal import Decimal, localcontext
from functools import partial
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from paper_law import TABLE_4
from scipy.special import lambertw

from rollerrig.rig.contact import adhesion, polach
from rollerrig.rig.contact.patch import patch_for

DATA = Path(__file__).parents[2] / "data"
near = partial(pytest.approx, abs=0.0)  # relative only: many values here are small
MATERIAL = (2.1e11, 8.0e10, 0.3)
RAIL = patch_for(0.445, math.inf, 0.3, *MATERIAL)
SPOILING = TABLE_4._replace(mu_cd=0.28, mu_cr=0.06)
LOAD = 52.7e3
SLIDING = [0.0, 1e-9, 1e-3, 0.02, 0.3, 1.0, 3.0, 6.0, 12.0, 40.0]
SPEEDS = [0.0, 0.05, 1.0, 5.0, 20.0, 40.0]


def table():
    with (DATA / "adhesion_table4_r300.csv").open() as file:
        for row in csv.DictReader(file):
            yield {key: float(value) for key, value in row.items() if key != "patch"}


def solved(f_d, f_r, k):
    """Return the f of eq. 15, solved for y = k f.

    Newton's method from k f_r is monotone for f_d <= f_r; otherwise bisection is used.
    """
    D = f_r - f_d
    if D < 0.0:
        low = k * f_r
        high = k * f_d
        for _ in range(100):
            y = 0.5 * (low + high)
            if k * f_r - k * D * math.exp(-y) > y:
                low = y
            else:
                high = y
        return 0.5 * (low + high) / k
    y = k * f_r
    for _ in range(100):
        step = (k * f_d - k * D * math.expm1(-y) - y) / (1.0 - k * D * math.exp(-y))
        y += step
        if abs(step) <= 1e-15 * y:
            break
    return y / k


def exact_w0(x):
    """Return W0 to 40 digits, by Newton's method in decimal arithmetic from above the root."""
    with localcontext() as context:
        context.prec = 50
        x = Decimal(x)
        p2 = 2 * (1 + Decimal(1).exp() * x)
        w = -1 + p2.sqrt() if p2 < 2 else (x + 1).ln()
        for _ in range(200):
            step = (w - x * (-w).exp()) / (1 + w)
            w -= step
            if abs(step) <= abs(w) * Decimal("1e-40"):
                return w
    raise AssertionError(f"no convergence at {x}")


# the paper's values


def test_table_4_is_met_to_its_printed_digits():
    columns = ("f_d", "f_r", "f", "lambda", "Wsp_J_per_m", "tau_Wsp", "T_N")
    rows = list(table())
    assert len(rows) == 95
    for row in rows:
        f, f_d, f_r, lambda_, work, _ = adhesion.wheel_adhesion(
            row["s_m_s"], row["v_m_s"], LOAD, RAIL, TABLE_4
        )
        results = (f_d, f_r, f, lambda_, work, TABLE_4.tau_m_J * work, f * LOAD)
        assert results == near([row[name] for name in columns], rel=5.1e-8)


def test_the_friction_of_table_4_is_met():
    for row in table():
        degraded = polach.friction(row["s_m_s"], 0.06, 0.4, 0.2)
        recovered = polach.friction(row["s_m_s"], 0.28, 0.4, 0.6)
        assert degraded == near(row["mu_d"], rel=5.1e-8)
        assert recovered == near(row["mu_r"], rel=5.1e-8)


def test_adhesion_dips_where_falling_friction_outweighs_recovery():
    f = [
        adhesion.wheel_adhesion(s, 40.0, LOAD, RAIL, TABLE_4)[0] for s in np.arange(0.5, 15.0, 0.1)
    ]
    dip_m_s = 0.5 + 0.1 * (20 + int(np.argmin(f[20:])))
    assert 5.0 < dip_m_s < 7.0
    assert max(f[:20]) > min(f[20:]) < f[-1]


@pytest.mark.parametrize(
    ("radius", "creep_slope"), [(1.0, -0.17), (0.75, -0.20), (0.6, -0.24), (0.5, -0.27)]
)
def test_a_roller_softens_the_creep_slope_as_published(radius, creep_slope):
    roller = patch_for(0.445, radius, 0.3, *MATERIAL)
    assert roller.eps1 / RAIL.eps1 - 1.0 == pytest.approx(creep_slope, abs=0.006)
    area = roller.a1 * roller.b1 / (RAIL.a1 * RAIL.b1) - 1.0
    assert -0.195 < area < -0.085


# the closed form


def test_the_closed_form_agrees_with_an_independent_solver_for_random_and_extreme_parameters():
    random = np.random.default_rng(20140919)
    for _ in range(3000):
        f_d, f_r = random.uniform(1e-4, 0.7, 2)
        k = 10.0 ** random.uniform(-9.0, 9.0)
        assert adhesion.recovery(f_d, f_r, k)[0] == near(solved(f_d, f_r, k), rel=1e-10)
    for f_d, f_r, k in product(
        (1e-12, 1e-6, 0.1, 0.7),
        (1e-12, 1e-6, 0.1, 0.7),
        (1e-200, 1e-30, 1e-3, 1.0, 10.0, 1e3, 1e9, 1e30),
    ):
        assert adhesion.recovery(f_d, f_r, k)[0] == near(solved(f_d, f_r, k), rel=1e-10)


def test_the_root_keeps_its_digits_at_the_branch_point_of_lamberts_function():
    # f_d -> 0 with k f_r = 1: here k f = sqrt(2 k f_d) to leading order
    for f_d in (1e-8, 1e-12, 1e-16, 1e-20):
        f = adhesion.recovery(f_d, 0.25, 4.0)[0]
        assert 4.0 * f == near(math.sqrt(8.0 * f_d), rel=math.sqrt(8.0 * f_d) + 1e-6)


def test_a_small_degraded_adhesion_keeps_its_digits_next_to_a_large_recovered_one():
    # to first order in f_d: f = f_d / (1 - k D)
    for f_d, k in product((1e-14, 1e-10), (1e-9, 1e-3, 1.0, 3.0)):
        f, lambda_ = adhesion.recovery(f_d, 0.3, k)
        assert f == near(f_d / (1.0 - k * (0.3 - f_d)), rel=1e-7 * f_d / 1e-10)
        assert lambda_ == near(-math.expm1(-k * f), rel=1e-13)


def test_the_pair_satisfies_equations_9_and_10():
    random = np.random.default_rng(7)
    for _ in range(1000):
        f_d, f_r = random.uniform(0.0, 0.7, 2)
        k = 10.0 ** random.uniform(-6.0, 12.0)
        f, lambda_ = adhesion.recovery(f_d, f_r, k)
        assert f == near((1.0 - lambda_) * f_d + lambda_ * f_r, rel=1e-11)
        assert lambda_ == near(-math.expm1(-k * f), rel=1e-13)
        assert min(f_d, f_r) <= f <= max(f_d, f_r)


def test_without_degraded_adhesion_nothing_recovers_before_k_f_r_is_one():
    for k in (0.0, 1.0, 3.0, 4.0):
        assert adhesion.recovery(0.0, 0.25, k) == (0.0, 0.0)
    for k in (4.4, 8.0, 100.0):
        assert adhesion.recovery(0.0, 0.25, k)[0] == near(solved(0.0, 0.25, k), rel=1e-12)


def test_unlimited_energy_gives_full_recovery():
    for k in (1e6, 1e30, math.inf):
        assert adhesion.recovery(0.1, 0.3, k) == (near(0.3, rel=1e-15), 1.0)
        assert adhesion.recovery(0.3, 0.1, k) == (0.1, 1.0)


@pytest.mark.parametrize("k", [0.0, -0.0, -1.0, 5e-324])
def test_without_energy_adhesion_is_the_degraded_one_bit_for_bit(k):
    assert adhesion.recovery(0.1234567, 0.3, k) == (0.1234567, 0.0)


# Lambert's function


def test_w0_agrees_with_scipy():
    random = np.random.default_rng(1758)
    x = np.concatenate(
        (
            random.uniform(-0.36, 3.0, 2000),
            10.0 ** random.uniform(-300.0, 308.0, 2000),
            -(10.0 ** random.uniform(-300.0, -0.45, 2000)),
        )
    )
    w = np.array([adhesion.lambert_w0(value) for value in x])
    assert w == near(lambertw(x).real, rel=1e-14)


def test_w0_agrees_with_decimal_arithmetic_down_to_its_branch_point():
    # scipy loses half of the digits there
    neighbours = [-1.0 / math.e]
    for _ in range(3):
        neighbours.append(math.nextafter(neighbours[-1], 0.0))
    for x in (*neighbours[1:], *(-1.0 / math.e + np.geomspace(1e-15, 0.3, 200))):
        assert adhesion.lambert_w0(x) == near(float(exact_w0(x)), rel=1e-14)
    for x in np.geomspace(1e-300, 1e308, 100):
        assert adhesion.lambert_w0(x) == near(float(exact_w0(x)), rel=1e-14)


def test_w0_is_exact_at_its_known_points():
    assert adhesion.lambert_w0(0.0) == 0.0
    assert adhesion.lambert_w0(-1.0 / math.e) == -1.0
    assert adhesion.lambert_w0(math.inf) == math.inf
    assert adhesion.lambert_w0(math.e) == near(1.0, rel=1e-15)
    assert adhesion.lambert_w0(1.0) == near(0.5671432904097838730, rel=1e-15)
    assert adhesion.lambert_w0(-math.log(2.0) / 2.0) == near(-math.log(2.0), rel=1e-14)
    assert adhesion.lambert_w0(-0.5) == -1.0


def test_w0_inverts_w_exp_w_and_never_decreases():
    w = np.concatenate((-1.0 + np.geomspace(0.05, 1.0, 300), np.geomspace(1e-12, 700.0, 300)))
    inverted = np.array([adhesion.lambert_w0(value * math.exp(value)) for value in w])
    assert inverted == pytest.approx(w, rel=1e-13, abs=1e-15)
    x = np.concatenate((np.linspace(-1.0 / math.e, 0.1, 3001), np.geomspace(0.1, 1e308, 3000)))
    values = np.array([adhesion.lambert_w0(value) for value in x])
    assert (np.diff(values) >= -1e-15 * np.abs(values[1:])).all()


# the law of one wheel


@pytest.mark.parametrize("law", [TABLE_4, SPOILING])
def test_adhesion_is_odd_in_sliding_and_even_in_the_direction_of_travel(law):
    for sliding, speed in product(SLIDING, SPEEDS):
        forward = adhesion.wheel_adhesion(sliding, speed, LOAD, RAIL, law)
        assert adhesion.wheel_adhesion(-sliding, speed, LOAD, RAIL, law) == (
            -forward[0],
            *forward[1:],
        )
        assert adhesion.wheel_adhesion(sliding, -speed, LOAD, RAIL, law) == forward


@pytest.mark.parametrize("law", [TABLE_4, SPOILING])
def test_adhesion_lies_between_its_limits_and_lambda_in_0_to_1(law):
    for sliding, speed, load in product(SLIDING, SPEEDS, (1e-3, 1e3, LOAD, 2e5)):
        f, f_d, f_r, lambda_, work, _ = adhesion.wheel_adhesion(sliding, speed, load, RAIL, law)
        assert min(f_d, f_r) <= f <= max(f_d, f_r)
        assert 0.0 <= lambda_ <= 1.0
        assert lambda_ == pytest.approx(-math.expm1(-law.tau_m_J * work), rel=1e-12, abs=1e-300)
        creepage = sliding / max(speed, adhesion.SPEED_FLOOR_M_S)
        assert work == near(f * load * creepage, rel=1e-15)


def test_adhesion_grows_with_tau():
    for sliding, speed in product(SLIDING[1:], SPEEDS):
        f = [
            adhesion.wheel_adhesion(sliding, speed, LOAD, RAIL, TABLE_4._replace(tau_m_J=tau))[0]
            for tau in (0.0, *np.geomspace(1e-9, 1.0, 40))
        ]
        assert all(later >= earlier * (1.0 - 1e-15) for earlier, later in pairwise(f))


def test_without_tau_adhesion_is_the_degraded_one_bit_for_bit():
    for sliding, speed in product(SLIDING, SPEEDS):
        f, f_d, _, lambda_, _, _ = adhesion.wheel_adhesion(
            sliding, speed, LOAD, RAIL, TABLE_4._replace(tau_m_J=0.0)
        )
        assert (f, lambda_) == (f_d, 0.0)


def test_the_limits_are_polachs_force_at_the_patch_of_the_load():
    for sliding, speed, load in product(SLIDING, SPEEDS[2:], (1e3, LOAD)):
        _, f_d, f_r, _, _, _ = adhesion.wheel_adhesion(sliding, speed, load, RAIL, TABLE_4)
        growth = load ** (1 / 3)
        eps_mu = polach.eps_per_creepage(
            RAIL.a1 * growth, RAIL.b1 * growth, RAIL.c11, RAIL.shear_Pa, load
        )
        for f, mu_c, gamma, k_a, k_s in (
            (f_d, 0.06, 0.2, 0.3, 0.1),
            (f_r, 0.28, 0.6, 1.0, 0.4),
        ):
            mu = polach.friction(sliding, mu_c, 0.4, gamma)
            shape, _ = polach.shape(eps_mu * sliding / speed / mu, k_a, k_s)
            assert f == near(mu * shape, rel=1e-13)


@pytest.mark.parametrize("law", [TABLE_4, SPOILING, TABLE_4._replace(tau_m_J=0.0)])
def test_the_slope_is_the_derivative_to_sliding(law):
    def f_and_slope(sliding, speed):
        f, _, _, _, _, slope = adhesion.wheel_adhesion(sliding, speed, LOAD, RAIL, law)
        return f, slope

    for size, speed, sign in product((1e-4, 0.02, 0.3, 1.0, 3.0, 12.0), SPEEDS[1:], (1, -1)):
        sliding = sign * size
        h = 1e-5 * size
        f_after, _ = f_and_slope(sliding + h, speed)
        f_before, _ = f_and_slope(sliding - h, speed)
        _, slope = f_and_slope(sliding, speed)
        assert slope == pytest.approx((f_after - f_before) / (2.0 * h), rel=1e-5, abs=1e-9)


def test_at_rest_the_slope_is_the_weakened_creep_slope_of_the_patch():
    f, _, _, _, _, slope = adhesion.wheel_adhesion(0.0, 20.0, LOAD, RAIL, TABLE_4)
    stiffness = RAIL.eps1 * LOAD ** (-1 / 3) * 2.0 / math.pi * (0.3 + 0.1)
    assert f == 0.0
    assert slope == near(stiffness / 20.0, rel=1e-13)


def test_a_roller_of_infinite_radius_is_a_rail_bit_for_bit():
    assert patch_for(0.445, 1e300, 0.3, *MATERIAL) == RAIL
    roller = patch_for(0.445, 1e12, 0.3, *MATERIAL)
    assert roller == near(RAIL, rel=1e-11)


@pytest.mark.parametrize("load", [0.0, -0.0, -1.0, -math.inf])
def test_an_unloaded_wheel_transmits_nothing(load):
    assert adhesion.wheel_adhesion(1.0, 20.0, load, RAIL, TABLE_4) == (0.0,) * 6


def test_infinite_and_zero_inputs_give_no_nan():
    ends = (0.0, 5e-324, 1e-300, 1.0, 1e300, math.inf)
    laws = (
        TABLE_4,
        SPOILING,
        TABLE_4._replace(tau_m_J=0.0),
        TABLE_4._replace(mu_cd=0.0),
        TABLE_4._replace(mu_cd=0.0, mu_cr=0.0),
        TABLE_4._replace(gamma_d_s_m=0.0, gamma_r_s_m=0.0),
        TABLE_4._replace(tau_m_J=1e30),
    )
    for sliding, speed, load, law in product((*ends, -math.inf), ends, ends, laws):
        assert not np.isnan(adhesion.wheel_adhesion(sliding, speed, load, RAIL, law)).any()
    for f_d, f_r, k in product((0.0, 5e-324, 0.1, 1.0), (0.0, 5e-324, 0.1, 1.0), ends):
        assert not np.isnan(adhesion.recovery(f_d, f_r, k)).any()


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_nan_input_gives_a_nan_adhesion(place):
    inputs = [1.0, 20.0, LOAD]
    inputs[place] = math.nan
    assert math.isnan(adhesion.wheel_adhesion(*inputs, RAIL, TABLE_4)[0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wheel_radius_m", 0.0),
        ("wheel_radius_m", math.inf),
        ("roller_radius_m", -1.0),
        ("lateral_radius_m", math.nan),
        ("young_Pa", -2.1e11),
        ("shear_Pa", 0.0),
        ("poisson", 0.6),
    ],
)
def test_an_impossible_patch_is_refused_with_the_parameter(name, value):
    parameters = {
        "wheel_radius_m": 0.445,
        "roller_radius_m": 1.0,
        "lateral_radius_m": 0.3,
        "young_Pa": 2.1e11,
        "shear_Pa": 8.0e10,
        "poisson": 0.3,
    }
    parameters[name] = value
    with pytest.raises(ValueError, match=f"{name} = {value!r}; must be"):
        patch_for(**parameters)


PLAIN = """
import math
from paper_law import TABLE_4
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.patch import patch_for
laws = (TABLE_4, TABLE_4._replace(mu_cd=0.28, mu_cr=0.06), TABLE_4._replace(mu_cd=0.0))
for radius in (math.inf, 0.5):
    patch = patch_for(0.445, radius, 0.3, 2.1e11, 8.0e10, 0.3)
    for sliding in (0.0, 1e-3, -0.3, 3.0, 12.0, math.inf):
        for speed in (0.0, 5.0, 40.0):
            for load in (0.0, 52.7e3, math.inf):
                for law in laws:
                    print(*adhesion.wheel_adhesion(sliding, speed, load, patch, law))
"""


def test_plain_python_agrees_with_the_compiled_kernels():
    def run(disabled):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        process = subprocess.run(
            [sys.executable, "-c", PLAIN],
            cwd=Path(__file__).parent,
            env=environment,
            check=False,
            capture_output=True,
            text=True,
        )
        assert process.returncode == 0, process.stderr
        return np.array([line.split() for line in process.stdout.splitlines()], dtype=float)

    compiled = run("0")
    assert compiled.shape == (324, 6)
    assert run("1") == pytest.approx(compiled, rel=1e-12, abs=1e-300)
