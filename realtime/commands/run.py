"""`rollerrig run`: one bench run, its progress line, its table and its exit status."""

import argparse
import asyncio
import itertools
import sys
import time
from pathlib import Path
from typing import Any

from rollerrig.realtime.commands import output, wsp

LATE = 3


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", help="name of a packaged scenario, or a TOML file")
    parser.add_argument(
        "--pacing",
        choices=("wall", "lockstep", "free"),
        default="wall",
        help="wall: real time; lockstep: each bus cycle waits for the unit's answer, "
        "repeatable; free: no bus, as fast as it goes (default: wall)",
    )
    parser.add_argument(
        "--wsp",
        type=wsp.parse_unit,
        action=wsp.AppendUnit,
        default="reference",
        metavar="{reference,external,none,fmu:FILE}",
        help="reference: in its own process over the bus; external: wait for a unit's heartbeat; "
        "fmu:FILE: an FMU (FMI 2 or 3, co-simulation) in its own process, again for further ones that "
        "share the bus by CAN ports (FMI-LS-BUS); none (default: reference)",
    )
    wsp.map_argument(parser)
    parser.add_argument("--model", default="", metavar="FILE", help="an extended model to load")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the run (default: runs/SCENARIO, with a number if it exists)",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="show the run live in Rerun: in a window, or without a "
        "screen as a page for a browser, whose address is told",
    )
    parser.add_argument(
        "--hold", action="store_true", help="with --live: begin when somebody looks on"
    )
    parser.add_argument(
        "--strict", action="store_true", help="exit status 3 when a deadline is missed"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of whatever is random (default: 0)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one value, as in adhesion.mu_cd=0.05; may be repeated",
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="'KIND KEY=VALUE ...'",
        help="inject a fault "
        "of the catalogue, as in 'speed_sensor_stuck axle=2 at=5 for=3'; may be repeated",
    )
    parser.add_argument(
        "--start",
        choices=("now", "modbus"),
        default="now",
        help="modbus: hold the rig "
        "rolling at its set speed until a Modbus client starts it (default: now)",
    )
    parser.add_argument(
        "--harness",
        action="store_true",
        help="begin when a harness has joined (node 127), as 'rollerrig sequence --bus' does",
    )
    parser.add_argument(
        "--wait",
        type=float,
        default=60.0,
        metavar="S",
        help="longest wait for a WSP unit to appear (default: 60)",
    )
    parser.add_argument(
        "--answer-wait",
        type=float,
        default=10.0,
        metavar="S",
        help="in lockstep, how long a unit may "
        "owe its answer (default: 10); the bench's own, while it lives, and a harness six times that",
    )


def call(given: argparse.Namespace) -> int:
    from rollerrig.configs.processes import children
    from rollerrig.realtime.bench import options

    own_unit = given.wsp == "reference" and given.pacing != "free"
    with options.waiting_processes(
        children.can_fork(), wsp.run_from_stdin if own_unit else None
    ) as processes:
        return _run(given, processes)


def _run(given: argparse.Namespace, processes: dict[str, Any]) -> int:
    from rollerrig.realtime.bench import bench, options, scenario
    from rollerrig.realtime.record import summary

    plan = scenario.load(given.scenario, given.model, tuple(given.set), faults=tuple(given.fault))
    out = given.out or free_folder(plan.name)
    how = options.Options(
        pacing=given.pacing,
        unit=given.wsp,
        out=out,
        live=given.live,
        hold=given.hold,
        seed=given.seed,
        unit_wait_s=given.wait,
        answer_wait_s=given.answer_wait,
        start=given.start,
        harness=given.harness,
        unit_map=given.unit_map,
        **processes,
    )
    line = ProgressLine()
    result = asyncio.run(bench.Bench(plan, how, line).run())
    line.end()
    shown: list[Any] = []
    if not given.json:
        from rich.text import Text

        shown = [
            summary.table(result),
            f"recorded in {out}; open it with: rollerrig view {out}",
            *(Text(f"not valid: {reason}", "bold red") for reason in result["invalid_because"]),
        ]
    output.show(given, result | {"folder": str(out)}, *shown)
    if result["invalid_because"]:
        return output.INVALID
    return LATE if given.strict and result["loop"]["missed"] else output.PASS


def free_folder(name: str) -> Path:
    """runs/NAME, or the first runs/NAME-2, runs/NAME-3 ... that does not exist yet."""
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(out for one in names if not (out := Path("runs") / one).exists())


class ProgressLine:
    """One line on standard error, rewritten on a terminal, else printed every five seconds."""

    def __init__(self) -> None:
        self._terminal, self._said, self._open = sys.stderr.isatty(), -5.0, False

    def __call__(self, progress: Any) -> None:
        if progress.message:
            self.message(progress.message)
            return
        text = (
            f"t = {progress.time_s:6.1f} s   v = {progress.speed_m_s:5.1f} m/s   "
            f"sliding {progress.sliding_m_s:5.1f} m/s   missed deadlines {progress.missed}"
        )
        now = time.monotonic()
        if self._terminal:
            print("\r" + text, end="", file=sys.stderr, flush=True)
            self._open = True
        elif now - self._said >= 5.0:
            output.print_message(text)
            self._said = now

    def message(self, text: str) -> None:
        self.end()
        output.print_message(text)

    def end(self) -> None:
        if self._open:
            print(file=sys.stderr)
            self._open = False
