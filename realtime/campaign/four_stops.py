"""Four stops at a time: their ticks, with their reference WSP units, in one call.

Each does before and after its physics what `tick.run_tick` does; the physics between runs for all
four in lanes (`rig.lanes`). One that is done waits until its place is given to the next stop. No bus,
no clock and no Python stand between two ticks; the samples are those of `--pacing free` to rounding.
"""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

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

# a stop with what it is called by, and the memory of its samples
Placed = tuple[Any, free.Stop, Memory]
_TICKS = 1 << 20
# the unit's state as views into its buffer, for compiled code
see_unit = buffer_viewer(logic.State, logic.PLACES)


def together(
    jobs: Iterable[tuple[Any, Scenario]], unit: free.Unit = "reference"
) -> Iterator[tuple[Any, Scenario, dict[str, np.ndarray]]]:
    """Run many scenarios, four at a time where they allow it: (tag, scenario, channels) as they end.

    A result does not depend on which stops ran beside it; against `free.simulate` it differs by rounding.
    """
    groups: dict[int, list[tuple[Any, Scenario]]] = {}
    for tag, plan in jobs:
        if (unit in ("reference", "none") or isinstance(unit, logic.Params)) and fits(plan):
            groups.setdefault(plan.params.substeps, []).append((tag, plan))
        else:
            yield tag, plan, free.channels(free.simulate(plan, unit))
    for group in groups.values():
        # without a unit one that is never asked takes its place
        own = "reference" if unit == "none" else unit
        for tag, stop, memory in _run(
            ((tag, *free.remembered(plan, own)) for tag, plan in group), unit != "none"
        ):
            yield tag, stop.plan, free.channels(memory.written)


def fits(plan: Scenario) -> bool:
    """Whether a scenario may run beside others: one planar plant, no faults."""
    return (
        plan.rollers is None
        and not plan.faults
        and not plan["bus"]["arbitration"]
        and layout.fits(plan.params)
    )


def _run(stops: Iterable[Placed], with_unit: bool) -> Iterator[Placed]:
    """Run stops with like steps in a tick that all fit `layout.fits`, four at a time; gives back each that is done."""
    waiting, lanes = iter(stops), np.zeros(layout.SIZE)
    inputs = np.zeros(2 * tick.AXLES, dtype=np.int64)
    row = list(itertools.islice(waiting, RIGS))
    if not row:
        return
    # places without a stop of their own repeat one; they are not asked to run
    runs = np.array([rig < len(row) for rig in range(RIGS)], dtype=np.int64)
    row += [row[0]] * (RIGS - len(row))
    for rig, (_, stop, _) in enumerate(row):
        layout.load_constants(lanes, rig, stop.data.params)
    while runs.any():
        # ticks between two cycles of a unit, 0 where it is not asked
        syncs = np.array([stop.plan.sync_ticks * with_unit for _, stop, _ in row], dtype=np.int64)
        units = tuple(
            (logic.buffer_of(stop.reference_unit), stop.reference_unit.params)
            for _, stop, _ in row
            if stop.reference_unit
        )
        run_ticks(tuple(stop.data for _, stop, _ in row), units, syncs, runs, lanes, inputs, _TICKS)
        for rig in range(RIGS):
            if runs[rig] and row[rig][1].data.control[DONE]:
                yield row[rig]
                following = next(waiting, None)
                runs[rig] = following is not None
                if following is not None:
                    row[rig] = following
                    layout.load_constants(lanes, rig, following[1].data.params)


@kernel
def run_ticks(four, units, syncs, runs, lanes, inputs, ticks):
    """Run ticks until one of the stops that run is done; tuples of four, (4,) and the lanes.

    A unit is (buffer, parameters).
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
    """What a stop does before the physics of a tick; its state then stands in its lanes."""
    if runs == 0:
        return
    now = m.control[TICK]
    if sync_ticks != 0 and now % sync_ticks == 0:
        tick.write_unit_inputs(m, inputs)
        tick.run_unit_cycle(m, logic.Unit(see_unit(unit[0]), unit[1]), inputs)
    tick.begin(m, now)
    target_Pa = plant.prepare(
        m.state, m.delay, m.command[: tick.AXLES], m.command[tick.DEMAND], now, m.params
    )
    layout.scatter(lanes, rig, m.state, target_Pa)


@kernel
def after(m, runs, lanes, rig):
    """What a stop does after the physics of a tick; 1 where it is done now."""
    if runs == 0:
        return 0
    now, params = m.control[TICK], m.params
    layout.gather(lanes, rig, m.state)
    m.state.time[0] = (now * params.substeps + params.substeps) * params.step_s
    heat.advance(m.state, params.heat)
    plant.observe(m.state, params)
    tick.end(m, now)
    return int(m.control[DONE])
