"""The points of a campaign: how the values of all runs are combined or drawn.

A plan varies values in two tables. `[vary]` has lists (for a matrix) or ranges with equal chances.
`[inputs]` has distributions with sources (`statistics.laws`), correlated by `[[correlation]]`.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.stats import qmc

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign.drawn_rows import DrawnRows
from rollerrig.realtime.campaign.statistics import drivers, laws

MATRIX = "matrix"
SALTELLI = "saltelli"  # blocks of runs for Sobol indices
INDEPENDENT = "random"  # the only design whose runs are independent draws
DESIGNS = (MATRIX, "sobol", "halton", "latin_hypercube", INDEPENDENT, SALTELLI)
# keys of a range in [vary]
RANGE = (
    table.number("low", None, -1e300, 1e300, "-"),
    table.number("high", None, -1e300, 1e300, "-"),
    table.flag("log", False, "spread evenly in the logarithm"),
)
_RANGE_SOURCE = "the range of the plan, with equal chances; no source"


class Points(NamedTuple):
    """All runs of a plan.

    axes: names of the varied values.
    rows: the values of each run, in the order of `axes`.
    sources: (input, law, source) of each input that is drawn from a law.
    ranges: of each input that is drawn: its lowest and highest value, `log` if it is even in the
    logarithm, and its law in words.
    """

    axes: tuple[str, ...]
    rows: Sequence[tuple[Any, ...]]
    sources: tuple[tuple[str, str, str], ...]
    ranges: tuple[dict[str, Any], ...] = ()


def points(
    vary: Any, inputs: Any, correlations: Any, head: Mapping[str, Any], path: Path
) -> Points:
    """Return the runs of a plan from its tables. Raises ConfigError.

    `head` has design, runs, seed and rows_up_to: the rows of a random design with more runs are
    drawn when they are needed.
    """
    for name, given in (("vary", vary), ("inputs", inputs)):
        if not isinstance(given, dict):
            raise ConfigError(f"{path} [{name}]: must be a table of values to vary")
    if not vary and not inputs:
        raise ConfigError(
            f"{path}: [vary] and [inputs] are empty, so no value is varied; write, for example, "
            '"adhesion.mu_cd" = [0.03, 0.06] or { low = 0.03, high = 0.1 } in [vary]'
        )
    twice = sorted(set(vary) & set(inputs))
    if twice:
        raise ConfigError(f"{path}: {', '.join(twice)} is in [vary] and in [inputs]; keep one")

    if head["design"] == MATRIX:
        if inputs or correlations:
            raise ConfigError(
                f"{path}: a matrix combines lists, and [inputs] and [[correlation]] draw from laws;"
                f' set design = "{INDEPENDENT}"'
            )
        return Points(tuple(vary), tuple(_matrix(vary, path)), ())
    return _drawn(vary, inputs, correlations, head, path)


def _matrix(vary: Mapping[str, Any], path: Path) -> list[tuple[Any, ...]]:
    """Return all combinations of the listed values."""
    for key, values in vary.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(
                f"{path} [vary] {key} = {values!r}: a matrix needs a list of values; "
                'for a range set design = "sobol"'
            )
    return list(itertools.product(*vary.values()))


def _drawn(
    vary: Mapping[str, Any],
    inputs: Mapping[str, Any],
    correlations: Any,
    head: Mapping[str, Any],
    path: Path,
) -> Points:
    """Return the runs of a design that draws values."""
    design = head["design"]
    all_laws = [_range(key, given, design, path) for key, given in vary.items()]
    all_laws += [laws.read(key, given, f"{path} [inputs] {key}") for key, given in inputs.items()]
    axes = tuple(law.name for law in all_laws)
    matrix = laws.read_correlation(correlations, axes, f"{path} [[correlation]]")
    if design == SALTELLI and correlations:
        raise ConfigError(
            f"{path}: Sobol indices are for independent inputs, so a {SALTELLI} design has no "
            f'[[correlation]]; remove it, or set design = "{INDEPENDENT}"'
        )
    rows: Sequence[tuple[Any, ...]]
    if is_large(head):
        identity = [vary, inputs, correlations]
        rows = DrawnRows(head["runs"], head["seed"], all_laws, matrix, identity)
    else:
        shares = laws.correlated(_unit_cube(head, len(axes), path), matrix)
        columns = [law.at(shares[:, place]).tolist() for place, law in enumerate(all_laws)]
        rows = tuple(zip(*columns, strict=True))
    ranges = []
    ends = extremes(rows, axes)
    for place, law in enumerate(all_laws):
        low_run, high_run = ends[law.name]
        low, high = rows[low_run][place], rows[high_run][place]
        if law.name in vary:
            low, high = vary[law.name]["low"], vary[law.name]["high"]
        is_log = law.name in vary and bool(vary[law.name].get("log"))
        ranges.append({"low": low, "high": high, "log": is_log, "law": law.text})
    return Points(
        axes,
        rows,
        tuple((law.name, law.text, law.source) for law in all_laws),
        tuple(ranges),
    )


def is_large(head: Mapping[str, Any]) -> bool:
    """Return whether a plan keeps no rows of all runs; `head` are the values at its top."""
    return bool(head["design"] == INDEPENDENT and head["runs"] > head["rows_up_to"])


def identity(rows: Sequence[tuple[Any, ...]]) -> Any:
    """Return what decides the values of all runs, for the fingerprint of a plan."""
    return rows.identity if isinstance(rows, DrawnRows) else rows


def _range(key: str, span: Any, design: str, path: Path) -> laws.Law:
    """Return the law of a range of [vary]."""
    where = f"{path} [vary] {key}"
    if not isinstance(span, dict):
        raise ConfigError(
            f"{where} = {span!r}: a {design} design needs a range "
            '{ low = ..., high = ... }; for a list set design = "matrix"'
        )
    checked = table.read(RANGE, span, where)
    low, high = checked["low"], checked["high"]
    if not low < high or (checked["log"] and low <= 0.0):
        raise ConfigError(
            f"{where}: low = {low:g} and high = {high:g} must rise, and be above 0 if log = true"
        )
    if checked["log"]:
        text = "evenly in the logarithm"
        return laws.Law(key, stats.loguniform(low, high), 0.0, 1.0, text, _RANGE_SOURCE)
    text = "evenly"
    return laws.Law(key, stats.uniform(low, high - low), 0.0, 1.0, text, _RANGE_SOURCE)


def _unit_cube(head: Mapping[str, Any], dimensions: int, path: Path) -> np.ndarray:
    """Return the sample of a design between 0 and 1, shape (runs, dimensions)."""
    design = head["design"]
    runs = head["runs"]
    seed = head["seed"]
    if design == INDEPENDENT:
        return np.random.default_rng(seed).random((runs, dimensions))
    if design == SALTELLI:
        size = drivers.block_size(dimensions)
        least = drivers.FEWEST_BLOCKS * size
        if runs < least:
            raise ConfigError(
                f"{path}: runs = {runs}: a {SALTELLI} design of {dimensions} inputs has blocks of "
                f"{size} runs, and indices need {drivers.FEWEST_BLOCKS} blocks; set runs = {least} "
                "or more"
            )
        return drivers.blocks(runs // size, dimensions, seed)
    if design == "sobol":
        # a Sobol sequence is balanced only in powers of two; take the first points of enough
        exponent = max(runs - 1, 1).bit_length()
        return np.asarray(qmc.Sobol(dimensions, rng=seed).random_base2(exponent)[:runs])
    kind = qmc.Halton if design == "halton" else qmc.LatinHypercube
    return np.asarray(kind(dimensions, rng=seed).random(runs))


def extremes(rows: Sequence[tuple[Any, ...]], axes: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return, for each numeric input, the runs with its least and its greatest value."""
    if isinstance(rows, DrawnRows):
        return dict(zip(axes, rows.extremes, strict=True))
    found = {}
    for place, axis in enumerate(axes):
        column = [row[place] for row in rows]
        if all(isinstance(value, int | float) for value in column):
            found[axis] = (int(np.argmin(column)), int(np.argmax(column)))
    return found
