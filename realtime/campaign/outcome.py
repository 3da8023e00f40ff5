"""What a campaign has found, for its report: from all rows, or from what a large one keeps."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import campaign, large, stopping
from rollerrig.realtime.campaign.statistics import draws, strata
from rollerrig.realtime.record import figures

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


class Outcome(NamedTuple):
    """The results of a campaign.

    runs, failed, not_valid: numbers of runs.
    rows: the rows that pictures and correlations are made of: all, or the first ones.
    longest: rows in which the worst runs are.
    invalid: rows of runs that failed or are not valid: all, or the first ones.
    distance_m: order statistics of the stopping distance of the runs that count, or their values
    with the strata of a stratified design.
    uncounted, not_stopped: numbers of runs that do not count, and that count as inf.
    quantiles: (figure, its values at QUANTILES); figures that no run has are left out. A quantile
    is the order statistic of rank ceil(share * n), here as in bounds and comparisons.
    again: (number of stops that ran again with the step of the scenario, the largest share by which
    the longer step had missed their distance); of a large campaign, those among its longest stops.
    warnings: what was planned but did not happen, with the number of its runs.
    """

    runs: int
    failed: int
    not_valid: int
    rows: pa.Table
    longest: pa.Table
    invalid: pa.Table
    distance_m: draws.Draws | strata.Sample
    uncounted: int
    not_stopped: int
    quantiles: list[tuple[str, list[float]]]
    again: tuple[int, float]
    warnings: dict[str, int]

    @property
    def has_all_rows(self) -> bool:
        """Whether `rows` has all runs."""
        return self.rows.num_rows == self.runs


def read(plan: campaign.Plan, out: Path) -> Outcome:
    """Return the results in a folder. Raises ConfigError if there are none."""
    if not plan.is_large:
        return of_rows(campaign.result(out), plan.strata)
    kept = large.read(large.tails_of(plan), out)
    if kept.whole.first is None:
        raise ConfigError(f"{out}: no results; repeat its 'rollerrig campaign'")
    return of_kept(kept)


def of_rows(table: pa.Table, of_plan: Sequence[strata.Stratum] = ()) -> Outcome:
    """Return the results in the rows of all runs; `of_plan` are the strata of its design."""
    counts, distance_m = stopping.counted(table)
    quantiles = []
    for name in figures.BY_NAME:
        values = table[name].to_numpy().astype(float)
        known = np.isfinite(values)
        if known.any():
            quantiles.append((name, _quantiles(sample(table, known, values[known], of_plan))))
    return Outcome(
        runs=table.num_rows,
        failed=table.num_rows - table["error"].null_count,
        not_valid=table.num_rows - table["invalid_because"].null_count,
        rows=table,
        longest=table,
        invalid=table,
        distance_m=sample(table, counts, distance_m, of_plan),
        uncounted=int((~counts).sum()),
        not_stopped=int(np.isinf(distance_m).sum()),
        quantiles=quantiles,
        again=_again(table),
        warnings=dict(Counter(text for text in table["warnings"].to_pylist() if text)),
    )


def sample(
    table: pa.Table, counts: np.ndarray, values: np.ndarray, of_plan: Sequence[strata.Stratum]
) -> draws.Draws | strata.Sample:
    """Return the values of the rows that count, for statistics.

    counts: bool (rows,). values: of these rows. of_plan: strata of the design; none: equal weights.
    """
    if not of_plan:
        return draws.of(values)
    stratum = table[campaign.STRATUM].to_numpy()[counts]
    return strata.Sample(values, stratum, of_plan)


def _quantiles(values: draws.Draws | strata.Sample) -> list[float]:
    """Return the values at QUANTILES; least and largest are those of the runs."""
    if isinstance(values, strata.Sample):
        inner = [values.quantile(1.0 - share) for share in QUANTILES[1:-1]]
        return [float(values.values[-1]), *inner, float(values.values[0])]
    return [values.at(max(math.ceil(share * values.size), 1)) for share in QUANTILES]


def of_kept(kept: large.Kept) -> Outcome:
    """Return the results of a large campaign."""
    whole = kept.whole
    quantiles = []
    for name in figures.BY_NAME:
        values = kept.quantiles(name, QUANTILES)
        if values:
            quantiles.append((name, values))
    return Outcome(
        runs=whole.runs,
        failed=whole.failed,
        not_valid=whole.not_valid,
        rows=whole.first,
        longest=whole.tails.get(large.DISTANCE, whole.first),
        invalid=whole.invalid,
        distance_m=kept.draws(large.DISTANCE),
        uncounted=whole.runs - whole.counted,
        not_stopped=whole.not_stopped,
        quantiles=quantiles,
        again=_again(whole.tails.get(large.DISTANCE, whole.first)),
        warnings=whole.warnings,
    )


def _again(table: pa.Table) -> tuple[int, float]:
    """Return how many rows ran again, and the largest share that the longer step had missed."""
    missed = np.abs(table[campaign.MISSED].to_numpy().astype(float))
    missed = missed[np.isfinite(missed)]
    return missed.size, float(missed.max(initial=0.0))
