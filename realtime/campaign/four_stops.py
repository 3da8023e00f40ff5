"""Four stops at a time: the ticks of four machines, with their reference WSP units, in one call.

Each machine does before and after its physics what `tick.once` does; the physics between runs for
all four in lanes (`rig.lanes`). A machine that is done waits until its place is given to the next
stop. No bus, no clock and no Python stand between two ticks, and a stop's samples are those of
`--pacing free` to rounding.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.mailbox import Mailbox
from rollerrig.realtime.loop.tick import DONE, TICK, Machine
from rollerrig.rig import heat, plant
from rollerrig.rig.kernel import kernel, kernel_inlined, seeing
from rollerrig.rig.lanes import layout, step
from rollerrig.rig.lanes.layout import RIGS
from rollerrig.rig.params import Params
from rollerrig.rig.state import State

_TICKS = 1 << 20
# the unit's state as views into its buffer, for compiled code
see_unit = seeing(logic.State, logic.PLACES)


class Rider(NamedTuple):
    """What `Machine` and `wsp.Unit` hold, with one array for the unit's state instead of its views."""

    params: Params
    state: State
    buffer: np.ndarray
    delay: np.ndarray
    control: np.ndarray
    commands: Mailbox
    command: np.ndarray
    published: Mailbox
    row: np.ndarray
    gather: np.ndarray
    ring_header: np.ndarray
    ring_rows: np.ndarray
    record_ticks: int
    end_tick: int
    stand_ticks: int
    hold: np.ndarray
    answer: np.ndarray
    sensor: Any
    pulses: np.ndarray
    unit_buffer: np.ndarray
    unit_params: Any


class Stop(NamedTuple):
    """A machine about to run; `sync_ticks` between two cycles of its unit, 0 where it has none."""

    machine: Machine
    unit: logic.Unit
    sync_ticks: int
    tag: Any = None


def fits(plan: Scenario) -> bool:
    """Whether a scenario may run beside others: one planar plant, no faults."""
    return (plan.rollers is None and not plan.faults and not plan["bus"]["arbitration"]
            and layout.fits(plan.params))


def run(stops: Iterable[Stop]) -> Iterator[Stop]:
    """Run stops to their ends, four at a time; gives each back when it is done.

    All must have the same number of steps in a tick and fit `lanes.layout.fits`.
    """
    waiting, lanes = iter(stops), np.zeros(layout.SIZE)
    inputs = np.zeros(2 * tick.AXLES, dtype=np.int64)
    row: list[Stop] = []
    for stop in waiting:
        row.append(stop)
        if len(row) == RIGS:
            break
    if not row:
        return
    # places without a stop of their own repeat a machine; they are not asked to run
    given = len(row)
    row += [row[0]] * (RIGS - given)
    runs = np.array([rig < given for rig in range(RIGS)], dtype=np.int64)
    for rig in range(RIGS):
        layout.load_constants(lanes, rig, row[rig].machine.params)
    while runs.any():
        syncs = np.array([stop.sync_ticks for stop in row], dtype=np.int64)
        together(tuple(rider(stop) for stop in row), syncs, runs, lanes, inputs, _TICKS)
        for rig in range(RIGS):
            if runs[rig] and row[rig].machine.control[DONE]:
                yield row[rig]
                following = next(waiting, None)
                runs[rig] = following is not None
                if following is not None:
                    row[rig] = following
                    layout.load_constants(lanes, rig, following.machine.params)


def rider(stop: Stop) -> Rider:
    """A stop as the compiled loop takes it."""
    shared = {name: value for name, value in stop.machine._asdict().items() if name in Rider._fields}
    return Rider(**shared, unit_buffer=logic.buffer_of(stop.unit), unit_params=stop.unit.params)


@kernel_inlined
def machine_of(r):
    """The machine of a rider; its rollers are the plant itself."""
    return Machine(r.params, r.state, r.buffer, r.delay, r.control, r.commands, r.command, r.published,
                   r.row, r.gather, r.ring_header, r.ring_rows, 0, r.params, r.state, r.buffer, r.delay,
                   r.gather[:0], r.record_ticks, r.end_tick, r.stand_ticks, r.hold, r.answer, r.sensor,
                   r.pulses)


@kernel
def together(riders, syncs, runs, lanes, inputs, ticks):
    """Run ticks until one of the machines that run is done; tuples of four, (4,) and the lanes."""
    m0, m1, m2, m3 = riders
    rigs = (m0.params.vehicle, m1.params.vehicle, m2.params.vehicle, m3.params.vehicle)
    for _ in range(ticks):
        before(m0, syncs[0], runs[0], lanes, 0, inputs)
        before(m1, syncs[1], runs[1], lanes, 1, inputs)
        before(m2, syncs[2], runs[2], lanes, 2, inputs)
        before(m3, syncs[3], runs[3], lanes, 3, inputs)
        for _ in range(m0.params.substeps):
            step.step(lanes, rigs)
        done = after(m0, runs[0], lanes, 0)
        done += after(m1, runs[1], lanes, 1)
        done += after(m2, runs[2], lanes, 2)
        done += after(m3, runs[3], lanes, 3)
        if done != 0:
            return


@kernel
def before(r, sync_ticks, runs, lanes, rig, inputs):
    """What a machine does before the physics of a tick; its state then stands in its lanes."""
    if runs == 0:
        return
    m = machine_of(r)
    now = m.control[TICK]
    if sync_ticks != 0 and now % sync_ticks == 0:
        tick.ask_unit(m, inputs)
        tick.hear_unit(m, logic.Unit(see_unit(r.unit_buffer), r.unit_params), inputs)
    tick.begin(m, now)
    target_Pa = plant.prepare(m.state, m.delay, m.command[:tick.AXLES], m.command[tick.DEMAND], now,
                              m.params)
    layout.scatter(lanes, rig, m.state, target_Pa)


@kernel
def after(r, runs, lanes, rig):
    """What a machine does after the physics of a tick; 1 where it is done now."""
    if runs == 0:
        return 0
    m = machine_of(r)
    now, params = m.control[TICK], m.params
    layout.gather(lanes, rig, m.state)
    m.state.time[0] = (now * params.substeps + params.substeps) * params.step_s
    heat.warm(m.state, params.heat)
    plant.observe(m.state, params)
    tick.end(m, now)
    return int(m.control[DONE])
