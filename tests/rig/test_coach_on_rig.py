"""The plant with the coach in 3D as its vehicle: same signals, same laws, nearly the same stop."""

import numpy as np
import pytest
from rolling import SOAP, TRACK, Rig

COACH = {"model": "multibody"}
MASS_KG = 43000.0
WEIGHT_N = MASS_KG * 9.80665
WHEELSET_KGM2 = 160.0
# of the running circle of a loaded wheel, a little less than the nominal radius
ROLLING_RADIUS_M = 0.4447
LAST_SECOND = slice(-1000, None)


@pytest.fixture(scope="module")
def planar():
    """Return six seconds of full brake on soap, on the track, of the planar vehicle."""
    return Rig(30.0, vehicle={"model": "planar"}, adhesion=SOAP, rig=TRACK).roll(6.0)


@pytest.fixture(scope="module")
def coach():
    """Return the same six seconds of the coach in 3D."""
    return Rig(30.0, vehicle=COACH, adhesion=SOAP, rig=TRACK).roll(6.0)


def test_the_coach_in_3d_brakes_as_the_planar_vehicle_does(coach, planar):
    lost_m_s = -coach.change("vehicle_speed")
    assert lost_m_s == pytest.approx(-planar.change("vehicle_speed"), rel=0.1)


def test_loads_sum_to_the_weight_and_lean_forward(coach, planar):
    loads_N = coach.wheel_load[LAST_SECOND].mean(axis=0)
    assert loads_N.sum() == pytest.approx(WEIGHT_N, rel=1e-3)
    planar_N = planar.wheel_load[LAST_SECOND].mean(axis=0)
    np.testing.assert_allclose(loads_N, planar_N, rtol=0.03)


def test_the_observed_quantities_obey_the_equation_of_the_vehicle(coach):
    pulled_Ns = coach.integral(coach.contact_force_N.sum(axis=1))
    resisted_Ns = coach.integral(600.0 + 0.9375 * coach.vehicle_speed**2)
    lost_Ns = -MASS_KG * coach.change("vehicle_speed")
    assert lost_Ns == pytest.approx(pulled_Ns + resisted_Ns, rel=2e-3)


def test_the_observed_quantities_obey_the_equation_of_the_wheelset(coach):
    moment_Nm = ROLLING_RADIUS_M * coach.contact_force_N - coach.brake_torque
    gained_Nms = WHEELSET_KGM2 * coach.change("wheel_speed")
    braked_Nms = coach.integral(np.abs(coach.brake_torque))
    tolerance_Nms = 0.01 * braked_Nms.max()
    np.testing.assert_allclose(gained_Nms, coach.integral(moment_Nm), atol=tolerance_Nms)


def test_a_run_repeats_bit_for_bit(coach):
    repeated = Rig(30.0, vehicle=COACH, adhesion=SOAP, rig=TRACK).roll(1.0)
    np.testing.assert_array_equal(repeated.log, coach.log[: len(repeated.log)])


def test_a_standing_coach_swings_out_to_its_static_loads():
    rig = Rig(1.0, vehicle=COACH, rig=TRACK)
    rig.roll(12.0)
    assert rig.state.standing[0] == 1.0
    assert rig.state.vehicle_speed[0] == 0.0
    np.testing.assert_allclose(rig.state.wheel_load, WEIGHT_N / 4.0, rtol=0.01)


def test_on_rollers_the_coach_brakes_too_and_the_motors_hold_the_rollers():
    rig = Rig(20.0, vehicle=COACH, adhesion=SOAP)
    history = rig.roll(3.0)
    assert history.change("vehicle_speed") < -2.0
    surface_m_s = rig.params.drive.roller_radius_m * rig.state.roller_speed
    np.testing.assert_allclose(surface_m_s, rig.state.vehicle_speed[0], atol=0.3)
