"""Order statistics of a sample, from all of its values or from a sketch and its largest values.

[D1] A sketch counts values in bins whose ends are powers of gamma = (1 + a) / (1 - a), by sign. The
     middle of a bin differs from each value in it by at most the share a. Counts are whole numbers,
     so a merged sketch does not depend on the order in which its parts were merged.
[D2] A bound by rank that uses the far end of a bin is on the safe side. It is wider than the exact
     one by at most 2 * a of the value. Ranks among the largest values, which are kept, are exact.
[D3] Means and variances of two parts give those of the whole (Chan, Golub and LeVeque 1983). These
     are rounded numbers, so they depend on the order of merging.

Source: Masson, Rim and Lee 2019, DDSketch [D1].
"""

import math
from typing import NamedTuple

import numpy as np

ACCURACY = 1e-4  # a of [D1], relative
_LOG_GAMMA = math.log((1.0 + ACCURACY) / (1.0 - ACCURACY))
# a value that is closer to 0 counts as 0
LEAST = 1e-9
# the end of a bin is computed with rounding, so a bound is beyond it by this share
_ROUNDING = 1e-12


class Moments(NamedTuple):
    """Number, mean and sum of squared deviations of values [D3]."""

    number: int = 0
    mean: float = 0.0
    squares: float = 0.0

    @property
    def variance(self) -> float:
        """The variance of the law, as estimated from its draws; NaN for fewer than two."""
        return self.squares / (self.number - 1) if self.number > 1 else math.nan

    def merged(self, other: "Moments") -> "Moments":
        """Return the moments of both samples together."""
        number = self.number + other.number
        if not self.number or not other.number:
            return other if other.number else self
        apart = other.mean - self.mean
        return Moments(
            number,
            mean=self.mean + apart * other.number / number,
            squares=self.squares + other.squares + apart**2 * self.number * other.number / number,
        )


def moments(values: np.ndarray) -> Moments:
    """Return the moments of finite values (n,)."""
    if not values.size:
        return Moments()
    mean = float(values.mean())
    return Moments(values.size, mean, float(((values - mean) ** 2).sum()))


class Sketch(NamedTuple):
    """Counts of finite values in bins [D1].

    bins: (n,) int64, rising; the bin k > 0 has values from gamma**(k - 1) to gamma**k times LEAST,
    the bin -k the same with the other sign, and the bin 0 those closer to 0 than LEAST.
    counts: (n,) int64.
    """

    bins: np.ndarray
    counts: np.ndarray

    def merged(self, other: "Sketch") -> "Sketch":
        """Return the sketch of both samples together."""
        bins, places = np.unique(np.concatenate((self.bins, other.bins)), return_inverse=True)
        counts = np.zeros(bins.size, dtype=np.int64)
        np.add.at(counts, places, np.concatenate((self.counts, other.counts)))
        return Sketch(bins, counts)

    def negated(self) -> "Sketch":
        """Return the sketch of the values with the other sign."""
        return Sketch(-self.bins[::-1], self.counts[::-1])

    @property
    def size(self) -> int:
        """The number of values."""
        return int(self.counts.sum())


def sketch(values: np.ndarray) -> Sketch:
    """Return the sketch of finite values (n,)."""
    sizes = np.abs(values)
    counted = sizes >= LEAST
    bins = np.zeros(values.size, dtype=np.int64)
    places = np.floor(np.log(sizes[counted] / LEAST) / _LOG_GAMMA).astype(np.int64) + 1
    bins[counted] = np.where(values[counted] < 0.0, -places, places)
    found, counts = np.unique(bins, return_counts=True)
    return Sketch(found, counts.astype(np.int64))


def _ends(place: int) -> tuple[float, float]:
    """Return the lower and the upper end of a bin."""
    if place == 0:
        return -LEAST, LEAST
    inner = LEAST * math.exp((abs(place) - 1) * _LOG_GAMMA) * (1.0 - _ROUNDING)
    outer = LEAST * math.exp(abs(place) * _LOG_GAMMA) * (1.0 + _ROUNDING)
    return (inner, outer) if place > 0 else (-outer, -inner)


class Draws:
    """The order statistics of independent draws; rank 1 is the smallest draw.

    size: number of the draws. largest: the largest draws (k,), rising; all of them if all values
    are known. inf is larger than any other value.
    """

    def __init__(self, size: int, largest: np.ndarray, body: Sketch | None = None) -> None:
        self.size = size
        self.largest = largest
        self._body = body
        # number of finite draws up to each bin
        self._up_to = np.cumsum(body.counts) if body is not None else np.zeros(0, dtype=np.int64)

    def at(self, rank: int) -> float:
        """Return the draw of a rank, within ACCURACY if only its bin is known."""
        low, high = self._between(rank)
        if low == high:
            return low
        # the bin around 0
        if low < 0.0 < high:
            return 0.0
        # both ends of the bin differ from this value by the same share
        return 2.0 * low * high / (low + high)

    def above(self, rank: int) -> float:
        """Return a value that the draw of a rank does not exceed [D2]."""
        return self._between(rank)[1]

    def below(self, rank: int) -> float:
        """Return a value that the draw of a rank reaches [D2]."""
        return self._between(rank)[0]

    def _between(self, rank: int) -> tuple[float, float]:
        if not 1 <= rank <= self.size:
            raise ValueError(f"rank {rank}: allowed are 1 to {self.size}")
        from_largest = rank - self.size - 1
        if -from_largest <= self.largest.size or self._body is None:
            value = float(self.largest[from_largest])
            return value, value
        place = int(np.searchsorted(self._up_to, rank))
        # beyond all finite draws
        if place == self._up_to.size:
            return math.inf, math.inf
        return _ends(int(self._body.bins[place]))

    def divided(self, by: float) -> "Draws":
        """Return the draws divided by a number above 0."""
        if self._body is None:
            return Draws(self.size, self.largest / by)
        return _Divided(self.size, self.largest, self._body, by)


class _Divided(Draws):
    """Draws of a sketch that are divided by a number; the bins stay those of the sketch."""

    def __init__(self, size: int, largest: np.ndarray, body: Sketch, by: float) -> None:
        super().__init__(size, largest / by, body)
        self._by = by

    def _between(self, rank: int) -> tuple[float, float]:
        low, high = super()._between(rank)
        if low == high:
            return low, high
        return low / self._by, high / self._by


def of(values: "np.ndarray | Draws") -> Draws:
    """Return the order statistics of values (n,)."""
    if isinstance(values, Draws):
        return values
    return Draws(values.size, np.sort(values))
