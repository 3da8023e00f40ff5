"""`rollerrig run`: one bench run, its progress line, its table and its exit status."""

import argparse
import asyncio
import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from rollerrig.rig import kernel

PASS, LATE = 0, 3


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", help="name of a packaged scenario, or a TOML file")
    parser.add_argument("--pacing", choices=("wall", "lockstep", "free"), default="wall",
                        help="wall: real time; lockstep: each bus cycle waits for the unit's answer, "
                        "repeatable; free: no bus, as fast as it goes (default: wall)")
    parser.add_argument("--wsp", choices=("reference", "external", "none"), default="reference",
                        help="reference: in its own process over the bus; external: wait for a "
                        "unit's heartbeat; none (default: reference)")
    parser.add_argument("--model", default="", metavar="FILE", help="an extended model to load")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the run (default: "
                        "runs/SCENARIO, with a number if it exists)")
    parser.add_argument("--live", action="store_true", help="show the run live in Rerun")
    parser.add_argument("--strict", action="store_true", help="exit status 3 when a deadline is missed")
    parser.add_argument("--seed", type=int, default=0, help="seed of whatever is random (default: 0)")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE",
                        help="change one value, as in adhesion.mu_cd=0.05; may be repeated")
    parser.add_argument("--fault", action="append", default=[], metavar="'KIND KEY=VALUE ...'",
                        help="inject a fault of the catalogue, as in 'speed_sensor_stuck axle=2 at=5 "
                        "for=3'; may be repeated")
    parser.add_argument("--start", choices=("now", "modbus"), default="now", help="modbus: hold the rig "
                        "rolling at its set speed until a Modbus client starts it (default: now)")
    parser.add_argument("--harness", action="store_true", help="begin when a harness has joined "
                        "(node 127), as 'rollerrig sequence --bus' does")
    parser.add_argument("--wait", type=float, default=60.0, metavar="S",
                        help="longest wait for a WSP unit to appear (default: 60)")


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.bench import bench, options, scenario
    from rollerrig.realtime.record import summary

    plan = scenario.load(given.scenario, given.model, tuple(given.set), faults=tuple(given.fault))
    out = given.out or free_folder(plan.name)
    how = options.Options(pacing=given.pacing, unit=given.wsp, out=out, live=given.live, seed=given.seed,
                          unit_wait_s=given.wait, start=given.start, harness=given.harness)
    options.check_options(how)
    line = ProgressLine()
    if not kernel.is_compiled():
        line.message("compiling the kernels, once after an installation (about half a minute) ...")
    result = asyncio.run(bench.Bench(plan, how, line).run())
    line.end()
    if given.json:
        print(json.dumps(result | {"folder": str(out)}))
    else:
        console = Console()
        console.print(summary.table(result))
        console.print(f"recorded in {out}; open it with: rollerrig view {out}", highlight=False)
    return LATE if given.strict and result["loop"]["missed"] else PASS


def free_folder(name: str) -> Path:
    """runs/NAME, or the first runs/NAME-2, runs/NAME-3 ... that does not exist yet."""
    number, out = 1, Path("runs") / name
    while out.exists():
        number += 1
        out = Path("runs") / f"{name}-{number}"
    return out


class ProgressLine:
    """One line on standard error, rewritten on a terminal, else printed every five seconds."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._said = -5.0
        self._open = False

    def __call__(self, progress: Any) -> None:
        if progress.message:
            self.message(progress.message)
            return
        text = (f"t = {progress.time_s:6.1f} s   v = {progress.speed_m_s:5.1f} m/s   "
                f"sliding {progress.sliding_m_s:5.1f} m/s   missed deadlines {progress.missed}")
        now = time.monotonic()
        if self._terminal:
            print("\r" + text, end="", file=sys.stderr, flush=True)
            self._open = True
        elif now - self._said >= 5.0:
            print(text, file=sys.stderr, flush=True)
            self._said = now

    def message(self, text: str) -> None:
        self.end()
        print(text, file=sys.stderr, flush=True)

    def end(self) -> None:
        if self._open:
            print(file=sys.stderr)
            self._open = False
