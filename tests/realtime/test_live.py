"""The live view listens on loopback only, never delays the run, and is replaced if it stalls."""

import functools
import os
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any, NamedTuple

import bench_process
import numpy as np
import paced_writer
import pytest
from rerun.experimental import ViewerClient

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.loop import ring
from rollerrig.realtime.telemetry import live, recorder, viewer, views
from rollerrig.wsp_interface import signals

until = functools.partial(bench_process.until, timeout_s=120.0)

# the time that a process may take to exit after a signal
EXIT_S = 60.0

# fields of a line of /proc/net/tcp, and the state of a socket that listens
LOCAL_ADDRESS = 1
STATE = 3
INODE = 9
LISTENS = "0A"

# 127.0.0.1 in /proc/net/tcp
LOOPBACK = "0100007F"


class Listener(NamedTuple):
    """A TCP address on which a process listens."""

    host: str  # hexadecimal, as in /proc/net/tcp
    port: int


def children(process):
    """Return the processes that a process has started, the first one first."""
    text = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(number) for number in text.split()]


def listeners(process):
    """Return the addresses on which a process listens."""
    sockets = sockets_of(process)
    addresses = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[STATE] == LISTENS and fields[INODE] in sockets:
                host, _, port = fields[LOCAL_ADDRESS].partition(":")
                addresses.append(Listener(host, int(port, 16)))
    return addresses


def sockets_of(process):
    """Return the inodes of the sockets that a process has open, as text."""
    inodes = set()
    for link in Path(f"/proc/{process}/fd").iterdir():
        try:
            target = os.readlink(link)
        except OSError:
            # the process has closed the file since the folder was listed
            continue
        if target.startswith("socket:["):
            inodes.add(target.removeprefix("socket:[").removesuffix("]"))
    return inodes


def has_exited(process):
    return not Path(f"/proc/{process}").exists()


class LiveRun(NamedTuple):
    """A run that the test writes, and the live view of it.

    The live view is a watcher process. Its first child is the worker, which serves the run. Its
    second child is a viewer, which serves a page.
    """

    rings: tuple[Any, Any, Any]  # rows, frames, events
    watcher: subprocess.Popen

    @property
    def header(self):
        """The header of the ring of rows, in which bench and live view exchange their states."""
        rows, _, _ = self.rings
        return rows.header

    @property
    def children(self):
        """The process numbers of the worker and of the viewer, as far as they run."""
        return children(self.watcher.pid)

    @property
    def worker(self):
        return self.children[0]

    def worker_listeners(self):
        """Wait until the worker listens, and return its addresses."""
        worker = self.worker
        return until(lambda: listeners(worker), "the worker to listen")

    def server_port(self):
        """Return the port on which the worker serves the run."""
        return self.worker_listeners()[0].port

    def wait_for_heartbeat(self):
        until(lambda: self.header[ring.READER_BEAT_NS], "a heartbeat of the worker")

    def finish(self):
        """Close the rings, as the bench does at the end of a run."""
        for each in self.rings:
            each.close()


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run without rows so far, and a live view of it on a machine without a display."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "scenario.toml").write_text(paced_writer.SCENARIO)
    rings = paced_writer.rings()
    rows, _, events = rings
    live_run = LiveRun(rings, live.start(tmp_path, COACH, rows, events))
    live_run.wait_for_heartbeat()

    yield live_run

    live_run.finish()
    if live_run.watcher.poll() is None:
        live_run.watcher.kill()
    live_run.watcher.wait()
    for each in rings:
        each.unlink()


# --- serving ---


def test_the_live_view_is_served_on_loopback_only(run):
    (listener,) = run.worker_listeners()
    assert listener.host == LOOPBACK


def latest_times_ns(port):
    """Return the recordings that a viewer has, with the latest time of each.

    Empty while the viewer is not ready.
    """
    try:
        client = ViewerClient.connect(viewer.server_address(port))
        found = set()
        for recording in client.get_state().recordings:
            for timeline in recording.timelines:
                if timeline.name == views.TIMELINE:
                    found.add((recording.store_id, timeline.end))
        return found
    except Exception:
        # Rerun does not document the exception of its client
        return set()


@pytest.mark.nightly
def test_a_viewer_sees_the_run_under_the_name_of_the_recorders_recording(run, tmp_path):
    rows, _, _ = run.rings
    port = viewer.free_port()
    window = subprocess.Popen(
        viewer.command(
            "--headless",
            "--port",
            str(port),
            "--connect",
            viewer.server_address(run.server_port()),
        ),
        env=viewer.environment(),
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    )
    try:
        for number in range(100):
            paced_writer.write(run.rings, number)

        name = f"Recording:rollerrig:{recorder.recording_id(tmp_path, rows)}"
        last_row_ns = 990_000_000

        def shows_the_run():
            if window.poll() is not None:
                pytest.skip("no graphics driver for the viewer")
            return (name, last_row_ns) in latest_times_ns(port)

        until(shows_the_run, "the viewer to show the last row")
    finally:
        viewer.terminate(window)
        window.wait(EXIT_S)


def test_without_a_display_a_page_is_served_on_loopback_and_a_client_is_noticed(run):
    # the watcher starts the viewer after the first heartbeat of the worker
    until(lambda: len(run.children) > 1, "the viewer")
    _, page_server = run.children
    (page,) = until(lambda: listeners(page_server), "the viewer to listen")
    assert page.host == LOOPBACK
    assert not run.header[ring.VIEWED]

    with socket.create_connection(("127.0.0.1", run.server_port())):
        until(lambda: run.header[ring.VIEWED], "the live view to notice its client")

    run.watcher.terminate()
    assert run.watcher.wait(EXIT_S) == 0
    until(lambda: has_exited(page_server), "the exit of the viewer")


# --- stalled, terminated and finished ---


@pytest.mark.nightly
def test_a_live_view_that_stalls_is_replaced_and_the_rows_go_on(run):
    stalled = run.worker
    os.kill(stalled, signal.SIGSTOP)
    number = 0
    begun_s = time.monotonic()
    while stalled in run.children:
        paced_writer.write(run.rings, number)
        number += 1
        assert time.monotonic() - begun_s < 120.0
        time.sleep(0.01)

    assert run.header[ring.WRITTEN] == number
    until(lambda: run.children, "a new worker")
    run.wait_for_heartbeat()


@pytest.mark.nightly
def test_a_live_view_that_is_terminated_leaves_no_process(run):
    worker = run.worker
    run.watcher.terminate()
    assert run.watcher.wait(EXIT_S) == 0
    until(lambda: has_exited(worker), "the exit of the worker")


@pytest.mark.nightly
def test_the_live_view_exits_by_itself_after_the_run(run):
    run.finish()
    # A bench does this immediately. It has no effect after the run, because a viewer may still
    # load the last rows.
    run.watcher.terminate()
    assert run.watcher.wait(EXIT_S) == 0


# --- what the worker sends ---


def test_a_feed_drops_the_oldest_rows_when_too_many_have_accumulated():
    rings = paced_writer.rings(8192)
    rows, _, events = rings
    try:
        feed = live.Feed(paced_writer.TABLE, rows, events, record_hz=100.0)
        for number in range(3000):
            paced_writer.write(rings, number)

        new_rows, new_events = feed.take()
        # the last ten seconds
        times_s = new_rows[:, signals.column("time")].tolist()
        assert times_s == [number / 100.0 for number in range(2000, 3000)]
        assert len(new_events) == 120

        later_rows, _ = feed.take()
        assert len(later_rows) == 0
    finally:
        for each in rings:
            each.unlink()


def test_thinned_rows_keep_every_spike():
    rows = np.zeros((10_000, 3))
    rows[:, 0] = np.arange(10_000)
    rows[4321, 1] = 5.0
    rows[777, 2] = -3.0

    thinned = live.thin(rows, 100)

    assert len(thinned) == 100
    rising, with_peak, with_trough = thinned.T
    assert with_peak.max() == 5.0
    assert with_trough.min() == -3.0
    assert rising[0] == 0.0
    assert rising[-1] == 9999.0
    assert np.all(np.diff(rising) > 0)


def test_few_rows_are_not_thinned():
    rows = np.random.default_rng(0).normal(size=(99, 2))
    assert np.array_equal(live.thin(rows, 100), rows)


@pytest.mark.parametrize(
    ("beat_s", "begun_s", "now_s", "expected"),
    [
        # the last heartbeat is 4.9 s or 5.1 s old
        (100.0, 0.0, 104.9, True),
        (100.0, 0.0, 105.1, False),
        # there is no heartbeat yet, and the worker started 10 s or 30 s ago
        (0.0, 90.0, 100.0, True),
        (0.0, 70.0, 100.0, False),
    ],
)
def test_a_worker_is_alive_if_its_heartbeat_is_recent_or_it_has_just_started(
    beat_s, begun_s, now_s, expected
):
    assert live.is_alive(beat_s, begun_s, now_s) is expected
