"""A ring of rows in shared memory: one writer that never waits, any number of readers.

The writer (often the real-time thread) copies a row into its slot and then increments the count of
rows written. Each reader has a cursor, and learns how many rows it lost if it fell behind by more
than the capacity. The memory is a mapped file, so it outlives a writer that is killed.

Three rings belong to a run: `rows` (float64, one row of all signals a sample), `frames` (int64:
time in ns, identifier and flags, length, data as 8 little-endian bytes) and `events` (int64: time
in ns, then code and fields as JSON).

The writer holds a lock on the file as long as it runs. The operating system releases the lock when
the writer exits or is killed.
"""

import fcntl
import json
import mmap
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import Code, Event

# slots of the header, int64; times are on CLOCK_MONOTONIC
WRITTEN = 0  # rows that the writer has appended
CLOSED = 1  # 1 when no more rows will come
WRITER_PID = 2  # process number of the writer
CAPACITY = 3  # rows
WIDTH = 4  # items of 8 bytes in a row
READER_BEAT_NS = 5  # heartbeat of the live view, which writes it
READ = 6  # rows that the recorder has read, which writes it
LOST = 7  # rows that were overwritten before the recorder read them; it writes this
CREATED_NS = 8  # when the writer made the ring
RECORDER_BEAT_NS = 9  # heartbeat of the recorder, which writes it; 0: it is not ready yet
VIEWED = 10  # 1 while a viewer has joined the live view, which writes it
_HEADER = 16
# words of 8 bytes in a row of a ring of events, and of frames
EVENT_WORDS = 64
FRAME_WORDS = 4
# places in a row of a ring of frames; FRAME_ID also has the flags of `wsp_interface.bus.frames`
FRAME_TIME_NS, FRAME_ID, FRAME_LENGTH, FRAME_DATA = range(FRAME_WORDS)
# the most bytes that one character takes in JSON: escaped, as in \\u0001
_BYTES_PER_CHARACTER = 6
_PREFIX = "rollerrig-"
# a ring without a writer whose recorder has been silent for this time is removed
_ABANDONED_NS = 60_000_000_000


def folder() -> Path:
    """Return the folder for rings: in memory where the system has one, else a temporary one."""
    in_memory = Path("/dev/shm")
    return in_memory if in_memory.is_dir() else Path(tempfile.gettempdir())


def place(kind: str) -> Path:
    """Return a path for a ring of this process, of a kind (rows, frames, events)."""
    return folder() / f"{_PREFIX}{os.getpid()}-{time.monotonic_ns()}-{kind}"


def sweep() -> list[Path]:
    """Remove rings that no writer locks and no recorder reads; return what was removed.

    Writer and recorder of such a ring were killed.
    """
    removed: list[Path] = []
    for path in sorted(folder().glob(_PREFIX + "*")):
        try:
            ring = Ring(path, np.int64)
        except (OSError, ValueError, RollerrigError):
            continue
        last_ns = max(int(ring.header[RECORDER_BEAT_NS]), int(ring.header[CREATED_NS]))
        idle_ns = time.monotonic_ns() - last_ns
        if not ring.writer_alive and idle_ns > _ABANDONED_NS:
            ring.unlink()
            removed.append(path)
    return removed


class Memory:
    """The memory of a ring within one process: `rows` of shape (capacity, width) float64.

    `appending.push` fills it.
    """

    def __init__(self, capacity: int, width: int) -> None:
        self.header = np.zeros(_HEADER, dtype=np.int64)
        self.rows = np.zeros((capacity, width))

    @property
    def written(self) -> np.ndarray:
        """All rows so far, if they are not more than the capacity."""
        return self.rows[: int(self.header[WRITTEN])]


class Ring:
    """A ring on a mapped file. `rows` has shape (capacity, width) and 8 bytes an item.

    With a capacity this process makes the file and is its writer; without, it is a reader. Raises
    RollerrigError where there is not enough memory or the file is not a ring.
    """

    def __init__(self, path: Path, dtype: type, capacity: int = 0, width: int = 0) -> None:
        self.path = Path(path)
        self._one_at_a_time = threading.Lock()
        if capacity:
            _make(self.path, 8 * (_HEADER + capacity * width))
        self._file = open(self.path, "r+b")  # noqa: SIM115 (open as long as the map: it carries the lock)
        if capacity:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        size = os.fstat(self._file.fileno()).st_size
        if size < 8 * _HEADER:
            raise RollerrigError(f"{self.path}: not a ring ({size} bytes)")
        self._map = mmap.mmap(self._file.fileno(), 0)
        words = np.frombuffer(self._map, dtype=np.int64)
        self.header = words[:_HEADER]
        if capacity:
            # touch every page now: the real-time thread must never have a page fault here
            words[:] = 0
            self.header[CAPACITY] = capacity
            self.header[WIDTH] = width
            self.header[WRITER_PID] = os.getpid()
            self.header[CREATED_NS] = time.monotonic_ns()
        rows_in_file = int(self.header[CAPACITY])
        items_in_row = int(self.header[WIDTH])
        if 8 * (_HEADER + rows_in_file * items_in_row) != size:
            raise RollerrigError(
                f"{self.path}: not a ring ({rows_in_file} rows of {items_in_row} items in {size} bytes)"
            )
        self.rows: np.ndarray = words[_HEADER:].view(dtype).reshape(rows_in_file, items_in_row)
        if capacity:
            from rollerrig.realtime.loop import appending

            self._append = appending.push
            # compile now: the first row of a run must not wait for the compiler
            self.push(np.zeros_like(self.rows[0]))
            self.header[WRITTEN] = 0

    def push(self, row: np.ndarray) -> None:
        """Append one row of `width` items; any thread of the writing process may call this."""
        with self._one_at_a_time:
            self._append(self.header, self.rows, row)

    def read(self, cursor: int) -> tuple[np.ndarray, int, int]:
        """Return a copy of the rows since `cursor`, the new cursor, and how many rows were lost.

        A slot that the writer may be filling is left out. Rows that were overwritten while they
        were copied count as lost.
        """
        capacity = self.rows.shape[0]
        written = int(self.header[WRITTEN])
        first = max(cursor, written - capacity + 1)
        skipped = first - cursor
        rows = self.rows[np.arange(first, written) % capacity]
        # look again: the writer may have gone on meanwhile
        first_valid = int(self.header[WRITTEN]) - capacity + 1
        overwritten = min(max(0, first_valid - first), len(rows))
        return rows[overwritten:], written, skipped + overwritten

    @property
    def room(self) -> int:
        """How many rows the writer may append before the recorder loses one."""
        return int(self.header[CAPACITY] - 1 - (self.header[WRITTEN] - self.header[READ]))

    def close(self) -> None:
        """Mark the ring as closed: no more rows will come."""
        self.header[CLOSED] = 1

    @property
    def closed(self) -> bool:
        return bool(self.header[CLOSED])

    @property
    def writer_alive(self) -> bool:
        """Whether the process that made the ring runs, by its lock.

        Its number may belong to another process, or to a zombie.
        """
        with open(f"/proc/self/fd/{self._file.fileno()}") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False

    def unlink(self) -> None:
        """Remove the file; processes that have it mapped keep their memory."""
        self.path.unlink(missing_ok=True)


def _make(path: Path, size: int) -> None:
    """Make a new file of zeros.

    An old file is unlinked first, so that its readers keep their memory.
    """
    path.unlink(missing_ok=True)
    try:
        with open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(bytes(size))
    except OSError as error:
        path.unlink(missing_ok=True)
        raise RollerrigError(
            f"{path}: no room for a ring of {size / 1e6:.1f} MB "
            f"({error.strerror}); make room in {path.parent}"
        ) from None


def push_event(ring: Ring, event: Event) -> None:
    """Append an event to a ring of events: its time in ns, then code and fields as JSON.

    A row has room for 504 bytes; where that is too little, the longest text field is cut.
    """
    row = np.zeros(EVENT_WORDS, dtype=np.int64)
    row[0] = round(event.time_s * 1e9)
    body = _event_bytes(event)
    row[1:].view(np.uint8)[: len(body)] = np.frombuffer(body, dtype=np.uint8)
    ring.push(row)


def _event_bytes(event: Event) -> bytes:
    """Return code and fields as JSON that fits into a row."""
    fields = dict(event.fields)
    body = json.dumps([event.code, fields], ensure_ascii=False).encode()
    room = 8 * (EVENT_WORDS - 1)
    while len(body) > room:
        excess = len(body) - room
        texts = [name for name, value in fields.items() if isinstance(value, str)]
        longest = max(texts, key=lambda name: len(fields[name]))
        # a character may take several bytes, so the text may be cut more than once
        characters = len(fields[longest])
        surplus = max(excess // _BYTES_PER_CHARACTER, 1)
        fields[longest] = fields[longest][: characters - surplus]
        body = json.dumps([event.code, fields], ensure_ascii=False).encode()
    return body


def read_event(row: np.ndarray) -> Event:
    """Return the event in one row of a ring of events."""
    code, fields = json.loads(row[1:].tobytes().rstrip(b"\0"))
    return events.make(int(row[0]) / 1e9, Code(code), **fields)
