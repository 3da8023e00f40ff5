"""Rings: order and loss of rows, room, who may have made them, and rows of events."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.desk import reader
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.wsp_interface import signals
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
    path.chmod(0o600)
    with pytest.raises(RollerrigError, match="other: not a ring"):
        Ring(path, np.float64)


# --- rings in a folder that all users share ---


def test_only_the_owner_may_read_and_write_a_ring(tmp_path):
    before = os.umask(0)
    try:
        made = Ring(tmp_path / "ring", np.float64, 8, 2)
    finally:
        os.umask(before)
    assert made.path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("mode", [0o604, 0o640, 0o602, 0o666])
def test_a_ring_to_which_other_users_have_access_is_refused(small, mode):
    small.path.chmod(mode)
    with pytest.raises(RollerrigError, match="other users have access"):
        Ring(small.path, np.float64)


@pytest.mark.conformance("Bad input", "shared memory: a ring of another user is refused")
def test_a_ring_of_another_user_is_refused_and_not_swept(killed):
    if os.geteuid() != 0:
        pytest.skip("only root can give a file to another user")
    Ring(killed, np.float64).header[ring.CREATED_NS] = time.monotonic_ns() - 61_000_000_000
    os.chown(killed, 65534, 65534)
    with pytest.raises(RollerrigError, match="belongs to user 65534"):
        Ring(killed, np.float64)
    assert killed not in map(str, ring.sweep())
    assert os.path.exists(killed)


def test_a_link_and_a_pipe_in_the_place_of_a_ring_are_refused(small, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(small.path)
    with pytest.raises(OSError, match="symbolic links"):
        Ring(link, np.float64)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    with pytest.raises(RollerrigError, match="pipe: not a ring"):
        Ring(pipe, np.float64)


@pytest.mark.parametrize(
    ("capacity", "width"), [(-8, -2), (0, 0), (8, 3), (1 << 62, 2), (8, -2), (16, 1 << 61)]
)
def test_a_ring_whose_header_and_size_differ_is_refused(small, capacity, width):
    small.header[ring.CAPACITY] = capacity
    small.header[ring.WIDTH] = width
    with pytest.raises(RollerrigError, match="not a ring"):
        Ring(small.path, np.float64)


def test_a_reader_refuses_a_ring_whose_rows_have_another_width(small):
    assert Ring(small.path, np.float64, width=2).read(0)[1] == 0
    with pytest.raises(RollerrigError, match="rows have 2 items, allowed here: 3"):
        Ring(small.path, np.float64, width=3)


@pytest.mark.parametrize("written", [-5, 1 << 62])
def test_a_wrong_count_of_rows_gives_at_most_the_rows_of_the_ring(small, written):
    fill(small, range(3))
    other = Ring(small.path, np.float64)
    small.header[ring.WRITTEN] = written
    assert len(other.read(0)[0]) <= 8


@pytest.mark.conformance("Bad input", "shared memory: a ring that is cut off is an error")
@pytest.mark.parametrize("size", [0, 100, 200])
def test_a_reader_survives_a_ring_that_is_cut_off_and_reports_it(tmp_path, size):
    written = Ring(tmp_path / "ring", np.float64, 8, 2)
    fill(written, range(5))
    # a copy, because the writer maps its file, and would not survive
    path = tmp_path / "copy"
    shutil.copy(written.path, path)
    reader = Ring(path, np.float64)
    assert len(reader.read(0)[0]) == 5
    assert reader.intact
    os.truncate(path, size)
    assert not reader.intact
    with pytest.raises(RollerrigError, match=f"copy: .* cut the ring off at {size} of 256 bytes"):
        reader.read(0)
    reader.header[ring.READER_BEAT_NS] = 1
    with pytest.raises(RollerrigError, match="cut the ring off"):
        reader.read(0)
    assert not reader.closed


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


def put_file(path):
    """Make an empty file of another user, or, without root rights, one that all may write."""
    path.touch()
    if os.geteuid() == 0:
        os.chown(path, 65534, 65534)
    path.chmod(0o666)


FOREIGN = {
    "a file of another user": put_file,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link": lambda path: path.symlink_to("/etc/passwd"),
}


@pytest.mark.parametrize("foreign", FOREIGN)
def test_foreign_files_with_names_of_rings_hide_no_running_bench(foreign):
    width = len(signals.table(COACH).columns)
    rows = Ring(ring.place("rows"), np.float64, 8, width)
    _, pid, created_ns, _ = rows.path.name.split("-")
    # the names of the attacker come before that of the ring of events, and after the ring of rows
    names = [
        f"rollerrig-{pid}-{int(created_ns) + 1}-events",
        f"rollerrig-{pid}-0-events",
        f"rollerrig-{pid}-none-events",
        f"rollerrig-{pid}-{int(created_ns) + 1}-rows",
    ]
    attacks = [rows.path.with_name(name) for name in names]
    events = Ring(ring.place("events"), np.int64, 8, ring.EVENT_WORDS)
    try:
        for path in attacks:
            FOREIGN[foreign](path)
        (bench,) = reader.running(lambda of: of == os.getpid())
        ring.push_event(events, make(0.0, Code.BUS_PLACE, address="vcan:here"))
        bench.poll()
        assert bench.bus == "vcan:here"
    finally:
        for path in attacks:
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink(
                missing_ok=True
            )
        rows.unlink()
        events.unlink()
