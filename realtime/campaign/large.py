"""What a large campaign keeps of its runs, and how its chunks are merged.

Of all runs it keeps sketches and moments of every figure (`statistics.draws`). Whole rows are kept
of the first runs, which are a sample of a random design, of the runs of each tail, and of the first
ones that failed or are not valid. A tail is one of the longest stopping distances, or of the least
decelerations of a step of speed. What is kept does not grow with the number of runs.

[K1] Chunks are merged in the order of their numbers. The state after n chunks is therefore the same
     to the byte, whoever did them and however often the campaign was killed.
[K2] The state is a folder that is renamed when it is complete. A campaign that was killed continues
     from it; what was in work, or was merged later, is done again.
[K3] A worker returns only rows that may belong to a tail: those beyond the last row of a full tail.
     That row only moves outwards, so no row of the final tail is left out.
"""

import contextlib
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rollerrig.configs import unpacking, user_files
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.output_files import check_no_link, make_folder, write_text
from rollerrig.realtime.campaign import campaign, spreading, stopping
from rollerrig.realtime.campaign.statistics import draws
from rollerrig.realtime.record import figures

TAIL_ROWS = 20_000  # of each tail: a tenth of the fewest runs of a large campaign
FIRST_ROWS = 20_000
NOT_VALID_ROWS = 1_000
WARNINGS = 100  # different texts
DISTANCE = "braking_distance_m"
# column of the tails: what they are ordered by, large first
RANKED = "ranked"
# the state is written when this much time has passed, and this many times that of the last writing
WRITE_AFTER_S = 2.0
WRITE_AFTER_WRITINGS = 20.0

_STATE = "state.json"
_SKETCHES = "sketches.parquet"
_FIRST = "first.parquet"
_NOT_VALID = "not_valid.parquet"
_NEW = ".new"

Limits = dict[str, float]  # by tail: the least value of RANKED that may still belong to it


class Part(NamedTuple):
    """What one chunk, or several merged ones, leave.

    runs, failed, not_valid, not_stopped: numbers of runs. counted: those whose distance counts.
    sketches, moments: of finite values, by column.
    first, invalid, tails: rows; None if there are none.
    """

    runs: int
    counted: int
    failed: int
    not_valid: int
    not_stopped: int
    sketches: dict[str, draws.Sketch]
    moments: dict[str, draws.Moments]
    warnings: dict[str, int]
    first: pa.Table | None
    invalid: pa.Table | None
    tails: dict[str, pa.Table]


def tails_of(plan: campaign.Plan) -> tuple[str, ...]:
    """Return the columns that have a tail."""
    return (DISTANCE, *(plan.steps.columns if plan.steps is not None else ()))


def run_chunk(plan: campaign.Plan, chunk: int, limits: Limits) -> Part:
    """Run one chunk, in a worker; return what it leaves [K3]."""
    return part(plan, campaign.as_table(campaign.run_chunk(plan, chunk)), limits)


def part(plan: campaign.Plan, table: pa.Table, limits: Limits) -> Part:
    """Return what the rows of a chunk leave."""
    counts, distance_m = stopping.counted(table)
    invalid = pc.or_(pc.is_valid(table["invalid_because"]), pc.is_valid(table["error"]))
    values = {DISTANCE: (counts, distance_m)}
    for column in tails_of(plan)[1:]:
        decelerations = table[column].to_numpy().astype(float)
        known = counts & np.isfinite(decelerations)
        # the weakest brake is the largest value
        values[column] = (known, -decelerations[known])

    sketches: dict[str, draws.Sketch] = {}
    moments: dict[str, draws.Moments] = {}
    tails: dict[str, pa.Table] = {}
    for column in figures.BY_NAME:
        found = table[column].to_numpy().astype(float)
        found = found[np.isfinite(found)]
        sketches[column] = draws.sketch(found)
        moments[column] = draws.moments(found)
    for column, (known, ranked) in values.items():
        if column != DISTANCE:
            sketches[column] = draws.sketch(-ranked)
            moments[column] = draws.moments(-ranked)
        far = ranked >= limits.get(column, -np.inf)
        if far.any():
            rows = table.take(np.flatnonzero(known)[far])
            tails[column] = rows.append_column(RANKED, pa.array(ranked[far]))

    first = table if int(table["run"][0].as_py()) < FIRST_ROWS else None
    warnings = Counter(text for text in table["warnings"].to_pylist() if text)
    return Part(
        runs=table.num_rows,
        counted=distance_m.size,
        failed=table.num_rows - table["error"].null_count,
        not_valid=table.num_rows - table["invalid_because"].null_count,
        not_stopped=int(np.isinf(distance_m).sum()),
        sketches=sketches,
        moments=moments,
        warnings=dict(warnings),
        first=first,
        invalid=table.filter(invalid).slice(0, NOT_VALID_ROWS),
        tails=tails,
    )


class Kept:
    """The state of a large campaign after its first chunks [K1].

    chunks: number of merged chunks. whole: of their runs.
    """

    def __init__(self, tails: Iterable[str]) -> None:
        self.chunks = 0
        self.whole = Part(
            runs=0,
            counted=0,
            failed=0,
            not_valid=0,
            not_stopped=0,
            sketches={},
            moments={},
            warnings={},
            first=None,
            invalid=None,
            tails={},
        )
        self._new_tail_rows: dict[str, list[pa.Table]] = {column: [] for column in tails}
        self.limits: Limits = {}

    def add(self, found: Part) -> None:
        """Merge the part of the next chunk."""
        whole = self.whole
        sketches = dict(whole.sketches)
        moments = dict(whole.moments)
        for column, sketch in found.sketches.items():
            if column in sketches:
                sketch = sketches[column].merged(sketch)
            sketches[column] = sketch
            moments[column] = moments.get(column, draws.Moments()).merged(found.moments[column])
        warnings = dict(whole.warnings)
        for text, count in found.warnings.items():
            if text in warnings or len(warnings) < WARNINGS:
                warnings[text] = warnings.get(text, 0) + count
        self.whole = Part(
            runs=whole.runs + found.runs,
            counted=whole.counted + found.counted,
            failed=whole.failed + found.failed,
            not_valid=whole.not_valid + found.not_valid,
            not_stopped=whole.not_stopped + found.not_stopped,
            sketches=sketches,
            moments=moments,
            warnings=warnings,
            first=_together(whole.first, found.first, FIRST_ROWS),
            invalid=_together(whole.invalid, found.invalid, NOT_VALID_ROWS),
            tails=whole.tails,
        )
        for column, rows in found.tails.items():
            new = self._new_tail_rows[column]
            new.append(rows)
            if sum(table.num_rows for table in new) >= TAIL_ROWS:
                self._merge_tail(column)
        self.chunks += 1

    def merge_tails(self) -> None:
        """Merge the rows that have come since the last time into the tails."""
        for column in self._new_tail_rows:
            self._merge_tail(column)

    def _merge_tail(self, column: str) -> None:
        new = self._new_tail_rows[column]
        if not new:
            return
        tables = [self.whole.tails[column], *new] if column in self.whole.tails else new
        rows = pa.concat_tables(tables)
        # of equal values, the first run: the order is complete, so the tail is unique
        order = pc.sort_indices(rows, sort_keys=[(RANKED, "descending"), ("run", "ascending")])
        tail = rows.take(order[:TAIL_ROWS]).combine_chunks()
        self.whole.tails[column] = tail
        self._new_tail_rows[column] = []
        if tail.num_rows == TAIL_ROWS:
            self.limits[column] = tail[RANKED][-1].as_py()

    # --- statistics ---

    def draws(self, column: str) -> draws.Draws:
        """Return the order statistics of a tail: of distances, or of negative decelerations."""
        sketch = self.whole.sketches[column]
        if column != DISTANCE:
            sketch = sketch.negated()
        largest = np.zeros(0)
        if column in self.whole.tails:
            largest = self.whole.tails[column][RANKED].to_numpy()[::-1]
        not_stopped = self.whole.not_stopped if column == DISTANCE else 0
        return draws.Draws(sketch.size + not_stopped, largest, sketch)

    def quantiles(self, column: str, shares: tuple[float, ...]) -> list[float]:
        """Return quantiles of a figure over the runs that have it; empty if there are none."""
        sketch = self.whole.sketches[column]
        if not sketch.size:
            return []
        body = draws.Draws(sketch.size, np.zeros(0), sketch)
        return [body.at(max(int(np.ceil(share * sketch.size)), 1)) for share in shares]

    # --- files ---

    def write(self, out: Path) -> None:
        """Write the state, in one step [K2]. Raises RollerrigError if it cannot."""
        self.merge_tails()
        place = make_folder(out, "results")
        folder = place / f"kept-{self.chunks:09d}"
        new = place / _NEW
        check_no_link(new)
        try:
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir()
            self._write_files(new)
            new.rename(folder)
            for older in _folders(out):
                if older != folder:
                    shutil.rmtree(older)
        except OSError as error:
            raise RollerrigError(
                f"{new}: cannot be written: {error}; the state before it is kept: make room, and "
                "repeat the command to continue"
            ) from None

    def _write_files(self, folder: Path) -> None:
        whole = self.whole
        state = {
            "chunks": self.chunks,
            **{name: getattr(whole, name) for name in _NUMBERS},
            "moments": {column: list(found) for column, found in whole.moments.items()},
            "warnings": whole.warnings,
        }
        write_text(folder / _STATE, json.dumps(state, indent=1))
        columns = [
            pa.table(
                {
                    "column": pa.array([column] * found.bins.size, pa.string()),
                    "bin": found.bins,
                    "count": found.counts,
                }
            )
            for column, found in whole.sketches.items()
        ]
        pq.write_table(pa.concat_tables(columns).combine_chunks(), folder / _SKETCHES)
        for name, rows in ((_FIRST, whole.first), (_NOT_VALID, whole.invalid)):
            if rows is not None:
                pq.write_table(rows.combine_chunks(), folder / name)
        for column, rows in whole.tails.items():
            pq.write_table(rows, folder / _tail_file(column))


# fields of a part that are numbers of runs
_NUMBERS = ("runs", "counted", "failed", "not_valid", "not_stopped")


def _together(rows: pa.Table | None, new: pa.Table | None, most: int) -> pa.Table | None:
    """Return rows with new ones behind them, the first `most` of them."""
    if new is None:
        return rows
    if rows is None:
        return new.slice(0, most)
    if not new.num_rows or rows.num_rows >= most:
        return rows
    return pa.concat_tables((rows, new)).slice(0, most)


def _tail_file(column: str) -> str:
    return f"tail_{column}.parquet"


def _folders(out: Path) -> list[Path]:
    """Return the folders with states of a campaign, the newest last."""
    return sorted((out / "results").glob("kept-*"))


def is_in(out: Path) -> bool:
    """Return whether a folder holds a large campaign."""
    return bool(_folders(out))


def read(plan_tails: Iterable[str], out: Path) -> Kept:
    """Return the newest state in a folder, or an empty one. Raises ConfigError."""
    kept = Kept(plan_tails)
    folders = _folders(out)
    if not folders:
        return kept
    folder = folders[-1]
    try:
        _fill(kept, folder, out)
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{folder}: cannot be read: {error!r}; remove it, and repeat the command to begin again"
        ) from None
    return kept


def _fill(kept: Kept, folder: Path, out: Path) -> None:
    """Read the files of a state."""
    state = user_files.read_json(folder / _STATE, within=out)
    table = _read_rows(folder / _SKETCHES, out)
    if table is None:
        raise ValueError(f"{_SKETCHES} is missing")
    columns = table["column"].to_numpy(zero_copy_only=False)
    bins, counts = table["bin"].to_numpy(), table["count"].to_numpy()
    sketches = {}
    for column in state["moments"]:
        of_column = columns == column
        sketches[column] = draws.Sketch(bins[of_column], counts[of_column])
    tails = {}
    for column in kept._new_tail_rows:
        rows = _read_rows(folder / _tail_file(column), out)
        if rows is None:
            continue
        tails[column] = rows
        if rows.num_rows == TAIL_ROWS:
            kept.limits[column] = rows[RANKED][-1].as_py()
    kept.chunks = int(state["chunks"])
    kept.whole = Part(
        **{name: int(state[name]) for name in _NUMBERS},
        sketches=sketches,
        moments={column: draws.Moments(*found) for column, found in state["moments"].items()},
        warnings=state["warnings"],
        first=_read_rows(folder / _FIRST, out),
        invalid=_read_rows(folder / _NOT_VALID, out),
        tails=tails,
    )


def _read_rows(path: Path, out: Path) -> pa.Table | None:
    if not path.exists():
        return None
    user_files.check(path, user_files.PARQUET, within=out)
    unpacking.check_parquet(path, pq.read_metadata(path))
    return pq.read_table(path)


# --- merging ---


class Merger:
    """Merges chunks in their order [K1], and writes the state now and then [K2]."""

    def __init__(self, plan: campaign.Plan, out: Path) -> None:
        self._out = out
        self._early: dict[int, Part] = {}
        self.kept = read(tails_of(plan), out)
        self._written_chunks = self.kept.chunks
        self._written_s = time.monotonic()
        self._writing_s = 0.0

    def add(self, chunk: int, found: Part) -> None:
        """Take a chunk in any order."""
        self._early[chunk] = found
        while self.kept.chunks in self._early:
            self.kept.add(self._early.pop(self.kept.chunks))
        waited_s = time.monotonic() - self._written_s
        if waited_s >= max(WRITE_AFTER_S, WRITE_AFTER_WRITINGS * self._writing_s):
            self.write()

    def write(self) -> None:
        """Write the state, unless it is written."""
        if self._written_chunks == self.kept.chunks:
            return
        begun_s = time.monotonic()
        self.kept.write(self._out)
        self._written_chunks = self.kept.chunks
        self._written_s = time.monotonic()
        self._writing_s = self._written_s - begun_s

    @contextlib.contextmanager
    def writing(self) -> Iterator["Merger"]:
        """Write the state at the end of the block, also after an error or a signal."""
        try:
            yield self
        finally:
            self.write()


def work(plan: campaign.Plan, kept: Kept) -> spreading.Work:
    """Return what does a chunk of a campaign, for `spreading`."""

    def call(chunk: int) -> tuple[Any, ...]:
        return run_chunk, campaign.piece(plan, chunk), chunk, dict(kept.limits)

    return call
