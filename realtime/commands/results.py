"""Finished runs: `rollerrig compare`, `view` and `export`; and a rig to take elsewhere: `rollerrig export-fmu`."""

import argparse
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output

_SHOWN = 12


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "run", nargs="+", type=Path, help="folders of runs; the first is the reference"
    )
    parser.add_argument(
        "--tolerance",
        action="append",
        default=[],
        metavar="UNIT=VALUE",
        help="largest difference allowed for a unit (m_s=0.1) or a channel "
        "(sliding_1_m_s=0.5); may be repeated; beyond it the status is 1",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the overlay as .rrd")


def compare(given: argparse.Namespace) -> int:
    from rollerrig.realtime.record import compare as by_value
    from rollerrig.realtime.record import figures, records
    from rollerrig.realtime.telemetry import viewer

    limits = by_value.tolerances(given.tolerance)
    if len(given.run) < 2:
        raise ConfigError(
            "compare needs at least two run folders, as in: rollerrig compare runs/a runs/b"
        )
    runs = [records.load(folder) for folder in given.run]
    rows, not_valid = by_value.differences(runs, limits), records.not_valid(given.run)
    shown = [
        (one.title, one.unit, [one.shown(run.summary) for run in runs]) for one in figures.FIGURES
    ]
    failed = [row for row in rows if row.failed]
    drifts = [by_value.drifts(run) for run in runs]
    shown += [
        (f"{name}, {part} third", "", [drift[name][k] for drift in drifts])
        for name in drifts[0]
        for k, part in enumerate(("first", "second", "last"))
    ]
    if given.out:
        viewer.overlay(given.run, given.out)
    output.show(
        given,
        {
            "runs": [str(run.folder) for run in runs],
            "warnings": not_valid,
            "figures": [
                {"name": title, "unit": unit, "values": values} for title, unit, values in shown
            ],
            "differences": [row._asdict() | {"failed": row.failed} for row in rows],
            "overlay": str(given.out) if given.out else None,
            "passed": not (failed or not_valid),
        },
        (
            None,
            ("", "unit", *(run.folder.name for run in runs)),
            (
                (title, unit, *("-" if value is None else f"{value:.4g}" for value in values))
                for title, unit, values in shown
            ),
        ),
        *(
            [
                (
                    None,
                    ("run", "channel", "largest difference", "rms", "at s", "tolerance"),
                    (
                        (
                            Path(row.run).name,
                            row.channel,
                            f"{row.largest:.4g}",
                            f"{row.rms:.4g}",
                            f"{row.at_s:.2f}",
                            f"{row.tolerance:.4g}",
                        )
                        for row in failed[:_SHOWN]
                    ),
                )
            ]
            if failed
            else ()
        ),
        *([f"{len(failed)} of {len(rows)} channels beyond their tolerance"] if limits else ()),
        *([f"overlay: {given.out}"] if given.out else ()),
    )
    return output.FAILED if failed else output.INVALID if not_valid and limits else output.PASS


def view_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", nargs="+", type=Path, help="folders of runs; several are overlaid")
    parser.add_argument(
        "--png", type=Path, metavar="FILE", help="write a picture instead, headless"
    )
    parser.add_argument("--size", default="1600x1000", metavar="WxH", help="of the picture")
    parser.add_argument("--time", type=float, metavar="S", help="time shown in the picture")


def view(given: argparse.Namespace) -> int:
    from rollerrig.realtime.record import records
    from rollerrig.realtime.telemetry import viewer

    warnings = records.not_valid(run for run in given.run if run.is_dir())
    if given.png:
        try:
            width, height = (int(part) for part in given.size.split("x"))
        except ValueError:
            raise ConfigError(
                f"--size {given.size}: write width x height, as in 1600x1000"
            ) from None
        result = {"picture": str(viewer.picture(given.run, given.png, (width, height), given.time))}
    else:
        result = viewer.open_run(given.run)
    return output.show(
        given,
        result | {"warnings": warnings},
        *(f"{key}: {value}" for key, value in result.items()),
    )


def export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument(
        "--format",
        required=True,
        metavar="FORMAT",
        help="mdf4, mat, csv, or svg: a picture of the stop",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="the file (default: in the run's folder, called as the run)",
    )


def export(given: argparse.Namespace) -> int:
    from rollerrig.realtime.record import export as formats
    from rollerrig.realtime.record import records
    from rollerrig.realtime.reports import stop

    run = records.load(given.run)
    out = (
        given.out or given.run / f"{given.run.resolve().name}{formats.SUFFIX.get(given.format, '')}"
    )
    files = formats.write(run, given.format, out, {"svg": stop.write})
    samples, channels, events = len(run.table), len(run.table.column_names), len(run.events)
    return output.show(
        given,
        {
            "files": [str(file) for file in files],
            "samples": samples,
            "channels": channels,
            "events": events,
            "warnings": records.not_valid([given.run]),
        },
        f"{samples} samples of {channels} channels and {events} events in {', '.join(map(str, files))}",
    )


def fmu_arguments(parser: argparse.ArgumentParser) -> None:
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


def export_fmu(given: argparse.Namespace) -> int:
    from rollerrig.firmware_sim.faults import panel
    from rollerrig.realtime.bench import as_fmu, scenario

    plan = scenario.load(given.scenario, given.model, tuple(given.set))
    panel.check_pacing(plan.faults, "free")
    count = as_fmu.write(plan, given.out)
    return output.show(
        given,
        {"file": str(given.out), "variables": count, "step_s": as_fmu.STEP_S},
        f"{given.out}: {count} variables, FMI 3.0, steps of {as_fmu.STEP_S:g} s; where it runs, Python "
        "with rollerrig has to be installed",
    )
