"""The imports and kernels of a bench whose run begins: tests fork their benches from here.

Nothing of it differs from a bench that is started by hand; it has no threads, and no run was run in
it.
"""

import numpy as np

from rollerrig.realtime import cli
from rollerrig.realtime.bench import bench, scenario, tick_data
from rollerrig.realtime.record import summary
from rollerrig.wsp_interface import signals

__all__ = ["bench", "cli", "summary"]


class Rows:
    """The memory that `tick_data.build` wants of a ring."""

    header, rows = np.zeros(16, dtype=np.int64), np.zeros((1000, len(signals.COLUMNS)))


for pacing in ("wall", "lockstep"):
    tick_data.warm_up(tick_data.build(scenario.load("velim_a1"), Rows()), pacing, "external")
