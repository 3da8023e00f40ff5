"""Heat: discs and motors keep the heat that they get, except what they give to the air."""

import math

import numba
import numpy as np
import pytest

from rollerrig.realtime.bench import scenario
from rollerrig.rig import heat, plant
from rollerrig.rig.state import SIZE, views

AIR_K = 293.15
COLD = ("brake.disc_cooling_time_s=100000", "drive.thermal_time_constant_s=100000")


def bodies(**changes):
    """Return a state at rest and the heat parameters of the shipped rig, with changes."""
    state = views(np.zeros(SIZE), 4)
    constants = scenario.load("velim_a1").params.heat._replace(**changes)
    heat.begin(state, constants)
    return state, constants


def stop(plan, seconds):
    """Return the state of a plant that has braked without WSP for some seconds."""
    run = plant.Plant(plan.params, plan["initial_speed_m_s"])
    for tick in range(round(seconds / plan.params.tick_s)):
        plant.advance(run.state, run.delay, np.zeros(4), 3.8e5, tick, plan.params)
    return run.state


@numba.njit
def advance_ticks(state, constants, ticks):
    for _ in range(ticks):
        heat.advance(state, constants)


def test_discs_and_motors_begin_at_the_temperature_of_the_air():
    state, _ = bodies()
    assert set(state.disc_temperature) == set(state.motor_temperature) == {AIR_K}


def test_without_cooling_the_discs_keep_all_work_of_the_brake():
    plan = scenario.load("dry_stop", settings=COLD)
    state = stop(plan, 8.0)
    assert state.brake_work.min() > 1e5
    rise_J = plan["brake"]["disc_heat_capacity_J_K"] * (state.disc_temperature - AIR_K)
    assert rise_J == pytest.approx(state.brake_work, rel=1e-4)


def test_a_hot_disc_cools_to_the_air_with_its_time_constant():
    state, constants = bodies()
    state.disc_temperature[:] = AIR_K + 100.0
    advance_ticks(state, constants, 600_000)
    assert state.disc_temperature == pytest.approx(AIR_K + 100.0 / math.e, abs=0.1)


@pytest.mark.parametrize("load", [0.5, -1.0, 1.1])
def test_a_motor_approaches_the_rated_rise_times_the_square_of_its_load(load):
    state, constants = bodies(motor_share=0.01)
    state.motor_torque[:] = load * constants.rated_torque_Nm
    for _ in range(3000):
        heat.advance(state, constants)
    expected_K = AIR_K + load**2 * constants.motor_rise_K
    assert state.motor_temperature == pytest.approx(expected_K, abs=1e-6)


def test_only_the_braked_wheelset_warms_up():
    state, constants = bodies()
    state.brake_work[2] = constants.disc_J_K
    heat.advance(state, constants)
    assert list(state.disc_temperature - AIR_K) == pytest.approx([0.0, 0.0, 1.0, 0.0])
