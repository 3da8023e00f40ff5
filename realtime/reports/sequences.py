"""The report of a set of sequences: one HTML file that needs nothing else, JUnit XML, and JSON.

The HTML (and on demand a PDF) holds a title block, the summary, for each sequence its verdicts with margins and
sources, what each axle did, plots, events, the resolved configuration and how punctual bench and bus were; recordings
are linked beside it. All say the same; none of them certifies anything.
"""

import contextlib
import dataclasses
import json
import math
import os
import platform
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.record.summary import finite
from rollerrig.realtime.reports import page, pdf, stop
from rollerrig.realtime.reports.page import Markup, element, folded, paragraph, table
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.verdict import DISCLAIMER, Result, Verdict, worst

HTML, JUNIT, JSON, PDF = "report.html", "junit.xml", "report.json", "report.pdf"
NOT_STATED = "not stated"
_MARKED = {Result.FAIL: "marked", Result.ERROR: "marked", Result.ABSENT: "void"}
_STANDARD = re.compile(r"(?:EN|UIC|ISO|IEC|prEN) ?\d[\d-]*|[Pp]aper[^:;,]*")
# how JUnit calls a result
TAGS = {Result.FAIL: "failure", Result.ERROR: "error", Result.ABSENT: "skipped"}


def write(
    outcomes: Sequence[Outcome],
    out: Path,
    junit: Path | None = None,
    about: Mapping[str, str] | None = None,
    on_paper: bool = False,
) -> list[Path]:
    """Write the files, PDF too where they shall be `on_paper`; what was written. Raises RollerrigError.

    `about` is what the title block shall say of the unit, who tested it, and so on.
    """
    when, about = datetime.now(UTC), about or {}
    paths = {
        out / HTML: html(outcomes, out, when, about),
        out / JSON: json.dumps(as_data(outcomes, when) | {"about": dict(about)}, indent=2) + "\n",
        junit or out / JUNIT: junit_xml(outcomes),
    }
    try:
        for path, text in paths.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        if on_paper:
            with page.on_paper():
                pdf.write(html(outcomes, out, when, about), out / PDF)
    except OSError as error:
        raise RollerrigError(
            f"{error.filename or out}: the report cannot be written: {error.strerror}; the runs are "
            f"kept in {out}"
        ) from None
    return [*paths, *[out / PDF] * on_paper]


def overall(outcomes: Sequence[Outcome]) -> Result:
    """The worst result of all sequences."""
    return worst([outcome.result for outcome in outcomes])


def as_data(outcomes: Sequence[Outcome], when: datetime) -> dict[str, Any]:
    """All verdicts as plain data; a value that is not known is null."""
    return {
        "disclaimer": DISCLAIMER,
        "result": overall(outcomes),
        "written": when.isoformat(),
        "versions": _versions(),
        "sequences": [_sequence_data(one) for one in outcomes],
    }


def _sequence_data(outcome: Outcome) -> dict[str, Any]:
    sequence = outcome.sequence
    return {
        "name": sequence.name,
        "title": sequence.title,
        "file": str(sequence.path),
        "criteria": sequence.criteria.name,
        "result": outcome.result,
        "error": outcome.error or None,
        "folder": str(outcome.folder),
        "wall_s": round(outcome.wall_s, 3),
        "verdicts": [
            dataclasses.asdict(one) | {"value": finite(one.value), "margin": finite(one.margin)}
            for one in outcome.verdicts
        ],
        "figures": figures(outcome),
        "events": [dataclasses.asdict(event) for event in outcome.events],
    } | {
        key: outcome.summary.get(key)
        for key in ("config_hash", "seed", "pacing", "valid", "invalid_because", "loop", "bus")
    }


def figures(outcome: Outcome) -> dict[str, float]:
    """Every measure of a sequence that could be computed, limited or not."""
    found = {}
    for one in measures.MEASURES if outcome.record else ():
        with contextlib.suppress(KeyError, IndexError, ValueError):
            found[one.name] = float(one.of(outcome.record))  # type: ignore[arg-type]
    return {name: value for name, value in found.items() if math.isfinite(value)}


def _versions() -> dict[str, str]:
    return {
        "rollerrig": metadata.version("rollerrig"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        **{name: metadata.version(name) for name in ("numba", "numpy", "canopen", "python-can")},
    }


def junit_xml(outcomes: Sequence[Outcome]) -> str:
    """One suite a sequence, one case a verdict; `error` where a sequence could not be judged."""
    suites = ET.Element("testsuites", name="rollerrig sequence")
    for outcome in outcomes:
        name = outcome.sequence.name
        suite = ET.SubElement(suites, "testsuite", name=name, time=f"{outcome.wall_s:.3f}")
        properties = ET.SubElement(suite, "properties")
        for key, value in (
            ("title", outcome.sequence.title),
            ("disclaimer", DISCLAIMER),
            ("folder", str(outcome.folder)),
        ):
            ET.SubElement(properties, "property", name=key, value=value)
        for one in outcome.verdicts:
            case = ET.SubElement(
                suite, "testcase", name=_printable(f"{one.what}: {one.limit}"), classname=name
            )
            text = _printable(f"{one.value_text} ({one.limit}); {one.text}; source: {one.source}")
            if tag := TAGS.get(one.result):
                ET.SubElement(case, tag, message=text)
            else:
                ET.SubElement(case, "system-out").text = text
        if outcome.error:
            case = ET.SubElement(
                suite, "testcase", name="the sequence was carried out", classname=name
            )
            ET.SubElement(case, "error", message=_printable(outcome.error))
        for tag, key in (
            ("testcase", "tests"),
            (".//failure", "failures"),
            (".//error", "errors"),
            (".//skipped", "skipped"),
        ):
            suite.set(key, str(len(suite.findall(tag))))
    ET.indent(suites)
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(suites, encoding="unicode") + "\n"
    )


def _printable(text: str) -> str:
    # XML 1.0 has no control characters
    return "".join(one if one >= " " or one in "\n\t" else "?" for one in text)


def html(
    outcomes: Sequence[Outcome], out: Path, when: datetime, about: Mapping[str, str] | None = None
) -> str:
    """The whole report as one document; links to recordings are relative to `out`."""
    counts = [
        f"{count} {one}"
        for one in Result
        if (count := sum(outcome.result is one for outcome in outcomes))
    ]
    return page.page(
        "WSP test sequences on the roller rig",
        paragraph("Result: ", _result(overall(outcomes)), f" ({', '.join(counts)})"),
        page.facts(_title_block(outcomes, when, about or {})),
        paragraph(
            element("b", f"{DISCLAIMER.capitalize()}."),
            " Simulated rig and vehicle; limits are those of "
            "the named criteria profiles, whose sources stand beside each number.",
            kind="note",
        ),
        table(
            (
                "sequence",
                "result",
                "least margin",
                "",
                "stop, m",
                "over dry",
                "lock, s",
                "air, NL",
                "record",
            ),
            [_summary(outcome, out) for outcome in outcomes],
            [_MARKED.get(one.result, "") for one in outcomes],
        ),
        *(part for outcome in outcomes for part in _section(outcome, out)),
    )


def _title_block(
    outcomes: Sequence[Outcome], when: datetime, about: Mapping[str, str]
) -> dict[str, str]:
    """What was tested, by whom, with what, when; `about` wins."""
    units = {str((one.summary.get("wsp") or {}).get("unit") or NOT_STATED) for one in outcomes}
    versions = _versions()
    own = {"unit under test": ", ".join(sorted(units)), "version of the unit": NOT_STATED}
    if units == {"reference"} and "unit under test" not in about:
        own = {
            "unit under test": "reference WSP of rollerrig (simulated)",
            "version of the unit": versions["rollerrig"],
        }
    return (
        own
        | {"tested by": NOT_STATED}
        | dict(about)
        | {
            "date": f"{when:%Y-%m-%d %H:%M} UTC",
            "tested with": " · ".join(f"{name} {version}" for name, version in versions.items()),
        }
    )


def _conditions(outcome: Outcome) -> dict[str, str]:
    """Rig, vehicle, load, speed and adhesion of one sequence, from its resolved scenario."""
    if not outcome.record:
        return {}
    scenario, speed = outcome.record.scenario, outcome.record.columns["vehicle_speed_m_s"]
    vehicle, adhesion = scenario["vehicle"], scenario["adhesion"]
    mode = scenario.get("rig", {}).get("mode", "")
    return {
        "rig": " ".join(filter(None, (str(scenario.get("rig_set", "")), mode and f"({mode})"))),
        "vehicle": f"{scenario.get('vehicle_set', NOT_STATED)}, wheels of {2e3 * vehicle['wheel_radius_m']:g} mm",
        "load": f"{vehicle['mass_kg'] / 1e3:g} t in all",
        "initial speed": f"{3.6 * speed[0]:.0f} km/h" if len(speed) else NOT_STATED,
        "adhesion": f"{scenario.get('adhesion_set', NOT_STATED)}, mu_cd {adhesion['mu_cd']:.3g}"
        + (
            f", initial {adhesion['initial_adhesion']:g}"
            if adhesion.get("initial_adhesion")
            else ""
        ),
    }


def _summary(outcome: Outcome, out: Path) -> list[str]:
    """A row: the sequence and why it did not pass, its least margin, some figures, its records."""
    wrong = [
        one.against_limit for one in outcome.verdicts if one.result in (Result.FAIL, Result.ERROR)
    ]
    why = "; ".join([outcome.error] * bool(outcome.error) + wrong)
    known = [one for one in outcome.verdicts if math.isfinite(one.margin)]
    least = min(known, key=lambda one: one.margin, default=None)
    found, name = {} if outcome.result is Result.ERROR else figures(outcome), outcome.sequence.name
    return [
        element(
            "span",
            element("a", name, href=f"#{name}"),
            page.BREAK,
            element("small", outcome.sequence.title),
            *((page.BREAK, element("small", why, kind="fail")) if why else ()),
        ),
        _result(outcome.result),
        _margin(least) if least else "-",
        _worded(least.what) if least else "",
        *(
            f"{found[key]:.{places}f}" if key in found else "-"
            for key, places in (
                ("stop_distance", 0),
                ("stop_distance_over_dry", 2),
                ("longest_lock", 2),
                ("air_consumption", 0),
            )
        ),
        _links(outcome, out),
    ]


def _section(outcome: Outcome, out: Path) -> list[Markup]:
    sequence = outcome.sequence
    parts = [
        element("h2", f"{sequence.title} · ", _result(outcome.result), id=sequence.name),
        paragraph(
            element(
                "small",
                f"{sequence.name} · criteria: {sequence.criteria.name} "
                f"({sequence.criteria.title}) · {_punctuality(outcome)} · ",
                _links(outcome, out),
            )
        ),
    ]
    if outcome.error:
        parts.append(paragraph(element("b", "Error: "), outcome.error, kind="note"))
    parts.append(page.facts(_conditions(outcome)))
    parts.append(
        table(
            ("measure or check", "value", "limit", "margin", "result", "the limit's source"),
            [
                (
                    element(
                        "span",
                        element("b", _worded(one.what)),
                        page.BREAK,
                        element("small", one.text),
                    ),
                    one.value_text,
                    f"{one.limit} {one.unit}",
                    _margin(one),
                    "void" if one.void else _result(one.result),
                    _source(one.source),
                )
                for one in outcome.verdicts
            ],
            [_MARKED.get(one.result, "") for one in outcome.verdicts],
        )
    )
    if outcome.record is not None and len(outcome.record.columns["time_s"]) > 1:
        columns, radius_m = (
            outcome.record.columns,
            outcome.record.scenario["vehicle"]["wheel_radius_m"],
        )
        parts.append(table(*stop.axles(outcome.record)))
        parts.append(stop.picture(columns.__getitem__, radius_m, marks(outcome)))
    if outcome.events:
        parts.append(
            folded(
                f"{len(outcome.events)} events",
                table(
                    ("s", "who", "what"),
                    [(f"{event.time_s:.3f}", event.who, event.text) for event in outcome.events],
                ),
            )
        )
    for title, path in (
        ("sequence", sequence.path),
        ("resolved scenario", outcome.folder / "scenario.toml"),
    ):
        if path.is_file():
            parts.append(
                folded(f"{title}: {path.name}", element("pre", path.read_text(encoding="utf-8")))
            )
    return parts


def marks(outcome: Outcome) -> list[stop.Mark]:
    """The beginnings of steps and faults, as they are named in the picture."""
    found = []
    for event in outcome.events:
        if event.code == Code.SEQUENCE_STEP:
            found.append((event.time_s, stop.STEP, event.fields["title"]))
        elif event.code == Code.TEST_FAULT:
            found.append((event.time_s, stop.FAULT, event.fields["fault"]))
        elif event.code == Code.TEST_FAULT_LIFTED:
            found.append((event.time_s, stop.FAULT, f"{event.fields['fault']} lifted"))
    return sorted(found)


def _worded(what: str) -> str:
    """The name of a measure, or of a step, as words."""
    words = what.replace("_", " ") if what in measures.BY_NAME else what
    return words[:1].upper() + words[1:]


def _source(source: str) -> Markup:
    """The standard of a limit, or that it is assumed, before its source in full."""
    named = _STANDARD.search(source)
    kind = "assumption" if source.startswith("assumption") else named[0] if named else ""
    return element(
        "span",
        *((element("b", kind), page.BREAK) if kind else ()),
        element("small", source if source != kind else ""),
    )


def _punctuality(outcome: Outcome) -> str:
    summary = outcome.summary
    if seen := summary.get("over_the_bus"):
        return (
            f"a bench that ran already · pacing {summary['pacing']} · {seen['cycles']} cycles of "
            f"{1e3 * seen['cycle_s']:g} ms seen, {seen['cycles_lost']} lost · missed ticks and lateness "
            "are not told over the bus: they stand in the bench's own summary.json"
        )
    loop, bus = summary.get("loop") or {}, summary.get("bus") or {}
    late = (loop.get("lateness_us") or {}).get("p99")
    return " · ".join(
        (
            f"pacing {summary.get('pacing', '-')}",
            f"ticks {loop.get('ticks', '-')}",
            f"missed {loop.get('missed', '-')}",
            *(
                [f"late p99 {late:.0f} us"]
                if summary.get("pacing") == "wall" and late is not None
                else ()
            ),
            f"bus load {bus.get('load_percent', 0):.0f} %",
            f"dropped {bus.get('dropped', '-')}",
            f"configuration {summary.get('config_hash', '-')}",
            f"seed {summary.get('seed', '-')}",
        )
    )


def _links(outcome: Outcome, out: Path) -> Markup:
    return element(
        "span",
        *(
            element("a", f"{name} ", href=os.path.relpath(outcome.folder / name, out))
            for name in ("run.rrd", "can.log", "summary.json", "harness.csv")
            if (outcome.folder / name).is_file()
        ),
    )


def _result(result: Result) -> Markup:
    return element("b", result, kind=result.split()[0])


def _margin(verdict: Verdict) -> str:
    return f"{100 * verdict.margin:+.0f} %" if math.isfinite(verdict.margin) else ""
