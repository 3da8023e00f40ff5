"""The live view: it shows a run while it goes on, and can never delay the run.

A worker process serves Rerun on loopback and writes a heartbeat into the ring of rows. Rerun waits
for its clients, so a viewer that stalls stalls the worker as well. The heartbeat then stops, and
the watcher process kills the worker and starts another. A worker that is ten seconds behind drops
the oldest rows. The rig does not know about any of this.

The recording has the same name as the recorder's, so a viewer that has both shows one run.

    python -m rollerrig.realtime.telemetry.live RUN_DIR --rows PATH --events PATH --kind KIND
"""

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.processes import children
from rollerrig.configs.vehicle import Kind
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.telemetry import kind_option
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Event

_MODULE = "rollerrig.realtime.telemetry.live"

# s. The worker sends what is new with this period, the watcher looks with this period.
_PERIOD_S = 0.1
_WATCH_PERIOD_S = 0.2

# s. Rows that are older than this are dropped.
_BEHIND_S = 10.0

# s. A worker whose heartbeat is older than this has stalled. A new worker may take longer to its
# first heartbeat.
_STALE_S = 5.0
_START_S = 20.0

# s. The worker serves for this time after the end of the run.
_LINGER_S = 5.0

# The watcher gives up after this many workers.
_RESTARTS = 50

# Hz. The most points of a signal in a second of the run.
_POINTS_HZ = 1000.0

_MEMORY = "512MiB"

# Hz, of a scenario that states none
_RECORD_HZ = 100

# added to the nice value: the view gives way to everything else
_NICENESS = 10


# --- start ---


def start(run_dir: Path, kind: Kind, rows: Ring, events: Ring, unit: str = "") -> subprocess.Popen:
    """Start the live view of a run that a `unit` protects; it exits some seconds after the run.

    `kind` is that of the vehicle.
    """
    return subprocess.Popen(
        _command(run_dir, kind, rows.path, events.path, "--unit", unit),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )


def _command(run_dir: Path, kind: Kind, rows: Path, events: Path, *more: str) -> list[str]:
    return [
        *children.module(_MODULE),
        str(run_dir),
        *kind_option.words(kind),
        "--rows",
        str(rows),
        "--events",
        str(events),
        *more,
    ]


# --- the worker ---


def thin(rows: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` rows for rows (n, columns), with every spike.

    The rows are divided into bins. Each bin gives two rows: the smallest and the largest value of
    every signal.
    """
    bins = max(most // 2, 1)
    if len(rows) <= 2 * bins:
        return rows
    starts = np.linspace(0, len(rows), bins, endpoint=False).astype(np.int64)
    smallest = np.minimum.reduceat(rows, starts)
    largest = np.maximum.reduceat(rows, starts)
    return np.stack([smallest, largest], axis=1).reshape(2 * len(starts), -1)


class Feed:
    """New rows and events of the rings, without the oldest rows if too many have accumulated.

    `table` has the signals of the vehicle.
    """

    def __init__(self, table: signals.Table, rows: Ring, events: Ring, record_hz: float) -> None:
        self._table = table
        self._time_column = table.columns.index("time_s")
        self._rows = rows
        self._events = events
        self._most_rows = int(_BEHIND_S * record_hz)
        self._row_cursor = max(0, int(rows.header[ring.WRITTEN]) - self._most_rows)
        self._event_cursor = 0

    def take(self) -> tuple[np.ndarray, list[Event]]:
        """Return the rows of all signals, thinned, and the events since the last call."""
        rows, self._row_cursor, _ = self._rows.read(self._row_cursor)
        events, self._event_cursor, _ = self._events.read(self._event_cursor)
        rows = rows[-self._most_rows :]
        if len(rows):
            span_s = float(np.ptp(rows[:, self._time_column]))
            most_points = max(int(_POINTS_HZ * span_s), 2)
            rows = thin(rows, most_points)
        return self._table.rows_of_all(rows), [ring.read_event(event) for event in events]


def serve(run_dir: Path, kind: Kind, rows: Ring, events: Ring, port: int, unit: str = "") -> None:
    """Serve the run on loopback until some seconds after its end. This is the worker."""
    import rerun as rr

    from rollerrig.realtime.telemetry import recorder, scene, viewer, views
    from rollerrig.realtime.telemetry.drawing import Drawing

    scenario = recorder.scenario_of(run_dir)
    identity = recorder.recording_id(run_dir, rows)
    stream = rr.RecordingStream(views.APPLICATION, recording_id=identity)
    sink = rr.GrpcServerSink(bind_ip=viewer.LOOPBACK, port=port, server_memory_limit=_MEMORY)
    table = signals.table(kind)
    layout = views.blueprint(table, live=True, eye=scene.eye(scene.geometry(kind, scenario)))
    stream.set_sinks(sink, default_blueprint=layout)

    drawing = Drawing(stream, table, scenario, everything=False, unit=unit)
    record_hz = float(scenario.get("loop", {}).get("record_hz", _RECORD_HZ))
    feed = Feed(table, rows, events, record_hz)
    ended_s: float | None = None
    while ended_s is None or time.monotonic() - ended_s < _LINGER_S:
        if ended_s is None and (rows.closed or not rows.writer_alive):
            ended_s = time.monotonic()
        new_rows, new_events = feed.take()
        drawing.rows(new_rows)
        drawing.events(new_events)
        if len(new_rows):
            newest = new_rows[-1]
            drawing.result(_heading(newest), newest[signals.column("time")])
        rows.header[ring.READER_BEAT_NS] = time.monotonic_ns()
        time.sleep(_PERIOD_S)


def _heading(row: np.ndarray) -> str:
    """Return time, speed and position of a row in a line of Markdown."""
    time_s = row[signals.column("time")]
    speed_km_h = 3.6 * row[signals.column("vehicle_speed")]
    position_m = row[signals.column("position")]
    return f"### {time_s:.1f} s · {speed_km_h:.0f} km/h · {position_m:.0f} m"


# --- the watcher ---


class _View(NamedTuple):
    """What a worker serves: the folder, vehicle and rings of a run, its unit, and a port."""

    run_dir: Path
    kind: Kind
    rows: Path
    events: Path
    unit: str
    port: int


def _start_worker(view: _View) -> subprocess.Popen:
    command = _command(
        view.run_dir,
        view.kind,
        view.rows,
        view.events,
        "--port",
        str(view.port),
        "--unit",
        view.unit,
        "--worker",
    )
    return subprocess.Popen(command)


def watch(view: _View, rows: Ring) -> None:
    """Keep a worker running until the run is over, and open the viewer once."""
    from rollerrig.realtime.telemetry import viewer

    worker: subprocess.Popen | None = None
    opened: subprocess.Popen | None = None
    starts = 0
    begun_s = 0.0
    try:
        while starts <= _RESTARTS:
            if worker is None:
                rows.header[ring.READER_BEAT_NS] = 0
                worker = _start_worker(view)
                starts += 1
                begun_s = time.monotonic()

            beat_s = int(rows.header[ring.READER_BEAT_NS]) / 1e9
            run_is_over = rows.closed or not rows.writer_alive
            if worker.poll() is None and not is_alive(beat_s, begun_s, time.monotonic()):
                worker.kill()
                worker.wait()
            if worker.poll() is not None:
                if worker.returncode == 0 or run_is_over:
                    return
                worker = None
            elif beat_s and not opened:
                opened = open_viewer(view.port)

            if beat_s and viewer.has_client(view.port):
                rows.header[ring.VIEWED] = 1
            time.sleep(_WATCH_PERIOD_S)
        print(
            f"live view: it stopped, because it stalled {_RESTARTS} times; the recording continues",
            file=sys.stderr,
        )
    finally:
        if worker and worker.poll() is None:
            worker.kill()
        # a window stays open; a browser that has loaded the page keeps it
        if opened and not viewer.has_display():
            viewer.terminate(opened)


def is_alive(beat_s: float, begun_s: float, now_s: float) -> bool:
    """Return whether a worker works: its last heartbeat is recent, or it has just started.

    `beat_s` is the time of the last heartbeat, 0 before the first. `begun_s` is the time of its
    start.
    """
    if beat_s:
        return now_s - beat_s < _STALE_S
    return now_s - begun_s < _START_S


def open_viewer(port: int) -> subprocess.Popen:
    """Open the viewer on the worker's port; without a display, serve its page and print where."""
    from rollerrig.realtime.telemetry import viewer

    address = viewer.server_address(port)
    if viewer.has_display():
        return viewer.spawn("--port", "auto", "--connect", address)

    web_port = viewer.free_port(viewer.WEB_PORT)
    page = viewer.serve_page(web_port, address)
    forwards = [f"-L {number}:{viewer.LOOPBACK}:{number}" for number in (web_port, port)]
    print(
        f"live view: {viewer.page_address(web_port, port)}\n"
        f"  from another machine, first run: ssh {' '.join(forwards)} {socket.gethostname()}",
        file=sys.stderr,
        flush=True,
    )
    return page


# --- both processes ---


def main(arguments: list[str] | None = None) -> int:
    """Run the watcher, or with --worker the worker; return the exit status."""
    given = _parse(arguments)
    # Ctrl-C reaches the bench, which stops the view
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICENESS)
    rows = Ring(given.rows, np.float64, width=len(signals.table(given.kind).columns))
    if given.worker:
        events = Ring(given.events, np.int64, width=ring.EVENT_WORDS)
        serve(given.run_dir, given.kind, rows, events, given.port, given.unit)
        # an ordinary exit waits for Rerun's clients, and a client may have stalled
        sys.stderr.flush()
        os._exit(0)

    def on_terminate(*_: object) -> None:
        if not rows.closed:
            raise SystemExit(0)

    signal.signal(signal.SIGTERM, on_terminate)
    from rollerrig.realtime.telemetry import viewer

    view = _View(
        run_dir=given.run_dir,
        kind=given.kind,
        rows=given.rows,
        events=given.events,
        unit=given.unit,
        port=viewer.free_port(given.port or viewer.GRPC_PORT),
    )
    watch(view, rows)
    return 0


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="live")
    parser.add_argument("run_dir", type=Path)
    kind_option.add(parser)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--events", type=Path, required=True)
    parser.add_argument("--port", type=int, default=0, help="preferred port of the server")
    parser.add_argument("--unit", default="", help="unit whose slip limits are drawn")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
