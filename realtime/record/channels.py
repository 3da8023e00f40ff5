"""channels.parquet while a run goes on: always whole, never more than a second old.

A Parquet file can be read only when its end has been written, so the file is written anew beside the old one and
renamed over it, at least once a second while that is cheap. All rows stand in channels.tail (plain float64 rows,
appended many times a second) as long as the run goes on; a reader adds those that are later than the file's. A long run
is written less often, so that writing takes at most a tenth of a core. A finished run has no tail.
"""

import contextlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes.without import without
from rollerrig.realtime.record.files import replaced
from rollerrig.realtime.record.run_folder import CHANNELS, TAIL
from rollerrig.wsp_interface.signals import COLUMNS

_PERIOD_S, _DUTY, _BYTES_S, _STEP_S = 0.8, 0.1, 50e6, 0.03
# each block leaves 50 kB of what Parquet remembers of it until the file is whole
_BLOCK_BYTES = 8 * len(COLUMNS) * (1 << 13)


class Channels:
    """The channels of one run: rows go in, files in `folder` follow; none stays in memory."""

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)
        self._tail = open(self._folder / TAIL, "wb+", buffering=0)  # noqa: SIM115 (open for the run)
        self._saving: Iterator[None] | None = None
        self.write()

    def add(self, rows: np.ndarray) -> None:
        """Append rows of all signals, shape (n, columns)."""
        if len(rows):
            self._tail.write(np.ascontiguousarray(rows).tobytes())

    def write_if_due(self) -> None:
        """Write channels.parquet anew if that is due, a part at each call: rows are taken in meanwhile."""
        began_s = time.monotonic()
        if not self._saving and began_s >= self._due_s and self._tail.tell() > self._written:
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
        self._written, self._spent_s = self._tail.tell(), 0.0
        self._saving = self._save()

    def _go_on(self) -> None:
        began_s, over = time.perf_counter(), object()
        assert self._saving
        if next(self._saving, over) is over:
            self._saving = None
        self._spent_s += time.perf_counter() - began_s
        self._due_s = time.monotonic() + max(
            _PERIOD_S, self._spent_s / _DUTY, self._written / _BYTES_S
        )

    def finish(self) -> None:
        """Write the final, compressed file, and remove the tail."""
        self._saving, self._written = None, self._tail.tell()
        for _ in self._save(compression="zstd"):
            pass
        self._tail.close()
        (self._folder / TAIL).unlink(missing_ok=True)

    def _save(self, compression: str = "none") -> Iterator[None]:
        """Put the rows so far in place of channels.parquet in one step, block by block before: one sees old or new."""
        final, names = compression != "none", list(COLUMNS)
        with (
            replaced(self._folder / CHANNELS) as new,
            pq.ParquetWriter(
                new,
                schema(),
                compression=compression,
                use_dictionary=False,
                use_byte_stream_split=final,
                write_statistics=final,
            ) as writer,
        ):
            for at in range(0, self._written, _BLOCK_BYTES):
                block = os.pread(self._tail.fileno(), min(_BLOCK_BYTES, self._written - at), at)
                rows = np.frombuffer(
                    block[: len(block) // (8 * len(names)) * 8 * len(names)]
                ).reshape(-1, len(names))
                writer.write_batch(
                    pa.RecordBatch.from_arrays(list(map(_array, rows.T.copy())), names=names)
                )
                yield


class Columns(Mapping[str, pa.ChunkedArray]):
    """The channels of a run folder by name, each read when it is asked for: a long run may be more than memory holds.

    What a killed run left in the tail follows what stands in the file. Raises ConfigError.
    """

    def __init__(self, folder: Path) -> None:
        self._path = path = folder / CHANNELS
        if not path.is_file():
            raise ConfigError(
                f"{path}: no such file; a run's folder holds one: give the folder that 'rollerrig run "
                "... --out DIR' has written"
            )
        with self._readable():
            self._file = pq.ParquetFile(path)
        self._names: list[str] = self._file.schema_arrow.names
        if "time_s" not in self._names:
            raise ConfigError(
                f"{path}: has no column time_s; its columns are "
                f"{', '.join(self._names[:6])} ...; is it a recording of a run?"
            )
        self._tail, tail, width = np.empty((0, len(self._names))), folder / TAIL, len(self._names)
        if tail.is_file() and (count := tail.stat().st_size // (8 * width)):
            rows, time_s = np.memmap(tail, np.float64, "r", shape=(count, width)), self["time_s"]
            begins_s = time_s[-1].as_py() if len(time_s) else -np.inf
            self._tail = rows[
                np.searchsorted(rows[:, self._names.index("time_s")], begins_s, "right") :
            ]

    def __getitem__(self, name: str) -> pa.ChunkedArray:
        if name not in self._names:
            raise KeyError(name)
        with self._readable():
            written: pa.ChunkedArray = self._file.read([name])[name]  # read_table would load pandas
        more = self._tail[:, self._names.index(name)]
        return pa.chunked_array([*written.chunks, _array(more)]) if len(more) else written

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def blocks(self, rows: int) -> Iterator[pa.RecordBatch]:
        """The rows of the file in their order, some at a time."""
        return self._file.iter_batches(rows)

    @contextlib.contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except (pa.ArrowException, OSError) as error:
            raise ConfigError(
                f"{self._path}: damaged, not a readable Parquet file ({error}); record the run again"
            ) from None


def leave_pandas_out() -> None:
    """Let Arrow not load pandas, only to see whether what it is given is of pandas."""
    with without("pandas"):
        pa.array([0])


def schema() -> pa.Schema:
    """One float64 column for each column of the table of signals."""
    return pa.schema([(name, pa.float64()) for name in COLUMNS])


def load(folder: Path) -> pa.Table:
    """All channels of a run folder, with what a killed run left in the tail. Raises ConfigError."""
    found = Columns(folder)
    return pa.Table.from_arrays(list(found.values()), names=list(found))


# pyarrow's own ways to and from numpy load pandas, which takes longer than all else that ends a run


def values(column: pa.Array | pa.ChunkedArray | np.ndarray | Sequence[float]) -> np.ndarray:
    """One channel, shape (n,), float64; nulls are NaN."""
    whole = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if (
        not isinstance(whole, pa.Array)
        or not len(whole)
        or whole.null_count
        or whole.type != pa.float64()
    ):
        return np.asarray(column, dtype=np.float64)
    return np.frombuffer(whole.buffers()[1])[whole.offset : whole.offset + len(whole)].copy()


def _array(found: np.ndarray) -> pa.Array:
    return pa.Array.from_buffers(
        pa.float64(), len(found), [None, pa.py_buffer(np.ascontiguousarray(found))]
    )
