"""The recorder: a process that drains a run's rings into the files of its folder.

It writes channels.parquet, run.rrd, can.log and events.jsonl as the run goes, so that at most the last second is lost
whoever is killed. When the bench dies the recorder finishes the files, says so in summary.json, removes the rings and
leaves. Where its folder can no longer be written (a full disk) it keeps what it has and leaves with the number of the
error as its status. It never holds the bench up, but one without deadlines waits for it when a ring is nearly full.

    python -m rollerrig.realtime.telemetry.recorder RUN_DIR --rows PATH --frames PATH --events PATH

Without arguments it waits for them as a line of JSON, a list, on its standard input: so it can be begun early.
"""

import argparse
import contextlib
import errno
import json
import os
import shutil
import signal
import sys
import threading
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from rollerrig.configs import store
from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.record import channels, records, run_folder, summary
from rollerrig.realtime.record.events import Events
from rollerrig.realtime.record.files import replaced
from rollerrig.realtime.telemetry import derived, scene, views
from rollerrig.realtime.telemetry.drawing import Drawing
from rollerrig.wsp_interface import events as run_events
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import frames
from rollerrig.wsp_interface.events import Code, Event

READY = "recorder ready"
_PERIOD_S = 0.06
_BLOCK_S = 0.4  # rows go to run.rrd in blocks of this much wall time, and in no larger ones than
_BLOCK_ROWS = 1024
_LINGER_S = 2.0  # how long the other rings may still be open when the rows have ended
_FINAL_ROWS = 20_000
_ROOM_BYTES = 1 << 20


def recording_id(run_dir: Path, rows: Ring) -> str:
    """The same for the recorder and the live view of one run, and for no other run."""
    return str(
        uuid.uuid5(
            uuid.NAMESPACE_URL, f"{Path(run_dir).resolve()} {int(rows.header[ring.CREATED_NS])}"
        )
    )


def scenario_of(run_dir: Path) -> dict[str, Any]:
    """The resolved scenario of a run; empty where there is none: a recorder never gives up."""
    with contextlib.suppress(Exception):
        return store.parse(Path(run_dir) / run_folder.SCENARIO)
    return {}


class Recorder:
    """Cursors in three rings, and the files that follow them."""

    def __init__(
        self,
        run_dir: Path,
        rows: Ring,
        frame: Ring,
        event: Ring,
        counters: Mapping[str, Any] | None = None,
    ) -> None:
        self._folder, self._rows, self._frames, self._events = Path(run_dir), rows, frame, event
        self._cursors = [0, 0, 0]
        self._counters = {"scenario": self._folder.resolve().name} | dict(counters or {})
        self._scenario = scenario_of(run_dir)
        self._pending: list[np.ndarray] = []
        self._told = Events()
        self._sent_s, self._time_s, self.frames = 0.0, 0.0, 0
        self.channels = channels.Channels(self._folder)
        # unbuffered: what has been written survives the process
        self._can = open(self._folder / run_folder.CAN_LOG, "wb", buffering=0)  # noqa: SIM115
        self._log = open(self._folder / run_folder.EVENTS, "wb", buffering=0)  # noqa: SIM115
        self._id = recording_id(run_dir, rows)
        self._stream, self._drawing = self._open(self._folder / run_folder.RRD, index=False)

    def _open(self, path: Path, index: bool, **known: Any) -> tuple[rr.RecordingStream, Drawing]:
        """A new recording in a file; its `index` stays in memory until the end, more than 10 MB a minute."""
        # Rerun waits for ever where it finds no room for the layout
        if shutil.disk_usage(path.parent).free < _ROOM_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        stream = rr.RecordingStream(views.APPLICATION, recording_id=self._id)
        eye = scene.eye(scene.geometry(self._scenario))
        stream.set_sinks(
            rr.FileSink(path, write_footer=index),
            default_blueprint=views.blueprint(eye=eye, **known),
        )
        stream.send_recording_name(self._folder.resolve().name)
        return stream, Drawing(stream, self._scenario, unit=str(self._counters.get("unit") or ""))

    def drain(self) -> None:
        """Take what is new in the rings, and write what is due."""
        rows = self._take(0, self._rows, "rows of channels")
        if len(rows):
            self._time_s = float(rows[-1, signals.column("time")])
            self.channels.add(rows)
            self._pending.append(rows)
        found = self._take(1, self._frames, "CAN frames")
        if len(found):
            self.frames += len(found)
            lines = [
                frames.candump_line(frame_of(row), signals.BUS_CHANNEL) for row in found.tolist()
            ]
            self._can.write(("\n".join(lines) + "\n").encode())
        self._write_events([ring.read_event(row) for row in self._take(2, self._events, "events")])
        if self._pending and time.monotonic() - self._sent_s > _BLOCK_S:
            self._send()
        self.channels.write_if_due()
        self._rows.header[ring.RECORDER_BEAT_NS] = time.monotonic_ns()

    def _take(self, which: int, source: Ring, what: str) -> np.ndarray:
        found, self._cursors[which], lost = source.read(self._cursors[which])
        source.header[ring.READ] = self._cursors[which]
        source.header[ring.LOST] += lost
        if lost:
            self._write_events(
                [run_events.make(self._time_s, Code.RECORDER_OVERRUN, lost=lost, rows=what)]
            )
        return found

    def _write_events(self, events: list[Event]) -> None:
        if events:
            for event in events:
                self._told.add(event)
            lines = [json.dumps(event._asdict()) for event in events]
            self._log.write(("\n".join(lines) + "\n").encode())
            self._drawing.events(events)

    def _send(self) -> None:
        rows, self._pending = np.concatenate(self._pending), []
        for first in range(0, len(rows), _BLOCK_ROWS):
            self._drawing.rows(rows[first : first + _BLOCK_ROWS])
        self._sent_s = time.monotonic()

    def finish(self, ended: str) -> None:
        """Complete all files. `ended` says how: finished, killed (the bench died) or terminated."""
        self.drain()
        if ended == "killed":
            self._write_events([run_events.make(self._time_s, Code.BENCH_KILLED)])
        self.channels.finish()
        self._stream.disconnect()
        stored = channels.Columns(self._folder)
        # rows of all rings that were overwritten before they were read
        lost = sum(int(one.header[ring.LOST]) for one in (self._rows, self._frames, self._events))
        counters = self._counters | {
            "ended": ended,
            "bus": {"frames": self.frames},
            "recorder": {"lost": lost},
        }
        found = summary.of(stored, counters, self._scenario, self._told)
        self._compact(stored, derived.result_text(found))
        records.write_summary(self._folder, found)
        self._can.close()
        self._log.close()

    def _compact(self, stored: channels.Columns, result: str) -> None:
        """Write run.rrd anew in large blocks: smaller, faster to open, and with an index; if there is room for both."""
        if (
            shutil.disk_usage(self._folder).free
            < _ROOM_BYTES + (self._folder / run_folder.RRD).stat().st_size
        ):
            return
        with replaced(self._folder / run_folder.RRD) as new:
            stream, drawing = self._open(new, index=True, ends=views.axis_ends(stored))
            for block in stored.blocks(_FINAL_ROWS):
                drawing.rows(records.rows(block))
                stream.flush()
            drawing.events(self._told)
            drawing.result(result)
            stream.disconnect()


def frame_of(row: list[int]) -> frames.Frame:
    """One row of a frame ring: time in ns, identifier and flags, length, data as 8 bytes."""
    time_ns, word, length, data = row
    remote = bool(word & frames.REMOTE_FLAG)
    body = b"" if remote else (data & (2**64 - 1)).to_bytes(8, "little")[:length]
    return frames.Frame(
        word & frames.EXTENDED_ID_MAX,
        body,
        bool(word & frames.EXTENDED_FLAG),
        remote,
        length,
        time_ns,
        bool(word & frames.ERROR_FLAG),
    )


def run(recorder: Recorder, rings: tuple[Ring, Ring, Ring], stop: threading.Event) -> str:
    """Drain until the rows have ended, the writer died, or a signal asks to stop; returns which."""
    rows = rings[0]
    closed_s: float | None = None
    while True:
        # asked before draining: what was written until then is drained afterwards
        alive, closed = rows.writer_alive, all(r.closed for r in rings)
        if rows.closed and closed_s is None:
            closed_s = time.monotonic()
        recorder.drain()
        if closed or (closed_s is not None and time.monotonic() - closed_s > _LINGER_S):
            return "finished"
        if not alive:
            return "finished" if rows.closed else "killed"
        if stop.is_set():
            return "terminated"
        # half a ring is waiting (a run without deadlines): go on at once
        if min(r.room / r.header[ring.CAPACITY] for r in rings) > 0.5:
            time.sleep(_PERIOD_S)


def main(arguments: list[str] | None = None) -> int:
    """The recorder process: see the module."""
    parser = argparse.ArgumentParser(prog="recorder")
    parser.add_argument("run_dir", type=Path)
    for name in ("--rows", "--frames", "--events"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument(
        "--counters",
        type=json.loads,
        default={},
        metavar="JSON",
        help="what the summary of a killed run shall say",
    )
    if arguments is None:
        arguments = sys.argv[1:]
    if not arguments and (arguments := json.loads(sys.stdin.readline() or "null")) is None:
        return 0  # the run did not come to be
    given = parser.parse_args(arguments)
    stop = threading.Event()
    # Ctrl-C and a closed terminal are the bench's to answer
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with contextlib.suppress(OSError):
        os.setsid()
    with contextlib.suppress(OSError):
        os.nice(5)
    rings = Ring(given.rows, np.float64), Ring(given.frames, np.int64), Ring(given.events, np.int64)
    recorder, ended, status = None, "", 0
    channels.leave_pandas_out()
    try:
        recorder = Recorder(given.run_dir, *rings, given.counters)
        recorder.drain()
        print(READY, flush=True)
        ended = run(recorder, rings, stop)
        recorder.finish(ended)
    except (OSError, RollerrigError) as error:
        status = getattr(error, "errno", None) or errno.EIO
        with contextlib.suppress(OSError, ValueError):  # or it has been closed
            if recorder:  # what the tail holds takes less room there
                recorder.channels.finish()
    if ended == "killed" or not rings[0].writer_alive:
        for one in rings:
            one.unlink()
    if status:
        os._exit(status)  # Rerun's own goodbye would wait for the disk
    return 0


if __name__ == "__main__":
    sys.exit(main())
