"""The stops in MuJoCo, which judge `explain`: momentum, rotation, loads and adhesion hold in what is written."""

import math
import sys

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
WEIGHT_N = 43000.0 * 9.81


def rows(folder, run=RUN):
    """time, speed, spins (., 4), loads (., 4), torques (., 4) of a file"""
    told = np.loadtxt(folder / "runs" / f"{run}.csv", delimiter=",", skiprows=1)
    return told[:, 0], told[:, 1], told[:, 2:6], told[:, 6:10], told[:, 10:14]


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return stops.make(tmp_path_factory.mktemp("clean"), {}, 5, (RUN, "long_1"))


@pytest.fixture(scope="module")
def trace():
    return coach.run(stops.nature({}, 5, RUN))


def test_the_same_seed_writes_the_same_bytes_and_another_seed_others(tmp_path, clean):
    again, other = (stops.make(tmp_path / str(seed), {}, seed, (RUN,)) for seed in (5, 6))
    file = f"runs/{RUN}.csv"
    assert (again / file).read_bytes() == (clean / file).read_bytes() != (other / file).read_bytes()


def test_loads_sum_to_the_weight_and_move_forward_by_the_moment_of_braking(clean):
    _, speed, _, loads, _ = rows(clean, "long_1")
    braked = slice(300, 900)
    assert loads.sum(axis=1).mean() == pytest.approx(WEIGHT_N, rel=4 * stops.CALIBRATION)
    deceleration = (speed[braked][0] - speed[braked][-1]) / (0.01 * (speed[braked].size - 1))
    # about the rail: the body at its height, bogies and wheelsets at theirs, all slowed down; wheels turn slower too
    moment = deceleration * (
        29720.0 * 1.8 + 2 * 3000.0 * 0.6 + 4 * 1820.0 * 0.445 + 4 * 160.0 / 0.445
    )
    arms = 21.56 / 2.0 - np.array([0.0, 2.56, 19.0, 21.56])
    assert (loads[braked].mean(axis=0) - WEIGHT_N / 4.0) @ arms == pytest.approx(moment, rel=0.05)
    assert (
        loads[braked, 0].mean()
        > loads[braked, 2].mean()
        > loads[braked, 1].mean()
        > loads[braked, 3].mean()
    )


def test_momentum_closes_on_a_clean_set_within_noise_and_calibration(clean):
    for run in (RUN, "long_1"):
        time, speed, spins, _, torques = rows(clean, run)
        duration = time[-1] - time[0]
        resistance = (600.0 + 0.9375 * speed**2).mean() * duration
        ends = [value[:20].mean(axis=0) - value[-20:].mean(axis=0) for value in (speed, spins)]
        # r T = C + J domega/dt
        rail = (torques.sum(axis=1).mean() * (duration - 0.19) - 160.0 * ends[1].sum()) / 0.445
        assert rail + resistance == pytest.approx(43000.0 * ends[0], rel=4 * stops.CALIBRATION)


def test_the_energy_that_the_coach_loses_is_what_brakes_rail_and_air_take(trace):
    v, spins = trace[:, coach.SPEED_M_S], coach.four(trace, coach.SPINS)
    forces, torques = coach.four(trace, coach.FORCES), coach.four(trace, coach.TORQUES)
    mass = stops.nature({}, 5, RUN).mass_kg
    lost = mass * (v[0] ** 2 - v[-1] ** 2) / 2.0 + 80.0 * (spins[0] ** 2 - spins[-1] ** 2).sum()
    sliding = v[:, None] - 0.445 * spins
    taken = (torques * spins).sum() + (forces * sliding).sum() + ((600.0 + 0.9375 * v**2) * v).sum()
    assert taken * coach.STEP_S == pytest.approx(lost, rel=5e-4)


def test_the_adhesion_told_is_the_papers_solved_in_closed_form(clean):
    """The implicit equation by Lambert's function, half axes and c11 from Hertz's and Kalker's tables at 52.7 kN."""
    _, speed, spins, loads, torques = rows(clean, "long_1")
    half = loads.mean(axis=0) / 2.0
    rate = savgol_filter(spins, 21, 2, deriv=1, delta=0.01, axis=0)
    told = ((torques + 160.0 * rate) / 0.445 / loads)[150:-20]
    s = np.abs(speed[:, None] - 0.445 * savgol_filter(spins, 21, 2, axis=0))[150:-20]
    e = s / speed[150:-20, None]
    a_b = 5.6919e-3 * 4.3771e-3 * (half / 52700.0) ** (2.0 / 3.0)
    stiff = 8.0e10 * math.pi * a_b * 4.593 / (4.0 * half) * e

    def limit(mu_c, k_a, k_s, gamma):
        mu = mu_c * (1.0 + 1.5 * np.exp(-gamma * s))
        return (
            2.0
            * mu
            / math.pi
            * (k_a * stiff / mu / (1.0 + (k_a * stiff / mu) ** 2) + np.arctan(k_s * stiff / mu))
        )

    degraded = limit(stops.nature({}, 5, "long_1").mu_cd, 0.3, 0.1, 0.2)
    recovered = limit(0.28, 1.0, 0.4, 0.6)
    k = 1.9e-4 * half * e
    law = recovered + lambertw(-k * (recovered - degraded) * np.exp(-k * recovered)).real / k
    sliding = s > 1.0
    assert sliding.mean() > 0.3
    assert (
        abs(np.mean((told / law)[sliding]) - 1.0) < 0.015
    )  # calibration, and the field of friction
    assert np.std((told / law)[sliding]) < 0.08


def test_speed_rotation_and_torque_are_told_at_one_clock(trace):
    spins, forces = coach.four(trace, coach.SPINS), coach.four(trace, coach.FORCES)
    torques = coach.four(trace, coach.TORQUES)
    rate = np.diff(spins, axis=0) / coach.STEP_S
    mean = (torques[1:] + torques[:-1]) / 2.0
    np.testing.assert_allclose(160.0 * rate, 0.445 * forces[:-1] - mean, atol=1e-5)


def test_half_the_step_gives_the_same_stop(trace):
    fine = coach.run(stops.nature({}, 5, RUN), coach.STEP_S / 2.0)[::2]
    n = min(len(trace), len(fine))
    assert abs(len(trace) - len(fine)) <= 20  # 10 ms
    apart = np.abs(trace[:n] - fine[:n])
    assert apart[:, coach.SPEED_M_S].max() < stops.SPEED_NOISE_M_S / 3.0
    # protection acts every 10 ms: a vent may come one cycle later
    assert np.sqrt((coach.four(apart, coach.SPINS) ** 2).mean()) < stops.SPIN_NOISE_RAD_S


def test_the_iteration_ends_at_the_root_from_every_guess():
    K = contact.stiffness(0.445)
    for sliding in (1e-3, 0.1, 2.0, 15.0):
        found = [
            contact.adhesion(sliding, 20.0, 5.0e4, 0.06, K, -1.0, guess)
            for guess in (0.0, 0.1, 0.7)
        ]
        np.testing.assert_allclose(found, found[0], atol=1e-9)
        assert contact.adhesion(-sliding, 20.0, 5.0e4, 0.06, K, -1.0, 0.1) == pytest.approx(
            -found[0], abs=1e-9
        )


def test_every_effect_changes_the_records_and_nothing_else_tells_it(tmp_path, clean):
    told = {path.name: path.read_text() for path in (clean / "runs").iterdir()}[
        f"{RUN}.csv"
    ].splitlines()
    about = stops.make(tmp_path / "none", {}, 5, (RUN,)) / "dataset.toml"
    for name in stops.NAMES:
        size = (stops.SMALLEST | stops.UNKNOWN)[name]
        folder = stops.make(tmp_path / name, {name: size}, 5, (RUN,))
        lines = (folder / "runs" / f"{RUN}.csv").read_text().splitlines()
        assert lines[0] == told[0], name
        assert lines[1:] != told[1:], name
        assert (folder / "dataset.toml").read_text() == about.read_text(), name
        assert sorted(path.name for path in folder.rglob("*")) == [
            "dataset.toml",
            "runs",
            f"{RUN}.csv",
        ]


def test_a_size_with_a_plain_meaning_is_that_share_or_that_delay(trace):
    effects = {"brake_gain": 0.04, "wheel_inertia": 0.05}
    other = coach.run(stops.nature(effects, 5, RUN))
    spins, forces, torques = (
        coach.four(other, first) for first in (coach.SPINS, coach.FORCES, coach.TORQUES)
    )
    mean = (torques[1:] + torques[:-1]) / 2.0
    rate = np.diff(spins, axis=0) / coach.STEP_S
    np.testing.assert_allclose(160.0 * 1.05 * rate, 0.445 * forces[:-1] - 1.04 * mean, atol=1e-5)

    stop = stops.nature({}, 5, RUN)
    late = {"speed_sensor_delay": 0.005, "torque_sensor_delay": 0.010}
    now, then = (stops.records(trace, stop, which, 5, RUN)[1] for which in ({}, late))
    at = np.round(now[:, 0] / coach.STEP_S).astype(int)[1:]
    for columns, first, steps, least in (
        (slice(2, 6), coach.SPINS, 10, 1e-9),
        (slice(10, 14), coach.TORQUES, 20, 1.0),
    ):
        told, true = (then - now)[1:, columns], coach.four(trace, first)
        np.testing.assert_allclose(
            told, true[at - steps] - true[at], rtol=0.01, atol=least
        )  # off by 0.3 %


def test_an_effect_that_nobody_knows_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no effect snow; there are rail_cleaning"):
        stops.make(tmp_path, {"snow": 1.0}, 1, (RUN,))


def test_a_machine_without_mujoco_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in ("mujoco_coach", "mujoco_stops"):
        monkeypatch.delitem(sys.modules, f"generator.{name}")
        monkeypatch.delattr(generator, name)
    with pytest.raises(ConfigError, match=r"pip install 'rollerrig\[mujoco\]'"):
        cases.generator("third")
