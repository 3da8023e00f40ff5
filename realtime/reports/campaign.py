"""The report of a campaign: quantiles, the worst runs with the command that replays each, and a
page.

The page begins with a title block and the stopping distance with its bounds. It has the ranges of
the inputs, a map over the two inputs that matter most, distributions, figures against what was
varied, and room to sign.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rollerrig.configs.number_text import rounded
from rollerrig.configs.output_files import write_text
from rollerrig.realtime.campaign import campaign, stopping
from rollerrig.realtime.campaign.outcome import QUANTILES, Outcome
from rollerrig.realtime.campaign.statistics import draws, strata
from rollerrig.realtime.record import figures, played
from rollerrig.realtime.reports import page, pdf
from rollerrig.realtime.reports.statistics import failures, tail
from rollerrig.wsp_interface.sequences.verdict import DISCLAIMER

HEAD = ("figure", *(f"{100 * q:g} %" for q in QUANTILES))

_RANGES_HEAD = ("input", "from", "to", "spread", "key")

# a name that is not longer is a symbol
_SYMBOL = 5

# figures that every case of the list of the worst has
DISTANCES = ("braking_distance_m", "stop_distance_m")

# runs in the list of the worst
_WORST = 5

# runs with a figure. With fewer a rank correlation shows nothing.
_LEAST_RUNS = 3

# units at the end of the names of inputs
_UNITS = {
    "m_s2": "m/s²",
    "rad_s": "rad/s",
    "m_s": "m/s",
    "kgm2": "kg m²",
    "Nm": "N m",
    "kg": "kg",
    "Pa": "Pa",
    "Hz": "Hz",
    "N": "N",
    "m": "m",
    "s": "s",
    "K": "K",
    "L": "L",
}

# the axis of probabilities ends here, or at a rarer stop
_LEAST_SHOWN = 1e-4

# inputs against which every figure is drawn: those that matter most
_MOST_DRAWN = 3

# columns of inputs in the list of the worst; if there are more, each run has the inputs in a line
_MOST_COLUMNS = 5

# standard errors of a 95 % interval
_NORMAL_95 = 1.96


def _values(table: pa.Table, column: str) -> np.ndarray:
    """Return a column as numbers (n,)."""
    return table[column].to_numpy().astype(float)


def worst(plan: campaign.Plan, rows: pa.Table, figure: str) -> list[dict[str, Any]]:
    """Return the valid runs that do not have a figure, then those with the worst one."""
    valid = rows.filter(rows["invalid_because"].is_null())
    values = _values(valid, figure)
    # a figure without a better direction is worst where it is largest
    sign = -(figures.BY_NAME[figure].better or -1)
    badness = np.where(np.isfinite(values), sign * values, np.inf)
    order = np.argsort(-badness, kind="stable")[:_WORST]
    runs = valid["run"].to_numpy()

    cases = []
    for i in order:
        run = int(runs[i])
        value = _known(values[i])
        case: dict[str, Any] = {"run": run, figure: value}
        for distance in DISTANCES:
            case.setdefault(distance, _known(valid[distance][int(i)].as_py()))
        cases.append(case | {"replay": campaign.command(plan, run)})
    return cases


def _known(value: float | None) -> float | None:
    """Return a number, or None if it is missing or not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def not_valid(plan: campaign.Plan, outcome: Outcome) -> list[dict[str, Any]]:
    """Return the runs that are not valid; no figure includes them.

    A large campaign lists only the first ones.
    """
    runs = outcome.invalid["run"].to_pylist()
    reasons = outcome.invalid["invalid_because"].to_pylist()
    return [
        {"run": run, "because": reason, "replay": campaign.command(plan, run)}
        for run, reason in zip(runs, reasons, strict=True)
        if reason
    ]


def warnings(outcome: Outcome) -> list[str]:
    """Return what was planned but did not happen, once each, with the number of its runs."""
    return [f"{text} ({count} of {outcome.runs} runs)" for text, count in outcome.warnings.items()]


def step(plan: campaign.Plan, outcome: Outcome) -> str:
    """Return a sentence on the step of the stops, and on those that ran again; "" without any."""
    again, missed = outcome.again
    if not again:
        return ""
    return (
        f"stops have steps of {1e3 * plan.head[campaign.STEP]:g} ms; {again} of the longest ran "
        "again with the step of the scenario, and their stopping distances had differed by at most "
        f"{100 * missed:.2g} %"
    )


def cells(outcome: Outcome) -> list[list[str]]:
    """Return rows under `HEAD`; the last one has the number of runs that are not valid."""
    rows = []
    for name, values in outcome.quantiles:
        scale = figures.BY_NAME[name].scale
        rows.append([_title(name), *(rounded(scale * value) for value in values)])
    empty = [""] * (len(QUANTILES) - 1)
    rows.append(["not valid (runs, left out)", str(outcome.not_valid), *empty])
    return rows


def write(
    plan: campaign.Plan,
    outcome: Outcome,
    out: Path,
    figure: str,
    on_paper: bool = False,
    about: Mapping[str, str] | None = None,
) -> Path:
    """Write the page, also as PDF if `on_paper`, and return its path. Raises OSError.

    `about` are entries of the title block: the document number, who tested, and so on.
    """
    path = out / "report.html"
    when = datetime.now(UTC)
    write_text(path, _page(plan, outcome, figure, when, about or {}))
    if on_paper:
        with page.on_paper():
            pdf.write(_page(plan, outcome, figure, when, about or {}), path.with_suffix(".pdf"))
    return path


def _title_block(
    plan: campaign.Plan, outcome: Outcome, when: datetime, about: Mapping[str, str]
) -> dict[str, str]:
    """Return what was tested, with which plan, and when."""
    seed = "" if plan.head["design"] == "matrix" else f", seed {plan.head['seed']}"
    recorded = {
        played.UNIT_PLAYED: played.words(played.unit_of(plan.head["unit"])),
        "scenario": Path(plan.head["scenario"]).stem,
        "design": f"{plan.head['design']}{seed}",
        "runs": f"{outcome.runs}, of which {outcome.not_valid} are not valid and left out",
        "date": f"{when:%Y-%m-%d %H:%M} UTC",
        "tested with": f"rollerrig {metadata.version('rollerrig')}",
    }
    return page.title_block(about, recorded)


def contradictions(plan: campaign.Plan, about: Mapping[str, str]) -> list[str]:
    """Return a warning where --about names another unit than that of the plan."""
    return played.contradictions([played.unit_of(plan.head["unit"])], about)


def input_title(key: str) -> str:
    """Return the name of a varied input as words, with its unit."""
    table, _, name = key.rpartition(".")
    unit = ""
    for suffix, shown in _UNITS.items():
        if name.endswith(f"_{suffix}"):
            name = name.removesuffix(f"_{suffix}")
            unit = shown
            break
    # a symbol such as mu_cd is no word
    words = name if len(name) <= _SYMBOL else name.replace("_", " ")
    title = f"{table.replace('_', ' ')}: {words}" if table else words
    return f"{title}, {unit}" if unit else title


def _range_rows(plan: campaign.Plan) -> list[tuple[str, ...]]:
    """Return, for each input, its key, what it is, the lowest and highest value, and how drawn."""
    rows: list[tuple[str, ...]] = []
    components = failure_columns(plan)
    for at, key in enumerate(plan.axes):
        if key in components:
            # the part on failures has them
            continue
        if at < len(plan.ranges):
            span = plan.ranges[at]
            spread = span["law"]
            low, high = _input(span["low"]), _input(span["high"])
        else:
            values = list(dict.fromkeys(point[at] for point in plan.points))
            spread = f"{len(values)} listed values"
            low, high = _input(values[0]), _input(values[-1])
        rows.append((input_title(key), low, high, spread, page.element("code", key)))
    return rows


def _page(
    plan: campaign.Plan, outcome: Outcome, figure: str, when: datetime, about: Mapping[str, str]
) -> str:
    table = outcome.rows
    left_out = not_valid(plan, outcome)
    varied = _varied(plan, table)
    all_quantiles = outcome.quantiles
    # figures that differ between runs are drawn, the others are listed
    differing = [name for name, values in all_quantiles if values[0] < values[-1]]
    # stable: the stopping distance first, then in the order of the table
    differing.sort(key=lambda name: name != DISTANCES[0])
    constant = [
        f"{_title(name)} {rounded(figures.BY_NAME[name].scale * values[0])}"
        for name, values in all_quantiles
        if values[0] == values[-1]
    ]

    parts: list[str] = [
        page.facts(_title_block(plan, outcome, when, about)),
        page.paragraph(
            page.element("b", f"{DISCLAIMER.capitalize()}."),
            " Simulated rig and vehicle.",
            kind="note",
        ),
        *(
            page.paragraph(f"Warning: {text}", kind="note")
            for text in (*contradictions(plan, about), *warnings(outcome))
        ),
        *_kept(outcome),
        *_stopping(plan, outcome),
        *failures.parts(plan, outcome),
        page.element("h2", "What was varied"),
        page.table(_RANGES_HEAD, _range_rows(plan)),
        page.element("h2", f"Worst {_title(figure)}"),
        *_worst_parts(plan, outcome, figure),
    ]
    pair = _pair(table, varied, figure)
    if pair is not None:
        draw = partial(_draw_map, plan=plan, table=table, pair=pair, figure=figure)
        parts.append(page.picture(draw, (11.0, 5.0)))
    parts += tail.parts(plan, outcome)

    parts += [page.element("h2", "All figures"), page.table(HEAD, cells(outcome))]
    if sentence := step(plan, outcome):
        parts.append(page.paragraph(f"{sentence[0].upper()}{sentence[1:]}."))
    if constant:
        parts.append(page.paragraph(f"The same in every run: {', '.join(constant)}."))
    if differing:
        drawn = _most_important(table, varied, figure)
        if len(drawn) < len(varied):
            parts.append(
                page.paragraph(
                    f"Each figure is drawn against the {len(drawn)} inputs that correlate most with "
                    f"the {figures.BY_NAME[figure].title}."
                )
            )
        draw = partial(_draw_distributions, plan=plan, varied=drawn, table=table, names=differing)
        parts.append(page.picture(draw, (11.0, 2.3 * len(differing))))

    rows = [
        (str(case["run"]), case["because"], page.element("code", case["replay"]))
        for case in left_out
    ]
    parts += [
        page.element("h2", f"Not valid: {outcome.not_valid} of {outcome.runs} runs"),
        page.table(("run", "why", "to see it"), rows),
        page.signatures(about),
    ]
    return page.page(plan.head["title"] or "Campaign", *parts)


def _kept(outcome: Outcome) -> list[page.Markup]:
    """Return what of a large campaign the page is made of; nothing if it has all rows."""
    if outcome.has_all_rows:
        return []
    return [
        page.paragraph(
            f"This campaign keeps no rows of all runs. Quantiles are from sketches (within "
            f"{100 * draws.ACCURACY:g} %), bounds and the law of the tail from the "
            f"{outcome.longest.num_rows} longest stops, pictures and correlations from the first "
            f"{outcome.rows.num_rows} runs.",
            kind="note",
        )
    ]


def _worst_parts(plan: campaign.Plan, outcome: Outcome, figure: str) -> list[page.Markup]:
    """Return the table of the worst runs with their inputs, and the command that repeats each."""
    table = outcome.longest
    row_of_run = {run: row for row, run in enumerate(table["run"].to_pylist())}
    titles = [input_title(key) for key in plan.axes]
    has_columns = len(titles) <= _MOST_COLUMNS
    rows = []
    commands = []
    for case in worst(plan, table, figure):
        row = row_of_run[case["run"]]
        inputs = [_input(table[key][row].as_py()) for key in plan.axes]
        if not has_columns:
            pairs = zip(titles, inputs, strict=True)
            inputs = ["; ".join(f"{title} {value}" for title, value in pairs)]
        rows.append((str(case["run"]), read(figure, case[figure]), *inputs))
        commands.append((str(case["run"]), page.element("code", case["replay"])))
    heads = titles if has_columns else ["inputs"]
    return [
        page.table(("run", _title(figure), *heads), rows),
        page.table(("run", "to see it"), commands),
    ]


def _title(name: str) -> str:
    figure = figures.BY_NAME[name]
    return f"{figure.title}, {figure.unit}" if figure.unit else figure.title


def read(name: str, value: float | None) -> str:
    """Return a figure for a reader: four digits in its unit; "not stopped" if the run has none."""
    return "not stopped" if value is None else rounded(figures.BY_NAME[name].scale * value)


def read_with_unit(name: str, value: float | None) -> str:
    """Return a figure as `read` does, with its unit if it has one."""
    text = read(name, value)
    unit = figures.BY_NAME[name].unit
    return f"{text} {unit}" if unit and value is not None else text


def _input(value: Any) -> str:
    if isinstance(value, float):
        return rounded(value)
    return "none" if value == "" else str(value)


def _varied(plan: campaign.Plan, table: pa.Table) -> list[str]:
    """Return the inputs that have more than one value."""
    components = failure_columns(plan)
    keys = [key for key in plan.axes if key not in components]
    return [key for key in keys if len(table[key].unique()) > 1]


def failure_columns(plan: campaign.Plan) -> set[str]:
    """Return the columns that have the failed components of a run."""
    return {failure.column for failure in plan.applied.failures} if plan.applied else set()


def _pair(table: pa.Table, varied: Sequence[str], figure: str) -> tuple[str, str] | None:
    """Return the two numeric inputs on which a figure depends most; None if there are not two."""
    numeric = [key for key in varied if _is_numeric(table, key)]
    known = np.isfinite(_values(table, figure))
    if len(numeric) < 2 or known.sum() < _LEAST_RUNS:
        return None
    first, second, *_ = _by_correlation(table, numeric, figure)
    return first, second


def _is_numeric(table: pa.Table, key: str) -> bool:
    kind = table[key].type
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _most_important(table: pa.Table, varied: Sequence[str], figure: str) -> list[str]:
    """Return the inputs on which a figure depends most, in the order of the plan."""
    if len(varied) <= _MOST_DRAWN:
        return list(varied)
    words = [key for key in varied if not _is_numeric(table, key)]
    numeric = [key for key in varied if key not in words]
    if np.isfinite(_values(table, figure)).sum() >= _LEAST_RUNS:
        numeric = _by_correlation(table, numeric, figure)
    # an input of words has no rank, and may matter most
    chosen = [*words, *numeric][:_MOST_DRAWN]
    return [key for key in varied if key in chosen]


def _by_correlation(table: pa.Table, numeric: Sequence[str], figure: str) -> list[str]:
    """Return numeric inputs, that with the largest rank correlation with a figure first."""
    values = _values(table, figure)
    known = np.isfinite(values)

    def ranks(column: np.ndarray) -> np.ndarray:
        return np.argsort(np.argsort(column[known]))

    ranks_of_figure = ranks(values)
    correlation = {}
    for key in numeric:
        ranks_of_input = ranks(table[key].to_numpy())
        correlation[key] = abs(np.corrcoef(ranks_of_figure, ranks_of_input)[0, 1])
    return sorted(numeric, key=lambda key: -correlation[key])


def _draw_map(
    drawn: Figure, plan: campaign.Plan, table: pa.Table, pair: tuple[str, str], figure: str
) -> None:
    """Draw every run at its two inputs, with its figure as colour, and the ranges of the plan.

    Crosses are runs without a figure.
    """
    across_key, up_key = pair
    across = _values(table, across_key)
    up = _values(table, up_key)
    values = figures.BY_NAME[figure].scale * _values(table, figure)
    known = np.isfinite(values)

    plot = drawn.subplots()
    points = plot.scatter(across[known], up[known], c=values[known], cmap="cividis", s=26)
    drawn.colorbar(points, ax=plot, label=_wrapped(_title(figure), 34))
    plot.plot(
        across[~known], up[~known], "x", color=page.VERMILION, label="did not stop, or not valid"
    )
    plot.set(xlabel=input_title(across_key), ylabel=_wrapped(input_title(up_key), 40))
    across_span, up_span = (_drawn_range(plan, key) for key in pair)
    corner = (across_span[0], up_span[0])
    width = across_span[1] - across_span[0]
    height = up_span[1] - up_span[0]
    plot.add_patch(
        Rectangle(
            corner, width, height, fill=False, ls="--", ec=page.GREY, label="range of the plan"
        )
    )
    plot.autoscale_view()
    if _is_logarithmic(plan, across_key):
        plot.set_xscale("log")
        page.plain_logarithm(plot.xaxis)
    if _is_logarithmic(plan, up_key):
        plot.set_yscale("log")
        page.plain_logarithm(plot.yaxis)
    drawn.legend(loc="outside upper center", ncols=2)


def _drawn_range(plan: campaign.Plan, key: str) -> tuple[float, float]:
    """Return the lowest and the highest value that a plan gives a numeric input."""
    at = plan.axes.index(key)
    if at < len(plan.ranges):
        return plan.ranges[at]["low"], plan.ranges[at]["high"]
    values = [point[at] for point in plan.points]
    return min(values), max(values)


def _is_logarithmic(plan: campaign.Plan, key: str) -> bool:
    """Return whether an input is spread evenly in its logarithm."""
    at = plan.axes.index(key)
    return at < len(plan.ranges) and bool(plan.ranges[at]["log"])


def _wrapped(name: str, width: int = 24) -> str:
    """Return a name on as many lines as it needs; it may break after a dot or an underscore."""
    spaced = name.replace(".", ". ").replace("_", "_ ")
    lines = "\n".join(textwrap.wrap(spaced, width))
    return lines.replace(". ", ".").replace("_ ", "_")


def _draw_distributions(
    drawn: Figure,
    plan: campaign.Plan,
    varied: Sequence[str],
    table: pa.Table,
    names: Sequence[str],
) -> None:
    """Draw, for each figure, its distribution and its values against each varied input.

    Dashed lines are the ends of the range of an input.
    """
    plots = drawn.subplots(len(names), 1 + len(varied), squeeze=False)
    for (counts, *others), name in zip(plots, names, strict=True):
        values = figures.BY_NAME[name].scale * _values(table, name)
        counts.hist(values[np.isfinite(values)], bins=40)
        counts.set(xlabel=_wrapped(_title(name)), ylabel="runs")
        for plot, key in zip(others, varied, strict=True):
            plot.plot(table[key].to_numpy(), values, ".", markersize=3)
            plot.set(xlabel=_wrapped(input_title(key)), ylabel=_wrapped(_title(name)))
            if isinstance(plan.points[0][plan.axes.index(key)], int | float):
                for end in _drawn_range(plan, key):
                    plot.axvline(end, ls="--", lw=0.8, color=page.GREY)
            if _is_logarithmic(plan, key):
                plot.set_xscale("log")
                page.plain_logarithm(plot.xaxis)


# --- stopping distance ---


def _stopping(plan: campaign.Plan, outcome: Outcome) -> list[page.Markup]:
    """Return the part of the page about the stopping distance.

    It is empty for a matrix, which is not a sample, and for too few runs.
    """
    distance_m = outcome.distance_m
    if plan.head["design"] == "matrix" or distance_m.size < stopping.FEWEST:
        return []

    confidence = f"{100 * stopping.CONFIDENCE:g} %"
    if isinstance(distance_m, strata.Sample):
        return _stopping_in_strata(outcome, distance_m, confidence)
    correlated = outcome.rows.num_rows if not outcome.has_all_rows else distance_m.size
    noise = _NORMAL_95 / math.sqrt(max(correlated - 1, 1))
    drivers = [
        (input_title(key), f"{whole:+.2f}", f"{tail:+.2f}")
        for key, whole, tail in stopping.drivers(plan, outcome.rows)
    ]
    return [
        page.element("h2", "Stopping distance"),
        page.paragraph("It counts from the first brake demand to standstill."),
        page.paragraph(_stopping_words(plan.head["design"], outcome), kind="note"),
        page.table(
            (
                "quantile",
                "estimate, m",
                f"bound with a confidence of {confidence}, m",
                "rank of the bound",
            ),
            [_bound_row(bound) for bound in stopping.bounds(distance_m)],
        ),
        page.table(
            (
                "input",
                "rank correlation with the distance",
                f"of the longest {100 * stopping.TAIL:g} % against the rest",
            ),
            drivers,
        ),
        page.paragraph(
            f"Without any dependence a correlation of {correlated} runs is within {noise:.2f} of 0 in "
            "19 of 20 campaigns."
        ),
        page.picture(partial(_draw_exceedance, outcome=outcome), (11.0, 3.6)),
    ]


def _stopping_in_strata(
    outcome: Outcome, distance_m: strata.Sample, confidence: str
) -> list[page.Markup]:
    """Return the part about the stopping distance of a stratified design."""
    rows = []
    for bound in stopping.bounds(distance_m):
        share = 1.0 - bound["quantile"]
        error = bound["probability_error"]
        rows.append(
            (
                failures.percent(bound["quantile"]),
                _metres(bound["estimate_m"]),
                "-" if error is None else f"{100 * error / share:.1f} %",
                "needs more runs" if bound["bound_m"] is None else _metres(bound["bound_m"]),
            )
        )
    return [
        page.element("h2", "Stopping distance"),
        page.paragraph("It counts from the first brake demand to standstill."),
        page.paragraph(
            f"{distance_m.size} runs in {len(distance_m.strata)} strata; each run counts by the "
            f"probability of its stratum. {outcome.not_stopped} runs had not stopped at the end of "
            f"their time and count as longer than any other. {outcome.uncounted} more failed or are "
            "not valid and do not count. This is not a certificate: it shows what this plant did with "
            "the laws and failures of this plan.",
            kind="note",
        ),
        page.table(
            (
                "quantile",
                "estimate, m",
                "relative standard error of the probability of a longer stop",
                f"bound with a confidence of {confidence}, m",
            ),
            rows,
        ),
        page.picture(partial(_draw_exceedance, outcome=outcome), (11.0, 3.6)),
    ]


def _stopping_words(design: str, outcome: Outcome) -> str:
    even = ""
    if design != "random":
        even = (
            f" A {design} design fills its ranges more evenly than independent draws, for which the "
            'bounds are made: use them for orientation, and design = "random" for a statement.'
        )
    return (
        f"{outcome.distance_m.size} runs count; {outcome.not_stopped} of them had not stopped at the end of their time "
        f"and count as longer than any other. {outcome.uncounted} more failed or are not valid and do not count."
        f"{even} This is not a certificate: it shows what this plant did over the ranges of this plan, "
        "with the frequency of the drawn values. It does not show how often a railway meets them."
    )


def _bound_row(bound: Mapping[str, Any]) -> tuple[str, str, str, str]:
    limit = _metres(bound["bound_m"]) if bound["rank"] else f"needs {bound['needs']} runs"
    return (
        f"{100 * bound['quantile']:g} %",
        _metres(bound["estimate_m"]),
        limit,
        str(bound["rank"] or "-"),
    )


def _metres(value_m: float | None) -> str:
    return "not stopped" if value_m is None else f"{value_m:.1f}"


def _draw_exceedance(drawn: Figure, outcome: Outcome) -> None:
    """Draw the distribution of the stopping distance, and the share of runs that go further."""
    distance_m = outcome.distance_m
    _, counted_m = stopping.counted(outcome.rows)
    counts, exceeded = drawn.subplots(1, 2)
    if isinstance(distance_m, strata.Sample):
        _draw_strata(counts, exceeded, distance_m)
        return
    counts.hist(counted_m[np.isfinite(counted_m)], bins=40)
    counts.set(xlabel="stopping distance, m", ylabel="runs")

    ranks = tail.shown_ranks(distance_m.size - outcome.not_stopped)
    values_m = [distance_m.at(rank) for rank in ranks.tolist()]
    exceeded.step(values_m, 1.0 - ranks / distance_m.size, where="post")
    _draw_bounds(exceeded, distance_m)
    exceeded.set(
        xlabel="stopping distance, m (triangles: bounds)",
        ylabel="share of runs that go further",
        yscale="log",
        ylim=(0.5 / distance_m.size, 1.1),
    )
    page.plain_logarithm(exceeded.yaxis)


def _draw_bounds(exceeded: Axes, distance_m: draws.Draws | strata.Sample) -> None:
    """Draw a triangle for the upper bound of each quantile that has one."""
    for bound in stopping.bounds(distance_m):
        if bound["bound_m"] is not None:
            exceeded.plot(bound["bound_m"], 1.0 - bound["quantile"], "v", color=page.VERMILION)


def _draw_strata(counts: Axes, exceeded: Axes, distance_m: strata.Sample) -> None:
    """Draw the same for runs with weights."""
    values_m, above = distance_m.curve()
    finite = np.isfinite(values_m)
    counts.hist(values_m[finite], bins=40, weights=distance_m.weights[finite])
    counts.set(xlabel="stopping distance, m", ylabel="share of all stops")
    known = finite & (above > 0.0)
    exceeded.step(values_m[known], above[known], where="pre")
    _draw_bounds(exceeded, distance_m)
    exceeded.set(
        xlabel="stopping distance, m (triangles: bounds)",
        ylabel="probability of a longer stop",
        yscale="log",
        ylim=(min(_LEAST_SHOWN, 0.5 * float(above[known].min(initial=1.0))), 1.1),
    )
    page.plain_logarithm(exceeded.yaxis)
