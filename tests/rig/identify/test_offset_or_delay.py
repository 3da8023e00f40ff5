"""An offset and a delay look alike in braking at one rate; steady driving distinguishes them."""

import numpy as np
import pytest
from tiers import first_of

from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import recording, verdict
from rollerrig.rig.identify.train_recorder.alignment import Scale
from rollerrig.rig.identify.train_recorder.findings import OffsetOrDelay, ScaleOrOffset

RATE_HZ = 10.0
DECELERATION_M_S2 = 0.4

# s and m/s: gentle braking alone, and driving with several visits of low and of high speed
BRAKING = [(0, 40), (95, 2)]
DRIVING = [(0, 5), (40, 30), (90, 30), (140, 8), (160, 8), (190, 20), (240, 20), (280, 3)]
CRUISING = [(0, 25), (120, 27), (240, 25)]


def explained(folder, profile, *, late_s=0.0, offset_m_s=0.0, share=0.0, wheels=None):
    """Return the explanation of four wheels and a reference that is late and has an offset.

    `share` is that of the reference beyond the speed, `wheels` the shares of wheels by axle.
    """
    points_s, speeds_m_s = np.transpose(profile)
    time_s = np.arange(0.0, points_s[-1], 1.0 / RATE_HZ)
    rng = np.random.default_rng(3)
    columns = [time_s]
    for axle in range(1, 5):
        true = np.interp(time_s, points_s, speeds_m_s) * (1.0 + (wheels or {}).get(axle, 0.0))
        columns.append(true + 0.03 * rng.standard_normal(time_s.size))
    reference = np.interp(time_s - late_s, points_s, speeds_m_s) * (1.0 + share) + offset_m_s
    columns.append(reference + 0.04 * rng.standard_normal(time_s.size))
    names = [f"wheel_speed_{axle}_m_s" for axle in range(1, 5)]
    np.savetxt(
        folder / "run.csv",
        np.column_stack(columns),
        delimiter=",",
        fmt="%.3f",
        header=",".join(["time_s", *names, "reference_speed_m_s"]),
        comments="",
    )
    (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "run.csv"\n')
    return verdict.explain(recording.load(folder))


def test_a_usual_delay_of_the_reference_in_gentle_braking_is_no_finding(tmp_path):
    account = explained(tmp_path, BRAKING, late_s=0.5)
    assert account.verdict == "consistent"
    (check,) = [check for check in account.checks if check.name == "speed_offset"]
    late_s, offset_m_s = check.values
    assert not check.judged
    assert late_s == pytest.approx(0.5, abs=0.1)
    assert offset_m_s == pytest.approx(0.5 * DECELERATION_M_S2, abs=0.04)
    assert "record steady driving" in " ".join(report.story(account))


@pytest.mark.parametrize("fault", first_of([{"late_s": 1.5}, {"offset_m_s": 0.6}]))
def test_a_larger_one_in_braking_at_one_rate_is_unknown_with_both_causes(tmp_path, fault):
    account = explained(tmp_path, BRAKING, **fault)
    assert not account.findings
    (unknown,) = account.unknown
    assert unknown.channels == ("reference",)
    assert isinstance(unknown.details, OffsetOrDelay)
    assert unknown.details.delay_s == pytest.approx(1.5, abs=0.15)
    assert unknown.details.offset_m_s == pytest.approx(0.6, abs=0.05)
    assert "look alike" in " ".join(report.story(account))


def test_a_radius_is_right_beside_a_usual_delay_in_gentle_braking(tmp_path):
    account = explained(tmp_path, BRAKING, late_s=0.5, wheels={2: 0.01})
    (radius,) = account.findings
    assert (radius.name, radius.channels) == ("wheel_radius", ("axle 2",))
    assert radius.low <= -1.0 <= radius.high


@pytest.mark.nightly
def test_steady_driving_distinguishes_them(tmp_path):
    (offset,) = explained(tmp_path, DRIVING, offset_m_s=0.4).findings
    assert (offset.name, offset.channels) == ("speed_offset", ("reference",))
    assert offset.low <= 0.4 <= offset.high


def test_an_offset_is_found_beside_a_usual_delay(tmp_path):
    (offset,) = explained(tmp_path, DRIVING, late_s=0.5, offset_m_s=0.4).findings
    assert (offset.name, offset.channels) == ("speed_offset", ("reference",))
    assert offset.low <= 0.4 <= offset.high


@pytest.mark.parametrize("fault", first_of([{"share": 0.04}, {"offset_m_s": 1.0}]))
def test_at_one_speed_a_factor_and_an_offset_of_the_reference_are_unknown(tmp_path, fault):
    account = explained(tmp_path, CRUISING, **fault)
    assert not account.findings
    (unknown,) = account.unknown
    assert isinstance(unknown.details, ScaleOrOffset)
    assert unknown.details.scale_percent == pytest.approx(4.0, abs=0.3)
    assert unknown.details.offset_m_s == pytest.approx(1.0, abs=0.1)
    assert "record low and high speeds" in " ".join(report.story(account))


def test_a_scale_gives_the_true_speeds_of_recorded_ones_and_back():
    scale = Scale(ratio=0.02, offset_m_s=0.4)
    recorded = scale.recorded(np.array([0.5, 10.0]))
    np.testing.assert_allclose(recorded, [0.91, 10.6])
    np.testing.assert_allclose(scale.corrected(recorded), [0.5, 10.0])
    # a wheel that stands does not roll backwards because of the offset
    assert scale.corrected(np.array([0.0])) == [0.0]
