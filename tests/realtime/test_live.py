"""The live view: on loopback, never in the way, and started again when it stands still."""

import contextlib
import os
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import paced_writer
import pytest
from rerun.experimental import ViewerClient

from rollerrig.realtime.loop import ring
from rollerrig.realtime.telemetry import live, recorder, viewer
from rollerrig.wsp_interface import signals


def children(process):
    """Processes that a process has started."""
    text = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(number) for number in text.split()]


def listening(process):
    """Addresses (hexadecimal, as in /proc/net/tcp) on which a process listens."""
    sockets = set()
    for link in Path(f"/proc/{process}/fd").iterdir():
        try:
            sockets.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
        except OSError:
            continue
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in sockets:
                found.append(fields[1])
    return found


def until(condition, timeout_s=120.0):
    end = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
    return found


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Rings that this process writes, and a live view of them."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "scenario.toml").write_text(paced_writer.SCENARIO)
    to = paced_writer.rings()
    process = live.start(tmp_path, to[0], to[2])
    until(lambda: to[0].header[ring.READER_BEAT_NS])
    yield to, process
    for one in to:
        one.close()
    process.kill() if process.poll() is None else None
    process.wait()
    for one in to:
        one.unlink()


def test_the_live_view_is_served_on_loopback_only(run):
    _, process = run
    worker = children(process.pid)[0]
    addresses = until(lambda: listening(worker))
    assert [address.split(":")[0] for address in addresses] == ["0100007F"]


def test_a_viewer_sees_the_run_under_the_recorders_name(run, tmp_path):
    to, process = run
    worker = children(process.pid)[0]
    server = int(until(lambda: listening(worker))[0].split(":")[1], 16)
    port = viewer.free_port()
    shown = subprocess.Popen(
        viewer.command(
            "--headless", "--port", str(port), "--connect", f"rerun+http://127.0.0.1:{server}/proxy"
        ),
        env=viewer.environment(),
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    )
    try:
        for number in range(100):
            paced_writer.write(to, number)

        def seen():
            if shown.poll() is not None:
                pytest.skip("no graphics driver for the viewer")
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                return {
                    (one.store_id, line.end)
                    for one in client.get_state().recordings
                    for line in one.timelines
                    if line.name == "t"
                }
            except Exception:
                return set()  # not up yet

        name = f"Recording:rollerrig:{recorder.recording_id(tmp_path, to[0])}"
        until(lambda: (name, 990_000_000) in seen())
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(shown.pid, signal.SIGTERM)
        shown.wait(60)


def test_a_live_view_that_stands_still_is_replaced_and_the_rows_go_on(run):
    to, process = run
    worker = children(process.pid)[0]
    os.kill(worker, signal.SIGSTOP)
    number, begun = 0, time.monotonic()
    while worker in children(process.pid):
        paced_writer.write(to, number)
        number += 1
        assert time.monotonic() - begun < 120.0
        time.sleep(0.01)
    assert to[0].header[ring.WRITTEN] == number
    until(lambda: children(process.pid))
    until(lambda: to[0].header[ring.READER_BEAT_NS])


def test_a_live_view_that_is_told_to_end_leaves_no_process(run):
    _, process = run
    worker = children(process.pid)[0]
    process.terminate()
    assert process.wait(60) == 0
    until(lambda: not Path(f"/proc/{worker}").exists())


def test_the_live_view_ends_by_itself_after_the_run(run):
    to, process = run
    for one in to:
        one.close()
    process.terminate()  # as a bench does at once; the viewer may still be fetching
    assert process.wait(60) == 0


def test_without_a_screen_the_page_is_served_on_loopback_and_whoever_joins_is_seen(run):
    to, process = run
    worker, shown = until(lambda: len(found := children(process.pid)) > 1 and found)
    page = until(lambda: listening(shown))
    assert [address.split(":")[0] for address in page] == ["0100007F"]
    assert not to[0].header[ring.VIEWED]
    server = int(until(lambda: listening(worker))[0].split(":")[1], 16)
    with socket.create_connection(("127.0.0.1", server)):
        until(lambda: to[0].header[ring.VIEWED])
    process.terminate()
    assert process.wait(60) == 0
    until(lambda: not Path(f"/proc/{shown}").exists())


def test_a_feed_drops_the_oldest_rows_when_it_has_fallen_behind(tmp_path):
    to = paced_writer.rings(8192)
    try:
        feed = live.Feed(to[0], to[2], record_hz=100.0)
        for number in range(3000):
            paced_writer.write(to, number)
        rows, events = feed.take()
        assert rows[:, signals.column("time")].tolist() == [n / 100.0 for n in range(2000, 3000)]
        assert len(events) == 120
        assert len(feed.take()[0]) == 0
    finally:
        for one in to:
            one.unlink()


def test_thinned_rows_keep_every_spike():
    rows = np.zeros((10_000, 3))
    rows[:, 0] = np.arange(10_000)
    rows[4321, 1], rows[777, 2] = 5.0, -3.0
    thinned = live.thin(rows, 100)
    assert len(thinned) == 100
    assert (thinned[:, 1].max(), thinned[:, 2].min()) == (5.0, -3.0)
    assert (thinned[0, 0], thinned[-1, 0]) == (0.0, 9999.0)
    assert np.all(np.diff(thinned[:, 0]) > 0)


def test_few_rows_are_not_thinned():
    rows = np.random.default_rng(0).normal(size=(99, 2))
    assert live.thin(rows, 100) is rows or np.array_equal(live.thin(rows, 100), rows)


@pytest.mark.parametrize(
    ("beat_s", "begun_s", "now_s", "expected"),
    [
        (100.0, 0.0, 104.9, True),
        (100.0, 0.0, 105.1, False),
        (0.0, 90.0, 100.0, True),
        (0.0, 70.0, 100.0, False),
    ],
)
def test_a_heart_that_has_stopped_is_told_from_one_that_has_yet_to_beat(
    beat_s, begun_s, now_s, expected
):
    assert live.is_alive(beat_s, begun_s, now_s) is expected
