"""The bench reports a wheel of the coach that leaves its rail, and stops the run."""

import json

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime import cli
from rollerrig.realtime.bench import derailment, free, scenario, tick_data
from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.tick import TICK
from rollerrig.rig.multibody import coach_state
from rollerrig.rig.state import SIZE
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.events import Code

TABLE = signals.table(COACH)

SETTINGS = ("vehicle.model=multibody", "rig=plain_track")
# the coach's velocities: six a body, of which the second is lateral; body 5 is the third wheelset
VELOCITIES = 6
LATERAL = 1
LATERAL_OF_WHEELSET_3 = VELOCITIES * 5 + LATERAL


class Rows:
    """The memory of a ring, as `tick_data.build` needs it."""

    def __init__(self):
        self.header = np.zeros(16, dtype=np.int64)
        self.rows = np.zeros((1000, len(TABLE.columns)))


@pytest.fixture
def coach():
    """A coach that brakes; a free run calls the kernels that `compile_kernels.py` has compiled."""
    plan = scenario.load("velim_a1", settings=SETTINGS)
    return free.Stop(plan, tick_data.build(plan, Rows()))


@pytest.fixture
def watch():
    """A watch for derailments, the events that it reports, and its requests to stop the run."""
    events_seen = []
    stopped = []

    def on_event(code, /, **fields):
        events_seen.append(events.make(0.0, code, **fields))

    return derailment.Watch(4, on_event, lambda: stopped.append(True)), events_seen, stopped


def test_a_wheelset_that_is_thrown_over_its_flange_is_reported_once_and_the_run_ends(coach, watch):
    look, events_seen, stopped = watch
    machine = coach.data
    coach.advance(50)
    look.look(machine.buffer)
    assert not events_seen
    assert not stopped

    # throw the third wheelset to the left
    coach_state.views(machine.buffer[SIZE:]).v[LATERAL_OF_WHEELSET_3] = 12.0
    coach.advance(200)
    look.look(machine.buffer)
    assert {event.code for event in events_seen} == {Code.COACH_DERAILED}
    assert 3 in [event.fields["axle"] for event in events_seen]
    assert stopped == [True]

    count = len(events_seen)
    look.look(machine.buffer)
    assert len(events_seen) == count


def test_a_stop_of_a_campaign_ends_where_the_coach_derails_and_is_not_valid(coach):
    memory = ring.Memory(4000, TABLE)
    stop = free.Stop(coach.plan, tick_data.build(coach.plan, memory))
    stop.advance(500)
    coach_state.views(stop.data.buffer[SIZE:]).v[LATERAL_OF_WHEELSET_3] = 12.0
    stop.run()

    finished = stops_in_lanes.finished(0, stop, memory)
    assert finished.channels["time_s"][-1] < 2.0
    summary = campaign.summarize(finished, "reference")
    assert summary["ended"] == "derailed"
    assert summary["valid"] is False
    (reason,) = summary["invalid_because"]
    assert "derailed: the " in reason
    assert " left its rail after " in reason


def test_a_wheel_that_has_left_its_rail_is_reported_with_its_side_and_its_wheelset(watch):
    look, events_seen, _ = watch
    buffer = np.zeros(SIZE + coach_state.SIZE)
    coach_state.views(buffer[SIZE:]).left[5] = 120.0
    look.look(buffer)
    (event,) = events_seen
    assert event.fields == {"side": "right", "axle": 3, "distance_m": 120.0}


def test_a_planar_vehicle_cannot_derail(watch):
    look, events_seen, stopped = watch
    planar = tick_data.build(scenario.load("velim_a1"), Rows())
    look.look(planar.buffer)
    assert not events_seen
    assert not stopped


def test_a_sway_within_the_gauge_is_no_derailment(coach, watch):
    look, events_seen, _ = watch
    machine = coach.data
    coach_state.views(machine.buffer[SIZE:]).v[LATERAL::VELOCITIES] = 0.2
    coach.advance(1500)
    assert machine.control[TICK] == 1500
    look.look(machine.buffer)
    assert not events_seen


def test_a_run_of_the_coach_that_stays_on_its_rails_reports_no_derailment(tmp_path):
    status = cli.main(
        [
            "run",
            "velim_a1",
            "--pacing",
            "free",
            "--out",
            str(tmp_path / "run"),
            "--set",
            "vehicle.model=multibody",
            "--set",
            "duration_max_s=0.2",
        ]
    )
    assert status == 4  # it does not stop in that time
    lines = (tmp_path / "run" / "events.jsonl").read_text().splitlines()
    codes = [json.loads(line)["code"] for line in lines]
    assert Code.COACH_DERAILED not in codes
