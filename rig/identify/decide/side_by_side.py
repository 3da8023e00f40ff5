"""Compares the runs with each other: what differs between them, and which runs differ.

Causes are searched in all runs together. Two rigs, a changed wheel, a cold run or another unit in
one run look like no cause then. So each quantity of `base.by_run`, and the size of the nearest
cause, is compared between the runs, and the runs are parted into two groups if there are two
(`statistics.groups`). All quantities together give a false alarm in ALPHA of fault-free sets.

The size of a cause in one run is fitted to this run alone, with the shape and the shared scales
that all fitted runs gave.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.base import by_run, shared
from rollerrig.rig.identify.base.by_run import ByRun, Quantity
from rollerrig.rig.identify.base.shared import Shared
from rollerrig.rig.identify.causes import discrepancy, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import evidence, fitting
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.null_simulations import Workspace
from rollerrig.rig.identify.statistics import groups
from rollerrig.rig.identify.statistics.interval import Estimate

# probability of a false alarm of all comparisons of a dataset
ALPHA = 0.02
STEPS_OF_ONE_RUN = 5


class CauseByRun(NamedTuple):
    """The size of a cause, its first coefficient, in each run (runs,); NaN where it has none."""

    cause: Cause
    sizes: np.ndarray
    errors: np.ndarray


class Difference(NamedTuple):
    """A quantity, or the size of a cause, that differs between two groups of runs."""

    quantity: Quantity | None  # None: the size of the cause
    channel: str
    cause: str
    difference: Estimate  # of the runs apart less the others; of logarithms for some quantities


class Apart(NamedTuple):
    """Runs that differ from the others, and in what."""

    runs: tuple[str, ...]
    others: tuple[str, ...]
    differences: list[Difference]
    shared: dict[Shared, str]  # with the name of the rig, or the date


class SideBySide(NamedTuple):
    """All quantities of all runs, the size of the nearest cause, and the runs that differ."""

    runs: tuple[str, ...]
    quantities: list[ByRun]
    cause: CauseByRun | None
    apart: list[Apart]  # with most differences first

    @property
    def contradicts_one_model(self) -> bool:
        """Whether no model with one size of everything is right for all runs.

        Each run has its friction, and its noise is no error of a model.
        """
        of_run = (Quantity.FRICTION, Quantity.NOISE)
        return any(one.quantity not in of_run for group in self.apart for one in group.differences)


# before runs were compared
NOTHING = SideBySide((), [], None, [])


def compare(
    workspace: Workspace, explanation: Explanation, tests: Sequence[ScoreTest]
) -> SideBySide:
    """Return all runs of a dataset side by side.

    `explanation` is the fitted base with the causes that won, reported or not. Without one the
    cause of the most significant score test is the nearest.
    """
    data = workspace.data
    cause = _by_run(workspace, explanation, tests)
    return of_runs(data.runs, by_run.measure(data), cause)


def of_runs(runs: Sequence[Run], quantities: list[ByRun], cause: CauseByRun | None) -> SideBySide:
    """Return runs side by side by their quantities and the size of a cause."""
    tests = len(quantities) + (cause is not None)
    by_group: dict[tuple[int, ...], list[Difference]] = {}
    others: dict[tuple[int, ...], tuple[int, ...]] = {}
    if cause is not None:
        found = groups.find(cause.sizes, cause.errors, ALPHA, tests)
        if found is not None:
            others[found.apart] = found.others
            by_group[found.apart] = [Difference(None, "", cause.cause.name, found.difference)]
    for quantity in quantities:
        found = groups.find(quantity.sizes, quantity.errors, ALPHA, tests)
        if found is not None:
            others[found.apart] = found.others
            difference = Difference(quantity.quantity, quantity.channel, "", found.difference)
            by_group.setdefault(found.apart, []).append(difference)

    apart = [
        Apart(
            runs=tuple(runs[k].name for k in places),
            others=tuple(runs[k].name for k in others[places]),
            differences=differences,
            shared=shared.find(runs, places, others[places]),
        )
        for places, differences in by_group.items()
    ]
    apart.sort(key=lambda one: -len(one.differences))
    return SideBySide(tuple(run.name for run in runs), quantities, cause, apart)


# --- the size of the nearest cause ---


def nearest(explanation: Explanation, tests: Sequence[ScoreTest]) -> Cause | None:
    """Return the cause that comes nearest to the error; None if nothing is significant."""
    if explanation.causes:
        return explanation.causes[0]
    significant = [
        test
        for test in tests
        if not evidence.is_smooth_function(test.name) and evidence.is_significant(test)
    ]
    best = max(significant, key=lambda test: test.statistic, default=None)
    return None if best is None else best.cause()


def _by_run(
    workspace: Workspace, explanation: Explanation, tests: Sequence[ScoreTest]
) -> CauseByRun | None:
    """Return the size of the nearest cause by run; None without a cause that has one size."""
    cause = nearest(explanation, tests)
    if cause is None or table.BY_NAME[cause.name].edge_step or table.BY_NAME[cause.name].phase:
        return None
    with_cause = explanation._replace(causes=(cause, *explanation.causes[1:]))
    spread = max((test.spread_by_chance for test in tests if test.name == cause.name), default=1.0)
    data = workspace.data
    tasks = [(data, run, workspace.design, with_cause) for run in data.runs]
    fits = workspace.run_all(size_in_run, tasks, "each run by itself")
    sizes = np.array([size for size, _ in fits])
    errors = max(spread, 1.0) * np.array([error for _, error in fits])
    return CauseByRun(cause, sizes, np.hypot(errors, table.BY_NAME[cause.name].floor))


def size_in_run(
    data: Dataset, run: Run, fitted: Design, explanation: Explanation
) -> tuple[float, float]:
    """Return the size of the first cause of an explanation in one run, and its standard error.

    The level of the contaminant, the mass and the course of the brake belong to this run. NaN if
    the run does not show the size.
    """
    design = prepare(data, [run], fitted)
    base = {"ln_mu_cd_0": explanation.level}
    for label, value in explanation.base.items():
        if not label.startswith(("ln_mu_cd", "mass", discrepancy.BRAKE)):
            base[label] = value
    start = explanation._replace(base=base)
    fit = fitting.fit(design, start, STEPS_OF_ONE_RUN, noise=False)
    variance = float(fit.covariance[0, 0]) if fit.covariance.size else math.inf
    if not 0.0 < variance < math.inf:
        return math.nan, math.nan
    return fit.explanation.causes[0].values[0], math.sqrt(variance)
