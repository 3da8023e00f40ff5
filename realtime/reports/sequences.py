"""The report of a set of sequences: one HTML file that needs nothing else, JUnit XML, and JSON.

The HTML (and on demand a PDF) has a title block and a summary. For each sequence it has the
verdicts with margins and sources, what each axle did, plots, events, the resolved configuration,
and how punctual bench and bus were. It links to the recordings. All three files have the same
verdicts. None of them is a certification.
"""

import contextlib
import dataclasses
import json
import math
import platform
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from rollerrig.configs import user_files
from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.output_files import make_folder, write_text
from rollerrig.configs.printable import printable
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.record import played, records, run_folder
from rollerrig.realtime.record.summary import finite
from rollerrig.realtime.reports import friction_changes, page, pdf, stop
from rollerrig.realtime.reports import train as train_report
from rollerrig.realtime.reports.page import Markup, element, folded, paragraph, table
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences import verdict as verdict_of
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.record import Record
from rollerrig.wsp_interface.sequences.verdict import DISCLAIMER, Result, Verdict, worst

# names of the files
HTML = "report.html"
JUNIT = "junit.xml"
JSON = "report.json"
PDF = "report.pdf"

# how the row of a result is set off
_MARKED = {Result.FAIL: "marked", Result.ERROR: "marked", Result.ABSENT: "void"}

# element of JUnit for a result
TAGS = {Result.FAIL: "failure", Result.ERROR: "error", Result.ABSENT: "skipped"}

# figures in the summary, with their decimal places
_SUMMARY_FIGURES = (
    ("stop_distance", 0),
    ("stop_distance_over_dry", 2),
    ("longest_lock", 2),
    ("air_consumption", 0),
)
_SUMMARY_HEAD = (
    "sequence",
    "result",
    "least margin",
    "",
    "stopping distance, m",
    "over dry",
    "lock, s",
    "air, NL",
    "record",
)
_VERDICTS_HEAD = ("measure or check", "value", "limit", "margin", "result", "the limit's source")

# recordings that a sequence may have
_RECORDINGS = ("run.rrd", "can.log", "summary.json", "harness.csv")

# packages whose versions the report has
_PACKAGES = ("numba", "numpy", "canopen", "python-can")


def write(
    outcomes: Sequence[Outcome],
    out: Path,
    junit: Path | None = None,
    about: Mapping[str, str] | None = None,
    on_paper: bool = False,
) -> list[Path]:
    """Write the files, with a PDF if `on_paper`, and return their paths. Raises RollerrigError.

    `about` are entries of the title block: the unit, who tested it, and so on.
    """
    when = datetime.now(UTC)
    about = dict(about or {})
    data = as_data(outcomes, when) | {
        "about": about,
        "warnings": contradictions(outcomes, about),
    }
    texts = {
        out / HTML: html(outcomes, out, when, about),
        out / JSON: json.dumps(data, indent=2) + "\n",
        junit or out / JUNIT: junit_xml(outcomes),
    }
    paths = list(texts)
    try:
        for path, text in texts.items():
            make_folder(path.parent)
            write_text(path, text)
        if on_paper:
            with page.on_paper():
                pdf.write(html(outcomes, out, when, about), out / PDF)
            paths.append(out / PDF)
    except OSError as error:
        raise RollerrigError(
            f"{error.filename or out}: the report cannot be written: {error.strerror}; the runs are "
            f"kept in {out}"
        ) from None
    return paths


def overall(outcomes: Sequence[Outcome]) -> Result:
    """Return the worst result of all sequences."""
    return worst([outcome.result for outcome in outcomes])


# --- JSON ---


def as_data(outcomes: Sequence[Outcome], when: datetime) -> dict[str, Any]:
    """Return all verdicts as plain data; an unknown value is null."""
    return {
        "disclaimer": DISCLAIMER,
        "result": overall(outcomes),
        "written": when.isoformat(),
        "versions": _versions(),
        "sequences": [_sequence_data(outcome) for outcome in outcomes],
    }


def _sequence_data(outcome: Outcome) -> dict[str, Any]:
    sequence = outcome.sequence
    data = {
        "name": sequence.name,
        "title": sequence.title,
        "file": str(sequence.path),
        "criteria": sequence.criteria.name,
        "result": outcome.result,
        "error": outcome.error or None,
        "folder": str(outcome.folder),
        "wall_s": round(outcome.wall_s, 3),
        "conditions": _conditions(outcome),
        "verdicts": [_verdict_data(verdict) for verdict in outcome.verdicts],
        "figures": figures(outcome),
        "measured": _measured(outcome),
        "events": [dataclasses.asdict(event) for event in outcome.events],
    }
    for key in (
        *("config_hash", "seed", "pacing", "valid", "invalid_because", "warnings"),
        *("loop", "bus", "unit_played", "scenario", "vehicle", "version"),
    ):
        data[key] = outcome.summary.get(key)
    return data


def _verdict_data(verdict: Verdict) -> dict[str, Any]:
    data = dataclasses.asdict(verdict)
    data["value"] = finite(verdict.value)
    data["margin"] = finite(verdict.margin)
    data["above_m_s"] = finite(verdict.above_m_s)
    data["below_m_s"] = finite(verdict.below_m_s)
    return data


def figures(outcome: Outcome) -> dict[str, float]:
    """Return every measure of a sequence that can be computed, with or without a limit.

    All are of the true motion. `measures.as_measured` has what the speed sensors measured.
    """
    if not outcome.record:
        return {}
    found = {}
    for measure in measures.of_kind(bool(outcome.record.train)):
        with contextlib.suppress(KeyError, IndexError, ValueError):
            found[measure.name] = float(measure.of(outcome.record))  # type: ignore[arg-type]
    return {name: value for name, value in found.items() if math.isfinite(value)}


def _measured(outcome: Outcome) -> dict[str, float | None]:
    """Return the measures of sliding by the speed sensors; an unknown value is null."""
    record = outcome.record
    if record is None or record.train or not len(record.columns["time_s"]):
        return {}
    found = measures.as_measured(record)
    return {name: finite(value) for name, value in found.items()}


def _versions() -> dict[str, str]:
    return {
        "rollerrig": metadata.version("rollerrig"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        **{name: metadata.version(name) for name in _PACKAGES},
    }


# --- JUnit ---


def junit_xml(outcomes: Sequence[Outcome]) -> str:
    """Return JUnit XML: one suite a sequence, one case a verdict.

    A sequence that could not be judged has an `error`.
    """
    suites = ET.Element("testsuites", name="rollerrig sequence")
    for outcome in outcomes:
        _add_suite(suites, outcome)
    ET.indent(suites)
    head = '<?xml version="1.0" encoding="utf-8"?>\n'
    # XML has no control characters
    return head + printable(ET.tostring(suites, encoding="unicode")) + "\n"


def _add_suite(suites: ET.Element, outcome: Outcome) -> None:
    name = outcome.sequence.name
    suite = ET.SubElement(suites, "testsuite", name=name, time=f"{outcome.wall_s:.3f}")
    properties = ET.SubElement(suite, "properties")
    stated = {
        "title": outcome.sequence.title,
        "disclaimer": DISCLAIMER,
        "folder": str(outcome.folder),
        **played.of_summary(outcome.summary).facts(),
    }
    for key, value in stated.items():
        ET.SubElement(properties, "property", name=key, value=value)

    for verdict in outcome.verdicts:
        title = f"{verdict.what}: {verdict.limit_text}"
        case = ET.SubElement(suite, "testcase", name=title, classname=name)
        source = verdict_of.source_text(verdict.source)
        text = f"{verdict.value_text} ({verdict.limit_text}); {verdict.text}; source: {source}"
        tag = TAGS.get(verdict.result)
        if tag is not None:
            ET.SubElement(case, tag, message=text)
        else:
            ET.SubElement(case, "system-out").text = text
    if outcome.error:
        title = "the sequence was carried out"
        case = ET.SubElement(suite, "testcase", name=title, classname=name)
        ET.SubElement(case, "error", message=outcome.error)

    for path, key in (
        ("testcase", "tests"),
        (".//failure", "failures"),
        (".//error", "errors"),
        (".//skipped", "skipped"),
    ):
        suite.set(key, str(len(suite.findall(path))))


# --- HTML ---


def html(
    outcomes: Sequence[Outcome], out: Path, when: datetime, about: Mapping[str, str] | None = None
) -> str:
    """Return the whole report as one document; links to recordings are relative to `out`."""
    counts = []
    for result in Result:
        count = sum(outcome.result is result for outcome in outcomes)
        if count:
            counts.append(f"{count} {result}")

    sections: list[Markup] = []
    for outcome in outcomes:
        sections += _section(outcome, out)
    return page.page(
        "WSP test sequences on the roller rig",
        paragraph("Result: ", _result(overall(outcomes)), f" ({', '.join(counts)})"),
        page.facts(_title_block(outcomes, when, about or {})),
        *(
            paragraph(element("b", "Warning: "), text, kind="note")
            for text in contradictions(outcomes, about or {})
        ),
        paragraph(
            element("b", f"{DISCLAIMER.capitalize()}."),
            " Simulated rig and vehicle. The limits are those of the named criteria profiles; the "
            "source of each limit is next to it.",
            kind="note",
        ),
        table(
            _SUMMARY_HEAD,
            [_summary(outcome, out) for outcome in outcomes],
            [_MARKED.get(outcome.result, "") for outcome in outcomes],
        ),
        *sections,
        page.signatures(about or {}),
    )


def _title_block(
    outcomes: Sequence[Outcome], when: datetime, about: Mapping[str, str]
) -> dict[str, str]:
    """Return what the user states, and which unit was played, with what and when."""
    units = dict.fromkeys(played.words(unit) for unit in _units(outcomes))
    recorded = {
        played.UNIT_PLAYED: " / ".join(units),
        "date": f"{when:%Y-%m-%d %H:%M} UTC",
        "tested with": " · ".join(f"{name} {number}" for name, number in _versions().items()),
    }
    return page.title_block(about, recorded)


def _units(outcomes: Sequence[Outcome]) -> list[played.Unit | None]:
    """Return the unit of each outcome, as far as its bench has made a summary."""
    return [played.of_summary(outcome.summary).unit for outcome in outcomes]


def contradictions(outcomes: Sequence[Outcome], about: Mapping[str, str]) -> list[str]:
    """Return a warning where --about names another unit than that of the records."""
    return played.contradictions([unit for unit in _units(outcomes) if unit], about)


def _conditions(outcome: Outcome) -> dict[str, str]:
    """Return rig, vehicle, load, speed, adhesion, gradient and changed friction of a sequence.

    They are those of the resolved scenario of the bench, with the speed at the beginning. The
    friction may change by the scenario and by commands of the sequence.
    """
    if not outcome.record:
        return {}
    if outcome.record.train:
        return _conditions_of_train(outcome.record)
    scenario = outcome.record.scenario
    vehicle = scenario["vehicle"]
    adhesion = scenario["adhesion"]
    speed_m_s = outcome.record.columns["vehicle_speed_m_s"]

    mode = scenario.get("rig", {}).get("mode", "")
    rig_words = (str(scenario.get("rig_set", "")), f"({mode})" if mode else "")
    adhesion_words = (
        f"{scenario.get('adhesion_set', played.NOT_STATED)}, mu_cd {adhesion['mu_cd']:.3g}"
    )
    if adhesion.get("initial_adhesion"):
        adhesion_words += f", initial {adhesion['initial_adhesion']:g}"
    wheel_mm = 2e3 * vehicle["wheel_radius_m"]
    conditions = {
        "rig": " ".join(filter(None, rig_words)),
        "vehicle": f"{scenario.get('vehicle_set', played.NOT_STATED)}, wheels of {wheel_mm:g} mm",
        "load": f"{vehicle['mass_kg'] / 1e3:g} t in all",
        "initial speed": f"{3.6 * speed_m_s[0]:.0f} km/h" if len(speed_m_s) else played.NOT_STATED,
        "adhesion": adhesion_words,
        "gradient": _gradient(scenario["mechanisms"]["track_gradient_gradient"]),
    }
    changed = friction_changes.changes(scenario, outcome.events, outcome.record.columns.__getitem__)
    if changed:
        conditions["changed friction"] = friction_changes.text(changed)
    return conditions


def _conditions_of_train(record: Record) -> dict[str, str]:
    """Return the train, its load, speed, adhesion and gradient."""
    scenario = record.scenario
    gradient = _gradient(scenario["mechanisms"]["track_gradient_gradient"])
    return train_report.conditions(record.train, scenario) | {"gradient": gradient}


def _gradient(rise: float) -> str:
    """Return the gradient of the track in percent; `rise` is positive uphill."""
    if rise == 0.0:
        return "0 % (level)"
    return f"{100.0 * rise:+g} % ({'uphill' if rise > 0.0 else 'downhill'})"


def _summary(outcome: Outcome, out: Path) -> list[str]:
    """Return the cells of a row of the table of sequences, in the order of `_SUMMARY_HEAD`.

    The first cell also has the reasons why the sequence did not pass.
    """
    name = outcome.sequence.name
    reasons = [outcome.error] if outcome.error else []
    for verdict in outcome.verdicts:
        if verdict.result is Result.FAIL:
            reasons.append(verdict.against_limit)
        elif verdict.result is Result.ERROR:
            reasons.append(f"{verdict.what} could not be judged (wanted {verdict.limit_text})")

    title: list[str] = [
        element("a", name, href=f"#{name}"),
        page.BREAK,
        element("small", outcome.sequence.title),
    ]
    if reasons:
        title += [page.BREAK, element("small", "; ".join(reasons), kind="fail")]

    least_margin = "-"
    least_margin_of = ""
    known = [verdict for verdict in outcome.verdicts if math.isfinite(verdict.margin)]
    if known:
        least = min(known, key=lambda verdict: verdict.margin)
        least_margin = _margin(least)
        least_margin_of = _worded(least)

    # an error may have left a record that is not complete
    found = {} if outcome.result is Result.ERROR else figures(outcome)
    figure_cells = []
    for key, places in _SUMMARY_FIGURES:
        figure_cells.append(f"{found[key]:.{places}f}" if key in found else "-")

    return [
        element("span", *title),
        _result(outcome.result),
        least_margin,
        least_margin_of,
        *figure_cells,
        _links(outcome, out),
    ]


def _section(outcome: Outcome, out: Path) -> list[Markup]:
    """Return the part of the page about one sequence."""
    sequence = outcome.sequence
    criteria = sequence.criteria
    # a sequence without a profile may still have limits
    profile = criteria.title
    if criteria.name != verdict_of.NO_PROFILE:
        profile = f"{criteria.name} ({criteria.title})"
    about = f"{sequence.name} · criteria: {profile} · {_punctuality(outcome)} · "
    parts = [
        element("h2", f"{sequence.title} · ", _result(outcome.result), id=sequence.name),
        paragraph(element("small", about, _links(outcome, out))),
    ]
    if outcome.error:
        parts.append(paragraph(element("b", "Error: "), outcome.error, kind="note"))
    for warning in outcome.summary.get("warnings", ()):
        parts.append(paragraph(element("b", "Warning: "), warning, kind="note"))
    parts.append(page.facts(played.of_summary(outcome.summary).facts() | _conditions(outcome)))
    parts.append(
        table(
            _VERDICTS_HEAD,
            [_verdict_row(verdict) for verdict in outcome.verdicts],
            [_MARKED.get(verdict.result, "") for verdict in outcome.verdicts],
        )
    )

    record = outcome.record
    if record is not None and record.train:
        parts.append(paragraph(train_report.sentence(record.train)))
        parts += train_report.parts(records.load(outcome.folder))
    elif record is not None and len(record.columns["time_s"]) > 1:
        parts.append(table(*stop.axles(record)))
        parts.append(paragraph(element("small", stop.lock_note(record))))
        parts.append(stop.picture(stop.motion_of_record(record), marks(outcome)))
        parts += _brakes(outcome)

    if outcome.events:
        parts.append(_events(outcome))
    for title, path in (
        ("sequence", sequence.path),
        ("resolved scenario", outcome.folder / "scenario.toml"),
    ):
        if path.is_file():
            text = user_files.read_text(path, user_files.TOML)
            parts.append(folded(f"{title}: {path.name}", element("pre", text)))
    return parts


def _events(outcome: Outcome) -> Markup:
    """Return the folded table of events, without the states of the nodes before and after the test.

    States during the test may be the effect of a fault, so they stay.
    """
    steps_s = [event.time_s for event in outcome.events if event.code == Code.SEQUENCE_STEP]
    begin_s = min(steps_s, default=0.0)
    end_s = math.inf
    if outcome.record is not None and len(outcome.record.columns["time_s"]):
        end_s = float(outcome.record.columns["time_s"][-1])

    rows = []
    for event in outcome.events:
        is_in_test = begin_s < event.time_s < end_s
        if event.code != Code.NMT_STATE or is_in_test:
            rows.append((f"{event.time_s:.3f}", event.who, event.text))
    title = f"{len(rows)} events"
    left_out = len(outcome.events) - len(rows)
    if left_out:
        title += (
            f" ({left_out} NMT states before and after the test are only in {run_folder.EVENTS})"
        )
    return folded(title, table(("s", "who", "what"), rows))


def _brakes(outcome: Outcome) -> list[Markup]:
    """Return what friction brake, motors and magnets did; nothing for friction brakes only."""
    head, rows = stop.brakes(outcome.summary)
    if not rows:
        return []
    run = records.load(outcome.folder)
    return [table(head, rows), stop.brakes_picture(stop.motion_of(run))]


def _verdict_row(verdict: Verdict) -> tuple[str, ...]:
    measure = element(
        "span",
        element("b", _worded(verdict)),
        page.BREAK,
        element("small", verdict.text),
    )
    return (
        measure,
        verdict.value_text,
        verdict.limit_text,
        _margin(verdict),
        "void" if verdict.void else _result(verdict.result),
        _source(verdict.source),
    )


def marks(outcome: Outcome) -> list[stop.Mark]:
    """Return steps, faults and changes of the friction, as they are named in the picture."""
    found = []
    for event in outcome.events:
        if event.code == Code.SEQUENCE_STEP:
            found.append(stop.Mark(event.time_s, stop.STEP, event.fields["title"]))
    found += stop.fault_marks(outcome.events) or _commanded_faults(outcome)
    if outcome.record is not None and not outcome.record.train:
        column = outcome.record.columns.__getitem__
        found += stop.friction_marks(outcome.record.scenario, outcome.events, column)
    return sorted(found)


def _commanded_faults(outcome: Outcome) -> list[stop.Mark]:
    """Return when the faults that the sequence commanded begin and are lifted.

    They count if the events of the bench are unknown, as those of a bench that ran already.
    """
    found = []
    for event in outcome.events:
        if event.code == Code.TEST_FAULT:
            text = event.fields["fault"]
            fault = catalogue.parse(text, outcome.sequence.kind)
            begins_s = max(event.time_s, fault.at_s)
            words = stop.fault_words(text)
            found.append(stop.Mark(begins_s, stop.FAULT, words))
            if math.isfinite(fault.for_s):
                found.append(stop.Mark(begins_s + fault.for_s, stop.FAULT, f"{words} lifted"))
        elif event.code == Code.TEST_FAULT_LIFTED:
            lifted = f"{stop.fault_words(event.fields['fault'])} lifted"
            found.append(stop.Mark(event.time_s, stop.FAULT, lifted))
    return found


def _worded(verdict: Verdict) -> str:
    """Return the measure with its bounds of speed, or the name of a step, as words."""
    words = verdict.what.replace("_", " ") if verdict.measure else verdict.what
    return words[:1].upper() + words[1:]


def _source(source: str) -> Markup:
    """Return the source of a limit, below a heading of what it is worth."""
    heading, rest = verdict_of.source_words(source)
    parts: list[str] = []
    if heading:
        parts += [element("b", heading), page.BREAK]
    parts.append(element("small", rest))
    return element("span", *parts)


def _punctuality(outcome: Outcome) -> str:
    """Return how punctual bench and bus were, in words."""
    summary = outcome.summary
    seen = summary.get("over_the_bus")
    if seen:
        return (
            f"a bench that ran already · pacing {summary['pacing']} · {seen['cycles']} cycles of "
            f"{1e3 * seen['cycle_s']:g} ms seen, {seen['cycles_lost']} lost · the bus does not show "
            "missed ticks and lateness: they are in the summary.json of the bench · configuration "
            f"{summary.get('config_hash') or '-'} · seed {summary.get('seed', '-')}"
        )
    loop = summary.get("loop") or {}
    bus = summary.get("bus") or {}
    late_us = (loop.get("lateness_us") or {}).get("p99")
    words = [
        f"pacing {summary.get('pacing', '-')}",
        f"ticks {loop.get('ticks', '-')}",
        f"missed {loop.get('missed', '-')}",
    ]
    if summary.get("pacing") == "wall" and late_us is not None:
        words.append(f"late p99 {late_us:.0f} us")
    words += [
        f"bus load {bus.get('load_percent', 0):.0f} %",
        f"dropped {bus.get('dropped', '-')}",
        f"configuration {summary.get('config_hash', '-')}",
        f"seed {summary.get('seed', '-')}",
    ]
    return " · ".join(words)


def _links(outcome: Outcome, out: Path) -> Markup:
    """Return links to the recordings that a sequence has."""
    links = []
    for name in _RECORDINGS:
        path = outcome.folder / name
        if path.is_file():
            links.append(page.file_link(f"{name} ", path, out))
    return element("span", *links)


def _result(result: Result) -> Markup:
    return element("b", result, kind=result.split()[0])


def _margin(verdict: Verdict) -> str:
    return f"{100 * verdict.margin:+.0f} %" if math.isfinite(verdict.margin) else ""
