"""Heat: what goes into discs and motors stays there, less what the air takes."""

import math

import numba
import numpy as np
import pytest

from rollerrig.realtime.bench import scenario
from rollerrig.rig import heat
from rollerrig.rig.plant import Plant
from rollerrig.rig.state import SIZE, views

AIR_K = 293.15
COLD = ("brake.disc_cooling_time_s=100000", "drive.thermal_time_constant_s=100000")


def bodies(**changes):
    """A state at rest and the heat parameters of the shipped rig, with changes."""
    state = views(np.zeros(SIZE))
    made = scenario.load("velim_a1").params.heat._replace(**changes)
    heat.begin(state, made)
    return state, made


def stop(plan, seconds):
    """A plant that brakes without WSP for so long, from the plan's speed."""
    from rollerrig.rig import plant

    made = Plant(plan.params, plan["initial_speed_m_s"])
    for tick in range(round(seconds / plan.params.tick_s)):
        plant.advance(made.state, made.delay, np.zeros(4), 3.8e5, tick, plan.params)
    return made.state


@numba.njit
def warmed(state, made, ticks):
    for _ in range(ticks):
        heat.advance(state, made)


def test_everything_begins_as_cold_as_the_air():
    state, _ = bodies()
    assert set(state.disc_temperature) == set(state.motor_temperature) == {AIR_K}


def test_without_cooling_the_discs_keep_all_work_of_the_brake():
    plan = scenario.load("dry_stop", settings=COLD)
    state = stop(plan, 8.0)
    assert state.brake_work.min() > 1e5
    rise_J = plan["brake"]["disc_heat_capacity_J_K"] * (state.disc_temperature - AIR_K)
    assert rise_J == pytest.approx(state.brake_work, rel=1e-4)


def test_a_hot_disc_cools_to_the_air_with_its_time_constant():
    state, made = bodies()
    state.disc_temperature[:] = AIR_K + 100.0
    warmed(state, made, 600_000)
    assert state.disc_temperature == pytest.approx(AIR_K + 100.0 / math.e, abs=0.1)


@pytest.mark.parametrize("load", [0.5, -1.0, 1.1])
def test_a_motor_approaches_the_rated_rise_times_the_square_of_its_load(load):
    state, made = bodies(motor_share=0.01)
    state.motor_torque[:] = load * made.rated_torque_Nm
    for _ in range(3000):
        heat.advance(state, made)
    assert state.motor_temperature == pytest.approx(AIR_K + load**2 * made.motor_rise_K, abs=1e-6)


def test_only_the_braked_wheelset_warms_up():
    state, made = bodies()
    state.brake_work[2] = made.disc_J_K
    heat.advance(state, made)
    assert list(state.disc_temperature - AIR_K) == pytest.approx([0.0, 0.0, 1.0, 0.0])
