"""The points of a large random design, drawn when they are needed.

[W1] A random number costs one step of the generator, so the numbers of any run are reached by a
     jump. Runs are drawn in blocks of BLOCK, always from the beginning of a block: the points of a
     run do not depend on which others are drawn with it, also not by rounding.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any, overload

import numpy as np

from rollerrig.realtime.campaign.components import failures as failures_of
from rollerrig.realtime.campaign.statistics import failing, laws

BLOCK = 4096  # runs
# blocks in memory: chunks are drawn in their order, and some again
_BLOCKS_KEPT = 4

Row = tuple[Any, ...]


class DrawnRows(Sequence[Row]):
    """The values of all runs, in the order of the laws; the memory does not grow with the runs.

    Behind them come the texts of the failed components of each kind.
    identity: what decides the values, for the fingerprint of a plan.
    """

    def __init__(
        self,
        runs: int,
        seed: int,
        all_laws: Sequence[laws.Law],
        matrix: np.ndarray,
        identity: Any,
        failures: Sequence[failures_of.Failure] = (),
    ) -> None:
        self.identity = identity
        self._runs = runs
        self._seed = seed
        self._laws = tuple(all_laws)
        self._matrix = matrix
        self._failures = tuple(failures)
        self._block: Callable[[int], tuple[Row, ...]] = lru_cache(_BLOCKS_KEPT)(self._drawn_block)

    def __len__(self) -> int:
        return self._runs

    @overload
    def __getitem__(self, place: int) -> Row: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Row, ...]: ...

    def __getitem__(self, place: int | slice) -> Row | tuple[Row, ...]:
        if isinstance(place, slice):
            return tuple(self._row(number) for number in range(*place.indices(self._runs)))
        number = place + self._runs if place < 0 else place
        if not 0 <= number < self._runs:
            raise IndexError(f"run {place}: allowed are 0 to {self._runs - 1}")
        return self._row(number)

    def _row(self, number: int) -> Row:
        return self._block(number // BLOCK)[number % BLOCK]

    def _drawn_block(self, block: int) -> tuple[Row, ...]:
        """Return the values of the runs of a block."""
        shares, of_failures = self._shares(block)
        columns = [law.at(shares[:, place]).tolist() for place, law in enumerate(self._laws)]
        columns += failure_columns(of_failures, self._failures)
        return tuple(zip(*columns, strict=True))

    def _shares(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the shares of the laws (runs of the block, laws), and of the components [W1]."""
        dimensions = len(self._laws) + components(self._failures)
        generator = np.random.default_rng(self._seed)
        generator.bit_generator.advance(block * BLOCK * dimensions)  # type: ignore[attr-defined]
        count = min(BLOCK, self._runs - block * BLOCK)
        drawn = generator.random((count, dimensions))
        inputs = len(self._laws)
        return laws.correlated(drawn[:, :inputs], self._matrix), drawn[:, inputs:]

    @cached_property
    def extremes(self) -> list[tuple[int, int]]:
        """For each law, the runs with its least and its greatest value.

        A law rises with its share, so the shares of all runs are drawn, and no values.
        """
        dimensions = len(self._laws)
        least = np.full(dimensions, np.inf)
        greatest = np.full(dimensions, -np.inf)
        least_run = np.zeros(dimensions, dtype=np.int64)
        greatest_run = np.zeros(dimensions, dtype=np.int64)
        for begin in range(0, self._runs, BLOCK):
            shares, _ = self._shares(begin // BLOCK)
            for place in range(dimensions):
                column = shares[:, place]
                low, high = int(column.argmin()), int(column.argmax())
                if column[low] < least[place]:
                    least[place] = column[low]
                    least_run[place] = begin + low
                if column[high] > greatest[place]:
                    greatest[place] = column[high]
                    greatest_run[place] = begin + high
        return list(zip(least_run.tolist(), greatest_run.tolist(), strict=True))


def components(failures: Sequence[failures_of.Failure]) -> int:
    """Return the number of all components that can fail: each needs a random number in each run."""
    return sum(failure.kind.places for failure in failures)


def failure_columns(shares: np.ndarray, failures: Sequence[failures_of.Failure]) -> list[list[str]]:
    """Return a column of texts for each kind of component.

    shares: even random numbers (runs, components).
    """
    columns = []
    begin = 0
    for failure in failures:
        end = begin + failure.kind.places
        failed = failing.from_shares(shares[:, begin:end], failure.kind)
        rows = [tuple(np.flatnonzero(row).tolist()) for row in failed]
        columns.append([failures_of.shown(row, failure) for row in rows])
        begin = end
    return columns
