"""`rollerrig check`: what this machine can do, and how to enable what it cannot.

Every row is one question, put to the machine itself and not to a list of known machines: the port
is bound, the priority asked for, memory locked and let go. Exit status 0 when a run is possible at
all, 2 when it is not.
"""

import argparse
import json
import sys
from collections.abc import Callable

from rich.console import Console
from rich.table import Table

from rollerrig.realtime.bench import machine_check
from rollerrig.realtime.bench.machine_check import Finding, State

PASS, USAGE = 0, 2


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=int, default=29536, metavar="N",
                        help="the hub's port to look at (default: 29536)")


def call(given: argparse.Namespace) -> int:
    return tell(look(given.port), given.json)


def tell(findings: list[Finding], as_json: bool) -> int:
    """Print the findings; the exit status says whether a run is possible."""
    possible = all(one.state is not State.MISSING for one in findings)
    if as_json:
        print(json.dumps({"possible": possible, "checks": [one._asdict() for one in findings]}))
    else:
        Console().print(table(findings))
        print("a run is possible" if possible else "no run is possible before the rows that say "
              "'missing' are mended", file=sys.stderr)
    return PASS if possible else USAGE


def look(port: int) -> list[Finding]:
    """Ask the machine all questions, in the order of the table."""
    checks: tuple[Callable[[], Finding], ...] = (
        machine_check.python, machine_check.packages, machine_check.kernels, machine_check.shared_memory,
        machine_check.loopback,
        machine_check.socketcan, lambda: machine_check.port(port), machine_check.cores, machine_check.priority,
        machine_check.memory_lock, machine_check.idle_states, machine_check.governor, machine_check.preemption,
        machine_check.display, machine_check.pictures, machine_check.cyclictest)
    return [check() for check in checks]


_COLOURS = {State.OK: "green", State.WEAKER: "yellow", State.MISSING: "bold red"}


def table(findings: list[Finding]) -> Table:
    """The findings for a terminal."""
    shown = Table(title="what this machine can do", title_justify="left")
    for head in ("what", "state", "found", "how to enable"):
        shown.add_column(head, overflow="fold")
    for one in findings:
        shown.add_row(one.name, f"[{_COLOURS[one.state]}]{one.state}[/]", one.found, one.mend)
    return shown
