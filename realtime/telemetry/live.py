"""The live view: a process that shows a run as it goes, and can never hold the run up.

The worker serves Rerun on loopback and beats a heartbeat into the ring of rows. A viewer that stands still makes it
stand still too, since Rerun waits for its clients: then the heart stops, and the watcher kills the worker and starts
another. A worker that has fallen behind by ten seconds drops the oldest rows. The rig knows nothing of all this.
Recording and application name are the recorder's, so a viewer that has both shows one run.

    python -m rollerrig.realtime.telemetry.live RUN_DIR --rows PATH --events PATH
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

import numpy as np

from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Event

_PERIOD_S = 0.1
_BEHIND_S = 10.0
_STALE_S = 5.0
_START_S = 20.0  # a new worker may take this long to its first heartbeat
_LINGER_S = 5.0
_RESTARTS = 50
_POINTS_HZ = 1000.0
_MEMORY = "512MiB"


def start(run_dir: Path, rows: Ring, events: Ring, unit: str = "") -> subprocess.Popen:
    """Start the live view of a run that a `unit` protects; it ends by itself some seconds after the run."""
    return subprocess.Popen(
        _command(run_dir, rows.path, events.path, "--unit", unit),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )


def _command(run_dir: Path, rows: Path, events: Path, *more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "rollerrig.realtime.telemetry.live",
        str(run_dir),
        "--rows",
        str(rows),
        "--events",
        str(events),
        *more,
    ]


def thin(rows: np.ndarray, most: int) -> np.ndarray:
    """Rows (n, columns) as at most `most`: each bin's least and largest value of every signal: no spike is lost."""
    bins = max(most // 2, 1)
    if len(rows) <= 2 * bins:
        return rows
    edges = np.linspace(0, len(rows), bins, endpoint=False).astype(np.int64)
    low, high = np.minimum.reduceat(rows, edges), np.maximum.reduceat(rows, edges)
    return np.stack([low, high], axis=1).reshape(2 * len(edges), -1)


class Feed:
    """What is new in the rings, the oldest dropped where too much has gathered."""

    def __init__(self, rows: Ring, events: Ring, record_hz: float) -> None:
        self._rows, self._events, self._record_hz = rows, events, record_hz
        self._cursor = max(0, int(rows.header[ring.WRITTEN]) - int(_BEHIND_S * record_hz))
        self._event_cursor = 0

    def take(self) -> tuple[np.ndarray, list[Event]]:
        """Rows and events since the last call."""
        rows, self._cursor, _ = self._rows.read(self._cursor)
        events, self._event_cursor, _ = self._events.read(self._event_cursor)
        rows = rows[-int(_BEHIND_S * self._record_hz) :]
        if len(rows):
            span_s = float(np.ptp(rows[:, signals.column("time")]))
            rows = thin(rows, max(int(_POINTS_HZ * span_s), 2))
        return rows, [ring.read_event(event) for event in events]


def serve(run_dir: Path, rows: Ring, events: Ring, port: int, unit: str = "") -> None:
    """The worker: serve the run on loopback until it has ended."""
    import rerun as rr

    from rollerrig.realtime.telemetry import recorder, scene, viewer, views
    from rollerrig.realtime.telemetry.drawing import Drawing

    scenario = recorder.scenario_of(run_dir)
    stream = rr.RecordingStream(
        views.APPLICATION, recording_id=recorder.recording_id(run_dir, rows)
    )
    sink = rr.GrpcServerSink(bind_ip=viewer.LOOPBACK, port=port, server_memory_limit=_MEMORY)
    layout = views.blueprint(live=True, eye=scene.eye(scene.scene(scenario)))
    stream.set_sinks(sink, default_blueprint=layout)
    drawing = Drawing(stream, scenario, everything=False, unit=unit)
    feed = Feed(rows, events, float(scenario.get("loop", {}).get("record_hz", 100)))
    ended_s: float | None = None
    while ended_s is None or time.monotonic() - ended_s < _LINGER_S:
        if ended_s is None and (rows.closed or not rows.writer_alive):
            ended_s = time.monotonic()
        found, happened = feed.take()
        drawing.rows(found)
        drawing.events(happened)
        if len(found):
            at = {
                name: found[-1, signals.column(name)]
                for name in ("time", "vehicle_speed", "position")
            }
            drawing.result(
                f"### {at['time']:.1f} s · {3.6 * at['vehicle_speed']:.0f} km/h · {at['position']:.0f} m",
                at["time"],
            )
        rows.header[ring.READER_BEAT_NS] = time.monotonic_ns()
        time.sleep(_PERIOD_S)


def watch(given: argparse.Namespace, rows: Ring) -> None:
    """The watcher: keep a worker serving, and open the viewer once."""
    from rollerrig.realtime.telemetry import viewer

    port = viewer.free_port(given.port or viewer.GRPC_PORT)
    worker: subprocess.Popen | None = None
    shown: subprocess.Popen | None = None
    starts, begun_s = 0, 0.0
    try:
        while starts <= _RESTARTS:
            if worker is None:
                rows.header[ring.READER_BEAT_NS] = 0
                worker = subprocess.Popen(
                    _command(
                        given.run_dir,
                        given.rows,
                        given.events,
                        "--port",
                        str(port),
                        "--unit",
                        given.unit,
                        "--worker",
                    )
                )
                starts, begun_s = starts + 1, time.monotonic()
            beat_s = int(rows.header[ring.READER_BEAT_NS]) / 1e9
            over = rows.closed or not rows.writer_alive
            if worker.poll() is None and not is_alive(beat_s, begun_s, time.monotonic()):
                worker.kill()
                worker.wait()
            if worker.poll() is not None:
                if worker.returncode == 0 or over:
                    return
                worker = None
            elif beat_s and not shown:
                shown = show(port)
            rows.header[ring.VIEWED] |= bool(beat_s) and viewer.connected(port)
            time.sleep(0.2)
        print(
            "live view: given up, it stood still again and again; the recording goes on",
            file=sys.stderr,
        )
    finally:
        if worker and worker.poll() is None:
            worker.kill()
        if shown and not viewer.has_display():  # a browser that has the page keeps it
            viewer.terminate(shown)


def is_alive(beat_s: float, begun_s: float, now_s: float) -> bool:
    """Whether a worker's heart beats: the last beat is fresh, or it has only just been started."""
    return now_s - beat_s < _STALE_S if beat_s else now_s - begun_s < _START_S


def show(port: int) -> subprocess.Popen:
    """Open the viewer on the worker's address, or serve its page and say where."""
    from rollerrig.realtime.telemetry import viewer

    address = f"rerun+http://{viewer.LOOPBACK}:{port}/proxy"
    if viewer.has_display():
        return viewer.spawn("--port", "auto", "--connect", address)
    web = viewer.free_port(viewer.WEB_PORT)
    served = viewer.serve_page(web, address)
    tunnel = " ".join(f"-L {one}:{viewer.LOOPBACK}:{one}" for one in (web, port))
    print(
        f"live view: {viewer.page_address(web, port)}\n"
        f"  seen from another machine after: ssh {tunnel} {socket.gethostname()}",
        file=sys.stderr,
        flush=True,
    )
    return served


def main(arguments: list[str] | None = None) -> int:
    """The live view's two processes: see the module."""
    parser = argparse.ArgumentParser(prog="live")
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--events", type=Path, required=True)
    parser.add_argument("--port", type=int, default=0, help="wanted port of the server")
    parser.add_argument("--unit", default="", help="whose bands of slip are drawn")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(10)
    rows = Ring(given.rows, np.float64)
    if given.worker:
        serve(given.run_dir, rows, Ring(given.events, np.int64), given.port, given.unit)
        # Rerun's own goodbye waits for its clients, and one may stand still
        sys.stderr.flush()
        os._exit(0)

    def on_terminate(*_: object) -> None:
        if not rows.closed:
            raise SystemExit(0)

    signal.signal(signal.SIGTERM, on_terminate)
    watch(given, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
