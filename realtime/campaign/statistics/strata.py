"""Quantiles of stops that are drawn in strata, with the probability of each stratum known exactly.

A stratum is a part of all stops: those with a combination of failures, and with a brake of a
strength between two limits. Rare strata get many more runs than their probability, and their stops
count less.

[Y1] The probability of a value above x is estimated by E(x) = sum of P_s h_s / n_s. P_s is the
     probability of the stratum s, n_s the number of its stops, h_s those above x. The estimate is
     unbiased, whatever the numbers n_s.
[Y2] The variance of E(x) is estimated, also unbiased, by the sum of
     P_s**2 h_s (n_s - h_s) / (n_s**2 (n_s - 1)). A stratum all of whose stops were computed has
     none.
[Y3] Bounds of the expected E(x) are quantiles of gamma laws with the variance V + w**2, V of [Y2]:
     the lower one of the law with the mean E, the upper one of that with the mean E + w. w is the
     largest P_s / n_s of the strata that may be the next to have a stop above x.
[Y4] Next is, of each combination of failures, the weakest stratum from which on no stop is above x.
     This assumes that the strength decides: from there on, stronger strata of the combination do
     not add more to E(x) than this one.

With one stratum [Y3] is about the bound of Clopper and Pearson.

Sources: Cochran 1977, chapter 5 [Y1, Y2]; Fay and Feuer 1997 [Y3] (both from memory). [Y4] is a
choice of this project.
"""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from rollerrig.configs.errors import ConfigError

CONFIDENCE = 0.95


class Stratum(NamedTuple):
    """A part of all stops.

    probability: P_s of [Y1].
    runs: planned number n_s.
    group: number of its combination of failures. order: its place in the group, 0 is the weakest.
    is_whole: whether its runs are all different stops that it has, each equally probable.
    text: the combination of failures in words.
    """

    probability: float
    runs: int
    group: int
    order: int
    is_whole: bool
    text: str


def from_json(content: Any, where: str) -> tuple[Stratum, ...]:
    """Return the strata that a file has as a list of tables. Raises ConfigError."""
    try:
        found = [Stratum(**given) for given in content]
        # a wrong type would fail far from here
        return tuple(
            Stratum(
                float(one.probability),
                int(one.runs),
                int(one.group),
                int(one.order),
                bool(one.is_whole),
                str(one.text),
            )
            for one in found
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{where}: strata cannot be read ({error}); repeat the campaign in a new folder"
        ) from None


class Bounded(NamedTuple):
    """A quantile of a sample in strata; large values are the bad ones.

    exceeded: the probability of a value above it. error: standard error of E at the estimate.
    low, high: ends of the two-sided interval. bound: one-sided upper bound.
    -inf and inf instead of a number that the runs do not reach.
    """

    exceeded: float
    estimate: float
    error: float
    low: float
    high: float
    bound: float


class Sample:
    """Values of stops (n,) with the number of the stratum of each (n,); inf is above any other.

    A stratum without any value is missing. Its probability counts as that of values above all
    others.
    """

    def __init__(self, values: np.ndarray, stratum: np.ndarray, strata: Sequence[Stratum]) -> None:
        order = np.argsort(-values, kind="stable")
        self.values = values[order]  # falling
        self.stratum = stratum[order]
        self.strata = tuple(strata)
        self._probability = np.array([found.probability for found in strata])
        self._number = np.bincount(stratum, minlength=len(strata))
        self.missing = float(self._probability[self._number == 0].sum())

    @property
    def size(self) -> int:
        """The number of values."""
        return int(self.values.size)

    def divided(self, by: float) -> "Sample":
        """Return the sample with its values divided by a number above 0."""
        return Sample(self.values / by, self.stratum, self.strata)

    @cached_property
    def weights(self) -> np.ndarray:
        """P_s / n_s of each value, falling as the values (n,)."""
        return np.asarray(self._probability[self.stratum] / self._number[self.stratum])

    @cached_property
    def _hits(self) -> np.ndarray:
        """For each value, how many values of its stratum come before it (n,)."""
        by_stratum = np.argsort(self.stratum, kind="stable")
        begins = np.concatenate(([0], np.cumsum(self._number)))
        hits = np.empty(self.size, dtype=np.int64)
        hits[by_stratum] = np.arange(self.size) - begins[self.stratum[by_stratum]]
        return hits

    @cached_property
    def _sums(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E, V and w of [Y1] to [Y3] after the first 0 to n values, (n + 1,) each."""
        exceeded = self.missing + np.concatenate(([0.0], np.cumsum(self.weights)))
        number = self._number[self.stratum]
        change = self._probability[self.stratum] ** 2 * (number - 2 * self._hits - 1.0)
        is_whole = np.array([found.is_whole for found in self.strata])[self.stratum]
        # one stop in a stratum has no variance; its whole weight is the error
        several = np.where(is_whole, np.inf, np.maximum(number - 1.0, 1.0))
        change = change / (number.astype(float) ** 2 * several)
        alone = (number == 1) & ~is_whole
        change[alone] = self._probability[self.stratum[alone]] ** 2
        variance = np.maximum(np.concatenate(([0.0], np.cumsum(change))), 0.0)
        return exceeded, variance, self._next_weights()

    def _next_weights(self) -> np.ndarray:
        """Return w of [Y3] after the first 0 to n values, (n + 1,), by [Y4]."""
        groups: dict[int, list[int]] = {}
        for place, found in enumerate(self.strata):
            if self._number[place] and not found.is_whole:
                groups.setdefault(found.group, []).append(place)
        weight = self._probability / np.maximum(self._number, 1)
        # of each group, the weights in the order of strength; the last one stays the next
        ladders = {}
        place_in_group = {}
        for group, members in groups.items():
            members.sort(key=lambda place: self.strata[place].order)
            ladders[group] = [*weight[members].tolist(), float(weight[members[-1]])]
            for place, member in enumerate(members):
                place_in_group[member] = (group, place)

        after = dict.fromkeys(ladders, 0)
        largest = max((ladder[0] for ladder in ladders.values()), default=0.0)
        largest_after = np.empty(self.size + 1)
        largest_after[0] = largest
        for n, member in enumerate(self.stratum.tolist(), start=1):
            if member in place_in_group:
                group, place = place_in_group[member]
                if place + 1 > after[group]:
                    before = ladders[group][after[group]]
                    after[group] = place + 1
                    now = ladders[group][place + 1]
                    if now >= largest:
                        largest = now
                    elif before == largest:
                        largest = max(ladders[one][at] for one, at in after.items())
            largest_after[n] = largest
        return largest_after

    # --- estimates ---

    def mean(self) -> tuple[float, float]:
        """Return the mean of the values that are there, and its variance; strata count by P_s."""
        total = 0.0
        variance = 0.0
        known = 0.0
        for place, found in enumerate(self.strata):
            of_stratum = self.values[self.stratum == place]
            if not of_stratum.size:
                continue
            known += found.probability
            total += found.probability * float(of_stratum.mean())
            if of_stratum.size > 1 and not found.is_whole:
                spread = float(of_stratum.var(ddof=1)) / of_stratum.size
                variance += found.probability**2 * spread
        return total / known, variance / known**2

    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the values, falling (n,), and the probability of a value above each (n,)."""
        return self.values, self._sums[0][:-1]

    def share_above(self, value: float) -> tuple[float, float]:
        """Return the estimated probability of a value above one, and its standard error."""
        exceeded, variance, _ = self._sums
        above = int(np.searchsorted(-self.values, -value, side="left"))
        return float(exceeded[above]), math.sqrt(float(variance[above]))

    def quantile(self, share: float) -> float:
        """Return the least value above which the estimated share is at most `share`; share < 1."""
        exceeded, _, _ = self._sums
        firsts = self._firsts
        fits = exceeded[firsts] <= share * (1.0 + 1e-12)
        if not fits.any():
            return math.inf
        return float(self.values[firsts[np.flatnonzero(fits)[-1]]])

    @cached_property
    def _firsts(self) -> np.ndarray:
        """The places of the first of equal values."""
        changes = self.values[1:] != self.values[:-1]
        return np.concatenate(([0], 1 + np.flatnonzero(changes)))

    def bounded(self, share: float, confidence: float = CONFIDENCE) -> Bounded:
        """Return the value that a share of all stops exceeds, with its bounds [Y3]."""
        estimate = self.quantile(share)
        return Bounded(
            exceeded=share,
            estimate=estimate,
            error=self.share_above(estimate)[1] if math.isfinite(estimate) else math.nan,
            low=self._lower(share, 0.5 + 0.5 * confidence),
            high=self._upper(share, 0.5 + 0.5 * confidence),
            bound=self._upper(share, confidence),
        )

    def _upper(self, share: float, confidence: float) -> float:
        """Return a value that a larger share exceeds with the probability 1 - confidence."""
        exceeded, variance, following = self._sums
        firsts = self._firsts
        above = _gamma_end(
            exceeded[firsts] + following[firsts],
            variance[firsts] + following[firsts] ** 2,
            confidence,
        )
        too_much = np.flatnonzero(above > share * (1.0 + 1e-12))
        last = int(too_much[0]) - 1 if too_much.size else firsts.size - 1
        return float(self.values[firsts[last]]) if last >= 0 else math.inf

    def _lower(self, share: float, confidence: float) -> float:
        """Return a value that a smaller share reaches with the probability 1 - confidence."""
        exceeded, variance, following = self._sums
        # after the last of equal values: those that reach it
        ends = np.append(self._firsts[1:], self.size)
        spread = variance[ends] + following[ends] ** 2
        below = _gamma_end(exceeded[ends], spread, 1.0 - confidence)
        enough = np.flatnonzero(below >= share)
        return float(self.values[self._firsts[enough[0]]]) if enough.size else -math.inf


def _gamma_end(mean: np.ndarray, variance: np.ndarray, probability: float) -> np.ndarray:
    """Return quantiles of gamma laws; those of a law without variance are its mean."""
    found = mean.copy()
    spread = (variance > 0.0) & (mean > 0.0)
    scale = variance[spread] / mean[spread]
    found[spread] = stats.gamma.ppf(probability, mean[spread] / scale, scale=scale)
    return found
