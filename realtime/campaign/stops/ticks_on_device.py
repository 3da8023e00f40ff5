"""The ticks of stops on a GPU: a thread for each stop calls the ticks of `ticks_in_lanes`.

Each thread has a table of one stop, whose state lies among those of all others (`many_rigs`). So
the law, the plant and the reference unit are the functions of a core, compiled for the GPU.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from rollerrig.realtime.loop import ticks_in_lanes
from rollerrig.realtime.loop.tick import DONE
from rollerrig.rig.compiled import device, record_type


class Rig(NamedTuple):
    """A stop as its thread needs it."""

    stop: ticks_in_lanes.Stop
    clocks: np.ndarray  # int64 (1, COLUMNS_OF_CLOCK)


record_type.register(Rig)


@functools.cache
def threads(kind: record_type.Record) -> Any:
    """Return what runs ticks of stops in threads (`device.start`).

    kind: the type of the `Rig` of each thread. The argument of `device.start` is the most steps; a
    stop that is done takes none.
    """
    rigs_at = record_type.table_at(kind)

    def run_rig(address: int, most: int) -> None:
        rigs = rigs_at(address)
        m = rigs[0].stop.m
        if m.control[DONE] == 0:
            ticks_in_lanes.run_ticks(rigs.stop, m.state, rigs[0].clocks, most)

    return device.threads_of(run_rig)
