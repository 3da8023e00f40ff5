"""One tick: commands in, physics, a row of all signals out, samples into the ring."""

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH, MOST_AXLES
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import mailbox, tick
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop.tick import DEMAND, DONE, MAGNETS, REFERENCE, STOP, TICK
from rollerrig.rig.state import slots
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)

SETTINGS = ("duration_max_s=60", "stand_s=0.2")


@pytest.fixture
def build(tmp_path):
    """A function that builds the tick data of a scenario with settings."""
    made = []

    def with_settings(*settings):
        ring = rings.Ring(tmp_path / f"rows{len(made)}", np.float64, 1 << 14, len(TABLE.columns))
        made.append(ring)
        plan = scenario.load("velim_a1", settings=(*SETTINGS, *settings))
        return tick_data.build(plan, ring)

    return with_settings


def sampled(machine):
    """Return the samples as rows of all signals."""
    return TABLE.rows_of_all(machine.ring_rows[: machine.ring_header[rings.WRITTEN]])


def post_command(machine, magnets, demand_Pa=np.nan, reference=np.nan):
    command = machine.commands.values.copy()
    command[MAGNETS : MAGNETS + 4] = magnets
    command[DEMAND] = demand_Pa
    command[REFERENCE] = reference
    mailbox.post(machine.commands, command)


def test_a_sample_is_taken_every_tenth_tick_beginning_with_the_first_state(build):
    machine = build()
    tick.run_ticks(machine, 205)
    rows = sampled(machine)
    assert len(rows) == 21
    np.testing.assert_allclose(rows[:, signals.column("time")], np.arange(21) * 0.01, atol=1e-12)
    assert rows[0, signals.column("vehicle_speed")] == 42.3
    assert (np.diff(rows[:, signals.column("position")]) > 0).all()


def test_the_published_row_is_the_state_under_the_names_of_the_signals(build):
    machine = build()
    tick.run_ticks(machine, 300)
    row = np.empty(signals.WIDTH)
    mailbox.fetch(machine.published, row)
    shared = [signal for signal in TABLE.signals if signal.name in slots(4)]
    assert len(shared) > 20
    for signal in shared:
        np.testing.assert_array_equal(
            row[TABLE.span(signal.name)], machine.buffer[slots(4)[signal.name]], signal.name
        )


def test_every_signal_of_the_table_is_written(build):
    machine = build()
    post_command(machine, (0, 0, 0, 0), reference=40.0)
    machine.row[:] = np.nan
    tick.run_ticks(machine, 20)
    unwritten = np.array(TABLE.columns)[np.isnan(machine.row[TABLE.kept])]
    assert unwritten.tolist() == []


def test_magnets_and_demand_of_the_mailbox_act_with_the_next_tick(build):
    machine = build("valve.dead_time_s=0.0")
    post_command(machine, (1, 3, 0, 2))
    tick.run_ticks(machine, 1)
    assert machine.state.valve.tolist() == [1, 2, 0, 2]
    assert machine.row[TABLE.span("magnets")].tolist() == [1, 3, 0, 2]

    post_command(machine, (0, 0, 0, 0), demand_Pa=1e5)
    tick.run_ticks(machine, 6000)
    assert machine.state.brake_demand[0] == pytest.approx(1e5, rel=0.05)
    post_command(machine, (0, 0, 0, 0), demand_Pa=0.0)
    tick.run_ticks(machine, 1)
    assert machine.state.brake_demand[0] < 1e5


def test_a_batch_ends_when_the_vehicle_has_stood_long_enough(build):
    machine = build("initial_speed_m_s=1.0", "adhesion=dry")
    ran = tick.run_ticks(machine, 60_000)
    assert machine.control[DONE] == 1
    assert ran == machine.control[TICK] < 60_000
    rows = sampled(machine)
    first_still = np.argmax(rows[:, signals.column("vehicle_speed")] == 0.0)
    still_s = machine.state.time[0] - rows[first_still, signals.column("time")]
    assert still_s == pytest.approx(0.2, abs=0.011)
    assert tick.run_ticks(machine, 10) == 0


def test_a_batch_ends_with_the_longest_time(build):
    machine = build("duration_max_s=0.123")
    assert tick.run_ticks(machine, 1000) == 123
    assert machine.control[DONE] == 1


def test_a_batch_ends_before_its_first_tick_when_it_is_stopped(build):
    machine = build()
    machine.control[STOP] = 1
    assert tick.run_ticks(machine, 10) == 0
    assert machine.control[TICK] == 0


def test_batches_of_any_length_make_the_same_run(build):
    whole = build()
    parts = build()
    tick.run_ticks(whole, 1000)
    for length in (1, 9, 90, 400, 500):
        tick.run_ticks(parts, length)
    assert whole.buffer.tobytes() == parts.buffer.tobytes()
    assert sampled(whole).tobytes() == sampled(parts).tobytes()


def test_the_unit_in_the_tick_sees_counts_and_answers_a_cycle_later(build):
    machine = build()
    units = tick.Units(np.zeros((1, logic.SIZE)), logic.load("reference"))
    inputs = np.zeros(2 * MOST_AXLES, dtype=np.int64)
    tick.run_ticks_with_units(machine, 6000, 10, units, inputs)
    speed = machine.row[TABLE.span("wheel_speed")]
    assert np.abs(inputs[:4] * 0.01 - speed).max() < 0.5
    assert np.isfinite(machine.command[REFERENCE])
    assert np.isnan(machine.command[DEMAND])
    rows = sampled(machine)
    assert rows[:, TABLE.span("magnets")].max() > 0
    assert rows[0, TABLE.span("magnets")].max() == 0


@pytest.mark.parametrize(
    ("value", "scale", "count"),
    [
        (1.234, 0.01, 123),
        (1e9, 0.01, 32767),
        (-1e9, 0.01, -32768),
        (0.005, 0.01, 0),
        (0.015, 0.01, 2),
    ],
)
def test_counts_are_those_of_the_bus(value, scale, count):
    assert tick.counts(value, scale) == count


def test_a_mailbox_gives_the_latest_row_whole():
    box = mailbox.mailbox(3)
    into = np.zeros(3)
    assert mailbox.fetch(box, into) == 0
    for n in range(1, 4):
        mailbox.post(box, np.full(3, float(n)))
    assert mailbox.fetch(box, into) == 6
    assert into.tolist() == [3.0, 3.0, 3.0]


@pytest.mark.parametrize("half_done", ["values", "second"])
def test_a_reader_does_not_wait_for_a_writer_that_is_half_done(half_done):
    # on one core a thread of higher priority takes the core from the writer
    box = mailbox.mailbox(3)
    mailbox.post(box, np.full(3, 1.0))
    row = ("values", "second").index(half_done)
    box.sequence[row] += 1
    getattr(box, half_done)[0] = 2.0
    into = np.zeros(3)
    assert mailbox.fetch(box, into) == 2
    assert into.tolist() == [1.0, 1.0, 1.0]
