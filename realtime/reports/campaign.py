"""What a campaign showed: quantiles of every figure, the worst runs with the command that replays
each, and one self-contained page of distributions and of figures against what was varied."""

import html
import io
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.table import Table

from rollerrig.realtime.campaign import campaign

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
_WORST = 5


def _figures() -> list[str]:
    return [name for name, _ in campaign.FIGURES if name != "stopped"]


def quantiles(table: pa.Table) -> list[tuple[str, list[float]]]:
    """Rows of (figure, its quantiles); figures that no run has are left out."""
    rows = []
    for name in _figures():
        values = table[name].to_numpy().astype(float)
        values = values[np.isfinite(values)]
        if values.size:
            rows.append((name, np.quantile(values, QUANTILES).tolist()))
    return rows


def worst(plan: campaign.Plan, table: pa.Table, figure: str) -> list[dict[str, Any]]:
    """The runs with the largest figure, and those that did not stop, with their replay commands."""
    values = table[figure].to_numpy().astype(float)
    values = np.where(np.isfinite(values), values, np.inf)
    order = np.argsort(-values, kind="stable")[:_WORST]
    runs = table["run"].to_numpy()
    return [{"run": int(runs[i]), figure: None if np.isinf(values[i]) else float(values[i]),
             "replay": campaign.command(plan, int(runs[i]))} for i in order]


def show(plan: campaign.Plan, table: pa.Table, figure: str, report: Path) -> None:
    """Print quantiles and worst cases."""
    console = Console()
    shown = Table("figure", *(f"{100 * q:g} %" for q in QUANTILES), title=plan.head["title"] or None)
    for name, values in quantiles(table):
        shown.add_row(name, *(f"{value:.4g}" for value in values))
    console.print(shown)
    console.print(f"{table.num_rows} runs; the largest {figure}:")
    for row in worst(plan, table, figure):
        console.print(f"  run {row['run']}: {row[figure]}: {row['replay']}", highlight=False, soft_wrap=True)
    console.print(f"report: {report}", highlight=False)


def write(plan: campaign.Plan, table: pa.Table, out: Path, figure: str) -> Path:
    """Write the page; returns its path."""
    rows = "".join(f"<tr><td>{name}</td>" + "".join(f"<td>{value:.4g}</td>" for value in values) + "</tr>"
                   for name, values in quantiles(table))
    cases = "".join(f"<li>run {row['run']}: {row[figure]}<br><code>{html.escape(row['replay'])}</code></li>"
                    for row in worst(plan, table, figure))
    head = "".join(f"<th>{100 * q:g} %</th>" for q in QUANTILES)
    title = html.escape(plan.head["title"] or "Campaign")
    page = out / "report.html"
    page.write_text(
        f"<!doctype html><meta charset=utf-8><title>{title}</title><style>body{{font:15px sans-serif;"
        "max-width:70rem;margin:2rem auto}td,th{padding:.2rem .8rem;text-align:right}"
        "td:first-child{text-align:left}svg{max-width:100%;height:auto}</style>"
        f"<h1>{title}</h1><p>{table.num_rows} runs of {html.escape(plan.head['scenario'])}, "
        f"{plan.head['design']} design over {html.escape(', '.join(plan.axes))}.</p>"
        f"<table><tr><th>figure</th>{head}</tr>{rows}</table>{_plots(plan, table)}"
        f"<h2>Largest {figure}</h2><ol>{cases}</ol>", encoding="utf-8")
    return page


def _plots(plan: campaign.Plan, table: pa.Table) -> str:
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    parts = []
    for name, _ in quantiles(table):
        values = table[name].to_numpy().astype(float)
        figure, axes = pyplot.subplots(1, 1 + len(plan.axes), figsize=(3.4 * (1 + len(plan.axes)), 2.6),
                                       layout="constrained", squeeze=False)
        axes[0, 0].hist(values[np.isfinite(values)], bins=40, color="#56b4e9")
        axes[0, 0].set(xlabel=name, ylabel="runs")
        for at, key in enumerate(plan.axes, start=1):
            axes[0, at].plot(table[key].to_numpy(), values, ".", markersize=3, color="#0072b2")
            axes[0, at].set(xlabel=key, ylabel=name)
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg")
        pyplot.close(figure)
        parts.append(drawn.getvalue()[drawn.getvalue().index("<svg"):])
    return "".join(parts)
