"""The stops in MuJoCo, which judge `explain`, keep the physics that they declare.

Momentum, rotation, loads and adhesion hold in the written files. These are laws of the generator,
not of rollerrig, so they are in the nightly tier.
"""

import math
import sys
from typing import NamedTuple

import generator
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="pip install 'rollerrig[mujoco]'")

from generator import mujoco_coach as coach
from generator import mujoco_contact as contact
from generator import mujoco_stops as stops
from scipy.signal import savgol_filter
from scipy.special import lambertw
from sealed import cases

from rollerrig.configs.errors import ConfigError

RUN = "short_2"
LONG_RUN = "long_1"
SEED = 5
MASS_KG = 43000.0
WEIGHT_N = MASS_KG * 9.81
RADIUS_M = 0.445
INERTIA_KGM2 = 160.0  # of a wheelset
STEP_S = 0.01  # of the files


class Record(NamedTuple):
    """The columns of a written run."""

    time_s: np.ndarray
    speed_m_s: np.ndarray
    spins_rad_s: np.ndarray  # (n, 4)
    loads_N: np.ndarray  # (n, 4)
    torques_Nm: np.ndarray  # (n, 4)


def record_of(folder, run=RUN) -> Record:
    columns = np.loadtxt(folder / "runs" / f"{run}.csv", delimiter=",", skiprows=1)
    return Record(
        time_s=columns[:, 0],
        speed_m_s=columns[:, 1],
        spins_rad_s=columns[:, 2:6],
        loads_N=columns[:, 6:10],
        torques_Nm=columns[:, 10:14],
    )


def resistance_N(speed_m_s):
    return 600.0 + 0.9375 * speed_m_s**2


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Two runs with nothing hidden in them."""
    return stops.make(tmp_path_factory.mktemp("clean"), {}, SEED, (RUN, LONG_RUN))


@pytest.fixture(scope="module")
def trace():
    """A run with nothing hidden in it, at every step of the simulation."""
    return coach.run(stops.nature({}, SEED, RUN))


@pytest.mark.nightly
def test_the_same_seed_writes_the_same_bytes_and_another_seed_others(tmp_path, clean):
    again = stops.make(tmp_path / "same", {}, SEED, (RUN,))
    other = stops.make(tmp_path / "other", {}, SEED + 1, (RUN,))
    file = f"runs/{RUN}.csv"
    assert (again / file).read_bytes() == (clean / file).read_bytes()
    assert (other / file).read_bytes() != (clean / file).read_bytes()


# --- mechanics ---


@pytest.mark.nightly
def test_loads_sum_to_the_weight_and_move_forward_by_the_moment_of_braking(clean):
    record = record_of(clean, LONG_RUN)
    loads_N = record.loads_N
    assert loads_N.sum(axis=1).mean() == pytest.approx(WEIGHT_N, rel=4 * stops.CALIBRATION)

    braked = slice(300, 900)
    speed_m_s = record.speed_m_s[braked]
    deceleration_m_s2 = (speed_m_s[0] - speed_m_s[-1]) / (STEP_S * (speed_m_s.size - 1))
    # About the rail: the body, the bogies and the wheelsets slow down at their heights, and the
    # wheels turn more slowly.
    of_body = 29720.0 * 1.8
    of_bogies = 2 * 3000.0 * 0.6
    of_wheelsets = 4 * 1820.0 * RADIUS_M
    of_rotation = 4 * INERTIA_KGM2 / RADIUS_M
    moment_Nm = deceleration_m_s2 * (of_body + of_bogies + of_wheelsets + of_rotation)
    arms_m = 21.56 / 2.0 - np.array([0.0, 2.56, 19.0, 21.56])
    mean_N = loads_N[braked].mean(axis=0)
    assert (mean_N - WEIGHT_N / 4.0) @ arms_m == pytest.approx(moment_Nm, rel=0.05)
    assert mean_N[0] > mean_N[2] > mean_N[1] > mean_N[3]


@pytest.mark.nightly
def test_momentum_closes_on_a_clean_set_within_noise_and_calibration(clean):
    for run in (RUN, LONG_RUN):
        record = record_of(clean, run)
        duration_s = record.time_s[-1] - record.time_s[0]
        resistance_Ns = resistance_N(record.speed_m_s).mean() * duration_s

        def lost(values):
            """What is lost from the first 0.2 s to the last 0.2 s."""
            return values[:20].mean(axis=0) - values[-20:].mean(axis=0)

        # r T = C + J domega/dt
        brake_Nms = record.torques_Nm.sum(axis=1).mean() * (duration_s - 0.19)
        rotation_Nms = INERTIA_KGM2 * lost(record.spins_rad_s).sum()
        rail_Ns = (brake_Nms - rotation_Nms) / RADIUS_M
        momentum_Ns = MASS_KG * lost(record.speed_m_s)
        assert rail_Ns + resistance_Ns == pytest.approx(momentum_Ns, rel=4 * stops.CALIBRATION)


@pytest.mark.nightly
def test_brakes_rail_and_air_take_the_energy_that_the_coach_loses(trace):
    speed_m_s = trace[:, coach.SPEED_M_S]
    spins_rad_s = coach.four(trace, coach.SPINS)
    forces_N = coach.four(trace, coach.FORCES)
    torques_Nm = coach.four(trace, coach.TORQUES)
    mass_kg = stops.nature({}, SEED, RUN).mass_kg

    of_vehicle_J = mass_kg * (speed_m_s[0] ** 2 - speed_m_s[-1] ** 2) / 2.0
    of_wheels_J = 80.0 * (spins_rad_s[0] ** 2 - spins_rad_s[-1] ** 2).sum()
    sliding_m_s = speed_m_s[:, None] - RADIUS_M * spins_rad_s
    brakes_W = (torques_Nm * spins_rad_s).sum()
    rail_W = (forces_N * sliding_m_s).sum()
    air_W = (resistance_N(speed_m_s) * speed_m_s).sum()
    assert (brakes_W + rail_W + air_W) * coach.STEP_S == pytest.approx(
        of_vehicle_J + of_wheels_J, rel=5e-4
    )


@pytest.mark.nightly
def test_the_wheels_obey_the_papers_adhesion_in_its_closed_form(clean):
    """Lambert's function solves the implicit equation.

    Half axes and c11 are those of a table for 52.7 kN.
    """
    record = record_of(clean, LONG_RUN)
    half_N = record.loads_N.mean(axis=0) / 2.0
    inside = slice(150, -20)
    rate_rad_s2 = savgol_filter(record.spins_rad_s, 21, 2, deriv=1, delta=STEP_S, axis=0)
    force_N = (record.torques_Nm + INERTIA_KGM2 * rate_rad_s2) / RADIUS_M
    measured = (force_N / record.loads_N)[inside]
    smooth_rad_s = savgol_filter(record.spins_rad_s, 21, 2, axis=0)
    s = np.abs(record.speed_m_s[:, None] - RADIUS_M * smooth_rad_s)[inside]
    e = s / record.speed_m_s[inside, None]
    a_b = 5.6919e-3 * 4.3771e-3 * (half_N / 52700.0) ** (2.0 / 3.0)
    stiffness = 8.0e10 * math.pi * a_b * 4.593 / (4.0 * half_N) * e

    def curve(mu_c, k_a, k_s, gamma):
        """Adhesion without recovery."""
        mu = mu_c * (1.0 + 1.5 * np.exp(-gamma * s))
        stick = k_a * stiffness / mu
        return 2.0 * mu / math.pi * (stick / (1.0 + stick**2) + np.arctan(k_s * stiffness / mu))

    degraded = curve(stops.nature({}, SEED, LONG_RUN).mu_cd, 0.3, 0.1, 0.2)
    recovered = curve(0.28, 1.0, 0.4, 0.6)
    k = 1.9e-4 * half_N * e
    law = recovered + lambertw(-k * (recovered - degraded) * np.exp(-k * recovered)).real / k

    sliding = s > 1.0
    assert sliding.mean() > 0.3
    ratio = (measured / law)[sliding]
    # calibration, and the field of friction
    assert abs(np.mean(ratio) - 1.0) < 0.015
    assert np.std(ratio) < 0.08


@pytest.mark.nightly
def test_speed_rotation_and_torque_have_one_clock(trace):
    spins_rad_s = coach.four(trace, coach.SPINS)
    forces_N = coach.four(trace, coach.FORCES)
    torques_Nm = coach.four(trace, coach.TORQUES)
    rate_rad_s2 = np.diff(spins_rad_s, axis=0) / coach.STEP_S
    mean_Nm = (torques_Nm[1:] + torques_Nm[:-1]) / 2.0
    balance_Nm = RADIUS_M * forces_N[:-1] - mean_Nm
    np.testing.assert_allclose(INERTIA_KGM2 * rate_rad_s2, balance_Nm, atol=1e-5)


# --- numerics ---


@pytest.mark.nightly
def test_half_the_step_gives_the_same_stop(trace):
    fine = coach.run(stops.nature({}, SEED, RUN), coach.STEP_S / 2.0)[::2]
    n = min(len(trace), len(fine))
    assert abs(len(trace) - len(fine)) <= 20  # 10 ms
    difference = np.abs(trace[:n] - fine[:n])
    assert difference[:, coach.SPEED_M_S].max() < stops.SPEED_NOISE_M_S / 3.0
    # protection acts every 10 ms: a vent may come one cycle later
    spins_rad_s = coach.four(difference, coach.SPINS)
    assert np.sqrt((spins_rad_s**2).mean()) < stops.SPIN_NOISE_RAD_S


@pytest.mark.nightly
def test_the_iteration_ends_at_the_root_from_every_guess():
    K = contact.stiffness(RADIUS_M)
    for sliding_m_s in (1e-3, 0.1, 2.0, 15.0):
        roots = []
        for guess in (0.0, 0.1, 0.7):
            roots.append(contact.adhesion(sliding_m_s, 20.0, 5.0e4, 0.06, K, -1.0, guess))
        np.testing.assert_allclose(roots, roots[0], atol=1e-9)
        backwards = contact.adhesion(-sliding_m_s, 20.0, 5.0e4, 0.06, K, -1.0, 0.1)
        assert backwards == pytest.approx(-roots[0], abs=1e-9)


# --- hidden effects ---


@pytest.mark.nightly
def test_every_effect_changes_the_records_and_no_other_file_reveals_it(tmp_path, clean):
    clean_lines = (clean / "runs" / f"{RUN}.csv").read_text().splitlines()
    head = (stops.make(tmp_path / "none", {}, SEED, (RUN,)) / "dataset.toml").read_text()
    for name in stops.NAMES:
        size = (stops.SMALLEST | stops.UNKNOWN)[name]
        folder = stops.make(tmp_path / name, {name: size}, SEED, (RUN,))
        lines = (folder / "runs" / f"{RUN}.csv").read_text().splitlines()
        assert lines[0] == clean_lines[0], name
        assert lines[1:] != clean_lines[1:], name
        assert (folder / "dataset.toml").read_text() == head, name
        files = sorted(path.name for path in folder.rglob("*"))
        assert files == ["dataset.toml", "runs", f"{RUN}.csv"]


@pytest.mark.nightly
def test_a_gain_or_an_inertia_changes_by_the_share_that_is_its_size():
    effects = {"brake_gain": 0.04, "wheel_inertia": 0.05}
    trace = coach.run(stops.nature(effects, SEED, RUN))
    spins_rad_s = coach.four(trace, coach.SPINS)
    forces_N = coach.four(trace, coach.FORCES)
    torques_Nm = coach.four(trace, coach.TORQUES)
    mean_Nm = (torques_Nm[1:] + torques_Nm[:-1]) / 2.0
    rate_rad_s2 = np.diff(spins_rad_s, axis=0) / coach.STEP_S
    balance_Nm = RADIUS_M * forces_N[:-1] - 1.04 * mean_Nm
    np.testing.assert_allclose(1.05 * INERTIA_KGM2 * rate_rad_s2, balance_Nm, atol=1e-5)


@pytest.mark.nightly
def test_a_delay_is_as_long_as_its_size(trace):
    stop = stops.nature({}, SEED, RUN)
    late = {"speed_sensor_delay": 0.005, "torque_sensor_delay": 0.010}
    _, on_time_rows = stops.records(trace, stop, {}, SEED, RUN)
    _, late_rows = stops.records(trace, stop, late, SEED, RUN)
    at = np.round(on_time_rows[:, 0] / coach.STEP_S).astype(int)[1:]
    change = (late_rows - on_time_rows)[1:]

    for columns, first, steps, tolerance in (
        (slice(2, 6), coach.SPINS, 10, 1e-9),
        (slice(10, 14), coach.TORQUES, 20, 1.0),
    ):
        true = coach.four(trace, first)
        # calibration is off by 0.3 %
        np.testing.assert_allclose(
            change[:, columns], true[at - steps] - true[at], rtol=0.01, atol=tolerance
        )


def test_an_unknown_effect_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no effect snow; there are rail_cleaning"):
        stops.make(tmp_path, {"snow": 1.0}, 1, (RUN,))


def test_without_mujoco_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in ("mujoco_coach", "mujoco_stops"):
        monkeypatch.delitem(sys.modules, f"generator.{name}")
        monkeypatch.delattr(generator, name)
    with pytest.raises(ConfigError, match=r"pip install 'rollerrig\[mujoco\]'"):
        cases.generator("third")
