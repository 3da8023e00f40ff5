"""The form of a benchmark's result: figures, and the targets that some of them have to meet.

A result is a plain table of numbers that goes into JSON as it stands; `targets` in it are verdicts against the
project's own requirements. `put` writes what was printed into a page of Markdown.
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

from rollerrig.realtime.record.files import writing

Result = dict[str, Any]
Say = Callable[[str], None]
SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
QUANTILES = (*SHARES, "max")


def target(
    name: str, value: float | None, limit: float, unit: str = "", spread: float = 0.0
) -> Result:
    """A requirement: a figure, the limit that it must not exceed, and whether it is known and within it.

    With a spread it is met only where the figure and the spread together are within the limit.
    """
    return {
        "name": name,
        "value": value,
        "limit": limit,
        "unit": unit,
        **({"spread": spread} if spread else {}),
        "met": value is not None and value + spread <= limit,
    }


def quantiles(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """p50, p99, p999 and max of some values, in their unit; empty where there are none."""
    found = np.sort(np.asarray(values, dtype=np.float64))
    if not found.size:
        return {}
    at = [min(int(share * found.size), found.size - 1) for share in SHARES.values()]
    return dict(zip(QUANTILES, map(float, found[[*at, -1]]), strict=True))


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
    """A table of figures."""
    shown = Table(title=title, title_justify="left")
    for at, head in enumerate(heads):
        shown.add_column(head, overflow="fold", justify="right" if at else "left")
    for row in rows:
        shown.add_row(*map(show, row))
    return shown


def show(value: object) -> str:
    """A cell: four significant digits for a number, a dash for nothing."""
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def lines(result: Result) -> list[str]:
    """What stands below the table: each target, met or not, and the notes."""
    found = []
    for one in result.get("targets", []):
        beside = f"+- {one['spread']:.2g} " if "spread" in one else ""
        found.append(
            f"{'met    ' if one['met'] else 'NOT MET'} {one['name']}: {show(one['value'])} {beside}"
            f"{one['unit']} (at most {show(one['limit'])})"
        )
    return found + list(result.get("notes", []))


def put(path: Path, name: str, command: str, shown: Table | Group, lines: Sequence[str]) -> None:
    """Replace (or append) the section `## NAME` of a page: machine, command, tables, what stands below.

    Raises ConfigError where it cannot be written.
    """
    section = "\n".join(
        [
            f"## {name}",
            "",
            machine(),
            "",
            f"    {command}",
            "",
            *_markdown(shown),
            *(f"- {line}" for line in lines),
        ]
    ).rstrip()
    with writing(path, "give another file"):
        text = path.read_text(encoding="utf-8") if path.exists() else "# Performance\n"
        head, *sections = text.rstrip().split("\n## ")
        kept = {one.partition("\n")[0]: f"## {one.rstrip()}" for one in sections} | {name: section}
        path.write_text("\n\n".join([head.rstrip(), *kept.values()]) + "\n", encoding="utf-8")


def machine() -> str:
    """The machine and the moment in a sentence; no name of a host."""
    model = next(
        (
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
            if line.startswith(("model name", "Model"))
        ),
        platform.machine(),
    )
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {len(os.sched_getaffinity(0))} cores of {model}, Linux "
        f"{platform.release().partition('-')[0]}, Python {platform.python_version()}; load average "
        f"{os.getloadavg()[0]:.1f} at the end."
    )


def _markdown(shown: Table | Group) -> Iterator[str]:
    tables: Any = shown.renderables if isinstance(shown, Group) else [shown]
    for one in tables:
        rows = [
            [str(column.header) for column in one.columns],
            ["---"] * len(one.columns),
            *zip(*(map(str, column.cells) for column in one.columns), strict=True),
        ]
        yield from (f"**{one.title}**", "", *(f"| {' | '.join(row)} |" for row in rows), "")
