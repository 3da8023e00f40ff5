"""Runs many stops, several at a time in the vector lanes of a core, and each other one alone.

A stop that is done gives its place to the next stop.
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import UnitError
from rollerrig.configs.vehicle import MOST_AXLES, Kind
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, tick_data
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import tick, ticks_in_lanes
from rollerrig.realtime.loop.ring import WRITTEN, Memory
from rollerrig.realtime.loop.tick import DONE
from rollerrig.rig.compiled import record_type
from rollerrig.rig.state import rigs_together, size_of, views
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
    unit_of = unit_by_plan(unit)
    fitting: dict[Kind, list[tuple[Any, Scenario]]] = {}
    for tag, plan in jobs:
        if is_compiled(unit) and fits(plan):
            fitting.setdefault(plan.kind, []).append((tag, plan))
        else:
            yield alone(tag, plan, unit)

    for kind, together_jobs in fitting.items():
        names = signals.table(kind).columns if columns is None else columns
        lanes = _Together(kind, places(kind, names))
        for tag, stop, samples in lanes.run(
            (tag, plan, unit_of(plan)) for tag, plan in together_jobs
        ):
            # no events are expected: no stop has faults, and a planar vehicle cannot derail
            channels = dict(zip(names, samples, strict=True))
            yield Finished(tag, stop.plan, channels, stop.events, stop.ended)


def unit_by_plan(unit: free.Unit) -> Callable[[Scenario], free.Unit]:
    """Return what gives the unit of a scenario; the file of a reference unit is read once."""
    parameters = functools.cache(logic.load)

    def unit_of(plan: Scenario) -> free.Unit:
        return parameters(plan["wsp_config"]) if unit == "reference" else unit

    return unit_of


def is_compiled(unit: free.Unit) -> bool:
    """Return whether a unit runs in compiled code, between two ticks."""
    return unit in ("reference", "none") or isinstance(unit, logic.Params)


def places(kind: Kind, names: Sequence[str]) -> np.ndarray:
    """Return the places of channels in the row of all signals, int64 (n,)."""
    table = signals.table(kind)
    return np.array([table.kept[table.columns.index(name)] for name in names])


def alone(tag: Any, plan: Scenario, unit: free.Unit) -> Finished:
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
    """Whether a scenario may run together with others: one planar plant, the law, no faults."""
    return obstacle(plan) is None


def obstacle(plan: Scenario) -> str | None:
    """Return what lets a scenario run only alone, with its remedy; None if it fits."""
    if plan.rollers is not None:
        return 'a virtual track: set track = "plain"'
    if plan.faults:
        return f"a fault ({plan.faults[0].kind.name}): remove it"
    if plan["bus"]["arbitration"]:
        return "arbitration of the bus: set bus.arbitration = false"
    if plan.params.coach is not None:
        return 'the coach in 3D: set vehicle.model = "planar"'
    if plan.params.patch.model is not None:
        return f'the contact model {plan["contact"]["model"]}: set contact.model = "degraded"'
    return None


class _Together:
    """Stops of one kind of vehicle that are computed together, each in its place."""

    def __init__(self, kind: Kind, kept: np.ndarray) -> None:
        """Return the memory for the stops. `kept` are the columns of a sample, int64 (n,)."""
        self._rigs = rigs_together(kind.axles)
        self._buffer = np.zeros(size_of(self._rigs))
        self._kind = kind
        self._kept = kept
        self._clocks = np.zeros((self._rigs, ticks_in_lanes.COLUMNS_OF_CLOCK), dtype=np.int64)

    def run(
        self, jobs: Iterable[tuple[Any, Scenario, free.Unit]]
    ) -> Iterator[tuple[Any, free.Stop, np.ndarray]]:
        """Run stops; yield the tag of each that is done, the stop, and its samples (columns, n)."""
        waiting = iter(jobs)
        placed: dict[int, tuple[Any, free.Stop]] = {}
        records = []
        for rig, (tag, plan, unit) in enumerate(itertools.islice(waiting, self._rigs)):
            placed[rig] = tag, self._place(rig, plan, unit)
            records.append(record_of(placed[rig][1]))
        if not placed:
            return
        stops = record_type.table(records)
        while placed:
            state = views(self._buffer, self._kind.axles * len(placed))
            ticks_in_lanes.run_ticks(stops, state, self._clocks[: len(placed)], _MOST_STEPS)
            for rig, (tag, stop) in list(placed.items()):
                if not stop.data.control[DONE]:
                    continue
                recorded = stop.data.ring_rows[: int(stop.data.ring_header[WRITTEN])]
                yield tag, stop, recorded.T.copy()
                following = next(waiting, None)
                if following is not None:
                    tag, plan, unit = following
                    placed[rig] = tag, self._place(rig, plan, unit)
                    record_type.write(stops, rig, record_of(placed[rig][1]))
                else:
                    del placed[rig]
            # fewer stops than places: those in the last places move up
            empty = [rig for rig in range(len(placed)) if rig not in placed]
            for rig in empty:
                last = max(placed)
                placed[rig] = placed.pop(last)
                self._move(last, rig, placed[rig][1], stops)
            stops = record_type.first(stops, len(placed))

    def _place(self, rig: int, plan: Scenario, unit: free.Unit) -> free.Stop:
        """Give a place to a stop that has not begun."""
        self._clocks[rig] = 0
        return waiting_stop(plan, unit, self._kept, free.most_samples(plan), (self._buffer, rig))

    def _move(self, before: int, rig: int, stop: free.Stop, stops: record_type.Table) -> None:
        """Give another place to a stop that has begun."""
        state = views(self._buffer, self._kind.axles, rig)
        for old, new in zip(stop.data.state, state, strict=True):
            if new is not None:
                new[:] = old
        gather = tick.gather(self._kind, rig=rig)
        stop.data = stop.data._replace(state=state, roller_state=state, gather=gather)
        self._clocks[rig] = self._clocks[before]
        record_type.write(stops, rig, stops.records[before]._replace(m=stop.data))


def waiting_stop(
    plan: Scenario, unit: free.Unit, kept: np.ndarray, samples: int, seat: tuple[np.ndarray, int]
) -> free.Stop:
    """Return a stop that has not begun, for the ticks of `ticks_in_lanes`.

    kept: the columns of a sample, int64 (n,). samples: for so many there is room. seat: as for
    `plant.Plant`.
    """
    no_ring = Memory(1, plan.table)
    data = tick_data.build(plan, no_ring, seat=seat)
    data = data._replace(
        command=data.commands.values,  # commands act when they are written
        kept=kept,
        ring_rows=np.empty((samples, kept.size)),
    )
    return free.Stop(plan, data, unit)


def record_of(stop: free.Stop) -> ticks_in_lanes.Stop:
    """Return a stop as the ticks need it."""
    data = stop.data
    units = stop.reference_units
    return ticks_in_lanes.Stop(
        m=data,
        units=units or tick.Units(np.zeros((0, logic.SIZE)), _parameters_without_unit()),
        inputs=np.zeros(2 * MOST_AXLES, dtype=np.int64),
        sync_ticks=stop.plan.sync_ticks if units else 0,
        is_observed=ticks_in_lanes.is_observed(data),
        cleans=ticks_in_lanes.cleans(data.params),
    )


@functools.cache
def _parameters_without_unit() -> logic.Params:
    """Return parameters, which a record has even where no unit reads them."""
    return logic.load()
