"""channels.parquet while a run goes on: always complete, never more than a second old.

A Parquet file can be read only when its end has been written. So the file is written anew next to
the old one and renamed over it, at least once a second while that is cheap. While the run goes on,
all rows are also in channels.tail (plain float64 rows, appended many times a second); a reader adds
the rows that are later than those of the file. In a long run the file is written less often, so
that writing takes at most a tenth of a core. A finished run has no tail.
"""

import contextlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rollerrig.configs import unpacking, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import create, replaced
from rollerrig.configs.processes.without import without
from rollerrig.realtime.record.run_folder import CHANNELS, TAIL

# time between two writes of channels.parquet, at least
_PERIOD_S = 0.8
# share of a core that writing may take
_DUTY = 0.1
# rate at which the disk may be written
_BYTES_S = 50e6
# writing goes on for this time before rows are taken in again
_STEP_S = 0.03
# A long run may be large in memory, but only if its file is large, too: measured channels cannot
# be compressed to less than a tenth.
_MOST_RATIO = 100
# of a float64 number
_ITEM_BYTES = 8
# until the file is complete, Parquet keeps 50 kB of memory for each block
_BLOCK_ROWS = 1 << 13


class Channels:
    """The channels of one run: rows go in, the files in `folder` follow; no row stays in memory.

    `columns` are the names of the columns of a row.
    """

    def __init__(self, folder: Path, columns: Sequence[str]) -> None:
        self._folder = Path(folder)
        self._columns = list(columns)
        self._block_bytes = _ITEM_BYTES * len(self._columns) * _BLOCK_ROWS
        self._tail = create(self._folder / TAIL, buffering=0)
        # the write that is under way; its size, its time so far, and when the next one is due
        self._saving: Iterator[None] | None = None
        self._written = 0
        self._spent_s = 0.0
        self._due_s = 0.0
        self.write()

    def add(self, rows: np.ndarray) -> None:
        """Append rows, shape (n, columns)."""
        if len(rows):
            self._tail.write(np.ascontiguousarray(rows).tobytes())

    def write_if_due(self) -> None:
        """Write channels.parquet anew if that is due.

        Each call writes a part, so that rows can come in.
        """
        began_s = time.monotonic()
        has_new_rows = self._tail.tell() > self._written
        if not self._saving and began_s >= self._due_s and has_new_rows:
            self._begin()
        while self._saving:
            self._go_on()
            if time.monotonic() > began_s + _STEP_S:
                break

    def write(self) -> None:
        """Write channels.parquet anew."""
        self._begin()
        while self._saving:
            self._go_on()

    def _begin(self) -> None:
        self._written = self._tail.tell()
        self._spent_s = 0.0
        self._saving = self._save()

    def _go_on(self) -> None:
        """Write one more block, and decide when the file is next to be written."""
        began_s = time.perf_counter()
        assert self._saving
        try:
            next(self._saving)
        except StopIteration:
            self._saving = None
        self._spent_s += time.perf_counter() - began_s
        pause_s = max(_PERIOD_S, self._spent_s / _DUTY, self._written / _BYTES_S)
        self._due_s = time.monotonic() + pause_s

    def finish(self, about: Mapping[str, str] | None = None) -> None:
        """Write the final, compressed file, and remove the tail.

        `about`: metadata of the file, what was played.
        """
        self._saving = None
        self._written = self._tail.tell()
        for _ in self._save(compression="zstd", about=about):
            pass
        self._tail.close()
        (self._folder / TAIL).unlink(missing_ok=True)

    def _save(
        self, compression: str = "none", about: Mapping[str, str] | None = None
    ) -> Iterator[None]:
        """Write all rows so far, block by block; replace channels.parquet with them in one step."""
        is_final = compression != "none"
        with (
            replaced(self._folder / CHANNELS) as new,
            pq.ParquetWriter(
                new,
                schema(self._columns).with_metadata(dict(about or {})),
                compression=compression,
                use_dictionary=False,
                use_byte_stream_split=is_final,
                write_statistics=is_final,
            ) as writer,
        ):
            for at in range(0, self._written, self._block_bytes):
                size = min(self._block_bytes, self._written - at)
                block = os.pread(self._tail.fileno(), size, at)
                writer.write_batch(_batch(block, self._columns))
                yield


def _batch(block: bytes, names: list[str]) -> pa.RecordBatch:
    """Return the complete rows in bytes of the tail, with the names of the columns."""
    row_bytes = _ITEM_BYTES * len(names)
    complete = len(block) // row_bytes * row_bytes
    rows = np.frombuffer(block[:complete]).reshape(-1, len(names))
    columns = [_array(column) for column in rows.T.copy()]
    return pa.RecordBatch.from_arrays(columns, names=names)


class Columns(Mapping[str, pa.ChunkedArray]):
    """The channels of a run folder by name; each is read when it is needed.

    A long run may be more than the memory holds. The rows that a killed run left in the tail follow
    those of the file. Raises ConfigError.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / CHANNELS
        if not self._path.is_file():
            raise ConfigError(
                f"{self._path}: no such file; give a run's folder, as 'rollerrig run ... --out DIR' "
                "writes it"
            )
        user_files.check(self._path, user_files.PARQUET, within=folder)
        with self._readable():
            self._file = pq.ParquetFile(self._path)
        self._check_size()
        self._names: list[str] = self._file.schema_arrow.names
        if "time_s" not in self._names:
            raise ConfigError(
                f"{self._path}: has no column time_s; its columns are "
                f"{', '.join(self._names[:6])} ...; is it a recording of a run?"
            )
        self._tail = np.empty((0, len(self._names)))
        self._tail = self._rows_of_tail(folder / TAIL)

    def _check_size(self) -> None:
        """Raise ConfigError if the columns are no numbers, or too large for the memory."""
        metadata = self._file.metadata
        others = unpacking.not_numbers(metadata)
        if others:
            raise ConfigError(
                f"{self._path}: column {others[0]} is not a column of numbers; is it a recording of "
                "a run?"
            )
        unpacking.check_parquet(self._path, metadata, _MOST_RATIO)

    def _rows_of_tail(self, path: Path) -> np.ndarray:
        """Return the rows of the tail that are later than those of the file, shape (n, columns)."""
        width = len(self._names)
        count = 0
        if path.is_file():
            user_files.check(path, user_files.TAIL, within=path.parent)
            count = path.stat().st_size // (_ITEM_BYTES * width)
        if not count:
            return np.empty((0, width))
        rows = np.memmap(path, np.float64, "r", shape=(count, width))
        time_s = self["time_s"]
        last_s = time_s[-1].as_py() if len(time_s) else -np.inf
        first = np.searchsorted(rows[:, self._names.index("time_s")], last_s, "right")
        return rows[first:]

    def __getitem__(self, name: str) -> pa.ChunkedArray:
        if name not in self._names:
            raise KeyError(name)
        with self._readable():
            # not by read_table, which loads pandas
            written: pa.ChunkedArray = self._file.read([name])[name]
        more = self._tail[:, self._names.index(name)]
        if not len(more):
            return written
        return pa.chunked_array([*written.chunks, _array(more)])

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def blocks(self, rows: int) -> Iterator[pa.RecordBatch]:
        """Yield the rows of the file in their order, some at a time."""
        return self._file.iter_batches(rows)

    @contextlib.contextmanager
    def _readable(self) -> Iterator[None]:
        """Raise ConfigError if the file cannot be read inside the block."""
        try:
            yield
        except (pa.ArrowException, ValueError, OSError) as error:
            raise ConfigError(
                f"{self._path}: damaged, not a readable Parquet file ({error}); record the run again"
            ) from None


def leave_pandas_out() -> None:
    """Keep Arrow from loading pandas just to check whether its arguments are of pandas."""
    with without("pandas"):
        pa.array([0])


def schema(columns: Sequence[str]) -> pa.Schema:
    """Return one float64 column for each name."""
    return pa.schema([(name, pa.float64()) for name in columns])


def load(folder: Path) -> pa.Table:
    """Return all channels of a run folder, with the rows of the tail. Raises ConfigError."""
    found = Columns(folder)
    return pa.Table.from_arrays(list(found.values()), names=list(found))


# the functions of pyarrow to and from numpy load pandas, which takes longer than everything else at
# the end of a run


def values(column: pa.Array | pa.ChunkedArray | np.ndarray | Sequence[float]) -> np.ndarray:
    """Return one channel, shape (n,), float64; nulls are NaN."""
    whole = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if not isinstance(whole, pa.Array) or not _is_plain(whole):
        return np.asarray(column, dtype=np.float64)
    everything = np.frombuffer(whole.buffers()[1])
    return everything[whole.offset : whole.offset + len(whole)].copy()


def _is_plain(whole: pa.Array) -> bool:
    """Whether the memory of an array is that of float64 numbers."""
    return len(whole) > 0 and not whole.null_count and whole.type == pa.float64()


def _array(found: np.ndarray) -> pa.Array:
    """Return an array of numpy, shape (n,), as one of Arrow."""
    data = pa.py_buffer(np.ascontiguousarray(found))
    return pa.Array.from_buffers(pa.float64(), len(found), [None, data])
