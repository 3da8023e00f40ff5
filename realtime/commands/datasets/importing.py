"""`rollerrig import`: makes a dataset of the files of a logger.

It proposes what each column is, and in which unit. The user sees the proposal and accepts it, on
the terminal or with --yes. Nothing is written before.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output

if TYPE_CHECKING:
    from rollerrig.realtime.datasets.imported import File, Run
    from rollerrig.rig.identify.files.proposal import Proposal

_SHOWN_UNUSED = 12  # columns that are not used; --json has all
KINDS = ("braking_runs", "creep_curve", "recorder")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig import`."""
    parser.add_argument(
        "file",
        nargs="+",
        type=Path,
        help="files of a logger with the same columns, one for each run: CSV, Parquet or MDF4",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DATASET", help="folder of the new dataset"
    )
    parser.add_argument(
        "--kind",
        choices=KINDS,
        default="",
        help="what the data are (default: found in the columns)",
    )
    parser.add_argument(
        "--vehicle",
        default="uic_z1",
        metavar="NAME",
        help="packaged vehicle whose parameters, and whose wheel radius, are used "
        "(default: uic_z1)",
    )
    parser.add_argument(
        "--map",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="the column of a channel, as in wheel_speed_1_m_s=v1; without a column the channel is "
        "left out; may be repeated",
    )
    parser.add_argument(
        "--unit",
        action="append",
        default=[],
        metavar="NAME=UNIT",
        help="the unit of a channel, or of all channels that begin with NAME, as in "
        "wheel_speed=km/h; may be repeated",
    )
    parser.add_argument(
        "--decimal",
        choices=("auto", ".", ","),
        default="auto",
        help="decimal mark of CSV files (default: found in the files)",
    )
    parser.add_argument(
        "--separator",
        choices=("auto", ",", ";", "tab", "|", "blanks"),
        default="auto",
        help="separator of CSV files (default: found in the files)",
    )
    parser.add_argument("--yes", action="store_true", help="accept the proposal without a question")


def call(options: argparse.Namespace) -> int:
    """Propose a dataset, ask, and write it.

    Returns PASS, or USAGE if the proposal is not accepted or is incomplete.
    """
    from rollerrig.realtime.datasets import imported
    from rollerrig.rig.identify.files import proposal

    mapped = _pairs(options.map, "--map", "wheel_speed_1_m_s=v1")
    given_units = _pairs(options.unit, "--unit", "wheel_speed=km/h")
    head = {"separator": options.separator, "decimal": options.decimal}
    for path in options.file:
        if not path.exists():
            raise ConfigError(f"{path}: no such file; give the files that the logger wrote")
    at = ""
    with output.report_progress(lambda: f"reading {at}"):
        files = []
        for path in options.file:
            at = str(path)
            files.append(imported.read(path, head))
    axles = imported.axles_of(options.vehicle)
    found = proposal.propose(files[0].contents, options.kind, mapped, given_units, axles)
    imported.check_keys(found.kind, [proposal.full_key(key, found.kind) for key in mapped], axles)
    imported.check_same_columns(files, found)

    missing = _missing(files, found)
    runs = [] if missing else [imported.describe_run(file, found) for file in files]
    result = _result(options, files, found, runs, missing)
    if missing:
        return _refuse(options, result, files, found, runs, "; ".join(missing))
    if not options.yes and (options.json or not sys.stdin.isatty()):
        return _refuse(
            options, result, files, found, runs, "nothing is written; accept it with --yes"
        )
    if not options.yes:
        _show(files, found, runs)
        answer = input(f"Write {options.out / 'dataset.toml'} with these channels? [y/N] ")
        if answer.strip().lower() not in ("y", "yes", "j", "ja"):
            output.print_message("rollerrig import: nothing is written")
            return output.USAGE

    with output.report_progress(lambda: f"writing {options.out}"):
        imported.write(options.out, files, found, runs, options.vehicle, head)
        warnings = imported.check(options.out, found.kind)
    result |= {"written": True, "warnings": warnings}
    items: list[Any] = []
    if options.yes:
        items = _items(files, found, runs)
    return output.show(
        options,
        result,
        *items,
        f"{options.out}: {len(files)} runs; next: rollerrig explain {options.out}",
    )


def _pairs(texts: list[str], option: str, example: str) -> dict[str, str]:
    """Return the values of NAME=VALUE by name. Raises ConfigError."""
    pairs = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name and sign):
            raise ConfigError(f"{option} {text}: write NAME=VALUE, as in {option} {example}")
        pairs[name.strip()] = value.strip()
    return pairs


def _missing(files: "list[File]", found: "Proposal") -> list[str]:
    """Return what a proposal lacks, each with the option that gives it."""
    missing = []
    keys = found.without_unit()
    if keys:
        missing.append(
            f"no unit is known for {', '.join(keys)}; give it, as in --unit {keys[0]}=km/h (or "
            f"--unit {keys[0].split('_')[0]}=km/h for all that begin so)"
        )
    needs_stamps = found.kind != "creep_curve" and files[0].table is not None
    if needs_stamps and found.channel("time_s") is None:
        missing.append("no column of stamps is recognised; give it, as in --map time_s=COLUMN")
    return missing


def _result(
    options: argparse.Namespace,
    files: "list[File]",
    found: "Proposal",
    runs: "list[Run]",
    missing: list[str],
) -> dict[str, Any]:
    """Return the proposal as a JSON object."""
    return {
        "dataset": str(options.out),
        "written": False,
        "kind": found.kind,
        "vehicle": options.vehicle,
        "files": [
            {"file": str(file.path), "form": file.form, "notes": list(file.notes)} for file in files
        ],
        "channels": [channel._asdict() for channel in found.channels],
        "unused": [unused._asdict() for unused in found.unused],
        "remarks": list(found.remarks),
        "runs": [run._asdict() for run in runs],
        "missing": missing,
    }


def _refuse(
    options: argparse.Namespace,
    result: dict[str, Any],
    files: "list[File]",
    found: "Proposal",
    runs: "list[Run]",
    reason: str,
) -> int:
    """Show a proposal that is not written, with the reason. Returns USAGE."""
    output.show(options, result | {"error": reason}, *_items(files, found, runs))
    output.print_message(f"rollerrig import: {reason}")
    return output.USAGE


def _show(files: "list[File]", found: "Proposal", runs: "list[Run]") -> None:
    """Show a proposal on the terminal."""
    output.show(argparse.Namespace(json=False), {}, *_items(files, found, runs))


def _items(files: "list[File]", found: "Proposal", runs: "list[Run]") -> list[Any]:
    """Return the lines and tables that show a proposal."""
    from rollerrig.rig.identify.files import proposal

    items: list[Any] = [f"{file.path}: {file.form}" for file in files]
    items += [f"note: {file.path.name}: {note}" for file in files for note in file.notes]
    rows = [
        (channel.key, channel.column, channel.unit or "-", channel.unit_from or "-")
        for channel in found.channels
    ]
    title = f"proposal: {found.kind}"
    items.append((title, ("channel", "column", "unit", "unit is from"), rows))
    if found.unused:
        # those that are recognised first
        unused = sorted(found.unused, key=lambda column: column.reason == proposal.UNKNOWN)
        rows = [tuple(column) for column in unused[:_SHOWN_UNUSED]]
        items.append(("columns that are not used", ("column", "why"), rows))
        if len(unused) > _SHOWN_UNUSED:
            items.append(f"and {len(unused) - _SHOWN_UNUSED} more columns (--json lists all)")
    for run in runs:
        if run.step_s > 0.0:
            items.append(
                f"{run.name}: {run.duration_s:.6g} s, samples {run.step_s:.4g} s apart"
                + (f", of {run.date}" if run.date else "")
            )
        items += [f"note: {note}" for note in run.notes]
    items += [f"note: {remark}" for remark in found.remarks]
    return items
