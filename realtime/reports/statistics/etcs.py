"""The correction factors of a guaranteed deceleration as JSON, as CSV and as a page with a plot."""

import csv
import io
import json
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.realtime.campaign.statistics import corrections
from rollerrig.realtime.reports import page, pdf

HEAD = ("V, km/h", *(f"EBCL {level}" for level in corrections.LEVELS), "Kwet_rst")
_CSV_HEAD = (
    "v_from_km_h",
    "v_to_km_h",
    "m_nvebcl",
    "probability",
    "kdry_rst_bound",
    "kdry_rst_estimate",
    "kdry_rst_low",
    "kdry_rst_high",
    "method",
    "kwet_rst",
    "kwet_rst_low",
    "kwet_rst_high",
    "a_brake_nominal_m_s2",
    "a_safe_m_s2",
)
# digits of a factor; a safe value is never rounded up
_DIGITS = 3

Table = Mapping[str, Any]  # of `campaign.etcs.table`


def write(table: Table, out: Path, on_paper: bool = False) -> list[Path]:
    """Write the three files, and a PDF if `on_paper`; return their paths, the page last.

    Raises ConfigError if they cannot be written.
    """
    paths = [out / name for name in ("etcs.json", "etcs.csv", "etcs.html")]
    with writing(out):
        make_folder(out)
        write_text(paths[0], json.dumps(table, indent=1))
        write_text(paths[1], csv_text(table))
        write_text(paths[2], _page(table))
        if on_paper:
            paths.insert(0, paths[2].with_suffix(".pdf"))
            with page.on_paper():
                pdf.write(_page(table), paths[0])
    return paths


def rows(table: Table) -> list[tuple[str, ...]]:
    """Return a row per step of speed, under HEAD: the bounds of Kdry_rst, and Kwet_rst."""
    found = []
    for step in table["steps"]:
        bounds = [_down(level["bound"]) for level in step["kdry_rst"]]
        wet = step["kwet_rst"]
        found.append((_step(step), *bounds, _down(wet["estimate"] if wet else None)))
    return found


def csv_text(table: Table) -> str:
    """Return the table as CSV; lines that begin with # state what the numbers are."""
    text = io.StringIO()
    text.write(f"# {table['notice']}\n")
    for assumption in table["assumptions"]:
        text.write(f"# {assumption}\n")
    text.write(f"# M_NVAVADH = {table['m_nvavadh']:g}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_CSV_HEAD)
    for step in table["steps"]:
        wet = step["kwet_rst"] or dict.fromkeys(("estimate", "low", "high"))
        for level in step["kdry_rst"]:
            numbers = (
                step["from_km_h"],
                step["to_km_h"],
                level["m_nvebcl"],
                level["probability"],
                *(level[key] for key in ("bound", "estimate", "low", "high")),
                level["method"],
                *(wet[key] for key in ("estimate", "low", "high")),
                step["nominal_m_s2"],
                level["a_safe_m_s2"],
            )
            writer.writerow("" if number is None else number for number in numbers)
    return text.getvalue()


def _page(table: Table) -> str:
    confidence = f"{100 * table['confidence']:g} %"
    isolated = ", ".join(table["isolates"])
    parts = [
        page.paragraph(table["notice"], kind="note"),
        *([page.paragraph(f"Isolated: {isolated}.", kind="note")] if isolated else ()),
        page.paragraph(
            f"Kdry_rst by step of speed and confidence level M_NVEBCL: one-sided lower bounds with a "
            f"confidence of {confidence}, rounded down. Kwet_rst: estimate."
        ),
        page.table(HEAD, rows(table)),
        page.picture(partial(_draw, table=table), (11.0, 4.6)),
        page.element("h2", "Intervals"),
        page.table(
            (
                "V, km/h",
                "M_NVEBCL",
                "probability",
                "estimate",
                f"interval of {confidence}",
                "lower bound",
                "method",
                "A_safe, m/s²",
            ),
            [_level_row(step, level) for step in table["steps"] for level in step["kdry_rst"]],
        ),
        *_wet(table, confidence),
        *_build_up(table, confidence),
        page.element("h2", "What this assumes"),
        *(page.paragraph(text) for text in table["assumptions"]),
        page.element("h2", "Campaigns"),
    ]
    for name in ("dry", "wet"):
        if table[name]:
            parts += _campaign(name, table[name])
    return page.page("Kdry_rst and Kwet_rst", *parts)


def _wet(table: Table, confidence: str) -> list[page.Markup]:
    """Return the table of Kwet_rst with intervals; empty without a campaign on wet rails."""
    if table["wet"] is None:
        return [page.paragraph("No campaign on wet rails, so no Kwet_rst.", kind="note")]
    found = []
    for step in table["steps"]:
        wet = step["kwet_rst"]
        interval = f"{_near(wet['low'])} to {_near(wet['high'])}"
        runs = f"{step['runs_wet']} wet, {step['runs_dry']} dry"
        found.append((_step(step), _near(wet["estimate"]), interval, runs))
    head = ("V, km/h", "Kwet_rst", f"interval of {confidence}", "runs")
    return [page.element("h2", "Kwet_rst"), page.table(head, found)]


def _build_up(table: Table, confidence: str) -> list[page.Markup]:
    """Return the times of the build-up; empty where there are none."""
    found = table["build_up"]
    if found is None:
        return []
    rows_of_page = [
        (str(level["m_nvebcl"]), _near(level["estimate_s"]), _near(level["bound_s"]))
        for level in found["levels"]
        if level["estimate_s"] is not None
    ]
    return [
        page.element("h2", "Build-up of the brake"),
        page.paragraph(
            f"Nominal: {_near(found['nominal_s'])} s. A brake that begins so much later, at once with "
            "the deceleration of the highest step, has the same speed after the build-up."
        ),
        page.table(
            (
                "M_NVEBCL",
                "at most, with the probability of the level, s",
                f"bound of {confidence}, s",
            ),
            rows_of_page,
        ),
    ]


def _campaign(name: str, origin: Mapping[str, Any]) -> list[page.Markup]:
    facts = {
        f"{name} rails": origin["folder"],
        "scenario": str(origin["scenario"]),
        "unit": str(origin["unit"]),
        "runs": f"{origin['runs']}, of which {origin['left_out']} failed and do not count",
        "SHA-256 of the results": origin["sha256_of_results"],
    }
    return [page.facts(facts), page.table(("input", "law", "source"), origin["inputs"])]


def _level_row(step: Mapping[str, Any], level: Mapping[str, Any]) -> tuple[str, ...]:
    method = level["method"]
    if level["reason"] is not None:
        method = f"{method}: {level['reason']}"
    safe_m_s2 = level["a_safe_m_s2"]
    return (
        _step(step),
        str(level["m_nvebcl"]),
        f"{level['probability']:.10g}",
        _near(level["estimate"]),
        f"{_near(level['low'])} to {_near(level['high'])}",
        _down(level["bound"]),
        method,
        _down(safe_m_s2),
    )


def _step(step: Mapping[str, Any]) -> str:
    return f"{step['from_km_h']:g} to {step['to_km_h']:g}"


def _down(value: float | None) -> str:
    """Return a number rounded down, "-" without one."""
    if value is None:
        return "-"
    unit = 10.0**_DIGITS
    return f"{math.floor(value * unit) / unit:.{_DIGITS}f}"


def _near(value: float | None) -> str:
    return "-" if value is None else f"{value:.{_DIGITS}f}"


def _or(value: float | None, other: float) -> float:
    return other if value is None else value


def _draw(drawn: Figure, table: Table) -> None:
    """Draw the bounds of Kdry_rst against the level, a line for each step with its intervals."""
    plot = drawn.subplots()
    for place, step in enumerate(table["steps"]):
        known = [level for level in step["kdry_rst"] if level["bound"] is not None]
        levels = [level["m_nvebcl"] for level in known]
        colour = page.RUNS[place % len(page.RUNS)]
        bounds = [level["bound"] for level in known]
        plot.plot(levels, bounds, "o-", color=colour, label=f"{_step(step)} km/h")
        low = [_or(level["low"], level["bound"]) for level in known]
        high = [_or(level["high"], level["estimate"]) for level in known]
        plot.fill_between(levels, low, high, color=colour, alpha=0.15)
    plot.set(
        xlabel="confidence level M_NVEBCL",
        ylabel="Kdry_rst (line: lower bound, band: interval)",
        xticks=corrections.LEVELS,
    )
    plot.set_title("Not a certificate")
    plot.legend()
