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
from importlib import metadata
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.reports import page
from rollerrig.realtime.reports.page import Markup, element, folded, paragraph, table
from rollerrig.realtime.telemetry import colours
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.verdict import DISCLAIMER, Result, Verdict, worst
from rollerrig.wsp_interface.signals import AXLES

HTML, JUNIT, JSON = "report.html", "junit.xml", "report.json"


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
        "verdicts": [dataclasses.asdict(one) | {"value": _number(one.value), "margin": _number(one.margin)}
                     for one in outcome.verdicts],
        "figures": figures(outcome),
        "events": [dataclasses.asdict(event) for event in outcome.events],
        "config_hash": summary.get("config_hash"), "seed": summary.get("seed"),
        "pacing": summary.get("pacing"), "loop": summary.get("loop"), "bus": summary.get("bus"),
    }


def figures(outcome: Outcome) -> dict[str, float]:
    """Every measure of a sequence that could be computed, limited or not."""
    found = {}
    for one in measures.MEASURES if outcome.record else ():
        try:
            found[one.name] = float(one.of(outcome.record))  # type: ignore[arg-type]
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
    text = _printable(f"{_value(verdict)} ({verdict.limit}); {verdict.text}; "
                      f"source: {verdict.source}")
    tag = {Result.FAIL: "failure", Result.ERROR: "error", Result.ABSENT: "skipped"}.get(verdict.result)
    if tag:
        ET.SubElement(case, tag, message=text)
    else:
        ET.SubElement(case, "system-out").text = text


def _printable(text: str) -> str:
    # XML 1.0 has no control characters
    return "".join(one if one >= " " or one in "\n\t" else "?" for one in text)


# -- as HTML

def html(outcomes: Sequence[Outcome], out: Path, when: datetime) -> str:
    """The whole report as one document; links to recordings are relative to `out`."""
    counts = [f"{count} {one}" for one in Result
              if (count := sum(outcome.result is one for outcome in outcomes))]
    versions = " · ".join(f"{name} {version}" for name, version in _versions().items())
    return page.page(
        "WSP test sequences on the roller rig",
        paragraph("Result: ", _result(overall(outcomes)),
                  f" ({', '.join(counts)}) · {when:%Y-%m-%d %H:%M} UTC"),
        paragraph(element("small", versions)),
        paragraph(element("b", f"{DISCLAIMER.capitalize()}."), " Simulated rig and vehicle; limits are those of "
                  "the named criteria profiles, whose sources stand beside each number.", kind="note"),
        table(("sequence", "result", "least margin", "", "stop, m", "over dry", "lock, s", "air, NL", "record"),
              [_summary(outcome, out) for outcome in outcomes]),
        *(part for outcome in outcomes for part in _section(outcome, out)))


def _summary(outcome: Outcome, out: Path) -> list[str]:
    """A row: the sequence and why it did not pass, its least margin, some figures, its records."""
    wrong = [f"{one.what} {_value(one)}, wanted {one.limit} {one.unit}".strip()
             for one in outcome.verdicts if one.result in (Result.FAIL, Result.ERROR)]
    why = "; ".join([outcome.error] * bool(outcome.error) + wrong)
    least = min((one for one in outcome.verdicts if math.isfinite(one.margin)),
                key=lambda one: one.margin, default=None)
    found = figures(outcome)
    name = outcome.sequence.name
    return [
        element("span", element("a", name, href=f"#{name}"), page.BREAK,
                element("small", outcome.sequence.title),
                *((page.BREAK, element("small", why, kind="fail")) if why else ())),
        _result(outcome.result), _margin(least) if least else "-", least.what if least else "",
        *(f"{found[key]:.{places}f}" if key in found else "-" for key, places in (
            ("stop_distance", 0), ("stop_distance_over_dry", 2), ("longest_lock", 2),
            ("air_consumption", 0))),
        _links(outcome, out)]


def _section(outcome: Outcome, out: Path) -> list[Markup]:
    sequence = outcome.sequence
    parts = [element("h2", f"{sequence.title} · ", _result(outcome.result), id=sequence.name),
             paragraph(element("small", f"{sequence.name} · criteria: {sequence.criteria.name} "
                               f"({sequence.criteria.title}) · {_punctuality(outcome)} · ",
                               _links(outcome, out)))]
    if outcome.error:
        parts.append(paragraph(element("b", "Error: "), outcome.error, kind="note"))
    parts.append(table(
        ("measure or check", "value", "limit", "margin", "result", "source of the limit"),
        [(element("span", one.what, page.BREAK, element("small", one.text)), _value(one),
          f"{one.limit} {one.unit}", _margin(one), _result(one.result), element("small", one.source))
         for one in outcome.verdicts]))
    if outcome.record is not None and len(outcome.record.columns["time_s"]) > 1:
        parts.append(page.picture(lambda figure: _stop(figure, outcome), (11.0, 8.0)))
    if outcome.events:
        parts.append(folded(f"{len(outcome.events)} events", table(
            ("s", "who", "what"),
            [(f"{event.time_s:.3f}", event.who, event.text) for event in outcome.events])))
    for title, path in (("sequence", sequence.path), ("resolved scenario", outcome.folder / "scenario.toml")):
        if path.is_file():
            parts.append(folded(f"{title}: {path.name}", element("pre", path.read_text(encoding="utf-8"))))
    return parts


def _stop(figure: Figure, outcome: Outcome) -> None:
    """Speeds, pressures, adhesion and valves over time, with the instants at which faults began."""
    assert outcome.record is not None
    columns, radius_m = outcome.record.columns, outcome.record.scenario["vehicle"]["wheel_radius_m"]
    time_s = columns["time_s"]
    plots = figure.subplots(4, 1, sharex=True, height_ratios=(3, 3, 3, 2))
    speed, pressure, adhesion, valves = plots
    for axle, colour in enumerate(page.AXLES, start=1):
        for plot, name, factor in ((speed, "measured_speed_{}_rad_s", 3.6 * radius_m),
                                   (pressure, "cylinder_pressure_{}_Pa", 1e-5), (adhesion, "adhesion_{}", 1.0)):
            plot.plot(time_s, factor * columns[name.format(axle)], color=colour,
                      label=f"axle {axle}" if plot is speed else None)
        for state, (_, shade) in enumerate(colours.VALVE_STATES[1:], start=1):
            # the edge keeps a pulse of one cycle in sight
            valves.fill_between(time_s, axle - 0.4, axle + 0.4, columns[f"valve_{axle}"] == state,
                                step="post", color=colours.on_page(shade), linewidth=0.5)
    speed.plot(time_s, 3.6 * columns["wsp_reference_speed_m_s"], "--", color=page.GREY,
               label="WSP reference, brake demand")
    speed.plot(time_s, 3.6 * columns["vehicle_speed_m_s"], color=page.INK, label="vehicle")
    pressure.plot(time_s, 1e-5 * columns["brake_demand_Pa"], "--", color=page.GREY)
    for plot, title in zip(plots, ("speeds, km/h", "brake cylinders, bar", "adhesion used", "valve of axle"),
                           strict=True):
        plot.set_ylabel(title)
        for event in outcome.events:
            if event.who == "harness" and event.text.startswith("fault "):
                plot.axvline(event.time_s, linestyle=":", color=page.VERMILION)
    adhesion.set_ylim(0.0, None)
    figure.align_ylabels()
    valves.set(yticks=range(1, AXLES + 1), ylim=(AXLES + 0.5, 0.5), xlabel="time, s")
    lines, _ = speed.get_legend_handles_labels()
    states = [Patch(color=colours.on_page(shade), label=name) for name, shade in colours.VALVE_STATES[1:]]
    figure.legend(handles=[*lines, *states], loc="outside upper center", ncols=8)


def _punctuality(outcome: Outcome) -> str:
    summary = outcome.summary
    if seen := summary.get("over_the_bus"):
        return (f"a bench that ran already · pacing {summary['pacing']} · {seen['cycles']} cycles of "
                f"{1e3 * seen['cycle_s']:g} ms seen, {seen['cycles_lost']} lost · missed ticks and lateness "
                "are not told over the bus: they stand in the bench's own summary.json")
    loop, bus = summary.get("loop") or {}, summary.get("bus") or {}
    late = (loop.get("lateness_us") or {}).get("p99")
    return " · ".join((
        f"pacing {summary.get('pacing', '-')}", f"ticks {loop.get('ticks', '-')}",
        f"missed {loop.get('missed', '-')}",
        *([f"late p99 {late:.0f} us"] if summary.get("pacing") == "wall" and late is not None else ()),
        f"bus load {bus.get('load_percent', 0):.0f} %", f"dropped {bus.get('dropped', '-')}",
        f"configuration {summary.get('config_hash', '-')}", f"seed {summary.get('seed', '-')}"))


def _links(outcome: Outcome, out: Path) -> Markup:
    return element("span", *(
        element("a", f"{name} ", href=os.path.relpath(outcome.folder / name, out))
        for name in ("run.rrd", "can.log", "summary.json", "harness.csv")
        if (outcome.folder / name).is_file()))


def _result(result: Result) -> Markup:
    return element("b", result, kind=result.split()[0])


def _margin(verdict: Verdict) -> str:
    return f"{100 * verdict.margin:+.0f} %" if math.isfinite(verdict.margin) else ""


def _value(verdict: Verdict) -> str:
    if not math.isfinite(verdict.value):
        return "never" if math.isinf(verdict.value) else ""
    return f"{verdict.value:.4g} {verdict.unit}".strip()
