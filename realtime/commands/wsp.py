"""`rollerrig wsp`: runs the reference WSP unit, or an FMU, as a separate program on a bus."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import ALLOWED_AXLES, COACH_AXLES, Kind
from rollerrig.wsp_interface import unit_choice
from rollerrig.wsp_interface.signals import DEFAULT_ADDRESS


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig wsp`."""
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
        "--group",
        type=int,
        default=1,
        metavar="N",
        help="group of four axles that the unit protects, on a vehicle with more axles (default: 1)",
    )
    axles_argument(parser)
    parser.add_argument(
        "--dynamic-brake",
        action="store_true",
        help="the vehicle has a dynamic brake: release the motors of sliding axles",
    )
    parser.add_argument(
        "--priority",
        type=int,
        default=0,
        metavar="N",
        help="real-time priority to request (default: none)",
    )
    parser.add_argument(
        "--leave-core",
        type=int,
        default=-1,
        metavar="N",
        help="core that is left to the bench: run on the others, if there are any (default: none)",
    )
    parser.add_argument(
        "--lockstep",
        type=float,
        default=0.0,
        metavar="S",
        help="for a bench with --pacing lockstep: the unit sends nothing by wall clock and counts "
        "time in SYNCs, which come every S seconds of the run; it answers a SYNC without speeds "
        "together with the next SYNC",
    )
    parser.add_argument(
        "--fmu",
        type=Path,
        action="append",
        metavar="FILE",
        help="run a WSP that is an FMU instead of the reference; may be repeated if all FMUs have "
        "a CAN port (FMI-LS-BUS)",
    )
    parser.add_argument(
        "--replay",
        type=Path,
        metavar="FILE",
        help="send again what a unit has sent in a log of the bus (candump .log, .blf, .asc, .trc), "
        "instead of the reference; its SYNCs are those of the run",
    )
    map_argument(parser)
    parser.add_argument(
        "--step",
        type=float,
        default=0.01,
        metavar="S",
        help="with --fmu: length of one step of the FMU, which is the SYNC period (default: 0.01)",
    )
    parser.add_argument(
        "--step-wait",
        type=float,
        default=10.0,
        metavar="S",
        help="with --fmu: longest wall time of one step (default: 10)",
    )
    parser.add_argument(
        "--bitrate",
        type=int,
        default=0,
        metavar="N",
        help="with --fmu: bit rate of the bus, for which a CAN port must be configured "
        "(default: not checked)",
    )
    parser.add_argument("--log", type=Path, help=argparse.SUPPRESS)


def axles_argument(parser: argparse.ArgumentParser, begin: str = "") -> None:
    """Declare --axles, which several verbs have; `begin` is the beginning of its help."""
    parser.add_argument(
        "--axles",
        type=int,
        choices=ALLOWED_AXLES,
        default=COACH_AXLES,
        metavar="N",
        help=f"{begin}number of axles of the vehicle (default: {COACH_AXLES})",
    )


def map_argument(parser: argparse.ArgumentParser) -> None:
    """Declare --unit-map, which several verbs have."""
    parser.add_argument(
        "--unit-map",
        type=Path,
        metavar="FILE",
        help="names and scales of an FMU's speeds, pressures and magnets "
        "(default: the names and scales of the rig)",
    )


def parse_unit(text: str) -> str:
    """Return the value of --wsp if it is allowed; "" is the default of the command.

    Raises ArgumentTypeError for any other text.
    """
    if not text:
        return text
    try:
        return unit_choice.check(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def unit_argument(parser: argparse.ArgumentParser) -> None:
    """Declare --unit, which several verbs have; `with_command` applies it."""
    parser.add_argument(
        "--unit",
        default="",
        metavar="COMMAND",
        help="command that starts your unit for each run; {address}, {host} and {port} are "
        "replaced by those of the bus ({car}: the car of a train), as in "
        "'python docs/examples/wsp_unit.py {host} {port}'; its output is in wsp.log of the run",
    )


def with_command(options: argparse.Namespace, default: str) -> str:
    """Return the unit of the options --wsp and --unit, of which --unit wins over the `default`.

    Raises ConfigError if both choose a unit, or if the command is wrong.
    """
    if not options.unit:
        return str(options.wsp)
    if options.wsp not in (default, "external"):
        raise ConfigError(
            f"--unit '{options.unit}' and --wsp {options.wsp} are two units; give one of them"
        )
    return unit_choice.check(f"{unit_choice.COMMAND}{options.unit}")


def allow_argument(parser: argparse.ArgumentParser, what: str) -> None:
    """Declare --allow-unit for a verb; `what` may choose a unit, as in "a sequence"."""
    parser.add_argument(
        unit_choice.ALLOW_UNIT,
        action="append",
        default=[],
        metavar="UNIT",
        help=f"an FMU, or a command as in 'command:./unit {{host}} {{port}}', that {what} may "
        "choose as the WSP unit; it runs with your rights, so allow only programs that you trust; "
        "may be repeated (default: none)",
    )


class AppendUnit(argparse.Action):
    """Stores --wsp. A repeated --wsp adds a further FMU on the same bus: fmu:FILE,fmu:FILE."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        options: argparse.Namespace,
        value: Any,
        option: str | None = None,
    ) -> None:
        before = getattr(options, self.dest)
        if before == self.default:
            setattr(options, self.dest, value)
            return

        if not (unit_choice.fmus_of(value) and unit_choice.fmus_of(before)):
            parser.error(
                f"argument --wsp: {before} and {value}: only FMUs can share a bus, each through "
                "its CAN port; repeat --wsp only with fmu:FILE"
            )
        setattr(options, self.dest, f"{before},{value}")


def call(options: argparse.Namespace) -> int:
    """Run a WSP unit until its bus ends. Returns the exit status."""
    if options.log:
        _redirect_output(options.log)
    _leave_core(options.leave_core)
    if options.fmu and options.replay:
        raise ConfigError("--fmu and --replay are two units; give one of them")
    if options.fmu:
        return _run_fmus(options)

    from rollerrig.firmware_sim.wsp import node

    if options.replay:
        return _replay(options)
    return node.main(
        bus_address=options.bus,
        config=options.config,
        priority=options.priority,
        lockstep_s=options.lockstep,
        group=options.group,
        kind=_kind(options),
    )


def _replay(options: argparse.Namespace) -> int:
    """Run the unit of a log. Raises ConfigError before the bus is opened."""
    from rollerrig.firmware_sim.wsp import node, replay

    frames = node.frames_of_group(_kind(options), options.group)
    found = replay.read(options.replay, frames)
    return node.serve(
        lambda bus: replay.Replay(bus, found, frames, options.lockstep),
        options.bus,
        options.priority,
        options.lockstep,
    )


def _kind(options: argparse.Namespace) -> Kind:
    """Return the kind of the vehicle, as far as a unit has to know it."""
    return Kind(options.axles, options.dynamic_brake)


def _redirect_output(path: Path) -> None:
    """Append standard output and standard error of this process to a file."""
    with open(path, "ab", buffering=0) as log:
        os.dup2(log.fileno(), sys.stdout.fileno())
        os.dup2(log.fileno(), sys.stderr.fileno())


def _leave_core(core: int) -> None:
    """Run on all allowed cores but one; on that one, too, if there is no other."""
    others = os.sched_getaffinity(0) - {core}
    if others:
        os.sched_setaffinity(0, others)


def _run_fmus(options: argparse.Namespace) -> int:
    """Run one or several FMUs as WSP unit: through their CAN ports, or one by its signals."""
    from rollerrig.firmware_sim.fmu import can_unit, fmu_file, signal_unit

    kind = _kind(options)
    paths = tuple(options.fmu)
    fmus = fmu_file.check_all(paths, options.unit_map, options.step, kind.unit_axles)
    first = fmus[0]
    if first.terminal:
        return can_unit.main(
            fmus,
            bus_address=options.bus,
            priority=options.priority,
            lockstep_s=options.lockstep,
            patience_s=options.step_wait,
            bitrate=options.bitrate,
        )
    return signal_unit.main(
        first,
        bus_address=options.bus,
        priority=options.priority,
        lockstep_s=options.lockstep,
        patience_s=options.step_wait,
        group=options.group,
        kind=kind,
    )


def run_from_stdin() -> int:
    """Run the WSP unit whose arguments come as a line of JSON on standard input.

    A bench starts this process before it knows the arguments, so that the unit is ready early.
    Returns the exit status; 0 if no arguments come.
    """
    from rollerrig.firmware_sim.wsp import logic, node
    from rollerrig.rig.compiled import kernel_cache

    # loads the compiled kernels while the bench prepares the run; never compiles them here
    if kernel_cache.is_compiled():
        node.warm(logic.load("reference"))

    words = json.loads(sys.stdin.readline() or "null")
    if words is None:
        return 0
    parser = argparse.ArgumentParser(prog="rollerrig wsp")
    arguments(parser)
    return call(parser.parse_args(words))
