"""A ring of rows in shared memory: one writer that never waits, any number of readers.

The writer (often the real-time thread) copies a row into its slot and then raises the count of
rows written. A reader keeps its own cursor, and learns how many rows it lost if it fell behind
by more than the capacity. The memory is a mapped file, so it outlives a writer that is killed.

Three rings belong to a run: `rows` (float64, one row of all signals a sample), `frames` (int64:
time in ns, identifier and flags, length, data as 8 little-endian bytes) and `events` (int64: time
in ns, then code and fields as JSON).
The writer holds a lock on the file while it lives; the kernel lets go of it however it dies.
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

# slots of the header (int64): written by the writer, or by the one reader that is named there.
# READER_BEAT_NS is the live view's heartbeat, RECORDER_BEAT_NS the recorder's (0: not ready yet), VIEWED whether
# anybody looks at the live view, READ and LOST are the recorder's count of rows, all on CLOCK_MONOTONIC
(
    WRITTEN,
    CLOSED,
    WRITER_PID,
    CAPACITY,
    WIDTH,
    READER_BEAT_NS,
    READ,
    LOST,
    CREATED_NS,
    RECORDER_BEAT_NS,
    VIEWED,
) = range(11)
_HEADER = 16
EVENT_WORDS = 64
FRAME_WORDS = 4
# places in a row of a ring of frames
FRAME_TIME_NS, FRAME_ID, FRAME_LENGTH, FRAME_DATA = range(FRAME_WORDS)
# most that one character takes in JSON: as UTF-8, or escaped as in \\u0001
_BYTES_PER_CHARACTER = 6
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 1 << 31, 1 << 30, 1 << 29
_PREFIX = "rollerrig-"


def folder() -> Path:
    """The folder in which rings live: in memory where the system has one, else a temporary one."""
    return Path("/dev/shm") if os.path.isdir("/dev/shm") else Path(tempfile.gettempdir())


def place(kind: str) -> Path:
    """A path for this process's ring of a kind (rows, frames, events)."""
    return folder() / f"{_PREFIX}{os.getpid()}-{time.monotonic_ns()}-{kind}"


def sweep() -> list[Path]:
    """Remove rings that no writer locks and no recorder reads: both were killed. Returns what was removed."""
    removed = []
    for path in sorted(folder().glob(_PREFIX + "*")):
        try:
            ring = Ring(path, np.int64)
        except (OSError, ValueError, RollerrigError):
            continue
        idle_ns = time.monotonic_ns() - max(
            int(ring.header[RECORDER_BEAT_NS]), int(ring.header[CREATED_NS])
        )
        if not ring.writer_alive and idle_ns > 60_000_000_000:
            ring.unlink()
            removed.append(path)
    return removed


class Memory:
    """What `appending.push` fills, for one process alone: `rows` of shape (capacity, width) float64."""

    def __init__(self, capacity: int, width: int) -> None:
        self.header = np.zeros(_HEADER, dtype=np.int64)
        self.rows = np.zeros((capacity, width))

    @property
    def written(self) -> np.ndarray:
        """All rows so far, where they have not been more than the capacity."""
        return self.rows[: int(self.header[WRITTEN])]


class Ring:
    """A ring on a mapped file. `rows` has shape (capacity, width) and 8 bytes an item.

    With a capacity the file is made and this process is its writer; without, it is read. Raises
    RollerrigError where the memory does not suffice or the file is not a ring.
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
            # every page is touched now: the real-time thread shall never fault on one
            words[:] = 0
            self.header[CAPACITY], self.header[WIDTH] = capacity, width
            self.header[WRITER_PID] = os.getpid()
            self.header[CREATED_NS] = time.monotonic_ns()
        shape = int(self.header[CAPACITY]), int(self.header[WIDTH])
        if 8 * (_HEADER + shape[0] * shape[1]) != size:
            raise RollerrigError(f"{self.path}: not a ring ({shape} rows in {size} bytes)")
        self.rows: np.ndarray = words[_HEADER:].view(dtype).reshape(shape)
        if capacity:
            from rollerrig.realtime.loop import appending

            self._append = appending.push
            # compiled now: the first row of a run shall not wait for the compiler
            self.push(np.zeros_like(self.rows[0]))
            self.header[WRITTEN] = 0

    def push(self, row: np.ndarray) -> None:
        """Append one row of `width` items; any thread of the writing process may."""
        with self._one_at_a_time:
            self._append(self.header, self.rows, row)

    def read(self, cursor: int) -> tuple[np.ndarray, int, int]:
        """Rows since `cursor` as a copy, the new cursor, and how many rows were lost.

        A slot that the writer may be filling is left out, and rows that were overwritten while
        they were copied are counted as lost.
        """
        capacity = self.rows.shape[0]
        written = int(self.header[WRITTEN])
        first = max(cursor, written - capacity + 1)
        rows = self.rows[np.arange(first, written) % capacity]
        overwritten = min(max(0, int(self.header[WRITTEN]) - capacity + 1 - first), len(rows))
        return rows[overwritten:], written, first - cursor + overwritten

    @property
    def room(self) -> int:
        """Rows that the writer may append before the recorder loses one."""
        return int(self.header[CAPACITY] - 1 - (self.header[WRITTEN] - self.header[READ]))

    def close(self) -> None:
        """Tell readers that no more rows will come."""
        self.header[CLOSED] = 1

    @property
    def closed(self) -> bool:
        return bool(self.header[CLOSED])

    @property
    def writer_alive(self) -> bool:
        """Whether the process that made the ring lives: its lock tells, for a number may be another's or a zombie's."""
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
    """A new file of zeros. What stood there is unlinked first: its readers keep their memory."""
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
    while (excess := len(body) - 8 * (EVENT_WORDS - 1)) > 0:
        texts = [name for name, value in fields.items() if isinstance(value, str)]
        longest = max(texts, key=lambda name: len(fields[name]))
        # a character may take several bytes, so the text may be cut more than once
        characters = len(fields[longest])
        fields[longest] = fields[longest][: characters - max(excess // _BYTES_PER_CHARACTER, 1)]
        body = json.dumps([event.code, fields], ensure_ascii=False).encode()
    return body


def read_event(row: np.ndarray) -> Event:
    """Return the event in one row of a ring of events."""
    code, fields = json.loads(row[1:].tobytes().rstrip(b"\0"))
    return events.make(int(row[0]) / 1e9, Code(code), **fields)
