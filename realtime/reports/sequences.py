"""The report of a set of sequences: one HTML file that needs nothing else, JUnit XML, and JSON.

The HTML holds the summary, for each sequence its verdicts with margins and sources, plots, events,
the resolved configuration and how punctual bench and bus were; recordings are linked beside it.
All three say the same; none of them certifies anything.
"""

import dataclasses
import json
import math
import os
import platform
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.reports import plots
from rollerrig.realtime.reports.plots import AXLE_COLOURS, DEMAND_COLOUR, VEHICLE_COLOUR, Line
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.verdict import DISCLAIMER, Result, Verdict, worst
from rollerrig.wsp_interface.signals import AXLES

HTML, JUNIT, JSON = "report.html", "junit.xml", "report.json"
_AXLES = range(1, AXLES + 1)
_STYLE = """
body{font:14px/1.45 system-ui,sans-serif;color:#222;max-width:1180px;margin:2em auto;padding:0 1.2em}
h1{font-size:1.5em;margin-bottom:.2em}h2{font-size:1.15em;margin:2.2em 0 .3em;border-top:1px solid #ccc;
padding-top:1em}h3{font-size:1em;margin:1.2em 0 .3em}
table{border-collapse:collapse;width:100%;font-size:.93em}th,td{text-align:left;padding:.25em .6em;
border-bottom:1px solid #e4e4e4;vertical-align:top}th{background:#f4f4f4}td.n,th.n{text-align:right;
font-variant-numeric:tabular-nums;white-space:nowrap}
.r{font-weight:600;white-space:nowrap}.pass{color:#1b7a34}.fail{color:#c0271d}.error{color:#8a2be2}
.not{color:#777}small,.dim{color:#666}
figure{margin:.6em 0;display:inline-block;width:49%;min-width:480px;vertical-align:top}
figcaption{font-size:.9em}figcaption span{margin-left:.7em;white-space:nowrap}
figcaption i{display:inline-block;width:.9em;height:.5em;margin-right:.3em;vertical-align:middle}
svg{width:100%;height:auto}svg polyline{fill:none;stroke-width:1.3}svg .g{stroke:#e6e6e6}
svg .m{stroke:#c0271d;stroke-dasharray:2 3;opacity:.6}svg text{font-size:11px;fill:#555}
svg .v{text-anchor:end;dominant-baseline:middle}svg .t{text-anchor:middle}
details{margin:.4em 0}summary{cursor:pointer;color:#335}pre{background:#f7f7f7;padding:.8em;
overflow:auto;font-size:.85em}.box{background:#fff8e6;border:1px solid #f0dca8;padding:.5em .8em}
.err{background:#f6effd;border:1px solid #d9c2f0;padding:.5em .8em}
@media print{figure{width:48%}details{display:none}}
"""


def write(outcomes: Sequence[Outcome], out: Path, junit: Path | None = None,
          when: datetime | None = None) -> list[Path]:
    """Write the three files; what was written. Raises RollerrigError where they cannot be."""
    when = when or datetime.now(UTC)
    paths = {out / HTML: html(outcomes, out, when), out / JSON: json.dumps(
        as_data(outcomes, when), indent=2) + "\n", junit or out / JUNIT: junit_xml(outcomes)}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, text in paths.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RollerrigError(f"{error.filename}: the report cannot be written: {error.strerror}; the "
                             f"runs are kept in {out}") from None
    return list(paths)


def overall(outcomes: Sequence[Outcome]) -> Result:
    """The worst result of all sequences."""
    return worst([outcome.result for outcome in outcomes])


# -- as data

def as_data(outcomes: Sequence[Outcome], when: datetime) -> dict[str, Any]:
    """All verdicts as plain data; a value that is not known is null."""
    return {
        "disclaimer": DISCLAIMER, "result": overall(outcomes), "written": when.isoformat(),
        "versions": _versions(), "sequences": [_sequence_data(one) for one in outcomes],
    }


def _sequence_data(outcome: Outcome) -> dict[str, Any]:
    summary = outcome.summary
    return {
        "name": outcome.sequence.name, "title": outcome.sequence.title,
        "file": str(outcome.sequence.path), "criteria": outcome.sequence.criteria.name,
        "result": outcome.result, "error": outcome.error or None, "folder": str(outcome.folder),
        "wall_s": round(outcome.wall_s, 3),
        "verdicts": [{"what": one.what, "unit": one.unit, "value": _number(one.value),
                      "limit": one.limit, "margin": _number(one.margin), "result": one.result,
                      "source": one.source, "text": one.text} for one in outcome.verdicts],
        "figures": {name: _number(value) for name, value in figures(outcome).items()},
        "events": [dataclasses.asdict(event) for event in outcome.events],
        "config_hash": summary.get("config_hash"), "seed": summary.get("seed"),
        "pacing": summary.get("pacing"), "loop": summary.get("loop"), "bus": summary.get("bus"),
    }


def figures(outcome: Outcome) -> dict[str, float]:
    """Every measure of a sequence that could be computed, limited or not."""
    found = {}
    for one in measures.MEASURES if outcome.record else ():
        try:
            found[one.name] = one.of(outcome.record)  # type: ignore[arg-type]
        except (KeyError, IndexError, ValueError):
            continue
    return {name: value for name, value in found.items() if math.isfinite(value)}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _versions() -> dict[str, str]:
    return {"rollerrig": metadata.version("rollerrig"), "python": platform.python_version(),
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            **{name: metadata.version(name) for name in ("numba", "numpy", "canopen", "python-can")}}


# -- as JUnit XML

def junit_xml(outcomes: Sequence[Outcome]) -> str:
    """One suite a sequence, one case a verdict; `error` where a sequence could not be judged."""
    suites = ET.Element("testsuites", name="rollerrig sequence")
    for outcome in outcomes:
        suite = ET.SubElement(suites, "testsuite", name=outcome.sequence.name,
                              time=f"{outcome.wall_s:.3f}")
        properties = ET.SubElement(suite, "properties")
        for name, value in (("title", outcome.sequence.title), ("disclaimer", DISCLAIMER),
                            ("folder", str(outcome.folder))):
            ET.SubElement(properties, "property", name=name, value=value)
        for verdict in outcome.verdicts:
            _case(suite, outcome.sequence.name, verdict)
        if outcome.error:
            case = ET.SubElement(suite, "testcase", name="the sequence was carried out",
                                 classname=outcome.sequence.name)
            ET.SubElement(case, "error", message=_printable(outcome.error))
        for tag, key in (("testcase", "tests"), (".//failure", "failures"), (".//error", "errors"),
                         (".//skipped", "skipped")):
            suite.set(key, str(len(suite.findall(tag))))
    ET.indent(suites)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(suites, encoding="unicode") + "\n"


def _case(suite: ET.Element, classname: str, verdict: Verdict) -> None:
    name = _printable(f"{verdict.what}: {verdict.limit}")
    case = ET.SubElement(suite, "testcase", name=name, classname=classname)
    told = _printable(f"{_value(verdict)} ({verdict.limit}); {verdict.text}; "
                      f"source: {verdict.source}")
    tag = {Result.FAIL: "failure", Result.ERROR: "error", Result.ABSENT: "skipped"}.get(verdict.result)
    if tag:
        ET.SubElement(case, tag, message=told)
    else:
        ET.SubElement(case, "system-out").text = told


def _printable(text: str) -> str:
    # XML 1.0 has no control characters
    return "".join(one if one >= " " or one in "\n\t" else "?" for one in text)


# -- as HTML

def html(outcomes: Sequence[Outcome], out: Path, when: datetime) -> str:
    """The whole report as one document; links to recordings are relative to `out`."""
    result = overall(outcomes)
    counts = {one: sum(outcome.result is one for outcome in outcomes) for one in Result}
    told = ", ".join(f"{count} {one}" for one, count in counts.items() if count)
    versions = " · ".join(f"{name} {version}" for name, version in _versions().items())
    body = [
        "<h1>WSP test sequences on the roller rig</h1>",
        f'<p>Result: {_result(result)} ({told}) · {when:%Y-%m-%d %H:%M} UTC<br>'
        f'<span class="dim">{escape(versions)}</span></p>',
        f'<p class="box"><b>{DISCLAIMER.capitalize()}.</b> Simulated rig and vehicle; limits are '
        "those of the named criteria profiles, whose sources stand beside each number.</p>",
        _summary_table(outcomes, out),
        *(_section(outcome, out) for outcome in outcomes),
    ]
    return ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>WSP test sequences: '
            f"{result}</title><style>{_STYLE}</style></head><body>{''.join(body)}</body></html>\n")


def _summary_table(outcomes: Sequence[Outcome], out: Path) -> str:
    rows = []
    for outcome in outcomes:
        found = figures(outcome)
        margins = [(one.margin, one.what) for one in outcome.verdicts if math.isfinite(one.margin)]
        margin = min(margins, default=(math.nan, ""))
        told = f"{100 * margin[0]:+.0f} % <small>{escape(margin[1])}</small>" if margins else "-"
        columns = [_show(found.get(name), places) for name, places in (
            ("stop_distance", 0), ("stop_distance_over_dry", 2), ("longest_lock", 2),
            ("air_consumption", 0))]
        rows.append(
            f'<tr><td><a href="#{escape(outcome.sequence.name)}">{escape(outcome.sequence.name)}</a>'
            f"<br><small>{escape(outcome.sequence.title)}</small>{_reason(outcome)}</td>"
            f"<td>{_result(outcome.result)}"
            f"</td><td>{told}</td>" + "".join(f'<td class="n">{one}</td>' for one in columns)
            + f"<td>{_links(outcome, out)}</td></tr>")
    heads = "".join(f"<th>{one}</th>" for one in ("sequence", "result", "least margin")) + "".join(
        f'<th class="n">{one}</th>' for one in ("stop, m", "over dry", "lock, s", "air, NL"))
    return f"<table><tr>{heads}<th>record</th></tr>" + "".join(rows) + "</table>"


def _reason(outcome: Outcome) -> str:
    """Why a sequence did not pass, for who reads no further than the summary."""
    wrong = [f"{one.what} {_value(one)}, wanted {one.limit} {one.unit}".strip()
             for one in outcome.verdicts if one.result in (Result.FAIL, Result.ERROR)]
    told = [outcome.error] * bool(outcome.error) + wrong
    return f'<br><small class="err">{escape("; ".join(told))}</small>' if told else ""


def _section(outcome: Outcome, out: Path) -> str:
    sequence = outcome.sequence
    parts = [f'<h2 id="{escape(sequence.name)}">{escape(sequence.title)} · '
             f"{_result(outcome.result)}</h2>",
             f'<p class="dim">{escape(sequence.name)} · criteria: {escape(sequence.criteria.name)} '
             f"({escape(sequence.criteria.title)}) · {_punctuality(outcome)} · "
             f"{_links(outcome, out)}</p>"]
    if outcome.error:
        parts.append(f'<p class="err"><b>Error:</b> {escape(outcome.error)}</p>')
    parts += [_verdict_table(outcome.verdicts), _plots(outcome), _events(outcome),
              _configuration(outcome)]
    return "".join(parts)


def _verdict_table(verdicts: Sequence[Verdict]) -> str:
    rows = "".join(
        f"<tr><td>{escape(one.what)}<br><small>{escape(one.text)}</small></td>"
        f'<td class="n">{escape(_value(one))}</td><td>{escape(one.limit)} {escape(one.unit)}</td>'
        f'<td class="n">{f"{100 * one.margin:+.0f} %" if math.isfinite(one.margin) else ""}</td>'
        f"<td>{_result(one.result)}</td><td><small>{escape(one.source)}</small></td></tr>"
        for one in verdicts)
    heads = ("measure or check", "value", "limit", "margin", "result", "source of the limit")
    return ("<table><tr>" + "".join(f"<th>{one}</th>" for one in heads) + f"</tr>{rows}</table>"
            if rows else "")


def _plots(outcome: Outcome) -> str:
    record = outcome.record
    if record is None or len(record.columns["time_s"]) < 2:
        return ""
    columns, time_s = record.columns, record.columns["time_s"]
    radius_m = record.scenario.get("vehicle", {}).get("wheel_radius_m", np.nan)
    marks = [event.time_s for event in outcome.events
             if event.who == "harness" and event.text.startswith("fault ")]

    def of_axles(name: str, factor: float = 1.0) -> list[Line]:
        pattern = {"adhesion": "adhesion_{}", "speed": "measured_speed_{}_rad_s",
                   "pressure": "cylinder_pressure_{}_Pa"}[name]
        return [Line(f"axle {axle}", AXLE_COLOURS[axle - 1], factor * columns[pattern.format(axle)])
                for axle in _AXLES]

    reference = Line("WSP reference", DEMAND_COLOUR, 3.6 * columns["wsp_reference_speed_m_s"], True)
    return "".join((
        plots.plot("speeds", "km/h", time_s, [*of_axles("speed", 3.6 * radius_m), reference, Line(
            "vehicle", VEHICLE_COLOUR, 3.6 * columns["vehicle_speed_m_s"])], marks),
        plots.plot("brake cylinders", "bar", time_s, [*of_axles("pressure", 1e-5), Line(
            "demand", DEMAND_COLOUR, 1e-5 * columns["brake_demand_Pa"], True)], marks),
        plots.plot("adhesion used", "", time_s, of_axles("adhesion"), marks),
        plots.lanes("dump valves", time_s, [(f"axle {axle}", columns[f"valve_{axle}"])
                                            for axle in _AXLES])))


def _events(outcome: Outcome) -> str:
    rows = "".join(f'<tr><td class="n">{event.time_s:.3f}</td><td>{escape(event.who)}</td>'
                   f"<td>{escape(event.text)}</td></tr>" for event in outcome.events)
    return (f"<details><summary>{len(outcome.events)} events</summary><table><tr><th>s</th>"
            f"<th>who</th><th>what</th></tr>{rows}</table></details>") if rows else ""


def _configuration(outcome: Outcome) -> str:
    parts = []
    for title, path in (("sequence", outcome.sequence.path),
                        ("resolved scenario", outcome.folder / "scenario.toml")):
        try:
            text = path.read_text(encoding="utf-8")
        except OSError:
            continue
        parts.append(f"<details><summary>{title}: {escape(path.name)}</summary>"
                     f"<pre>{escape(text)}</pre></details>")
    return "".join(parts)


def _punctuality(outcome: Outcome) -> str:
    if seen := outcome.summary.get("over_the_bus"):
        return escape(f"a bench that ran already · pacing {outcome.summary['pacing']} · "
                      f"{seen['cycles']} cycles of {1e3 * seen['cycle_s']:g} ms seen, {seen['cycles_lost']} "
                      "lost · missed ticks and lateness are not told over the bus: they stand in the "
                      "bench's own summary.json")
    loop, bus = outcome.summary.get("loop") or {}, outcome.summary.get("bus") or {}
    late = (loop.get("lateness_us") or {}).get("p99")
    told = [f"pacing {outcome.summary.get('pacing', '-')}", f"ticks {loop.get('ticks', '-')}",
            f"missed {loop.get('missed', '-')}"]
    if outcome.summary.get("pacing") == "wall" and late is not None:
        told.append(f"late p99 {late:.0f} us")
    told += [f"bus load {bus.get('load_percent', 0):.0f} %", f"dropped {bus.get('dropped', '-')}",
             f"configuration {outcome.summary.get('config_hash', '-')}",
             f"seed {outcome.summary.get('seed', '-')}"]
    return escape(" · ".join(told))


def _links(outcome: Outcome, out: Path) -> str:
    found = [f'<a href="{escape(os.path.relpath(outcome.folder / name, out))}">{name}</a>'
             for name in ("run.rrd", "can.log", "summary.json", "harness.csv")
             if (outcome.folder / name).is_file()]
    return " ".join(found)


def _result(result: Result) -> str:
    return f'<span class="r {result.split()[0]}">{result}</span>'


def _value(verdict: Verdict) -> str:
    if not math.isfinite(verdict.value):
        return "never" if math.isinf(verdict.value) else ""
    return f"{verdict.value:.4g} {verdict.unit}".strip()


def _show(value: float | None, places: int) -> str:
    return "-" if value is None else f"{value:.{places}f}"
