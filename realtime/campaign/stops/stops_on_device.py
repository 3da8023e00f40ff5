"""Runs many stops on a GPU, a thread for each.

A wave of stops is placed in the memory of the GPU, and all threads run until their stops are done,
a few seconds of simulated time at a time. After each of these pieces the samples come back. So the
memory does not grow with the length of a stop, and the samples are those of a core.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.realtime.bench import free
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.campaign.stops import stops_in_lanes, ticks_on_device
from rollerrig.realtime.campaign.stops.stops_in_lanes import Finished
from rollerrig.realtime.loop import ring, ticks_in_lanes
from rollerrig.realtime.loop.tick import DONE
from rollerrig.rig import many_rigs
from rollerrig.rig.compiled import device, record_type
from rollerrig.rig.state import SIZE
from rollerrig.wsp_interface import signals

# samples of a stop that the memory of the GPU holds: those of a piece
SAMPLES = 512
# stops that are on the GPU together, at most
WAVE = 32_768
_ALIGNED_BYTES = 8


class Job(NamedTuple):
    """A stop that waits: the tag by which its caller knows it, its scenario, and its unit."""

    tag: Any
    plan: Scenario
    unit: free.Unit


def together(
    jobs: Iterable[tuple[Any, Scenario]],
    unit: free.Unit = "reference",
    columns: Sequence[str] | None = None,
) -> Iterator[Finished]:
    """Run many scenarios on the GPU of this process; arguments and results as for
    `stops_in_lanes.together`.

    A scenario that does not fit (`stops_in_lanes.obstacle`) runs on the core. Distances agree with
    those of a core to rounding. Raises ConfigError without a GPU.
    """
    device.name()
    unit_of = stops_in_lanes.unit_by_plan(unit)
    fitting: dict[Any, list[Job]] = {}
    for tag, plan in jobs:
        if stops_in_lanes.is_compiled(unit) and stops_in_lanes.fits(plan):
            fitting.setdefault(plan.kind, []).append(Job(tag, plan, unit_of(plan)))
        else:
            yield stops_in_lanes.alone(tag, plan, unit)

    for kind, of_kind in fitting.items():
        names = signals.table(kind).columns if columns is None else columns
        for first in range(0, len(of_kind), WAVE):
            placed = Wave(of_kind[first : first + WAVE], stops_in_lanes.places(kind, names))
            for job, samples in zip(placed.jobs, placed.run(), strict=True):
                channels = dict(zip(names, samples, strict=True))
                # no events, and no other end: no stop has faults or can derail
                yield Finished(job.tag, job.plan, channels, [], "finished")


def wave(plans: Sequence[Scenario], columns: Sequence[str]) -> "Wave":
    """Return scenarios that fit, with the same number of axles and reference units, as a wave."""
    unit_of = stops_in_lanes.unit_by_plan("reference")
    jobs = [Job(number, plan, unit_of(plan)) for number, plan in enumerate(plans)]
    return Wave(jobs, stops_in_lanes.places(plans[0].kind, columns))


class _Arrays:
    """Arrays that are copied to the memory of the GPU together, one after another."""

    def __init__(self) -> None:
        self._arrays: list[np.ndarray] = []
        self._offsets: dict[int, int] = {}
        self.size = 0  # bytes

    def add(self, array: np.ndarray) -> int:
        """Give an array its place, if it has none; return its offset in bytes."""
        key = id(array)
        if key not in self._offsets:
            self._arrays.append(array)
            self._offsets[key] = self.size
            self.size += -(-array.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return self._offsets[key]

    def content(self) -> np.ndarray:
        """Return the bytes of all arrays, each at its offset."""
        content = np.zeros(self.size, dtype=np.uint8)
        for array in self._arrays:
            begin = self._offsets[id(array)]
            content[begin : begin + array.nbytes] = array.reshape(-1).view(np.uint8)
        return content


class Wave:
    """Stops with the same number of axles that are on the GPU together."""

    def __init__(self, jobs: Sequence[Job], kept: np.ndarray) -> None:
        """Place the stops in the memory of the GPU. `kept` are the columns of a sample, (n,)."""
        self.jobs = jobs
        stops = len(jobs)
        axles = jobs[0].plan.kind.axles
        alone = np.zeros(SIZE)
        states = np.zeros(many_rigs.size_of(stops, axles))
        rigs = []
        for rig, job in enumerate(jobs):
            stop = stops_in_lanes.waiting_stop(job.plan, job.unit, kept, SAMPLES, (alone, 0))
            many_rigs.copy(alone, states, rig, stops, axles)
            clocks = np.zeros((1, ticks_in_lanes.COLUMNS_OF_CLOCK), dtype=np.int64)
            rigs.append(ticks_on_device.Rig(stops_in_lanes.record_of(stop), clocks))

        self._controls = np.array([rig.stop.m.control for rig in rigs])
        self._headers = np.array([rig.stop.m.ring_header for rig in rigs])
        self._rows = np.zeros((stops, SAMPLES, kept.size))
        self._states_there = device.Memory(states)
        self._controls_there = device.Memory(self._controls)
        self._headers_there = device.Memory(self._headers)
        self._rows_there = device.Memory(self._rows.nbytes)
        self._records_there = device.Memory(self._table(rigs, axles))
        # a piece may have a sample at its beginning and at its end
        self._steps_of_a_piece = (SAMPLES - 1) * min(
            job.plan.record_ticks * job.plan.params.substeps for job in jobs
        )

    def _table(self, rigs: Sequence[ticks_on_device.Rig], axles: int) -> np.ndarray:
        """Return the records of the stops, uint8 (stops, bytes), and copy the arrays they need."""
        arrays = _Arrays()
        placed = []
        for number, rig in enumerate(rigs):
            m = rig.stop.m
            # kernels read it as they read a state of views
            state: Any = many_rigs.placed(self._states_there.address, number, len(rigs), axles)
            gather = m.gather.copy()
            gather[:, 1] = many_rigs.found(gather[:, 1], number, len(rigs), axles)
            m_there = m._replace(state=state, roller_state=state, gather=gather)
            placed.append(rig._replace(stop=rig.stop._replace(m=m_there)))
            elsewhere = {id(m.buffer), id(m.control), id(m.ring_header), id(m.ring_rows)}
            for array in record_type.arrays_of(placed[-1]):
                if id(array) not in elsewhere:
                    arrays.add(array)
        self._arrays_there = device.Memory(arrays.size)

        there = []
        for number, rig in enumerate(placed):
            m = rig.stop.m
            addresses = {
                id(m.buffer): self._states_there.address,
                id(m.control): self._controls_there.address + number * self._controls[0].nbytes,
                id(m.ring_header): self._headers_there.address + number * self._headers[0].nbytes,
                id(m.ring_rows): self._rows_there.address + number * self._rows[0].nbytes,
            }
            for array in record_type.arrays_of(rig):
                if id(array) not in addresses:
                    addresses[id(array)] = self._arrays_there.address + arrays.add(array)
            there.append(record_type.moved(rig, lambda array, at=addresses: at[id(array)]))
        self._arrays_there.write(arrays.content())
        self._threads = device.compiled(ticks_on_device.threads(record_type.type_of(there[0])))
        return record_type.table(there).memory

    def run(self) -> Iterator[np.ndarray]:
        """Run all stops to their ends; yield the samples of each, (columns, n), in their order."""
        pieces: list[list[np.ndarray]] = [[] for _ in self.jobs]
        next_record = self._records_there.size // len(self.jobs)
        while not self._controls[:, DONE].all():
            device.start(
                self._threads,
                self._records_there.address,
                next_record,
                len(self.jobs),
                self._steps_of_a_piece,
            )
            self._controls_there.read(self._controls)
            self._headers_there.read(self._headers)
            self._rows_there.read(self._rows)
            for rig, of_rig in enumerate(pieces):
                written = int(self._headers[rig, ring.WRITTEN])
                of_rig.append(self._rows[rig, :written].copy())
            # the rows of the next piece begin at the first place again
            self._headers[:, ring.WRITTEN] = 0
            self._headers_there.write(self._headers)
        for of_rig in pieces:
            yield np.concatenate(of_rig).T
            of_rig.clear()
