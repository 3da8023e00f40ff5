"""The processes of a run besides the bench: recorder, live view and WSP unit, and how they exit."""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError, RollerrigError, UnitError
from rollerrig.configs.output_files import create, writing
from rollerrig.configs.processes import children
from rollerrig.configs.vehicle import Kind
from rollerrig.realtime.bench.options import (
    Options,
    send_arguments,
    start_recorder,
    unit_command,
)
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.record import run_folder
from rollerrig.realtime.telemetry import kind_option
from rollerrig.wsp_interface import events, unit_choice
from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.events import Code, OnEvent

Process = subprocess.Popen[bytes]
# how long a recorder may take to complete its files: long, on a busy machine
_RECORDER_S = 300.0
# what messages of a unit of this project begin with, in its log
_UNIT_PROGRAM = "rollerrig wsp"
# lines of a unit's output in a message
_LINES_OF_COMMAND = 5
# how long a unit may take to exit after its bus is gone
_UNIT_S = 2.0
_KILL_S = 5.0
# up to this status a recorder exits as any program; above it is the number of an OS error
_LAST_COMMON_STATUS = 2


class Processes:
    """The processes that a run has started. `on_event(code, **fields)` records how they exit."""

    def __init__(self, options: Options, on_event: OnEvent) -> None:
        self.options = options
        self.on_event = on_event
        self.recorder: Process | None = None
        # one for each group of axles
        self.units: list[Process] = []
        self.live: Process | None = None
        # why the record is not complete
        self.unwritten: ConfigError | None = None
        # the folder in which an FMU is unpacked
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        # the numbers of processes whose exit is recorded already
        self._exited: set[int] = set()

    def start_recorder(
        self, kind: Kind, rows: Ring, frames: Ring, events: Ring, identity: Mapping[str, Any]
    ) -> None:
        """Start the recorder and the live view of a kind of vehicle; wait for neither."""
        self.recorder = record(
            self.options.out, kind, rows, frames, events, identity, self.options.recorder
        )
        if self.options.live:
            from rollerrig.realtime.telemetry import live

            self.live = live.start(self.options.out, kind, rows, events, self.options.unit)

    async def await_viewer(self, rows: Ring, given_up: Callable[[], object]) -> None:
        """With --hold, wait for a viewer of the live view, its exit, or until `given_up()`."""
        if not self.options.hold:
            return
        while not rows.header[ring.VIEWED] and _runs(self.live) and not given_up():
            await asyncio.sleep(0.1)

    async def await_recorder(self, rows: Ring) -> None:
        """Wait until the recorder drains its rings. Raises RollerrigError."""
        assert self.recorder is not None
        running = asyncio.get_running_loop()
        if not await running.run_in_executor(None, wait_ready, self.recorder, rows):
            self.watch_recorder()
            raise self.unwritten or RollerrigError(
                "the recorder did not start; its message is printed above"
            )

    def start_unit(
        self,
        place: str,
        config: str,
        priority: int,
        loop_core: int,
        sync_period_s: float,
        bitrate: int,
        kind: Kind,
    ) -> None:
        """Start the units of the bench on the bus at an address, of `bitrate` in bit/s.

        Each group of axles has a unit; `kind` is that of the vehicle. A unit requests a real-time
        `priority` where that is above 0, and leaves the core of the loop (-1: any core).
        """
        options = self.options
        words = ["--bus", place, "--config", config, "--priority", str(priority)]
        words += ["--leave-core", str(loop_core)]
        if options.pacing == "lockstep":
            words += ["--lockstep", str(sync_period_s)]
        environment = dict(os.environ)
        if options.fmus:
            # the FMU is unpacked in a folder that the bench removes, also after a crash of the unit
            self._scratch = tempfile.TemporaryDirectory(prefix="rollerrig-fmu-")
            environment["TMPDIR"] = self._scratch.name
            words += self._fmu_arguments(sync_period_s, bitrate)

        log_path = options.out / run_folder.UNIT_LOG
        with writing(options.out), create(log_path) as log:
            for group in range(kind.groups):
                of_group = [*words, *unit_choice.vehicle_options(kind, group)]
                if group == 0 and options.waiting_unit:
                    send_arguments(options.waiting_unit, [*of_group, "--log", str(log_path)])
                    self.units.append(options.waiting_unit)
                    continue
                process = subprocess.Popen(
                    unit_command(*of_group),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                    env=environment,
                )
                self.units.append(process)

    def start_command(self, place: str, car: int) -> None:
        """Start the unit of a car that is a program of the user, on the bus at an address.

        Its output goes into the log of the unit. Raises ConfigError if the command is wrong.
        """
        host, port = "", 0
        with contextlib.suppress(ValueError):  # a CAN interface has neither
            host, port, _ = plugin.parse_address(place)
        words = unit_choice.command_words(self.options.command, place, host, port, car)
        with writing(self.options.out), create(self.options.out / run_folder.UNIT_LOG) as log:
            process = subprocess.Popen(
                children.command(*words, by=signal.SIGKILL),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=children.users_environment(),
            )
            self.units.append(process)

    def unit_words(self) -> str:
        """Return the last lines of a unit that is a program of the user, as the end of a message.

        Of an FMU it is the last message. Empty for another unit.
        """
        if not self.options.command and not self.options.fmus:
            return ""
        log = self.options.out / run_folder.UNIT_LOG
        lines = self._last_words()
        output = f"its last lines: {lines}" if lines else "it has printed nothing"
        return f"; {output} ({log})"

    def _fmu_arguments(self, sync_period_s: float, bitrate: int) -> list[str]:
        words = [
            "--step",
            str(sync_period_s),
            "--step-wait",
            str(self.options.answer_wait_s),
            "--bitrate",
            str(bitrate),
        ]
        for fmu in self.options.fmus:
            words += ["--fmu", str(fmu)]
        if self.options.unit_map:
            words += ["--unit-map", str(self.options.unit_map)]
        return words

    @property
    def recording(self) -> bool:
        """Whether the recorder runs."""
        return _runs(self.recorder)

    def watch_recorder(self) -> None:
        """Record, once, that the recorder has exited."""
        process = self._newly_exited(self.recorder)
        if process is None:
            return
        status = process.returncode
        reason = None
        if status > _LAST_COMMON_STATUS:
            reason = f"{self.options.out} cannot be written: {os.strerror(status)}"
            self.unwritten = ConfigError(
                f"{reason}; what was recorded before is kept; make room, or give a "
                "folder elsewhere with --out, and run again"
            )
        self.on_event(Code.RECORDER_ENDED, status=status, reason=reason)

    def watch(self, starting: bool = False) -> None:
        """Record, once, which processes have exited.

        Raises UnitError where the run is `starting` and its unit has exited.
        """
        self.watch_recorder()
        for process in self.units:
            self._watch_unit(process, starting)

    def _watch_unit(self, unit: Process, starting: bool) -> None:
        process = self._newly_exited(unit)
        if process is None:
            return
        exited = {
            "unit": self._unit_name,
            "status": process.returncode,
            "last_words": self._last_words() or None,
            "log": str(self.options.out / run_folder.UNIT_LOG),
        }
        if starting:
            raise UnitError(events.text(Code.UNIT_ENDED, exited))
        self.on_event(Code.UNIT_ENDED, **exited)

    def _last_words(self) -> str:
        """Return why a unit has failed, as far as its log shows it."""
        log = self.options.out / run_folder.UNIT_LOG
        if self.options.command:
            # a program of the user may explain its failure in several lines
            return children.last_lines(log, _LINES_OF_COMMAND)
        return children.last_message(log, _UNIT_PROGRAM)

    @property
    def _unit_name(self) -> str:
        """What events call the unit."""
        if self.options.command:
            return f"WSP unit '{self.options.command}'"
        names = ", ".join(fmu.name for fmu in self.options.fmus)
        return f"WSP unit {names}" if names else "reference WSP unit"

    def _newly_exited(self, process: Process | None) -> Process | None:
        """Return the process if it has exited since the last call."""
        if process is None or process.poll() is None or process.pid in self._exited:
            return None
        self._exited.add(process.pid)
        return process

    def freeze(self, on: bool, groups: frozenset[int] | None = None) -> bool:
        """Stop the processes of the bench's units, or let them continue; False: there are none.

        `groups` (from 0) are those of the units, None all. A program of the user is not stopped: it
        may consist of several processes.
        """
        if self.options.command:
            return False
        running = []
        for group, unit in enumerate(self.units):
            is_meant = groups is None or group in groups
            if is_meant and _runs(unit):
                running.append(unit)
        for unit in running:
            unit.send_signal(signal.SIGSTOP if on else signal.SIGCONT)
        return bool(running)

    async def end_unit(self) -> None:
        """Wait for the units, which exit when their bus is gone; terminate those that do not."""
        self.freeze(False)  # a stopped process would not notice the end of its bus
        for unit in self.units:
            await _wait_for_exit(unit, _UNIT_S)
            if self.options.command:
                await _end_session(unit)
            elif _runs(unit):
                unit.terminate()
                unit.wait(_KILL_S)
        if self._scratch:
            self._scratch.cleanup()

    async def end_recorder(self) -> None:
        """Wait until the recorder has written all rows of its closed rings; stop the live view."""
        await _wait_for_exit(self.recorder, _RECORDER_S)
        if self.recorder is not None and _runs(self.recorder):
            self.recorder.kill()
            self.recorder.wait(_KILL_S)
        if self.recorder is not None and self.recorder.returncode:
            self.watch_recorder()
        if self.live is not None and _runs(self.live):
            self.live.terminate()


def _runs(process: Process | None) -> bool:
    return process is not None and process.poll() is None


async def _end_session(process: Process) -> None:
    """End a process and all others of its session that still run, such as those of a script."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        # the group has the number of its leader, and is gone when all its processes are
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        await _wait_for_exit(process, _KILL_S)


async def _wait_for_exit(process: Process | None, patience_s: float) -> None:
    """Wait until a process has exited, but no longer than its time."""
    deadline_s = time.monotonic() + patience_s
    while _runs(process) and time.monotonic() < deadline_s:
        await asyncio.sleep(0.01)


def record(
    run_dir: Path,
    kind: Kind,
    rows: Ring,
    frames: Ring,
    events: Ring,
    counters: Mapping[str, Any] | None = None,
    waiting: Process | None = None,
) -> Process:
    """Let a recorder record three rings into a folder: the `waiting` one, or a new one.

    `kind` is that of the vehicle. `counters` (pacing, seed, unit ...) go into the summary of a
    killed run.
    """
    process = waiting or start_recorder()
    words = [
        str(run_dir),
        *kind_option.words(kind),
        "--rows",
        str(rows.path),
        "--frames",
        str(frames.path),
        "--events",
        str(events.path),
        "--counters",
        json.dumps(dict(counters or {})),
    ]
    send_arguments(process, words)
    return process


def wait_ready(process: Process, rows: Ring, timeout_s: float = 120.0) -> bool:
    """Wait until the recorder drains its rings; False if it exited or is not ready in time."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s and process.poll() is None:
        if rows.header[ring.RECORDER_BEAT_NS]:
            return True
        time.sleep(0.01)
    return False
