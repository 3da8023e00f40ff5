"""`rollerrig compare`: runs side by side, by value with tolerances, and an overlay in Rerun."""

import argparse
import json
from pathlib import Path

PASS, FAILED = 0, 1
_SHOWN = 12


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", nargs="+", type=Path, help="folders of runs; the first is the reference")
    parser.add_argument("--tolerance", action="append", default=[], metavar="UNIT=VALUE",
                        help="largest difference allowed for a unit (m_s=0.1) or a channel "
                        "(sliding_1_m_s=0.5); may be repeated; beyond it the status is 1")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the overlay as .rrd")


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.record import compare
    from rollerrig.realtime.telemetry import viewer

    limits = compare.tolerances(given.tolerance)
    runs = compare.load(given.run)
    rows = compare.differences(runs, limits)
    failed = [row for row in rows if row.failed]
    if given.out:
        viewer.overlay(given.run, given.out)
    if given.json:
        print(json.dumps({
            "runs": [str(run.folder) for run in runs],
            "figures": [{"name": title, "unit": unit, "values": values}
                        for title, unit, values in compare.figures(runs)],
            "differences": [row._asdict() | {"failed": row.failed} for row in rows],
            "overlay": str(given.out) if given.out else None, "passed": not failed,
        }))
    else:
        _show(runs, rows, failed, limits, given.out)
    return FAILED if failed else PASS


def _show(runs, rows, failed, limits, overlay) -> None:  # type: ignore[no-untyped-def]
    from rich.console import Console
    from rich.table import Table

    from rollerrig.realtime.record import compare

    console = Console()
    table = Table("", "unit", *(run.folder.name for run in runs))
    for title, unit, values in compare.figures(runs):
        table.add_row(title, unit, *("-" if value is None else f"{value:.4g}" for value in values))
    console.print(table)
    table = Table("run", "channel", "largest difference", "rms", "at s", "tolerance")
    for row in failed[:_SHOWN]:
        table.add_row(Path(row.run).name, row.channel, f"{row.largest:.4g}", f"{row.rms:.4g}",
                      f"{row.at_s:.2f}", f"{row.tolerance:.4g}")
    if failed:
        console.print(table)
    if limits:
        console.print(f"{len(failed)} of {len(rows)} channels beyond their tolerance")
    if overlay:
        console.print(f"overlay: {overlay}", highlight=False)
