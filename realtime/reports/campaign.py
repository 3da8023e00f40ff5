"""What a campaign showed: quantiles of every figure, the worst runs with the command that replays
each, and a page of distributions and of figures against what was varied."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.record import figures
from rollerrig.realtime.reports import page

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
_HEAD = ("figure", *(f"{100 * q:g} %" for q in QUANTILES))
_WORST = 5


def quantiles(table: pa.Table) -> list[tuple[str, list[float]]]:
    """Rows of (figure, its quantiles); figures that no run has are left out."""
    rows = []
    for name in figures.BY_NAME:
        values = table[name].to_numpy().astype(float)
        values = values[np.isfinite(values)]
        if values.size:
            rows.append((name, np.quantile(values, QUANTILES).tolist()))
    return rows


def worst(plan: campaign.Plan, table: pa.Table, figure: str) -> list[dict[str, Any]]:
    """The runs that have none of a figure (as those that did not stop), and those with the worst."""
    values = table[figure].to_numpy().astype(float)
    badness = np.where(np.isfinite(values), -(figures.BY_NAME[figure].better or -1) * values, np.inf)
    order = np.argsort(-badness, kind="stable")[:_WORST]
    runs = table["run"].to_numpy()
    return [{"run": int(runs[i]), figure: float(values[i]) if np.isfinite(values[i]) else None,
             "replay": campaign.command(plan, int(runs[i]))} for i in order]


def _cells(table: pa.Table) -> list[list[str]]:
    return [[name, *(f"{value:.4g}" for value in values)] for name, values in quantiles(table)]


def show(plan: campaign.Plan, table: pa.Table, figure: str, report: Path) -> None:
    """Print quantiles and worst cases."""
    console = Console()
    shown = Table(*_HEAD, title=plan.head["title"] or None)
    for row in _cells(table):
        shown.add_row(*row)
    console.print(shown)
    console.print(f"{table.num_rows} runs; the worst {figure}:")
    for case in worst(plan, table, figure):
        console.print(f"  run {case['run']}: {case[figure]}: {case['replay']}", highlight=False,
                      soft_wrap=True)
    console.print(f"report: {report}", highlight=False)


def write(plan: campaign.Plan, table: pa.Table, out: Path, figure: str) -> Path:
    """Write the page; returns its path."""
    path = out / "report.html"
    path.write_text(page.page(
        plan.head["title"] or "Campaign",
        page.paragraph(f"{table.num_rows} runs of {plan.head['scenario']}, {plan.head['design']} design over "
                       f"{', '.join(plan.axes)}."),
        page.table(_HEAD, _cells(table)),
        page.picture(lambda drawn: _distributions(drawn, plan, table), (11.0, 2.3 * len(quantiles(table)))),
        page.element("h2", f"Worst {figure}"),
        page.table(("run", figure, "to see it"), [
            (str(case["run"]), f"{case[figure]:.4g}" if case[figure] is not None else "not stopped",
             page.element("code", case["replay"])) for case in worst(plan, table, figure)])),
        encoding="utf-8")
    return path


def _distributions(drawn: Figure, plan: campaign.Plan, table: pa.Table) -> None:
    shown = [figures.BY_NAME[name] for name, _ in quantiles(table)]
    plots = drawn.subplots(len(shown), 1 + len(plan.axes), squeeze=False)
    for (counts, *others), figure in zip(plots, shown, strict=True):
        values = figure.scale * table[figure.name].to_numpy().astype(float)
        title = f"{figure.title}, {figure.unit}" if figure.unit else figure.title
        counts.hist(values[np.isfinite(values)], bins=40)
        counts.set(xlabel=title, ylabel="runs")
        for plot, key in zip(others, plan.axes, strict=True):
            plot.plot(table[key].to_numpy(), values, ".", markersize=3)
            plot.set(xlabel=key, ylabel=title)
