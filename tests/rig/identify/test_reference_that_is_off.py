"""Wheels that agree with each other do not slide: a reference that is off is the finding."""

import car_drive
import numpy as np
import pytest

from rollerrig.rig.identify.train_recorder import findings, recording, verdict


def account_of(folder, of, speeds, read):
    return verdict.explain(recording.load(car_drive.write(folder, of, speeds, read)))


def names_of(account):
    return {finding.name for finding in account.findings}


@pytest.mark.parametrize("seed", [1, 2])
def test_a_speedometer_is_the_finding_and_no_wheel_slides(seed, tmp_path):
    of = car_drive.drive(seed)
    read = car_drive.reference(of, seed, scale=0.04, offset_m_s=0.075, noise_m_s=0.0)
    account = account_of(tmp_path, of, car_drive.wheels(of, seed), read)
    assert "speed_scale" in names_of(account)
    assert not names_of(account) & {"slide", "driving_slip"}
    scale = next(finding for finding in account.findings if finding.name == "speed_scale")
    assert scale.channels == ("reference",)
    # against the wheels, which read 0.225 % too much on average
    assert scale.low < 100.0 * (1.04 / (1.0 + np.mean(car_drive.RADII)) - 1.0) < scale.high
    assert scale.details.offset_m_s[0] == pytest.approx(0.075, abs=0.01)


def test_a_speedometer_in_steps_of_1_km_h_is_no_slide(tmp_path):
    of = car_drive.drive(3)
    read = car_drive.reference(of, 3, 0.04, 0.075, noise_m_s=0.0, step_m_s=1 / 3.6)
    account = account_of(tmp_path, of, car_drive.wheels(of, 3), read)
    assert not names_of(account) & {"slide", "driving_slip"}
    doubted = [*account.findings, *account.unknown]
    assert any(finding.channels == ("reference",) for finding in doubted)


def test_a_reference_that_leaves_wheels_that_agree_is_off_and_they_do_not_slide(tmp_path):
    of = car_drive.drive(4)
    read = car_drive.reference(of, 4)
    first = int(np.flatnonzero(of.change_m_s2 < -6.0)[0])
    read[first : first + 150] += 3.0
    account = account_of(tmp_path, of, car_drive.wheels(of, 4), read)
    assert "slide" not in names_of(account)
    off = [f for f in account.unknown if isinstance(f.details, findings.ReferenceOff)]
    assert [(f.channels, f.details.faster) for f in off] == [(("reference",), True)]
    assert off[0].start_s == pytest.approx(of.time_s[first], abs=0.5)


def test_front_wheels_that_agree_do_not_slip_where_the_reference_is_near_0(tmp_path):
    of = car_drive.drive(5)
    speeds = car_drive.wheels(of, 5)
    read = car_drive.reference(of, 5)
    # the receiver hardly shows speeds below 3 m/s, and the rear wheels spin at each start
    is_start = (of.speed_m_s < 3.0) & (of.change_m_s2 > 0.5)
    read[is_start] *= 0.3
    speeds[2:, is_start] += 5.0
    account = account_of(tmp_path, of, speeds, read)
    slips = [finding for finding in account.findings if finding.name == "driving_slip"]
    assert slips
    assert {name for finding in slips for name in finding.channels} == {"axle 3", "axle 4"}
