"""The processes beside the bench: recorder, live view and the WSP unit (reference or FMU), and how they end."""

import asyncio
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
from rollerrig.configs.processes import children
from rollerrig.realtime.bench.options import Options, begin_recorder, tell, unit_command
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.record import run_folder
from rollerrig.realtime.record.files import writing
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import Code, OnEvent

Process = subprocess.Popen[bytes]
# how long a recorder may take to complete its files: much, on a busy machine
_RECORDER_S = 300.0


class Processes:
    """What a run has started. `on_event(code, **fields)` records how it ends."""

    def __init__(self, options: Options, on_event: OnEvent) -> None:
        self.options, self.on_event = options, on_event
        self.recorder: Process | None = None
        self.unit: Process | None = None
        self.live: Process | None = None
        # where an FMU is unpacked
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        # those whose end has been told already
        self._ended: set[int] = set()
        # why the record is not whole
        self.unwritten: ConfigError | None = None

    def start_recorder(
        self, rows: Ring, frames: Ring, events: Ring, identity: Mapping[str, Any]
    ) -> None:
        """Start recorder and live view; neither is waited for."""
        self.recorder = record(
            self.options.out, rows, frames, events, identity, self.options.recorder
        )
        if self.options.live:
            from rollerrig.realtime.telemetry import live

            self.live = live.start(self.options.out, rows, events, self.options.unit)

    async def await_viewer(self, rows: Ring, given_up: Callable[[], object]) -> None:
        """With --hold wait until somebody looks at the live view, it has ended, or the run is `given_up`."""
        while (
            self.options.hold
            and not rows.header[ring.VIEWED]
            and _runs(self.live)
            and not given_up()
        ):
            await asyncio.sleep(0.1)

    async def await_recorder(self, rows: Ring) -> None:
        """Wait until the recorder drains its rings. Raises RollerrigError."""
        assert self.recorder is not None
        if not await asyncio.get_running_loop().run_in_executor(
            None, wait_ready, self.recorder, rows
        ):
            self.watch_recorder()
            raise self.unwritten or RollerrigError(
                "the recorder did not start; its message stands above"
            )

    def start_unit(
        self, place: str, config: str, priority: int, sync_period_s: float, bitrate: int
    ) -> None:
        """Start the unit on the bus at an address, of `bitrate` bit/s; it asks for a real-time `priority` above 0."""
        given = self.options
        words = [
            "--bus",
            place,
            "--config",
            config,
            "--priority",
            str(priority),
            *(["--lockstep", str(sync_period_s)] if given.pacing == "lockstep" else []),
        ]
        if given.fmus:
            # what it unpacks there goes with the bench, also when it has crashed
            self._scratch = tempfile.TemporaryDirectory(prefix="rollerrig-fmu-")
            words += [
                "--step",
                str(sync_period_s),
                "--step-wait",
                str(given.answer_wait_s),
                "--bitrate",
                str(bitrate),
                *(word for one in given.fmus for word in ("--fmu", str(one))),
                *(["--unit-map", str(given.unit_map)] if given.unit_map else []),
            ]
        environment = os.environ | ({"TMPDIR": self._scratch.name} if self._scratch else {})
        with writing(given.out), open(given.out / run_folder.UNIT_LOG, "wb") as log:
            if given.begun_unit:
                self.unit = given.begun_unit
                tell(self.unit, [*words, "--log", str(given.out / run_folder.UNIT_LOG)])
            else:
                self.unit = subprocess.Popen(
                    unit_command(*words),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                    env=environment,
                )

    @property
    def recording(self) -> bool:
        """Whether the recorder runs."""
        return _runs(self.recorder)

    def watch_recorder(self) -> None:
        """Say it, once, when the recorder has ended."""
        if process := self._newly_ended(self.recorder):
            status, reason = process.returncode, None
            if status > 2:  # the number of an error, as the recorder has it
                reason = f"{self.options.out} cannot be written: {os.strerror(status)}"
                self.unwritten = ConfigError(
                    f"{reason}; what was recorded before is kept; make room, or give a "
                    "folder elsewhere with --out, and run again"
                )
            self.on_event(Code.RECORDER_ENDED, status=status, reason=reason)

    def watch(self, starting: bool = False) -> None:
        """Say what has ended. Raises UnitError where the run is `starting` and has lost its unit."""
        self.watch_recorder()
        if process := self._newly_ended(self.unit):
            log = self.options.out / run_folder.UNIT_LOG
            names = ", ".join(one.name for one in self.options.fmus)
            kind = f"WSP unit {names}" if names else "reference WSP unit"
            ended = {
                "unit": kind,
                "status": process.returncode,
                "last_words": children.last_line(log) or None,
                "log": str(log),
            }
            if starting:
                raise UnitError(events.text(Code.UNIT_ENDED, ended))
            self.on_event(Code.UNIT_ENDED, **ended)

    def _newly_ended(self, process: Process | None) -> Process | None:
        if process is None or process.poll() is None or process.pid in self._ended:
            return None
        self._ended.add(process.pid)
        return process

    def freeze(self, on: bool) -> bool:
        """Stop the process of the bench's own unit, or let it go on; False where there is none."""
        if self.unit is None or not _runs(self.unit):
            return False
        self.unit.send_signal(signal.SIGSTOP if on else signal.SIGCONT)
        return True

    async def end_unit(self) -> None:
        """Wait for the unit, which ends with its bus, and end it when it does not."""
        self.freeze(False)  # a stopped process would not hear that it shall end
        await _end(self.unit, 2.0)
        if self._scratch:
            self._scratch.cleanup()

    async def end_recorder(self) -> None:
        """Wait until the recorder has written all that its closed rings hold, and end the live view."""
        await _end(self.recorder, _RECORDER_S, ask=False)
        if self.recorder is not None and self.recorder.returncode:
            self.watch_recorder()
        if self.live is not None and _runs(self.live):
            self.live.terminate()


def _runs(process: Process | None) -> bool:
    return process is not None and process.poll() is None


async def _end(process: Process | None, patience_s: float, ask: bool = True) -> None:
    deadline = time.monotonic() + patience_s
    while _runs(process) and time.monotonic() < deadline:
        await asyncio.sleep(0.01)
    if process is not None and process.poll() is None:
        process.terminate() if ask else process.kill()
        process.wait(5.0)


def record(
    run_dir: Path,
    rows: Ring,
    frames: Ring,
    events: Ring,
    counters: Mapping[str, Any] | None = None,
    begun: Process | None = None,
) -> Process:
    """Tell the recorder that has `begun`, or a new one, what to record.

    `counters` (pacing, seed, unit ...) go into the summary of a killed run.
    """
    process = begun or begin_recorder()
    words = [
        str(run_dir),
        "--rows",
        str(rows.path),
        "--frames",
        str(frames.path),
        "--events",
        str(events.path),
        "--counters",
        json.dumps(dict(counters or {})),
    ]
    tell(process, words)
    return process


def wait_ready(process: Process, rows: Ring, timeout_s: float = 120.0) -> bool:
    """Wait until the recorder drains its rings; False if it died or did not come in time."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until and process.poll() is None:
        if rows.header[ring.RECORDER_BEAT_NS]:
            return True
        time.sleep(0.01)
    return False
