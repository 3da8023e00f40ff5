"""A stop without a bus: `--pacing free`, and the stops of all programs that need many.

The reference WSP unit is called inside the compiled loop, where its SYNC would come. Without a
recorder the samples are collected in memory, and are those of a recorded run.
"""

from collections.abc import Callable

import numpy as np

from rollerrig.firmware_sim.faults import panel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import tick_data
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import ring, tick
from rollerrig.realtime.loop.tick import AXLES, DONE, TICK, TickData
from rollerrig.wsp_interface import events, magnets, signals

# an outside unit: axle speeds in 0.01 rad/s and cylinder pressures in mbar, int64 (8,), to the byte
# of magnets (wsp_interface.magnets)
UnitCall = Callable[[np.ndarray], int]
# "reference", "none", a reference unit with other parameters, or an outside unit
Unit = str | logic.Params | UnitCall
_MOST_TICKS = 1 << 20
_TICKS_BETWEEN_LOOKS = 500


class Stop:
    """A stop of `plan` on `data`, as built for it, with a unit and faults (default: the plan's)."""

    def __init__(
        self,
        plan: Scenario,
        data: TickData,
        unit: Unit = "reference",
        faults: panel.Panel | None = None,
    ) -> None:
        self.plan, self.data = plan, data
        self.faults = faults or panel.Panel(plan.faults, events.ignore)
        self.faults.connect(panel.Site(data.commands.values[tick.FAULTS :], lambda: None))
        self._call: UnitCall | None = unit if callable(unit) else None
        self.own: logic.Unit | None = None
        if isinstance(unit, logic.Params) or unit == "reference":
            self.own = logic.new_unit(
                unit if isinstance(unit, logic.Params) else logic.load(plan["wsp_config"])
            )
        self._inputs = np.zeros(2 * AXLES, dtype=np.int64)
        self._ticks = None if self.own else tick.Ticks(data)

    def advance(self, most: int = _MOST_TICKS) -> None:
        """Run ticks: `most`, or fewer until a fault begins or ends, an outside unit is asked, or the end."""
        tick_hz = self.plan["loop"]["tick_hz"]
        self.faults.poll(int(self.data.control[TICK]) / tick_hz)
        ticks = min(
            most,
            max(1, round(min(self.faults.next_change_s() - self.faults.now_s, 3600.0) * tick_hz)),
        )
        if self.own:
            tick.run_ticks_with_unit(self.data, ticks, self.plan.sync_ticks, self.own, self._inputs)
            return
        if self._call:
            past = int(self.data.control[TICK]) % self.plan.sync_ticks
            if not past:
                self._ask(self._call)
            ticks = min(ticks, self.plan.sync_ticks - past)
        assert self._ticks
        self._ticks.run(ticks)

    def _ask(self, call: UnitCall) -> None:
        for at, name in ((0, "measured_speed"), (AXLES, "cylinder_pressure")):
            place, values = signals.BY_NAME[name].places[0], self.data.row[signals.span(name)]
            self._inputs[at : at + AXLES] = [signals.count(value, place) for value in values]
        byte = int(call(self._inputs))
        self.data.commands.values[:AXLES] = magnets.unpack(byte)


def remembered(plan: Scenario, unit: Unit = "reference") -> tuple[Stop, ring.Memory]:
    """A stop, and the memory that its samples are collected in."""
    memory = ring.Memory(
        int(plan["duration_max_s"] * plan["loop"]["record_hz"]) + 2, len(signals.COLUMNS)
    )
    return Stop(plan, tick_data.build(plan, memory), unit), memory


def simulate(plan: Scenario, unit: Unit = "reference") -> np.ndarray:
    """Run a scenario to its end; its samples, shape (samples, columns). Raises ConfigError."""
    panel.check_pacing(plan.faults, "free")
    stop, memory = remembered(plan, unit)
    while not stop.data.control[DONE]:
        stop.advance()
    return memory.written


def channels(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Samples (n, columns) by the names of the table of signals."""
    return dict(zip(signals.COLUMNS, rows.T, strict=True))


def moving(rows: np.ndarray, slowest_m_s: float = 0.01) -> np.ndarray:
    """The part of a stop's samples up to standstill, or to a speed in m/s."""
    still = np.flatnonzero(rows[:, signals.column("vehicle_speed")] <= slowest_m_s)
    return rows[: still[0] if still.size else len(rows)]


async def run(parts: Parts) -> None:
    """Run ticks as fast as they go, with a look at recorder and faults now and then."""
    stop = Stop(parts.plan, parts.data, parts.options.unit, parts.faults)
    await parts.processes.await_recorder(parts.rows)
    while not parts.stopping:
        parts.derailment.look(parts.data.buffer)
        stop.advance(_TICKS_BETWEEN_LOOKS)
        await parts.pause()
