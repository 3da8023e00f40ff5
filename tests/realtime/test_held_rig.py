"""A held rig rolls at its set speed, while its run has not begun."""

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.wsp import logic
from rollerrig.firmware_sim.wsp.phases import Phase
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import held_rig, mailbox, ring
from rollerrig.realtime.loop.held_rig import HOLDING, RELEASED, RUNNING
from rollerrig.realtime.loop.tick import HELD, HOLD, TICK
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)


@pytest.fixture
def initial_m_s():
    return 10.0


@pytest.fixture(params=["full_scale", "plain_track", "virtual_track"])
def machine(request, initial_m_s):
    settings = (f"rig={request.param}", f"initial_speed_m_s={initial_m_s}")
    plan = scenario.load("velim_a1", settings=settings)
    rows = ring.Ring(ring.place("held"), np.float64, 1 << 8, len(TABLE.columns))
    made = tick_data.build(plan, rows)
    made.control[HOLD] = HOLDING
    yield made
    rows.close()
    rows.unlink()


def published(machine):
    """The row of all signals that the tick published last."""
    row = np.zeros(signals.WIDTH)
    mailbox.fetch(machine.published, row)
    return row


def test_it_rolls_without_sliding_at_its_set_speed_and_time_stands_still(machine):
    for _ in range(50):
        held_rig.roll(machine)
    row = published(machine)
    assert row[signals.column("vehicle_speed")] == 10.0
    assert row[TABLE.span("wheel_circumferential_speed")] == pytest.approx([10.0] * 4)
    assert row[TABLE.span("sliding")] == pytest.approx([0.0] * 4, abs=1e-9)
    assert row[TABLE.span("wheel_angle")] == pytest.approx(
        0.05 * row[TABLE.span("wheel_speed")], rel=1e-9
    )
    assert row[signals.column("time")] == 0.0
    assert row[signals.column("position")] == 0.0
    assert machine.control[TICK] == 0
    assert machine.control[HELD] == 50
    assert machine.ring_header[ring.WRITTEN] == 0


@pytest.mark.parametrize(("initial_m_s", "set_m_s"), [(10.0, 10.5), (10.0, 9.5), (0.5, 0.0)])
def test_it_approaches_its_set_speed_at_its_rate_and_stays(initial_m_s, set_m_s, machine):
    machine.hold[held_rig.SET_M_S] = set_m_s
    held_rig.roll(machine)
    change = machine.params.tick_s * held_rig.RATE_M_S2
    speed_m_s = published(machine)[signals.column("vehicle_speed")]
    assert abs(speed_m_s - initial_m_s) == pytest.approx(change)

    rolls_needed = round(abs(set_m_s - initial_m_s) / change)
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


@kernel
def roll_with_unit(machine, ticks, unit, ticks_a_cycle, counts_a_rad_s, first_column, counts):
    """Roll for some ticks; the unit hears the measured speeds, as `counts`, once a cycle."""
    for at in range(ticks):
        held_rig.roll(machine)
        if at % ticks_a_cycle == 0:
            for j in range(counts.size):
                counts[j] = round(machine.row[first_column + j] * counts_a_rad_s)
            logic.cycle(unit, counts)


class HeldWithUnit:
    """A held rig, and the reference unit that hears its speed sensors."""

    def __init__(self, machine):
        self.machine = machine
        self.unit = logic.new_unit(logic.load())
        self.ticks_a_cycle = round(self.unit.params.cycle_s / machine.params.tick_s)
        place = TABLE.by_name["measured_speed"].places[0]
        self.counts_a_rad_s = 1.0 / place.scale
        self.counts = np.zeros(4, dtype=np.int64)

    def roll(self, for_s):
        """Roll for a time of a whole number of cycles."""
        ticks = round(for_s / self.machine.params.tick_s)
        roll_with_unit(
            self.machine,
            ticks,
            self.unit,
            self.ticks_a_cycle,
            self.counts_a_rad_s,
            TABLE.span("measured_speed").start,
            self.counts,
        )

    def until_settled(self, longest_s):
        """Roll until the rig has settled; return the time it took."""
        took_s = 0.0
        while not held_rig.has_settled(self.machine):
            assert took_s < longest_s
            self.roll(0.1)
            took_s += 0.1
        return took_s

    def is_misled(self):
        """Whether the reference of the unit is off by 0.2 m/s, or a valve does not fill."""
        reference_m_s = self.unit.state.reference_m_s[0]
        off = abs(reference_m_s - self.machine.state.vehicle_speed[0]) > 0.2
        return off or any(self.unit.state.phase != Phase.FILL)


@pytest.mark.parametrize("set_m_s", [4.0, 30.0])
def test_a_unit_that_hears_a_held_rig_change_its_speed_is_never_misled(set_m_s, machine):
    held = HeldWithUnit(machine)
    held.roll(1.0)
    machine.hold[held_rig.SET_M_S] = set_m_s
    while machine.state.vehicle_speed[0] != set_m_s:
        held.roll(0.1)
        assert not held.is_misled()
    assert held.until_settled(longest_s=10.0) == pytest.approx(held_rig.SETTLE_S, abs=0.3)
    assert not held.is_misled()


def test_a_held_rig_has_not_settled_as_soon_as_another_speed_is_set(machine):
    assert held_rig.has_settled(machine)
    machine.hold[held_rig.SET_M_S] = 11.0
    assert not held_rig.has_settled(machine)
    held = HeldWithUnit(machine)
    held.roll(1.5)
    assert not held_rig.has_settled(machine)
    held.until_settled(longest_s=5.0)
    assert machine.state.vehicle_speed[0] == 11.0


@pytest.mark.parametrize("slowed_m_s", [3.0, 15.0, 30.0])
def test_after_an_emergency_stop_a_held_rig_settles_no_earlier_than_the_unit(slowed_m_s):
    plan = scenario.load("velim_a1", settings=("initial_speed_m_s=40",))
    rows = ring.Ring(ring.place("held"), np.float64, 1 << 8, len(TABLE.columns))
    machine = tick_data.build(plan, rows)
    machine.control[HOLD] = HOLDING
    held = HeldWithUnit(machine)
    held.roll(1.0)
    # the emergency stop is reset while the rollers still turn, at the speed of that moment
    machine.hold[held_rig.APPROACH_M_S2] = held_rig.EMERGENCY_RATE_M_S2
    machine.hold[held_rig.SET_M_S] = 0.0
    held.roll(slowed_m_s / held_rig.EMERGENCY_RATE_M_S2)
    assert held.is_misled()
    machine.hold[held_rig.APPROACH_M_S2] = held_rig.RATE_M_S2
    machine.hold[held_rig.SET_M_S] = machine.state.vehicle_speed[0]
    held.until_settled(longest_s=60.0)
    assert not held.is_misled()
    rows.close()
    rows.unlink()
