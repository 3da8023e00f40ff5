"""channels.parquet while a run goes on: always whole, never more than a second old.

A Parquet file can be read only when its end has been written, so the file is written anew beside
the old one and renamed over it, at least once a second while that is cheap. Rows since then stand
in channels.tail (plain float64 rows, appended many times a second), which a reader adds. A long
run is written less often, so that writing takes at most a tenth of a core; the tail then holds
the difference. A finished run has no tail.
"""

import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record.files import replaced
from rollerrig.realtime.record.run_folder import CHANNELS, TAIL
from rollerrig.wsp_interface.signals import COLUMNS

_PERIOD_S = 0.8
_DUTY = 0.1
_BYTES_S = 50e6


class Channels:
    """The channels of one run: rows go in, files in `folder` follow."""

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)
        self._blocks: list[np.ndarray] = []  # each (columns, rows), sizes falling
        self._tail = open(self._folder / TAIL, "wb", buffering=0)  # noqa: SIM115 (open for the run)
        self._unwritten = False
        self.write()

    def add(self, rows: np.ndarray) -> None:
        """Append rows of all signals, shape (n, columns)."""
        if not len(rows):
            return
        self._tail.write(np.ascontiguousarray(rows).tobytes())
        self._blocks.append(np.ascontiguousarray(rows.T))
        # blocks of like size are joined, so that there are never many: each row moves log n times
        while len(self._blocks) > 1 and self._blocks[-2].shape[1] <= 2 * self._blocks[-1].shape[1]:
            last = self._blocks.pop()
            self._blocks[-1] = np.concatenate([self._blocks[-1], last], axis=1)
        self._unwritten = True

    def table(self) -> pa.Table:
        """All rows so far."""
        return pa.Table.from_batches([
            pa.RecordBatch.from_arrays([pa.array(column) for column in block], names=list(COLUMNS))
            for block in self._blocks
        ], schema=schema())

    def write_if_due(self) -> None:
        """Write channels.parquet anew if that is due."""
        if self._unwritten and time.monotonic() >= self._due_s:
            self.write()

    def write(self) -> None:
        """Write channels.parquet anew and empty the tail."""
        began = time.perf_counter()
        save(self._folder, self.table())
        self._tail.truncate(0)
        self._tail.seek(0)
        spent_s = time.perf_counter() - began
        size = sum(block.nbytes for block in self._blocks)
        self._due_s = time.monotonic() + max(_PERIOD_S, spent_s / _DUTY, size / _BYTES_S)
        self._unwritten = False

    def finish(self) -> pa.Table:
        """Write the final, compressed file, remove the tail, and return all rows."""
        table = self.table()
        save(self._folder, table, compression="zstd")
        self._tail.close()
        (self._folder / TAIL).unlink(missing_ok=True)
        return table


def schema() -> pa.Schema:
    """One float64 column for each column of the table of signals."""
    return pa.schema([(name, pa.float64()) for name in COLUMNS])


def save(folder: Path, table: pa.Table, compression: str = "none") -> None:
    """Put a table in place of channels.parquet in one step: a reader sees the old or the new."""
    final = compression != "none"
    with replaced(folder / CHANNELS) as new:
        pq.write_table(table, new, compression=compression, use_dictionary=False,
                       use_byte_stream_split=final, write_statistics=final)


def load(folder: Path) -> pa.Table:
    """The channels of a run folder, with what a killed run left in the tail.

    Raises ConfigError for a file that is missing or cannot be read.
    """
    path = folder / CHANNELS
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; a run's folder holds one: give the folder that "
                          "'rollerrig run ... --out DIR' has written")
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise ConfigError(f"{path}: damaged, not a readable Parquet file ({error}); "
                          "record the run again") from None
    if "time_s" not in table.column_names:
        raise ConfigError(f"{path}: has no column time_s; its columns are "
                          f"{', '.join(table.column_names[:6])} ...; is it a recording of a run?")
    tail = folder / TAIL
    if not tail.is_file():
        return table
    width = len(table.column_names)
    words = np.fromfile(tail, dtype=np.float64)
    rows = words[: len(words) // width * width].reshape(-1, width)
    if len(table):
        # killed between the new file and the emptied tail: these rows stand in both
        rows = rows[rows[:, table.column_names.index("time_s")] > table["time_s"][-1].as_py()]
    extra = pa.table([pa.array(column) for column in rows.T], schema=table.schema)
    return pa.concat_tables([table, extra])
