"""Values that mean "not available" are no speeds; speeds in another unit are."""

import numpy as np
import pytest

from rollerrig.rig.identify.train_recorder import recording, verdict
from rollerrig.rig.identify.train_recorder.recording import not_available

STEP_S = 0.1
# all ones in 16 bits, with steps of 0.1 km/h
ALL_ONES_KM_H = 6553.5


def ride(folder, spoil):
    """Write a ride of two wheels and a receiver in km/h; `spoil` changes the first wheel."""
    rng = np.random.default_rng(1)
    time_s = STEP_S * np.arange(3000)
    speed = 80.0 + 10.0 * np.sin(2.0 * np.pi * time_s / 60.0)
    columns = [speed + 0.05 * rng.standard_normal(time_s.size) for _ in range(3)]
    spoil(columns[0])
    np.savetxt(
        folder / "a.csv",
        np.column_stack([time_s, *columns]),
        delimiter=",",
        header="t,v1,v2,gps",
        comments="",
        fmt="%.6g",
    )
    (folder / "dataset.toml").write_text(
        'kind = "recorder"\n[channels]\ntime_s = { column = "t" }\n'
        'wheel_speed_1_m_s = { column = "v1", unit = "km/h" }\n'
        'wheel_speed_2_m_s = { column = "v2", unit = "km/h" }\n'
        'reference_speed_m_s = { column = "gps", unit = "km/h" }\n[[run]]\nfile = "a.csv"\n'
    )
    return folder


@pytest.mark.parametrize("seconds", [4.0, 20.0])
def test_all_ones_are_a_drop_out_and_no_slip(seconds, tmp_path):
    def spoil(speed):
        speed[1000 : 1000 + int(seconds / STEP_S)] = ALL_ONES_KM_H

    recorded = recording.load(ride(tmp_path, spoil))
    assert any("mean 'not available'" in note for note in recorded.warnings)
    account = verdict.explain(recorded)
    assert [finding.name for finding in account.findings] == ["sensor_dropout"]
    assert account.findings[0].size == pytest.approx(seconds, abs=0.3)


def test_single_codes_leave_the_recording_consistent(tmp_path):
    def spoil(speed):
        speed[[500, 1500]] = ALL_ONES_KM_H

    account = verdict.explain(recording.load(ride(tmp_path, spoil)))
    assert account.verdict == "consistent"


def test_speeds_of_another_unit_are_no_codes():
    speed_km_h = np.linspace(0.0, 250.0, 500)
    assert not not_available(speed_km_h).any()
    assert not not_available(np.full(10, 250.0)).any()


def test_codes_near_each_other_are_left_out():
    speed_m_s = np.concatenate([np.linspace(0.0, 40.0, 500), [1820.4, 1820.4, 1820.1]])
    assert np.flatnonzero(not_available(speed_m_s)).tolist() == [500, 501, 502]


def test_many_values_that_no_vehicle_reaches_are_no_codes():
    speed_m_s = np.concatenate([np.linspace(0.0, 40.0, 500), np.linspace(200.0, 900.0, 20)])
    assert not not_available(speed_m_s).any()
