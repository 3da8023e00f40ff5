"""The second generator of braking stops keeps the conditions that it declares."""

import ast
from pathlib import Path

import numpy as np
import pytest
from generator import other_stops
from scipy.special import lambertw

NOTHING = np.zeros(len(other_stops.NAMES))


def table(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", names=True)


def wheels(record: np.ndarray, pattern: str) -> np.ndarray:
    return np.column_stack([record[pattern.format(j)] for j in range(1, 5)])


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    return other_stops.make(tmp_path_factory.mktemp("stops") / "clean", {}, 3)


@pytest.fixture(scope="module")
def stop() -> tuple[other_stops.Stop, np.ndarray]:
    """The first stop of a seed on a rail without irregularity, every millisecond."""
    _, plan, _, _ = other_stops._plan(np.random.default_rng(5), NOTHING, 1.0)[0]
    even, fine = np.zeros(int(other_stops.LENGTH_M / other_stops.FIELD_M)), np.zeros((60000, 14))
    rows = other_stops.run(
        plan, NOTHING, other_stops.rolling(plan, NOTHING), even, np.zeros((4, len(even))), fine
    )
    return plan, fine[:rows]


def test_the_second_generator_imports_nothing_of_the_bench():
    tree = ast.parse(Path(other_stops.__file__).read_text())
    modules = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    modules |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name.split(".")[0] for name in modules} == {
        "math",
        "pathlib",
        "typing",
        "numpy",
        "numba",
        "scipy",
    }


def test_the_same_seed_writes_the_same_files(clean, tmp_path):
    again = other_stops.make(tmp_path, {}, 3, ("a3",))
    other = other_stops.make(tmp_path / "other", {}, 4, ("a3",))
    assert (again / "runs/a3.csv").read_bytes() == (clean / "runs/a3.csv").read_bytes()
    assert (other / "runs/a3.csv").read_bytes() != (clean / "runs/a3.csv").read_bytes()


def test_wheels_slide_do_not_lock_and_the_coach_slows_down(clean):
    for path in sorted((clean / "runs").glob("*.csv")):
        record = table(path)
        v, omega = record["vehicle_speed_m_s"], wheels(record, "wheel_speed_{}_rad_s")
        sliding = v[:, None] - 0.445 * omega
        assert v[0] > 21.8, path.name
        assert 3.3 < v[-1] < 5.2, path.name
        assert ((sliding > 2.0).mean(axis=0) > 0.2).all(), path.name
        assert sliding.max() < 12.0, path.name
        assert ((omega < 1.0).sum(axis=0) < 40).all(), path.name
        assert np.allclose(np.diff(record["time_s"]), 0.01), path.name


def test_the_records_of_a_clean_set_keep_the_balance_of_coach_and_wheels(clean):
    # sum r T = sum (J domega/dt + C) leaves the law of adhesion out
    text = (clean / "dataset.toml").read_text()
    masses = [float(line.split("=")[1]) for line in text.splitlines() if line.startswith("mass_kg")]
    for mass, path in zip(masses, sorted((clean / "runs").glob("*.csv")), strict=True):
        record = table(path)
        v, c = record["vehicle_speed_m_s"], wheels(record, "brake_torque_{}_Nm").sum(axis=1)
        moving = v + 160.0 * wheels(record, "wheel_speed_{}_rad_s").sum(axis=1) / (mass * 0.445)
        braked = 0.01 * np.cumsum(c) / (mass * 0.445)
        rest = moving + 0.01 * np.cumsum(600.0 + 0.9375 * v**2) / mass
        gain, start = np.polyfit(braked, rest, 1)
        assert gain == pytest.approx(-1.0, abs=0.015), path.name
        assert np.std(rest - gain * braked - start) == pytest.approx(0.0301, rel=0.08), path.name


def test_each_wheel_of_a_clean_stop_obeys_the_degraded_adhesion_in_its_closed_form(stop):
    plan, fine = stop
    v, omega, load, c = fine[:, :1], fine[:, 1:5], fine[:, 5:9], fine[:, 9:13]
    s, n = v - 0.445 * omega, 0.5 * load
    e = np.maximum(s, 1e-9) / v
    # a b c11 of the wheel on the rail at 52.7 kN
    x = np.pi / 4.0 * 8.0e10 * 5.6919e-3 * 4.3771e-3 * 4.591 * (n / 52700.0) ** (2.0 / 3.0) * e / n
    f = {}
    for k, k_a, k_s, mu, gamma in (("d", 0.3, 0.1, plan.mu_d, 0.2), ("r", 1.0, 0.4, 0.28, 0.6)):
        mu = (mu / 0.4 - mu) * np.exp(-gamma * s) + mu
        f[k] = (
            2.0
            * mu
            / np.pi
            * (k_a * x / mu / (1.0 + (k_a * x / mu) ** 2) + np.arctan(k_s * x / mu))
        )
    k, step = 1.9e-4 * n * e, f["r"] - f["d"]
    both = f["r"] + lambertw(-k * step * np.exp(-k * f["r"])).real / k
    balance = 160.0 * np.gradient(omega, 0.001, axis=0) - (0.445 * both * load - c)
    slides = s > 1.0
    assert slides.mean() > 0.3
    assert np.sqrt(np.mean(balance[slides] ** 2)) < 15.0
    assert np.abs(balance[slides]).max() < 150.0


def test_the_friction_of_the_rail_scatters_by_two_percent_over_eight_metres():
    rng = np.random.default_rng(2)
    field = other_stops.friction_field(rng, 0.0141, (30,))
    away = round(8.0 / other_stops.FIELD_M)
    assert field.std() * np.sqrt(2.0) == pytest.approx(0.02, rel=0.1)
    assert np.mean(field[:, away:] * field[:, :-away]) / field.var() == pytest.approx(
        np.exp(-1.0), abs=0.1
    )


@pytest.mark.parametrize("name", other_stops.NAMES)
def test_each_effect_changes_what_is_recorded(name, clean, tmp_path_factory):
    size = {**other_stops.SMALLEST, **other_stops.UNKNOWN}[name]
    runs = other_stops.RUNS if name == "one_run_burst" else ("a3",)
    folder = other_stops.make(tmp_path_factory.mktemp(name), {name: size}, 3, runs)
    pairs = [[(one / f"runs/{run}.csv").read_bytes() for one in (folder, clean)] for run in runs]
    assert sum(one != other for one, other in pairs) == 1
