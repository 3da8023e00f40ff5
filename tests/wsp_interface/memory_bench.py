"""The harness of a bench without a bus, so that a test judges hundreds of stops.

`MemoryBench` offers what `play.play` uses of `harness_client.Harness`. The plant, its ticks, the
steps of the sequence, the measures and the verdicts are those of the product. Values have the
resolution that they have on the bus. `test_flawed_units.py` compares a stop with that of a bench on
the bus.
"""

import math
from collections.abc import Mapping

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES_OF_GROUP
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.bench import free, tick_data
from rollerrig.realtime.campaign import dry_stop
from rollerrig.realtime.commands import sequence as command
from rollerrig.realtime.loop import ring, tick
from rollerrig.wsp_interface import events, magnets, signals
from rollerrig.wsp_interface.harness_client import Event, Harness, reception
from rollerrig.wsp_interface.sequences import play, verdict
from rollerrig.wsp_interface.sequences.record import Record
from rollerrig.wsp_interface.signals import BENCH_NODE, BRAKE_NODE


class Values(Mapping):
    """The newest values of the columns of a harness, read from the row of all signals."""

    def __init__(self, places, row):
        self._places = places
        self._row = row

    def __getitem__(self, name):
        column, scale = self._places[name]
        return float(quantised(self._row[column], scale))

    def __iter__(self):
        return iter(self._places)

    def __len__(self):
        return len(self._places)


def quantised(value, scale):
    """Return values in steps of a scale, as they are on the bus; 0 is a value that is no count."""
    steps = np.where(scale > 0.0, scale, 1.0)
    return np.where(scale > 0.0, np.rint(value / steps) * steps, value)


def places_of(table):
    """Return the column of the row of all signals and the scale of each column of a harness."""
    found = {}
    for signal in table.signals:
        of_bench = [place for place in signal.places if place.node == BENCH_NODE]
        place = next(iter([*of_bench, *signal.places]), None)
        for axle, name in enumerate(signals.columns(signal), start=1):
            counted = place is not None and signal.name != "magnets"
            found[name] = signals.column(signal.name, axle), place.scale if counted else 0.0
    return {name: found[name] for name in reception(table).columns}


class MemoryBench:
    """A bench in memory with a WSP unit for each group of axles.

    `units` is empty for a bench without WSP. A unit has `cycle(counts)`, which returns the byte of
    magnets, the reference speed in counts or None, and the permitted share of each motor.
    """

    lockstep = True

    def __init__(self, sequence, units):
        self.plan = command.scenario_of(sequence)
        self.table = self.plan.table
        # nobody reads the samples
        self._stop = free.Stop(
            self.plan, tick_data.build(self.plan, ring.Memory(1, self.table)), "none"
        )
        self._data = self._stop.data
        self._commands = self._data.commands.values
        self._units = units
        places = places_of(self.table)
        self.columns = tuple(places)
        self.values = Values(places, self._data.row)
        self._at = np.array([column for column, _ in places.values()])
        self._scales = np.array([scale for _, scale in places.values()])
        self._rows = []
        self.events = []
        self.demands = []
        self.record("harness", events.Code.HARNESS_TEXT, message="a bench in memory")
        self._take()

    @property
    def trace(self):
        """The values of every cycle, shape (n, columns)."""
        return quantised(np.array(self._rows), self._scales)

    @property
    def time_s(self):
        return self.values["time_s"]

    def _take(self):
        self._rows.append(self._data.row[self._at])

    def step(self):
        for group, unit in enumerate(self._units):
            self._answer(group, unit)
        self._stop.advance(self.plan.sync_ticks)
        self._take()

    def _answer(self, group, unit):
        """Let the unit of a group answer the speeds of this cycle."""
        axles = np.array(self.table.axles_of(group)) - 1
        place = signals.first_place("measured_speed")
        first = signals.column("measured_speed") + axles[0]
        speeds = self._data.row[first : first + len(axles)]
        counts = np.array([signals.count(speed, place) for speed in speeds])
        byte, reference, shares = unit.cycle(counts)
        self._commands[axles] = magnets.unpack(byte, len(axles))
        self._commands[tick.MOTORS + axles] = shares
        scale = signals.first_place("wsp_reference_speed").scale
        self._commands[tick.REFERENCE + group] = (
            math.nan if reference is None else reference * scale
        )

    # -- what a sequence uses

    def brake(self, pressure_Pa):
        place = self.table.place("brake_demand", BRAKE_NODE)
        self._commands[tick.DEMAND] = signals.value(signals.count(pressure_Pa, place), place)
        self.demands.append((self.time_s, pressure_Pa))

    def friction(self, mu, axles):
        for axle in axles:
            self._commands[tick.FRICTION + axle - 1] = mu

    def sand(self, on):
        self._commands[tick.SAND : tick.SAND + self.plan.kind.axles] = float(on)

    def inject(self, text):
        fault = catalogue.parse(text, self.plan.kind)
        at_s = max(fault.at_s, self.time_s)
        self._stop.faults.inject(fault.kind.name, at_s=at_s, for_s=fault.for_s, **fault.values)
        self.record("harness", events.Code.TEST_FAULT, fault=text)

    def lift(self, text):
        fault = catalogue.parse(text, self.plan.kind)
        self._stop.faults.clear(fault.kind.name, **fault.values)

    def note(self, text):
        self.record("note", events.Code.OPERATOR_NOTE, note=text)

    def record(self, who, code, /, **fields):
        made = events.make(float(self._data.row[signals.column("time")]), code, **fields)
        self.events.append(Event(made.time_s, who, made.text, code, fields))

    # time passes as on a bench with a bus
    wait = Harness.wait
    until = Harness.until

    def read(self, name):
        place = self.table.place(name, BENCH_NODE)
        values = self._data.row[self.table.span(name)]
        return tuple(signals.value(signals.count(value, place), place) for value in values)


def units_of(kind, make):
    """Return a unit for each group of a vehicle: `make(axles)` for its number of axles."""
    axles = [kind.axles_of_group(group) for group in range(kind.groups)]
    assert max(axles) <= AXLES_OF_GROUP
    return [make(number) for number in axles]


def played(sequence, make=None):
    """Return the outcome of a sequence in memory, with units by `make`, or without WSP (None).

    Raises ConfigError for a sequence whose faults need a bus.
    """
    units = [] if make is None else units_of(sequence.kind, make)
    bench = MemoryBench(sequence, units)
    outcome = play.Outcome(sequence, sequence.path.parent)
    play.play(sequence, bench, outcome)
    scenario = bench.plan.resolved
    faults_s = [event.time_s for event in bench.events if event.code == events.Code.TEST_FAULT]
    demands = tuple(bench.demands)
    outcome.record = Record(
        columns=dict(zip(bench.columns, bench.trace.T, strict=True)),
        demands=demands,
        finals=outcome.finals,
        scenario=scenario,
        dry_m=dry_stop.distance_m(scenario, demands),
        fault_s=min(faults_s, default=math.nan),
    )
    outcome.verdicts += verdict.judge(sequence.criteria, outcome.record)
    return outcome


def needs_bus(sequence):
    """Return whether a fault of a sequence exists on a bus only."""
    texts = [text for step in sequence.steps for text in step.faults]
    try:
        faults = [catalogue.parse(text, sequence.kind) for text in texts]
        free.panel.check_without_bus(faults, "memory", "")
    except ConfigError:
        return True
    return False
