"""Rings: order and loss of rows, room, the check that the writer is alive, and rows of events."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.wsp_interface.events import Code, make

_WRITER = """
import sys, time
import numpy as np
from rollerrig.realtime.loop import ring
one = ring.Ring(ring.place("rows"), np.float64, 8, 2)
print(one.path, flush=True)
time.sleep(60)
"""


@pytest.fixture
def small(tmp_path):
    return Ring(tmp_path / "ring", np.float64, 8, 2)


@pytest.fixture
def killed():
    """The path of a ring whose writer was killed and not yet waited for (a zombie)."""
    process = subprocess.Popen([sys.executable, "-c", _WRITER], stdout=subprocess.PIPE, text=True)
    path = process.stdout.readline().strip()
    reader = Ring(path, np.float64)
    assert reader.writer_alive
    os.kill(process.pid, signal.SIGKILL)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    yield path
    process.wait()
    reader.unlink()


def fill(one, numbers):
    for number in numbers:
        one.push(np.array([number, 10.0 * number]))


def test_a_reader_gets_every_row_once_and_in_order(small):
    other = Ring(small.path, np.float64)
    seen = []
    cursor = 0
    for first in range(0, 30, 5):
        fill(small, range(first, first + 5))
        rows, cursor, lost = other.read(cursor)
        assert lost == 0
        seen += rows[:, 0].tolist()
    assert seen == list(range(30))
    assert np.array_equal(other.read(cursor)[0], np.empty((0, 2)))


def test_a_reader_that_fell_behind_learns_how_many_rows_it_lost(small):
    fill(small, range(20))
    rows, cursor, lost = small.read(0)
    assert lost + len(rows) == 20
    assert rows[:, 0].tolist() == list(range(lost, 20))
    assert cursor == 20


def test_the_slot_that_the_writer_fills_next_is_never_read(small):
    fill(small, range(8))
    rows, _, lost = small.read(0)
    assert lost == 1
    assert rows[0, 0] == 1.0


def test_room_is_what_may_be_written_before_the_recorder_loses_a_row(small):
    assert small.room == 7
    fill(small, range(small.room))
    assert small.room == 0
    assert small.read(0)[2] == 0
    small.header[ring.READ] = small.read(0)[1]
    assert small.room == 7


def test_a_ring_is_closed_while_its_writer_is_still_alive(small):
    other = Ring(small.path, np.float64)
    assert other.writer_alive
    assert not other.closed
    small.close()
    assert other.closed
    assert other.writer_alive


def test_a_killed_writer_is_dead_even_as_a_zombie(killed):
    assert not Ring(killed, np.float64).writer_alive


def test_a_dead_writer_is_noticed_after_the_file_is_gone(killed):
    reader = Ring(killed, np.float64)
    reader.unlink()
    assert not reader.writer_alive


def test_sweeping_removes_abandoned_rings_of_dead_writers_and_nothing_else(killed):
    mine = Ring(ring.place("rows"), np.float64, 8, 2)
    try:
        assert killed not in map(str, ring.sweep())  # its recorder may still be at work
        left = Ring(killed, np.int64)
        left.header[ring.CREATED_NS] = time.monotonic_ns() - 61_000_000_000
        mine.header[ring.CREATED_NS] = left.header[ring.CREATED_NS]
        swept = list(map(str, ring.sweep()))
        assert killed in swept
        assert str(mine.path) not in swept
        assert mine.path.exists()
    finally:
        mine.unlink()


def test_a_new_ring_in_an_old_place_leaves_the_old_readers_their_rows(tmp_path):
    old = Ring(tmp_path / "ring", np.float64, 8, 2)
    fill(old, range(3))
    new = Ring(tmp_path / "ring", np.float64, 4, 2)
    assert old.read(0)[0][:, 0].tolist() == [0.0, 1.0, 2.0]
    assert len(new.read(0)[0]) == 0


@pytest.mark.parametrize("content", [b"", b"x" * 200])
def test_a_file_that_is_not_a_ring_is_refused_with_its_name(tmp_path, content):
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(RollerrigError, match="other: not a ring"):
        Ring(path, np.float64)


def note(text, time_s=0.0):
    return make(time_s, Code.OPERATOR_NOTE, note=text)


def test_events_of_several_threads_all_arrive(tmp_path):
    events = Ring(tmp_path / "events", np.int64, 1024, ring.EVENT_WORDS)

    def push(thread):
        for number in range(100):
            ring.push_event(events, note(f"{thread} {number}", number))

    threads = [threading.Thread(target=push, args=(thread,)) for thread in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    rows, _, lost = events.read(0)
    assert lost == 0
    notes = {ring.read_event(row).fields["note"] for row in rows}
    assert notes == {f"{thread} {number}" for thread in range(4) for number in range(100)}


@pytest.mark.parametrize("text", ["axle 1 locked", "Räder rollen: λ = 0.3 µ", "", "a\nb"])
def test_an_event_comes_out_as_it_went_in(tmp_path, text):
    events = Ring(tmp_path / "events", np.int64, 4, ring.EVENT_WORDS)
    event = note(text, 12.345)
    ring.push_event(events, event)
    assert ring.read_event(events.read(0)[0][0]) == event


def test_a_long_event_is_cut_between_characters(tmp_path):
    events = Ring(tmp_path / "events", np.int64, 4, ring.EVENT_WORDS)
    ring.push_event(events, note("λ" * 1000))
    text = ring.read_event(events.read(0)[0][0]).fields["note"]
    assert set(text) == {"λ"}
    assert len(text) > 200


@pytest.mark.parametrize("text", ["a" * 1000, "\0" * 1000, '"' * 1000, "λ" * 1000])
def test_of_a_long_event_the_longest_text_is_cut_and_code_and_other_fields_are_kept(tmp_path, text):
    events = Ring(tmp_path / "events", np.int64, 4, ring.EVENT_WORDS)
    given = make(1.0, Code.BENCH_EXCEPTION, message="hub: node failed", exception=text)
    ring.push_event(events, given)
    found = ring.read_event(events.read(0)[0][0])
    assert found.time_s == 1.0
    assert found.code == Code.BENCH_EXCEPTION
    assert found.fields["message"] == "hub: node failed"
    assert 60 < len(found.fields["exception"]) < 500
    assert text.startswith(found.fields["exception"])
