"""`rollerrig campaign`: many runs from a plan, over processes or a Dask cluster."""

import argparse
import json
import os
import sys
from pathlib import Path

PASS, FAILED = 0, 1


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plan", help="name of a packaged campaign, or a TOML file")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results (default: "
                        "campaigns/PLAN); one that was begun is gone on with")
    parser.add_argument("--workers", type=int, default=0, metavar="N",
                        help="processes on this machine (default: one a core)")
    parser.add_argument("--scheduler", default="", metavar="ADDRESS",
                        help="Dask scheduler, as in tcp://host:8786, instead of own processes")
    parser.add_argument("--worst", default="stop_distance_m", metavar="FIGURE",
                        help="figure that ranks the worst cases (default: stop_distance_m)")


def call(given: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.campaign import campaign
    from rollerrig.realtime.record import figures
    from rollerrig.realtime.reports import campaign as campaign_report

    plan = campaign.load(given.plan)
    if given.worst not in figures.BY_NAME:
        raise ConfigError(f"--worst {given.worst}: allowed are {', '.join(figures.BY_NAME)}")
    out = given.out or Path("campaigns") / Path(given.plan).stem
    todo = campaign.open_result(plan, out)
    workers = given.workers or os.cpu_count() or 1
    parts = (campaign.spread_dask(plan, todo, given.scheduler) if given.scheduler
             else campaign.spread_local(plan, todo, workers))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(file=sys.stderr)) as progress:
        task = progress.add_task("runs", total=len(plan.points))
        chunk_size = plan.head["chunk"]
        progress.advance(task, min(len(plan.points), (len(plan.chunks) - len(todo)) * chunk_size))
        if todo:
            for chunk, rows in parts:
                campaign.write_chunk(out, chunk, rows)
                progress.advance(task, len(rows))
    table = campaign.result(out)
    report = campaign_report.write(plan, table, out, given.worst)
    failed = sum(error is not None for error in table["error"].to_pylist())
    if given.json:
        print(json.dumps({"folder": str(out), "runs": table.num_rows, "failed": failed,
                          "report": str(report),
                          "worst": campaign_report.worst(plan, table, given.worst)}))
    else:
        campaign_report.show(plan, table, given.worst, report)
    return FAILED if failed else PASS
