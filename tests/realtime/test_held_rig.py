"""A held rig rolls at its set speed, while its run has not begun."""

import numpy as np
import pytest

from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import held_rig, mailbox, ring
from rollerrig.realtime.loop.held_rig import HOLDING, RELEASED, RUNNING
from rollerrig.realtime.loop.tick import HELD, HOLD, TICK
from rollerrig.wsp_interface import signals


@pytest.fixture(params=["full_scale", "plain_track", "virtual_track"])
def machine(request):
    plan = scenario.load("velim_a1", settings=(f"rig={request.param}", "initial_speed_m_s=10"))
    rows = ring.Ring(ring.place("held"), np.float64, 1 << 8, len(signals.COLUMNS))
    made = tick_data.build(plan, rows)
    made.control[HOLD] = HOLDING
    yield made
    rows.close()
    rows.unlink()


def published(machine):
    """The row of all signals that the tick published last."""
    row = np.zeros(len(signals.COLUMNS))
    mailbox.fetch(machine.published, row)
    return row


def test_it_rolls_without_sliding_at_its_set_speed_and_time_stands_still(machine):
    for _ in range(50):
        held_rig.roll(machine)
    row = published(machine)
    assert row[signals.column("vehicle_speed")] == 10.0
    assert row[signals.span("wheel_circumferential_speed")] == pytest.approx([10.0] * 4)
    assert row[signals.span("sliding")] == pytest.approx([0.0] * 4, abs=1e-9)
    assert row[signals.span("wheel_angle")] == pytest.approx(
        0.05 * row[signals.span("wheel_speed")], rel=1e-9
    )
    assert row[signals.column("time")] == 0.0
    assert row[signals.column("position")] == 0.0
    assert machine.control[TICK] == 0
    assert machine.control[HELD] == 50
    assert machine.ring_header[ring.WRITTEN] == 0


@pytest.mark.parametrize("set_m_s", [12.0, 8.0, 0.0])
def test_it_approaches_its_set_speed_at_its_rate_and_stays(set_m_s, machine):
    machine.hold[0] = set_m_s
    held_rig.roll(machine)
    change = machine.params.tick_s * held_rig.RATE_M_S2
    speed_m_s = published(machine)[signals.column("vehicle_speed")]
    assert abs(speed_m_s - 10.0) == pytest.approx(change)

    rolls_needed = round(abs(set_m_s - 10.0) / change)
    for _ in range(rolls_needed + 10):
        held_rig.roll(machine)
    assert published(machine)[signals.column("vehicle_speed")] == set_m_s


def test_its_run_begins_with_a_sync(machine):
    machine.control[HELD] = 13
    machine.control[HOLD] = RELEASED
    ticks = 0
    while held_rig.is_held(machine, 10):
        held_rig.roll(machine)
        ticks += 1
    assert ticks == 7
    assert machine.control[HOLD] == RUNNING
