"""What is done with finished runs: `rollerrig compare`, `rollerrig view` and `rollerrig export`."""

import argparse
import json
import sys
from pathlib import Path

PASS, FAILED = 0, 1
_SHOWN = 12


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", nargs="+", type=Path, help="folders of runs; the first is the reference")
    parser.add_argument("--tolerance", action="append", default=[], metavar="UNIT=VALUE",
                        help="largest difference allowed for a unit (m_s=0.1) or a channel "
                        "(sliding_1_m_s=0.5); may be repeated; beyond it the status is 1")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the overlay as .rrd")


def compare(given: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from rollerrig.realtime.record import compare as by_value
    from rollerrig.realtime.telemetry import viewer

    limits = by_value.tolerances(given.tolerance)
    runs = by_value.load(given.run)
    rows = by_value.differences(runs, limits)
    figures = by_value.figures(runs)
    failed = [row for row in rows if row.failed]
    if given.out:
        viewer.overlay(given.run, given.out)
    if given.json:
        print(json.dumps({
            "runs": [str(run.folder) for run in runs],
            "figures": [{"name": title, "unit": unit, "values": values} for title, unit, values in figures],
            "differences": [row._asdict() | {"failed": row.failed} for row in rows],
            "overlay": str(given.out) if given.out else None, "passed": not failed,
        }))
        return FAILED if failed else PASS
    console = Console()
    table = Table("", "unit", *(run.folder.name for run in runs))
    for title, unit, values in figures:
        table.add_row(title, unit, *("-" if value is None else f"{value:.4g}" for value in values))
    console.print(table)
    if failed:
        table = Table("run", "channel", "largest difference", "rms", "at s", "tolerance")
        for row in failed[:_SHOWN]:
            table.add_row(Path(row.run).name, row.channel, f"{row.largest:.4g}", f"{row.rms:.4g}",
                          f"{row.at_s:.2f}", f"{row.tolerance:.4g}")
        console.print(table)
    if limits:
        console.print(f"{len(failed)} of {len(rows)} channels beyond their tolerance")
    if given.out:
        console.print(f"overlay: {given.out}", highlight=False)
    return FAILED if failed else PASS


def view_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", nargs="+", type=Path, help="folders of runs; several are overlaid")
    parser.add_argument("--png", type=Path, metavar="FILE", help="write a picture instead, headless")
    parser.add_argument("--size", default="1600x1000", metavar="WxH", help="of the picture")
    parser.add_argument("--time", type=float, metavar="S", help="time shown in the picture")


def view(given: argparse.Namespace) -> int:
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.telemetry import viewer

    if given.png:
        try:
            width, height = (int(part) for part in given.size.split("x"))
        except ValueError:
            raise ConfigError(f"--size {given.size}: write width x height, as in 1600x1000") from None
        result = {"picture": str(viewer.picture(given.run, given.png, (width, height), given.time))}
    else:
        result = viewer.open_run(given.run)
    if given.json:
        print(json.dumps(result, default=str))
    else:
        for key, value in result.items():
            print(f"{key}: {value}", file=sys.stderr)
    return PASS


def export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("--format", required=True, metavar="FORMAT", help="mdf4, mat or csv")
    parser.add_argument("--out", type=Path, metavar="FILE",
                        help="the file (default: in the run's folder, called as the run)")


def export(given: argparse.Namespace) -> int:
    from rollerrig.realtime.record import export as formats
    from rollerrig.realtime.record import records

    run = records.load(given.run)
    suffix = formats.SUFFIX.get(given.format, "")
    out = given.out or given.run / f"{given.run.resolve().name}{suffix}"
    files = formats.write(run, given.format, out)
    columns = run.table.column_names
    if given.json:
        print(json.dumps({"files": [str(file) for file in files], "samples": len(run.table),
                          "channels": len(columns), "events": len(run.events)}))
    else:
        print(f"{len(run.table)} samples of {len(columns)} channels and {len(run.events)} events in "
              f"{', '.join(str(file) for file in files)}")
    return PASS
