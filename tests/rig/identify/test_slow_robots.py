"""Recordings of small robots at 0.2 m/s are judged with limits that fit them, or refused."""

import numpy as np
import pytest
from tiers import first_of

from rollerrig.rig.identify.train_recorder import judged, recording, verdict

RATE_HZ = 30.0
DURATION_S = 120.0
FASTEST_M_S = 0.2

# s. From start to end of a hidden slip or of a held value.
HIDDEN_S = (50.0, 58.0)


def drive(seed):
    """Return stamps and the speed of a robot that drives steadily for 6 s after each change."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    begins_s = np.arange(0.0, DURATION_S, 8.0)
    speed_m_s = FASTEST_M_S * rng.uniform(0.3, 1.0, begins_s.size)
    changes_s = np.sort(np.concatenate([begins_s, begins_s + 6.0]))
    return time_s, np.interp(time_s, changes_s, np.repeat(speed_m_s, 2))


def explained(folder, seed, noise_m_s, share_of_wheel=0.0, is_brief=False):
    """Return the explanation of a robot whose first wheel is faster by a share.

    `is_brief`: only from start to end of HIDDEN_S, else throughout.
    """
    time_s, vehicle_m_s = drive(seed)
    is_hidden = np.ones(time_s.size, bool)
    if is_brief:
        is_hidden = (time_s > HIDDEN_S[0]) & (time_s < HIDDEN_S[1])
    wheel_1_m_s = vehicle_m_s * (1.0 + share_of_wheel * is_hidden)
    rng = np.random.default_rng(seed + 1)
    columns = [time_s]
    for speed_m_s in (vehicle_m_s, wheel_1_m_s, vehicle_m_s):
        columns.append(speed_m_s + noise_m_s * rng.standard_normal(time_s.size))
    np.savetxt(
        folder / "a.csv",
        np.column_stack(columns),
        delimiter=",",
        fmt="%.5f",
        header="time_s,reference_speed_m_s,wheel_speed_1_m_s,wheel_speed_2_m_s",
        comments="",
    )
    (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
    return verdict.explain(recording.load(folder))


def check_of(account, name):
    return next(check for check in account.checks if check.name == name)


@pytest.mark.parametrize("seed", first_of(range(4)))
def test_a_slow_robot_without_faults_is_judged_and_consistent(tmp_path, seed):
    account = explained(tmp_path, seed, 0.001)
    assert account.verdict == "consistent"
    assert check_of(account, "wheel_radius").judged
    assert check_of(account, "driving_slip").judged


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_a_wheel_radius_of_a_slow_robot_is_found(tmp_path, seed):
    account = explained(tmp_path, seed, 0.001, share_of_wheel=0.02)
    (finding,) = [*account.findings, *account.unknown]
    assert finding.name == "wheel_radius"
    assert finding.channels == ("axle 1",)


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_driving_slip_of_a_slow_robot_is_found(tmp_path, seed):
    account = explained(tmp_path, seed, 0.001, share_of_wheel=1.5, is_brief=True)
    assert {finding.name for finding in account.findings} == {"driving_slip"}
    assert account.unknown == []
    assert account.findings[0].start_s == pytest.approx(HIDDEN_S[0], abs=0.5)


def test_a_check_that_needs_more_speed_than_a_robot_has_is_not_judged(tmp_path):
    account = explained(tmp_path, 0, 0.02)
    assert account.verdict == "not_judged"
    for name in ("old_messages", "sensor_stuck"):
        check = check_of(account, name)
        assert not check.judged
        assert check.reason == judged.SLOW
        needed_m_s, fastest_m_s = check.values
        assert needed_m_s > fastest_m_s
    assert check_of(account, "wrong_unit").reason == judged.SLOW_FOR_UNIT


def test_a_stuck_sensor_of_a_slow_robot_is_found(tmp_path):
    explained(tmp_path, 3, 0.001)
    rows = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    is_held = (rows[:, 0] > 40.0) & (rows[:, 0] < 70.0)
    rows[is_held, 3] = rows[np.argmax(is_held), 3]
    head = (tmp_path / "a.csv").read_text().splitlines()[0]
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", fmt="%.5f", header=head, comments="")
    account = verdict.explain(recording.load(tmp_path))
    stuck = [finding for finding in account.findings if finding.name == "sensor_stuck"]
    assert [finding.channels for finding in stuck] == [("axle 2",)]
