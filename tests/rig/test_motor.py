"""The roller motors, and the control that holds a roller's surface at the vehicle's speed."""

import numpy as np
import pytest
from rolling import DRY, SOAP, Rig

from rollerrig.rig import motor

DRIVE = Rig(30.0).params.drive


def limited(demand_Nm, speed_rad_s):
    """Return the torque of a motor of the shipped rig."""
    limits = DRIVE.max_torque_Nm, DRIVE.max_power_W, DRIVE.max_speed_rad_s
    return motor.limit(demand_Nm, speed_rad_s, *limits)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_is_limited_at_low_speed_and_power_at_high_speed(sign):
    assert limited(sign * 1e6, 0.0) == sign * DRIVE.max_torque_Nm
    assert limited(sign * 1e6, 10.0) == sign * DRIVE.max_torque_Nm

    # twice the speed at which both limits meet
    fast_rad_s = 2.0 * DRIVE.max_power_W / DRIVE.max_torque_Nm
    fast_rad_s = min(fast_rad_s, DRIVE.max_speed_rad_s)
    torque_Nm = limited(sign * 1e6, fast_rad_s)
    assert torque_Nm == pytest.approx(sign * DRIVE.max_power_W / fast_rad_s)
    assert limited(sign * 123.0, fast_rad_s) == sign * 123.0


def test_beyond_its_speed_a_motor_brakes_but_does_not_drive():
    over_rad_s = 1.01 * DRIVE.max_speed_rad_s
    assert limited(100.0, over_rad_s) == 0.0
    assert limited(-100.0, -over_rad_s) == 0.0
    assert limited(-100.0, over_rad_s) == -100.0
    assert limited(100.0, -over_rad_s) == 100.0


def test_power_never_exceeds_the_limit_at_any_speed():
    for speed_rad_s in np.linspace(-2.0, 2.0, 401) * DRIVE.max_speed_rad_s:
        for demand_Nm in (-1e9, -5e3, 0.0, 5e3, 1e9):
            torque_Nm = limited(demand_Nm, speed_rad_s)
            assert abs(torque_Nm) <= min(DRIVE.max_torque_Nm, abs(demand_Nm))
            assert torque_Nm * speed_rad_s <= DRIVE.max_power_W * (1 + 1e-12)


def test_torque_follows_a_step_with_its_time_constant():
    time_constant_s = 0.02
    demands_Nm = np.array([1000.0, -1000.0, 500.0, 0.0])
    rig = Rig(10.0, drive={"torque_time_constant_s": time_constant_s})
    rig.state.motor_torque_demand[:] = demands_Nm
    run = rig.roll(0.1, demand_Pa=0.0, controlled=False)
    risen_share = -np.expm1(-run.time / time_constant_s)
    expected_Nm = np.outer(risen_share, demands_Nm)
    np.testing.assert_allclose(run.motor_torque, expected_Nm, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", [DRY, SOAP])
def test_rollers_keep_the_speed_of_the_virtual_vehicle(law):
    rig = Rig(42.3, adhesion=law)
    run = rig.roll(36.0)
    surface_m_s = rig.params.drive.roller_radius_m * run.roller_speed
    error_m_s = np.abs(surface_m_s - run.vehicle_speed[:, None])
    moves = run.vehicle_speed > 0.5
    assert error_m_s[moves].max() < 0.02
    assert np.abs(run.motor_torque).max() <= rig.params.drive.max_torque_Nm


def test_a_motor_that_is_too_weak_lets_the_roller_fall_behind_and_stays_within_its_limit():
    weak = {"max_torque_Nm": 2000.0, "max_power_W": 5e4}
    run = Rig(42.3, adhesion=DRY, drive=weak).roll(5.0)
    power_W = run.motor_torque * run.roller_speed
    assert power_W.max() <= weak["max_power_W"] * 1.01
    assert np.abs(run.motor_torque).max() <= weak["max_torque_Nm"]
    assert (42.3 - run.roller_speed[-1]).min() > 5.0
    assert np.isfinite(run.log).all()
