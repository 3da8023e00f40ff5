"""`rollerrig campaign`: many runs from a plan, over processes or a Dask cluster."""

import argparse
import os
import sys
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plan", help="name of a packaged campaign, or a TOML file")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the results (default: campaigns/PLAN); one that was begun is gone on with",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=0,
        metavar="N",
        help="processes on this machine (default: one a core)",
    )
    parser.add_argument(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="Dask scheduler, as in tcp://host:8786, instead of own processes",
    )
    parser.add_argument(
        "--worst",
        default="stop_distance_m",
        metavar="FIGURE",
        help="figure that ranks the worst cases (default: stop_distance_m)",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="write the report as PDF as well (report.pdf)"
    )


def call(given: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from rollerrig.realtime.campaign import campaign, stopping
    from rollerrig.realtime.record import figures
    from rollerrig.realtime.reports import campaign as campaign_report
    from rollerrig.realtime.reports import pdf

    if given.pdf:
        pdf.check()
    plan = campaign.load(given.plan)
    if given.worst not in figures.BY_NAME:
        raise ConfigError(f"--worst {given.worst}: allowed are {', '.join(figures.BY_NAME)}")
    out = given.out or Path("campaigns") / Path(given.plan).stem
    todo = campaign.open_result(plan, out)
    parts = (
        campaign.spread_dask(plan, todo, given.scheduler)
        if given.scheduler
        else campaign.spread_local(plan, todo, given.workers or os.cpu_count() or 1)
    )
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    console, count = Console(file=sys.stderr), len(plan.points)
    with (
        Progress(*columns, console=console, disable=not console.is_terminal) as progress,
        output.report_progress(lambda: f"{progress.tasks[0].completed:.0f} of {count} runs"),
    ):
        task = progress.add_task("runs", total=count)
        progress.advance(task, min(count, (len(plan.chunks) - len(todo)) * plan.head["chunk"]))
        if todo:
            for chunk, rows in parts:
                campaign.write_chunk(out, chunk, rows)
                progress.advance(task, len(rows))
    table = campaign.result(out)
    report = campaign_report.write(plan, table, out, given.worst, given.pdf)
    failed = sum(error is not None for error in table["error"].to_pylist())
    worst, left_out = (
        campaign_report.worst(plan, table, given.worst),
        campaign_report.not_valid(plan, table),
    )
    output.show(
        given,
        {
            "folder": str(out),
            "runs": table.num_rows,
            "failed": failed,
            "not_valid": len(left_out),
            "report": str(report),
            "worst": worst,
            "stopping_distance": stopping.bounds(table),
            "not_valid_runs": left_out,
        },
        (plan.head["title"] or None, campaign_report.HEAD, campaign_report.cells(table)),
        f"{table.num_rows} runs, {len(left_out)} not valid; the worst {given.worst}:",
        *(
            f"  run {case['run']}: {campaign_report.read(given.worst, case[given.worst])}: {case['replay']}"
            for case in worst
        ),
        *(
            f"  run {one['run']} is not valid: {one['because']}: {one['replay']}"
            for one in left_out[:5]
        ),
        f"report: {report}",
    )
    return output.FAILED if failed else output.INVALID if left_out else output.PASS
