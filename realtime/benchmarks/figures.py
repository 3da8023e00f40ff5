"""The form of a benchmark's result: figures, and the targets that some of them have to meet.

A result is a plain table of numbers that goes into JSON as it stands; `targets` is the list of
verdicts in it. The targets are those of the project's own requirements (the README lists them).
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

Result = dict[str, Any]
Say = Callable[[str], None]
# what a benchmark is handed: the parsed command line, and how to tell how far it is
Run = Callable[[argparse.Namespace, Say], Result]
QUANTILES = (("p50", 0.5), ("p99", 0.99), ("p999", 0.999))


class Target(NamedTuple):
    """A requirement: a figure and the limit that it must not exceed."""

    name: str
    value: float | None
    limit: float
    unit: str = ""

    @property
    def met(self) -> bool:
        """Whether the figure is known and within its limit."""
        return self.value is not None and self.value <= self.limit

    def plain(self) -> Result:
        """As it stands in JSON."""
        return {"name": self.name, "value": self.value, "limit": self.limit, "unit": self.unit,
                "met": self.met}


def quantiles(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """p50, p99, p999 and max of some values, in their unit; empty where there are none."""
    found = np.sort(np.asarray(values, dtype=np.float64))
    if not found.size:
        return {}
    named = {name: float(found[min(int(share * found.size), found.size - 1)])
             for name, share in QUANTILES}
    return named | {"max": float(found[-1])}


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
    """A table of figures."""
    shown = Table(title=title, title_justify="left")
    for at, head in enumerate(heads):
        shown.add_column(head, justify="right" if at else "left")
    for row in rows:
        shown.add_row(*(show(cell) for cell in row))
    return shown


def show(value: object) -> str:
    """A cell: four significant digits for a number, a dash for nothing."""
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def lines(result: Result) -> list[str]:
    """What stands below the table: each target, met or not, and the notes."""
    found = [f"{'met    ' if one['met'] else 'NOT MET'} {one['name']}: {show(one['value'])} "
             f"{one['unit']} (at most {show(one['limit'])})" for one in result.get("targets", [])]
    return found + list(result.get("notes", []))


def all_met(results: Iterable[Result]) -> bool:
    """Whether every target of every result is met."""
    return all(one["met"] for result in results for one in result.get("targets", []))
