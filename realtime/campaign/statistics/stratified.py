"""Draws stops in strata: by combinations of failures, and by the strength of the brake.

[Z1] A combination of failures [F2] has a group of strata. The combinations that would have too few
     stops share groups: one for each power of ten of their probability.
[Z2] The strength of the brake is v = a . n, where n are the independent normal numbers of the
     inputs, and a is a unit vector: a = L' s / |L' s|, s the strengths [L4] of the inputs and L the
     root of their correlations, R = L L'. v is a standard normal number, so its strata have exact
     probabilities. A stratum ends where a weaker brake has a probability of 1, 10**-0.5, 10**-1 and
     so on. The last one of a group is that of `rarest`.
[Z3] In a stratum v is drawn between its ends, and n = m + a (v - a . m), m independent normal
     numbers. So n has the law of the inputs under the condition that v is in the stratum.
[Z4] Half of the stops are spread over the strata by their probabilities, the other half evenly,
     where a stratum of several combinations counts as OF_SEVERAL ones. Each has at least FEWEST.
[Z5] Without inputs the stops of a combination are its sets of places. If they are few, each of them
     is computed once, and the stratum has no error of sampling.

How good a is decides the precision, never whether an estimate is biased.

Source: stratified sampling with exact probabilities, Cochran 1977, chapter 5; along a line in the
space of normal numbers, Glasserman 2003, section 4.3.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign.statistics import failing, laws
from rollerrig.realtime.campaign.statistics.strata import Stratum

FEWEST = 2  # stops of a stratum
OF_SEVERAL = 10  # of [Z4]
# sets of places that are all computed [Z5]
MOST_WAYS = 64
# stops of an improbable stratum of a plan without inputs at most
_MOST_DRAWN = 200
_STRATA_FOR_RUNS = 0.25  # strata for each run at most
_EDGES_IN_DECADE = 2.0

Places = tuple[tuple[int, ...], ...]  # of each kind of component, those that have failed, from 0


class Stops(NamedTuple):
    """All stops of a plan, in the order of their strata.

    strata: one after another. shares: of the laws, (runs, laws). failed: by run.
    """

    strata: tuple[Stratum, ...]
    shares: np.ndarray
    failed: list[Places]


class _Group(NamedTuple):
    """Combinations of failures that are drawn together; probability of all of them."""

    branches: list[failing.Branch]
    probability: float
    text: str


def draw(
    all_laws: Sequence[laws.Law],
    matrix: np.ndarray,
    kinds: Sequence[failing.Kind],
    names: Sequence[str],
    runs: int,
    seed: int,
    rarest: float,
) -> Stops:
    """Return at most `runs` stops.

    Parameters
    ----------
    all_laws, matrix : laws of the inputs, and R of [L2]
    kinds, names : of the components that fail
    rarest : probability down to which combinations and strengths have strata of their own

    Raises ConfigError if there are too few runs for the strata.
    """
    direction = _direction(all_laws, matrix)
    kept, cut = failing.branches(kinds, rarest)
    most = int(_STRATA_FOR_RUNS * runs)
    separate = len(kept)
    while True:
        groups = _groups(kept, cut, separate, names)
        planned = []
        for number, group in enumerate(groups):
            planned += _strata_of(group, number, kinds, all_laws, direction, rarest)
        even = [_even(found, groups, kinds) for found in planned]
        if sum(even) <= most:
            break
        if separate == 0:
            least = math.ceil(sum(even) / _STRATA_FOR_RUNS)
            raise ConfigError(
                f"runs = {runs}: the failures and inputs have at least {len(planned)} strata, and each "
                f"needs some runs; set runs = {least} or more, or a larger rarest in [failures]"
            )
        separate = int(0.8 * separate)
    strata = _with_runs(planned, even, runs, bool(all_laws))
    return _drawn(strata, groups, kinds, direction, matrix, len(all_laws), seed)


def _direction(all_laws: Sequence[laws.Law], matrix: np.ndarray) -> np.ndarray | None:
    """Return a of [Z2]; None if no input has a strength."""
    if not all_laws:
        return None
    strength = np.array([law.strength for law in all_laws])
    along = np.linalg.cholesky(matrix).T @ strength
    length = float(np.linalg.norm(along))
    return along / length if length > 0.0 else None


def _groups(
    kept: list[failing.Branch],
    cut: list[failing.Branch],
    separate: int,
    names: Sequence[str],
) -> list[_Group]:
    """Return the groups of combinations [Z1]; the first `separate` ones are alone."""
    groups = [
        _Group([branch], branch.probability, _text(branch.counts, names))
        for branch in kept[:separate]
    ]
    by_decade: dict[int, list[failing.Branch]] = {}
    for branch in kept[separate:]:
        by_decade.setdefault(math.floor(math.log10(branch.probability)), []).append(branch)
    if cut:
        by_decade[-1000] = cut
    for branches in by_decade.values():
        probability = math.fsum(branch.probability for branch in branches)
        groups.append(_Group(branches, probability, "other combinations"))
    return groups


def _text(counts: failing.Counts, names: Sequence[str]) -> str:
    """Return a combination in words."""
    failed = [f"{count} x {name}" for name, count in zip(names, counts, strict=True) if count]
    return ", ".join(failed) or "no failure"


def _is_single(group: _Group, kinds: Sequence[failing.Kind]) -> bool:
    return len(group.branches) == 1 and len(group.branches[0].counts) == len(kinds)


def _strata_of(
    group: _Group,
    number: int,
    kinds: Sequence[failing.Kind],
    all_laws: Sequence[laws.Law],
    direction: np.ndarray | None,
    rarest: float,
) -> list[Stratum]:
    """Return the strata of a group, the weakest first, without runs."""
    one = Stratum(group.probability, 0, number, 0, False, group.text)
    if not all_laws:
        ways = failing.ways(group.branches[0].counts, kinds) if _is_single(group, kinds) else 0
        if 0 < ways <= MOST_WAYS:
            return [one._replace(runs=ways, is_whole=True)]
        return [one]
    # combinations that share a group differ by more than the strength of the brake
    if direction is None or not _is_single(group, kinds):
        return [one]
    ends = _ends(group.probability, rarest)
    return [
        one._replace(probability=group.probability * (high - low), order=order)
        for order, (low, high) in enumerate(itertools.pairwise(ends))
    ]


def _ends(probability: float, rarest: float) -> list[float]:
    """Return the rising shares between which the strata of a group are [Z2]."""
    steps = max(math.floor(_EDGES_IN_DECADE * math.log10(probability / rarest) + 1e-9), 0)
    return [0.0, *(10.0 ** (-step / _EDGES_IN_DECADE) for step in range(steps, -1, -1))]


def _even(found: Stratum, groups: list[_Group], kinds: Sequence[failing.Kind]) -> int:
    """Return as how many strata one counts in the even spread [Z4]."""
    if found.is_whole:
        return 0
    return 1 if _is_single(groups[found.group], kinds) else OF_SEVERAL


def _with_runs(
    planned: list[Stratum], even: list[int], runs: int, has_inputs: bool
) -> tuple[Stratum, ...]:
    """Return strata with their numbers of runs [Z4]."""
    drawn = [found for found in planned if not found.is_whole]
    left = runs - FEWEST * len(drawn) - sum(found.runs for found in planned if found.is_whole)
    if left < 0:
        raise ConfigError(
            f"runs = {runs}: the strata need {runs - left} runs; set runs = {runs - left}"
        )
    total = math.fsum(found.probability for found in drawn)
    numbers = []
    for found, share in zip(planned, even, strict=True):
        if found.is_whole:
            numbers.append(found.runs)
            continue
        part = 0.5 * found.probability / total + 0.5 * share / sum(even)
        number = FEWEST + int(left * part)
        if not has_inputs:
            number = min(number, max(_MOST_DRAWN, int(runs * math.sqrt(found.probability))))
        numbers.append(number)
    if has_inputs:
        # what rounding has left goes to the most probable stratum
        heaviest = max(range(len(planned)), key=lambda place: planned[place].probability)
        numbers[heaviest] += runs - sum(numbers)
    return tuple(
        found._replace(runs=number) for found, number in zip(planned, numbers, strict=True)
    )


def _drawn(
    strata: tuple[Stratum, ...],
    groups: list[_Group],
    kinds: Sequence[failing.Kind],
    direction: np.ndarray | None,
    matrix: np.ndarray,
    inputs: int,
    seed: int,
) -> Stops:
    """Return the stops of strata [Z3, Z5]."""
    normal = np.zeros((sum(found.runs for found in strata), inputs))
    failed: list[Places] = []
    for number, found in enumerate(strata):
        # the stops of a stratum do not depend on the runs of another one
        generator = np.random.default_rng((seed, number))
        group = groups[found.group]
        if found.is_whole:
            failed += failing.all_places(group.branches[0].counts, kinds)
            continue
        begin = len(failed)
        chances = np.array([branch.probability for branch in group.branches])
        chances /= chances.sum()
        for place in generator.choice(len(chances), size=found.runs, p=chances):
            counts = failing.completed(group.branches[int(place)], kinds, generator)
            failed.append(failing.places(counts, kinds, generator))
        numbers = generator.standard_normal((found.runs, inputs))
        if direction is not None:
            low, high = _share_ends(strata, found, group)
            strength = stats.norm.ppf(low + (high - low) * generator.random(found.runs))
            numbers += np.outer(strength - numbers @ direction, direction)
        normal[begin : begin + found.runs] = numbers
    shares = laws.correlated(stats.norm.cdf(normal), matrix) if inputs else normal
    return Stops(strata, shares, failed)


def _share_ends(strata: Sequence[Stratum], found: Stratum, group: _Group) -> tuple[float, float]:
    """Return the shares between which a stratum of a group is."""
    weaker = [
        other.probability
        for other in strata
        if other.group == found.group and other.order < found.order
    ]
    low = math.fsum(weaker) / group.probability
    return low, min(low + found.probability / group.probability, 1.0)
