"""The desk, shared by all pages: it has a bench that it follows, alarms, and started programs.

`work` runs as long as the desk does. It reads the rings ten times a second and the registers twice
a second. While no bench runs, it looks for a bench every second.
"""

import asyncio
import math
import shlex
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import BusError, ConfigError, RollerrigError
from rollerrig.firmware_sim.modbus.map import State
from rollerrig.realtime.desk import reader
from rollerrig.realtime.desk.doors import Doors
from rollerrig.realtime.desk.programs import Program
from rollerrig.realtime.telemetry import viewer
from rollerrig.wsp_interface.events import Code

_READ_S = 0.1
_REGISTERS_S = 0.5
_FIND_S = 1.0
_MOST_ALARMS = 300
_LONGEST_NOTE = 400  # characters


@dataclass(eq=False)
class Alarm:
    """A warning or an error of a bench (at a simulated time) or of the desk (time NaN).

    `bench` is the key of the bench. `acknowledged` is the time of day, empty before.
    """

    time_s: float
    level: str
    text: str
    bench: str = ""
    acknowledged: str = ""
    code: Code | None = None

    @property
    def of_desk(self) -> bool:
        """Whether it is an alarm of the desk, without a simulated time."""
        return math.isnan(self.time_s)


class Desk:
    """`folder` holds runs, reports and campaigns; programs are started there.

    `own`: the desk follows only benches that it has started. Otherwise it follows the newest bench
    of this machine, and prefers those that it has started.
    """

    def __init__(self, folder: Path, own: bool = False) -> None:
        self.folder = folder
        self.own = own
        self.bench: reader.Bench | None = None
        self.doors: Doors | None = None
        self.alarms: deque[Alarm] = deque(maxlen=_MOST_ALARMS)
        self.programs: list[Program] = []
        self._viewer: Any = None
        self._last_failure = ""  # reported only once while it repeats

    # -- the work in the background

    async def work(self) -> None:
        """Follow the bench, until cancelled."""
        polled_s = 0.0
        looked_for_s = 0.0
        while True:
            now_s = time.monotonic()
            try:
                if not self.running() and now_s - looked_for_s > _FIND_S:
                    looked_for_s = now_s
                    self.find()
                self.look()
                if self.doors and now_s - polled_s > _REGISTERS_S:
                    polled_s = now_s
                    await self.doors.poll()
            except Exception as error:  # any error becomes an alarm, and the desk continues
                if repr(error) != self._last_failure:
                    self._last_failure = repr(error)
                    self.alarm("error", f"the desk: {error!r}")
            await asyncio.sleep(_READ_S)

    def find(self) -> None:
        """Follow the newest running bench, if the desk does not follow it already."""
        started_here = [program.pid for program in self._running_benches()]
        among = started_here if started_here or self.own else None
        followed = self.bench.key if self.bench else ""
        bench = reader.find(followed, among)
        if bench is None:
            return
        if self.doors:
            self.doors.close()
        self.bench = bench
        self.doors = Doors(bench)

    def _running_benches(self) -> list[Program]:
        """The benches that the desk has started and that still run."""
        return [
            program
            for program in self.programs
            if program.words[0] == "run" and program.status is None
        ]

    def look(self) -> None:
        """Process the new events of the bench, and the programs that have exited."""
        if self.bench:
            self._look_at(self.bench)
        for program in self.programs:
            if program.status is None or program.end_noticed:
                continue
            program.end_noticed = True
            if program.error:
                text = f"{program.title}: status {program.status}: {program.error}"
                self.alarm("error", text)

    def _look_at(self, bench: reader.Bench) -> None:
        for event in bench.poll():
            if event.level != "info":
                alarm = Alarm(event.time_s, event.level, event.text, bench.key, code=event.code)
                self.alarms.appendleft(alarm)
        if bench.ended == "killed" and not self._is_known_as_killed(bench):
            text = f"the bench was killed (process {bench.pid}): its recorder keeps the data so far"
            self.alarm("error", text, bench.key, Code.BENCH_KILLED)

    def _is_known_as_killed(self, bench: reader.Bench) -> bool:
        """Whether there is already an alarm that this bench was killed."""
        return any(
            alarm.bench == bench.key and alarm.code == Code.BENCH_KILLED for alarm in self.alarms
        )

    def alarm(self, level: str, text: str, bench: str = "", code: Code | None = None) -> None:
        """Add an alarm of the desk."""
        self.alarms.appendleft(Alarm(math.nan, level, text, bench, code=code))

    # -- commands of an operator

    def held(self) -> bool:
        """Whether the bench is held, so that it waits for its start."""
        return bool(self.doors and self.doors.state is State.HELD)

    def running(self) -> bool:
        """Whether there is a bench that has not ended."""
        return bool(self.bench and not self.bench.ended)

    async def prepare(
        self, scenario: str, unit: str, settings: Mapping[str, str], more: str = ""
    ) -> None:
        """Start a bench that is held. Raises ConfigError if a bench runs already.

        `settings` are keys and values of the scenario; empty values are left out. `more` has
        further ones, as in "adhesion.mu_cd=0.05".
        """
        if self.running() or self._running_benches():
            raise ConfigError(
                "a bench runs already on this machine: stop it first, or wait until it has ended"
            )
        words = ["run", scenario, "--start", "modbus", "--pacing", "wall", "--wsp", unit]
        for key, value in settings.items():
            if value:
                words += ["--set", f"{key}={value}"]
        for setting in shlex.split(more):
            words += ["--set", setting]
        self.start(words)

    def start(self, words: list[str]) -> Program:
        """Start a `rollerrig` command line. Raises ConfigError if it cannot start."""
        program = Program(words, self.folder)
        self.programs.append(program)
        return program

    def door(self) -> Doors:
        """The ways into the bench. Raises BusError if none runs."""
        if not self.doors or not self.running():
            raise BusError("no bench runs here: prepare one first")
        return self.doors

    def free_door(self) -> Doors:
        """The ways into a bench on which no sequence plays. Raises BusError if one does."""
        door = self.door()
        if door.bench.harness:
            raise BusError(
                "a harness has joined this bench: a change from here would falsify its test"
            )
        return door

    async def acknowledge(self, alarm: Alarm) -> None:
        """Acknowledge an alarm. If its run continues, its events get a note."""
        alarm.acknowledged = time.strftime("%H:%M:%S")
        of_this_run = bool(alarm.bench and self.bench and alarm.bench == self.bench.key)
        if not of_this_run or not self.running():
            return
        text = f"alarm acknowledged at the desk: {alarm.text}"[:_LONGEST_NOTE]
        try:
            await self.door().send_as_harness(lambda harness: harness.note(text))
        except RollerrigError as error:
            self.alarm("warning", f"acknowledged here, but not in the events of the run: {error}")

    def rerun(self, run: Path) -> str:
        """Open a run in Rerun's viewer for browsers, and return its address.

        Raises ConfigError.
        """
        file = viewer.recording_file(run)
        if self._viewer:
            viewer.terminate(self._viewer)
        port = viewer.free_port()
        web_port = viewer.free_port()
        self._viewer = viewer.spawn(
            "--serve-web", "--port", str(port), "--web-viewer-port", str(web_port), str(file)
        )
        return viewer.page_address(web_port, port)

    def close(self) -> None:
        """Leave the bench and close the viewer. Benches and programs continue."""
        if self.doors:
            self.doors.close()
        if self._viewer:
            viewer.terminate(self._viewer)
