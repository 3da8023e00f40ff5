"""Channels that are compared at wrong times, or that stop, are no stuck sensors and no slides.

The vehicle is a road vehicle in traffic, with new speeds and new noise in each test.
"""

from pathlib import Path

import numpy as np
import pytest
from tiers import first_of

from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import judged, recording, verdict

# of the vehicle's speed, s
STEP_S = 0.02

# m/s. A pulse sensor reads zero below it.
LEAST_SEEN_M_S = 1.1


def traffic(seconds, seed):
    """Return the speed of a vehicle in traffic (n,), m/s, every STEP_S: starts, cruises, stops."""
    rng = np.random.default_rng(seed)
    speeds_m_s = [0.0]
    points_s = [0.0]
    while points_s[-1] < seconds:
        target_m_s = float(rng.choice([0.0, rng.uniform(6.0, 16.0), rng.uniform(10.0, 20.0)]))
        rate_m_s2 = rng.uniform(0.6, 2.0)
        points_s.append(points_s[-1] + abs(target_m_s - speeds_m_s[-1]) / rate_m_s2 + 0.5)
        speeds_m_s.append(target_m_s)
        points_s.append(points_s[-1] + rng.uniform(4.0, 15.0))
        speeds_m_s.append(max(target_m_s + rng.normal(0.0, 0.4), 0.0))
    time_s = np.arange(0.0, seconds, STEP_S)
    speed = np.interp(time_s, points_s, speeds_m_s)
    width = np.ones(25) / 25.0
    return time_s, np.convolve(np.pad(speed, 12, mode="edge"), width, "valid")


def sampled(time_s, speed, at_s, noise_m_s, rng):
    """Return noisy samples of a speed, not below zero."""
    values = np.interp(at_s, time_s, speed)
    return np.maximum(values + noise_m_s * rng.standard_normal(at_s.size) * (values > 0.0), 0.0)


class Van:
    """One wheel speed in steps of 1 km/h, and a reference; a test changes one of them."""

    def __init__(self, seconds=600, rate_hz=5.0, seed=1):
        self.rng = np.random.default_rng(seed)
        self.motion = traffic(seconds, seed)
        self.time_s = np.arange(0.0, seconds - 5.0, 1.0 / rate_hz)
        self.reference_at_s = self.time_s
        self.frozen = {}
        self.on_change = False
        self.reads_offset_m_s = 0.0

    def columns(self):
        wheel = sampled(*self.motion, self.time_s, 0.0, self.rng)
        wheel = np.where(wheel < LEAST_SEEN_M_S, 0.0, wheel + self.reads_offset_m_s)
        wheel = np.floor(3.6 * wheel) / 3.6
        reference = sampled(*self.motion, self.reference_at_s, 0.02, self.rng)
        columns = {"wheel_speed_1_m_s": wheel, "reference_speed_m_s": reference}
        for name, (start_s, end_s) in self.frozen.items():
            part = (self.time_s > start_s) & (self.time_s < end_s)
            columns[name][part] = columns[name][part][0]
        return columns

    def explained(self, folder: Path):
        columns = self.columns()
        rows = np.column_stack([self.time_s, *(np.round(c, 3) for c in columns.values())])
        if self.on_change:
            rows[:, 2] = np.round(3.6 * rows[:, 2], 0) / 3.6
            changes = np.any(rows[1:, 1:] != rows[:-1, 1:], axis=1)
            rows = rows[np.concatenate([[True], changes])]
        header = ",".join(["time_s", *columns])
        np.savetxt(folder / "a.csv", rows, delimiter=",", fmt="%.4f", header=header, comments="")
        (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
        return verdict.explain(recording.load(folder))

    def braking_s(self):
        """Return a moment at which the vehicle starts to lose speed for some seconds."""
        time_s, speed = self.motion
        later = int(5.0 / STEP_S)
        loss = speed[:-later] - speed[later:]
        inside = (time_s[:-later] > 60.0) & (time_s[:-later] < self.time_s[-1] - 60.0)
        return float(time_s[:-later][np.argmax(np.where(inside, loss, -1.0))])


def named(account, name):
    return [finding for finding in account.findings if finding.name == name]


def names(account):
    return sorted({finding.name for finding in (*account.findings, *account.unknown)})


@pytest.mark.parametrize("seed", first_of([1, 2, 3]))
@pytest.mark.parametrize("rate_hz", first_of([1.0, 5.0, 10.0], count=2))
def test_a_late_reference_makes_no_stuck_sensor_and_no_slide(tmp_path, seed, rate_hz):
    van = Van(seed=seed, rate_hz=rate_hz)
    van.reference_at_s = van.time_s - 1.4
    account = van.explained(tmp_path)
    # the steps of the wheel's speed are rounded down
    allowed = {"speed_sensor_delay", "wheel_radius", "speed_offset"}
    assert set(names(account)) <= allowed, report.story(account)
    if rate_hz > 1.0:
        (late,) = named(account, "speed_sensor_delay")
        assert late.channels == ("reference",)


@pytest.mark.parametrize(
    ("channel", "on_change"),
    [
        ("wheel_speed_1_m_s", False),
        ("reference_speed_m_s", True),
        pytest.param("wheel_speed_1_m_s", True, marks=pytest.mark.nightly),
        pytest.param("reference_speed_m_s", False, marks=pytest.mark.nightly),
    ],
)
@pytest.mark.parametrize("seed", first_of([4, 5]))
def test_a_speed_that_stops_in_braking_is_stuck_and_no_wheel_slides(
    tmp_path, seed, channel, on_change
):
    van = Van(seed=seed)
    van.on_change = on_change
    start_s = van.braking_s()
    van.frozen[channel] = (start_s, start_s + 7.0)
    account = van.explained(tmp_path)
    (stuck,) = named(account, "sensor_stuck")
    assert stuck.channels == ("reference" if "reference" in channel else "axle 1",)
    assert start_s - 1.5 < stuck.start_s < start_s + 0.5
    assert abs(stuck.end_s - start_s - 7.0) < 0.6
    assert not named(account, "slide"), report.story(account)
    assert not named(account, "driving_slip")
    if on_change:
        # an interval without rows may be a steady speed
        (check,) = [check for check in account.checks if check.name == "sensor_dropout"]
        assert check.reason == judged.ON_CHANGE


@pytest.mark.parametrize(
    ("rate", "rate_hz"),
    [
        (0.992, 1.0),
        (1.01, 5.0),
        pytest.param(0.992, 5.0, marks=pytest.mark.nightly),
        pytest.param(1.01, 1.0, marks=pytest.mark.nightly),
    ],
)
def test_a_clock_that_is_a_little_fast_is_found_with_its_rate_and_nothing_else(
    tmp_path, rate, rate_hz
):
    van = Van(seed=6, rate_hz=rate_hz)
    # reference(t) is the speed of t / rate
    van.reference_at_s = van.time_s / rate
    account = van.explained(tmp_path)
    (clock,) = named(account, "clock_rate")
    assert clock.low - 2e-4 <= rate <= clock.high + 2e-4
    assert set(names(account)) <= {"clock_rate", "wheel_radius", "speed_offset"}
    assert f"{rate:.3g}" in report.sentence(clock)


@pytest.mark.parametrize("late_s", first_of([2.0, 0.0, 0.6]))
def test_a_delay_is_no_clock_at_another_rate(tmp_path, late_s):
    van = Van(seed=7)
    van.reference_at_s = van.time_s - late_s
    account = van.explained(tmp_path)
    assert not named(account, "clock_rate")
    (check,) = [check for check in account.checks if check.name == "clock_rate"]
    assert check.judged
    assert 1.001 < check.smallest < 1.01


@pytest.mark.parametrize("seed", first_of([8, 9]))
def test_a_sensor_that_reads_zero_at_low_speed_does_not_slide_beside_an_offset(tmp_path, seed):
    van = Van(seed=seed)
    van.reads_offset_m_s = 0.4
    account = van.explained(tmp_path)
    assert not named(account, "slide"), report.story(account)


def test_a_gap_of_the_rows_is_no_drop_out_of_a_slow_sensor_before_it(tmp_path):
    van = Van(seed=10)
    start_s = van.braking_s()
    keep = (van.time_s < start_s) | (van.time_s > start_s + 20.0)
    van.time_s = van.time_s[keep]
    van.reference_at_s = van.time_s
    account = van.explained(tmp_path)
    (gap,) = named(account, "sensor_dropout")
    assert gap.size == pytest.approx(20.0, abs=0.5)


# --- four wheels at 50 Hz, a receiver that repeats its values ---


def four_wheels(seed, *, frozen=None, late=None):
    """Return rows of four wheels at 50 Hz and a receiver at 10 Hz: time, wheels, reference.

    `frozen`: start and end, s, of a hold of the receiver. `late`: axle and delay, s.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 60.0, 0.02)
    points_s = np.array([0, 6, 22, 27, 33, 45, 60.0]) + rng.uniform(-0.5, 0.5, 7)
    motion = (points_s, np.array([8.0, 17.5, 18.0, 13.5, 13.8, 18.5, 16.0]))
    columns = [time_s]
    for axle in range(1, 5):
        at_s = time_s - (late[1] if late and late[0] == axle else 0.0)
        columns.append(np.interp(at_s, *motion) + 0.03 * rng.standard_normal(time_s.size))
    updates_s = np.floor(time_s * 10.0 + 1e-6) / 10.0
    noise = np.interp(updates_s, np.arange(0, 61, 0.1), 0.05 * rng.standard_normal(610))
    receiver = np.interp(updates_s, *motion) + noise
    if frozen:
        part = (time_s > frozen[0]) & (time_s < frozen[1])
        receiver[part] = receiver[part][0]
    return np.column_stack([*columns, receiver])


def account_of(folder, rows):
    header = "time_s," + ",".join(f"wheel_speed_{axle}_m_s" for axle in range(1, 5))
    header += ",reference_speed_m_s"
    np.savetxt(folder / "a.csv", rows, delimiter=",", fmt="%.3f", header=header, comments="")
    (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
    return verdict.explain(recording.load(folder))


@pytest.mark.parametrize("seed", first_of([11, 12, 13]))
def test_a_receiver_that_stops_in_braking_is_stuck_and_the_wheels_roll(tmp_path, seed):
    account = account_of(tmp_path, four_wheels(seed, frozen=(21.0, 28.0)))
    assert names(account) == ["sensor_stuck"], report.story(account)


@pytest.mark.parametrize("seed", first_of([14, 15]))
def test_a_late_wheel_does_not_slide_before_the_other_channels_begin(tmp_path, seed):
    account = account_of(tmp_path, four_wheels(seed, late=(1, 0.9)))
    assert names(account) == ["speed_sensor_delay"], report.story(account)


@pytest.mark.parametrize("every", first_of([25, 1]))
def test_a_column_that_is_written_twice_is_a_copy_also_at_few_samples(tmp_path, every):
    rows = four_wheels(16)[::every]
    rows[:, 2] = rows[:, 1]
    account = account_of(tmp_path, rows)
    (copy,) = named(account, "copy")
    assert copy.channels == ("axle 2",)


def test_stamps_that_jump_ahead_and_back_while_the_vehicle_cruises_are_one_clock_step(tmp_path):
    time_s = np.arange(0.0, 80.0, 0.1)
    rng = np.random.default_rng(17)
    speed = np.interp(time_s, [0, 20, 60, 80], [5.0, 20.0, 20.0, 5.0])
    columns = [speed + 0.03 * rng.standard_normal(time_s.size) for _ in range(5)]
    # nothing shows at the first jump whether time has passed
    stamps_s = np.where((time_s > 30.0) & (time_s < 45.0), time_s + 1.0, time_s)
    account = account_of(tmp_path, np.column_stack([stamps_s, *columns]))
    (step,) = named(account, "clock_step")
    assert names(account) == ["clock_step"]
    assert step.low <= 1.0 <= step.high
    assert step.details.returns


def test_at_nearly_one_speed_a_radius_is_reported_with_the_offset_that_looks_the_same(tmp_path):
    time_s = np.arange(0.0, 120.0, 0.1)
    rng = np.random.default_rng(18)
    speed = np.interp(time_s, [0, 40, 80, 120], [17.0, 19.0, 18.0, 18.5])
    columns = [speed + 0.03 * rng.standard_normal(time_s.size) for _ in range(3)]
    columns[0] = columns[0] + 0.3
    header = "time_s,wheel_speed_1_m_s,wheel_speed_2_m_s,reference_speed_m_s"
    rows = np.column_stack([time_s, *columns])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", fmt="%.3f", header=header, comments="")
    (tmp_path / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
    account = verdict.explain(recording.load(tmp_path))
    (radius,) = account.findings
    assert radius.name == "wheel_radius"
    assert radius.details.rival.offset_m_s == pytest.approx(0.3, abs=0.03)
    assert "or its speed has an offset of +0.3 m/s" in report.sentence(radius)
    (cause,) = report.as_json(account)["causes"]
    assert cause["rival"]["name"] == "speed_offset"


@pytest.mark.parametrize("seed", first_of(range(50, 56)))
@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_a_gap_of_a_small_robot_that_repeats_its_motion_is_a_gap(tmp_path, seed, rate_hz):
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 70.0, 1.0 / rate_hz)
    period_s = rng.uniform(1.5, 4.0)
    speed = 0.3 + 0.12 * np.sin(2.0 * np.pi * time_s / period_s + rng.uniform(0.0, 6.0))
    columns = [time_s, *(speed + 0.004 * rng.standard_normal(time_s.size) for _ in range(2))]
    rows = np.column_stack(columns)
    start_s = rng.uniform(20.0, 40.0)
    rows = rows[(time_s < start_s) | (time_s > start_s + 6.0)]
    header = "time_s,wheel_speed_1_m_s,wheel_speed_2_m_s"
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", fmt="%.3f", header=header, comments="")
    (tmp_path / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
    account = verdict.explain(recording.load(tmp_path))
    (gap,) = account.findings
    assert gap.name == "sensor_dropout", report.story(account)
    assert gap.size == pytest.approx(6.0, abs=0.2)
