"""The desk itself: the bench that it looks at, its doors, alarms, the programs that it has started, one for all pages.

`work` goes on as long as the desk does: it reads the rings ten times a second, asks the registers twice a second, and
looks for a bench each second while there is none.
"""

import asyncio
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

_READ_S, _ASK_S, _FIND_S = 0.1, 0.5, 1.0
_ALARMS = 300


@dataclass(eq=False)
class Alarm:
    """A warning or an error: of the bench at a simulated time, or of the desk (NaN)."""

    time_s: float
    level: str
    text: str
    bench: str = ""
    acknowledged: str = ""
    code: Code | None = None


class Desk:
    """`folder` is where runs, reports and campaigns stand; commands are started there.

    `own`: it looks only at benches that it has started itself; else at the newest, its own before others.
    """

    def __init__(self, folder: Path, own: bool = False) -> None:
        self.folder, self.own = folder, own
        self.bench: reader.Bench | None = None
        self.doors: Doors | None = None
        self.alarms: deque[Alarm] = deque(maxlen=_ALARMS)
        self.programs: list[Program] = []
        self._viewer: Any = None
        self._last_failure = ""

    # -- what goes on

    async def work(self) -> None:
        """Follow the bench, until cancelled."""
        asked_s = found_s = 0.0
        while True:
            now_s = time.monotonic()
            try:
                if (self.bench is None or self.bench.ended) and now_s - found_s > _FIND_S:
                    found_s = now_s
                    self.find()
                self.look()
                if self.doors and now_s - asked_s > _ASK_S:
                    asked_s = now_s
                    await self.doors.poll()
            except Exception as error:  # whatever it is: the page says it, and the desk goes on
                if repr(error) != self._last_failure:
                    self._last_failure = repr(error)
                    self.alarm("error", f"the desk: {error!r}")
            await asyncio.sleep(_READ_S)

    def find(self) -> None:
        """Turn to the newest bench that lives, where there is another than before."""
        mine = [one.pid for one in self.programs if one.words[0] == "run" and one.status is None]
        if found := reader.find(
            self.bench.key if self.bench else "", mine if mine or self.own else None
        ):
            if self.doors:
                self.doors.close()
            self.bench, self.doors = found, Doors(found)

    def look(self) -> None:
        """Take in what bench and programs tell."""
        if self.bench:
            killed = not self.alarms or not any(
                one.bench == self.bench.key and one.code == Code.BENCH_KILLED for one in self.alarms
            )
            for event in self.bench.poll():
                if event.level != "info":
                    self.alarms.appendleft(
                        Alarm(
                            event.time_s,
                            event.level,
                            event.text,
                            self.bench.key,
                            code=event.code,
                        )
                    )
            if self.bench.ended == "killed" and killed:
                self.alarm(
                    "error",
                    f"the bench was killed (process {self.bench.pid}): its recorder keeps what there "
                    "was",
                    self.bench.key,
                    Code.BENCH_KILLED,
                )
        for program in self.programs:
            if program.status is not None and not program.told:
                program.told = True
                if program.error:
                    self.alarm(
                        "error", f"{program.title}: status {program.status}: {program.error}"
                    )

    def alarm(self, level: str, text: str, bench: str = "", code: Code | None = None) -> None:
        """Add an alarm of the desk itself."""
        self.alarms.appendleft(Alarm(float("nan"), level, text, bench, code=code))

    # -- what an operator asks

    def held(self) -> bool:
        """Whether the bench is held and waits for its start."""
        return bool(self.doors and self.doors.state is State.HELD)

    def running(self) -> bool:
        """Whether a bench lives."""
        return bool(self.bench and not self.bench.ended)

    async def prepare(
        self, scenario: str, unit: str, settings: Mapping[str, str], more: str = ""
    ) -> None:
        """Start a bench that is held, or give a held one another scenario. Raises RollerrigError."""
        if self.running() or any(
            one.words[0] == "run" and one.status is None for one in self.programs
        ):
            raise ConfigError(
                "a bench runs already on this machine: stop it first, or wait until it has ended"
            )
        words = ["run", scenario, "--start", "modbus", "--pacing", "wall", "--wsp", unit]
        given = [f"{key}={value}" for key, value in settings.items() if value] + shlex.split(more)
        self.start([*words, *(word for setting in given for word in ("--set", setting))])

    def start(self, words: list[str]) -> Program:
        """Start a command line. Raises ConfigError."""
        program = Program(words, self.folder)
        self.programs.append(program)
        return program

    def door(self) -> Doors:
        """The ways into the bench. Raises BusError where none runs, or a sequence has it."""
        if not self.doors or not self.running():
            raise BusError("no bench runs here: prepare one first")
        return self.doors

    def free_door(self) -> Doors:
        """As `door`, of a bench that no sequence plays on. Raises BusError."""
        if self.door().bench.harness:
            raise BusError(
                "a harness has joined this bench: what it tests would no longer be what its sequence says"
            )
        return self.door()

    async def acknowledge(self, alarm: Alarm) -> None:
        """Acknowledge an alarm, and put that into the events of its run, where it still goes on."""
        alarm.acknowledged = time.strftime("%H:%M:%S")
        if alarm.bench and self.running() and self.bench and alarm.bench == self.bench.key:
            text = f"alarm acknowledged at the desk: {alarm.text}"[:400]
            try:
                await self.door().ask(lambda harness: harness.note(text))
            except RollerrigError as error:
                self.alarm(
                    "warning", f"acknowledged here, but not in the events of the run: {error}"
                )

    def rerun(self, run: Path) -> str:
        """Open a run in Rerun's viewer for browsers; its address. Raises ConfigError."""
        file = viewer.recording(run)
        if self._viewer:
            viewer.end(self._viewer)
        port, web = viewer.free_port(), viewer.free_port()
        self._viewer = viewer.spawn(
            "--serve-web", "--port", str(port), "--web-viewer-port", str(web), str(file)
        )
        return viewer.page(web, port)

    def close(self) -> None:
        """Leave; benches and programs go on."""
        if self.doors:
            self.doors.close()
        if self._viewer:
            viewer.end(self._viewer)
