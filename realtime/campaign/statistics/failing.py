"""How many components of each kind have failed: exact probabilities, and draws of them.

A kind of component is in `places` places of a train. Each of them has failed with the same
probability, independently of all others. A combination states how many of each kind have failed.

[F1] The number of one kind that has failed is binomial: P(k) = C(n, k) p**k (1 - p)**(n - k). A
     rule that a train with more than `most` of them does not run divides P(k) by the sum of P(0)
     to P(most).
[F2] The probability of a combination is the product of [F1] over the kinds.
[F3] Combinations form a tree with a kind on each level. A branch in which no combination reaches
     the least probability is cut off, and its probability is that of its beginning. All terms are
     positive, so no probability is the small difference of large numbers.
[F4] A component that is found only at an inspection, at intervals T, and fails with the constant
     rate r, has failed at a stop with the probability 1 - (1 - exp(-r T)) / (r T), about r T / 2.

Sources: the binomial law [F1]; [F4] is the mean unavailability of one channel, IEC 61508-6 annex B
(from memory).
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError

Counts = tuple[int, ...]  # how many of each kind have failed
# branches of the tree [F3] at most; more are refused
MOST_BRANCHES = 200_000


class Kind(NamedTuple):
    """A kind of component: its number of places, probability, and the most that may have failed."""

    places: int
    probability: float
    most: int

    @property
    def chances(self) -> np.ndarray:
        """The probabilities of 0 to `most` failed components, shape (most + 1,) [F1]."""
        n, p = self.places, self.probability
        found = np.empty(self.most + 1)
        for k in range(self.most + 1):
            # log1p keeps (1 - p)**n exact for a small p; p = 1 has one term
            none_of_the_others = math.exp((n - k) * math.log1p(-p)) if p < 1.0 else float(k == n)
            found[k] = math.comb(n, k) * p**k * none_of_the_others
        if self.most < n:
            found /= found.sum()
        return found


class Branch(NamedTuple):
    """Combinations that begin with the same counts; a single one if it has a count of each kind.

    probability: of all of its combinations together [F2].
    """

    counts: Counts
    probability: float


def probability_at_a_stop(rate_1_h: float, interval_h: float) -> float:
    """Return the probability that a component has failed, unnoticed since an inspection [F4]."""
    x = rate_1_h * interval_h
    if x < 1e-3:
        # the next term is smaller than 1e-14 of the first one
        return x / 2.0 - x**2 / 6.0 + x**3 / 24.0 - x**4 / 120.0
    return 1.0 + math.expm1(-x) / x


def branches(kinds: Sequence[Kind], least: float) -> tuple[list[Branch], list[Branch]]:
    """Return the combinations that are at least so probable, and the branches that are cut off.

    The first list begins with the most probable one. Together the two lists have the probability 1
    [F3]. Raises ConfigError if there are more than MOST_BRANCHES.
    """
    chances = [kind.chances for kind in kinds]
    # the largest probability that the kinds from each place on can contribute
    largest = np.append(np.cumprod([found.max() for found in reversed(chances)])[::-1], 1.0)
    kept: list[Branch] = []
    cut: list[Branch] = []

    def grow(branch: Branch) -> None:
        depth = len(branch.counts)
        if branch.probability == 0.0:
            return
        if branch.probability * largest[depth] < least:
            cut.append(branch)
        elif depth == len(kinds):
            kept.append(branch)
        else:
            for count, chance in enumerate(chances[depth].tolist()):
                grow(Branch((*branch.counts, count), branch.probability * chance))
        if len(kept) + len(cut) > MOST_BRANCHES:
            raise ConfigError(
                f"the failures have more than {MOST_BRANCHES} combinations with a probability of at "
                f"least {least:g}; raise rarest, or give a kind of component a rule most = 1 or 2"
            )

    grow(Branch((), 1.0))
    kept.sort(key=lambda branch: (-branch.probability, branch.counts))
    return kept, cut


def completed(branch: Branch, kinds: Sequence[Kind], generator: np.random.Generator) -> Counts:
    """Return one combination of a branch, drawn with its probability [F2]."""
    rest = kinds[len(branch.counts) :]
    return branch.counts + tuple(
        int(generator.choice(kind.most + 1, p=_whole(kind.chances))) for kind in rest
    )


def _whole(chances: np.ndarray) -> np.ndarray:
    """Return probabilities whose sum is 1 to the last digit, as numpy requires it."""
    return np.asarray(chances / chances.sum())


def places(
    counts: Counts, kinds: Sequence[Kind], generator: np.random.Generator
) -> tuple[tuple[int, ...], ...]:
    """Return the places (from 0) of the failed components of each kind, drawn evenly."""
    found = []
    for count, kind in zip(counts, kinds, strict=True):
        drawn = generator.choice(kind.places, size=count, replace=False)
        found.append(tuple(sorted(drawn.tolist())))
    return tuple(found)


def ways(counts: Counts, kinds: Sequence[Kind]) -> int:
    """Return in how many sets of places a combination can be; all of them are equally probable."""
    return math.prod(
        math.comb(kind.places, count) for count, kind in zip(counts, kinds, strict=True)
    )


def all_places(counts: Counts, kinds: Sequence[Kind]) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Yield all sets of places of a combination."""
    yield from itertools.product(
        *(
            itertools.combinations(range(kind.places), count)
            for count, kind in zip(counts, kinds, strict=True)
        )
    )


def from_shares(shares: np.ndarray, kind: Kind) -> np.ndarray:
    """Return which places have failed, bool (runs, places), from random numbers (runs, places).

    A place fails with the probability that the places before it leave, so that at most `most` have
    failed, each set with its probability [F1].
    """
    at_most = _at_most(kind)
    failed = np.zeros(shares.shape, dtype=bool)
    left = np.full(shares.shape[0], kind.most)
    for place in range(kind.places):
        others = kind.places - place - 1
        chance = kind.probability * at_most[others, left] / at_most[others + 1, left + 1]
        failed[:, place] = shares[:, place] < chance
        left -= failed[:, place]
    return failed


def _at_most(kind: Kind) -> np.ndarray:
    """Return P(at most m of n have failed) in the row n and the column m + 1; the column 0 is 0."""
    n, p = kind.places, kind.probability
    table = np.zeros((n + 1, kind.most + 2))
    table[0, 1:] = 1.0
    for size in range(1, n + 1):
        table[size, 1:] = (1.0 - p) * table[size - 1, 1:] + p * table[size - 1, :-1]
    return table
