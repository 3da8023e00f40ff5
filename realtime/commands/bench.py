"""`rollerrig bench`: the project's own benchmarks, by name, as tables or JSON; `rollerrig score`: judge any tool."""

import argparse
import importlib
import json
import sys
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output

# module under `benchmarks`, imported only when it is asked for, and what it is
BENCHMARKS = {
    "contact": "what a contact costs, and the four models braking the coach: Table 8 of the paper",
    "hunting": "the speed above which the coach in 3D hunts, by a sweep",
    "loop": "lateness of the real-time loop against cyclictest's",
    "bus": "TPDO to valve, SYNC to last TPDO, round trips, on a running bench",
    "discover": "how often discover finds out a sealed rig (minutes a rig)",
    "explain": "how often explain is right, on sets with known hidden effects (an hour)",
    "campaign": "stops a minute and core, two workers against one, memory, Dask",
    "harness": "lateness and missed ticks with and without a scripted sequence",
    "desk": "lateness and missed ticks with and without a desk that ten browsers look at",
    "vehicle": "45 s of four axles without deadlines, and the start of a run",
    "endurance.soak": "memory, disk and losses of long runs, in real time and in lockstep",
    "endurance.fuzz": "a million malformed inputs through every door of running benches",
    "endurance.kill": "what is lost and left when processes of a run are killed, a hundred times",
}
NAMES = {path.rpartition(".")[2]: path for path in BENCHMARKS}


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = "The project's own benchmarks:\n" + "\n".join(
        f"  {name:10}{BENCHMARKS[path]}" for name, path in NAMES.items()
    )
    parser.add_argument("name", nargs="+", choices=NAMES, metavar="NAME", help=", ".join(NAMES))
    parser.add_argument(
        "--seconds",
        type=float,
        default=None,
        metavar="S",
        help="how long the loop runs, all slices "
        "together (default: 20), or soak, both pacings together (default: 480)",
    )
    parser.add_argument(
        "--count",
        type=int,
        default=0,
        metavar="N",
        help="inputs of fuzz (default: 1000000), kills of kill (default: 100)",
    )
    parser.add_argument("--live", action="store_true", help="loop: with the live view on")
    parser.add_argument(
        "--sets",
        type=int,
        default=0,
        metavar="N",
        help="explain: the first N sets (default: one turn "
        "of the matrix, of which there are as many as wanted); discover: rigs (default: 40)",
    )
    parser.add_argument(
        "--tool",
        choices=("explain", "bic", "sparse", "least_squares"),
        default="explain",
        help="explain: what answers, explain or one of three usual ways (default: explain)",
    )
    parser.add_argument(
        "--export",
        type=Path,
        metavar="DIR",
        help="explain: only write the sets without truth, and the key, for rollerrig score",
    )
    parser.add_argument(
        "--folder",
        type=Path,
        metavar="DIR",
        help="explain, discover: where sets and answers are, to "
        "go on or to grow (default: reports/bench_explain_GENERATOR_SEED, reports/bench_discover_SEED)",
    )
    parser.add_argument(
        "--generator",
        choices=("first", "second", "third"),
        default="first",
        help="explain: whose sets, by one author, by another, or in MuJoCo (default: first)",
    )
    parser.add_argument(
        "--alone",
        action="store_true",
        help="explain: one set after another, each on all cores, as "
        "rollerrig explain does: for its time (default: one set a core)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of whatever is random (default: 0)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="loop, hunting: change one value of the scenario, as in loop.priority=0",
    )
    parser.add_argument(
        "--strict", action="store_true", help="exit status 1 when a target is missed"
    )
    parser.add_argument(
        "--markdown",
        type=Path,
        metavar="FILE",
        help="also write the tables into a page, in "
        "place of the same benchmark's section, as in docs/performance.md",
    )


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.benchmarks import figures

    if not 1.0 <= (given.seconds or 1.0) <= 36_000.0 or given.seconds == 0.0:
        raise ConfigError(f"--seconds {given.seconds:g}: allowed are 1 to 36000 s")
    if given.count < 0:
        raise ConfigError(
            f"--count {given.count}: allowed are 1 and more, and 0 for the usual number"
        )
    from rich.console import Console

    asked_s, console, results = given.seconds, Console(), {}
    for name in dict.fromkeys(given.name):
        module = importlib.import_module(f"rollerrig.realtime.benchmarks.{NAMES[name]}")
        given.seconds = asked_s or getattr(module, "SECONDS", 20.0)
        results[name] = module.run(given, output.say)
        shown, lines = module.table(results[name]), figures.lines(results[name])
        if not given.json:
            console.print(shown)
            console.print("\n".join(lines), highlight=False)
        if given.markdown:
            figures.put(given.markdown, name, " ".join(["rollerrig", *sys.argv[1:]]), shown, lines)
    if given.json:
        print(json.dumps(results))
    met = all(one["met"] for result in results.values() for one in result.get("targets", ()))
    return output.FAILED if given.strict and not met else output.PASS


def score_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="folder of the sets and their key")
    parser.add_argument(
        "answers",
        type=Path,
        help="JSON file with an answer for each set, or a folder of files "
        "SET.json; report.json of rollerrig explain is such an answer",
    )


def score(given: argparse.Namespace) -> int:
    from rollerrig.realtime.benchmarks import explain, figures

    found = explain.judge(given.folder, given.answers)
    return output.show(given, found, explain.table(found), *figures.lines(found))
