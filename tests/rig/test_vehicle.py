"""The virtual vehicle: running resistance, load transfer, standstill."""

import math

import numpy as np
import pytest
from rolling import DRY, SOAP, TRACK, VENT, Rig

from rollerrig.rig import params, vehicle

# defaults of the parameters
COACH = {row.name: row.default for row in params.ROWS["vehicle"]}
GRAVITY_M_S2 = 9.80665
# wheelsets behind the first one
PLACES_M = np.array([0.0, 2.56, 19.0, 21.56])
# wheelsets turn with the vehicle: their inertia adds mass
TURNING_KG = 4 * COACH["wheelset_inertia_kgm2"] / COACH["wheel_radius_m"] ** 2


def test_resistance_is_the_polynomial_of_davis():
    coefficients = {
        "resistance_A_N": 500.0,
        "resistance_B_N_s_m": 20.0,
        "resistance_C_N_s2_m2": 2.0,
    }
    constants = Rig(30.0, vehicle=coefficients).params.vehicle
    assert [vehicle.resistance(v, constants) for v in (0.0, 1.0, 10.0)] == [500.0, 522.0, 900.0]


def test_a_coasting_vehicle_slows_down_as_in_the_closed_form():
    rig = Rig(30.0, rig=TRACK)
    run = rig.roll(60.0, demand_Pa=0.0)
    # v(t) of M dv/dt = -(A + C v^2)
    mass_kg = COACH["mass_kg"] + TURNING_KG
    A = COACH["resistance_A_N"]
    C = COACH["resistance_C_N_s2_m2"]
    unit_m_s = math.sqrt(A / C)
    rate_1_s = math.sqrt(A * C) / mass_kg
    angle = np.arctan(30.0 / unit_m_s) - rate_1_s * run.time
    np.testing.assert_allclose(run.vehicle_speed, unit_m_s * np.tan(angle), rtol=1e-5)


@pytest.mark.parametrize("deceleration_m_s2", [0.0, 0.5, 1.6])
def test_loads_carry_the_weight_and_the_moment_of_braking(deceleration_m_s2):
    constants = Rig(30.0).params.vehicle
    loads_N = np.array([vehicle.load(j, -deceleration_m_s2, constants) for j in range(4)])
    assert loads_N.sum() == pytest.approx(COACH["mass_kg"] * GRAVITY_M_S2, rel=1e-12)

    # about the rail: each mass at its height
    body_kg = COACH["mass_kg"] - 2 * COACH["bogie_mass_kg"] - 4 * COACH["wheelset_mass_kg"]
    moment_kg_m = (
        body_kg * COACH["body_height_m"]
        + 2 * COACH["bogie_mass_kg"] * COACH["bogie_height_m"]
        + 4 * COACH["wheelset_mass_kg"] * COACH["wheel_radius_m"]
    )
    ahead_m = PLACES_M.mean() - PLACES_M
    expected_Nm = moment_kg_m * deceleration_m_s2
    assert loads_N @ ahead_m == pytest.approx(expected_Nm, rel=1e-12, abs=1e-6)


def test_braking_loads_the_leading_wheelset_of_every_bogie_and_the_leading_bogie():
    run = Rig(30.0, adhesion=DRY).roll(5.0)
    first_N, second_N, third_N, fourth_N = run.wheel_load[-1]
    assert first_N > second_N
    assert third_N > fourth_N
    assert first_N + second_N > third_N + fourth_N
    weight_N = COACH["mass_kg"] * GRAVITY_M_S2
    np.testing.assert_allclose(run.wheel_load.sum(axis=1), weight_N, rtol=1e-12)


def test_loads_follow_the_deceleration_with_the_lag_of_pitching():
    run = Rig(30.0, adhesion=DRY).roll(8.0)
    lag_s = COACH["pitch_time_constant_s"]
    felt_m_s2 = run.felt_acceleration
    unlagged_m_s2 = felt_m_s2 + lag_s * np.gradient(felt_m_s2, run.time)
    np.testing.assert_allclose(unlagged_m_s2[1:], run.vehicle_acceleration[1:], atol=0.02)


def test_a_wheelset_that_is_lifted_off_has_no_load_and_no_adhesion():
    rig = Rig(30.0, adhesion=DRY)
    rig.state.felt_acceleration[0] = -20.0
    run = rig.roll(0.1)
    lifted = run.wheel_load == 0.0
    assert lifted[:, 3].any()
    assert not lifted[:, 0].any()
    assert run.wheel_load.min() == 0.0
    assert (run.adhesion[lifted] == 0.0).all()
    assert np.isfinite(run.log).all()


def test_a_released_vehicle_at_walking_pace_coasts_to_a_standstill():
    rig = Rig(0.5, adhesion=SOAP)
    run = rig.roll(40.0, demand_Pa=0.0)
    momentum_Ns = (COACH["mass_kg"] + TURNING_KG) * 0.5
    expected_s = momentum_Ns / COACH["resistance_A_N"]
    stopped = np.flatnonzero(run.standing)[0]
    assert run.time[stopped] == pytest.approx(expected_s, rel=0.02)


def test_brakes_that_are_applied_at_standstill_move_nothing():
    rig = Rig(0.5)
    rig.roll(40.0, demand_Pa=0.0)
    place_m = rig.state.position[0]
    rig.roll(5.0, VENT)
    run = rig.roll(5.0)
    assert run.position[-1] == place_m
    assert (run.wheel_speed == 0.0).all()
    assert (run.brake_torque == 0.0).all()
    assert run.cylinder_pressure[-1].min() > 3e5
