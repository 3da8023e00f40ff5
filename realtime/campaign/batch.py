"""A run without bus, recorder or deadlines: a scenario in, its summary and channels out.

The same ticks as `rollerrig run --pacing free`, collected in memory, so figures are equal to those
of a recorded run. The unit is the reference WSP inside the compiled loop, none, or a Python call.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from rollerrig.firmware_sim.faults import panel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import bench, scenario
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.campaign import four_stops
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import AXLES, DONE
from rollerrig.realtime.record import summary
from rollerrig.wsp_interface import signals

# an outside unit: axle speeds in 0.01 rad/s and cylinder pressures in mbar, int64 (8,), to the byte
# of magnets (bit 2j hold, 2j+1 vent)
UnitCall = Callable[[np.ndarray], int]


class Memory:
    """Rows of a run in memory, shaped as the ring that `bench.build_machine` wants."""

    def __init__(self, rows: int) -> None:
        self.header = np.zeros(16, dtype=np.int64)
        self.rows = np.zeros((rows, len(signals.COLUMNS)))


def simulate(plan: Scenario, unit: str | UnitCall = "reference") -> dict[str, np.ndarray]:
    """Run a scenario to its end; channels by name, each of shape (samples,)."""
    memory = _memory(plan)
    machine = bench.build_machine(plan, memory)  # type: ignore[arg-type]
    inputs = np.zeros(2 * AXLES, dtype=np.int64)
    panel.check_pacing(plan.faults, "free")
    faults = panel.Panel(plan.faults, lambda level, text: None)
    faults.connect(panel.Site(machine.commands.values[tick.FAULTS:], lambda: None))
    own = logic.new_unit(logic.load(plan["wsp_config"]))
    while not machine.control[DONE]:
        ticks = _due(faults, machine, plan) if plan.faults else 1 << 20
        if unit == "none":
            tick.batch(machine, ticks)
        elif unit == "reference":
            tick.batch_with_unit(machine, ticks, plan.sync_ticks, own, inputs)
        else:
            _with_call(machine, plan, unit, inputs)  # type: ignore[arg-type]
            tick.batch(machine, min(ticks, plan.sync_ticks))
    return channels_of(memory)


def together(
    jobs: Iterable[tuple[Any, Scenario]], unit: str | UnitCall = "reference"
) -> Iterator[tuple[Any, Scenario, dict[str, np.ndarray]]]:
    """Run many scenarios, four at a time where they allow it: (tag, scenario, channels) as they end.

    A result does not depend on which stops ran beside it; against `simulate` it differs by rounding.
    """
    groups: dict[int, list[tuple[Any, Scenario]]] = {}
    for tag, plan in jobs:
        if unit in ("reference", "none") and four_stops.fits(plan):
            groups.setdefault(plan.params.substeps, []).append((tag, plan))
        else:
            yield tag, plan, simulate(plan, unit)
    for group in groups.values():
        for stop in four_stops.run(_stop(tag, plan, unit != "none") for tag, plan in group):
            tag, plan, memory = stop.tag
            yield tag, plan, channels_of(memory)


def _stop(tag: Any, plan: Scenario, with_unit: bool) -> four_stops.Stop:
    memory = _memory(plan)
    machine = bench.build_machine(plan, memory)  # type: ignore[arg-type]
    return four_stops.Stop(machine, logic.new_unit(logic.load(plan["wsp_config"])),
                       plan.sync_ticks if with_unit else 0, (tag, plan, memory))


def _memory(plan: Scenario) -> Memory:
    return Memory(int(plan["duration_max_s"] * plan["loop"]["record_hz"]) + 2)


def channels_of(memory: Memory) -> dict[str, np.ndarray]:
    """What a machine has recorded, by the names of the table of signals."""
    written = int(memory.header[rings.WRITTEN])
    return {name: memory.rows[:written, i] for i, name in enumerate(signals.COLUMNS)}


def _due(faults: panel.Panel, machine: tick.Machine, plan: Scenario) -> int:
    """Let faults begin and end; ticks until the next does."""
    now_s = int(machine.control[tick.TICK]) / plan["loop"]["tick_hz"]
    faults.poll(now_s)
    return max(1, round(min(faults.next_change_s() - now_s, 3600.0) * plan["loop"]["tick_hz"]))


def _with_call(machine: tick.Machine, plan: Scenario, unit: UnitCall, inputs: np.ndarray) -> None:
    """Ask an outside unit where its SYNC would come."""
    if machine.control[tick.TICK] % plan.sync_ticks:
        return
    for at, name in ((0, "measured_speed"), (AXLES, "cylinder_pressure")):
        signal = signals.BY_NAME[name]
        values = machine.row[signals.span(name)]
        inputs[at:at + AXLES] = [signals.count(value, signal.places[0]) for value in values]
    byte = int(unit(inputs))
    machine.commands.values[:AXLES] = [byte >> 2 * j & 3 for j in range(AXLES)]


def summarize(plan: Scenario, channels: dict[str, np.ndarray], unit: str) -> dict[str, Any]:
    """The summary of a run in memory, as a recorded run in free pacing has it."""
    ticks = round(float(channels["time_s"][-1]) * plan["loop"]["tick_hz"])
    counters = {"pacing": "free", "seed": 0, "unit": unit, "config_hash": scenario.digest(plan),
                "scenario": plan.name, "loop": {"ticks": ticks, "missed": 0}}
    return summary.of(channels, counters, plan.resolved)
