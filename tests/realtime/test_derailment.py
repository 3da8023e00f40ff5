"""A wheel of the coach that leaves its rail is an event, and ends the run."""

import json

import numpy as np
import pytest

from rollerrig.realtime import cli
from rollerrig.realtime.bench import derailment, free, scenario, tick_data
from rollerrig.realtime.loop.tick import TICK
from rollerrig.rig.multibody import coach_state
from rollerrig.rig.state import SIZE
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.events import Code

SETTINGS = ("vehicle.model=multibody", "rig=plain_track")


class Rows:
    """The memory that `build_machine` wants of a ring."""

    def __init__(self):
        self.header = np.zeros(16, dtype=np.int64)
        self.rows = np.zeros((1000, len(signals.COLUMNS)))


@pytest.fixture
def coach():
    """A coach that brakes; a free run calls what `compile_kernels.py` has compiled."""
    plan = scenario.load("velim_a1", settings=SETTINGS)
    return free.Stop(plan, tick_data.build(plan, Rows()))


@pytest.fixture
def watch():
    told, stopped = [], []

    def on_event(code, /, **fields):
        told.append(events.make(0.0, code, **fields))

    return derailment.Watch(on_event, lambda: stopped.append(True)), told, stopped


def test_a_wheelset_that_is_thrown_over_its_flange_is_told_once_and_the_run_ends(coach, watch):
    (look, told, stopped), machine = watch, coach.data
    coach.advance(50)
    look.look(machine.buffer)
    assert not told
    assert not stopped
    coach_state.views(machine.buffer[SIZE:]).v[6 * 5 + 1] = 12.0  # the third wheelset, to the left
    coach.advance(200)
    look.look(machine.buffer)
    assert {event.code for event in told} == {Code.COACH_DERAILED}
    assert 3 in [event.fields["axle"] for event in told]
    assert stopped == [True]
    count = len(told)
    look.look(machine.buffer)
    assert len(told) == count


def test_a_planar_vehicle_cannot_derail(watch):
    look, told, stopped = watch
    planar = tick_data.build(scenario.load("velim_a1"), Rows())
    look.look(planar.buffer)
    assert not told
    assert not stopped


def test_a_sway_within_the_gauge_is_no_derailment(coach, watch):
    (look, told, _), machine = watch, coach.data
    coach_state.views(machine.buffer[SIZE:]).v[1::6] = 0.2
    coach.advance(1500)
    assert machine.control[TICK] == 1500
    look.look(machine.buffer)
    assert not told


def test_a_run_of_the_coach_that_stays_on_its_rails_says_nothing_of_it(tmp_path):
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
