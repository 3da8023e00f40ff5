"""`rollerrig run --repeat N`: the same run with several seeds, and one table of the figures."""

import argparse
import copy
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import figures, validity

_NUMBERS = ("mean", "standard_deviation", "least", "largest")
_HEAD = ("figure", "unit", "runs", "mean", "standard deviation", "least", "largest")


def check(options: argparse.Namespace) -> None:
    """Raise ConfigError for a number of runs that cannot be, or with what is for one run only."""
    if options.repeat < 1:
        raise ConfigError(f"--repeat {options.repeat}: allowed are numbers from 1")
    if options.repeat > 1 and options.also_without_wsp:
        raise ConfigError(
            "--repeat and --also-without-wsp: a stop without WSP is computed for one run; leave one of "
            "the options out"
        )


def options_of_runs(options: argparse.Namespace, folder: Path) -> Iterator[argparse.Namespace]:
    """Yield the options of each run: folder and seed count up."""
    for number in range(options.repeat):
        of_run = copy.copy(options)
        of_run.out = folder / str(number + 1)
        of_run.seed = options.seed + number
        yield of_run


def show(options: argparse.Namespace, folder: Path, summaries: Sequence[Mapping[str, Any]]) -> None:
    """Print the figures of all runs that are valid, and why the others are not."""
    found = spread(summaries)
    rows = [
        (one["title"], one["unit"], str(one["runs"]), *(f"{one[key]:.6g}" for key in _NUMBERS))
        for one in found
    ]
    lines = [f"recorded in {folder}/1 to {folder}/{len(summaries)}"]
    not_valid = []
    for number, summary in enumerate(summaries, start=1):
        for reason in validity.because(summary):
            not_valid.append({"run": number, "because": reason})
            lines.append(f"run {number} is not valid: {reason}")
    if not any(summary["random"] for summary in summaries):
        lines.append("nothing in these runs of the rig is random: their seeds have no effect")
    output.show(
        options,
        {
            "folder": str(folder),
            "runs": list(summaries),
            "not_valid": not_valid,
            "figures": found,
        },
        (f"{len(summaries)} runs", _HEAD, rows),
        *lines,
    )


def spread(summaries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the spread of each figure over the valid runs that have it, in the unit of people.

    The standard deviation is that of a sample; it is 0 for one run.
    """
    found = []
    for figure in figures.FIGURES:
        known = [figure.of(summary) for summary in summaries]
        values = [figure.scale * value for value in known if _is_number(value)]
        if values:
            found.append(
                {
                    "name": figure.name,
                    "title": figure.title,
                    "unit": figure.unit,
                    "runs": len(values),
                    "mean": statistics.fmean(values),
                    "standard_deviation": statistics.stdev(values) if len(values) > 1 else 0.0,
                    "least": min(values),
                    "largest": max(values),
                }
            )
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
