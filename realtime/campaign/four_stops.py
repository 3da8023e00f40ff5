"""Runs four stops at a time: their ticks, with their reference WSP units, in one compiled call.

Each stop does before and after its physics what `tick.run_tick` does. The physics in between runs
for all four stops in lanes (`rig.lanes`). A stop that is done waits until its place is given to the
next stop. No bus, clock or Python code runs between two ticks. The samples agree with those of
`--pacing free` to rounding.
"""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import UnitError
from rollerrig.configs.vehicle import GROUPS
from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import mailbox, tick
from rollerrig.realtime.loop.ring import Memory
from rollerrig.realtime.loop.tick import DONE, TICK
from rollerrig.rig import heat, plant
from rollerrig.rig.compiled.generated import buffer_viewer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.lanes import layout, step
from rollerrig.rig.lanes.layout import RIGS
from rollerrig.wsp_interface.events import Event

_MOST_STEPS = 1 << 20  # in one call
# the unit's state as views into its buffer, for compiled code
see_unit = buffer_viewer(logic.State, logic.PLACES)


class Finished(NamedTuple):
    """A stop that is done: the tag by which its caller knows it, and what it has left.

    channels: samples (n,) by the names of the table of signals.
    events, ended: as in `free.Stop`.
    """

    tag: Any
    plan: Scenario
    channels: dict[str, np.ndarray]
    events: list[Event]
    ended: str


class Pace(NamedTuple):
    """How far the four stops are in their ticks, int64 (4,).

    The stops do not wait for one another: each has its tick, and its number of steps in a tick.
    """

    begun: np.ndarray  # 1: a tick has begun and not ended
    left: np.ndarray  # steps that are left in this tick
    each_tick: np.ndarray  # 1: the row of all signals acts in the next tick, so each tick makes it


class _Placed(NamedTuple):
    """A stop, the tag by which its caller knows it, and the memory of its samples."""

    tag: Any
    stop: free.Stop
    memory: Memory


def together(
    jobs: Iterable[tuple[Any, Scenario]], unit: free.Unit = "reference"
) -> Iterator[Finished]:
    """Run many scenarios, four at a time if possible; yield each that is done.

    `jobs` are (tag, scenario). The results come in the order in which the stops are done. A result
    does not depend on the stops in the other places. It differs from that of `free.simulate` by
    rounding.
    """
    is_compiled = unit in ("reference", "none") or isinstance(unit, logic.Params)
    fitting: list[tuple[Any, Scenario]] = []
    for tag, plan in jobs:
        if is_compiled and fits(plan):
            fitting.append((tag, plan))
        else:
            yield _alone(tag, plan, unit)

    with_unit = unit != "none"
    # the compiled call needs a unit; without one, it gets a unit that never runs
    placed_unit = unit if with_unit else "reference"
    stops = (_Placed(tag, *free.remembered(plan, placed_unit)) for tag, plan in fitting)
    for tag, stop, memory in _run(stops, with_unit):
        # these stops have no events: they have no faults, and a planar vehicle cannot derail
        yield finished(tag, stop, memory)


def _alone(tag: Any, plan: Scenario, unit: free.Unit) -> Finished:
    """Run one stop. A failure of its unit is in its events. Raises ConfigError."""
    free.check(plan)
    stop, memory = free.remembered(plan, unit)
    try:
        stop.run()
    except UnitError as error:
        stop.fail(error)
    return finished(tag, stop, memory)


def finished(tag: Any, stop: free.Stop, memory: Memory) -> Finished:
    """Return what a stop that is done has left."""
    return Finished(tag, stop.plan, free.channels(memory.written), stop.events, stop.ended)


def fits(plan: Scenario) -> bool:
    """Whether a scenario may run together with others: one planar plant, no faults."""
    return (
        GROUPS == 1
        and plan.rollers is None
        and not plan.faults
        and not plan["bus"]["arbitration"]
        and layout.fits(plan.params)
    )


def _run(stops: Iterable[_Placed], with_unit: bool) -> Iterator[_Placed]:
    """Run stops four at a time; yield each that is done. All must fit (`fits`)."""
    waiting = iter(stops)
    row = list(itertools.islice(waiting, RIGS))
    if not row:
        return
    # an empty place holds a stop of another place, and does not run
    runs = np.array([rig < len(row) for rig in range(RIGS)], dtype=np.int64)
    while len(row) < RIGS:
        row.append(row[0])

    lanes = np.zeros(layout.SIZE)
    inputs = np.zeros(2 * tick.AXLES, dtype=np.int64)
    pace = Pace(*(np.zeros(RIGS, dtype=np.int64) for _ in Pace._fields))
    for rig, placed in enumerate(row):
        _place(placed, rig, lanes, pace)

    while runs.any():
        _run_until_done(row, with_unit, runs, pace, lanes, inputs)
        for rig in range(RIGS):
            if not runs[rig] or not row[rig].stop.data.control[DONE]:
                continue
            yield row[rig]
            following = next(waiting, None)
            if following is None:
                runs[rig] = 0
            else:
                row[rig] = following
                _place(following, rig, lanes, pace)


def _place(placed: _Placed, rig: int, lanes: np.ndarray, pace: Pace) -> None:
    """Give a place of the row to a stop that has not begun."""
    params = placed.stop.data.params
    layout.load_constants(lanes, rig, params)
    pace.begun[rig] = 0
    pace.left[rig] = 0
    pace.each_tick[rig] = int(_is_observed_each_tick(placed.stop))


def _is_observed_each_tick(stop: free.Stop) -> bool:
    """Return whether the row of all signals, or what it is made of, acts in the next tick."""
    return stop.data.sensor.model != pole_wheel.IDEAL or stop.data.params.effects.on_friction


def _run_until_done(
    row: list[_Placed],
    with_unit: bool,
    runs: np.ndarray,
    pace: Pace,
    lanes: np.ndarray,
    inputs: np.ndarray,
) -> None:
    """Run the four stops of a row until at least one of them is done."""
    data = tuple(placed.stop.data for placed in row)
    units = tuple(
        tuple((logic.buffer_of(unit), unit.params) for unit in placed.stop.reference_units)
        for placed in row
    )
    # ticks between two cycles of a unit; 0: it does not run
    sync_ticks = np.array(
        [placed.stop.plan.sync_ticks if with_unit else 0 for placed in row], dtype=np.int64
    )
    run_ticks(data, units, sync_ticks, runs, pace, lanes, inputs, _MOST_STEPS)


@kernel
def run_ticks(four, units, syncs, runs, pace, lanes, inputs, most):
    """Run ticks until one of the running stops is done.

    Parameters
    ----------
    four : the tick data of the four stops
    units : of each stop the units of its groups, each as (buffer, parameters)
    syncs : (4,), ticks between two cycles of a unit; 0: it does not run
    runs : (4,), 0 for a place that does not run
    pace : `Pace`
    lanes : the array of `rig.lanes.layout`
    inputs : int64 scratch, as in `tick.run_ticks_with_units`
    most : the largest number of steps in this call
    """
    m0, m1, m2, m3 = four
    rigs = (m0.params.vehicle, m1.params.vehicle, m2.params.vehicle, m3.params.vehicle)
    for _ in range(most):
        done = between_ticks(m0, units[0], syncs[0], runs[0], pace, lanes, 0, inputs)
        done += between_ticks(m1, units[1], syncs[1], runs[1], pace, lanes, 1, inputs)
        done += between_ticks(m2, units[2], syncs[2], runs[2], pace, lanes, 2, inputs)
        done += between_ticks(m3, units[3], syncs[3], runs[3], pace, lanes, 3, inputs)
        if done != 0:
            return
        step.step(lanes, rigs)
        for rig in range(RIGS):
            pace.left[rig] -= 1


@kernel
def between_ticks(m, units, sync_ticks, runs, pace, lanes, rig, inputs):
    """End the tick of a stop whose steps are done, and begin its next one.

    Returns 1 if the stop is done now, else 0.
    """
    if runs == 0 or pace.left[rig] > 0:
        return 0
    if pace.begun[rig] != 0:
        after(m, sync_ticks, pace.each_tick[rig], lanes, rig)
        pace.begun[rig] = 0
        if m.control[DONE] != 0:
            return 1
    target_Pa = before(m, units, sync_ticks, inputs)
    layout.scatter(lanes, rig, m.state, target_Pa)
    pace.begun[rig] = 1
    pace.left[rig] = m.params.substeps
    return 0


@kernel_inlined
def before(m, units, sync_ticks, inputs):
    """Do what precedes the physics of a tick; return the demanded pressure in Pa."""
    now = m.control[TICK]
    if sync_ticks != 0 and now % sync_ticks == 0:
        tick.write_unit_inputs(m, inputs)
        for group in range(len(units)):
            buffer, params = units[group]
            tick.run_unit_cycle(m, logic.Unit(see_unit(buffer), params), group, inputs)
        # nobody else writes commands
        mailbox.fetch(m.commands, m.command)
    tick.record(m, now)
    tick.obey(m)
    return plant.prepare(
        m.state, m.delay, m.command[: tick.AXLES], m.command[tick.DEMAND], now, m.params
    )


@kernel_inlined
def after(m, sync_ticks, each_tick, lanes, rig):
    """Gather the state of the stop, and do what follows the physics of a tick.

    The row of all signals is made only where somebody reads it: the next tick records a sample or
    runs the unit.
    """
    now = m.control[TICK]
    params = m.params
    layout.gather(lanes, rig, m.state)
    m.state.time[0] = (now * params.substeps + params.substeps) * params.step_s
    heat.advance(m.state, params.heat)
    following = now + 1
    is_read = each_tick != 0 or following % m.record_ticks == 0
    if is_read or (sync_ticks != 0 and following % sync_ticks == 0):
        plant.observe(m.state, params)
        tick.publish(m)
    else:
        for axle in range(tick.AXLES):
            plant.watch_lock(m.state, axle, params)
    tick.count(m, now)
