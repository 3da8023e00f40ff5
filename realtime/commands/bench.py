"""`rollerrig bench` runs the project's benchmarks by name; `rollerrig score` judges answers.

Nine benchmarks belong to the installed package, because users want their figures of a new machine.
The others judge the project itself. They are in `tests/` and run from a clone only.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import clone, output, wsp


class Benchmark(NamedTuple):
    """A row of the help: one line of text, and the module, which is imported only when it runs."""

    text: str
    module: str
    needs_clone: bool  # then the module is below the folder `tests` of the clone


def _installed(name: str, text: str) -> Benchmark:
    return Benchmark(text, f"rollerrig.realtime.benchmarks.{name}", needs_clone=False)


def _in_clone(module: str, text: str) -> Benchmark:
    return Benchmark(text, module, needs_clone=True)


BENCHMARKS = {
    "loop": _installed("loop", "lateness of the real-time loop, compared with cyclictest"),
    "bus": _installed("bus", "TPDO to valve, SYNC to last TPDO, round trips, on a running bench"),
    "vehicle": _installed("vehicle", "45 s of four axles without deadlines; the start of a run"),
    "train": _installed("train", "five coaches with five units in real time, each on a bus"),
    "start": _installed(
        "start", "first and next starts of run and explain: processor time, wall time, kernels"
    ),
    "campaign": _installed("campaign", "stops per minute and core, two workers, memory, Dask"),
    "million": _installed("million", "hours of a million stops on two cores, by the step"),
    "merge": _installed(
        "merge", "memory, disk and time of a campaign of a million stops, apart from the stops"
    ),
    "evidence": _installed(
        "evidence", "what of the rig is verified against what, and where that is valid"
    ),
    "contact": _in_clone(
        "benchmarks.contact",
        "time of a contact; four contact models in the coach (Table 8 of the paper)",
    ),
    "hunting": _in_clone(
        "benchmarks.hunting", "the speed above which the coach in 3D hunts, by a sweep"
    ),
    "protection": _in_clone(
        "benchmarks.protection", "stops without WSP and at many slip bands, on low adhesion"
    ),
    "sensors": _in_clone(
        "benchmarks.sensors", "stops with one to three false speed sensors, by fault and rail"
    ),
    "discover": _in_clone(
        "benchmarks.discover", "how often discover solves a sealed rig (minutes per rig)"
    ),
    "explain": _in_clone(
        "benchmarks.explain",
        "how often explain is right on sets with known hidden effects (an hour)",
    ),
    "harness": _in_clone(
        "benchmarks.harness", "lateness and missed ticks with and without a scripted sequence"
    ),
    "desk": _in_clone(
        "benchmarks.desk", "lateness and missed ticks with and without a desk and ten browsers"
    ),
    "soak": _in_clone(
        "endurance.soak", "memory, disk and losses of long runs, in real time and in lockstep"
    ),
    "fuzz": _in_clone(
        "endurance.fuzz", "a million malformed inputs through every interface of running benches"
    ),
    "files": _in_clone(
        "endurance.files",
        "a thousand damaged files of each kind that is read (a quarter of an hour)",
    ),
    "repeat": _in_clone(
        "benchmarks.repeat",
        "whether the sequence of every fault repeats to the byte on busy cores (two hours)",
    ),
    "kill": _in_clone(
        "endurance.kill", "what is lost when processes of a run are killed, a hundred times"
    ),
}
# allowed values of --seconds, and what a benchmark takes that has no SECONDS
SHORTEST_S = 1.0
LONGEST_S = 36_000.0
DEFAULT_S = 20.0


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = ["The project's own benchmarks (* needs a clone of the repository):"]
    for name, benchmark in BENCHMARKS.items():
        mark = "*" if benchmark.needs_clone else " "
        lines.append(f"{mark} {name:11}{benchmark.text}")
    parser.description = "\n".join(lines)
    parser.add_argument(
        "name",
        nargs="+",
        choices=BENCHMARKS,
        metavar="NAME",
        help=", ".join(BENCHMARKS),
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=None,
        metavar="S",
        help="loop: duration of all slices together (default: 20); soak: duration of both pacings "
        "together (default: 480); desk: duration of all rounds together (default: 120); train: duration of "
        "each run (default: 20)",
    )
    parser.add_argument(
        "--count",
        type=int,
        default=0,
        metavar="N",
        help="fuzz: number of inputs (default: 1000000); files: files of each kind (default: 1000); "
        "kill: number of kills (default: 100); "
        "repeat: runs of each sequence (default: 10); merge: stops (default: 1000000); "
        "campaign with --device cuda: stops (default: 8192); million: stops of each plan (default: 60)",
    )
    parser.add_argument("--live", action="store_true", help="loop: with the live view")
    parser.add_argument(
        "--beside",
        type=Path,
        metavar="DIR",
        help="campaign, start: the checkout of an older commit, whose code does the same alternately",
    )
    wsp.axles_argument(parser, "campaign: ")
    parser.add_argument(
        "--device",
        choices=("cores", "cuda"),
        default="cores",
        help="campaign: measure on cores, or on a GPU of NVIDIA (cuda), with a comparison (default: cores)",
    )
    parser.add_argument(
        "--runs",
        type=int,
        default=None,
        metavar="N",
        help="start: number of cold and of warm starts of each command (default: 1 cold, 3 warm)",
    )
    parser.add_argument(
        "--sets",
        type=int,
        default=0,
        metavar="N",
        help="explain: number of sets (default: one round of the matrix of hidden effects; any "
        "larger number is possible); discover: number of rigs (default: 40)",
    )
    parser.add_argument(
        "--tool",
        choices=("explain", "bic", "sparse", "least_squares"),
        default="explain",
        help="explain: the tool that answers, explain or one of three usual methods "
        "(default: explain)",
    )
    parser.add_argument(
        "--export",
        type=Path,
        metavar="DIR",
        help="explain: only write the sets without their truth, and the key for rollerrig score",
    )
    parser.add_argument(
        "--folder",
        type=Path,
        metavar="DIR",
        help="explain, discover: folder of sets and answers, which is completed or extended "
        "(default: reports/bench_explain_GENERATOR_SEED, reports/bench_discover_SEED)",
    )
    parser.add_argument(
        "--generator",
        choices=("first", "second", "third"),
        default="first",
        help="explain: the generator of the sets; each has another author, and the third uses "
        "MuJoCo (default: first)",
    )
    parser.add_argument(
        "--alone",
        action="store_true",
        help="explain: answer one set after another, each on all cores, as rollerrig explain does; "
        "use it to measure the time of a set (default: one set per core)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of everything that is random (default: 0)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="loop, train, hunting, protection, sensors: change one value of the scenario, as in loop.priority=0",
    )
    parser.add_argument(
        "--png", type=Path, metavar="FILE", help="protection: also draw the figures"
    )
    parser.add_argument(
        "--strict", action="store_true", help="exit status 1 when a target is missed"
    )
    parser.add_argument(
        "--markdown",
        type=Path,
        metavar="FILE",
        help="also write the tables into a page, in place of the section of the same benchmark, "
        "as in docs/performance.md",
    )


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.benchmarks import figures

    requested_s = given.seconds
    if requested_s is not None and not SHORTEST_S <= requested_s <= LONGEST_S:
        raise ConfigError(
            f"--seconds {requested_s:g} is out of range; "
            f"allowed are {SHORTEST_S:g} to {LONGEST_S:g} s"
        )
    if given.count < 0:
        raise ConfigError(
            f"--count {given.count} is out of range; allowed are 1 and more, "
            "and 0 for the default number"
        )

    console = output.console()
    command = " ".join(["rollerrig", *sys.argv[1:]])
    results = {}
    # a name that is given twice runs once
    for name in dict.fromkeys(given.name):
        module = _module(name)
        given.seconds = requested_s or getattr(module, "SECONDS", DEFAULT_S)
        results[name] = module.run(given, output.print_message)
        table = module.table(results[name])
        lines = figures.lines(results[name])
        if not given.json:
            console.print(table)
            console.print("\n".join(lines))
        if given.markdown:
            heading = module.section(given) if hasattr(module, "section") else name
            figures.put(given.markdown, heading, command, table, lines)
    if given.json:
        print(json.dumps(results))

    if given.strict and not _all_met(results):
        return output.FAILED
    return output.PASS


def _module(name: str) -> ModuleType:
    """Return the module of a benchmark, which has `run(given, say)` and `table(result)`."""
    benchmark = BENCHMARKS[name]
    if benchmark.needs_clone:
        return clone.load(benchmark.module, f"rollerrig bench {name}")
    return importlib.import_module(benchmark.module)


def _all_met(results: dict[str, dict]) -> bool:
    """Return whether all targets of all benchmarks are met."""
    targets = [target for result in results.values() for target in result.get("targets", [])]
    return all(target["met"] for target in targets)


def score_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Judges the answers of any tool (needs a clone of the repository)."
    parser.add_argument("folder", type=Path, help="folder of the sets and their key")
    parser.add_argument(
        "answers",
        type=Path,
        help="JSON file with one answer per set, or a folder with one file SET.json per set; "
        "report.json of rollerrig explain is such an answer",
    )


def score(given: argparse.Namespace) -> int:
    explain = clone.load("benchmarks.explain", "rollerrig score")
    from rollerrig.realtime.benchmarks import figures

    result = explain.judge(given.folder, given.answers)
    return output.show(given, result, explain.table(result), *figures.lines(result))
