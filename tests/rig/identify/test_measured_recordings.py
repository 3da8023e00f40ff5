"""Measured recordings, and recordings of their shape, are explained as is known independently.

The recordings are in tests/data/measured, with their sources and licences in tests/data/README.md.
"""

import functools
import math
from pathlib import Path

import numpy as np
import pytest
from tiers import first_of

from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import judged, recording, verdict

DATA = Path(__file__).parents[2] / "data/measured"
CASES = sorted(
    path.parent.relative_to(DATA).as_posix()
    for path in DATA.rglob("dataset.toml")
    if 'kind = "recorder"' in path.read_text()
)

# `make test` explains these, one or two of each kind of answer
SOME = (
    "abs_slide_short",
    "clock_factor_two",
    "comma_60s_mit",
    "driven_wheel_slips",
    "hard_driving_clean",
    "radius_one_wheel_plateaus",
    "slow_robot",
    "speed_offset",
    "speedometer_high",
    "train_gap",
)

# % of the radius, by GNSS over the whole drive
COMMA_RADII = {"axle 1": 0.85, "axle 2": 0.80, "axle 3": 0.94, "axle 4": 0.99}


def in_tiers(cases):
    """Return cases as parameters; those that are not in SOME are in the nightly tier."""
    return first_of(
        sorted(cases, key=lambda case: case not in SOME), sum(case in SOME for case in cases)
    )


@functools.cache
def account_of(case):
    """Return the explanation of one recording."""
    return verdict.explain(recording.load(DATA / case))


def names_of(account):
    """Return the names of all findings, also of those without a cause."""
    return {finding.name for finding in (*account.findings, *account.unknown)}


def holds(finding, true):
    """Return whether the 95 % interval of a finding holds the true size."""
    return finding.low <= true <= finding.high


# --- nothing is wrong ---


@pytest.mark.parametrize(
    "case",
    in_tiers(
        [
            "hard_driving_clean",
            "rec_1hz_sound",
            "rec_on_change",
            "as_written/km_h_one_digit",
            "as_written/m_s_four_digits",
        ]
    ),
)
def test_a_recording_without_faults_is_consistent(case):
    account = account_of(case)
    assert account.verdict == "consistent", report.story(account)


def test_hard_braking_is_taken_from_the_data_and_no_unit_is_blamed():
    account = account_of("hard_driving_clean")
    assert 6.5 < account.aligned[0].run.hardest_m_s2 < 9.0
    assert "wrong_unit" not in names_of(account)


@pytest.mark.nightly
def test_a_recorder_that_logs_on_change_is_recognised_and_its_gaps_are_not_judged():
    account = account_of("rec_on_change")
    assert all(a.run.logs_on_change for a in account.aligned)
    check = check_of(account, "sensor_dropout")
    assert not check.judged
    assert check.reason == judged.ON_CHANGE


# --- radii, scales and offsets ---


def test_the_radii_of_a_car_are_those_by_gnss():
    account = account_of("comma_60s_mit")
    assert names_of(account) == {"wheel_radius"}, report.story(account)
    found = {finding.channels[0]: finding for finding in account.findings}
    assert found.keys() == COMMA_RADII.keys()
    for name, true in COMMA_RADII.items():
        assert holds(found[name], true), report.story(account)


def test_the_radius_of_one_wheel_shows_without_a_brake_demand():
    account = account_of("radius_one_wheel_plateaus")
    (finding,) = account.findings
    assert finding.name == "wheel_radius"
    assert holds(finding, 1.0)
    assert account.verdict == "explained"


def test_an_offset_is_not_reported_as_a_radius_or_a_slide():
    account = account_of("speed_offset")
    (finding,) = account.findings
    assert names_of(account) == {"speed_offset"}
    assert finding.channels == ("axle 1",)
    assert finding.size == pytest.approx(0.4, abs=0.02)


def test_a_speedometer_has_its_scale_and_its_offset_from_one_fit():
    account = account_of("speedometer_high")
    (finding,) = account.findings
    assert names_of(account) == {"speed_scale"}
    assert finding.channels == ("reference",)
    assert holds(finding, 4.0)
    _, low, high = finding.details.offset_m_s
    assert low <= 0.075 <= high


def test_wheels_of_a_slow_robot_are_judged_with_limits_from_its_data():
    account = account_of("slow_robot")
    assert names_of(account) == {"speed_scale", "slide"}, report.story(account)
    scale = next(finding for finding in account.findings if finding.name == "speed_scale")
    # the wheels are 20 % fast against the reference
    assert holds(scale, 100.0 * (1.0 / 1.2 - 1.0))
    (slide,) = account.slides
    assert slide.finding.channels == ("axle 1",)
    assert slide.finding.details.duration_s == pytest.approx(4.0, abs=0.3)


# --- stamps ---


@pytest.mark.parametrize(
    ("case", "gap_s"),
    [
        ("train_gap", 120.1),
        pytest.param("gap_told_as_clock_step", 622.2, marks=pytest.mark.nightly),
        pytest.param("obd_gap_mit", 622.2, marks=pytest.mark.nightly),
    ],
)
def test_a_gap_is_a_gap_and_later_stamps_stay(case, gap_s):
    account = account_of(case)
    assert "clock_step" not in names_of(account)
    (gap,) = [finding for finding in account.findings if finding.name == "sensor_dropout"]
    assert gap.size == pytest.approx(gap_s, abs=0.3)
    recorded = account.recording.runs[0].of("speed")[0].time_s
    assert account.aligned[0].time_s[-1] == pytest.approx(recorded[-1], abs=1.0)
    assert not account.unknown


def test_a_reference_at_twice_the_rate_is_recognised_and_no_slide_is_reported():
    account = account_of("clock_factor_two")
    (finding,) = account.findings
    assert names_of(account) == {"clock_rate"}
    assert finding.size == 2.0


# --- slides and slip ---


@pytest.mark.parametrize("case", in_tiers(["driven_wheel_laps", "driven_wheel_slips"]))
def test_a_driven_wheel_that_slips_is_neither_late_nor_small(case):
    account = account_of(case)
    assert names_of(account) == {"driving_slip"}, report.story(account)
    assert {finding.channels for finding in account.findings} == {("axle 2",)}
    check = check_of(account, "wheel_radius")
    assert check.channels == ("axle 2",)
    assert check.reason == judged.UNSTEADY


def test_slides_of_a_car_shorter_than_half_a_second_are_found_with_their_cycles():
    account = account_of("abs_slide_short")
    assert names_of(account) == {"slide"}, report.story(account)
    assert len(account.slides) == 2
    for slide in account.slides:
        assert slide.finding.size == pytest.approx(5.0, abs=0.2)
        (cycle,) = slide.finding.details.cycles
        assert cycle.end_s - cycle.start_s == pytest.approx(0.45, abs=0.1)
        assert slide.adhesion.low < 0.9


# --- what could be judged ---


def check_of(account, name):
    """Return the check of one kind of finding."""
    return next(check for check in account.checks if check.name == name)


@pytest.mark.parametrize("case", in_tiers(CASES))
def test_every_kind_of_finding_is_judged_from_a_size_on_or_has_a_reason(case):
    account = account_of(case)
    written = report.as_json(account)["checks"]
    assert {check["name"] for check in written} == set(report.TITLES) - {"unknown"}
    for check in written:
        if check["judged"]:
            assert math.isfinite(check["smallest"]["value"])
            assert check["smallest"]["value"] > 0.0
            assert check["smallest"]["unit"]
        else:
            assert check["smallest"] is None
            assert check["reason"]
    text = " ".join(report.story(account))
    assert "Judged of the" in text
    assert "not statistically significant:" not in report.page(account)


@pytest.mark.parametrize("case", in_tiers(CASES))
def test_findings_of_a_size_are_larger_than_the_smallest_one_that_would_have_been_seen(case):
    account = account_of(case)
    for finding in account.findings:
        check = check_of(account, finding.name)
        assert check.judged
        if finding.name in ("wheel_radius", "sensor_dropout", "speed_offset", "speed_scale"):
            assert abs(finding.size) >= 0.99 * check.smallest


def write(folder, columns, keys):
    """Write a recording of these columns, with the channels `keys` (key -> column)."""
    names = list(columns)
    rows = [",".join(names)]
    for row in zip(*columns.values(), strict=True):
        rows.append(",".join(f"{value:.5f}" for value in row))
    (folder / "a.csv").write_text("\n".join(rows) + "\n")
    lines = ['kind = "recorder"', "[channels]"]
    lines += [f'{key} = "{column}"' for key, column in keys.items()]
    lines += ["[[run]]", 'file = "a.csv"']
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n")
    return folder


def test_a_vehicle_that_is_parked_is_not_judged(tmp_path):
    time_s = 0.1 * np.arange(600)
    rng = np.random.default_rng(1)
    columns = {
        "time_s": time_s,
        "v": 0.01 * rng.standard_normal(600),
        "ref": 0.01 * rng.standard_normal(600),
    }
    keys = {"time_s": "time_s", "wheel_speed_1_m_s": "v", "reference_speed_m_s": "ref"}
    account = verdict.explain(recording.load(write(tmp_path, columns, keys)))
    assert account.verdict == "not_judged", report.story(account)
    assert not check_of(account, "wheel_radius").judged


@pytest.mark.parametrize("with_yaw", [False, True])
def test_curves_are_no_radius_and_the_yaw_rate_takes_them_out(tmp_path, with_yaw):
    rng = np.random.default_rng(2)
    time_s = 0.05 * np.arange(8000)
    speed = 12.0 + 3.0 * np.sin(2 * np.pi * time_s / 180.0)
    yaw = 0.25 * np.sin(2 * np.pi * time_s / 47.0) * (np.sin(2 * np.pi * time_s / 130.0) > 0.0)
    noise = 0.03 * rng.standard_normal((3, time_s.size))
    columns = {
        "time_s": time_s,
        "ref": speed + noise[0],
        "left": 0.99 * (speed - 0.75 * yaw) + noise[1],
        "right": speed + 0.75 * yaw + noise[2],
        "yaw": yaw,
    }
    keys = {
        "time_s": "time_s",
        "reference_speed_m_s": "ref",
        "wheel_speed_1_m_s": "left",
        "wheel_speed_2_m_s": "right",
    }
    if with_yaw:
        keys["yaw_rate_rad_s"] = "yaw"
    account = verdict.explain(recording.load(write(tmp_path, columns, keys)))
    radii = [finding for finding in account.findings if finding.name == "wheel_radius"]
    assert names_of(account) <= {"wheel_radius"}, report.story(account)
    if with_yaw:
        (radius,) = radii
        assert radius.channels == ("axle 1",)
        assert holds(radius, 1.0)
    else:
        assert all(radius.channels == ("axle 1",) and holds(radius, 1.0) for radius in radii)
