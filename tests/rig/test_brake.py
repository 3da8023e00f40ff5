"""Brake pneumatics: valve states, dead time, time constants, air, torque."""

import numpy as np
import pytest
from rolling import FILL, FULL_BRAKE_PA, HOLD, LEAVES, VENT, Rig

from rollerrig.rig import brake, params
from rollerrig.rig import state as states

VALVE = {row.name: row.default for row in params.ROWS["valve"]}
BRAKE = {row.name: row.default for row in params.ROWS["brake"]}


@pytest.fixture
def charged():
    """Return a rig whose cylinders are all at full pressure."""
    rig = Rig(30.0)
    rig.state.cylinder_pressure[:] = rig.state.brake_demand[:] = FULL_BRAKE_PA
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
    moved = np.argmax(run.valve != 0, axis=0)
    ticks = round(dead_time_s * 1000) + 1  # the tick that acts on the command comes first
    assert moved.tolist() == [ticks, ticks, 0, ticks]
    assert run.valve[-1].tolist() == [states.VENT, states.HOLD, states.FILL, states.VENT]


def test_a_pulse_passes_the_valve_with_its_length_unchanged(charged):
    magnets = np.zeros((300, 4))
    magnets[50:73, 2] = VENT
    run = charged.roll(0.3, magnets)
    assert np.sum(run.valve[:, 2] == states.VENT) == 23
    assert run.vents[-1].tolist() == [0, 0, 1, 0]


def test_venting_empties_with_its_time_constant(charged):
    run = charged.roll(1.0, VENT)
    at = round(VALVE["dead_time_s"] * 1000)
    pressure = run.cylinder_pressure[at:]
    time_s = run.time[at:] - run.time[at]
    expected = FULL_BRAKE_PA * np.exp(-time_s / VALVE["vent_time_constant_s"])
    np.testing.assert_allclose(pressure, np.repeat(expected[:, None], 4, axis=1), rtol=1e-9)


def test_holding_keeps_the_pressure_to_the_last_bit(charged):
    charged.state.cylinder_pressure[:] = (1e5, 2e5, 3e5, 0.0)
    charged.roll(0.05, HOLD)
    run = charged.roll(2.0, HOLD)
    assert np.ptp(run.cylinder_pressure, axis=0).max() == 0.0
    assert run.change("air_consumption") == 0.0


def test_filling_rises_to_the_demand_with_its_time_constant(charged):
    charged.state.cylinder_pressure[:] = 0.0
    run = charged.roll(1.0)
    expected = FULL_BRAKE_PA * -np.expm1(-run.time / VALVE["fill_time_constant_s"])
    np.testing.assert_allclose(run.cylinder_pressure[:, 0], expected, rtol=1e-9)


def test_the_demand_rises_and_falls_with_its_time_constants():
    rig = Rig(30.0)
    rising = rig.roll(2.0)
    expected = FULL_BRAKE_PA * -np.expm1(-rising.time / BRAKE["fill_time_constant_s"])
    np.testing.assert_allclose(rising.brake_demand, expected, rtol=1e-9)
    falling = rig.roll(2.0, demand_Pa=0.0)
    time_s = falling.time - falling.time[0]
    expected = rising.brake_demand[-1] * np.exp(-time_s / BRAKE["release_time_constant_s"])
    np.testing.assert_allclose(falling.brake_demand, expected, rtol=1e-9)


def test_demand_and_valve_in_series_follow_their_closed_form():
    run = Rig(30.0).roll(5.0)
    slow = BRAKE["fill_time_constant_s"]
    fast = VALVE["fill_time_constant_s"]
    rest = (slow * np.exp(-run.time / slow) - fast * np.exp(-run.time / fast)) / (slow - fast)
    expected = FULL_BRAKE_PA * (1.0 - rest)
    np.testing.assert_allclose(run.cylinder_pressure[:, 3], expected, atol=1e-6 * FULL_BRAKE_PA)


def test_only_filling_uses_air_and_uses_the_volume_that_flows_in():
    rig = Rig(30.0)
    filled = rig.roll(12.0)
    expected = BRAKE["cylinder_volume_L"] * filled.change("cylinder_pressure").sum() / 101325.0
    assert filled.change("air_consumption") == pytest.approx(expected, rel=1e-9)
    rig.roll(0.05, VENT)
    assert rig.roll(1.0, VENT).change("air_consumption") == 0.0
    before = rig.state.air_consumption[0]
    refilled = rig.roll(1.0, (FILL, VENT, VENT, VENT))
    gained = refilled.change("cylinder_pressure")[0]
    assert rig.state.air_consumption[0] - before == pytest.approx(
        BRAKE["cylinder_volume_L"] * gained / 101325.0, rel=2e-2
    )


def test_a_demand_that_falls_below_the_cylinder_uses_no_air(charged):
    run = charged.roll(3.0, demand_Pa=0.0)
    assert run.change("cylinder_pressure").max() < -1e5
    assert run.change("air_consumption") == 0.0


def test_the_discs_hold_nothing_below_the_spring_and_rise_in_proportion_above():
    constants = Rig(30.0).params.brake
    assert brake.capacity(BRAKE["spring_pressure_Pa"], constants) == 0.0
    assert brake.capacity(0.0, constants) == 0.0
    # two pads a disc, two discs a wheelset, friction 0.35 at 0.247 m
    force_N = BRAKE["cylinder_area_m2"] * 1e5 * BRAKE["lever_ratio"] * BRAKE["efficiency"]
    torque_Nm = force_N * 2 * 0.35 * 0.247 * 2
    for steps in (1, 2, 3):
        pressure_Pa = BRAKE["spring_pressure_Pa"] + steps * 1e5
        expected_Nm = pytest.approx(steps * torque_Nm, rel=1e-12)
        assert brake.capacity(pressure_Pa, constants) == expected_Nm


def test_the_brake_never_drives_a_wheel_nor_turns_it_back():
    rig = Rig(15.0, adhesion=LEAVES)
    run = rig.roll(30.0)
    assert run.brake_torque.min() >= 0.0
    assert run.wheel_speed.min() == 0.0
    assert np.diff(run.wheel_angle, axis=0).min() >= 0.0
    # a locked wheel takes no more torque than the contact gives
    locked = (run.wheel_speed == 0.0) & (run.vehicle_speed[:, None] > 0.1)
    assert locked.any()
    np.testing.assert_allclose(
        run.brake_torque[locked], 0.445 * run.contact_force_N[locked], rtol=1e-12
    )


def test_the_programme_demands_the_last_step_that_has_begun():
    plan = params.Demand(np.array([1.0, 2.0, 4.0]), np.array([1e5, 3e5, 0.0]))
    demanded = [brake.target(plan, time_s) for time_s in (0.0, 0.999, 1.0, 2.5, 4.0, 1e6)]
    assert demanded == [0.0, 0.0, 1e5, 3e5, 0.0, 0.0]
