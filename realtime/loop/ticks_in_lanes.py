"""The ticks of several stops, with their reference WSP units, in one compiled call.

Each stop does before and after its steps what `tick.run_tick` does, and the steps are those of all
stops together (`plant.step`). The stops do not wait for one another: each has its tick, and its
number of steps in a tick. No bus, clock or Python code runs between two ticks.

Signals are observed and written only before a tick in which somebody reads them. Then the rail that
wheels clean needs the work of their contacts, which all stops get together. It agrees with the
observed one to 1e-9, so the samples agree with those of `--pacing free` to rounding.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim import pole_wheel
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import DONE, TICK, TickData, Units
from rollerrig.rig import plant, wheelset
from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.mechanisms.applied import PLACE
from rollerrig.rig.mechanisms.mechanism import FRICTION
from rollerrig.rig.mechanisms.table import IN_PLANT
from rollerrig.rig.params import Params

# columns of the clocks of the stops, int64 with a row for each stop
STEPS = 0  # steps that are left in this tick
BEGUN = 1  # 1: a tick has begun and not ended
COLUMNS_OF_CLOCK = 2

# places in `Effects.values` of the sizes of all mechanisms of friction except rail cleaning
_OTHERS = [
    PLACE[key]
    for mechanism in IN_PLANT
    if mechanism.acts_on == FRICTION and mechanism.name != "rail_cleaning"
    for key in mechanism.coefficients
]


class Stop(NamedTuple):
    """A stop as the ticks need it."""

    m: TickData
    units: Units
    inputs: np.ndarray  # int64 (2 MOST_AXLES,): scratch, what the units receive
    sync_ticks: int  # ticks between two cycles of its units; 0: it has none
    is_observed: bool  # whether each tick needs the signals of the one before
    cleans: bool  # whether a tick needs the work of the contacts in the one before


record_type.register(Stop)


def is_observed(m: TickData) -> bool:
    """Return whether a tick of a stop reads observed quantities of the tick before."""
    params = m.params
    effects = params.effects
    acts = effects.on_torque or (effects.on_friction and not cleans(params))
    return bool(acts or m.sensor.model != pole_wheel.IDEAL or params.flats.wear_m3_J > 0.0)


def cleans(params: Params) -> bool:
    """Return whether rail cleaning is the only mechanism of friction, and no programme changes it.

    A tick then needs only the work of the contacts in the one before.
    """
    effects = params.effects
    alone = params.friction.start.size == 0 and not effects.values[_OTHERS].any()
    return bool(effects.on_friction and alone and effects.memory_m == 0.0)


@kernel
def run_ticks(stops, state, clocks, most):
    """Run ticks until at least one of the stops is done, or `most` steps.

    `stops` is a table of `Stop`, `state` that of all rigs; `clocks` has the columns above.
    """
    plants = stops.m.params
    for _ in range(most):
        for rig in range(len(stops)):
            if clocks[rig, STEPS] == 0 and stops[rig].cleans:
                wheelset.observe_work(state, plants)
                break
        done = 0
        for rig in range(len(stops)):
            if clocks[rig, STEPS] == 0:
                done += between_ticks(stops[rig], clocks[rig])
        if done != 0:
            return
        plant.step(state, plants)
        for rig in range(len(stops)):
            clocks[rig, STEPS] -= 1


@kernel
def between_ticks(stop, clock):
    """End the tick of a stop whose steps are done, and begin the next one.

    Returns 1 if the stop is done now, else 0.
    """
    m = stop.m
    if clock[BEGUN] != 0:
        clock[BEGUN] = 0
        end(stop, m, m.control[TICK])
        if m.control[DONE] != 0:
            return 1
    begin(stop, m, m.control[TICK])
    clock[BEGUN] = 1
    clock[STEPS] = m.params.substeps
    return 0


@kernel
def begin(stop, m, now):
    """Do what precedes the steps of a tick. Commands act when the units write them."""
    if stop.sync_ticks != 0:
        tick.call_units(m, stop.sync_ticks, stop.units, stop.inputs)
    tick.record(m, now)
    tick.obey(m)
    magnets = m.command[tick.MAGNETS : tick.DEMAND]
    plant.prepare(m.state, m.delay, magnets, m.command[tick.DEMAND], now, m.params)


@kernel
def end(stop, m, now):
    """Do what follows the steps of a tick."""
    plant.finish(m.state, now, m.params)
    following = now + 1
    is_read = stop.is_observed or following % m.record_ticks == 0
    if is_read or (stop.sync_ticks != 0 and following % stop.sync_ticks == 0):
        plant.observe(m.state, m.params)
        tick.write_row(m)
    else:
        for axle in range(m.params.axles):
            plant.watch_lock(m.state, axle, m.params)
    tick.count(m, now)
