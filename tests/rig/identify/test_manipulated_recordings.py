"""One known change of a measured recording is found, and nothing else is reported.

The recording is a car with four wheels at 50 Hz and a receiver at 10 Hz (comma_50hz_mit). Nothing
is known to be wrong with it but the radii that are set in the car.
"""

import functools
from pathlib import Path

import numpy as np
import pytest
from tiers import first_of

from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import recording, verdict
from rollerrig.rig.identify.train_recorder.faults import on_change
from rollerrig.rig.identify.train_recorder.findings import CopyOfChannel

CAR = Path(__file__).parents[2] / "data/measured/comma_50hz_mit"

# % of the radius by axle, by GNSS over the whole drive
RADII = {"axle 1": 0.85, "axle 2": 0.80, "axle 3": 0.94, "axle 4": 0.99}
TIME = 0
WHEELS = slice(1, 5)
REFERENCE = 5


@functools.cache
def measured():
    """Return the rows of the recording: time, s; four wheels, m/s; the receiver, m/s."""
    rows = np.genfromtxt(CAR / "a.csv", delimiter=",", skip_header=1)
    rows[:, WHEELS] /= 3.6
    return rows


def explained(folder, rows, *, with_reference=True):
    """Return the explanation of rows, with steps of 0.01 m/s."""
    names = ["time_s", *(f"wheel_speed_{axle}_m_s" for axle in range(1, 5)), "reference_speed_m_s"]
    columns = len(names) if with_reference else len(names) - 1
    header = ",".join(names[:columns])
    np.savetxt(
        folder / "a.csv", rows[:, :columns], delimiter=",", fmt="%.3f", header=header, comments=""
    )
    (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
    return verdict.explain(recording.load(folder))


def radii_of(account):
    """Return the findings about radii by channel."""
    return {f.channels[0]: f for f in account.findings if f.name == "wheel_radius"}


def others(account):
    """Return the names of all findings but those about radii."""
    found = (*account.findings, *account.unknown)
    return [finding.name for finding in found if finding.name != "wheel_radius"]


def half_sine(time_s, starts_s, duration_s):
    """Return bumps of height 1, (n,)."""
    height = np.zeros(time_s.size)
    for start_s in starts_s:
        share = (time_s - start_s) / duration_s
        inside = (share > 0.0) & (share < 1.0)
        height[inside] += np.sin(np.pi * share[inside])
    return height


def test_the_recording_itself_shows_its_radii_and_no_offset_from_one_curve():
    account = verdict.explain(recording.load(CAR))
    assert not others(account), report.story(account)
    radii = radii_of(account)
    for channel, true in RADII.items():
        assert radii[channel].low <= true <= radii[channel].high


def test_the_repeated_values_of_a_slow_receiver_are_no_measurements():
    (run,) = recording.load(CAR).runs
    _, intervals_s = on_change.updates(run)
    assert list(intervals_s) == ["reference"]
    assert intervals_s["reference"] == pytest.approx(0.1)


def test_a_smaller_wheel_is_found_with_its_size(tmp_path):
    rows = measured().copy()
    rows[:, 3] *= 1.03
    account = explained(tmp_path, rows)
    assert not others(account)
    smaller = radii_of(account)["axle 3"]
    # the wheel was 0.94 % larger than set, and now turns 3 % faster
    assert smaller.low <= 100.0 * (1.0094 / 1.03 - 1.0) <= smaller.high


def test_a_smaller_wheel_is_found_without_a_reference(tmp_path):
    rows = measured().copy()
    rows[:, 3] *= 1.03
    account = explained(tmp_path, rows, with_reference=False)
    assert not others(account)
    assert list(radii_of(account)) == ["axle 3"]


def test_a_column_that_is_written_twice_is_a_copy(tmp_path):
    rows = measured().copy()
    rows[:, 2] = rows[:, 1]
    account = explained(tmp_path, rows)
    (copy,) = [finding for finding in account.findings if finding.name == "copy"]
    assert copy.channels == ("axle 2",)
    assert copy.details == CopyOfChannel("axle 1")
    assert others(account) == ["copy"]


@pytest.mark.parametrize("every", first_of([25, 1]))
def test_missing_samples_are_a_gap_and_no_step_of_the_clock(tmp_path, every):
    rows = measured()[::every]
    kept = (rows[:, TIME] < 20.0) | (rows[:, TIME] > 25.0)
    account = explained(tmp_path, rows[kept])
    assert others(account) == ["sensor_dropout"]


def test_abs_cycles_are_counted_with_start_end_and_depth(tmp_path):
    rows = measured().copy()
    starts_s = 30.0 + 0.5 * np.arange(6)
    rows[:, 3] -= 4.0 * half_sine(rows[:, TIME], starts_s, 0.3)
    account = explained(tmp_path, rows)
    assert others(account) == ["slide"]
    (slide,) = account.slides
    cycles = slide.finding.details.cycles
    assert [cycle.channel for cycle in cycles] == ["axle 3"] * starts_s.size
    for cycle, start_s in zip(cycles, starts_s, strict=True):
        assert start_s - 0.02 <= cycle.start_s <= start_s + 0.06
        assert start_s + 0.24 <= cycle.end_s <= start_s + 0.32
        assert cycle.depth_m_s == pytest.approx(4.0, abs=0.25)


def test_a_wheel_that_spins_does_not_slide_without_a_reference(tmp_path):
    rows = measured().copy()
    rows[:, 3] += 4.0 * half_sine(rows[:, TIME], (12.0, 17.0), 2.0)
    account = explained(tmp_path, rows, with_reference=False)
    assert "slide" not in others(account)


def test_speeds_from_few_pulses_have_no_drop_outs_and_no_old_messages(tmp_path):
    rows = measured().copy()
    # 0.15 m of rolling a pulse: two or three pulses in each interval at 20 m/s, often none at 5 m/s
    pulse_m = 0.15
    step_s = 0.02
    moving = rows[:, WHEELS] * (0.2 + 0.8 * np.minimum(rows[:, TIME] / 30.0, 1.0))[:, None]
    way_m = np.cumsum(moving, axis=0) * step_s
    pulses = np.diff(np.floor(way_m / pulse_m), axis=0, prepend=0.0)
    rows[:, WHEELS] = pulses * pulse_m / step_s
    account = explained(tmp_path, rows, with_reference=False)
    assert not others(account), report.story(account)
