"""The form of a benchmark's result: figures, and targets for some of them.

A result is a plain table of numbers that is written to JSON as it is. Its `targets` are verdicts on
the project's own requirements, and its `notes` are lines of text. `put` writes what was printed
into a page of Markdown.
"""

import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

from rollerrig.configs import user_files
from rollerrig.configs.output_files import write_text, writing

Result = dict[str, Any]
Say = Callable[[str], None]
SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
QUANTILES = (*SHARES, "max")


def target(
    name: str, value: float | None, limit: float, unit: str = "", spread: float = 0.0
) -> Result:
    """Return a target: a figure, the limit that it must not exceed, and whether it is met.

    A figure that is unknown (None) does not meet its target. With a spread, the figure plus the
    spread must be within the limit.
    """
    result: Result = {"name": name, "value": value, "limit": limit, "unit": unit}
    if spread:
        result["spread"] = spread
    result["met"] = value is not None and value + spread <= limit
    return result


def quantiles(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Return p50, p99, p999 and max of some values, in their unit; empty without values."""
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    if not ordered.size:
        return {}
    result = {}
    for name, share in SHARES.items():
        at = min(int(share * ordered.size), ordered.size - 1)
        result[name] = float(ordered[at])
    result["max"] = float(ordered[-1])
    return result


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
    """Return a table of figures; the first column is left-justified."""
    shown = Table(title=title, title_justify="left")
    for column, head in enumerate(heads):
        shown.add_column(head, overflow="fold", justify="right" if column else "left")
    for row in rows:
        shown.add_row(*map(show, row))
    return shown


def show(value: object) -> str:
    """Return the text of a cell: four significant digits of a float, and a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def lines(result: Result) -> list[str]:
    """Return the lines below the table: each target, met or not, and the notes."""
    found = []
    for one in result.get("targets", []):
        verdict = "met    " if one["met"] else "NOT MET"
        spread = f"+- {one['spread']:.2g} " if "spread" in one else ""
        found.append(
            f"{verdict} {one['name']}: {show(one['value'])} {spread}{one['unit']} "
            f"(at most {show(one['limit'])})"
        )
    return found + list(result.get("notes", []))


def put(path: Path, name: str, command: str, shown: Table | Group, lines: Sequence[str]) -> None:
    """Replace the section `## NAME` of a page, or append it.

    The section has the machine, the command, the tables, and the lines below them. Raises
    ConfigError where the page cannot be written.
    """
    content = ["", machine(), "", f"    {command}", "", *_markdown(shown)]
    content += [f"- {line}" for line in lines]
    section = "\n".join([f"## {name}", *content]).rstrip()

    with writing(path, "give another file"):
        text = "# Performance\n"
        if path.exists():
            text = user_files.read_text(path, user_files.PAGE)
        head, *old_sections = text.rstrip().split("\n## ")
        sections = {}
        for old in old_sections:
            old_name = old.partition("\n")[0]
            sections[old_name] = f"## {old.rstrip()}"
        sections[name] = section
        write_text(path, "\n\n".join([head.rstrip(), *sections.values()]) + "\n")


def machine() -> str:
    """Return one sentence on the machine and the moment; it contains no host name."""
    model = platform.machine()
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith(("model name", "Model")):
            model = line.partition(":")[2].strip()
            break
    cores = len(os.sched_getaffinity(0))
    linux = platform.release().partition("-")[0]
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {cores} cores of {model}, Linux {linux}, "
        f"Python {platform.python_version()}; load average {os.getloadavg()[0]:.1f} at the end."
    )


def _markdown(shown: Table | Group) -> Iterator[str]:
    """Yield the lines of one or several tables as Markdown."""
    tables: Any = shown.renderables if isinstance(shown, Group) else [shown]
    for one in tables:
        columns = [[str(cell) for cell in column.cells] for column in one.columns]
        rows = [
            [str(column.header) for column in one.columns],
            ["---"] * len(one.columns),
            *zip(*columns, strict=True),
        ]
        yield f"**{one.title}**"
        yield ""
        for row in rows:
            yield f"| {' | '.join(row)} |"
        yield ""
