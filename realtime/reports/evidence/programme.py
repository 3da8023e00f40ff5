"""The evidence of a test programme: JSON, a page, and a PDF with the same content.

It has what was run and on which configuration, the signals that each record must have, each verdict
with the source of its limit, the versions of software, and the SHA-256 of every file.
"""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from rollerrig.configs import store, unpacking, user_files
from rollerrig.configs.number_text import rounded
from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.configs.vehicle import TRAIN, kind_of
from rollerrig.realtime.record import played, run_folder
from rollerrig.realtime.reports import page, pdf
from rollerrig.realtime.train import record
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.sequences import programme as programme_file
from rollerrig.wsp_interface.sequences import verdict as verdict_of
from rollerrig.wsp_interface.sequences.verdict import DISCLAIMER, Result, worst

NAMES = ("evidence.json", "evidence.html", "evidence.pdf")
# of a part of a programme; so it does not replace the evidence of the whole
NAMES_OF_PART = ("evidence_part.json", "evidence_part.html", "evidence_part.pdf")
NOT_RUN = "not run"
_PACKAGES = ("rollerrig", "numpy", "numba", "scipy", "canopen", "python-can", "pyarrow")
_MARKED = {Result.FAIL: "marked", Result.ERROR: "marked"}
_VERDICTS_HEAD = ("measure or check", "value", "limit", "result", "source of the limit")

# signals that only the unit can send; a unit need not send them
_OF_UNIT = ("wsp_reference_speed",)

Part = Mapping[str, Any]  # of one sequence


def recorded(folder: Path) -> list[str]:
    """Return the signals of which the record of a run has numbers; empty without a record.

    A signal of several axles counts if all its axles have numbers. Of a train the first car counts.
    """
    path = folder / run_folder.CHANNELS
    if not path.is_file():
        return []
    user_files.check(path, user_files.PARQUET, within=folder)
    unpacking.check_parquet(path, pq.read_metadata(path))
    table = pq.read_table(path)
    resolved = store.parse(folder / run_folder.SCENARIO, within=folder)
    if TRAIN in resolved:
        # the cars have the signals of vehicles
        return recorded(record.folder_of_car(folder, 1))
    kind = kind_of(resolved, str(folder / run_folder.SCENARIO))
    found = []
    for signal in signals.table(kind).signals:
        columns = signals.columns(signal)
        if all(name in table.column_names and _has_numbers(table, name) for name in columns):
            found.append(signal.name)
    return found


def _has_numbers(table: Any, column: str) -> bool:
    values = table[column].to_numpy().astype(float)
    return bool(np.isfinite(values).any())


def evidence(
    programme: programme_file.Programme,
    parts: Mapping[str, Part],
    tested: Mapping[str, Any],
    when: datetime,
    about: Mapping[str, str],
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the evidence as plain data.

    `parts` has the sequences that were run, by name. `tested` is the unit and its files. `warnings`
    concern the entries of `about`. The result is the worst of the groups that count: a failure if
    anything has failed, else an error if a sequence could not be judged or was not run.
    """
    groups = []
    counted = []
    for group in programme.groups:
        in_group = [_sequence(Path(path).stem, parts, programme) for path in group.sequences]
        groups.append(
            {
                "title": group.title,
                "kind": group.kind,
                "source": group.source,
                "reason": group.reason or None,
                "sequences": in_group,
            }
        )
        if group.kind in programme.counted:
            counted += [_counted(one) for one in in_group]
    return {
        "disclaimer": DISCLAIMER,
        "programme": programme.name,
        "title": programme.title,
        "source": programme.source,
        "notes": list(programme.notes),
        "programme_sha256": _sha256_of(programme.path),
        "result": worst(counted),
        "not_judged": _not_judged(
            [group for group in groups if group["kind"] in programme.counted]
        ),
        "is_part": bool(programme.left_out),
        "groups_left_out": list(programme.left_out),
        "written": when.isoformat(),
        "about": dict(about),
        "warnings": list(warnings),
        "tested": dict(tested),
        "required_signals": list(programme.log),
        "versions": _versions(),
        "groups": groups,
    }


def _sha256_of(path: Path) -> str:
    return hashlib.sha256(user_files.read_bytes(path, user_files.TOML)).hexdigest()


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        **{name: metadata.version(name) for name in _PACKAGES},
    }


def _sequence(
    name: str, parts: Mapping[str, Part], programme: programme_file.Programme
) -> dict[str, Any]:
    """Return the evidence of one sequence."""
    part = parts.get(name)
    if part is None:
        return {"name": name, "result": NOT_RUN, "missing_signals": [], "verdicts": [], "files": {}}
    missing = [signal for signal in programme.log if signal not in part["signals"]]
    kept = {key: value for key, value in part.items() if key not in ("events", "loop", "bus")}
    return kept | {"missing_signals": missing}


def _counted(one: Mapping[str, Any]) -> Result:
    """Return what a sequence counts; one that was not run, or lacks a signal, is no pass.

    Optional signals that the unit does not send are reported, and are no error.
    """
    if one["result"] == NOT_RUN:
        return Result.ERROR
    result = Result(one["result"])
    return worst([result, Result.ERROR]) if _missing_of_rig(one) else result


def _missing_of_rig(one: Mapping[str, Any]) -> list[str]:
    """Return the required signals of the rig that the record of a sequence lacks."""
    return [signal for signal in one["missing_signals"] if signal not in _OF_UNIT]


def _not_judged(groups: list[dict[str, Any]]) -> list[str]:
    """Return what could not be judged in some groups, as a text for each sequence."""
    found = []
    for group in groups:
        for one in group["sequences"]:
            reasons = []
            if one["result"] == NOT_RUN:
                reasons.append(NOT_RUN)
            if one.get("error"):
                reasons.append(one["error"])
            reasons += [line["what"] for line in one["verdicts"] if line["result"] == Result.ERROR]
            reasons += [f"no signal {signal} in the record" for signal in _missing_of_rig(one)]
            if reasons:
                found.append(f"{one['name']}: {', '.join(reasons)}")
    return found


def about_before(out: Path) -> dict[str, str]:
    """Return the entries of the title block that earlier evidence in a folder has.

    Those of the whole programme win over those of a part. Raises ConfigError if it cannot be read.
    """
    entries: dict[str, str] = {}
    for path in (out / NAMES_OF_PART[0], out / NAMES[0]):
        if path.is_file():
            earlier = user_files.read_json(path, within=out)
            about = earlier.get("about") if isinstance(earlier, dict) else None
            if isinstance(about, dict):
                entries |= {str(key): str(value) for key, value in about.items()}
    return entries


def write(found: Mapping[str, Any], out: Path, on_paper: bool = False) -> list[Path]:
    """Write the evidence as JSON, as a page, and as PDF if `on_paper`; return the paths.

    Raises ConfigError if it cannot be written.
    """
    names = NAMES_OF_PART if found["is_part"] else NAMES
    paths = [out / name for name in names[: 3 if on_paper else 2]]
    with writing(out):
        make_folder(out)
        write_text(paths[0], json.dumps(found, indent=1))
        write_text(paths[1], _page(found, out))
        if on_paper:
            with page.on_paper():
                pdf.write(_page(found, out), paths[2])
    return paths


def _page(found: Mapping[str, Any], out: Path) -> str:
    tested = found["tested"]
    recorded = {
        played.UNIT_PLAYED: played.words(played.unit_in(tested.get("unit_played"))),
        "programme": found["programme"],
        "extent": "a part of the programme" if found["is_part"] else "the whole programme",
        "result": found["result"],
        "contents of the programme": verdict_of.source_text(found["source"]),
        "seed": str(tested["seed"]),
        "date": f"{datetime.fromisoformat(found['written']):%Y-%m-%d %H:%M} UTC",
    }
    warnings = [page.paragraph(f"Warning: {text}", kind="note") for text in found["warnings"]]
    parts: list[str] = [
        page.facts(page.title_block(found["about"], recorded)),
        *warnings,
        page.paragraph(
            page.element("b", f"{DISCLAIMER.capitalize()}."),
            " Simulated rig and vehicle. Mandatory groups and groups by agreement count for the "
            "result, which is fail if anything has failed. A sequence that was not run, or whose "
            "record lacks a required signal of the rig, is an error.",
            kind="note",
        ),
        *_part_note(found["groups_left_out"]),
        *_not_judged_note(found["not_judged"]),
        *(page.paragraph(note) for note in found["notes"]),
        page.element("h2", "Overview"),
        page.table(("group", "kind", "sequence", "result"), _overview(found)),
    ]
    for group in found["groups"]:
        parts += _group(group, out)
    parts += [
        page.element("h2", "Required signals"),
        page.paragraph(", ".join(found["required_signals"])),
        page.element("h2", "Software"),
        page.facts(found["versions"]),
        page.element("h2", "SHA-256 of the files"),
        page.table(("file", "SHA-256"), _hashes(found)),
        page.signatures(found["about"]),
    ]
    return page.page(found["title"], *parts)


def _part_note(left_out: list[str]) -> list[page.Markup]:
    """Return the note that the evidence is a part of a programme, if it is one."""
    if not left_out:
        return []
    text = f" The result is that of the groups below. Not chosen: {'; '.join(left_out)}."
    return [page.paragraph(page.element("b", "A part of the programme."), text, kind="note")]


def _not_judged_note(texts: list[str]) -> list[page.Markup]:
    if not texts:
        return []
    return [
        page.paragraph(page.element("b", "Could not be judged: "), "; ".join(texts), kind="note")
    ]


def _overview(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for group in found["groups"]:
        if not group["sequences"]:
            rows.append((group["title"], group["kind"], "-", "not part of this programme"))
        for one in group["sequences"]:
            rows.append((group["title"], group["kind"], one["name"], one["result"]))
    return rows


def _group(group: Mapping[str, Any], out: Path) -> list[page.Markup]:
    """Return the section of one group."""
    parts = [
        page.element("h2", f"{group['title']} ({group['kind']})"),
        page.paragraph(f"In the programme by: {verdict_of.source_text(group['source'])}."),
    ]
    if group["reason"]:
        parts.append(page.paragraph(group["reason"], kind="note"))
    for one in group["sequences"]:
        parts.append(page.element("h3", f"{one['name']}: {one['result']}"))
        if one["result"] == NOT_RUN:
            continue
        parts.append(page.paragraph(one["title"]))
        parts.append(page.facts(played.of_summary(one).facts() | one["conditions"]))
        if one["error"]:
            parts.append(page.paragraph(f"Error: {one['error']}", kind="note"))
        if one["missing_signals"]:
            text = f"Not in the record: {', '.join(one['missing_signals'])}."
            if set(one["missing_signals"]) <= set(_OF_UNIT):
                text += " It is optional, and the unit does not send it."
            parts.append(page.paragraph(text, kind="note"))
        rows = [_verdict(verdict) for verdict in one["verdicts"]]
        marked = [_MARKED.get(Result(verdict["result"]), "") for verdict in one["verdicts"]]
        parts.append(page.table(_VERDICTS_HEAD, rows, marked))
        configuration = (
            f"Scenario {one['config_hash']}, sequence {one['sequence_sha256'][:16]} (SHA-256), "
            f"seed {one['seed']}, {one['pacing']}. "
        )
        report = out / one["name"] / "report.html"
        link = page.file_link("report of the sequence", report, out)
        parts.append(page.paragraph(configuration, link))
    return parts


def _verdict(verdict: Mapping[str, Any]) -> tuple[str, ...]:
    value = verdict["value"]
    return (
        verdict["what"],
        "" if value is None else f"{rounded(value)} {verdict['unit']}".strip(),
        f"{verdict['limit']} {verdict['unit']}".strip(),
        verdict["result"],
        verdict_of.source_text(verdict["source"]),
    )


def _hashes(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [(found["programme"], found["programme_sha256"])]
    rows += list(found["tested"]["files"].items())
    for group in found["groups"]:
        for one in group["sequences"]:
            rows += [(f"{one['name']}/{file}", digest) for file, digest in one["files"].items()]
    return rows
