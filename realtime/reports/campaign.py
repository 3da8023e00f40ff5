"""What a campaign showed: quantiles of every figure, the worst runs with the command that replays
each, and a page of them, a map over the two inputs that matter most, distributions and figures against what was varied.
"""

import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from rollerrig.realtime.campaign import campaign, stopping
from rollerrig.realtime.record import figures
from rollerrig.realtime.reports import page, pdf

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
HEAD = ("figure", *(f"{100 * q:g} %" for q in QUANTILES))
_WORST = 5


def quantiles(table: pa.Table) -> list[tuple[str, list[float]]]:
    """Rows of (figure, its quantiles); figures that no run has are left out."""
    known = (
        (name, values[np.isfinite(values)])
        for name in figures.BY_NAME
        for values in [table[name].to_numpy().astype(float)]
    )
    return [
        (name, np.quantile(values, QUANTILES).tolist()) for name, values in known if values.size
    ]


def worst(plan: campaign.Plan, table: pa.Table, figure: str) -> list[dict[str, Any]]:
    """The runs that have none of a figure, and those with the worst, of all but those that are not valid."""
    table = table.filter(table["invalid_because"].is_null())
    values = table[figure].to_numpy().astype(float)
    badness = np.where(
        np.isfinite(values), -(figures.BY_NAME[figure].better or -1) * values, np.inf
    )
    order = np.argsort(-badness, kind="stable")[:_WORST]
    runs = table["run"].to_numpy()
    return [
        {
            "run": int(runs[i]),
            figure: float(values[i]) if np.isfinite(values[i]) else None,
            "replay": campaign.command(plan, int(runs[i])),
        }
        for i in order
    ]


def not_valid(plan: campaign.Plan, table: pa.Table) -> list[dict[str, Any]]:
    """The runs that are not valid: they count in no figure."""
    return [
        {"run": run, "because": why, "replay": campaign.command(plan, run)}
        for run, why in zip(
            table["run"].to_pylist(), table["invalid_because"].to_pylist(), strict=True
        )
        if why
    ]


def cells(table: pa.Table) -> list[list[str]]:
    """Rows under `HEAD`, the last one with the number of runs that are not valid."""
    left_out = table.num_rows - table["invalid_because"].null_count
    return [
        *([name, *(f"{value:.4g}" for value in values)] for name, values in quantiles(table)),
        ["not valid (runs, left out)", str(left_out), *[""] * (len(QUANTILES) - 1)],
    ]


def write(
    plan: campaign.Plan, table: pa.Table, out: Path, figure: str, on_paper: bool = False
) -> Path:
    """Write the page, and as PDF too where it shall be `on_paper`; returns its path. Raises OSError."""
    path = out / "report.html"
    path.write_text(_page(plan, table, figure), encoding="utf-8")
    if on_paper:
        with page.on_paper():
            pdf.write(_page(plan, table, figure), path.with_suffix(".pdf"))
    return path


def _page(plan: campaign.Plan, table: pa.Table, figure: str) -> str:
    left_out, varied = not_valid(plan, table), _varied(plan, table)
    shown = [one for one in quantiles(table) if one[1][0] < one[1][-1]]
    same = [
        f"{_title(name)} {figures.BY_NAME[name].scale * values[0]:.4g}"
        for name, values in quantiles(table)
        if values[0] == values[-1]
    ]
    inputs, cases = (
        {run: at for at, run in enumerate(table["run"].to_pylist())},
        worst(plan, table, figure),
    )
    pair = _pair(plan, table, varied, figure)
    return page.page(
        plan.head["title"] or "Campaign",
        page.paragraph(
            f"{table.num_rows} runs of {plan.head['scenario']}, {plan.head['design']} design over "
            f"{', '.join(plan.axes)}; {len(left_out)} of them not valid and left out."
        ),
        page.element("h2", f"Worst {_title(figure)}"),
        page.table(
            ("run", _title(figure), *plan.axes, "to see it"),
            [
                (
                    str(case["run"]),
                    read(figure, case[figure]),
                    *(_input(table[key][inputs[case["run"]]].as_py()) for key in plan.axes),
                    page.element("code", case["replay"]),
                )
                for case in cases
            ],
        ),
        *(
            [page.picture(lambda drawn: _map(drawn, table, pair, figure), (8.0, 4.6))]
            if pair
            else []
        ),
        *_stopping(plan, table),
        page.element("h2", "All figures"),
        page.table(HEAD, cells(table)),
        *([page.paragraph(f"The same in every run: {', '.join(same)}.")] if same else []),
        *(
            [
                page.picture(
                    lambda drawn: _distributions(drawn, varied, table, [name for name, _ in shown]),
                    (11.0, 2.3 * len(shown)),
                )
            ]
            if shown
            else []
        ),
        page.element("h2", f"Not valid: {len(left_out)} of {table.num_rows} runs"),
        page.table(
            ("run", "why", "to see it"),
            [
                (str(one["run"]), one["because"], page.element("code", one["replay"]))
                for one in left_out
            ],
        ),
    )


def _title(name: str) -> str:
    figure = figures.BY_NAME[name]
    return f"{figure.title}, {figure.unit}" if figure.unit else figure.title


def read(name: str, value: float | None) -> str:
    """A figure as it is read: four digits in its unit; a run without has not stopped."""
    return "not stopped" if value is None else f"{figures.BY_NAME[name].scale * value:.4g}"


def _input(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _varied(plan: campaign.Plan, table: pa.Table) -> list[str]:
    """The inputs that have more than one value."""
    return [key for key in plan.axes if len(table[key].unique()) > 1]


def _pair(
    plan: campaign.Plan, table: pa.Table, varied: list[str], figure: str
) -> tuple[str, str] | None:
    """The two inputs, of numbers, on which a figure depends most; None where there are not two."""
    values = table[figure].to_numpy().astype(float)
    known = np.isfinite(values)
    numbers = [
        key
        for key in varied
        if pa.types.is_integer(table[key].type) or pa.types.is_floating(table[key].type)
    ]
    if len(numbers) < 2 or known.sum() < 3:
        return None
    inputs = (table[key].to_numpy() for key in numbers)
    order, *ranks = (np.argsort(np.argsort(one[known])) for one in (values, *inputs))
    first, second = sorted(
        range(len(numbers)), key=lambda at: -abs(np.corrcoef(order, ranks[at])[0, 1])
    )[:2]
    return numbers[first], numbers[second]


def _map(drawn: Figure, table: pa.Table, pair: tuple[str, str], figure: str) -> None:
    """Every run at its two inputs, its figure as colour; crosses are runs without one."""
    across, up = (table[key].to_numpy().astype(float) for key in pair)
    values = figures.BY_NAME[figure].scale * table[figure].to_numpy().astype(float)
    known, plot = np.isfinite(values), drawn.subplots()
    drawn.colorbar(
        plot.scatter(across[known], up[known], c=values[known], cmap="cividis", s=26),
        ax=plot,
        label=_wrapped(_title(figure), 34),
    )
    plot.plot(across[~known], up[~known], "x", color=page.VERMILION)
    plot.set(xlabel=pair[0], ylabel=_wrapped(pair[1], 40))


def _wrapped(name: str, width: int = 24) -> str:
    """A name on as many lines as it needs."""
    return (
        "\n".join(textwrap.wrap(name.replace(".", ". ").replace("_", "_ "), width))
        .replace(". ", ".")
        .replace("_ ", "_")
    )


def _distributions(drawn: Figure, varied: list[str], table: pa.Table, names: list[str]) -> None:
    plots = drawn.subplots(len(names), 1 + len(varied), squeeze=False)
    for (counts, *others), name in zip(plots, names, strict=True):
        values = figures.BY_NAME[name].scale * table[name].to_numpy().astype(float)
        counts.hist(values[np.isfinite(values)], bins=40)
        counts.set(xlabel=_wrapped(_title(name)), ylabel="runs")
        for plot, key in zip(others, varied, strict=True):
            plot.plot(table[key].to_numpy(), values, ".", markersize=3)
            plot.set(xlabel=_wrapped(key), ylabel=_wrapped(_title(name)))


def _stopping(plan: campaign.Plan, table: pa.Table) -> list[page.Markup]:
    """The stopping distance's part of the page; none of a matrix, which is no sample, nor of too few runs."""
    counts, distance_m = stopping.counted(table)
    if plan.head["design"] == "matrix" or distance_m.size < stopping.FEWEST:
        return []
    percent, left_out = f"{100 * stopping.CONFIDENCE:g} %", int((~counts).sum())
    even = (
        ""
        if plan.head["design"] == "random"
        else (
            f" A {plan.head['design']} design fills its ranges more evenly than the independent draws that the bounds "
            'are for: take them for orientation, and design = "random" for a statement.'
        )
    )
    rows = [
        (
            f"{100 * one['quantile']:g} %",
            _shown(one["estimate_m"]),
            _shown(one["bound_m"]) if one["rank"] else f"needs {one['needs']} runs",
            str(one["rank"] or "-"),
        )
        for one in stopping.bounds(table)
    ]
    noise = 1.96 / math.sqrt(max(distance_m.size - 1, 1))
    return [
        page.element("h2", "Stopping distance"),
        page.paragraph(
            f"{distance_m.size} runs count; {int(np.isinf(distance_m).sum())} of them had not stopped when "
            "their time was up and are longer than any. "
            f"{left_out} more failed or are not valid and count nowhere."
            f"{even} This is not a certificate: it says what this plant did over the ranges of this plan, "
            "as often as their values were drawn, and nothing of how often a railway meets them.",
            kind="note",
        ),
        page.table(
            (
                "quantile",
                "estimate, m",
                f"bound with a confidence of {percent}, m",
                "rank of the bound",
            ),
            rows,
        ),
        page.table(
            (
                "input",
                "rank correlation with the distance",
                f"of the longest {100 * stopping.TAIL:g} % against the rest",
            ),
            [
                (key, f"{whole:+.2f}", f"{tail:+.2f}")
                for key, whole, tail in stopping.drivers(plan, table)
            ],
        ),
        page.paragraph(
            f"Without any dependence a correlation of {distance_m.size} runs is within {noise:.2f} of 0 in "
            "19 of 20 campaigns."
        ),
        page.picture(lambda drawn: _exceedance(drawn, table), (11.0, 3.6)),
    ]


def _shown(value_m: float | None) -> str:
    return "not stopped" if value_m is None else f"{value_m:.1f}"


def _exceedance(drawn: Figure, table: pa.Table) -> None:
    distance_m = np.sort(stopping.counted(table)[1])
    stopped_m = distance_m[np.isfinite(distance_m)]
    counts, exceeded = drawn.subplots(1, 2)
    counts.hist(stopped_m, bins=40)
    counts.set(xlabel="stop distance, m", ylabel="runs")
    exceeded.step(stopped_m, 1.0 - np.arange(1, stopped_m.size + 1) / distance_m.size, where="post")
    for one in stopping.bounds(table):
        if one["bound_m"] is not None:
            exceeded.plot(one["bound_m"], 1.0 - one["quantile"], "v", color=page.VERMILION)
    exceeded.set(
        xlabel="stop distance, m (triangles: bounds)",
        ylabel="share of runs that go further",
        yscale="log",
        ylim=(0.5 / distance_m.size, 1.1),
    )
