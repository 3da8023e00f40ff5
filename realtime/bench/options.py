"""How a run is run, and its recorder and reference unit, which are begun before they can be told of what.

This file imports next to nothing, so that these load what they need beside the bench's own imports.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children


class Options(NamedTuple):
    """How a run is run; the scenario says what.

    `unit`: reference, external, none, or fmu:FILE with its mapping, several as fmu:FILE,fmu:FILE.
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
    begun_unit: subprocess.Popen[bytes] | None = None

    @property
    def fmus(self) -> tuple[Path, ...]:
        """The files of a unit that is an FMU, or several."""
        return fmus_of(self.unit)

    @property
    def own_unit(self) -> bool:
        """Whether the bench starts the unit."""
        return self.unit not in ("external", "none")


def fmus_of(unit: str) -> tuple[Path, ...]:
    """The files of fmu:FILE,fmu:FILE; none of another unit."""
    return tuple(map(Path, re.split("(?:^|,)fmu:", unit)[1:]))


class Progress(NamedTuple):
    """What the progress line shows."""

    time_s: float
    speed_m_s: float
    sliding_m_s: float
    missed: int
    message: str = ""


_RECORDER = "rollerrig.realtime.telemetry.recorder"
# that run.rrd has no index before its end is meant to be
_TOLD_BY_RERUN = "warn,re_log_encoding=error"


def begin_recorder() -> subprocess.Popen[bytes]:
    """A recorder that waits for a line of arguments on its standard input, and ends where none comes."""
    return subprocess.Popen(
        [sys.executable, "-m", _RECORDER],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        env={"RUST_LOG": _TOLD_BY_RERUN, **os.environ},
    )


def unit_command(*words: str) -> list[str]:
    """The unit as a child that is killed with the bench, as one that is stopped would hear nothing else."""
    return children.command(
        sys.executable, "-m", "rollerrig.realtime.cli", "wsp", *words, by=signal.SIGKILL
    )


def _record() -> int:
    os.environ.setdefault("RUST_LOG", _TOLD_BY_RERUN)
    from rollerrig.realtime.telemetry import recorder

    return recorder.main([])


def _forked(unit: Callable[[], int] | None) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Recorder and unit, each forked when what it shares with the bench has been loaded."""
    from rollerrig.realtime.record import summary  # noqa: F401

    yield "recorder", (recorder := children.Forked((sys.executable, "-m", _RECORDER), _record))
    if unit:
        from rollerrig.firmware_sim.wsp import node  # noqa: F401

        yield (
            "begun_unit",
            children.Forked(("rollerrig", "wsp"), unit, signal.SIGKILL, True, (recorder,)),
        )


def tell(process: subprocess.Popen[bytes], words: list[str]) -> None:
    """Hand a process that has been begun its arguments; one that has died is noticed by whoever waits for it."""
    assert process.stdin
    with contextlib.suppress(OSError), process.stdin as line:
        line.write(json.dumps(words).encode() + b"\n")


@contextlib.contextmanager
def begun(
    fork: bool = False, unit: Callable[[], int] | None = None
) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """`recorder` of a run that is prepared meanwhile, and where this process may `fork`, `begun_unit`, which is `unit`.

    They end where the run does not come.
    """
    processes = dict(_forked(unit)) if fork else {"recorder": begin_recorder()}
    try:
        yield processes
    finally:
        for one in processes.values():
            assert one.stdin
            one.stdin.close()


def check(options: Options, modbus: bool) -> None:
    """Refuse options that contradict each other, or a scenario without Modbus. Raises ConfigError."""
    if options.pacing == "free" and options.unit not in ("reference", "none"):
        who = "FMU" if options.fmus else "external unit"
        raise ConfigError(
            f"--pacing free waits for no bus, so no {who} can answer; use --pacing lockstep "
            "(repeatable) or wall (real time)"
        )
    if options.unit_map and not options.fmus:
        raise ConfigError(
            f"--unit-map is of an FMU, and the unit is {options.unit}: use --wsp fmu:FILE"
        )
    if options.hold and not options.live:
        raise ConfigError("--hold waits for somebody who looks on: give --live as well")
    if options.start == "modbus" and options.pacing != "wall":
        raise ConfigError(
            f"--start modbus holds the rig in real time; --pacing {options.pacing} has none: use "
            "--pacing wall"
        )
    if options.start == "modbus" and not modbus:
        raise ConfigError(
            "--start modbus waits for a Modbus client, but [modbus] enabled is false; set "
            "modbus.enabled=true"
        )
