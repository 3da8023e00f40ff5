"""Loads the imports and kernels of a bench whose run begins: tests fork their benches from here.

A forked bench does not differ from a bench that is started by hand. This process has no threads,
and it has simulated no run.
"""

import numpy as np

from rollerrig.realtime import cli
from rollerrig.realtime.bench import bench, scenario, tick_data
from rollerrig.realtime.record import summary
from rollerrig.wsp_interface import signals

__all__ = ["bench", "cli", "summary"]


class Rows:
    """The memory of a ring, as `tick_data.build` needs it."""

    header = np.zeros(16, dtype=np.int64)
    rows = np.zeros((1000, len(signals.COLUMNS)))


for pacing in ("wall", "lockstep"):
    data = tick_data.build(scenario.load("velim_a1"), Rows())
    tick_data.warm_up(data, pacing, "external")
