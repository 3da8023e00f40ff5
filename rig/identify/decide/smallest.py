"""Measures the smallest size of each cause that a dataset shows, by planting the cause into it.

The cause is added to every null simulation, which has the torques, speeds, loads and noise of the
measured runs, and the rules of the decision are applied. The smallest size is found in one half of
them. A planted size changes the estimate by itself, and the gradient by the information:

    [J1] x' = x + size,  g' = g - S size      (x, g, S as in `evidence`)

The replay stays linearised, so a planted size costs no replay. Rules for a cause alone are applied:
significance, likelihood less its price, materiality, and brakes that vary in common. The choice
between causes and the remainder are not.

    [J2] such brakes win size^2 S_cm S_mm^-1 S_mc of size^2 S_cc, c the column of the cause, m those
         of the variation, S_mm with its priors
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from rollerrig.rig.identify.causes import discrepancy, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.causes.columns import SensitivityMatrix
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import (
    choice,
    coherence,
    evidence,
    fitting,
    stopping,
    thresholds,
)
from rollerrig.rig.identify.decide.evidence import Scores, ScoreTest
from rollerrig.rig.mechanisms.mechanism import TORQUE

# the smallest size is known to this share
_ACCURACY = 0.02
# planted windows: bins of a patch (50 m), and of sand in each run (4 s)
_BINS_OF_PATCH = 2
_BINS_OF_SAND = 2
POWER = 0.5


class Planting(NamedTuple):
    """What planting needs of a search."""

    design: Design
    base: Explanation  # the base model on which the tests were made
    normal: fitting.NormalEquations
    nulls: list[Scores]


def with_smallest(planting: Planting, tests: Sequence[ScoreTest]) -> list[ScoreTest]:
    """Return the tests with the smallest size of each cause; smooth functions are unchanged.

    The size is infinite if no size within the bounds of a cause is found.
    """
    rivals = _rivals(planting)
    found = []
    for test in tests:
        if not evidence.is_smooth_function(test.name):
            power = _power(planting, rivals, test)
            high = table.BY_NAME[test.name].mechanism.parameters[0].high
            test = test._replace(smallest=_where_half(power, high))
        found.append(test)
    return found


def _where_half(power: Callable[[float], float], high: float) -> float:
    """Return the size up to `high` at which a power reaches one half; infinite: at none."""
    if power(high) < POWER:
        return math.inf
    low = high
    while power(low) >= POWER and low > 1e-9 * high:
        high = low
        low *= 0.5
    while high > low * (1.0 + _ACCURACY):
        middle = math.sqrt(low * high)
        if power(middle) >= POWER:
            high = middle
        else:
            low = middle
    return math.sqrt(low * high)


def _power(planting: Planting, rivals: list["_Rival"], test: ScoreTest) -> Callable[[float], float]:
    """Return the share of null simulations in which a cause of a size is found."""
    if test.name == "contaminated_patch":
        return _power_of_patch(planting, test)
    if test.name == "sanding":
        return _power_of_sand(planting, test)
    return _power_of_coefficients(planting, rivals, test)


# --- causes with columns ---


def _power_of_coefficients(
    planting: Planting, rivals: list["_Rival"], test: ScoreTest
) -> Callable[[float], float]:
    """Return the power of a cause that has columns in the matrix."""
    variant = planting.normal.matrix.variant_of(test.cause())
    assert variant is not None
    x, S = evidence.estimated(evidence.stacked(planting.nulls), list(variant.columns))
    bias = x.mean(axis=0)
    planted = _unit(test.name, x.shape[1])
    share_of_unit = _torque_share(planting, test)
    of_rivals = [rival.of_size(test.cause()) for rival in rivals if coherence.is_force(test.name)]

    def power(size: float) -> float:
        off = x - bias + size * planted
        statistic = np.einsum("ki,kij,kj->k", off, S, off)
        ratio = np.einsum("ki,kij,kj->k", off + bias, S, off + bias)
        is_found = _is_significant(test, statistic / test.spread**2)
        is_found &= ratio - choice.by_chance(test) - choice.price(test) > thresholds.LEAST_RATIO
        most = thresholds.IMMATERIAL_DEVIATIONS * planting.design.calibration
        if share_of_unit > 0.0:
            is_found &= share_of_unit * np.abs(off[:, 0]) > most
        for of_size in of_rivals:
            is_found &= of_size(off[:, 0])
        return float(np.mean(is_found))

    return power


def _unit(name: str, size: int) -> np.ndarray:
    """Return the coefficients of a cause of size 1: its first, or the cosine of each run."""
    planted = np.zeros(size)
    planted[:: 2 if table.BY_NAME[name].phase else size] = 1.0
    return planted


def _is_significant(test: ScoreTest, statistic: np.ndarray) -> np.ndarray:
    """Return whether statistics like that of a test count (`evidence.is_significant`)."""
    size = len(test.estimate)
    p_value = fdtrc(size, test.freedom, statistic / size) * math.sqrt(test.trials)
    return (p_value < evidence.alpha_of(test)) & (statistic - size > thresholds.SCORE_FLOOR)


def _torque_share(planting: Planting, test: ScoreTest) -> float:
    """Return how much a torque of size 1 changes all torques, as a share; 0 for other causes."""
    mechanism = table.BY_NAME[test.name].mechanism
    if mechanism.acts_on != TORQUE:
        return 0.0
    size = 0.1 * mechanism.parameters[0].high
    cause = test.cause()._replace(values=(size,))
    with_cause = planting.base._replace(causes=(cause,))
    return stopping.torque_share(planting.design, with_cause, 0) / size


class _Rival(NamedTuple):
    """Brakes that vary in common in one form, as rivals of a cause of force."""

    scores: Scores
    matrix: SensitivityMatrix
    modes: list[int]  # numbers of the columns of the variation
    evidence: float  # ln det(S P) of [O1], less what the variation wins by chance

    def of_size(self, cause: Cause) -> Callable[[np.ndarray], np.ndarray]:
        """Return whether sizes of a cause are better explained by it [J2]."""
        variant = self.matrix.variant_of(cause)
        assert variant is not None
        [column, *_] = variant.columns
        coupling = self.scores.S[self.modes, column]
        inside = self.scores.S[np.ix_(self.modes, self.modes)]
        kept = self.scores.S[column, column] - coupling @ np.linalg.solve(inside, coupling)
        least = thresholds.CLEARLY_LESS_RATIO - self.evidence
        return lambda sizes: kept * sizes * sizes > least


def _rivals(planting: Planting) -> list[_Rival]:
    """Return the variations of the brakes in common, with their columns beside all causes."""
    found = []
    for form in coherence.FORMS:
        design = planting.design._replace(common_brake=form)
        normal, _, _ = fitting.normal_equations(design, planting.base)
        labels = {mode.label: mode.prior for mode in discrepancy.common_modes(design)}
        columns = normal.matrix.columns
        modes = [c for c, column in enumerate(columns) if column.label in labels]
        scores = evidence.scores(normal, without=modes)
        priors = np.array([columns[c].prior for c in modes])
        information = scores.S[np.ix_(modes, modes)] * np.outer(priors, priors)
        _, logarithm = np.linalg.slogdet(information)
        # without an effect, each value wins by its noise as much as its prior lets it
        by_noise = len(modes) - float(np.trace(np.linalg.inv(information)))
        found.append(_Rival(scores, normal.matrix, modes, float(logarithm) - by_noise))
    return found


# --- causes that act in a window ---


def _power_of_patch(planting: Planting, test: ScoreTest) -> Callable[[float], float]:
    """Return the power of a patch of 50 m, at another place in each null simulation."""
    at = evidence.bins(planting.normal, evidence.PLACE_BINS)
    bias = np.mean([s.g[at] for s in planting.nulls], axis=0)
    by_chance = _statistics([evidence.best_patch(s, at, bias) for s in planting.nulls])
    windows = []
    for k, null in enumerate(planting.nulls):
        seen = [i for i in range(len(at) - 1) if null.S[at[i], at[i]] > 0.0]
        first = seen[(7 * k) % len(seen)] if seen else 0
        windows.append(at[first : first + _BINS_OF_PATCH])

    def power(size: float) -> float:
        found = []
        for null, window in zip(planting.nulls, windows, strict=True):
            found.append(evidence.best_patch(_planted(null, window, -size), at, bias))
        return _share_of_windows(test, _statistics(found), by_chance)

    return power


def _power_of_sand(planting: Planting, test: ScoreTest) -> Callable[[float], float]:
    """Return the power of sand for 4 s in each run, at another time in each null simulation."""
    owner = evidence.TIME_BINS_BEHIND if test.shape.get("behind") else evidence.TIME_BINS
    at = evidence.bins(planting.normal, owner)
    runs = evidence.runs_of_bins(planting.normal, at)
    bias = np.mean([s.g[at] for s in planting.nulls], axis=0)
    by_chance = np.array([_total(evidence.best_sand(s, at, runs, bias)) for s in planting.nulls])
    windows = []
    for k in range(len(planting.nulls)):
        window: list[int] = []
        for run in sorted(set(runs)):
            of_run = [c for c, of in zip(at, runs, strict=True) if of == run]
            # the first bins are before the brake acts
            first = 1 + k % max(len(of_run) // 2, 1)
            window += of_run[first : first + _BINS_OF_SAND]
        windows.append(window)

    def power(size: float) -> float:
        statistics = []
        for null, window in zip(planting.nulls, windows, strict=True):
            sand = evidence.best_sand(_planted(null, window, size), at, runs, bias)
            statistics.append(_total(sand))
        return _share_of_windows(test, np.array(statistics), by_chance)

    return power


def _planted(null: Scores, window: Sequence[int], size: float) -> Scores:
    """Return the scores with a change of friction of a size in a window [J1]."""
    return null._replace(g=null.g - size * null.S[:, list(window)].sum(axis=1))


def _statistics(windows: Sequence[evidence.Window | None]) -> np.ndarray:
    return np.array([0.0 if window is None else window.statistic for window in windows])


def _total(windows: dict[int, evidence.Window]) -> float:
    return float(sum(window.statistic for window in windows.values()))


def _share_of_windows(test: ScoreTest, statistics: np.ndarray, by_chance: np.ndarray) -> float:
    """Return the share of statistics of a window that count, as in `evidence` and `choice`."""
    p_values = np.array([evidence.gumbel_tail(float(value), by_chance) for value in statistics])
    is_found = (p_values < evidence.alpha_of(test)) & (statistics - 1.0 > thresholds.SCORE_FLOOR)
    ratio = statistics - choice.by_chance(test) - choice.price(test)
    return float(np.mean(is_found & (ratio > thresholds.LEAST_RATIO)))
