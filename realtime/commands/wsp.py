"""`rollerrig wsp`: the reference WSP unit, or one that is an FMU, as a program of its own on a bus."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from rollerrig.wsp_interface.signals import DEFAULT_ADDRESS


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--bus",
        default=DEFAULT_ADDRESS,
        metavar="ADDRESS",
        help=f"socketcand://HOST:PORT/rig0 or socketcan:vcan0 (default: {DEFAULT_ADDRESS})",
    )
    parser.add_argument(
        "--config",
        default="reference",
        metavar="NAME",
        help="thresholds: a packaged configuration or a TOML file (default: reference)",
    )
    parser.add_argument(
        "--priority",
        type=int,
        default=0,
        metavar="N",
        help="real-time priority to ask for (default: none)",
    )
    parser.add_argument(
        "--lockstep",
        type=float,
        default=0.0,
        metavar="S",
        help="send nothing by wall clock, as the "
        "bench asks of its own unit with --pacing lockstep, and count the time in SYNCs, which come "
        "every S seconds of the run; a SYNC without speeds is answered with the next",
    )
    parser.add_argument(
        "--fmu",
        type=Path,
        action="append",
        metavar="FILE",
        help="run a WSP that is an FMU instead of "
        "the reference; again for further FMUs, where all have a CAN port (FMI-LS-BUS)",
    )
    map_argument(parser)
    parser.add_argument(
        "--step",
        type=float,
        default=0.01,
        metavar="S",
        help="with --fmu: how far a SYNC takes it, the SYNC period (default: 0.01)",
    )
    parser.add_argument(
        "--step-wait",
        type=float,
        default=10.0,
        metavar="S",
        help="with --fmu: how long one step may take of wall time (default: 10)",
    )
    parser.add_argument(
        "--bitrate",
        type=int,
        default=0,
        metavar="N",
        help="with --fmu: the bit rate of the bus, to "
        "which a CAN port has to be set (default: not compared)",
    )
    parser.add_argument("--log", type=Path, help=argparse.SUPPRESS)


def map_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--unit-map",
        type=Path,
        metavar="FILE",
        help="an FMU's names and scales of speeds, pressures and magnets (default: the rig's own)",
    )


def parse_unit(text: str) -> str:
    """Whose WSP it is, from the command line; nothing stands for what is the default there."""
    if text in ("", "reference", "external", "none") or (text.startswith("fmu:") and len(text) > 4):
        return text
    raise argparse.ArgumentTypeError(f"{text!r}: choose from reference, external, none, fmu:FILE")


class AppendUnit(argparse.Action):
    """`--wsp` once, or again for further FMUs of one bus: fmu:FILE,fmu:FILE."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        given: argparse.Namespace,
        value: Any,
        option: str | None = None,
    ) -> None:
        before = getattr(given, self.dest)
        if before == self.default:
            before = ""
        elif not (value.startswith("fmu:") and before.startswith("fmu:")):
            parser.error(
                f"argument --wsp: {before} and {value}: only FMUs go together, on one bus by their CAN ports"
            )
        setattr(given, self.dest, f"{before},{value}" if before else value)


def call(given: argparse.Namespace) -> int:
    if given.log:
        with open(given.log, "ab", buffering=0) as log:
            os.dup2(log.fileno(), sys.stdout.fileno())
            os.dup2(log.fileno(), sys.stderr.fileno())
    if given.fmu:
        from rollerrig.firmware_sim.fmu import can_unit, fmu_file, signal_unit

        fmus = fmu_file.check_all(tuple(given.fmu), given.unit_map, given.step)
        how = given.bus, given.priority, given.lockstep, given.step_wait
        return (
            can_unit.main(fmus, *how, given.bitrate)
            if fmus[0].terminal
            else signal_unit.main(fmus[0], *how)
        )
    from rollerrig.firmware_sim.wsp import node

    return node.main(given.bus, given.config, given.priority, given.lockstep)


def run_from_stdin() -> int:
    """Be the reference unit that a line of JSON on standard input asks for, its words; 0 where none comes."""
    from rollerrig.firmware_sim.wsp import logic, node
    from rollerrig.rig.compiled import kernel_cache

    if kernel_cache.is_compiled():
        node.warm(logic.load("reference"))
    words = json.loads(sys.stdin.readline() or "null")
    if words is None:
        return 0
    parser = argparse.ArgumentParser(prog="rollerrig wsp")
    arguments(parser)
    return call(parser.parse_args(words))
