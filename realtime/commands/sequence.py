"""`rollerrig sequence`: plays scripted tests on benches, judges them and writes the report."""

import argparse
import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.number_text import rounded
from rollerrig.configs.output_files import check_no_link, make_folder, writing
from rollerrig.configs.processes import children, cores, interruption
from rollerrig.realtime.commands import output, wsp
from rollerrig.realtime.record import run_folder

if TYPE_CHECKING:
    from rollerrig.configs.vehicle import Kind
    from rollerrig.firmware_sim.faults.catalogue import Fault
    from rollerrig.realtime.bench.scenario import Scenario
    from rollerrig.wsp_interface.harness_client import Event
    from rollerrig.wsp_interface.own_bench import Observer
    from rollerrig.wsp_interface.sequences.play import Outcome
    from rollerrig.wsp_interface.sequences.progress import Progress
    from rollerrig.wsp_interface.sequences.sequence import Sequence
    from rollerrig.wsp_interface.sequences.verdict import Verdict

# between two lines of progress where standard error is not a terminal
PERIOD_S = 60.0
# folder of the packaged sequences
LIBRARY = "sequences"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig sequence`."""
    parser.add_argument(
        "sequences",
        nargs="*",
        metavar="FILE",
        help="sequences: names of packaged sequences, TOML files, or folders of TOML files "
        "(default: all packaged sequences of the coach)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("report"),
        metavar="DIR",
        help="folder of the report; each run gets a folder in it (default: report)",
    )
    parser.add_argument(
        "--junit",
        type=Path,
        metavar="FILE",
        help="file for the JUnit XML (default: junit.xml in the folder of the report)",
    )
    parser.add_argument(
        "--bus",
        default="",
        metavar="ADDRESS",
        help="play one sequence on a bench that already runs ('rollerrig run ... --harness'), "
        "and start none",
    )
    parser.add_argument(
        "--pacing",
        choices=("lockstep", "wall"),
        default="lockstep",
        help="pacing of the benches that are started (default: lockstep, which is repeatable)",
    )
    parser.add_argument(
        "--wsp",
        type=wsp.parse_unit,
        action=wsp.AppendUnit,
        default="",
        metavar="{reference,external,none,fmu:FILE}",
        help="WSP unit of the benches; fmu:FILE may be repeated for FMUs that share the bus by "
        "CAN ports (default: the unit in the sequence, else reference)",
    )
    wsp.allow_argument(parser, "a sequence")
    wsp.unit_argument(parser)
    parser.add_argument(
        "--unit-map",
        type=Path,
        metavar="FILE",
        help="with --wsp external: mapping between the CAN messages of the unit and of the rig; "
        "with --wsp fmu:FILE: mapping of the FMU's variables",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of all random numbers (default: 0)"
    )
    parser.add_argument(
        "--repeat",
        type=int,
        default=1,
        metavar="N",
        help="play each sequence N times, with the seeds from --seed on, as NAME_1 to NAME_N, and "
        "print one table of its limits (default: 1)",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=0,
        metavar="N",
        help="number of benches that run at the same time (default: in lockstep the number of "
        "processor cores, in real time 1)",
    )
    parser.add_argument(
        "--steps", action="store_true", help="print each step of a sequence when it begins"
    )
    parser.add_argument(
        "--check", action="store_true", help="only read and check the sequences, and run none"
    )
    output.report_arguments(parser)


def call(options: argparse.Namespace) -> int:
    """Play the sequences and write the report.

    Returns INVALID if a signal has interrupted them, FAILED if not all have passed, otherwise PASS.
    """
    from rollerrig.realtime.reports import pdf
    from rollerrig.realtime.reports import sequences as report

    if options.unit and not options.wsp:
        options.wsp = "external"
    sequences = load(options.sequences)
    if options.check:
        names = [sequence.name for sequence in sequences]
        rows = [(sequence.name, sequence.title) for sequence in sequences]
        return output.show(
            options,
            {"checked": names},
            (None, ("sequence", "title"), rows),
            f"{count_text(len(names))} valid",
        )

    # all options are checked before the first bench starts
    check_options(options, sequences)
    sequences = _repeated(sequences, options.repeat)
    about = output.about(options)
    if options.pdf:
        pdf.check()

    with interruption.Interruption() as interrupted:
        played, not_played = _play_all(options, sequences)
        # a signal that comes now shall not cost the report
        interrupted.ignore()
        outcomes = [*played, *not_played]
        paths = report.write(outcomes, options.out, options.junit, about, options.pdf)

    result = report.overall(outcomes)
    counts = {"pass": 0, "fail": 0, "error": 0}
    for outcome in outcomes:
        if outcome.result in counts:
            counts[outcome.result] += 1

    limits = _spread(outcomes) if options.repeat > 1 else []
    repeated: list[Any] = []
    if limits:
        repeated.append(_spread_table(limits, options.repeat))
        if not any(outcome.summary.get("random") for outcome in outcomes):
            repeated.append("nothing in these runs is random: their seeds have no effect")

    output.show(
        options,
        {
            "result": result,
            **counts,
            "limits": limits,
            "report": str(paths[0]),
            "sequences": {outcome.sequence.name: outcome.result for outcome in outcomes},
            "warnings": [*report.contradictions(outcomes, about), *_warnings(outcomes)],
            "interrupted": interrupted.by or None,
            "not_played": [outcome.sequence.name for outcome in not_played],
        },
        f"{result}: {counts['pass']} passed, {counts['fail']} failed, "
        f"{counts['error']} with an error; report in {paths[0]} (not a certification)",
        *repeated,
        *_interruption_lines(interrupted.by, sequences, not_played),
    )
    if interrupted.by:
        return output.INVALID
    return output.PASS if result == "pass" else output.FAILED


def _repeated(sequences: "list[Sequence]", times: int) -> "list[Sequence]":
    """Return each sequence so many times; the name of each repetition has a number."""
    if times == 1:
        return sequences
    return [
        replace(sequence, name=f"{sequence.name}_{number + 1}", repetition=number)
        for sequence in sequences
        for number in range(times)
    ]


def _spread(outcomes: "list[Outcome]") -> list[dict[str, Any]]:
    """Return each limit of each sequence with the spread of its values over all repetitions."""
    from rollerrig.realtime.record import figures

    by_limit: dict[tuple[str, str, str, str], list[Verdict]] = {}
    for outcome in outcomes:
        # the file is the same in all repetitions, and the name is not
        name = outcome.sequence.path.stem
        for verdict in outcome.verdicts:
            if not math.isnan(verdict.value):
                key = (name, verdict.what, verdict.limit, verdict.unit)
                by_limit.setdefault(key, []).append(verdict)

    rows = []
    for (name, what, limit, unit), verdicts in by_limit.items():
        rows.append(
            {
                "sequence": name,
                "limit": what,
                "required": limit,
                "unit": unit,
                **figures.spread_of([verdict.value for verdict in verdicts]),
                "passed": sum(verdict.result == "pass" for verdict in verdicts),
                "played": len(verdicts),
            }
        )
    return rows


def _spread_table(rows: list[dict[str, Any]], times: int) -> Any:
    """Return the rows of `_spread` as a table to print."""
    shown = []
    for row in rows:
        words = (row["sequence"], row["limit"], row["required"], row["unit"])
        numbers = (rounded(row[key]) for key in output.SPREAD)
        shown.append((*words, *numbers, f"{row['passed']} of {row['played']}"))
    head = ("sequence", "limit", "required", "unit", *output.SPREAD.values(), "passed")
    return f"each sequence {times} times", head, shown


def count_text(count: int) -> str:
    """Return a number of sequences as the subject of a sentence, with its verb."""
    return "1 sequence is" if count == 1 else f"{count} sequences are"


def _interruption_lines(
    interrupted_by: str, sequences: "list[Sequence]", not_played: "list[Outcome]"
) -> list[str]:
    """Return the line about a signal that has ended the playing, if one has."""
    if not interrupted_by:
        return []
    begun = len(sequences) - len(not_played)
    return [f"interrupted by {interrupted_by}: {begun} of {len(sequences)} sequences were played"]


def _warnings(outcomes: "list[Outcome]") -> list[str]:
    """Return what was planned but did not happen, with the names of the sequences."""
    warnings = []
    for outcome in outcomes:
        for text in outcome.summary.get("warnings", ()):
            warnings.append(f"{outcome.sequence.name}: {text}")
    return warnings


# --- reading and checking ---


def load(names: list[str]) -> "list[Sequence]":
    """Return the sequences of names, files and folders; without names, those of the coach.

    Checks all of them. Raises ConfigError with the errors of all sequences.
    """
    from rollerrig.firmware_sim.faults import catalogue
    from rollerrig.wsp_interface.sequences import sequence as sequence_file

    sequences: list[Sequence] = []
    errors: list[str] = []
    for path in _find(names):
        try:
            sequences.append(sequence_file.load(path, _fault))
        except ConfigError as error:
            errors.append(str(error))

    # each sequence needs a different name, because the folder of its run has this name
    loaded_names = [sequence.name for sequence in sequences]
    for name in sorted(set(loaded_names)):
        if loaded_names.count(name) > 1:
            errors.append(f"two sequences have the name '{name}'; rename one of them")

    for sequence in sequences:
        try:
            of_bench = scenario_of(sequence)
            for step in sequence.steps:
                for text in step.faults:
                    fault = _fault(text, of_bench.kind)
                    catalogue.check_equipped(fault, of_bench.resolved, f"line {step.line} [[step]]")
        except ConfigError as error:
            errors.append(f"{sequence.path} [start]: {error}")

    if errors:
        raise ConfigError("no sequence was played:\n  " + "\n  ".join(errors))
    return sequences


def _fault(text: str, kind: "Kind") -> "Fault":
    """Return the fault of a step, on a kind of vehicle. Raises ConfigError."""
    from rollerrig.firmware_sim.faults import catalogue

    return catalogue.parse(text, kind, source="the fault")


def _find(names: list[str]) -> list[Path]:
    """Return the files of names, files and folders. Raises ConfigError for an empty folder."""
    from rollerrig.configs import store

    paths: list[Path] = []
    for name in names or [str(store.ROOT / LIBRARY)]:
        if not Path(name).is_dir():
            paths.append(store.find(LIBRARY, name))
            continue
        in_folder = sorted(Path(name).glob("*.toml"))
        if not in_folder:
            raise ConfigError(f"{name}: the folder contains no sequence (*.toml)")
        paths += in_folder
    return paths


def scenario_of(sequence: "Sequence") -> "Scenario":
    """Return the scenario of the bench that a sequence needs. Raises ConfigError."""
    from rollerrig.realtime.bench import scenario
    from rollerrig.wsp_interface import own_bench

    data = own_bench.scenario_of(
        name=sequence.scenario,
        initial_speed_m_s=sequence.speed_m_s,
        adhesion=sequence.adhesion,
        tables=sequence.tables,
        title=sequence.title,
    )
    return scenario.read(data, Path(sequence.path.name))


def check_options(options: argparse.Namespace, sequences: "list[Sequence]") -> None:
    """Check the options against one another, check the FMUs and maps, and make the report's folder.

    Raises ConfigError.
    """
    from rollerrig.firmware_sim.fmu import fmu_file
    from rollerrig.wsp_interface import signals, unit_choice
    from rollerrig.wsp_interface.unit_map import mapping

    fmus = unit_choice.fmus_of(options.wsp)
    allowed = unit_choice.AllowList.of(options.allow_unit)
    is_external = options.wsp == "external"

    if options.bus and len(sequences) != 1:
        raise ConfigError(
            f"--bus plays exactly one sequence on a running bench, and {len(sequences)} are given; "
            "give the name of one sequence"
        )
    if options.repeat < 1:
        raise ConfigError(f"--repeat {options.repeat}: allowed are numbers from 1")
    if options.repeat > 1 and options.bus:
        raise ConfigError(
            "--repeat and --bus: a running bench plays a sequence once; leave one of the options out"
        )
    if options.jobs < 0:
        raise ConfigError(
            f"--jobs {options.jobs}: allowed are numbers from 1, or 0 for the number of cores"
        )

    maps_external_unit = options.unit_map and not fmus
    if (options.unit or maps_external_unit) and not is_external:
        raise ConfigError(
            f"--unit and --unit-map are for an external unit, and --wsp is {options.wsp or 'not given'}: "
            "give --wsp external"
        )
    if fmus and options.bus:
        raise ConfigError(
            "--wsp fmu:FILE and --bus: a running bench already has its unit; give the FMU to the "
            "'rollerrig run' that starts the bench"
        )

    # a running bench has its unit, and starts none for a sequence
    if not options.bus:
        started = set()
        for sequence in sequences:
            unit = options.wsp or sequence.allowed_unit(allowed)
            period_s = scenario_of(sequence)["bus"]["sync_period_s"]
            started.add((unit, period_s, sequence.kind.unit_axles))
        for unit, period_s, unit_axles in sorted(started):
            fmus_of_unit = unit_choice.fmus_of(unit)
            fmu_file.check_all(fmus_of_unit, options.unit_map, period_s, unit_axles)

    if is_external and not options.bus and not options.unit:
        raise ConfigError(
            "--wsp external: each run has a separate bus, on which your unit must be started; give "
            "the command that starts it with --unit COMMAND"
        )
    if options.unit:
        unit_choice.command_words(options.unit, "")
    if maps_external_unit:
        for kind in sorted({sequence.kind for sequence in sequences}):
            mapping.load(options.unit_map, signals.table(kind))

    with writing(options.out):
        make_folder(options.out)
    for sequence in _repeated(sequences, options.repeat):
        check_no_link(options.out / sequence.name)


# --- playing ---


def _play_all(
    options: argparse.Namespace, sequences: "list[Sequence]"
) -> "tuple[list[Outcome], list[Outcome]]":
    """Play all sequences. Return the outcomes of those that were played, and of the others.

    Prints each outcome. A KeyboardInterrupt ends the playing: what runs is stopped immediately, and
    the other sequences are not played.
    """
    from rollerrig.wsp_interface.sequences.play import Outcome

    played: dict[str, Outcome] = {}

    def finish(outcome: Outcome) -> None:
        played[outcome.sequence.name] = outcome
        progress.finish(outcome.sequence.name)
        print_outcome(outcome)

    names = [sequence.name for sequence in sequences]
    with contextlib.suppress(KeyboardInterrupt), shown(names) as progress:
        jobs = min(_jobs(options), len(sequences))
        if jobs == 1:
            _play_one_by_one(options, sequences, progress, finish)
        else:
            _play_in_processes(options, sequences, jobs, progress, finish)

    not_played = []
    for sequence in sequences:
        if sequence.name not in played:
            error = "not played to its end, because the sequences were interrupted; play it again"
            not_played.append(Outcome(sequence, options.out / sequence.name, error=error))
    # the outcomes of processes come in any order after an interruption
    in_order = [played[sequence.name] for sequence in sequences if sequence.name in played]
    return in_order, not_played


def _jobs(options: argparse.Namespace) -> int:
    """Return how many sequences may be played at the same time."""
    if options.bus:
        return 1
    if options.jobs:
        return int(options.jobs)
    if options.pacing == "lockstep":
        return cores.allowed()
    # benches in real time would disturb one another
    return 1


def _play_one_by_one(
    options: argparse.Namespace,
    sequences: "list[Sequence]",
    progress: "Progress",
    finish: "Callable[[Outcome], None]",
) -> None:
    """Play sequences in this process. Raises KeyboardInterrupt, and BusError with --bus."""
    for sequence in sequences:
        play_one = play if options.bus else play_or_error
        watcher = observer(sequence.name, progress, options)
        outcome = play_one(sequence, options, watcher)
        finish(outcome)
        if outcome.interrupted:
            raise KeyboardInterrupt


def _play_in_processes(
    options: argparse.Namespace,
    sequences: "list[Sequence]",
    jobs: int,
    progress: "Progress",
    finish: "Callable[[Outcome], None]",
) -> None:
    """Play sequences in worker processes. Raises KeyboardInterrupt."""
    with children.pool(jobs) as pool:
        futures = []
        for sequence in sequences:
            watcher = observer(sequence.name, progress, options)
            futures.append(pool.submit(play, sequence, options, watcher))
        left = dict(zip(futures, sequences, strict=True))
        try:
            for future, sequence in zip(futures, sequences, strict=True):
                outcome = _outcome_or_error(future.result, sequence, options.out / sequence.name)
                finish(outcome)
                del left[future]
        except KeyboardInterrupt:
            pool.stop()
            # some were played while the first of them was awaited, others have just been stopped
            for future in left:
                if not future.cancelled() and future.exception() is None:
                    finish(future.result())
            raise


def play_or_error(
    sequence: "Sequence", options: argparse.Namespace, observer: "Observer"
) -> "Outcome":
    """Return the outcome of a sequence on a new bench; any failure of playing it is an error."""
    get_outcome = partial(play, sequence, options, observer)
    return _outcome_or_error(get_outcome, sequence, options.out / sequence.name)


def _outcome_or_error(
    get_outcome: "Callable[[], Outcome]", sequence: "Sequence", folder: Path
) -> "Outcome":
    """Return get_outcome(), or an outcome with an error if that raises an exception.

    So the other sequences keep their verdicts.
    """
    from rollerrig.wsp_interface.sequences.play import Outcome

    try:
        return get_outcome()
    except BrokenProcessPool:
        return Outcome(
            sequence,
            folder,
            error="the process that played this sequence was killed; play the sequence again",
        )
    except Exception as error:  # no exception, of whatever type, may count as a pass
        return Outcome(sequence, folder, error=f"unexpected: {error!r}")


def play(sequence: "Sequence", options: argparse.Namespace, observer: "Observer") -> "Outcome":
    """Return the outcome of a sequence, on a new bench or on the running bench of --bus."""
    folder = options.out / sequence.name
    begun_s = time.monotonic()
    if options.bus:
        outcome = _play_on_running_bench(sequence, options, folder, observer)
    else:
        outcome = _play_on_new_bench(sequence, options, folder, observer)
    outcome.wall_s = time.monotonic() - begun_s
    return outcome


def _play_on_running_bench(
    sequence: "Sequence", options: argparse.Namespace, folder: Path, observer: "Observer"
) -> "Outcome":
    from rollerrig.realtime.campaign import dry_stop
    from rollerrig.wsp_interface import harness_client
    from rollerrig.wsp_interface.sequences import play as player

    scenario = scenario_of(sequence).resolved
    harness = harness_client.connect(options.bus)
    return player.on_running_bench(
        sequence, harness, folder, scenario, dry_stop.distance_m, observer
    )


def _play_on_new_bench(
    sequence: "Sequence", options: argparse.Namespace, folder: Path, observer: "Observer"
) -> "Outcome":
    from rollerrig.realtime.campaign import dry_stop
    from rollerrig.wsp_interface import own_bench, signals, unit_choice
    from rollerrig.wsp_interface.sequences import play as player
    from rollerrig.wsp_interface.unit_map import gateway

    companions: list[Any] = []
    run_arguments: tuple[str, ...] = ()
    if options.unit:
        run_arguments += ("--started-unit", options.unit)
    if options.unit_map:
        if options.wsp == "external":
            # the gateway starts before the unit, which may send immediately
            vehicle = signals.table(sequence.kind)
            scenario = scenario_of(sequence).resolved
            start_rad_s = scenario["initial_speed_m_s"] / scenario["vehicle"]["wheel_radius_m"]
            log = folder / run_folder.UNIT_CAN_LOG
            companions.append(gateway.companion(options.unit_map, vehicle, start_rad_s, log))
        else:
            run_arguments += ("--unit-map", str(options.unit_map))
    if options.unit:
        companions.append(own_bench.program(options.unit, folder / run_folder.UNIT_LOG))

    return player.on_own_bench(
        sequence,
        folder,
        pacing=options.pacing,
        seed=options.seed + sequence.repetition,
        dry_m=dry_stop.distance_m,
        wsp=options.wsp,
        companions=tuple(companions),
        observer=observer,
        arguments=run_arguments,
        allowed=unit_choice.AllowList.of(options.allow_unit),
    )


# --- printing ---


@contextlib.contextmanager
def shown(names: Collection[str], before: int = 0) -> "Iterator[Progress]":
    """Yield the progress of sequences, and show it until the block ends.

    On a terminal it is a line that changes. Otherwise a line is printed once a minute, because the
    log of a CI server shall show the verdicts. `before` sequences of the same work were played
    earlier.
    """
    from rollerrig.wsp_interface.sequences.progress import Progress

    with tempfile.TemporaryDirectory(prefix="rollerrig-") as folder:
        progress = Progress(names, Path(folder), before)
        with output.report_progress(progress.text, PERIOD_S, draws=True):
            yield progress


def observer(name: str, progress: "Progress", options: argparse.Namespace) -> "Observer":
    """Return what writes the status of a sequence, and with --steps prints its steps."""
    from rollerrig.wsp_interface.sequences.progress import StatusFile

    on_event = partial(_print_step, name) if options.steps else _print_nothing
    return StatusFile(progress.file_of(name), on_event)


def _print_step(name: str, event: "Event") -> None:
    """Print an event if it is the begin of a step."""
    from rollerrig.wsp_interface.events import Code

    if event.code == Code.SEQUENCE_STEP:
        output.print_message(f"  step  {name}: {event.fields['title']} ({event.time_s:.2f} s)")


def _print_nothing(event: "Event") -> None:
    """Print no event."""


def print_outcome(outcome: "Outcome") -> None:
    """Print the result of a sequence, and each verdict that is a failure or an error."""
    error = f": {outcome.error}" if outcome.error else ""
    output.print_message(
        f"{outcome.result:>6}  {outcome.sequence.name} ({outcome.wall_s:.1f} s){error}"
    )
    for verdict in outcome.verdicts:
        if verdict.result in ("fail", "error"):
            output.print_message(f"        {_verdict_text(verdict)}")


def _verdict_text(verdict: "Verdict") -> str:
    value = ""
    if not math.isnan(verdict.value):
        value = f" {rounded(verdict.value)} {verdict.unit}".rstrip()
    comparison = f"{verdict.what}{value}, required {verdict.limit} {verdict.unit}".rstrip()
    return f"{comparison}: {verdict.result}, {verdict.text}"
