"""Rig control: the same stop on the track, on contaminated rollers and on a virtual track."""

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH, MOST_AXLES
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
MODES = ("plain_track", "full_scale", "virtual_track")


def stop(folder, rig, *settings):
    """Return the rows of all signals of a whole stop on soap with the reference WSP."""
    folder.mkdir()
    ring = rings.Ring(folder / "rows", np.float64, 1 << 14, len(TABLE.columns))
    plan = scenario.load("velim_a3", settings=(f"rig={rig}", "duration_max_s=100", *settings))
    machine = tick_data.build(plan, ring)
    units = tick.Units(np.zeros((1, logic.SIZE)), logic.load("reference"))
    inputs = np.zeros(2 * MOST_AXLES, dtype=np.int64)
    tick.run_ticks_with_units(machine, 100_000, plan.sync_ticks, units, inputs)
    return TABLE.rows_of_all(machine.ring_rows[: machine.ring_header[rings.WRITTEN]])


@pytest.fixture(scope="module")
def stops(tmp_path_factory):
    """The rows of a stop by the name of the rig."""
    folder = tmp_path_factory.mktemp("stops")
    return {rig: stop(folder / rig, rig) for rig in MODES}


def signal(rows, name):
    """Return a signal of all axles, shape (n, axles)."""
    return rows[:, TABLE.span(name)]


def rolling(rows):
    """Return which samples the vehicle still runs in."""
    return signal(rows, "vehicle_speed")[:, 0] > 1.0


@pytest.mark.conformance(
    "Rig control", "electric inertia simulation: rollers keep the vehicle's speed"
)
def test_contaminated_rollers_keep_the_speed_of_the_vehicle_that_they_simulate(stops):
    rows = stops["full_scale"]
    error = signal(rows, "tracking_error")[rolling(rows)]
    assert np.abs(error).max() < 0.15
    assert np.sqrt((error**2).mean()) < 0.01
    # the rollers weigh a ninth of the coach: without the motors they would stop with their wheels
    assert signal(rows, "motor_torque").max() > 2000.0


@pytest.mark.conformance(
    "Rig control", "virtual track: wheels turn as those of the virtual vehicle do, tracking error"
)
def test_on_a_virtual_track_real_wheels_turn_as_the_virtual_ones(stops):
    rows = stops["virtual_track"]
    error = signal(rows, "tracking_error")[rolling(rows)]
    assert np.abs(error).max() < 0.5
    assert 0.0 < np.sqrt((error**2).mean()) < 0.02
    # the wheels slide far more than that on the virtual track
    assert np.abs(signal(rows, "sliding")).max() > 1.0


@pytest.mark.conformance("Rig control", "the same scenario on both rigs and on the plain track")
@pytest.mark.parametrize("rig", ["full_scale", "virtual_track"])
def test_a_rig_has_the_stopping_distance_of_the_vehicle_on_the_track(stops, rig):
    distance = {name: signal(rows, "position")[-1, 0] for name, rows in stops.items()}
    assert signal(stops[rig], "vehicle_speed")[-1, 0] == 0.0
    # the smaller contact patch of a roller and the lag of the drives: about half a per cent
    assert distance[rig] == pytest.approx(distance["plain_track"], rel=0.02)
