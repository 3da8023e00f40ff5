"""A stop without a bus: `--pacing free`, and the stops of all programs that need many.

The compiled loop calls the reference WSP unit where its SYNC would come. Without a recorder the
samples are collected in memory, and are the same as those of a recorded run.
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
# a recorded run looks at recorder and faults so often
_TICKS_BETWEEN_LOOKS = 500
# with no fault to come, ticks are run for at most this time
_LONGEST_S = 3600.0
# a vehicle slower than this stands
_STANDSTILL_M_S = 0.01


class Stop:
    """A stop of `plan` on its `data`, with a unit and faults (default: those of the plan)."""

    def __init__(
        self,
        plan: Scenario,
        data: TickData,
        unit: Unit = "reference",
        faults: panel.Panel | None = None,
    ) -> None:
        self.plan = plan
        self.data = data
        self.faults = faults or panel.Panel(plan.faults, events.ignore)
        self.faults.connect(panel.Site(data.commands.values[tick.FAULTS :], lambda: None))
        self._call: UnitCall | None = unit if callable(unit) else None
        self.reference_unit: logic.Unit | None = None
        if isinstance(unit, logic.Params):
            self.reference_unit = logic.new_unit(unit)
        elif unit == "reference":
            self.reference_unit = logic.new_unit(logic.load(plan["wsp_config"]))
        self._inputs = np.zeros(2 * AXLES, dtype=np.int64)
        self._ticks = None if self.reference_unit else tick.Ticks(data)

    def advance(self, most: int = _MOST_TICKS) -> None:
        """Run `most` ticks, or fewer to the next change of a fault, unit call, or the end."""
        tick_hz = self.plan["loop"]["tick_hz"]
        self.faults.poll(int(self.data.control[TICK]) / tick_hz)
        until_change_s = min(self.faults.next_change_s() - self.faults.now_s, _LONGEST_S)
        ticks = min(most, max(1, round(until_change_s * tick_hz)))
        if self.reference_unit:
            tick.run_ticks_with_unit(
                self.data, ticks, self.plan.sync_ticks, self.reference_unit, self._inputs
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
        for at, name in ((0, "measured_speed"), (AXLES, "cylinder_pressure")):
            place = signals.BY_NAME[name].places[0]
            values = self.data.row[signals.span(name)]
            self._inputs[at : at + AXLES] = [signals.count(value, place) for value in values]
        byte = int(call(self._inputs))
        self.data.commands.values[:AXLES] = magnets.unpack(byte)


def remembered(plan: Scenario, unit: Unit = "reference") -> tuple[Stop, ring.Memory]:
    """Return a stop, and the memory in which its samples are collected."""
    samples = int(plan["duration_max_s"] * plan["loop"]["record_hz"]) + 2
    memory = ring.Memory(samples, len(signals.COLUMNS))
    return Stop(plan, tick_data.build(plan, memory), unit), memory


def simulate(plan: Scenario, unit: Unit = "reference") -> np.ndarray:
    """Run a scenario to its end; return its samples, shape (samples, columns).

    Raises ConfigError.
    """
    panel.check_pacing(plan.faults, "free")
    stop, memory = remembered(plan, unit)
    while not stop.data.control[DONE]:
        stop.advance()
    return memory.written


def channels(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return samples (n, columns) by the names of the table of signals."""
    return dict(zip(signals.COLUMNS, rows.T, strict=True))


def moving(rows: np.ndarray, slowest_m_s: float = _STANDSTILL_M_S) -> np.ndarray:
    """Return the samples of a stop up to standstill, or up to a speed in m/s."""
    still = np.flatnonzero(rows[:, signals.column("vehicle_speed")] <= slowest_m_s)
    return rows[: still[0]] if still.size else rows


async def run(parts: Parts) -> None:
    """Run ticks as fast as possible, with a look at recorder and faults now and then."""
    stop = Stop(parts.plan, parts.data, parts.options.unit, parts.faults)
    await parts.processes.await_recorder(parts.rows)
    while not parts.stopping:
        parts.derailment.look(parts.data.buffer)
        stop.advance(_TICKS_BETWEEN_LOOKS)
        await parts.pause()
