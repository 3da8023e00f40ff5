"""Two campaigns compared: is the second one better, by how much, and is that more than chance?

Run n of both campaigns is a pair if both have drawn it with the same random numbers: the same
design, seed, number of runs and inputs. Pairs are much more sensitive than two samples, because
every difference between the runs of one campaign is in both runs of a pair.

[M1] The inputs of a pair have the same values, with two exceptions. An input that each campaign
     keeps at one value may differ: it is what the campaigns compare. So may an input of a drawn
     design whose law differs: both values have the same place in their laws.
[M2] A matrix is no sample, and the runs of a saltelli design are not independent. Their
     differences have no interval and no test.
[M3] A large campaign keeps no rows of all runs, so it has no pairs. Quantiles and the interval of
     the difference of the medians come from its sketches.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from rollerrig.configs import table, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import campaign, design, large, outcome, speed_steps, stopping
from rollerrig.realtime.campaign.components import applied as applied_of
from rollerrig.realtime.campaign.statistics import differences, draws

# compared figures; of all of them less is better. The first one is judged by itself.
FIGURES = (
    "braking_distance_m",
    "braking_time_s",
    "sliding_max_m_s",
    "longest_lock_s",
    "longest_deep_slide_s",
    "dissipated_energy_J",
    "vents",
    "air_consumption_NL",
)
DISTANCE = FIGURES[0]
# runs in the list of those that became worst
WORST = 5
# designs whose runs are no sample [M2]
_NO_SAMPLE = (design.MATRIX, design.SALTELLI)
# values at the top of a plan that the comparison names if they differ
_NAMED = ("scenario", "unit", "design", "seed", "runs", campaign.STEP)
_MARK = "plan.json"


class Side(NamedTuple):
    """One of the two campaigns.

    plan: without points. planned: number of runs of the plan. fingerprint: of the plan.
    found: its results. kept: the sketches of a large campaign, None of another one.
    """

    folder: Path
    plan: campaign.Plan
    planned: int
    fingerprint: str
    found: outcome.Outcome
    kept: large.Kept | None

    def draws(self, name: str) -> draws.Draws:
        """Return the order statistics of a figure; a run that did not stop has an inf distance."""
        if self.kept is None:
            return draws.of(self.values(name))
        if name == DISTANCE:
            return self.kept.draws(name)
        sketch = self.kept.whole.sketches[name]
        return draws.Draws(sketch.size, np.zeros(0), sketch)

    def values(self, name: str) -> np.ndarray:
        """Return a figure of the runs in `found.rows` that have it (n,)."""
        column = _column(self.found.rows, name)
        return column[~np.isnan(column)]

    def worst(self, name: str) -> int | None:
        """Return the number of the run with the largest value; None if its row is not kept."""
        rows = self.found.longest
        if self.kept is not None and name != DISTANCE:
            return None
        values = rows[name].to_numpy().astype(float)
        if not np.isfinite(values).any():
            return None
        return int(rows["run"][int(np.nanargmax(values))].as_py())


class Compared(NamedTuple):
    """One figure of both campaigns, in the unit of its name.

    quantiles: of each campaign the values at `outcome.QUANTILES`; empty if no run has the figure.
    worst_runs: the run with the largest value in each campaign; None if its row is not kept.
    difference: None if a campaign has no value.
    counts: of the pairs; None without pairs.
    only_first, only_second: runs of pairs that have the figure in one campaign only.
    """

    name: str
    quantiles: tuple[list[float], list[float]]
    worst_runs: tuple[int | None, int | None]
    difference: differences.Difference | None
    counts: differences.Counts | None
    only_first: int = 0
    only_second: int = 0


class Worse(NamedTuple):
    """A run whose stopping distance became longer, with the commands that repeat it.

    None instead of a distance: it did not stop. first_m is also None without pairs.
    """

    run: int
    first_m: float | None
    second_m: float | None
    commands: tuple[str, ...]


class Comparison(NamedTuple):
    """Two campaigns; the first one is the reference.

    differs: (what, its value in each campaign).
    unpaired_because: why there are no pairs; "" if there are.
    other_inputs: inputs whose values differ within the pairs.
    untested_because: why there are no intervals and tests; "" if there are.
    is_even: a design fills its ranges more evenly than independent draws.
    """

    sides: tuple[Side, Side]
    differs: list[tuple[str, str, str]]
    unpaired_because: str
    other_inputs: list[str]
    untested_because: str
    is_even: bool
    compared: list[Compared]
    became_worse: list[Worse]

    @property
    def is_paired(self) -> bool:
        """Whether the runs of both campaigns are pairs."""
        return not self.unpaired_because


# --- reading ---


def read(folder: Path) -> Side:
    """Return a campaign from its folder. Raises ConfigError."""
    mark = folder / _MARK
    content = user_files.read_json(mark, within=folder)
    if not isinstance(content, dict) or not isinstance(content.get("head"), dict):
        raise ConfigError(f"{mark}: is not of a campaign; repeat the campaign in a new folder")
    head = table.read(campaign.ROWS, content["head"], f"{mark} head")
    if head["design"] == design.STRATIFIED:
        raise ConfigError(
            f"{folder}: the runs of a {design.STRATIFIED} design have different weights, so two such "
            f'campaigns are not compared run by run; set design = "{design.INDEPENDENT}", or compare '
            "the quantiles of both reports"
        )
    axes = content.get("axes")
    planned = content.get("runs")
    if not isinstance(axes, list) or not isinstance(planned, int):
        raise ConfigError(f"{mark}: has no axes or runs; repeat the campaign in a new folder")
    steps = None
    if content.get("etcs") is not None:
        steps = speed_steps.read(content["etcs"], f"{mark} etcs")
    applied = applied_of.from_json(content.get("components"), f"{mark} components")
    plan = campaign.Plan(head, tuple(map(str, axes)), (), steps=steps, applied=applied)

    kept = None
    if plan.is_large:
        kept = large.read(large.tails_of(plan), folder)
        if kept.whole.first is None:
            raise ConfigError(f"{folder}: no results; repeat its 'rollerrig campaign'")
        found = outcome.of_kept(kept)
    else:
        rows = campaign.result(folder)
        _check_columns(rows, plan, folder)
        found = outcome.of_rows(rows)
    return Side(folder, plan, planned, str(content.get("fingerprint")), found, kept)


def _check_columns(rows: pa.Table, plan: campaign.Plan, folder: Path) -> None:
    """Raise ConfigError unless rows have all columns of this version."""
    needed = campaign.empty_row(plan, 0, (None,) * len(plan.axes))
    missing = [name for name in needed if name not in rows.column_names]
    if missing:
        raise ConfigError(
            f"{folder}: its rows have no {missing[0]}, as those of another version; repeat the "
            "campaign in a new folder"
        )


def _column(rows: pa.Table, name: str) -> np.ndarray:
    """Return a figure of all rows (n,), NaN where a run has none, inf if it did not stop."""
    if name != DISTANCE:
        return rows[name].to_numpy().astype(float)
    counts, distance_m = stopping.counted(rows)
    column = np.full(rows.num_rows, np.nan)
    column[counts] = distance_m
    return column


# --- comparing ---


def compare(first: Side, second: Side) -> Comparison:
    """Return how the second campaign differs from the first one."""
    rows = (first.found.rows, second.found.rows)
    _, in_first, in_second = np.intersect1d(
        rows[0]["run"].to_numpy(), rows[1]["run"].to_numpy(), return_indices=True
    )
    common = (rows[0].take(in_first), rows[1].take(in_second))
    reason = _why_unpaired(first, second, common)
    designs = (first.plan.head["design"], second.plan.head["design"])
    no_sample = next((name for name in designs if name in _NO_SAMPLE), None)
    untested = ""
    if no_sample:
        untested = f"the runs of a {no_sample} design are no sample of independent draws"

    sides = (first, second)
    compared = []
    for name in FIGURES:
        found = _paired(sides, common, name) if not reason else _unpaired(sides, name)
        if untested and found.difference is not None:
            bare = differences.Difference(found.difference.median, -np.inf, np.inf, None)
            found = found._replace(difference=bare)
        if any(found.quantiles):
            compared.append(found)

    return Comparison(
        sides=sides,
        differs=_differs(first.plan.head, second.plan.head),
        unpaired_because=reason,
        other_inputs=[] if reason else _other_inputs(first.plan.axes, common),
        untested_because=untested,
        is_even=any(name != design.INDEPENDENT for name in designs),
        compared=_corrected(compared),
        became_worse=_worst_of(second) if reason else _worse_pairs(sides, common),
    )


def _why_unpaired(first: Side, second: Side, common: tuple[pa.Table, pa.Table]) -> str:
    """Return why the runs of two campaigns are no pairs; "" if they are."""
    for side in (first, second):
        if side.kept is not None:
            return f"{side.folder} is a large campaign, which keeps no rows of all runs"
    for key in ("design", "seed"):
        if key == "seed" and first.plan.head["design"] == design.MATRIX:
            continue
        if first.plan.head[key] != second.plan.head[key]:
            return f"{key} is {first.plan.head[key]} and {second.plan.head[key]}"
    if first.planned != second.planned:
        return f"the plans have {first.planned} and {second.planned} runs"
    if first.plan.axes != second.plan.axes:
        return (
            f"the inputs are {', '.join(first.plan.axes)} and {', '.join(second.plan.axes)}; the "
            "order counts"
        )
    if not common[0].num_rows:
        return "no run is done in both campaigns"
    if first.plan.head["design"] == design.MATRIX:
        for axis in _other_inputs(first.plan.axes, common):
            # [M1]
            if any(len(rows[axis].unique()) > 1 for rows in common):
                return f"the lists of {axis} differ"
    return ""


def _other_inputs(axes: Sequence[str], common: tuple[pa.Table, pa.Table]) -> list[str]:
    """Return the inputs that differ in at least one pair."""
    first, second = common
    return [axis for axis in axes if first[axis].to_pylist() != second[axis].to_pylist()]


def _differs(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return the values at the top of two plans that differ."""
    pairs = ((key, first[key], second[key]) for key in _NAMED)
    return [(key, str(one), str(other)) for key, one, other in pairs if one != other]


def _compared(
    sides: tuple[Side, Side], name: str, difference: differences.Difference | None
) -> Compared:
    first, second = (dict(side.found.quantiles).get(name, []) for side in sides)
    return Compared(
        name,
        quantiles=(first, second),
        worst_runs=(sides[0].worst(name), sides[1].worst(name)),
        difference=difference,
        counts=None,
    )


def _paired(sides: tuple[Side, Side], common: tuple[pa.Table, pa.Table], name: str) -> Compared:
    first, second = (_column(rows, name) for rows in common)
    in_first, in_second = ~np.isnan(first), ~np.isnan(second)
    in_both = in_first & in_second
    gaps, counts = differences.of_pairs(first[in_both], second[in_both])
    difference = differences.paired(gaps) if gaps.size else None
    return _compared(sides, name, difference)._replace(
        counts=counts,
        only_first=int((in_first & ~in_second).sum()),
        only_second=int((in_second & ~in_first).sum()),
    )


def _unpaired(sides: tuple[Side, Side], name: str) -> Compared:
    first, second = (side.draws(name) for side in sides)
    difference = None
    if first.size and second.size:
        if any(side.kept is not None for side in sides):
            difference = differences.of_medians(first, second)
        else:
            difference = differences.unpaired(sides[0].values(name), sides[1].values(name))
    return _compared(sides, name, difference)


def _corrected(compared: list[Compared]) -> list[Compared]:
    """Return figures with probabilities corrected together; the stopping distance keeps its own."""
    tested: dict[int, differences.Difference] = {}
    p_values: list[float] = []
    for place, figure in enumerate(compared):
        difference = figure.difference
        if difference is None or difference.p_value is None or figure.name == DISTANCE:
            continue
        tested[place] = difference
        p_values.append(difference.p_value)
    found = list(compared)
    for place, p_value in zip(tested, differences.corrected(p_values), strict=True):
        difference = tested[place]._replace(p_value=p_value)
        found[place] = found[place]._replace(difference=difference)
    return found


# --- the runs that became worst ---


def _worse_pairs(sides: tuple[Side, Side], common: tuple[pa.Table, pa.Table]) -> list[Worse]:
    """Return the runs whose stopping distance became longer, the largest difference first."""
    first_m, second_m = (_column(rows, DISTANCE) for rows in common)
    in_both = np.flatnonzero(~np.isnan(first_m) & ~np.isnan(second_m))
    gaps_m, _ = differences.of_pairs(first_m[in_both], second_m[in_both])
    order = np.argsort(-gaps_m, kind="stable")[:WORST]
    found = []
    for place in order[gaps_m[order] > 0.0]:
        row = int(in_both[place])
        commands = tuple(
            _command(side, rows, row) for side, rows in zip(sides, common, strict=True)
        )
        run = int(common[0]["run"][row].as_py())
        found.append(Worse(run, _finite(first_m[row]), _finite(second_m[row]), commands))
    return found


def _worst_of(side: Side) -> list[Worse]:
    """Return the longest stops of a campaign, the longest first."""
    rows = side.found.longest
    distances_m = _column(rows, DISTANCE)
    known = np.flatnonzero(~np.isnan(distances_m))
    order = known[np.argsort(-distances_m[known], kind="stable")][:WORST]
    return [
        Worse(
            run=int(rows["run"][int(row)].as_py()),
            first_m=None,
            second_m=_finite(distances_m[row]),
            commands=(_command(side, rows, int(row)),),
        )
        for row in order
    ]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _command(side: Side, rows: pa.Table, row: int) -> str:
    """Return the command line that repeats the run of a row."""
    run = int(rows["run"][row].as_py())
    values = [rows[axis][row].as_py() for axis in side.plan.axes]
    if side.plan.head["design"] == design.MATRIX:
        # rows have no whole numbers, and a list of a plan may have them
        values = [_whole(value) for value in values]
    return campaign.command(side.plan._replace(points=(tuple(values),), first=run), run)


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value
