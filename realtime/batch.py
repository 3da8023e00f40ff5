"""A run without bus, recorder or deadlines: a scenario in, its summary and channels out.

The same ticks as `rollerrig run --pacing free`, collected in memory, so figures are equal to those
of a recorded run. The unit is the reference WSP inside the compiled loop, none, or a Python call.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from rollerrig.firmware_sim import wsp
from rollerrig.realtime import bench, scenario, summary, tick
from rollerrig.realtime import ring as rings
from rollerrig.realtime.scenario import Scenario
from rollerrig.realtime.tick import AXLES, DONE
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
    samples = int(plan["duration_max_s"] * plan["loop"]["record_hz"]) + 2
    memory = Memory(samples)
    machine = bench.build_machine(plan, memory)  # type: ignore[arg-type]
    inputs = np.zeros(2 * AXLES, dtype=np.int64)
    if unit == "none":
        while not machine.control[DONE]:
            tick.batch(machine, 1 << 20)
    elif unit == "reference":
        own = wsp.new_unit(wsp.load(plan["wsp_config"]))
        while not machine.control[DONE]:
            tick.batch_with_unit(machine, 1 << 20, plan.sync_ticks, own, inputs)
    else:
        _with_call(machine, plan, unit, inputs)  # type: ignore[arg-type]
    written = int(memory.header[rings.WRITTEN])
    return {name: memory.rows[:written, i] for i, name in enumerate(signals.COLUMNS)}


def _with_call(machine: tick.Machine, plan: Scenario, unit: UnitCall, inputs: np.ndarray) -> None:
    speeds, pressures = signals.BY_NAME["wheel_speed"], signals.BY_NAME["cylinder_pressure"]
    while not machine.control[DONE]:
        for at, signal in ((0, speeds), (AXLES, pressures)):
            values = machine.row[signals.span(signal.name)]
            inputs[at:at + AXLES] = [signals.count(value, signal.places[0]) for value in values]
        byte = int(unit(inputs))
        machine.commands.values[:AXLES] = [byte >> 2 * j & 3 for j in range(AXLES)]
        tick.batch(machine, plan.sync_ticks)


def summarize(plan: Scenario, channels: dict[str, np.ndarray], unit: str) -> dict[str, Any]:
    """The summary of a run in memory, as a recorded run in free pacing has it."""
    ticks = round(float(channels["time_s"][-1]) * plan["loop"]["tick_hz"])
    counters = {"pacing": "free", "seed": 0, "unit": unit, "config_hash": scenario.digest(plan),
                "scenario": plan.name, "loop": {"ticks": ticks, "missed": 0}}
    return summary.of(channels, counters, plan.resolved)
