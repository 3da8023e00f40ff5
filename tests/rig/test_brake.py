"""Brake pneumatics: valve states, dead time, time constants, air, torque."""

import numpy as np
import pytest
from rolling import FILL, FULL_BRAKE_PA, HOLD, LEAVES, VENT, Rig

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import brake, params
from rollerrig.rig import state as states

# defaults of the parameters
VALVE = {row.name: row.default for row in params.ROWS["valve"]}
BRAKE = {row.name: row.default for row in params.ROWS["brake"]}

NORMAL_PRESSURE_PA = 101325.0
WHEEL_RADIUS_M = 0.445


def risen(time_s, time_constant_s):
    """Return the share of its way that a first-order lag has gone."""
    return -np.expm1(-time_s / time_constant_s)


def remaining(time_s, time_constant_s):
    """Return the share of its way that a first-order lag still has to go."""
    return np.exp(-time_s / time_constant_s)


@pytest.fixture
def charged():
    """Return a rig whose cylinders are all at full pressure."""
    rig = Rig(30.0)
    rig.charge(FULL_BRAKE_PA)
    return rig


@pytest.mark.parametrize(
    ("magnets", "valve"),
    [(0b00, states.FILL), (0b01, states.HOLD), (0b11, states.VENT), (0b10, states.VENT)],
)
def test_no_magnet_fills_hold_holds_and_vent_always_vents(magnets, valve):
    assert brake.valve_of(float(magnets)) == valve


@pytest.mark.parametrize("dead_time_s", [0.0, 0.001, 0.04, 0.25])
def test_a_valve_moves_its_dead_time_after_its_magnets(dead_time_s):
    rig = Rig(30.0, valve={"dead_time_s": dead_time_s})
    rig.roll(0.02)
    run = rig.roll(0.4, (VENT, HOLD, FILL, VENT))
    ticks_until_moved = np.argmax(run.valve != states.FILL, axis=0)
    ticks = round(dead_time_s * 1000) + 1  # the tick that acts on the command comes first
    assert ticks_until_moved.tolist() == [ticks, ticks, 0, ticks]
    assert run.valve[-1].tolist() == [states.VENT, states.HOLD, states.FILL, states.VENT]


def test_a_pulse_passes_the_valve_with_its_length_unchanged(charged):
    magnets = np.full((300, 4), FILL)
    magnets[50:73, 2] = VENT
    run = charged.roll(0.3, magnets)
    assert np.sum(run.valve[:, 2] == states.VENT) == 23
    assert run.vents[-1].tolist() == [0, 0, 1, 0]


def test_venting_empties_with_its_time_constant(charged):
    run = charged.roll(1.0, VENT)
    begin = round(VALVE["dead_time_s"] * 1000)
    time_s = run.time[begin:] - run.time[begin]
    expected_Pa = FULL_BRAKE_PA * remaining(time_s, VALVE["vent_time_constant_s"])
    for axle in range(4):
        pressure_Pa = run.cylinder_pressure[begin:, axle]
        np.testing.assert_allclose(pressure_Pa, expected_Pa, rtol=1e-9)


def test_holding_keeps_the_pressure_to_the_last_bit(charged):
    charged.state.cylinder_pressure[:] = (1e5, 2e5, 3e5, 0.0)
    charged.roll(0.05, HOLD)
    run = charged.roll(2.0, HOLD)
    assert np.ptp(run.cylinder_pressure, axis=0).max() == 0.0
    assert run.change("air_consumption") == 0.0


def test_filling_rises_to_the_demand_with_its_time_constant(charged):
    charged.state.cylinder_pressure[:] = 0.0
    run = charged.roll(1.0)
    expected_Pa = FULL_BRAKE_PA * risen(run.time, VALVE["fill_time_constant_s"])
    np.testing.assert_allclose(run.cylinder_pressure[:, 0], expected_Pa, rtol=1e-9)


def test_the_demand_rises_and_falls_with_its_time_constants():
    rig = Rig(30.0)
    rising = rig.roll(2.0)
    expected_Pa = FULL_BRAKE_PA * risen(rising.time, BRAKE["fill_time_constant_s"])
    np.testing.assert_allclose(rising.brake_demand, expected_Pa, rtol=1e-9)

    falling = rig.roll(2.0, demand_Pa=0.0)
    time_s = falling.time - falling.time[0]
    begin_Pa = rising.brake_demand[-1]
    expected_Pa = begin_Pa * remaining(time_s, BRAKE["release_time_constant_s"])
    np.testing.assert_allclose(falling.brake_demand, expected_Pa, rtol=1e-9)


def test_demand_and_valve_in_series_follow_their_closed_form():
    run = Rig(30.0).roll(5.0)
    slow_s = BRAKE["fill_time_constant_s"]
    fast_s = VALVE["fill_time_constant_s"]
    slow_part = slow_s * remaining(run.time, slow_s)
    fast_part = fast_s * remaining(run.time, fast_s)
    missing_share = (slow_part - fast_part) / (slow_s - fast_s)
    expected_Pa = FULL_BRAKE_PA * (1.0 - missing_share)
    tolerance_Pa = 1e-6 * FULL_BRAKE_PA
    np.testing.assert_allclose(run.cylinder_pressure[:, 3], expected_Pa, atol=tolerance_Pa)


def test_only_filling_uses_air_and_uses_the_volume_that_flows_in():
    def normal_litres(rise_Pa):
        return BRAKE["cylinder_volume_L"] * rise_Pa / NORMAL_PRESSURE_PA

    rig = Rig(30.0)
    filled = rig.roll(12.0)
    expected_NL = normal_litres(filled.change("cylinder_pressure").sum())
    assert filled.change("air_consumption") == pytest.approx(expected_NL, rel=1e-9)

    # beyond the dead time of the valves
    rig.roll(0.05, VENT)
    vented = rig.roll(1.0, VENT)
    assert vented.change("air_consumption") == 0.0

    refilled = rig.roll(1.0, (FILL, VENT, VENT, VENT))
    expected_NL = normal_litres(refilled.change("cylinder_pressure")[0])
    assert refilled.change("air_consumption") == pytest.approx(expected_NL, rel=2e-2)


def test_a_demand_that_falls_below_the_cylinder_uses_no_air(charged):
    run = charged.roll(3.0, demand_Pa=0.0)
    assert run.change("cylinder_pressure").max() < -1e5
    assert run.change("air_consumption") == 0.0


def test_the_discs_hold_nothing_below_the_spring_and_rise_in_proportion_above():
    constants = Rig(30.0).params.brake
    gain_Nm_Pa, spring_Pa = constants.torque_Nm_Pa[0], constants.spring_pressure_Pa
    assert brake.torque_at(BRAKE["spring_pressure_Pa"], gain_Nm_Pa, spring_Pa) == 0.0
    assert brake.torque_at(0.0, gain_Nm_Pa, spring_Pa) == 0.0
    # two pads a disc, two discs a wheelset, friction 0.35 at 0.247 m
    force_N = BRAKE["cylinder_area_m2"] * 1e5 * BRAKE["lever_ratio"] * BRAKE["efficiency"]
    torque_Nm = force_N * 2 * 0.35 * 0.247 * 2
    for bar in (1, 2, 3):
        pressure_Pa = BRAKE["spring_pressure_Pa"] + bar * 1e5
        capacity_Nm = brake.torque_at(pressure_Pa, gain_Nm_Pa, spring_Pa)
        assert capacity_Nm == pytest.approx(bar * torque_Nm, rel=1e-12)


def test_each_axle_brakes_with_its_factor_and_an_isolated_one_rolls_freely():
    factors = [1.0, 0.5, 0.0, 1.2]
    rig = Rig(20.0, brake={"axle_factors": factors})
    run = rig.roll(8.0, demand_Pa=FULL_BRAKE_PA)
    torque_Nm = run.brake_torque[-1]
    whole_Nm = Rig(20.0).roll(8.0, demand_Pa=FULL_BRAKE_PA).brake_torque[-1][0]
    assert torque_Nm == pytest.approx(np.array(factors) * whole_Nm, rel=1e-9)
    assert run.wheel_speed[-1][2] > 0.0


def test_factors_of_another_number_of_axles_are_refused():
    with pytest.raises(ConfigError, match="axle_factors has 3 numbers, and the vehicle has 4"):
        Rig(20.0, brake={"axle_factors": [1.0, 1.0, 0.5]})


def test_the_brake_never_drives_a_wheel_nor_turns_it_back():
    rig = Rig(15.0, adhesion=LEAVES)
    run = rig.roll(30.0)
    assert run.brake_torque.min() >= 0.0
    assert run.wheel_speed.min() == 0.0
    assert np.diff(run.wheel_angle, axis=0).min() >= 0.0
    # a locked wheel takes no more torque than the contact gives
    locked = (run.wheel_speed == 0.0) & (run.vehicle_speed[:, None] > 0.1)
    assert locked.any()
    contact_Nm = WHEEL_RADIUS_M * run.contact_force_N
    np.testing.assert_allclose(run.brake_torque[locked], contact_Nm[locked], rtol=1e-12)


def test_the_programme_demands_the_last_step_that_has_begun():
    plan = params.Demand(np.array([1.0, 2.0, 4.0]), np.array([1e5, 3e5, 0.0]))
    demanded = [brake.target(plan, time_s) for time_s in (0.0, 0.999, 1.0, 2.5, 4.0, 1e6)]
    assert demanded == [0.0, 0.0, 1e5, 3e5, 0.0, 0.0]
