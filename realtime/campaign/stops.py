"""One stop without bus, recorder or clock: a scenario in, its samples out. For programs that need many.

The same ticks and the same reference WSP unit as a run with `--pacing free`, sampled every 10 ms.
"""

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import bench
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import DONE
from rollerrig.wsp_interface import signals

SAMPLE_S = 0.01


def run(plan: Scenario, unit: logic.Params | None = None) -> np.ndarray:
    """Samples of a whole stop, one row of all signals each, shape (n, columns).

    `unit` stands for the parameters of the reference WSP that the scenario names. Raises ConfigError
    where the tick does not divide 10 ms.
    """
    ticks = round(SAMPLE_S * plan["loop"]["tick_hz"])
    if ticks < 1 or ticks != SAMPLE_S * plan["loop"]["tick_hz"]:
        raise ConfigError(f"{plan.name} [loop]: tick_hz = {plan['loop']['tick_hz']} does not divide a "
                          f"sample of {SAMPLE_S:g} s; use 1000")
    ring = rings.Ring(rings.place("stop"), np.float64, 1 << 12, len(signals.COLUMNS))
    try:
        machine = bench.build_machine(plan, ring)
        memory = logic.new_unit(logic.load(plan["wsp_config"]) if unit is None else unit)
        inputs = np.zeros(2 * tick.AXLES, dtype=np.int64)
        rows = [machine.row.copy()]
        while not machine.control[DONE]:
            tick.batch_with_unit(machine, ticks, plan.sync_ticks, memory, inputs)
            rows.append(machine.row.copy())
    finally:
        ring.close()
        ring.unlink()
    return np.array(rows)


def moving(rows: np.ndarray) -> np.ndarray:
    """The part of a stop up to standstill."""
    still = np.flatnonzero(rows[:, signals.column("vehicle_speed")] <= 0.01)
    return rows[: still[0] if still.size else len(rows)]
