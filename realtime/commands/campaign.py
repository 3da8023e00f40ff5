"""`rollerrig campaign`: many runs from a plan, in processes or on a Dask cluster."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children, cores, interruption
from rollerrig.configs.table import nearest
from rollerrig.realtime.commands import output

if TYPE_CHECKING:
    from rollerrig.realtime.campaign import spreading
    from rollerrig.realtime.campaign.campaign import Plan

# runs that are not valid and that the terminal lists; the report lists all of them
_LISTED_NOT_VALID = 5


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig campaign`."""
    parser.add_argument("plan", help="name of a packaged campaign, or a TOML file")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the results; an unfinished campaign in it is continued "
        "(default: campaigns/PLAN)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=0,
        metavar="N",
        help="number of processes on this machine (default: the number of cores that this process may use)",
    )
    parser.add_argument(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="use the Dask scheduler at this address, as in tcp://host:8786, instead of "
        "processes on this machine",
    )
    parser.add_argument(
        "--device",
        choices=("cores", "cuda"),
        default="cores",
        help="what computes the stops: cores of a processor, or a GPU of NVIDIA (cuda), which the "
        "processes share (default: cores)",
    )
    parser.add_argument(
        "--unit",
        default="",
        metavar="COMMAND",
        help="command that starts your unit for each run, as in './my_unit {host} {port}'; it "
        "replaces the unit of the plan, and each run is a bench in lockstep with a separate bus",
    )
    parser.add_argument(
        "--allow-code",
        action="store_true",
        help="let the plan name a Python function as the unit (unit = package.module:function); it "
        "runs with your rights, so allow it only for plans that you trust",
    )
    parser.add_argument(
        "--worst",
        default="braking_distance_m",
        metavar="FIGURE",
        help="figure that ranks the worst cases (default: braking_distance_m, the stopping "
        "distance from the first brake demand)",
    )
    output.report_arguments(parser)


def call(options: argparse.Namespace) -> int:
    """Do the runs of a plan that are not done yet, and write the report.

    A plan with combinations of brakes is one campaign for each, in a folder of its name. Returns
    FAILED if a run had an error, INVALID if a run is not valid, and otherwise PASS.
    """
    from rollerrig.realtime.campaign import campaign, combined
    from rollerrig.realtime.reports import pdf
    from rollerrig.rig.compiled import device

    # all that can be wrong is checked before the first run
    if options.pdf:
        pdf.check()
    about = output.about(options)
    names = tuple(combined.read(options.plan)) or ("",)
    plans = [
        campaign.load(options.plan, options.allow_code, options.unit, combination, options.device)
        for combination in names
    ]
    for plan in plans:
        _check(options, plan)
    if options.device == campaign.CUDA and not options.scheduler:
        # in another process: one that has used a GPU cannot be forked
        with children.pool(1) as pool:
            output.print_message(f"the stops run on {pool.submit(device.name).result()}")

    out = options.out or Path("campaigns") / Path(options.plan).stem
    if names == ("",):
        return _show(options, [_play(options, plans[0], out, about)])
    combined.claim(out, names)
    done = []
    for number, plan in enumerate(plans, start=1):
        what = ", ".join(plan.isolates) or "nothing"
        output.print_message(
            f"combination {number} of {len(plans)}: {plan.combination} (isolates {what})"
        )
        done.append(_play(options, plan, out / plan.combination, about))
    return _show(options, done)


class _Done(NamedTuple):
    """A campaign that is done.

    status: of the command line. result: for programs. table: as `output.show` prints it.
    lines: in words.
    """

    status: int
    result: dict[str, Any]
    table: tuple[Any, ...]
    lines: list[str]


def _check(options: argparse.Namespace, plan: "Plan") -> None:
    """Raise ConfigError if an option does not fit a plan."""
    from rollerrig.realtime.campaign import large
    from rollerrig.realtime.record import figures

    if options.worst not in figures.BY_NAME:
        hint = nearest(options.worst, figures.BY_NAME)
        raise ConfigError(f"--worst {options.worst}: there is no such figure{hint}")
    if options.workers < 0:
        raise ConfigError(
            f"--workers {options.workers}: allowed are numbers from 1, or 0 for the number of cores"
        )
    if plan.is_large and options.worst != large.DISTANCE:
        raise ConfigError(
            f"--worst {options.worst}: of more than {plan.head['rows_up_to']} runs only those with the "
            f"longest stopping distance keep their rows; use --worst {large.DISTANCE}, or a larger "
            "rows_up_to in the plan"
        )


def _show(options: argparse.Namespace, done: list[_Done]) -> int:
    """Print campaigns that are done; return the exit status."""
    result = done[0].result
    items: list[Any] = []
    for one in done:
        items += [one.table, *one.lines]
    if len(done) > 1:
        result = {"combinations": {one.result["combination"]: one.result for one in done}}
    output.show(options, result, *items)
    statuses = {one.status for one in done}
    return next(
        (status for status in (output.FAILED, output.INVALID) if status in statuses), output.PASS
    )


def _play(options: argparse.Namespace, plan: "Plan", out: Path, about: dict[str, str]) -> _Done:
    """Do the runs of one plan that are not done yet, and write its report."""
    from rollerrig.realtime.campaign import campaign, outcome, stopping
    from rollerrig.realtime.record import figures
    from rollerrig.realtime.reports import campaign as campaign_report

    # without it SIGTERM would end this process before it has stopped its workers
    with interruption.Interruption():
        _run_chunks(options, plan, out)

    output.print_message("all runs are done; the report follows")
    found = outcome.read(plan, out)
    campaign.write_deviation(plan, out, *found.again)
    report = campaign_report.write(plan, found, out, options.worst, options.pdf, about)
    worst = campaign_report.worst(plan, found.longest, options.worst)
    not_valid = campaign_report.not_valid(plan, found)

    title_of_worst = figures.BY_NAME[options.worst].title
    lines = [f"{found.runs} runs, {found.not_valid} not valid; the worst {title_of_worst}:"]
    for case in worst:
        value = campaign_report.read_with_unit(options.worst, case[options.worst])
        lines.append(f"  run {case['run']}: {value}: {case['replay']}")
    for case in not_valid[:_LISTED_NOT_VALID]:
        lines.append(f"  run {case['run']} is not valid: {case['because']}: {case['replay']}")
    if sentence := campaign_report.step(plan, found):
        lines.append(sentence)
    lines.append(f"report: {report}")

    result = {
        "folder": str(out),
        "combination": plan.combination or None,
        "runs": found.runs,
        "failed": found.failed,
        "not_valid": found.not_valid,
        "step": {
            "step_s": plan.head[campaign.STEP],
            "ran_again": found.again[0],
            "largest_deviation": found.again[1],
        },
        "report": str(report),
        "worst": worst,
        "stopping_distance": stopping.bounds(found.distance_m),
        "tail": stopping.extrapolated(plan, found.distance_m),
        "not_valid_runs": not_valid,
        "warnings": [
            *campaign_report.contradictions(plan, about),
            *campaign_report.warnings(found),
        ],
    }
    title = plan.head["title"] or None
    if plan.combination:
        title = f"{plan.head['title']} [{plan.combination}]".strip()
    status = output.PASS
    if found.not_valid:
        status = output.INVALID
    if found.failed:
        status = output.FAILED
    table = (title, campaign_report.HEAD, campaign_report.cells(found))
    return _Done(status, result, table, lines)


def _run_chunks(options: argparse.Namespace, plan: "Plan", out: Path) -> None:
    """Do the runs whose chunks have no file in the folder yet, and show the progress.

    Raises ConfigError, and RollerrigError if runs could not be done or written.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from rollerrig.realtime.campaign import campaign, large

    merger = None
    if plan.is_large:
        campaign.claim(plan, out)
        merger = large.Merger(plan, out)
        chunks_to_do = list(plan.chunks)[merger.kept.chunks :]
    else:
        chunks_to_do = campaign.open_result(plan, out)

    # the longest stops run once more if the plan has a longer step than the scenario
    run_count = len(plan.points) + campaign.again_count(plan)
    console = output.console(error=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )

    def describe() -> str:
        # before the first result the workers may still compile, and report that
        task = bar.tasks[0]
        return f"{task.completed:.0f} of {run_count} {task.description}" if task.visible else ""

    # the last chunk may have fewer runs than the others
    chunks_done = len(plan.chunks) - len(chunks_to_do)
    runs_done = min(len(plan.points), chunks_done * plan.head["chunk"])
    if runs_done:
        output.print_message(f"continued: {runs_done} of {len(plan.points)} runs were there")
    with bar, output.report_progress(describe):
        task = bar.add_task("runs", total=run_count, completed=runs_done, visible=False)

        if merger is None:
            if chunks_to_do:
                for chunk, rows in _finished(options, campaign.work(plan), chunks_to_do):
                    campaign.write_chunk(out, chunk, rows)
                    bar.update(task, advance=len(rows), visible=True)
            again = campaign.open_again(plan, out)
            to_do = sum(len(stops) for stops in again.values())
            bar.update(task, completed=run_count - to_do)
            if again:
                bar.update(
                    task, description="runs: the longest stops again, with the step of the scenario"
                )
                for chunk, rows in _finished(options, campaign.work_again(again), list(again)):
                    campaign.write_again(out, chunk, rows)
                    bar.update(task, advance=len(rows), visible=True)
            return
        if not chunks_to_do:
            return
        with merger.writing():
            for chunk, found in _finished(options, large.work(plan, merger.kept), chunks_to_do):
                merger.add(chunk, found)
                bar.update(task, advance=found.runs, visible=True)


def _finished(
    options: argparse.Namespace, work: "spreading.Work", chunks: list[int]
) -> Iterator[tuple[int, Any]]:
    """Yield each chunk with its result when it is done, on this machine or on a cluster."""
    from rollerrig.realtime.campaign import spreading

    if options.scheduler:
        return spreading.on_a_cluster(work, chunks, options.scheduler, output.print_message)
    return spreading.on_this_machine(work, chunks, options.workers or cores.allowed())
