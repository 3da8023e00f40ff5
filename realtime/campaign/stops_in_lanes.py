"""Runs many stops, several at a time in the vector lanes of a core, and each other one alone.

A stop that is done waits until its place is given to the next stop.
"""

import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import UnitError
from rollerrig.configs.vehicle import Kind
from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, tick_data
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.campaign import packed, ticks_in_lanes
from rollerrig.realtime.campaign.ticks_in_lanes import Rows
from rollerrig.realtime.loop.ring import Memory
from rollerrig.realtime.loop.tick import DONE
from rollerrig.rig.lanes import layout, rail_cleaning
from rollerrig.rig.lanes.layout import rigs_of
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Event

_MOST_STEPS = 1 << 20  # in one call


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
    """A stop, the tag by which its caller knows it, and its parameters.

    tapes: the parameters of the plant. unit_tape: those of the units, empty without a unit.
    """

    tag: Any
    stop: free.Stop
    tapes: packed.Tapes
    unit_tape: np.ndarray


def together(
    jobs: Iterable[tuple[Any, Scenario]],
    unit: free.Unit = "reference",
    columns: Sequence[str] | None = None,
) -> Iterator[Finished]:
    """Run many scenarios, several at a time if possible; yield each that is done.

    `jobs` are (tag, scenario). `columns` are the channels that the caller needs, at least; None:
    all that the vehicle has. Vehicles with the same number of axles run together. The results come
    in the order in which the stops are done. A result does not depend on the stops in the other
    places. It differs from that of `free.simulate` by rounding.
    """
    parameters = functools.cache(logic.load)

    def unit_of(plan: Scenario) -> free.Unit:
        # the reference unit, whose file is read once
        return parameters(plan["wsp_config"]) if unit == "reference" else unit

    is_compiled = unit in ("reference", "none") or isinstance(unit, logic.Params)
    fitting: dict[Kind, list[tuple[Any, Scenario]]] = {}
    for tag, plan in jobs:
        if is_compiled and fits(plan):
            fitting.setdefault(plan.kind, []).append((tag, plan))
        else:
            yield _alone(tag, plan, unit)

    for kind, together_jobs in fitting.items():
        table = signals.table(kind)
        names = table.columns if columns is None else columns
        kept = [int(table.kept[table.columns.index(name)]) for name in names]
        stops = (_placed(tag, plan, unit_of(plan)) for tag, plan in together_jobs)
        for placed, samples in _run(kind, stops, kept):
            channels = dict(zip(names, samples, strict=True))
            # these stops have no events: they have no faults, and a planar vehicle cannot derail
            yield Finished(
                placed.tag, placed.stop.plan, channels, placed.stop.events, placed.stop.ended
            )


def _placed(tag: Any, plan: Scenario, unit: free.Unit) -> _Placed:
    """Return a stop that has not begun."""
    no_ring = Memory(1, plan.table)
    stop = free.Stop(plan, tick_data.build(plan, no_ring), unit)
    units = stop.reference_units
    return _Placed(
        tag=tag,
        stop=stop,
        tapes=packed.tapes(stop.data.params),
        unit_tape=packed.unit_tape(units.params) if units else np.zeros(0),
    )


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
    return Finished(
        tag, stop.plan, free.channels(memory.written, stop.plan.table), stop.events, stop.ended
    )


def fits(plan: Scenario) -> bool:
    """Whether a scenario may run together with others: one planar plant, no faults."""
    return (
        plan.rollers is None
        and not plan.faults
        and not plan["bus"]["arbitration"]
        and layout.fits(plan.params)
    )


def _run(
    kind: Kind, stops: Iterable[_Placed], kept: list[int]
) -> Iterator[tuple[_Placed, np.ndarray]]:
    """Run stops of one kind of vehicle; yield each that is done, with its samples (columns, n).

    All must fit (`fits`). `kept` are the columns of the row of all signals that a sample has.
    """
    waiting = iter(stops)
    rigs = rigs_of(kind.axles)
    placed = dict(enumerate(itertools.islice(waiting, rigs)))
    if not placed:
        return
    rows = _memory(kind, placed.values(), kept)
    for rig, stop in placed.items():
        _place(stop, rig, rows)

    while placed:
        ticks_in_lanes.run_ticks(rows, _MOST_STEPS)
        for rig, stop in list(placed.items()):
            if not rows.control[rig, DONE]:
                continue
            yield stop, rows.samples[rig, :, : rows.written[rig]].copy()
            following = next(waiting, None)
            if following is None:
                del placed[rig]
                rows.clock[rig, ticks_in_lanes.RUNS] = 0
            else:
                placed[rig] = following
                rows = _with_room(rows, following)
                _place(following, rig, rows)


def _memory(kind: Kind, stops: Iterable[_Placed], kept: list[int]) -> Rows:
    """Return memory with room for some stops; `kept` as for `_run`."""
    sizes = [_sizes(placed) for placed in stops]
    return ticks_in_lanes.rows(kind, kept, *(max(size) for size in zip(*sizes, strict=True)))


def _sizes(placed: _Placed) -> tuple[int, int, int, int, int]:
    """Return the sizes of the tapes, of the dead time and of the samples, as `rows` takes them."""
    return (
        placed.tapes.tape.size,
        placed.tapes.whole.size,
        placed.unit_tape.size,
        placed.stop.data.delay.shape[0],
        free.most_samples(placed.stop.plan),
    )


def _with_room(rows: Rows, placed: _Placed) -> Rows:
    """Return the memory, or a larger one with the same stops, with room for a further stop."""
    # the field, and the axis that grows
    fields = {"tape": 1, "whole": 1, "unit_tape": 1, "delay": 1, "samples": 2}
    given = {field: getattr(rows, field) for field in fields}
    for (field, axis), size in zip(fields.items(), _sizes(placed), strict=True):
        missing = size - given[field].shape[axis]
        if missing > 0:
            padding = [(0, 0)] * given[field].ndim
            padding[axis] = (0, missing)
            given[field] = np.pad(given[field], padding)
    return rows._replace(**given)


def _place(placed: _Placed, rig: int, rows: Rows) -> None:
    """Give a place to a stop that has not begun."""
    stop = placed.stop
    data = stop.data
    tapes = placed.tapes
    rows.tape[rig, : tapes.tape.size] = tapes.tape
    rows.whole[rig, : tapes.whole.size] = tapes.whole
    rows.unit_tape[rig, : placed.unit_tape.size] = placed.unit_tape
    rows.units[rig] = 0.0
    rows.buffer[rig] = data.buffer
    rows.delay[rig, : data.delay.shape[0]] = data.delay
    rows.control[rig] = data.control
    rows.command[rig] = data.command
    rows.row[rig] = data.row
    rows.pulses[rig] = data.pulses
    rows.sensor[rig] = data.sensor
    rows.written[rig] = 0

    clock = rows.clock[rig]
    clock[:] = 0
    clock[ticks_in_lanes.RUNS] = 1
    clock[ticks_in_lanes.RECORD_TICKS] = data.record_ticks
    if stop.reference_units:
        clock[ticks_in_lanes.SYNC_TICKS] = stop.plan.sync_ticks
    clock[ticks_in_lanes.END_TICK] = data.end_tick
    clock[ticks_in_lanes.STAND_TICKS] = data.stand_ticks
    clock[ticks_in_lanes.IS_WATCHED] = int(_is_observed_each_tick(stop))
    clock[ticks_in_lanes.CLEANS] = int(rail_cleaning.is_alone(data.params))
    clock[ticks_in_lanes.SUBSTEPS] = data.params.substeps
    layout.load_constants(rows.lanes, rig, data.params)


def _is_observed_each_tick(stop: free.Stop) -> bool:
    """Return whether the row of all signals, or what it is made of, acts in the next tick."""
    params = stop.data.params
    friction_is_observed = params.effects.on_friction and not rail_cleaning.is_alone(params)
    return stop.data.sensor.model != pole_wheel.IDEAL or friction_is_observed
