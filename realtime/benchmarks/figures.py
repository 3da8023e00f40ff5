"""The form of a benchmark's result: figures, and the targets that some of them have to meet.

A result is a plain table of numbers that goes into JSON as it stands; `targets` is the list of
verdicts in it, against the project's own requirements. `put` writes what was printed into a page of Markdown.
"""

import argparse
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Group
from rich.table import Table

from rollerrig.configs.errors import ConfigError

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


def put(path: Path, name: str, command: str, shown: Table | Group, lines: Sequence[str]) -> None:
    """Replace (or append) the section `## NAME` of a page: machine, command, tables, what stands below.

    Raises ConfigError where it cannot be written.
    """
    below = [f"- {line}" for line in lines]
    section = "\n".join([f"## {name}", "", machine(), "", f"    {command}", "", *_tables(shown), *below]).rstrip()
    try:
        text = path.read_text(encoding="utf-8") if path.exists() else "# Performance\n"
        head, *sections = text.rstrip().split("\n## ")
        kept = {one.partition("\n")[0]: f"## {one.rstrip()}" for one in sections} | {name: section}
        path.write_text("\n\n".join([head.rstrip(), *kept.values()]) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; give another file") from None


def machine() -> str:
    """The machine and the moment in a sentence; no name of a host."""
    model = next((line.partition(":")[2].strip() for line in
                  Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
                  if line.startswith(("model name", "Model"))), platform.machine())
    return (f"{datetime.now(UTC):%Y-%m-%d}, {len(os.sched_getaffinity(0))} cores of {model}, Linux "
            f"{platform.release().partition('-')[0]}, Python {platform.python_version()}; load average "
            f"{os.getloadavg()[0]:.1f} at the end.")


def _tables(shown: Any) -> Iterator[str]:
    """Tables as lines of Markdown."""
    if isinstance(shown, Group):
        for one in shown.renderables:
            yield from _tables(one)
        return
    yield from (f"**{shown.title}**", "")
    rows = [[str(column.header) for column in shown.columns], ["---"] * len(shown.columns),
            *zip(*(map(str, column.cells) for column in shown.columns), strict=True)]
    yield from (f"| {' | '.join(row)} |" for row in rows)
    yield ""
