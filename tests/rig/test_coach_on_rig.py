"""The plant with the coach in 3D as its vehicle: same signals, same laws, nearly the same stop."""

import numpy as np
import pytest
from rolling import SOAP, TRACK, Rig

COACH = {"model": "multibody"}


@pytest.fixture(scope="module")
def both():
    """Return rig and history of six seconds of full brake on soap, on the track, by model."""
    runs = {}
    for model in ("planar", "multibody"):
        rig = Rig(30.0, vehicle={"model": model}, adhesion=SOAP, rig=TRACK)
        runs[model] = rig, rig.roll(6.0)
    return runs


def test_the_coach_in_3d_brakes_as_the_planar_vehicle_does(both):
    lost = {model: -history.change("vehicle_speed") for model, (_, history) in both.items()}
    assert lost["multibody"] == pytest.approx(lost["planar"], rel=0.1)


def test_loads_sum_to_the_weight_and_lean_forward(both):
    _, history = both["multibody"]
    loads = history.wheel_load
    assert np.mean(loads[-1000:].sum(1)) == pytest.approx(43000.0 * 9.80665, rel=1e-3)
    planar = both["planar"][1].wheel_load
    np.testing.assert_allclose(loads[-1000:].mean(0), planar[-1000:].mean(0), rtol=0.03)


def test_the_observed_quantities_obey_the_equation_of_the_vehicle(both):
    _, history = both["multibody"]
    pulled = history.integral(history.contact_force_N.sum(1))
    resisted = history.integral(600.0 + 0.9375 * history.vehicle_speed**2)
    assert -43000.0 * history.change("vehicle_speed") == pytest.approx(pulled + resisted, rel=2e-3)


def test_the_observed_quantities_obey_the_equation_of_the_wheelset(both):
    _, history = both["multibody"]
    moment = 0.4447 * history.contact_force_N - history.brake_torque
    gained = 160.0 * history.change("wheel_speed")
    torque = history.integral(np.abs(history.brake_torque))
    np.testing.assert_allclose(gained, history.integral(moment), atol=0.01 * torque.max())


def test_a_run_repeats_bit_for_bit(both):
    _, history = both["multibody"]
    repeated = Rig(30.0, vehicle=COACH, adhesion=SOAP, rig=TRACK).roll(1.0)
    np.testing.assert_array_equal(repeated.log, history.log[: repeated.log.shape[0]])


def test_a_standing_coach_swings_out_to_its_static_loads():
    rig = Rig(1.0, vehicle=COACH, rig=TRACK)
    rig.roll(12.0)
    assert rig.state.standing[0] == 1.0
    assert rig.state.vehicle_speed[0] == 0.0
    np.testing.assert_allclose(rig.state.wheel_load, 43000.0 * 9.80665 / 4.0, rtol=0.01)


def test_on_rollers_the_coach_brakes_too_and_the_motors_hold_the_rollers():
    rig = Rig(20.0, vehicle=COACH, adhesion=SOAP)
    history = rig.roll(3.0)
    assert history.change("vehicle_speed") < -2.0
    surface = rig.params.drive.roller_radius_m * rig.state.roller_speed
    np.testing.assert_allclose(surface, rig.state.vehicle_speed[0], atol=0.3)
