"""The options of a run, and its recorder and reference unit, which start before the bench is ready.

This file imports almost nothing, so the two processes start early. They load their libraries while
the bench loads its libraries, and then wait for their arguments on standard input.
"""

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.wsp_interface import unit_choice

_RECORDER = "rollerrig.realtime.telemetry.recorder"
# Rerun logs an error because run.rrd has no index while the run goes on; that is intended
_LOG_OF_RERUN = "warn,re_log_encoding=error"


class Options(NamedTuple):
    """How a run is run; the scenario says what is run.

    `unit` is reference, external, none, or fmu:FILE with its mapping, several as fmu:FILE,fmu:FILE,
    or command:LINE for a program of the user.
    `started_unit` is the command with which another program starts an external unit.
    `recorder` and `waiting_unit` are processes that wait for their arguments. `prepare_free`: where
    the run compiles kernels, it also compiles those of a free stop without a unit, which follows.
    """

    pacing: str = "wall"
    unit: str = "reference"
    out: Path = Path("runs/run")
    live: bool = False
    hold: bool = False
    seed: int = 0
    unit_wait_s: float = 60.0
    answer_wait_s: float = 10.0
    start: str = "now"
    harness: bool = False
    recorder: subprocess.Popen[bytes] | None = None
    unit_map: Path | None = None
    waiting_unit: subprocess.Popen[bytes] | None = None
    prepare_free: bool = False
    started_unit: str = ""

    @property
    def fmus(self) -> tuple[Path, ...]:
        """The files of a unit that is one FMU or several."""
        return unit_choice.fmus_of(self.unit)

    @property
    def command(self) -> str:
        """The command line that starts the unit; "" if the unit is no program of the user."""
        return unit_choice.command_of(self.unit)

    @property
    def own_unit(self) -> bool:
        """Whether the unit is one of this project's programs, which the bench starts."""
        return self.unit == "reference" or bool(self.fmus)

    @property
    def starts_unit(self) -> bool:
        """Whether the bench starts the unit."""
        return self.own_unit or bool(self.command)


class Progress(NamedTuple):
    """What the progress line shows."""

    time_s: float
    speed_m_s: float
    sliding_m_s: float
    missed: int
    message: str = ""


# --- processes that start early ---


def start_recorder() -> subprocess.Popen[bytes]:
    """Start a recorder that waits for a line of arguments on standard input.

    It exits if none comes.
    """
    return subprocess.Popen(
        children.module(_RECORDER),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        env={"RUST_LOG": _LOG_OF_RERUN, **os.environ},
    )


def unit_command(*words: str) -> list[str]:
    """Return the command of the unit as a child that is killed with the bench.

    SIGKILL, because a unit that a fault has stopped reacts to no other signal.
    """
    return children.command(
        *children.module("rollerrig.realtime.cli", "wsp", *words), by=signal.SIGKILL
    )


def send_arguments(process: subprocess.Popen[bytes], words: list[str]) -> None:
    """Send its arguments to a process that waits for them.

    A process that has exited is no error here: the code that waits for the process reports it.
    """
    assert process.stdin
    with contextlib.suppress(OSError), process.stdin as line:
        line.write(json.dumps(words).encode() + b"\n")


@contextlib.contextmanager
def waiting_processes(
    fork: bool = False, unit: Callable[[], int] | None = None
) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """Yield processes that wait for their arguments while the caller prepares a run.

    Keys are those of `Options`: `recorder`, and with `fork` (this process may fork) also
    `waiting_unit`, which runs `unit()`. They exit if they get no arguments.
    """
    processes = _fork(unit) if fork else {"recorder": start_recorder()}
    try:
        yield processes
    finally:
        for process in processes.values():
            assert process.stdin
            process.stdin.close()


def _fork(unit: Callable[[], int] | None) -> dict[str, subprocess.Popen[bytes]]:
    """Fork recorder and unit, each when the libraries that it shares with the bench are loaded."""
    from rollerrig.realtime.record import summary  # noqa: F401

    recorder = children.Forked(children.module(_RECORDER), _record)
    processes: dict[str, subprocess.Popen[bytes]] = {"recorder": recorder}
    if unit:
        from rollerrig.firmware_sim.wsp import node  # noqa: F401

        processes["waiting_unit"] = children.Forked(
            ("rollerrig", "wsp"), unit, signal.SIGKILL, True, (recorder,)
        )
    return processes


def _record() -> int:
    os.environ.setdefault("RUST_LOG", _LOG_OF_RERUN)
    from rollerrig.realtime.telemetry import recorder

    return recorder.main([])


# --- what contradicts itself ---


def check(options: Options, modbus: bool) -> None:
    """Refuse options that contradict one another, or a scenario without Modbus.

    Raises ConfigError.
    """
    if options.pacing == "free" and options.unit not in ("reference", "none"):
        kind = "FMU" if options.fmus else "external unit"
        raise ConfigError(
            f"--pacing free has no bus, so no {kind} can answer; use --pacing lockstep "
            "(repeatable) or wall (real time)"
        )
    if options.unit_map and not options.fmus:
        raise ConfigError(
            f"--unit-map is for an FMU, and the unit is {options.unit}: use --wsp fmu:FILE, or "
            "'rollerrig sequence' for a unit with its CAN messages"
        )
    if options.hold and not options.live:
        raise ConfigError("--hold waits for a viewer of the live view: give --live as well")
    if options.start == "modbus" and options.pacing != "wall":
        raise ConfigError(
            f"--start modbus holds the rig in real time; --pacing {options.pacing} is not real time: "
            "use --pacing wall"
        )
    if options.start == "modbus" and not modbus:
        raise ConfigError(
            "--start modbus waits for a Modbus client, but [modbus] enabled is false; set "
            "modbus.enabled=true"
        )
