"""A stop without a bus: `--pacing free`, and the stops of all programs that need many.

The compiled loop calls the reference WSP unit where its SYNC would come. Without a recorder the
samples are collected in memory, and are the same as those of a recorded run.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError, UnitError
from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.firmware_sim.faults import panel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import derailment, tick_data
from rollerrig.realtime.bench.parts import ENDED_BY, Parts
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import ring, tick
from rollerrig.realtime.loop.tick import DONE, STOP, TICK, TickData
from rollerrig.wsp_interface import braking, events, magnets, signals
from rollerrig.wsp_interface.events import Code, Event

# an outside unit: axle speeds in 0.01 rad/s and cylinder pressures in mbar, int64 of shape
# (2 axles,), to the byte of magnets (wsp_interface.magnets)
UnitCall = Callable[[np.ndarray], int]
# "reference", "none", a reference unit with other parameters, or an outside unit
Unit = str | logic.Params | UnitCall
_MOST_TICKS = 1 << 20
# a run looks at recorder, faults and derailment so often
_TICKS_BETWEEN_LOOKS = 500
# with no fault to come, ticks are run for at most this time
_LONGEST_S = 3600.0


class Stop:
    """A stop of `plan` on its `data`, with a unit and faults (default: those of the plan).

    `events` holds what happened in a stop in memory, and `ended` how it ended, as in a summary.
    """

    def __init__(
        self,
        plan: Scenario,
        data: TickData,
        unit: Unit = "reference",
        faults: panel.Panel | None = None,
    ) -> None:
        self.plan = plan
        self.data = data
        self.events: list[Event] = []
        self.ended = "finished"
        self.faults = faults or panel.Panel(plan.faults, self._record, plan.resolved)
        self.faults.connect(
            panel.Site(data.commands.values[tick.FAULTS : tick.MOTORS], lambda: None)
        )
        self._call: UnitCall | None = unit if callable(unit) else None
        kind = plan.kind
        if self._call and kind.groups > 1:
            raise ConfigError(
                f"an outside unit in a stop that is only computed has one group of axles, but the "
                f"vehicle has {kind.axles} axles in {kind.groups} groups; allowed are up to four axles, or "
                "--pacing lockstep with a unit for each group"
            )
        self.reference_units: tick.Units | None = None
        if unit == "reference":
            unit = logic.load(plan["wsp_config"])
        if isinstance(unit, logic.Params):
            self.reference_units = tick.Units(np.zeros((kind.groups, logic.SIZE)), unit)
        self._inputs = np.zeros(2 * MOST_AXLES, dtype=np.int64)
        self._ticks = None if self.reference_units else tick.Ticks(data)

    def _record(self, code: Code, /, **fields: Any) -> None:
        """Record an event at the present simulated time."""
        time_s = int(self.data.control[TICK]) / self.plan["loop"]["tick_hz"]
        self.events.append(events.make(time_s, code, **fields))

    def _derail(self) -> None:
        """End the stop because the coach is derailed."""
        self.data.control[STOP] = 1
        self.ended = ENDED_BY[Code.RUN_DERAILED]
        self._record(Code.RUN_DERAILED)

    def fail(self, error: UnitError) -> None:
        """Record that the stop has ended with an error."""
        self.ended = "error"
        self._record(Code.RUN_FAILED, reason=str(error))

    def run(self) -> None:
        """Run a stop in memory to its end, with the events of a recorded run. Raises UnitError."""
        control = self.data.control
        watch = derailment.Watch(self.plan.kind.axles, self._record, self._derail)
        while not control[DONE] and not control[STOP]:
            next_look = control[TICK] + _TICKS_BETWEEN_LOOKS
            while control[TICK] < next_look and not control[DONE]:
                self.advance(int(next_look - control[TICK]))
            watch.look(self.data.buffer)
        self.faults.report_waiting()

    def advance(self, most: int = _MOST_TICKS) -> None:
        """Run `most` ticks, or fewer to the next change of a fault, unit call, or the end."""
        tick_hz = self.plan["loop"]["tick_hz"]
        self.faults.poll(int(self.data.control[TICK]) / tick_hz)
        until_change_s = min(self.faults.next_change_s() - self.faults.now_s, _LONGEST_S)
        ticks = min(most, max(1, round(until_change_s * tick_hz)))
        if self.reference_units:
            tick.run_ticks_with_units(
                self.data, ticks, self.plan.sync_ticks, self.reference_units, self._inputs
            )
            return
        if self._call:
            phase = int(self.data.control[TICK]) % self.plan.sync_ticks
            if phase == 0:
                self._call_unit(self._call)
            ticks = min(ticks, self.plan.sync_ticks - phase)
        assert self._ticks
        self._ticks.run(ticks)

    def _call_unit(self, call: UnitCall) -> None:
        """Let an outside unit set the magnets from what it would receive with a SYNC."""
        table = self.plan.table
        inputs = []
        for name in ("measured_speed", "cylinder_pressure"):
            place = table.by_name[name].places[0]
            inputs += [signals.count(value, place) for value in self.data.row[table.span(name)]]
        byte = call(np.array(inputs))
        if not math.isfinite(byte):
            time_s = int(self.data.control[TICK]) / self.plan["loop"]["tick_hz"]
            raise UnitError(
                f"the unit has failed at {time_s:.3f} s: it returns {byte}; allowed is the byte of "
                "the magnets, 0 to 255"
            )
        axles = table.kind.axles
        self.data.commands.values[:axles] = magnets.unpack(int(byte), axles)


def remembered(plan: Scenario, unit: Unit = "reference") -> tuple[Stop, ring.Memory]:
    """Return a stop, and the memory in which its samples are collected."""
    memory = ring.Memory(most_samples(plan), plan.table)
    return Stop(plan, tick_data.build(plan, memory), unit), memory


def most_samples(plan: Scenario) -> int:
    """Return the number of samples that a stop has at most."""
    return int(plan["duration_max_s"] * plan["loop"]["record_hz"]) + 2


def check(plan: Scenario) -> None:
    """Refuse what a stop in memory cannot simulate. Raises ConfigError."""
    panel.check_without_bus(
        plan.faults,
        "a stop that is only computed",
        f"remove it from {plan.name}, or use 'rollerrig run {plan.name} --pacing lockstep'",
    )


def simulate(plan: Scenario, unit: Unit = "reference") -> np.ndarray:
    """Run a scenario to its end; return its samples, rows of all signals (n, signals.WIDTH).

    Raises ConfigError, UnitError.
    """
    check(plan)
    stop, memory = remembered(plan, unit)
    stop.run()
    return memory.written


def channels(rows: np.ndarray, table: signals.Table) -> dict[str, np.ndarray]:
    """Return the channels of a vehicle, (n,) each, from rows of all signals (n, signals.WIDTH)."""
    return dict(zip(table.columns, rows.T[table.kept], strict=True))


def moving(rows: np.ndarray, slowest_m_s: float = braking.STANDS_M_S) -> np.ndarray:
    """Return the samples of a stop up to standstill, or up to a speed in m/s."""
    still = np.flatnonzero(rows[:, signals.column("vehicle_speed")] <= slowest_m_s)
    return rows[: still[0]] if still.size else rows


async def run(parts: Parts) -> None:
    """Run ticks as fast as possible, with a look at recorder and faults now and then."""
    stop = Stop(parts.plan, parts.data, parts.options.unit, parts.faults)
    await parts.processes.await_recorder(parts.rows)
    while not parts.stopping:
        parts.derailment.look(parts.data.buffer)
        next_look = int(parts.data.control[TICK]) + _TICKS_BETWEEN_LOOKS
        while parts.data.control[TICK] < next_look and not parts.stopping:
            stop.advance(parts.plan.sync_ticks)
            parts.diagnose()
        await parts.pause()
