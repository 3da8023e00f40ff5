"""`rollerrig programme`: plays a test programme with one unit, and writes one evidence file.

Each sequence has a folder with its run and its report. When a sequence is done, its part of the
evidence is written there, with a fingerprint of what was tested. A programme that was stopped or
killed continues with the same command: it plays only sequences without such a part.
"""

import argparse
import contextlib
import copy
import hashlib
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.configs.processes import interruption
from rollerrig.realtime.commands import output, sequence, wsp

if TYPE_CHECKING:
    from rollerrig.wsp_interface.own_bench import Observer
    from rollerrig.wsp_interface.sequences.programme import Programme
    from rollerrig.wsp_interface.sequences.progress import Progress
    from rollerrig.wsp_interface.sequences.sequence import Sequence

# the part of the evidence in the folder of a sequence
PART = "evidence.json"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig programme`."""
    parser.add_argument("programme", help="name of a packaged programme, or a TOML file")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the evidence; an unfinished programme in it is continued "
        "(default: programmes/PROGRAMME)",
    )
    parser.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME",
        help="play only this group: its title, or the beginning of its title; may be repeated. The "
        "evidence then states that it is a part of the programme",
    )
    parser.add_argument(
        "--wsp",
        type=wsp.parse_unit,
        action=wsp.AppendUnit,
        default="",
        metavar="{reference,external,none,fmu:FILE}",
        help="WSP unit under test, the same in all sequences (default: reference)",
    )
    parser.add_argument(
        "--unit",
        default="",
        metavar="COMMAND",
        help="command that starts your unit for each run; {address}, {host} "
        "and {port} are replaced by those of the bus",
    )
    parser.add_argument(
        "--unit-map",
        type=Path,
        metavar="FILE",
        help="mapping between the CAN messages or variables of the unit and of the rig",
    )
    parser.add_argument(
        "--car",
        type=sequence.checked_cars,
        default="1",
        metavar="N",
        help="the cars of a train whose units are on buses, as --car of 'rollerrig run' (default: 1)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of all random numbers (default: 0)"
    )
    parser.add_argument(
        "--check", action="store_true", help="only read and check the programme, and run nothing"
    )
    output.report_arguments(parser)


def call(options: argparse.Namespace) -> int:
    """Play what is left of a programme, and write its evidence.

    Returns INVALID if a signal has interrupted it, FAILED if it has not passed, otherwise PASS.
    Raises ConfigError.
    """
    from rollerrig.realtime.record import played
    from rollerrig.realtime.reports import pdf
    from rollerrig.realtime.reports.evidence import programme as report
    from rollerrig.wsp_interface.sequences import programme as programme_file

    if options.unit and not options.wsp:
        options.wsp = "external"
    programme = programme_file.load(options.programme)
    if options.group:
        programme = programme.part(options.group)
    sequences = sequence.load(list(programme.sequences))
    if options.check:
        names = [one.name for one in sequences]
        return output.show(
            options,
            {"programme": programme.name, "checked": names},
            (None, ("group", "kind", "sequences"), _group_rows(programme)),
            f"{programme.name}: {sequence.count_text(len(names))} valid",
        )

    out = options.out or Path("programmes") / programme.name
    # a later call keeps the entries of the title block, and adds or changes those that it gives
    about = report.about_before(out) | output.about(options)
    options.about = [f"{key}={value}" for key, value in about.items()]
    if options.pdf:
        pdf.check()
    playing = _sequence_options(options, out)
    # all options are checked before the first bench starts
    sequence.check_options(playing, sequences)

    tested = _tested(options)
    marks = {one.name: _fingerprint(one, tested) for one in sequences}
    parts = _parts_done(out, marks)
    done_before = len(parts)
    left_names = [one.name for one in sequences if one.name not in parts]
    with interruption.Interruption() as interrupted:
        with (
            contextlib.suppress(KeyboardInterrupt),
            sequence.shown(left_names, done_before) as progress,
        ):
            for name, part in _play(sequences, playing, out, marks, parts, progress):
                parts[name] = part
                progress.finish(name)
        interrupted.ignore()
        warnings = played.contradictions([played.unit_in(tested["unit_played"])], about)
        evidence = report.evidence(programme, parts, tested, datetime.now(UTC), about, warnings)
        files = report.write(evidence, out, options.pdf)

    left = len(sequences) - len(parts)
    of_what = " (a part of the programme)" if evidence["is_part"] else ""
    output.show(
        options,
        {
            "result": evidence["result"],
            "programme": programme.name,
            "sequences": {name: parts[name]["result"] for name in parts},
            "done_before": done_before,
            "left": left,
            "not_judged": evidence["not_judged"],
            "warnings": warnings,
            "interrupted": interrupted.by or None,
            "files": [str(file) for file in files],
        },
        f"{evidence['result']}{of_what}: {len(parts)} of {len(sequences)} sequences done "
        f"({done_before} before); evidence in {files[0]} (not a certification)",
        *(f"could not be judged: {text}" for text in evidence["not_judged"]),
        *([f"interrupted: {left} are left; repeat the command to continue"] if left else []),
    )
    if interrupted.by:
        return output.INVALID
    return output.PASS if evidence["result"] == "pass" else output.FAILED


def _group_rows(programme: "Programme") -> list[tuple[str, str, str]]:
    """Return title, kind and names of the sequences of each group."""
    rows = []
    for group in programme.groups:
        names = ", ".join(Path(path).stem for path in group.sequences)
        rows.append((group.title, group.kind, names or "-"))
    return rows


def _sequence_options(options: argparse.Namespace, out: Path) -> argparse.Namespace:
    """Return the options of `rollerrig sequence` that play the sequences of a programme."""
    playing = copy.copy(options)
    playing.out = out
    playing.wsp = options.wsp or "reference"
    playing.bus = ""
    playing.pacing = "lockstep"
    playing.car = options.car
    playing.jobs = 1
    playing.steps = False
    playing.repeat = 1
    # the unit of the programme is the unit of all sequences
    playing.allow_unit = []
    return playing


def _tested(options: argparse.Namespace) -> dict[str, Any]:
    """Return what was tested, and the hash of each file that is known to belong to the unit.

    These are FMUs, the mapping, and the program and the files that the command names. Files that
    the program itself loads are not known.
    """
    from rollerrig.realtime.record import played

    text = options.wsp or "reference"
    unit = played.unit_of(text, options.unit_map, options.unit)
    return {
        "unit": text,
        "unit_played": unit._asdict(),
        "command": options.unit or None,
        "seed": options.seed,
        "files": dict(unit.sha256),
    }


def _fingerprint(one: "Sequence", tested: dict[str, Any]) -> str:
    """Return a hash of all that decides the outcome of a sequence, as far as rollerrig knows it.

    `tested` is from `_tested`.
    """
    from rollerrig.realtime.record import played

    of_scenario = sequence.digest_of(one)
    content = [
        tested,
        played.sha256(one.path),
        repr(one.criteria),
        of_scenario,
        metadata.version("rollerrig"),
    ]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _parts_done(out: Path, marks: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Return the parts of the evidence that are in the folder and belong to this programme."""
    from rollerrig.configs import user_files

    parts = {}
    for name, mark in marks.items():
        path = out / name / PART
        if not path.is_file():
            continue
        part = user_files.read_json(path, within=out)
        if isinstance(part, dict) and part.get("fingerprint") == mark:
            parts[name] = part
    return parts


def _play(
    sequences: "list[Sequence]",
    playing: argparse.Namespace,
    out: Path,
    marks: dict[str, str],
    done: dict[str, dict[str, Any]],
    progress: "Progress",
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Play the sequences that are not done; yield each with its part of the evidence.

    Raises KeyboardInterrupt if a signal has ended a sequence.
    """
    for one in sequences:
        if one.name in done:
            continue
        in_folder = copy.copy(playing)
        in_folder.out = out / one.name
        with writing(in_folder.out):
            make_folder(out, one.name)
        observer = sequence.observer(one.name, progress, in_folder)
        yield one.name, _play_one(one, in_folder, marks[one.name], observer)


def _play_one(
    one: "Sequence", options: argparse.Namespace, mark: str, observer: "Observer"
) -> dict[str, Any]:
    """Play a sequence, write its report, and write and return its part of the evidence."""
    from rollerrig.realtime.record import played
    from rollerrig.realtime.reports import sequences as report
    from rollerrig.realtime.reports.evidence import programme as evidence

    outcome = sequence.play_or_error(one, options, observer)
    if outcome.interrupted:
        raise KeyboardInterrupt
    sequence.print_outcome(outcome)
    report.write([outcome], options.out, None, output.about(options))
    (data,) = report.as_data([outcome], datetime.now(UTC))["sequences"]
    part: dict[str, Any] = {"fingerprint": mark} | data
    part["sequence_sha256"] = played.sha256(one.path)
    part["signals"] = evidence.recorded(outcome.folder)
    part["files"] = {
        str(path.relative_to(options.out)): played.sha256(path)
        for path in sorted(options.out.rglob("*"))
        if path.is_file() and path.name != PART
    }
    # last, so that a part that exists belongs to a sequence that is done
    write_text(options.out / PART, json.dumps(part, indent=1))
    return part
