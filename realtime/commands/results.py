"""Verbs for finished runs: `rollerrig compare`, `view` and `export`. Also `rollerrig export-fmu`.

`export-fmu` writes the rig as an FMU for other simulation programs.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.number_text import rounded
from rollerrig.realtime.commands import output

if TYPE_CHECKING:
    from rollerrig.realtime.record.compare import Difference
    from rollerrig.realtime.record.records import Run

DATASET = "dataset"  # a format of `export`
# the file that only the folder of a campaign has, see `campaign.claim`
PLAN = "plan.json"
# rows of the table of differences; --json has all of them
_TABLE_ROWS = 12
# a difference of sums that is smaller than this share of them is of their rounding
_ROUNDING = 1e-12
_THIRDS = ("first third", "second third", "last third")


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig compare`."""
    parser.add_argument(
        "run",
        nargs="+",
        type=Path,
        help="folders of runs, or of two campaigns; the first is the reference",
    )
    parser.add_argument(
        "--tolerance",
        action="append",
        default=[],
        metavar="UNIT=VALUE",
        help="largest allowed difference for a unit (m_s=0.1) or a channel "
        "(sliding_1_m_s=0.5); may be repeated; a larger difference gives exit status 1",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="write a Rerun recording (.rrd) of all runs"
    )


def compare(options: argparse.Namespace) -> int:
    """Print the figures of several runs, and the channels that differ too much from the first run.

    Two campaigns are compared as two samples of runs. Returns FAILED if a channel exceeds its
    tolerance or a run of a campaign failed, otherwise INVALID if a run is not valid, and otherwise
    PASS.
    """
    campaigns = [folder for folder in options.run if (folder / PLAN).is_file()]
    if campaigns:
        return _compare_campaigns(options, campaigns)

    # imported here, so that the other verbs start quickly
    from rollerrig.realtime.record import compare as comparison
    from rollerrig.realtime.record import records
    from rollerrig.realtime.telemetry import viewer

    if len(options.run) < 2:
        raise ConfigError(
            "compare needs at least two run folders, as in: rollerrig compare runs/a runs/b"
        )

    runs = [records.load(folder) for folder in options.run]
    tolerances = comparison.tolerances(options.tolerance, runs[0].signal_table)
    differences = comparison.differences(runs, tolerances)
    warnings = records.not_valid(options.run)
    failed = [difference for difference in differences if difference.failed]
    figures = _figures(runs)
    if options.out:
        viewer.overlay(options.run, options.out)

    result = {
        "runs": [str(run.folder) for run in runs],
        "warnings": warnings,
        "figures": [figure._asdict() for figure in figures],
        "differences": [
            difference._asdict() | {"failed": difference.failed} for difference in differences
        ],
        "overlay": str(options.out) if options.out else None,
        "passed": not (failed or warnings),
    }

    items: list[Any] = _figure_tables(runs, figures)
    if failed:
        items.append(_difference_table(runs, failed))
    if tolerances:
        items.append(f"{len(failed)} of {len(differences)} channels exceed their tolerance")
    if options.out:
        items.append(f"overlay: {options.out}")
    output.show(options, result, *items)

    if failed:
        return output.FAILED
    if warnings:
        return output.INVALID
    return output.PASS


def _compare_campaigns(options: argparse.Namespace, campaigns: Sequence[Path]) -> int:
    """Print how the second campaign differs from the first one. Raises ConfigError.

    `campaigns` are those of the folders that hold a campaign.
    """
    from rollerrig.realtime.campaign import comparison
    from rollerrig.realtime.reports.statistics import comparison as report

    others = [folder for folder in options.run if folder not in campaigns]
    if others:
        raise ConfigError(
            f"{campaigns[0]} holds a campaign, and {others[0]} does not; compare two campaigns, or "
            "runs with each other"
        )
    if len(campaigns) != 2:
        raise ConfigError(
            f"{len(campaigns)} campaigns are given; compare two, as in: rollerrig compare "
            "campaigns/a campaigns/b"
        )
    for option, value in (("--tolerance", options.tolerance), ("--out", options.out)):
        if value:
            raise ConfigError(f"{option} is for runs; compare two campaigns without it")

    first, second = map(comparison.read, campaigns)
    found = comparison.compare(first, second)
    output.show(
        options,
        report.as_json(found) | {"warnings": report.warnings(found)},
        report.run_table(found),
        report.figure_table(found),
        report.difference_table(found),
        *report.sentences(found),
        *report.worst_lines(found),
    )
    if first.found.failed or second.found.failed:
        return output.FAILED
    if first.found.not_valid or second.found.not_valid:
        return output.INVALID
    return output.PASS


class _Figure(NamedTuple):
    """One figure of all compared runs. The field names are keys of the JSON result."""

    name: str
    unit: str
    values: list[float | None]
    # of each further run: its value less that of the first; None where one of them has none
    differences: list[float | None]


def _figures(runs: "Sequence[Run]") -> list[_Figure]:
    """Return the figures of the summaries, then the drifts over the thirds of each stop."""
    from rollerrig.realtime.record import compare as comparison
    from rollerrig.realtime.record import figures

    compared: list[_Figure] = []
    for figure in figures.FIGURES:
        values = [figure.shown(run.summary) for run in runs]
        compared.append(_Figure(figure.title, figure.unit, values, _less_the_first(values)))

    drifts = [comparison.drifts(run) for run in runs]
    for name in drifts[0]:
        for number, third in enumerate(_THIRDS):
            values = [drift[name][number] for drift in drifts]
            differences = _less_the_first(values)
            compared.append(_Figure(f"{name}, {third}", "", values, differences))
    return compared


def _less_the_first(values: Sequence[float | None]) -> list[float | None]:
    """Return each further value less the first one; None where one of them is missing."""
    first, *others = values
    differences: list[float | None] = []
    for value in others:
        if first is None or value is None:
            differences.append(None)
        elif math.isclose(value, first, rel_tol=_ROUNDING):
            differences.append(0.0)
        else:
            differences.append(value - first)
    return differences


def _figure_tables(runs: "Sequence[Run]", figures: Sequence[_Figure]) -> list[Any]:
    """Return the table of figures for `output.show`.

    Columns are the value of each run, and the difference of each further run from the first; "-"
    for no value. The differences of more than two runs have a table.
    """
    from rollerrig.realtime.record.run_folder import short_names

    names = short_names([run.folder for run in runs])
    values = []
    differences = []
    for figure in figures:
        begin = (figure.name, figure.unit)
        cells = ["-" if value is None else rounded(value) for value in figure.values]
        values.append((*begin, *cells))
        cells = ["-" if value is None else _signed(value) for value in figure.differences]
        differences.append((*begin, *cells))
    if len(runs) > 2:
        return [
            (None, ("", "unit", *names), values),
            (f"less {names[0]}", ("", "unit", *names[1:]), differences),
        ]
    rows = [(*row, *cells[2:]) for row, cells in zip(values, differences, strict=True)]
    return [(None, ("", "unit", *names, f"{names[1]} - {names[0]}"), rows)]


def _signed(difference: float) -> str:
    """Return a difference with its sign."""
    text = rounded(difference, 3)
    return f"+{text}" if difference > 0.0 else text


def _difference_table(
    runs: "Sequence[Run]", differences: "Sequence[Difference]"
) -> tuple[Any, ...]:
    """Return the table of the first differences for `output.show`."""
    from rollerrig.realtime.record.run_folder import short_names

    folders = [run.folder for run in runs]
    names = dict(zip(map(str, folders), short_names(folders), strict=True))
    head = ("run", "channel", "largest difference", "rms", "at s", "tolerance")
    rows = [
        (
            names[difference.run],
            difference.channel,
            rounded(difference.largest),
            rounded(difference.rms),
            f"{difference.at_s:.2f}",
            rounded(difference.tolerance),
        )
        for difference in differences[:_TABLE_ROWS]
    ]
    return None, head, rows


def view_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig view`."""
    parser.add_argument(
        "run", nargs="+", type=Path, help="folders of runs; several runs are overlaid"
    )
    parser.add_argument(
        "--png",
        type=Path,
        metavar="FILE",
        help="write a picture for a report and open no window: speeds, slip, pressures, adhesion "
        "and valves on white, with a legend that names the runs; a name that ends with .svg or .pdf "
        "gives that kind of file",
    )
    parser.add_argument(
        "--size",
        default="1600x1000",
        metavar="WxH",
        help="size of the picture in pixels (default: 1600x1000)",
    )
    parser.add_argument(
        "--time",
        type=float,
        metavar="S",
        help="with --png: write the picture of the viewer instead, with the rig in 3D at this time "
        "of the run; it needs a Vulkan driver",
    )


def view(options: argparse.Namespace) -> int:
    """Open runs in the viewer, or write a picture of them. Returns PASS."""
    from rollerrig.realtime.record import records
    from rollerrig.realtime.reports import stop
    from rollerrig.realtime.telemetry import viewer

    warnings = records.not_valid(run for run in options.run if run.is_dir())
    if options.png:
        size = _picture_size(options.size)
        if options.time is None:
            picture = stop.write_runs([records.load(run) for run in options.run], options.png, size)
        else:
            picture = viewer.picture(options.run, options.png, size, options.time)
        result = {"picture": str(picture)}
    else:
        result = viewer.open_run(options.run)

    lines = [f"{key}: {value}" for key, value in result.items()]
    return output.show(options, result | {"warnings": warnings}, *lines)


def _picture_size(text: str) -> tuple[int, int]:
    """Return width and height in pixels, read from a text such as "1600x1000".

    Raises ConfigError.
    """
    try:
        width, height = (int(part) for part in text.split("x"))
    except ValueError:
        raise ConfigError(
            f"--size {text}: write width x height in pixels, as in 1600x1000"
        ) from None
    if width < 1 or height < 1:
        raise ConfigError(f"--size {text}: width and height must be at least 1 pixel")
    return width, height


def export_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig export`."""
    parser.add_argument("run", nargs="+", type=Path, help="folders of runs")
    parser.add_argument(
        "--format",
        required=True,
        metavar="FORMAT",
        help="mdf4, mat, csv, mcap, svg: a picture of the stop, or dataset: one dataset of all runs, as "
        "their sensors measure them, for 'rollerrig explain'",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="the file to write, or the folder of the dataset (default: in the folder of each run, "
        "with the name of the folder; a dataset needs --out)",
    )


def export(options: argparse.Namespace) -> int:
    """Write runs in the format of another program, or as a dataset. Returns PASS."""
    if options.format == DATASET:
        return _export_dataset(options)

    from rollerrig.realtime.record import export as formats
    from rollerrig.realtime.record import records
    from rollerrig.realtime.reports import stop

    if options.out and len(options.run) > 1:
        raise ConfigError(
            f"--out {options.out}: is one file, but {len(options.run)} runs are given; leave --out "
            "out, so that each run gets its file in its folder"
        )
    files: list[Path] = []
    samples = 0
    events = 0
    channels = 0
    for folder in options.run:
        run = records.load(folder)
        suffix = formats.SUFFIX.get(options.format, "")
        out = options.out or folder / f"{folder.resolve().name}{suffix}"
        files += formats.write(run, options.format, out, {"svg": stop.write})
        samples += len(run.table)
        events += len(run.events)
        channels = max(channels, len(run.table.column_names))
    result = {
        "files": [str(file) for file in files],
        "samples": samples,
        "channels": channels,
        "events": events,
        "warnings": records.not_valid(options.run),
    }
    names = ", ".join(map(str, files))
    return output.show(
        options,
        result,
        f"{samples} samples of {channels} channels and {events} events in {names}",
    )


def _export_dataset(options: argparse.Namespace) -> int:
    """Write a dataset of runs. Returns PASS."""
    from rollerrig.realtime.commands import study

    if options.out is None:
        raise ConfigError("--format dataset needs the folder of the dataset: --out DATASET")
    if (options.out / "dataset.toml").exists():
        raise ConfigError(
            f"{options.out / 'dataset.toml'}: is there already; give another folder with --out, or "
            "remove it"
        )
    with output.report_progress(lambda: f"writing {options.out}"):
        data = study.dataset_of_runs(options.run, [], options.out)
    validated = [run.name for run in data.group("validate")]
    result = {
        "dataset": str(options.out),
        "runs": [run.name for run in data.runs],
        "validate": validated,
        "warnings": data.warnings,
    }
    return output.show(
        options,
        result,
        f"{options.out}: {len(data.runs)} runs, {len(validated)} of them only to validate; next: "
        f"rollerrig explain {options.out}",
    )


def fmu_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig export-fmu`."""
    parser.add_argument("scenario", help="name of a packaged scenario, or a TOML file")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("rig.fmu"),
        metavar="FILE",
        help="the FMU to write (default: rig.fmu)",
    )
    parser.add_argument("--model", default="", metavar="FILE", help="an extended model to load")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one value, as in adhesion.mu_cd=0.05; may be repeated",
    )


def export_fmu(options: argparse.Namespace) -> int:
    """Write the rig with a scenario as an FMU. Returns PASS."""
    from rollerrig.firmware_sim.faults import panel
    from rollerrig.realtime.bench import scenario
    from rollerrig.realtime.bench.rig_fmu import description, export

    plan = scenario.load(options.scenario, options.model, tuple(options.set))
    panel.check_without_bus(
        plan.faults, "the FMU of a rig", f"remove the fault from scenario {options.scenario}"
    )
    variables = export.write(plan, options.out)
    return output.show(
        options,
        {"file": str(options.out), "variables": variables, "step_s": description.STEP_S},
        f"{options.out}: {variables} variables, FMI 3.0, steps of {description.STEP_S:g} s; Python with "
        "rollerrig must be installed where the FMU runs",
    )
