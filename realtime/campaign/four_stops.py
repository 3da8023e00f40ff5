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
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.ring import Memory
from rollerrig.realtime.loop.tick import DONE, TICK
from rollerrig.rig import heat, plant
from rollerrig.rig.compiled.generated import buffer_viewer
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.lanes import layout, step
from rollerrig.rig.lanes.layout import RIGS
from rollerrig.wsp_interface.events import Event

_MOST_TICKS = 1 << 20  # in one call
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
    # stops in one call have the same number of steps in a tick
    groups: dict[int, list[tuple[Any, Scenario]]] = {}
    for tag, plan in jobs:
        if is_compiled and fits(plan):
            groups.setdefault(plan.params.substeps, []).append((tag, plan))
        else:
            yield _alone(tag, plan, unit)

    with_unit = unit != "none"
    # the compiled call needs a unit; without one, it gets a unit that never runs
    placed_unit = unit if with_unit else "reference"
    for group in groups.values():
        stops = (_Placed(tag, *free.remembered(plan, placed_unit)) for tag, plan in group)
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
    """Whether a scenario may run together with others: one planar plant, one unit, no faults."""
    return (
        GROUPS == 1
        and plan.rollers is None
        and not plan.faults
        and not plan["bus"]["arbitration"]
        and layout.fits(plan.params)
    )


def _run(stops: Iterable[_Placed], with_unit: bool) -> Iterator[_Placed]:
    """Run stops four at a time; yield each that is done.

    All must fit (`fits`) and have the same number of steps in a tick.
    """
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
    for rig, placed in enumerate(row):
        layout.load_constants(lanes, rig, placed.stop.data.params)

    while runs.any():
        _run_until_done(row, with_unit, runs, lanes, inputs)
        for rig in range(RIGS):
            if not runs[rig] or not row[rig].stop.data.control[DONE]:
                continue
            yield row[rig]
            following = next(waiting, None)
            if following is None:
                runs[rig] = 0
            else:
                row[rig] = following
                layout.load_constants(lanes, rig, following.stop.data.params)


def _run_until_done(
    row: list[_Placed],
    with_unit: bool,
    runs: np.ndarray,
    lanes: np.ndarray,
    inputs: np.ndarray,
) -> None:
    """Run the four stops of a row until at least one of them is done."""
    data = tuple(placed.stop.data for placed in row)
    units = tuple(
        (logic.buffer_of(unit), unit.params)
        for placed in row
        for unit in placed.stop.reference_units
    )
    # ticks between two cycles of a unit; 0: it does not run
    sync_ticks = np.array(
        [placed.stop.plan.sync_ticks if with_unit else 0 for placed in row], dtype=np.int64
    )
    run_ticks(data, units, sync_ticks, runs, lanes, inputs, _MOST_TICKS)


@kernel
def run_ticks(four, units, syncs, runs, lanes, inputs, ticks):
    """Run ticks until one of the running stops is done.

    Parameters
    ----------
    four : the tick data of the four stops
    units : their units, each as (buffer, parameters)
    syncs : (4,), ticks between two cycles of a unit; 0: it does not run
    runs : (4,), 0 for a place that does not run
    lanes : the array of `rig.lanes.layout`
    inputs : int64 scratch, as in `tick.run_ticks_with_units`
    ticks : the largest number of ticks
    """
    m0, m1, m2, m3 = four
    rigs = (m0.params.vehicle, m1.params.vehicle, m2.params.vehicle, m3.params.vehicle)
    for _ in range(ticks):
        before(m0, units[0], syncs[0], runs[0], lanes, 0, inputs)
        before(m1, units[1], syncs[1], runs[1], lanes, 1, inputs)
        before(m2, units[2], syncs[2], runs[2], lanes, 2, inputs)
        before(m3, units[3], syncs[3], runs[3], lanes, 3, inputs)
        for _ in range(m0.params.substeps):
            step.step(lanes, rigs)
        done = after(m0, runs[0], lanes, 0)
        done += after(m1, runs[1], lanes, 1)
        done += after(m2, runs[2], lanes, 2)
        done += after(m3, runs[3], lanes, 3)
        if done != 0:
            return


@kernel
def before(m, unit, sync_ticks, runs, lanes, rig, inputs):
    """Do what precedes the physics of a tick, and scatter the state of the stop into its lanes."""
    if runs == 0:
        return
    now = m.control[TICK]
    if sync_ticks != 0 and now % sync_ticks == 0:
        tick.write_unit_inputs(m, inputs)
        tick.run_unit_cycle(m, logic.Unit(see_unit(unit[0]), unit[1]), 0, inputs)
    tick.begin(m, now)
    target_Pa = plant.prepare(
        m.state, m.delay, m.command[: tick.AXLES], m.command[tick.DEMAND], now, m.params
    )
    layout.scatter(lanes, rig, m.state, target_Pa)


@kernel
def after(m, runs, lanes, rig):
    """Gather the state of the stop, and do what follows the physics of a tick.

    Returns 1 if the stop is done now, else 0.
    """
    if runs == 0:
        return 0
    now = m.control[TICK]
    params = m.params
    layout.gather(lanes, rig, m.state)
    m.state.time[0] = (now * params.substeps + params.substeps) * params.step_s
    heat.advance(m.state, params.heat)
    plant.observe(m.state, params)
    tick.end(m, now)
    return int(m.control[DONE])
