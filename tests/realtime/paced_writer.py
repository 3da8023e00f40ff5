"""A bench for tests of the recorder: makes rings, starts a recorder, and writes rows on time.

As a program it prints its rings and the process number of the recorder as one line of JSON, and
writes until a test kills it. A second of the run has 100 rows, 200 frames and a few events. Writing
it takes two seconds, so that a recorder on a busy machine keeps up.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.bench import processes
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, make

TABLE = signals.table(COACH)
WIDTH = len(TABLE.columns)
ROW_NS = 10_000_000  # a hundredth of a second
SCENARIO = 'title = "rows of a test"\n[loop]\ntick_hz = 1000\nstep_s = 0.0001\nrecord_hz = 100\n'


def rings(capacity=4096, width=WIDTH):
    """Rings of rows, frames and events, written by this process."""
    return (
        Ring(ring.place("rows"), np.float64, capacity, width),
        Ring(ring.place("frames"), np.int64, 2 * capacity, ring.FRAME_WORDS),
        Ring(ring.place("events"), np.int64, 256, ring.EVENT_WORDS),
    )


def row(number):
    """The recorded row `number`: its time is in hundredths of a second.

    Every other column contains the number of its place plus the number of the row.
    """
    values = np.arange(WIDTH, dtype=np.float64) + number
    values[TABLE.columns.index("time_s")] = number / 100.0
    for column in signals.columns(TABLE.by_name["valve"]):
        values[TABLE.columns.index(column)] = (number // 20) % 3
    return values


def write(to, number):
    """Append row `number` and what belongs to its hundredth of a second."""
    rows, frames, events = to
    rows.push(row(number))
    for node in (0, 1):
        frame = np.zeros(ring.FRAME_WORDS, dtype=np.int64)
        frame[ring.FRAME_TIME_NS] = number * ROW_NS + node
        frame[ring.FRAME_ID] = 0x181 + node
        frame[ring.FRAME_LENGTH] = 8
        frame[ring.FRAME_DATA] = number
        frames.push(frame)
    if number % 25 == 0:
        ring.push_event(events, make(number / 100.0, Code.OPERATOR_NOTE, note=f"row {number}"))


def main():
    folder = Path(sys.argv[1])
    (folder / "scenario.toml").write_text(SCENARIO)
    to = rings()
    process = processes.record(folder, COACH, *to, {"pacing": "wall", "seed": 7})
    if not processes.wait_ready(process, to[0]):
        sys.exit("the recorder is not ready")
    report = {"rings": [str(each.path) for each in to], "recorder": process.pid}
    print(json.dumps(report), flush=True)
    number = 0
    while True:
        write(to, number)
        number += 1
        time.sleep(0.02)  # never in a burst, however busy the machine is


if __name__ == "__main__":
    main()
