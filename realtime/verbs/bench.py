"""`rollerrig bench`: the project's own benchmarks, one or more by name, as tables or JSON."""

import argparse
import importlib
import json
import sys
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

PASS, FAILED = 0, 1


class Benchmark(NamedTuple):
    """One benchmark: its module under `benchmarks`, imported only when it is asked for."""

    name: str
    text: str


BENCHMARKS = (
    Benchmark("contact", "what a contact costs, and the four models braking the coach: Table 8 of the paper"),
    Benchmark("hunting", "the speed above which the coach in 3D hunts, by a sweep"),
    Benchmark("loop", "lateness of the real-time loop against cyclictest's"),
    Benchmark("bus", "TPDO to valve, SYNC to last TPDO, round trips, on a running bench"),
    Benchmark("explain", "how often explain is right, on sets with known hidden effects (an hour)"),
    Benchmark("campaign", "stops a minute and core, two workers against one, memory, Dask"),
    Benchmark("harness", "lateness and missed ticks with and without a scripted sequence"),
    Benchmark("vehicle", "45 s of four axles without deadlines, and the start of a run"),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = "The project's own benchmarks:\n" + "\n".join(
        f"  {one.name:10}{one.text}" for one in BENCHMARKS)
    parser.add_argument("name", nargs="+", choices=[one.name for one in BENCHMARKS],
                        metavar="NAME", help=", ".join(one.name for one in BENCHMARKS))
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S",
                        help="how long the loop runs, all slices together (default: 20)")
    parser.add_argument("--live", action="store_true", help="loop: with the live view on")
    parser.add_argument("--sets", type=int, default=0, metavar="N",
                        help="explain: only the first N sets of the matrix (default: all)")
    parser.add_argument("--generator", choices=("first", "second"), default="first",
                        help="explain: whose sets, by one author or by another (default: first)")
    parser.add_argument("--seed", type=int, default=0, help="seed of whatever is random (default: 0)")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE",
                        help="loop, hunting: change one value of the scenario, as in loop.priority=0")
    parser.add_argument("--strict", action="store_true", help="exit status 1 when a target is missed")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="also write the tables into a page, in "
                        "place of the same benchmark's section, as in docs/performance.md")


def call(given: argparse.Namespace) -> int:
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.benchmarks import figures
    from rollerrig.rig import kernel

    if not 1.0 <= given.seconds <= 3600.0:
        raise ConfigError(f"--seconds {given.seconds:g}: allowed are 1 to 3600 s")
    if not kernel.is_compiled():
        say("compiling the kernels, once after an installation (about half a minute) ...")
    console, results = Console(), {}
    for name in dict.fromkeys(given.name):
        module = importlib.import_module(f"rollerrig.realtime.benchmarks.{name}")
        results[name] = module.run(given, say)
        if not given.json:
            console.print(module.table(results[name]))
            for line in figures.lines(results[name]):
                console.print(line, highlight=False)
        if given.markdown:
            figures.put(given.markdown, name, " ".join(["rollerrig", *sys.argv[1:]]),
                        module.table(results[name]), figures.lines(results[name]))
    if given.json:
        print(json.dumps(results))
    return FAILED if given.strict and not figures.all_met(results.values()) else PASS


def say(text: str) -> None:
    """Progress, on standard error."""
    print(text, file=sys.stderr, flush=True)
