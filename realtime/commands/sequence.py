"""`rollerrig sequence`: scripted tests against a bench, their verdicts and their report."""

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.realtime.commands import output, wsp
from rollerrig.realtime.record import run_folder
from rollerrig.realtime.record.files import writing

LIBRARY = "sequences"


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sequences",
        nargs="*",
        metavar="FILE",
        help="sequences: names of packaged "
        "ones, TOML files, or folders of them (default: the packaged library)",
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
        help="where JUnit XML goes (default: junit.xml in the folder of the report)",
    )
    parser.add_argument(
        "--bus",
        default="",
        metavar="ADDRESS",
        help="play one sequence on a bench "
        "that runs already ('rollerrig run ... --harness') instead of starting one",
    )
    parser.add_argument(
        "--pacing",
        choices=("lockstep", "wall"),
        default="lockstep",
        help="of benches that are started (default: lockstep, repeatable)",
    )
    parser.add_argument(
        "--wsp",
        type=wsp.parse_unit,
        action=wsp.AppendUnit,
        default="",
        metavar="{reference,external,none,fmu:FILE}",
        help="whose WSP; again for further FMUs that "
        "share the bus by CAN ports (default: what the sequence says, else reference)",
    )
    parser.add_argument(
        "--unit",
        default="",
        metavar="COMMAND",
        help="with --wsp external: starts your "
        "unit for each run; {address}, {host}, {port} are put in, as in "
        "'python docs/examples/wsp_unit.py {host} {port}'",
    )
    parser.add_argument(
        "--unit-map",
        type=Path,
        metavar="FILE",
        help="mapping of the unit's own CAN "
        "messages to the rig's (with --wsp external), or of an FMU's variables",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of whatever is random (default: 0)"
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=0,
        metavar="N",
        help="benches at a time (default: "
        "in lockstep as many as there are cores, in real time one)",
    )
    parser.add_argument("--steps", action="store_true", help="say which step each sequence is at")
    parser.add_argument("--check", action="store_true", help="only read and check the sequences")
    parser.add_argument(
        "--about",
        action="append",
        default=[],
        metavar="'WHAT=TEXT'",
        help="for the title block of "
        "the report, as in 'unit under test=ACME 7' or 'tested by=A. Meier'; may be repeated",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="write the report as PDF as well (report.pdf)"
    )


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.reports import pdf
    from rollerrig.realtime.reports import sequences as report

    sequences = load(given.sequences)
    if given.check:
        names = [one.name for one in sequences]
        return output.show(given, {"checked": names}, f"{len(names)} sequences are in order")
    _check_out(given, sequences)
    about = dict(_about(one) for one in given.about)
    if given.pdf:
        pdf.check()
    played: list[str] = []
    with output.report_progress(lambda: f"{len(played)} of {len(sequences)} sequences played"):
        outcomes = _play(given, sequences, played)
    written = report.write(outcomes, given.out, given.junit, about, given.pdf)
    result = report.overall(outcomes)
    counts = {
        name: sum(one.result == name for one in outcomes) for name in ("pass", "fail", "error")
    }
    output.show(
        given,
        {
            "result": result,
            **counts,
            "report": str(written[0]),
            "sequences": {one.sequence.name: one.result for one in outcomes},
        },
        f"{result}: {counts['pass']} passed, {counts['fail']} failed, {counts['error']} with an error; "
        f"report in {written[0]} (not a certification)",
    )
    return output.PASS if result == "pass" else output.FAILED


def _about(given: str) -> tuple[str, str]:
    what, found, text = given.partition("=")
    if not (found and what.strip()):
        raise ConfigError(f"--about '{given}': write WHAT=TEXT, as in 'tested by=A. Meier'")
    return what.strip(), text.strip()


def load(names: list[str]) -> list[Any]:
    """The sequences of names, files and folders, all checked. Raises ConfigError with all faults."""
    from rollerrig.configs import store
    from rollerrig.firmware_sim.faults import catalogue
    from rollerrig.wsp_interface.sequences import sequence

    paths: list[Path] = []
    for name in names or [str(store.ROOT / LIBRARY)]:
        found = (
            sorted(Path(name).glob("*.toml"))
            if Path(name).is_dir()
            else [store.find(LIBRARY, name)]
        )
        if not found:
            raise ConfigError(f"{name}: holds no sequence (*.toml)")
        paths += found
    loaded, wrong = [], []
    for path in paths:
        try:
            loaded.append(sequence.load(path, catalogue.parse))
        except ConfigError as error:
            wrong.append(str(error))
    twice = {one.name for one in loaded if sum(one.name == other.name for other in loaded) > 1}
    wrong += [f"two sequences are called '{name}'; rename one" for name in sorted(twice)]
    for one in loaded:
        try:
            _plan(one)
        except ConfigError as error:
            wrong.append(f"{one.path} [start]: {error}")
    if wrong:
        raise ConfigError("nothing was run:\n  " + "\n  ".join(wrong))
    return loaded


def _plan(one: Any) -> Any:
    """The scenario of the bench that a sequence wants. Raises ConfigError where it cannot be built."""
    from rollerrig.realtime.bench import scenario
    from rollerrig.wsp_interface import own_bench

    return scenario.read(
        own_bench.scenario_of(one.scenario, one.speed_m_s, None, one.adhesion, one.tables),
        Path(one.path.name),
    )


def _check_out(given: argparse.Namespace, sequences: list[Any]) -> None:
    from rollerrig.firmware_sim.fmu import fmu_file
    from rollerrig.realtime.bench import options
    from rollerrig.wsp_interface import unit_map

    if given.bus and len(sequences) != 1:
        raise ConfigError(
            f"--bus plays one sequence on a running bench, not {len(sequences)}; name one"
        )
    if given.jobs < 0:
        raise ConfigError(f"--jobs {given.jobs}: at least 1, or 0 for as many as there are cores")
    fmus = options.fmus_of(given.wsp)
    if ((given.unit_map and not fmus) or given.unit) and given.wsp != "external":
        raise ConfigError(
            "--unit and --unit-map belong to a unit outside: give --wsp external as well"
        )
    if fmus and given.bus:
        raise ConfigError(
            "--wsp fmu:FILE and --bus: a bench that runs already has its unit; give the FMU to its "
            "'rollerrig run'"
        )
    for period_s in sorted(
        {_plan(one)["bus"]["sync_period_s"] for one in sequences} if fmus else ()
    ):
        fmu_file.check_all(fmus, given.unit_map, period_s)
    if given.wsp == "external" and not (given.bus or given.unit):
        raise ConfigError(
            "--wsp external: each run is a bus of its own; say with --unit COMMAND how your unit is "
            "started on it"
        )
    if given.unit_map and not fmus:
        unit_map.load(given.unit_map)
    with writing(given.out):
        given.out.mkdir(parents=True, exist_ok=True)


def _play(given: argparse.Namespace, sequences: list[Any], played: list[str]) -> list[Any]:
    if given.bus:
        return [_say(played, play(sequences[0], given))]
    at_once = given.jobs or (len(os.sched_getaffinity(0)) if given.pacing == "lockstep" else 1)
    if at_once == 1 or len(sequences) == 1:
        return [
            _say(played, _guarded(partial(play, one, given), (one, given.out / one.name)))
            for one in sequences
        ]
    with children.pool(min(at_once, len(sequences))) as pool:
        waiting = [pool.submit(play, one, given) for one in sequences]
        return [
            _say(played, _guarded(future.result, (one, given.out / one.name)))
            for future, one in zip(waiting, sequences, strict=True)
        ]


def _guarded(get: Callable[[], Any], job: tuple[Any, ...]) -> Any:
    """The outcome, or an error in its place: one sequence takes no other's verdict away."""
    from rollerrig.wsp_interface.sequences.play import Outcome

    try:
        return get()
    except BrokenProcessPool:
        return Outcome(job[0], job[1], error="the process that played it has died; play it again")
    except Exception as error:  # whatever it is, it is no pass
        return Outcome(job[0], job[1], error=f"unexpected: {error!r}")


def play(one: Any, given: argparse.Namespace) -> Any:
    """One sequence on a bench of its own, or on one that runs already, and how it came out."""
    from rollerrig.realtime.campaign import dry_stop
    from rollerrig.wsp_interface import harness_client, own_bench, unit_map
    from rollerrig.wsp_interface.sequences import play as player

    folder, begun = given.out / one.name, time.monotonic()
    if given.bus:
        resolved = _plan(one).resolved
        outcome = player.on_running_bench(
            one, harness_client.connect(given.bus), folder, resolved, dry_stop.distance_m
        )
    else:
        # the gateway first: the unit's program may answer it at once
        gateway = given.unit_map and given.wsp == "external"
        companions: list[Any] = [unit_map.companion(given.unit_map)] if gateway else []
        companions += (
            [own_bench.program(given.unit, folder / run_folder.UNIT_LOG)] if given.unit else []
        )
        outcome = player.on_own_bench(
            one,
            folder,
            given.pacing,
            given.seed,
            dry_stop.distance_m,
            given.wsp,
            tuple(companions),
            partial(_step, one.name, given.steps),
            ("--unit-map", str(given.unit_map)) if given.unit_map and not gateway else (),
        )
    outcome.wall_s = time.monotonic() - begun
    return outcome


def _step(name: str, wanted: bool, event: Any) -> None:
    from rollerrig.wsp_interface.events import Code

    if wanted and event.code == Code.SEQUENCE_STEP:
        output.print_message(f"  step  {name}: {event.fields['title']} ({event.time_s:.2f} s)")


def _say(played: list[str], outcome: Any) -> Any:
    played.append(outcome.sequence.name)
    error = f": {outcome.error}" if outcome.error else ""
    output.print_message(
        f"{outcome.result:>6}  {outcome.sequence.name} ({outcome.wall_s:.1f} s){error}"
    )
    for one in outcome.verdicts:
        if one.result in ("fail", "error"):
            value = f" {one.value:.4g} {one.unit}".rstrip() if one.value == one.value else ""
            wanted = f"{one.what}{value}, wanted {one.limit} {one.unit}".rstrip()
            output.print_message(f"        {wanted}: {one.result}, {one.text}")
    return outcome
