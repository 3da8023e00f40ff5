"""`rollerrig run`: one bench run, its progress line, its table and its exit status.

With --repeat it does the same run with several seeds, and prints one table of their figures.
"""

import argparse
import asyncio
import copy
import itertools
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output, wsp
from rollerrig.realtime.record import run_folder

if TYPE_CHECKING:
    from rollerrig.realtime.bench.options import Progress
    from rollerrig.realtime.train.plan import Train

_SPREAD_HEAD = ("figure", "unit", "runs", *output.SPREAD.values())

# exit status of a run that has missed deadlines, under --strict
LATE = 3

# s between progress lines if standard error is not a terminal
_PROGRESS_S = 5.0


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig run`."""
    parser.add_argument("scenario", help="name of a packaged scenario or train, or a TOML file")
    parser.add_argument(
        "--pacing",
        choices=("wall", "lockstep", "free"),
        default="wall",
        help="wall: in real time; lockstep: each bus cycle waits for the answer of the WSP unit, "
        "so that a run is repeatable; free: without a bus, at full speed (default: wall)",
    )
    parser.add_argument(
        "--wsp",
        type=wsp.parse_unit,
        action=wsp.AppendUnit,
        default="reference",
        metavar="{reference,external,none,fmu:FILE}",
        help="reference: the reference unit, in a separate process on the bus; external: wait for "
        "the heartbeat of a unit on the bus; fmu:FILE: an FMU (FMI 2 or 3, co-simulation) in a "
        "separate process, may be repeated for FMUs that share the bus by CAN ports "
        "(FMI-LS-BUS); none: no unit (default: reference)",
    )
    wsp.unit_argument(parser)
    # for the record: the command with which another program starts an external unit
    parser.add_argument("--started-unit", default="", help=argparse.SUPPRESS)
    wsp.map_argument(parser)
    parser.add_argument(
        "--car",
        type=parse_cars,
        default=(1,),
        metavar="N",
        help="of a train in lockstep or in real time: the car, from the front, whose unit is on a "
        "bus, or several as in 1,3, or all; --wsp or --unit is started for each; all other cars "
        "have reference units (default: 1)",
    )
    parser.add_argument("--model", default="", metavar="FILE", help="load an extended model")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the run (default: runs/SCENARIO, with a number if it exists)",
    )
    parser.add_argument(
        "--replace",
        action="store_true",
        help="replace the run in --out without a question on the terminal; other files there are "
        "kept",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="show the run live in Rerun: in a window, or, without a screen, as a page for a "
        "browser, whose address is printed",
    )
    parser.add_argument(
        "--hold",
        action="store_true",
        help="with --live: begin the run when a viewer has connected",
    )
    parser.add_argument(
        "--strict", action="store_true", help="return exit status 3 if a deadline is missed"
    )
    parser.add_argument(
        "--also-without-wsp",
        action="store_true",
        help="after the run, compute the same stop without WSP in free pacing, print its "
        "distance, and record it in the folder without_wsp of the run",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of all random numbers (default: 0)"
    )
    parser.add_argument(
        "--repeat",
        type=int,
        default=1,
        metavar="N",
        help="do the run N times, with the seeds from --seed on, in the folders 1 to N of --out, and "
        "print one table of their figures (default: 1)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change a value of the scenario, as in adhesion.mu_cd=0.05; may be repeated",
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="'KIND KEY=VALUE ...'",
        help="inject a fault from the list that 'rollerrig list faults' prints, as in "
        "'speed_sensor_stuck axle=2 at=5 for=3'; may be repeated",
    )
    parser.add_argument(
        "--start",
        choices=("now", "modbus"),
        default="now",
        help="modbus: let the rig roll at its set speed until a Modbus client starts the stop "
        "(default: now)",
    )
    parser.add_argument(
        "--harness",
        action="store_true",
        help="begin the run when a test harness (node 127) has joined the bus, for example "
        "'rollerrig sequence --bus'",
    )
    parser.add_argument(
        "--wait",
        type=float,
        default=60.0,
        metavar="S",
        help="longest wait for a WSP unit to appear on the bus, in s (default: 60)",
    )
    parser.add_argument(
        "--answer-wait",
        type=float,
        default=10.0,
        metavar="S",
        help="in lockstep: longest wait for the answer of a WSP unit, in s (default: 10); a "
        "harness, and a unit that the bench has started and that still runs, get six times as "
        "long",
    )


class Recorded(NamedTuple):
    """A run that is recorded: its summary, and what the terminal shows of it.

    result: the summary, with what --json prints besides.
    """

    summary: dict[str, Any]
    result: dict[str, Any]
    items: list[Any]


def call(options: argparse.Namespace) -> int:
    """Do one run, or several with --repeat, and return the exit status."""
    options.wsp = wsp.with_command(options, default="reference")
    _check_repeat(options)
    if options.repeat > 1:
        folder = options.out or free_folder(Path(options.scenario).stem)
        runs = [_record(one) for one in _options_of_runs(options, folder)]
        _show_runs(options, folder, [run.summary for run in runs])
        return max(_status(options, run.summary) for run in runs)

    run = _record(options)
    output.show(options, run.result, *run.items)
    return _status(options, run.summary)


def _check_repeat(options: argparse.Namespace) -> None:
    """Raise ConfigError for a number of runs that cannot be, or with what is for one run only."""
    if options.repeat < 1:
        raise ConfigError(f"--repeat {options.repeat}: allowed are numbers from 1")
    if options.repeat > 1 and options.also_without_wsp:
        raise ConfigError(
            "--repeat and --also-without-wsp: a stop without WSP is computed for one run; leave one of "
            "the options out"
        )


def _options_of_runs(options: argparse.Namespace, folder: Path) -> Iterator[argparse.Namespace]:
    """Yield the options of each run: folder and seed count up."""
    for number in range(options.repeat):
        of_run = copy.copy(options)
        of_run.out = folder / str(number + 1)
        of_run.seed = options.seed + number
        yield of_run


def _show_runs(
    options: argparse.Namespace, folder: Path, summaries: Sequence[Mapping[str, Any]]
) -> None:
    """Print the figures of all runs that are valid, and why the others are not."""
    from rollerrig.realtime.record import figures, validity

    found = figures.spread(summaries)
    rows = [
        (one["title"], one["unit"], str(one["runs"]), *(f"{one[key]:.6g}" for key in output.SPREAD))
        for one in found
    ]
    lines = [f"recorded in {folder}/1 to {folder}/{len(summaries)}"]
    not_valid = []
    for number, summary in enumerate(summaries, start=1):
        for reason in validity.because(summary):
            not_valid.append({"run": number, "because": reason})
            lines.append(f"run {number} is not valid: {reason}")
    if not any(summary["random"] for summary in summaries):
        lines.append("nothing in these runs of the rig is random: their seeds have no effect")
    output.show(
        options,
        {
            "folder": str(folder),
            "runs": list(summaries),
            "not_valid": not_valid,
            "figures": found,
        },
        (f"{len(summaries)} runs", _SPREAD_HEAD, rows),
        *lines,
    )


def _status(options: argparse.Namespace, summary: dict[str, Any]) -> int:
    if summary["invalid_because"]:
        return output.INVALID
    if options.strict and summary["loop"]["missed"]:
        return LATE
    return output.PASS


def _record(options: argparse.Namespace) -> Recorded:
    """Do one run. Raises RollerrigError."""
    from rollerrig.configs.processes import children
    from rollerrig.realtime.bench.options import waiting_processes

    # the processes of the run load their libraries while this process prepares the run
    needs_reference_unit = options.wsp == "reference" and options.pacing != "free"
    unit = wsp.run_from_stdin if needs_reference_unit else None
    with waiting_processes(children.can_fork(), unit) as processes:
        return _run(options, processes)


def _run(options: argparse.Namespace, processes: dict[str, Any]) -> Recorded:
    from rollerrig.realtime.bench import bench, scenario, tick_data
    from rollerrig.realtime.bench.options import Options
    from rollerrig.realtime.reports import without_wsp
    from rollerrig.rig.compiled import compile_progress

    train = _train_of(options)
    if train is not None:
        return _run_train(train, options, processes)
    compile_progress.expect(tick_data.KERNELS[options.pacing])
    plan = scenario.load(
        options.scenario,
        options.model,
        tuple(options.set),
        faults=tuple(options.fault),
        sources=scenario.PYTHON if options.from_python else scenario.COMMAND_LINE,
    )
    out = options.out or free_folder(plan.name)
    _announce_replacement(out, options)
    bench_options = Options(
        pacing=options.pacing,
        unit=options.wsp,
        out=out,
        live=options.live,
        hold=options.hold,
        seed=options.seed,
        unit_wait_s=options.wait,
        answer_wait_s=options.answer_wait,
        start=options.start,
        harness=options.harness,
        unit_map=options.unit_map,
        prepare_free=options.also_without_wsp,
        started_unit=options.started_unit,
        **processes,
    )

    # what cannot be computed without WSP is refused before the run
    options_without = without_wsp.options_in(out, options.seed)
    if options.also_without_wsp:
        bench.check(plan, options_without)

    progress_line = ProgressLine()
    summary = asyncio.run(bench.Bench(plan, bench_options, progress_line).run())
    progress_line.close()

    items = [] if options.json else _items(summary, out)
    if options.seed and not summary["random"]:
        items.append(
            f"--seed {options.seed} has no effect: nothing in this run of the rig is random (noise of a "
            "speed sensor is: sensor.noise_rad_s, fault speed_noise_burst, wheel flats with noise)"
        )
    result = summary | {"folder": str(out)}
    if options.also_without_wsp:
        without = without_wsp.record(plan, options_without, progress_line)
        progress_line.close()
        result["without_wsp"] = without._asdict()
        items.append(without_wsp.sentence(without))
        folders = f"{shlex.quote(str(out))} {shlex.quote(without.folder)}"
        items.append(f"compare both with: rollerrig compare {folders}")
        picture = shlex.quote(str(out / "both.png"))
        items.append(f"draw both with: rollerrig view {folders} --png {picture}")
    return Recorded(summary, result, items)


def parse_cars(text: str) -> tuple[int, ...]:
    """Return the cars of N, N,N or all; none for all. Raises ArgumentTypeError."""
    if text == "all":
        return ()
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: write the numbers of cars, as in 2 or 1,3, or all"
        ) from None


def _train_of(options: argparse.Namespace) -> "Train | None":
    """Return the train that is to be run; None where the scenario is that of one vehicle.

    Raises ConfigError, also for options that a train does not have.
    """
    from rollerrig.realtime.bench import scenario
    from rollerrig.realtime.train import plan

    if plan.find(options.scenario) is None:
        plan.check_name(options.scenario)
        return None
    plan.check_options(
        {
            f"--wsp {options.wsp} with --pacing free": options.pacing == "free"
            and options.wsp not in ("reference", "none"),
            f"--wsp none with --pacing {options.pacing}": options.pacing != "free"
            and options.wsp == "none",
            "--live": options.live,
            "--hold": options.hold,
            "--start modbus": options.start != "now",
            "--harness": options.harness,
            "--also-without-wsp": options.also_without_wsp,
            "--fault": bool(options.fault),
        }
    )
    return plan.load(
        options.scenario,
        options.model,
        tuple(options.set),
        scenario.PYTHON if options.from_python else scenario.COMMAND_LINE,
    )


def _run_train(train: "Train", options: argparse.Namespace, processes: dict[str, Any]) -> Recorded:
    """Run a train, write its report, and return it."""
    from rich.text import Text

    from rollerrig.realtime.bench.options import Options
    from rollerrig.realtime.reports import train as report
    from rollerrig.realtime.train import run

    out = options.out or free_folder(train.name)
    _announce_replacement(out, options)
    progress_line = ProgressLine()
    if options.pacing == "free":
        summary = run.record_free(train, options.wsp, out, options.seed, progress_line)
    else:
        of_car = Options(
            pacing=options.pacing,
            unit=options.wsp,
            out=out,
            seed=options.seed,
            unit_wait_s=options.wait,
            answer_wait_s=options.answer_wait,
            unit_map=options.unit_map,
            started_unit=options.started_unit,
            **processes,
        )
        summary = run.record_on_bus(train, options.car, of_car, progress_line)
    progress_line.close()
    page = report.write(out)
    items: list[Any] = []
    if not options.json:
        items = [
            *report.tables(summary),
            f"recorded in {out}, each car in {out}/car_1 and so on; report: {page}",
        ]
        items += [Text(f"not valid: {reason}", "bold red") for reason in summary["invalid_because"]]
    return Recorded(summary, summary | {"folder": str(out), "report": str(page)}, items)


def _announce_replacement(out: Path, options: argparse.Namespace) -> None:
    """Print which run the new one replaces; on a terminal, ask the user before.

    Raises ConfigError if the user does not want that.
    """
    earlier = run_folder.earlier_run(out)
    if not earlier:
        return
    output.print_message(f"{out} holds {earlier}")
    asks = sys.stdin.isatty() and sys.stderr.isatty() and not (options.json or options.replace)
    if not asks:
        output.print_message("these files are replaced by the new run")
        return
    print("replace these files by the new run? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ConfigError(f"{out} is kept; give a new folder with --out")


def _items(result: dict[str, Any], out: Path) -> list[Any]:
    """Return what the terminal shows of the summary of a run."""
    from rich.text import Text

    from rollerrig.realtime.record import summary

    items: list[Any] = [
        summary.table(result),
        f"recorded in {out}; open it with: rollerrig view {shlex.quote(str(out))}",
    ]
    for reason in result["invalid_because"]:
        items.append(Text(f"not valid: {reason}", "bold red"))
    return items


def free_folder(name: str) -> Path:
    """Return runs/NAME, or the first of runs/NAME-2, runs/NAME-3 ... that does not exist."""
    folder = Path("runs") / name
    numbers = itertools.count(2)
    while folder.exists():
        folder = Path("runs") / f"{name}-{next(numbers)}"
    return folder


class ProgressLine:
    """Shows the progress of a run on standard error.

    On a terminal it rewrites one line. Otherwise it prints a line every five seconds.
    """

    def __init__(self) -> None:
        self._on_terminal = sys.stderr.isatty()
        self._printed_s = -_PROGRESS_S
        # whether the cursor is still on the rewritten line
        self._open = False

    def __call__(self, progress: "Progress") -> None:
        """Show the message of the progress if there is one, and otherwise its figures."""
        if progress.message:
            self.message(progress.message)
            return

        text = (
            f"t = {progress.time_s:6.1f} s   v = {progress.speed_m_s:5.1f} m/s   "
            f"sliding {progress.sliding_m_s:5.1f} m/s   missed deadlines {progress.missed}"
        )
        now_s = time.monotonic()
        if self._on_terminal:
            output.rewrite_line(text)
            self._open = True
        elif now_s - self._printed_s >= _PROGRESS_S:
            output.print_message(text)
            self._printed_s = now_s

    def message(self, text: str) -> None:
        """Print a message on a new line."""
        self.close()
        output.print_message(text)

    def close(self) -> None:
        """Move the cursor from the rewritten line to the next line."""
        if self._open:
            print(file=sys.stderr)
            self._open = False
