"""The recorder: a process that reads the rings of a run and writes the files of its folder.

It writes channels.parquet, run.rrd, can.log and events.jsonl while the run goes on. So at most the
last second is lost, whichever process is killed.

- If the bench dies, the recorder completes the files, notes the reason in summary.json, removes the
  rings and exits.
- If it cannot write its folder any more (for example, the disk is full), it keeps what it has
  written and exits. Its exit status is the error number of the operating system.

The recorder never delays a bench that has deadlines. A bench without deadlines waits for the
recorder when a ring is nearly full.

    python -m rollerrig.realtime.telemetry.recorder RUN_DIR --rows PATH --frames PATH --events PATH
        --kind KIND

Without arguments it reads them from its standard input: one line, a JSON list. So the bench can
start the recorder before it knows the run.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from rollerrig.configs import store
from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.output_files import create, place_of, replaced
from rollerrig.configs.vehicle import Kind
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.record import channels, played, records, run_folder, summary, validity
from rollerrig.realtime.record.events import Events
from rollerrig.realtime.telemetry import derived, kind_option, scene, views
from rollerrig.realtime.telemetry.drawing import Drawing
from rollerrig.wsp_interface import events as run_events
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import frames
from rollerrig.wsp_interface.events import Code, Event

# the recorder prints this line when it has opened its files
READY = "recorder ready"

# s; pause between two looks at the rings
_PERIOD_S = 0.06
# s; rows go to run.rrd in blocks of this much wall time
_BLOCK_S = 0.4
# rows; a larger block is split
_BLOCK_ROWS = 1024
# rows; blocks of the complete run.rrd
_FINAL_ROWS = 20_000
# s; the other rings may stay open for this time after the ring of rows is closed
_LINGER_S = 2.0
# a run is written only while the disk has this much free space
_ROOM_BYTES = 1 << 20
# share of a ring; the recorder pauses only while every ring has more room than this
_ROOM_FOR_A_PAUSE = 0.5
# added to the nice value of this process: the bench has priority
_NICENESS = 5


class Rings(NamedTuple):
    """The three rings of a run, see `ring`."""

    rows: Ring
    frames: Ring
    events: Ring


@dataclass
class _Source:
    """A ring that the recorder reads."""

    ring: Ring
    description: str  # of its rows, for the report on lost ones
    cursor: int = 0  # how many rows have been read or lost


def recording_id(run_dir: Path, rows: Ring) -> str:
    """Return the identity of a recording in Rerun.

    The recorder and the live view of a run get the same one. Every other run gets another one.
    """
    created_ns = int(rows.header[ring.CREATED_NS])
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"{Path(run_dir).resolve()} {created_ns}"))


def scenario_of(run_dir: Path) -> dict[str, Any]:
    """Return the resolved scenario of a run, or an empty one if it cannot be read.

    A run without a readable scenario must still be recorded.
    """
    with contextlib.suppress(Exception):
        return store.parse(Path(run_dir) / run_folder.SCENARIO)
    return {}


class Recorder:
    """Reads three rings and writes the files of a run of a `kind` of vehicle.

    `counters` are entries of the summary that only the bench knows, see `summary.of`. They are used
    if the bench is killed.
    """

    def __init__(
        self,
        run_dir: Path,
        kind: Kind,
        rows: Ring,
        frame: Ring,
        event: Ring,
        counters: Mapping[str, Any] | None = None,
    ) -> None:
        self._folder = Path(run_dir)
        self._table = signals.table(kind)
        self._time_column = self._table.columns.index("time_s")
        self._rows = _Source(rows, "rows of channels")
        self._frames = _Source(frame, "CAN frames")
        self._events = _Source(event, "events")
        self._counters = {"scenario": self._folder.resolve().name} | dict(counters or {})
        self._scenario = scenario_of(run_dir)

        # rows that are not yet in run.rrd, and when the last ones were sent there (monotonic time)
        self._unsent_rows: list[np.ndarray] = []
        self._sent_s = 0.0
        # time in the run of the last row
        self._time_s = 0.0
        self._frame_count = 0
        self._recorded_events = Events()
        # how the bench has ended the run early; "" if it has not
        self._ended_by = ""

        self.channels = channels.Channels(self._folder, self._table.columns)
        # unbuffered: written lines survive the death of this process
        self._can_log = create(self._folder / run_folder.CAN_LOG, buffering=0)
        self._event_log = create(self._folder / run_folder.EVENTS, buffering=0)
        self._recording_id = recording_id(run_dir, rows)
        # Rerun opens its file by a name; this one leads to a file that is already open
        self._rrd = create(self._folder / run_folder.RRD)
        place = place_of(self._rrd.fileno())
        self._stream, self._drawing = self._open(place, index=False)

    def _open(self, path: Path, index: bool, **layout: Any) -> tuple[rr.RecordingStream, Drawing]:
        """Open a new recording in a file; return its stream and the drawing on it.

        An `index` makes the file faster to open. Rerun keeps it in memory until the end of the
        recording, more than 10 MB for each minute. `layout` goes to `views.blueprint`. Raises
        OSError if the disk is full.
        """
        # if there is no room for the layout, Rerun waits for ever
        if shutil.disk_usage(self._folder).free < _ROOM_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        stream = rr.RecordingStream(views.APPLICATION, recording_id=self._recording_id)
        eye = scene.eye(scene.geometry(self._table.kind, self._scenario))
        stream.set_sinks(
            rr.FileSink(path, write_footer=index),
            default_blueprint=views.blueprint(self._table, eye=eye, **layout),
        )
        stream.send_recording_name(self._folder.resolve().name)
        unit = str(self._counters.get("unit") or "")
        return stream, Drawing(stream, self._table, self._scenario, unit=unit)

    # --- while the run goes on ---

    def drain(self) -> None:
        """Read all new rows of the rings, and write the files that are due."""
        self._write_rows(self._read(self._rows))
        self._write_frames(self._read(self._frames))
        self._write_events([ring.read_event(row) for row in self._read(self._events)])

        if self._unsent_rows and time.monotonic() - self._sent_s > _BLOCK_S:
            self._send_rows()
        self.channels.write_if_due()
        self._rows.ring.header[ring.RECORDER_BEAT_NS] = time.monotonic_ns()

    def _read(self, source: _Source) -> np.ndarray:
        """Return the new rows of a ring, shape (n, width). Lost rows become an event."""
        new_rows, source.cursor, lost = source.ring.read(source.cursor)
        source.ring.header[ring.READ] = source.cursor
        source.ring.header[ring.LOST] += lost
        if lost:
            overrun = run_events.make(
                self._time_s, Code.RECORDER_OVERRUN, lost=lost, rows=source.description
            )
            self._write_events([overrun])
        return new_rows

    def _write_rows(self, rows: np.ndarray) -> None:
        """Write recorded rows, shape (n, columns of the vehicle), to the channels.

        run.rrd gets them later, in larger blocks.
        """
        if not len(rows):
            return
        self._time_s = float(rows[-1, self._time_column])
        self.channels.add(rows)
        self._unsent_rows.append(rows)

    def _write_frames(self, rows: np.ndarray) -> None:
        """Write rows of the ring of frames, shape (n, 4), to can.log."""
        if not len(rows):
            return
        self._frame_count += len(rows)
        lines = [frames.candump_line(frame_of(row), signals.BUS_CHANNEL) for row in rows.tolist()]
        self._can_log.write(_as_bytes(lines))

    def _write_events(self, events: list[Event]) -> None:
        """Write events to events.jsonl and run.rrd, and keep them for the summary."""
        if not events:
            return
        for event in events:
            self._recorded_events.add(event)
            self._note(event)
        self._event_log.write(_as_bytes([json.dumps(event._asdict()) for event in events]))
        self._drawing.events(events)

    def _note(self, event: Event) -> None:
        """Note what the summary needs of an event: the identity of a unit, and the end of a run."""
        unit = self._counters.get("unit_played")
        if unit and event.code == Code.UNIT_IDENTITY:
            unit["identity"] = [*(unit["identity"] or ()), event.fields]
        elif event.code in validity.ENDED_BY:
            # a failure counts more than what has ended the run before it
            is_failure = event.code == Code.RUN_FAILED
            if is_failure or not self._ended_by:
                self._ended_by = validity.ENDED_BY[event.code]

    def _send_rows(self) -> None:
        """Send the waiting rows to run.rrd."""
        rows = np.concatenate(self._unsent_rows)
        self._unsent_rows = []
        for first in range(0, len(rows), _BLOCK_ROWS):
            block = rows[first : first + _BLOCK_ROWS]
            self._drawing.rows(self._table.rows_of_all(block))
        self._sent_s = time.monotonic()

    # --- at the end of the run ---

    def finish(self, ended: str) -> None:
        """Complete all files.

        `ended` is the reason: finished, killed (the bench died) or terminated.
        """
        self.drain()
        if ended == "killed":
            self._write_events([run_events.make(self._time_s, Code.BENCH_KILLED)])
        self._stream.disconnect()

        # rows of all rings that the writer overwrote before the recorder read them
        sources = (self._rows, self._frames, self._events)
        lost = sum(int(source.ring.header[ring.LOST]) for source in sources)
        counters = self._counters | {
            "ended": self._ended_by or ended,
            "bus": {"frames": self._frame_count},
            "recorder": {"lost": lost},
        }
        run_summary = summary.of(
            channels.Columns(self._folder),
            counters,
            self._scenario,
            self._recorded_events,
            self._table.kind,
        )
        self.channels.finish(played.of_summary(run_summary).texts())

        stored = channels.Columns(self._folder)
        self._compact(stored, derived.result_text(run_summary))
        records.write_summary(self._folder, run_summary)
        self._can_log.close()
        self._event_log.close()

    def _compact(self, stored: channels.Columns, result: str) -> None:
        """Write run.rrd again, in large blocks and with an index.

        The new file is smaller and opens faster. If the disk has no room for both files, the old
        one stays.
        """
        path = self._folder / run_folder.RRD
        free_bytes = shutil.disk_usage(self._folder).free
        if free_bytes < _ROOM_BYTES + path.stat().st_size:
            return

        with replaced(path) as new:
            ends = views.axis_ends(self._table, stored)
            stream, drawing = self._open(new, index=True, ends=ends)
            for block in stored.blocks(_FINAL_ROWS):
                drawing.rows(records.rows(block, self._table))
                stream.flush()
            drawing.events(self._recorded_events)
            drawing.result(result)
            stream.disconnect()


def _as_bytes(lines: list[str]) -> bytes:
    """Return lines as the bytes of a text file."""
    return ("\n".join(lines) + "\n").encode()


def frame_of(row: list[int]) -> frames.Frame:
    """Return the frame in a row of a ring of frames.

    The row has the time in ns, the identifier with flags, the length, and the data as 8 bytes.
    """
    time_ns, identifier_and_flags, length, data_word = row
    remote = bool(identifier_and_flags & frames.REMOTE_FLAG)
    data = b""
    if not remote:
        # the ring holds a signed word: the mask makes it unsigned
        data = (data_word & (2**64 - 1)).to_bytes(8, "little")[:length]
    return frames.Frame(
        can_id=identifier_and_flags & frames.EXTENDED_ID_MAX,
        data=data,
        extended=bool(identifier_and_flags & frames.EXTENDED_FLAG),
        remote=remote,
        dlc=length,
        time_ns=time_ns,
        error=bool(identifier_and_flags & frames.ERROR_FLAG),
    )


# --- the process ---


def run(recorder: Recorder, rings: Rings, stop: threading.Event) -> str:
    """Drain the rings until the run ends; return how it ended.

    - finished: the bench closed its rings
    - killed: the bench died before it closed the ring of rows
    - terminated: `stop` is set
    """
    rows_closed_s: float | None = None
    while True:
        # look first and drain afterwards: then nothing that was written before the look is left
        writer_alive = rings.rows.writer_alive
        all_closed = all(each.closed for each in rings)
        if rings.rows.closed and rows_closed_s is None:
            rows_closed_s = time.monotonic()
        recorder.drain()

        if all_closed:
            return "finished"
        if rows_closed_s is not None and time.monotonic() - rows_closed_s > _LINGER_S:
            return "finished"
        if not writer_alive:
            return "finished" if rings.rows.closed else "killed"
        if stop.is_set():
            return "terminated"

        # a run without deadlines fills a ring quickly: then drain again without a pause
        least_room = min(each.room / each.header[ring.CAPACITY] for each in rings)
        if least_room > _ROOM_FOR_A_PAUSE:
            time.sleep(_PERIOD_S)


def main(arguments: list[str] | None = None) -> int:
    """Run the recorder process and return its exit status. See the module for the arguments."""
    if arguments is None:
        arguments = sys.argv[1:]
    if not arguments:
        arguments = json.loads(sys.stdin.readline() or "null")
    if arguments is None:
        # the bench gave up before the run began
        return 0

    given = _parser().parse_args(arguments)
    stop = threading.Event()
    _detach_from_bench(stop)
    rings = Rings(
        rows=Ring(given.rows, np.float64, width=len(signals.table(given.kind).columns)),
        frames=Ring(given.frames, np.int64, width=ring.FRAME_WORDS),
        events=Ring(given.events, np.int64, width=ring.EVENT_WORDS),
    )
    channels.leave_pandas_out()

    recorder: Recorder | None = None
    ended = ""
    status = 0
    try:
        recorder = Recorder(given.run_dir, given.kind, *rings, given.counters)
        recorder.drain()
        print(READY, flush=True)
        ended = run(recorder, rings, stop)
        recorder.finish(ended)
    except (OSError, RollerrigError) as error:
        status = getattr(error, "errno", None) or errno.EIO
        if isinstance(error, RollerrigError):
            print(f"recorder: {error}", file=sys.stderr, flush=True)
        if recorder:
            _save_channels(recorder)

    # a living bench removes its rings itself
    if ended == "killed" or not rings.rows.writer_alive:
        for each in rings:
            each.unlink()
    if status:
        # a normal exit would let Rerun wait for the disk
        os._exit(status)
    return 0


def _parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="recorder")
    parser.add_argument("run_dir", type=Path)
    for name in ("--rows", "--frames", "--events"):
        parser.add_argument(name, type=Path, required=True)
    kind_option.add(parser)
    parser.add_argument(
        "--counters",
        type=json.loads,
        default={},
        metavar="JSON",
        help="entries of summary.json if the bench is killed",
    )
    return parser


def _detach_from_bench(stop: threading.Event) -> None:
    """Make this process independent of the terminal and of lower priority than the bench.

    The signal TERM sets `stop`.
    """
    # the bench reacts to Ctrl-C and to a closed terminal, and then closes its rings
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with contextlib.suppress(OSError):
        os.setsid()
    with contextlib.suppress(OSError):
        os.nice(_NICENESS)


def _save_channels(recorder: Recorder) -> None:
    """Complete channels.parquet after an error, if the disk allows it.

    The rows need less room there than in channels.tail.
    """
    # ValueError: the files are closed already
    with contextlib.suppress(OSError, ValueError):
        recorder.channels.finish()


if __name__ == "__main__":
    sys.exit(main())
