"""The second generator of braking stops keeps the conditions that it declares.

These are laws of the generator, not of rollerrig, so they are in the nightly tier.
"""

import ast
from pathlib import Path

import numpy as np
import pytest
from generator import conditions, other_stops
from scipy.special import lambertw

NOTHING = np.zeros(len(other_stops.NAMES))
RUN = "a3"
SEED = 3
RADIUS_M = 0.445
INERTIA_KGM2 = 160.0  # of a wheelset
STEP_S = 0.01  # of the files
FINE_STEP_S = 0.001  # of the simulation
FINE_COLUMNS = 14


def record_of(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", names=True)


def wheels(record: np.ndarray, pattern: str) -> np.ndarray:
    """A channel of all wheelsets, shape (n, 4)."""
    return np.column_stack([record[pattern.format(j)] for j in range(1, 5)])


def resistance_N(speed_m_s: np.ndarray) -> np.ndarray:
    return 600.0 + 0.9375 * speed_m_s**2


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    """Stops with nothing hidden in them."""
    return other_stops.make(tmp_path_factory.mktemp("stops") / "clean", {}, SEED)


@pytest.fixture(scope="module")
def stop() -> tuple[other_stops.Stop, np.ndarray]:
    """The first stop of a seed on a rail without irregularity, every millisecond."""
    _, plan, _, _ = other_stops._plan(np.random.default_rng(5), NOTHING, 1.0)[0]
    cells = int(other_stops.LENGTH_M / other_stops.FIELD_M)
    even_rail = np.zeros(cells)
    even_under_wheels = np.zeros((4, cells))
    fine = np.zeros((60000, FINE_COLUMNS))
    rolling = other_stops.rolling(plan, NOTHING)
    rows = other_stops.run(plan, NOTHING, rolling, even_rail, even_under_wheels, fine)
    return plan, fine[:rows]


def test_the_second_generator_imports_nothing_of_the_bench():
    tree = ast.parse(Path(other_stops.__file__).read_text())
    modules = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            modules.add(node.module)
    packages = {name.split(".")[0] for name in modules}
    others = {"collections", "math", "pathlib", "typing", "numpy", "numba", "scipy", "generator"}
    assert packages == others
    # the conditions are arithmetic alone
    assert "rollerrig" not in Path(conditions.__file__).read_text()


@pytest.mark.nightly
def test_the_same_seed_writes_the_same_files(clean, tmp_path):
    again = other_stops.make(tmp_path, {}, SEED, (RUN,))
    other = other_stops.make(tmp_path / "other", {}, SEED + 1, (RUN,))
    file = f"runs/{RUN}.csv"
    assert (again / file).read_bytes() == (clean / file).read_bytes()
    assert (other / file).read_bytes() != (clean / file).read_bytes()


@pytest.mark.nightly
def test_wheels_slide_do_not_lock_and_the_coach_slows_down(clean):
    for path in sorted((clean / "runs").glob("*.csv")):
        record = record_of(path)
        speed_m_s = record["vehicle_speed_m_s"]
        wheel_rad_s = wheels(record, "wheel_speed_{}_rad_s")
        sliding_m_s = speed_m_s[:, None] - RADIUS_M * wheel_rad_s
        assert speed_m_s[0] > 21.8, path.name
        assert 3.3 < speed_m_s[-1] < 5.2, path.name
        assert ((sliding_m_s > 2.0).mean(axis=0) > 0.2).all(), path.name
        assert sliding_m_s.max() < 12.0, path.name
        assert ((wheel_rad_s < 1.0).sum(axis=0) < 40).all(), path.name
        assert np.allclose(np.diff(record["time_s"]), STEP_S), path.name


@pytest.mark.nightly
def test_the_records_of_a_clean_set_keep_the_balance_of_coach_and_wheels(clean):
    # sum r T = sum (J domega/dt + C) contains no adhesion law
    head = (clean / "dataset.toml").read_text()
    masses_kg = []
    for line in head.splitlines():
        if line.startswith("mass_kg"):
            masses_kg.append(float(line.split("=")[1]))

    for mass_kg, path in zip(masses_kg, sorted((clean / "runs").glob("*.csv")), strict=True):
        record = record_of(path)
        speed_m_s = record["vehicle_speed_m_s"]
        torque_Nm = wheels(record, "brake_torque_{}_Nm").sum(axis=1)
        spins_rad_s = wheels(record, "wheel_speed_{}_rad_s").sum(axis=1)
        # all as speeds of the vehicle
        moving_m_s = speed_m_s + INERTIA_KGM2 * spins_rad_s / (mass_kg * RADIUS_M)
        braked_m_s = STEP_S * np.cumsum(torque_Nm) / (mass_kg * RADIUS_M)
        resisted_m_s = STEP_S * np.cumsum(resistance_N(speed_m_s)) / mass_kg
        rest_m_s = moving_m_s + resisted_m_s
        gain, start_m_s = np.polyfit(braked_m_s, rest_m_s, 1)
        noise_m_s = np.std(rest_m_s - gain * braked_m_s - start_m_s)
        assert gain == pytest.approx(-1.0, abs=0.015), path.name
        assert noise_m_s == pytest.approx(0.0301, rel=0.08), path.name


@pytest.mark.nightly
def test_each_wheel_of_a_clean_stop_obeys_the_degraded_adhesion_in_its_closed_form(stop):
    plan, fine = stop
    speed_m_s = fine[:, :1]
    wheel_rad_s = fine[:, 1:5]
    load_N = fine[:, 5:9]
    torque_Nm = fine[:, 9:13]
    s = speed_m_s - RADIUS_M * wheel_rad_s
    half_N = 0.5 * load_N
    e = np.maximum(s, 1e-9) / speed_m_s
    # a b c11 of the wheel on the rail at 52.7 kN
    a_b_c11 = 5.6919e-3 * 4.3771e-3 * 4.591 * (half_N / 52700.0) ** (2.0 / 3.0)
    x = np.pi / 4.0 * 8.0e10 * a_b_c11 * e / half_N

    def curve(k_a: float, k_s: float, mu: float, gamma: float) -> np.ndarray:
        """Adhesion without recovery."""
        mu_of_s = (mu / 0.4 - mu) * np.exp(-gamma * s) + mu
        stick = k_a * x / mu_of_s
        slip = np.arctan(k_s * x / mu_of_s)
        return 2.0 * mu_of_s / np.pi * (stick / (1.0 + stick**2) + slip)

    degraded = curve(0.3, 0.1, plan.mu_d, 0.2)
    recovered = curve(1.0, 0.4, 0.28, 0.6)
    k = 1.9e-4 * half_N * e
    step = recovered - degraded
    law = recovered + lambertw(-k * step * np.exp(-k * recovered)).real / k
    rate_rad_s2 = np.gradient(wheel_rad_s, FINE_STEP_S, axis=0)
    balance_Nm = INERTIA_KGM2 * rate_rad_s2 - (RADIUS_M * law * load_N - torque_Nm)

    slides = s > 1.0
    assert slides.mean() > 0.3
    assert np.sqrt(np.mean(balance_Nm[slides] ** 2)) < 15.0
    assert np.abs(balance_Nm[slides]).max() < 150.0


@pytest.mark.nightly
def test_the_friction_of_the_rail_scatters_by_two_percent_over_eight_metres():
    field = other_stops.friction_field(np.random.default_rng(2), 0.0141, (30,))
    assert field.std() * np.sqrt(2.0) == pytest.approx(0.02, rel=0.1)

    away = round(8.0 / other_stops.FIELD_M)
    correlation = np.mean(field[:, away:] * field[:, :-away]) / field.var()
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("name", other_stops.NAMES)
def test_each_effect_changes_one_of_the_records(name, clean, tmp_path_factory):
    size = {**other_stops.SMALLEST, **other_stops.UNKNOWN}[name]
    runs = other_stops.RUNS if name == "one_run_burst" else (RUN,)
    folder = other_stops.make(tmp_path_factory.mktemp(name), {name: size}, SEED, runs)
    changed = []
    for run in runs:
        file = f"runs/{run}.csv"
        if (folder / file).read_bytes() != (clean / file).read_bytes():
            changed.append(run)
    assert len(changed) == 1
