"""A ring of rows in shared memory: one writer that never waits, any number of readers.

The writer (often the real-time thread) copies a row into its slot and then increments the count of
rows written. Each reader has a cursor, and learns how many rows it lost if it fell behind by more
than the capacity. The memory is a mapped file, so it outlives a writer that is killed.

Three rings belong to a run: `rows` (float64, one row of all signals a sample), `frames` (int64:
time in ns, identifier and flags, length, data as 8 little-endian bytes) and `events` (int64: time
in ns, then code and fields as JSON).

The writer holds a lock on the file as long as it runs. The operating system releases the lock when
the writer exits or is killed.

The folder is open to all users of the machine, so a reader trusts only what it has checked. The
file must belong to the reader's user, nobody else may have access, and its size must be that of its
header. Only the writer maps the file. Readers read it with system calls: a file that is cut off
later is then an error, whereas access to a map without its file would kill the reader.
"""

import fcntl
import json
import mmap
import os
import stat
import sys
import tempfile
import threading
import time
from io import FileIO
from pathlib import Path

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import Code, Event
from rollerrig.wsp_interface.signals import Table

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
CAR = 11  # of a ring of rows: the car of a train, counted from 1; 0: a vehicle alone
_HEADER = 16
_WORD_BYTES = 8
# only the owner may read and write
_PERMISSIONS = 0o600
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
    """The memory of a ring of samples within one process: `rows` (capacity, columns) float64.

    The columns are those of a `signals.Table`. `appending.push_part` fills it.
    """

    def __init__(self, capacity: int, table: Table) -> None:
        self.table = table
        self.header = np.zeros(_HEADER, dtype=np.int64)
        # only rows that were written are read, so the memory need not be cleared
        self.rows = np.empty((capacity, len(table.columns)))

    @property
    def recorded(self) -> np.ndarray:
        """All samples so far, (n, columns), if they are not more than the capacity."""
        return self.rows[: int(self.header[WRITTEN])]

    @property
    def written(self) -> np.ndarray:
        """The same samples as rows of all signals, (n, signals.WIDTH)."""
        return self.table.rows_of_all(self.recorded)


class FileHeader:
    """The header of a ring as a reader has access to it: one slot at a time, from the file.

    A slot that has been cut off the file reads as 0; `Ring.read` reports that.
    """

    def __init__(self, file: FileIO) -> None:
        self._file = file

    def __getitem__(self, slot: int) -> int:
        word = os.pread(self._file.fileno(), _WORD_BYTES, _WORD_BYTES * slot)
        return int.from_bytes(word, sys.byteorder, signed=True)

    def __setitem__(self, slot: int, value: int) -> None:
        word = int(value).to_bytes(_WORD_BYTES, sys.byteorder, signed=True)
        os.pwrite(self._file.fileno(), word, _WORD_BYTES * slot)


class Ring:
    """A ring on a file of rows with 8 bytes an item.

    With a capacity this process makes the file and is its writer. Then `header` and `rows` of shape
    (capacity, width) are its mapped memory. Without a capacity it is a reader, and has no `rows`. A
    reader that gives a width accepts only rows of this width.

    Raises RollerrigError where there is not enough memory, or where the file is not a ring of this
    user.
    """

    header: np.ndarray | FileHeader
    rows: np.ndarray

    def __init__(self, path: Path, dtype: type, capacity: int = 0, width: int = 0) -> None:
        self.path = Path(path)
        self._dtype = np.dtype(dtype)
        self._one_at_a_time = threading.Lock()
        self._is_writer = capacity > 0
        if self._is_writer:
            self._capacity = capacity
            self._width = width
            self._file = _make(self.path, self._size)
            self._map_memory()
        else:
            self._file = _open(self.path)
            self.header = FileHeader(self._file)
            self._capacity = int(self.header[CAPACITY])
            self._width = int(self.header[WIDTH])
            self._check_shape(width)

    @property
    def _size(self) -> int:
        """The size of the file in bytes."""
        return _WORD_BYTES * (_HEADER + self._capacity * self._width)

    def _map_memory(self) -> None:
        """Map the file of a writer, and lock it."""
        from rollerrig.realtime.loop import appending

        fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._map = mmap.mmap(self._file.fileno(), 0)
        words = np.frombuffer(self._map, dtype=np.int64)
        # touch every page now: the real-time thread must never have a page fault here
        words[:] = 0
        self.header = words[:_HEADER]
        self.header[CAPACITY] = self._capacity
        self.header[WIDTH] = self._width
        self.header[WRITER_PID] = os.getpid()
        self.header[CREATED_NS] = time.monotonic_ns()
        shape = (self._capacity, self._width)
        self.rows = words[_HEADER:].view(self._dtype).reshape(shape)
        self._append = appending.push
        # compile now: the first row of a run must not wait for the compiler
        self.push(np.zeros_like(self.rows[0]))
        self.header[WRITTEN] = 0

    def _check_shape(self, width: int) -> None:
        """Raise RollerrigError unless header and size of the file fit, and the width if given."""
        size = os.fstat(self._file.fileno()).st_size
        has_rows = self._capacity > 0 and self._width > 0
        if not has_rows or self._size != size:
            raise RollerrigError(
                f"{self.path}: not a ring ({self._capacity} rows of {self._width} items in "
                f"{size} bytes); remove the file if no bench uses it"
            )
        if width and self._width != width:
            raise RollerrigError(
                f"{self.path}: its rows have {self._width} items, allowed here: {width}; use one "
                "version of rollerrig for the bench and the programs that follow it"
            )

    def push(self, row: np.ndarray) -> None:
        """Append one row of `width` items; any thread of the writing process may call this."""
        with self._one_at_a_time:
            self._append(self.header, self.rows, row)

    def read(self, cursor: int) -> tuple[np.ndarray, int, int]:
        """Return a copy of the rows since `cursor`, the new cursor, and how many rows were lost.

        A slot that the writer may be filling is left out. Rows that were overwritten while they
        were copied count as lost. Raises RollerrigError where a reader's file has been cut off.
        """
        if not self.intact:
            raise self._cut_off()
        written = int(self.header[WRITTEN])
        first = max(cursor, written - self._capacity + 1)
        skipped = first - cursor
        rows = self._copy(first, max(written - first, 0))
        # look again: the writer may have gone on meanwhile
        first_valid = int(self.header[WRITTEN]) - self._capacity + 1
        overwritten = min(max(0, first_valid - first), len(rows))
        return rows[overwritten:], written, skipped + overwritten

    def _copy(self, first: int, count: int) -> np.ndarray:
        """Return a copy of `count` rows from row number `first` on."""
        if self._is_writer:
            return self.rows[np.arange(first, first + count) % self._capacity]
        rows = np.empty((count, self._width), dtype=self._dtype)
        slot = first % self._capacity
        before_the_end = min(count, self._capacity - slot)
        self._fill(rows[:before_the_end], slot)
        self._fill(rows[before_the_end:], 0)
        return rows

    def _fill(self, rows: np.ndarray, slot: int) -> None:
        """Fill rows with those of the file from a slot on. Raises RollerrigError."""
        if not len(rows):
            return
        at = _WORD_BYTES * (_HEADER + slot * self._width)
        if os.preadv(self._file.fileno(), [rows.data], at) < rows.nbytes:
            raise self._cut_off()

    def _cut_off(self) -> RollerrigError:
        size = os.fstat(self._file.fileno()).st_size
        return RollerrigError(
            f"{self.path}: another program has cut the ring off at {size} of {self._size} bytes; "
            "start the bench again"
        )

    @property
    def intact(self) -> bool:
        """Whether the file still has its size."""
        return os.fstat(self._file.fileno()).st_size == self._size

    @property
    def room(self) -> int:
        """How many rows the writer may append before the recorder loses one."""
        return self._capacity - 1 - int(self.header[WRITTEN] - self.header[READ])

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


def _make(path: Path, size: int) -> FileIO:
    """Make a new file of zeros, and return it open.

    An old file is unlinked first, so that its readers keep their memory. Raises RollerrigError.
    """
    try:
        path.unlink(missing_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        file = FileIO(os.open(path, flags, _PERMISSIONS), "r+b")
    except OSError as error:
        raise RollerrigError(
            f"{path}: no ring can be made there ({error.strerror}); allow this user to make files "
            f"in {path.parent}, or remove the file if it belongs to another user"
        ) from None
    try:
        _write_zeros(file, size)
    except OSError as error:
        file.close()
        path.unlink(missing_ok=True)
        raise RollerrigError(
            f"{path}: no room for a ring of {size / 1e6:.1f} MB "
            f"({error.strerror}); make room in {path.parent}"
        ) from None
    return file


def _write_zeros(file: FileIO, size: int) -> None:
    """Write zeros, so that the system reserves the memory. Raises OSError where it has none."""
    zeros = memoryview(bytes(size))
    while zeros:
        zeros = zeros[file.write(zeros) :]


def _open(path: Path) -> FileIO:
    """Return the file of a ring that this user has made. Raises OSError or RollerrigError."""
    # O_NONBLOCK: a named pipe must not let the reader wait
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    file = FileIO(os.open(path, flags), "r+b")
    # the open file is checked, not its path: what is there may change in between
    status = os.fstat(file.fileno())
    problem = ""
    if not stat.S_ISREG(status.st_mode):
        problem = "not a ring (no regular file)"
    elif status.st_uid != os.geteuid():
        problem = (
            f"this ring belongs to user {status.st_uid}, and this program runs as user "
            f"{os.geteuid()}; run the bench and what follows it as the same user"
        )
    elif stat.S_IMODE(status.st_mode) & ~_PERMISSIONS:
        problem = (
            f"other users have access to this ring (mode {stat.S_IMODE(status.st_mode):04o}), "
            f"allowed is {_PERMISSIONS:04o}; start the bench again"
        )
    elif status.st_size < _WORD_BYTES * _HEADER:
        problem = f"not a ring ({status.st_size} bytes)"
    if problem:
        file.close()
        raise RollerrigError(f"{path}: {problem}")
    return file


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
