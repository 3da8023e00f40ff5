"""The processes beside the bench: recorder, live view and the reference WSP unit, and how they end."""

import asyncio
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from rollerrig.configs.errors import RollerrigError, UnitError
from rollerrig.realtime.bench.options import Options
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.record import run_folder
from rollerrig.realtime.telemetry import recording

Process = subprocess.Popen[bytes]


class Processes:
    """What a run has started. `event(level, text)` records what becomes of it."""

    def __init__(self, options: Options, event: Callable[[str, str], None]) -> None:
        self.options, self.event = options, event
        self.recorder: Process | None = None
        self.unit: Process | None = None
        self.live: Process | None = None
        # those whose end has been told already
        self._ended: set[int] = set()

    async def start_recorder(self, rows: Ring, frames: Ring, events: Ring, identity: Mapping[str, Any]) -> None:
        """Start recorder and live view, and wait for the recorder. Raises RollerrigError."""
        self.recorder = recording.start(self.options.out, rows, frames, events, identity)
        ready = await asyncio.get_running_loop().run_in_executor(
            None, recording.wait_ready, self.recorder, rows)
        if not ready:
            raise RollerrigError("the recorder did not start; its message stands above")
        if self.options.live:
            from rollerrig.realtime.telemetry import live

            self.live = live.start(self.options.out, rows, events)

    def start_unit(self, place: str, config: str) -> None:
        """Start the reference unit on the bus at an address."""
        command = [sys.executable, "-m", "rollerrig.realtime.cli", "wsp", "--bus", place, "--config", config]
        with open(self.options.out / run_folder.UNIT_LOG, "wb") as log:
            self.unit = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                                         start_new_session=True)

    @property
    def recording(self) -> bool:
        """Whether the recorder runs."""
        return _runs(self.recorder)

    def watch_recorder(self) -> None:
        """Say it, once, when the recorder has ended."""
        if (process := self._newly_ended(self.recorder)) is not None:
            self.event("error", f"the recorder has ended with status {process.returncode}; the "
                       "run goes on, its record ends about here")

    def watch(self, starting: bool = False) -> None:
        """Say what has ended. Raises UnitError where the run is `starting` and has lost its unit."""
        self.watch_recorder()
        if (process := self._newly_ended(self.unit)) is not None:
            text = (f"the reference WSP unit has ended with status {process.returncode}; its last words "
                    f"stand in {self.options.out / run_folder.UNIT_LOG}")
            if starting:
                raise UnitError(text)
            self.event("error", text)

    def _newly_ended(self, process: Process | None) -> Process | None:
        if process is None or process.poll() is None or process.pid in self._ended:
            return None
        self._ended.add(process.pid)
        return process

    def freeze(self, on: bool) -> bool:
        """Stop the reference unit's process, or let it go on; False where there is none."""
        if self.unit is None or not _runs(self.unit):
            return False
        self.unit.send_signal(signal.SIGSTOP if on else signal.SIGCONT)
        return True

    async def end_unit(self) -> None:
        """Wait for the unit, which ends with its bus, and end it when it does not."""
        self.freeze(False)  # a stopped process would not hear that it shall end
        await _end(self.unit, 2.0)

    async def end_recorder(self) -> None:
        """Wait until the recorder has written all that its closed rings hold, and end the live view."""
        await _end(self.recorder, 30.0, ask=False)
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
