"""`rollerrig sequence`: scripted tests against a bench, their verdicts and their report."""

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

PASS, FAILED = 0, 1
LIBRARY = "sequences"


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sequences", nargs="*", metavar="FILE", help="sequences: names of packaged "
                        "ones, TOML files, or folders of them (default: the packaged library)")
    parser.add_argument("--out", type=Path, default=Path("report"), metavar="DIR",
                        help="folder of the report; each run gets a folder in it (default: report)")
    parser.add_argument("--junit", type=Path, metavar="FILE",
                        help="where JUnit XML goes (default: junit.xml in the folder of the report)")
    parser.add_argument("--bus", default="", metavar="ADDRESS", help="play one sequence on a bench "
                        "that runs already ('rollerrig run ... --harness') instead of starting one")
    parser.add_argument("--pacing", choices=("lockstep", "wall"), default="lockstep",
                        help="of benches that are started (default: lockstep, repeatable)")
    parser.add_argument("--wsp", choices=("reference", "external", "none"), default="",
                        help="whose WSP (default: what the sequence says, else reference)")
    parser.add_argument("--unit", default="", metavar="COMMAND", help="with --wsp external: starts your "
                        "unit for each run; {address}, {host}, {port} are put in, as in "
                        "'python docs/examples/wsp_unit.py {host} {port}'")
    parser.add_argument("--unit-map", type=Path, metavar="FILE", help="mapping of the unit's own CAN "
                        "messages to the rig's (with --wsp external)")
    parser.add_argument("--seed", type=int, default=0, help="seed of whatever is random (default: 0)")
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="benches at a time (default: "
                        "in lockstep as many as there are cores, in real time one)")
    parser.add_argument("--check", action="store_true", help="only read and check the sequences")


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.reports import sequences as report

    sequences = load(given.sequences)
    if given.check:
        return _print(given, {"checked": [one.name for one in sequences]},
                      f"{len(sequences)} sequences are in order")
    _check_out(given, sequences)
    outcomes = _play(given, sequences)
    written = report.write(outcomes, given.out, given.junit)
    result = report.overall(outcomes)
    counts = {name: sum(one.result == name for one in outcomes) for name in ("pass", "fail", "error")}
    _print(given, {"result": result, **counts, "report": str(written[0]), "sequences": {
        one.sequence.name: one.result for one in outcomes}},
        f"{result}: {counts['pass']} passed, {counts['fail']} failed, {counts['error']} with an error; "
        f"report in {written[0]} (not a certification)")
    return PASS if result == "pass" else FAILED


def load(names: list[str]) -> list[Any]:
    """The sequences of names, files and folders, all checked. Raises ConfigError with all faults."""
    from rollerrig.configs import store
    from rollerrig.configs.errors import ConfigError
    from rollerrig.firmware_sim.faults import catalogue
    from rollerrig.wsp_interface.sequences import sequence

    paths: list[Path] = []
    for name in names or [str(store.ROOT / LIBRARY)]:
        folder = Path(name)
        if folder.is_dir():
            found = sorted(folder.glob("*.toml"))
            if not found:
                raise ConfigError(f"{folder}: holds no sequence (*.toml)")
            paths += found
        else:
            paths.append(store.find(LIBRARY, name))
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

    return scenario.read(own_bench.scenario_of(one.scenario, one.speed_m_s, None, one.adhesion, one.tables),
                         Path(one.path.name))


def _check_out(given: argparse.Namespace, sequences: list[Any]) -> None:
    from rollerrig.configs.errors import ConfigError
    from rollerrig.wsp_interface.sequences import mapping

    if given.bus and len(sequences) != 1:
        raise ConfigError(f"--bus plays one sequence on a running bench, not {len(sequences)}; "
                          "name one")
    if given.jobs < 0:
        raise ConfigError(f"--jobs {given.jobs}: at least 1, or 0 for as many as there are cores")
    if (given.unit_map or given.unit) and given.wsp != "external":
        raise ConfigError("--unit and --unit-map belong to a unit outside: give --wsp external as well")
    if given.wsp == "external" and not (given.bus or given.unit):
        raise ConfigError("--wsp external: each run is a bus of its own; say with --unit COMMAND how "
                          "your unit is started on it")
    if given.unit_map:
        mapping.load(given.unit_map)
    try:
        given.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{given.out}: cannot be written: {error.strerror}; give another folder "
                          "with --out") from None


def _play(given: argparse.Namespace, sequences: list[Any]) -> list[Any]:
    if given.bus:
        return [_on_bus(sequences[0], given)]
    jobs = [(one, given.out / one.name, given.pacing, given.seed, given.wsp, given.unit, given.unit_map)
            for one in sequences]
    at_once = given.jobs or (len(os.sched_getaffinity(0)) if given.pacing == "lockstep" else 1)
    if at_once == 1 or len(jobs) == 1:
        return [_say(_guarded(lambda job=job: play(*job), job)) for job in jobs]
    with ProcessPoolExecutor(min(at_once, len(jobs)),
                             multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(play, *job) for job in jobs]
        return [_say(_guarded(one.result, job)) for one, job in zip(waiting, jobs, strict=True)]


def _guarded(get: Callable[[], Any], job: tuple[Any, ...]) -> Any:
    """The outcome, or an error in its place: one sequence takes no other's verdict away."""
    from rollerrig.wsp_interface.sequences.play import Outcome

    try:
        return get()
    except BrokenProcessPool:
        return Outcome(job[0], job[1], error="the process that played it has died; play it again")
    except Exception as error:  # whatever it is, it is no pass
        return Outcome(job[0], job[1], error=f"unexpected: {error!r}")


def play(one: Any, folder: Path, pacing: str, seed: int, wsp: str, unit: str,
         unit_map: Path | None) -> Any:
    """One sequence on a bench of its own, and how it came out."""
    from rollerrig.realtime.campaign import dry_stop
    from rollerrig.wsp_interface import own_bench
    from rollerrig.wsp_interface.sequences import mapping
    from rollerrig.wsp_interface.sequences import play as player

    # the gateway first: the unit's program may answer it at once
    companions: list[Any] = [mapping.companion(unit_map)] if unit_map else []
    companions += [own_bench.program(unit)] if unit else []
    begun = time.monotonic()
    outcome = player.on_own_bench(one, folder, pacing, seed, dry_stop.distance_m, wsp,
                                  tuple(companions))
    outcome.wall_s = time.monotonic() - begun
    return outcome


def _on_bus(one: Any, given: argparse.Namespace) -> Any:
    """One sequence on a bench that runs already."""
    from rollerrig.realtime.campaign import dry_stop
    from rollerrig.wsp_interface import harness_client
    from rollerrig.wsp_interface.sequences import play as player

    resolved = _plan(one).resolved
    begun = time.monotonic()
    outcome = player.on_running_bench(one, harness_client.connect(given.bus), given.out / one.name, resolved,
                                      dry_stop.distance_m)
    outcome.wall_s = time.monotonic() - begun
    return _say(outcome)


def _say(outcome: Any) -> Any:
    error = f": {outcome.error}" if outcome.error else ""
    print(f"{outcome.result:>6}  {outcome.sequence.name} ({outcome.wall_s:.1f} s){error}",
          file=sys.stderr, flush=True)
    for one in outcome.verdicts:
        if one.result in ("fail", "error"):
            value = f" {one.value:.4g} {one.unit}".rstrip() if one.value == one.value else ""
            print(f"        {one.what}{value}, wanted {one.limit} {one.unit}".rstrip()
                  + f": {one.result}, {one.text}", file=sys.stderr, flush=True)
    return outcome


def _print(given: argparse.Namespace, data: dict[str, Any], text: str) -> int:
    if given.json:
        print(json.dumps(data))
    else:
        print(text)
    return PASS
