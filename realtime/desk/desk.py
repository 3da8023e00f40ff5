"""The desk, shared by all pages: it has a bench that it follows, alarms, and started programs.

A desk belongs to one bench. It follows this bench until it ends, so that a command always reaches
the bench that the page names. Afterwards it follows the next bench that it starts itself; the user
chooses any other one.

`work` runs as long as the desk does. It reads the rings ten times a second and the registers twice
a second. While it follows no bench, it looks for benches every second. It keeps off the cores that
loops of benches have claimed.
"""

import asyncio
import contextlib
import itertools
import math
import os
import re
import shlex
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import BusError, ConfigError, RollerrigError
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.modbus.map import State
from rollerrig.realtime.bench import scenario as scenarios
from rollerrig.realtime.desk import reader
from rollerrig.realtime.desk.doors import Doors
from rollerrig.realtime.desk.programs import Program
from rollerrig.realtime.loop import cores
from rollerrig.realtime.telemetry import viewer
from rollerrig.realtime.train import plan as trains
from rollerrig.wsp_interface import signals, unit_choice
from rollerrig.wsp_interface.events import Code, Event
from rollerrig.wsp_interface.unit_choice import AllowList

_READ_S = 0.1
_REGISTERS_S = 0.5
_FIND_S = 1.0
_MOST_ALARMS = 300
_LONGEST_NOTE = 400  # characters
# cars of a train, as on the command line
_CARS = re.compile(r"all|\d+(,\d+)*")


@dataclass(eq=False)
class Alarm:
    """A warning or an error of a bench (at a simulated time) or of the desk (time NaN).

    `bench` is the key of the bench and `run` its name; both are empty for an alarm of the desk.
    `acknowledged` is the time of day, empty before.
    """

    time_s: float
    level: str
    text: str
    bench: str = ""
    acknowledged: str = ""
    code: Code | None = None
    run: str = ""

    @property
    def of_desk(self) -> bool:
        """Whether it is an alarm of the desk, without a simulated time."""
        return math.isnan(self.time_s)


class Desk:
    """`folder` holds runs, reports and campaigns; programs are started there.

    `own`: the desk follows only benches that it has started. Otherwise its first bench may be one
    that runs on this machine already, if it is the only one.

    `allowed` are the programs that may be chosen as a unit. Scenario files may be in `folder`, and
    in the folders `scenario_folders`.

    `choices` are the running benches that the user may choose, empty while the desk follows a
    running one. `stops` counts the emergency stops that were requested here.
    """

    def __init__(
        self,
        folder: Path,
        own: bool = False,
        allowed: AllowList = unit_choice.NOTHING,
        scenario_folders: Sequence[Path] = (),
    ) -> None:
        self.folder = folder
        self.own = own
        self.allowed = allowed
        self.scenario_folders = tuple(place.resolve() for place in (folder, *scenario_folders))
        self.choices: list[reader.Bench] = []
        self.stops = 0
        self.bench: reader.Bench | None = None
        # the cars of the train that the bench belongs to; only the bench for a vehicle alone
        self.cars: list[reader.Bench] = []
        self.doors: Doors | None = None
        self.alarms: deque[Alarm] = deque(maxlen=_MOST_ALARMS)
        self.programs: list[Program] = []
        # what the last bench was prepared with, for every page: values of fields by their names
        self.prepared: dict[str, str] = {}
        # entries of the title block of the next report, for every page
        self.about: dict[str, str] = {}
        # the signals of the vehicle of that scenario
        self._prepared_table = signals.table(COACH)
        # the friction mu_cd that was commanded here, by axle; 0: as in the scenario
        self.frictions: dict[int, float] = {}
        self._viewer: Any = None
        # the cores of loops that the desk keeps off, and the cores of its threads before
        self._left_cores: set[int] = set()
        self._cores_before: dict[int, set[int]] = {}
        self._last_failure = ""  # reported only once while it repeats

    # -- the work in the background

    async def work(self) -> None:
        """Follow the bench, until cancelled."""
        try:
            await self._follow_until_cancelled()
        finally:
            cores.restore(self._cores_before)

    async def _follow_until_cancelled(self) -> None:
        polled_s = 0.0
        looked_for_s = 0.0
        while True:
            now_s = time.monotonic()
            try:
                if now_s - looked_for_s > _FIND_S:
                    looked_for_s = now_s
                    self._leave_cores()
                    if not self.running():
                        self.find()
                    self._find_cars()
                self.look()
                if self.doors and now_s - polled_s > _REGISTERS_S:
                    polled_s = now_s
                    await self.doors.poll()
            except Exception as error:  # any error becomes an alarm, and the desk continues
                if repr(error) != self._last_failure:
                    self._last_failure = repr(error)
                    self.alarm("error", f"the desk: {error!r}")
            await asyncio.sleep(_READ_S)

    def _leave_cores(self) -> None:
        """Keep off the cores of loops, and return to them when their benches have ended."""
        claimed = cores.claimed()
        if claimed != self._left_cores:
            cores.restore(self._cores_before)
            self._cores_before = cores.leave(claimed, os.getpid())
            self._left_cores = claimed

    def find(self) -> None:
        """Follow a running bench if there is no doubt which; else list the benches in `choices`."""
        started_here = _first_cars(reader.running(self._is_started_here))
        if len(started_here) == 1:
            self._follow(started_here[0])
            return
        self.choices = started_here
        if self.own or started_here:
            return
        self.choices = _first_cars(reader.running())
        if len(self.choices) == 1 and self.bench is None:
            self._follow(self.choices[0])

    def _is_started_here(self, pid: int) -> bool:
        """Whether a process belongs to a program of this desk, which share a session."""
        try:
            session = os.getsid(pid)
        except OSError:
            return False
        return any(program.pid == session for program in self.programs)

    def follow(self, key: str) -> None:
        """Follow the bench with this key. Raises ConfigError if it cannot be chosen."""
        if self.bench and self.running():
            raise ConfigError(
                f"this desk belongs to the bench of {self.bench.name}; wait until it has ended, or "
                "start another desk with --port 0 for the other bench"
            )
        for bench in self.choices:
            if bench.key == key and not bench.ended:
                self._follow(bench)
                return
        raise ConfigError("this bench has ended; choose another one")

    def _follow(self, bench: reader.Bench) -> None:
        self.choices = []
        self.cars = [bench]
        self._show(bench)
        self._find_cars()

    def _show(self, bench: reader.Bench) -> None:
        if self.doors:
            self.doors.close()
        self.bench = bench
        self.doors = Doors(bench)
        self.frictions = {}

    def _find_cars(self) -> None:
        """Add the cars of the train that the desk follows, which begin one after another."""
        bench = self.bench
        if bench is None or not bench.car or bench.ended:
            return
        known = {car.key for car in self.cars}
        found = reader.running(lambda pid: pid == bench.pid)
        self.cars += [car for car in found if car.key not in known]
        self.cars.sort(key=lambda car: car.car)

    def show_car(self, number: int) -> None:
        """Show another car of the train. Raises ConfigError if it has no bus."""
        for car in self.cars:
            if car.car == number:
                self._show(car)
                return
        shown = ", ".join(str(car.car) for car in self.cars)
        raise ConfigError(f"car {number} has no bus in this run; the desk can show: {shown}")

    def _running_benches(self) -> list[Program]:
        """The benches that the desk has started and that still run."""
        return [program for program in self.programs if program.is_bench and program.status is None]

    def look(self) -> None:
        """Process the new events of the bench, and the programs that have exited."""
        for bench in self.cars:
            self._look_at(bench)
        for program in self.programs:
            if program.status is None or program.end_noticed:
                continue
            program.end_noticed = True
            if program.error:
                text = f"{program.title}: status {program.status}: {program.error}"
                self.alarm("error", text)

    def _look_at(self, bench: reader.Bench) -> None:
        for event in self._new_events(bench):
            if event.level != "info":
                alarm = Alarm(
                    event.time_s,
                    event.level,
                    event.text,
                    bench.key,
                    code=event.code,
                    run=bench.name,
                )
                self.alarms.appendleft(alarm)
        if bench.ended == "killed" and not self._is_known_as_killed(bench):
            text = f"the bench was killed (process {bench.pid}): its recorder keeps the data so far"
            self.alarm("error", text, bench.key, Code.BENCH_KILLED)

    def _new_events(self, bench: reader.Bench) -> list[Event]:
        """Read the bench. Damaged rings are one alarm; the desk keeps its other connections."""
        try:
            return bench.poll()
        except RollerrigError as error:
            if str(error) != self._last_failure:
                self._last_failure = str(error)
                self.alarm("error", str(error), bench.key)
            return []

    def _is_known_as_killed(self, bench: reader.Bench) -> bool:
        """Whether there is already an alarm that this bench was killed."""
        return any(
            alarm.bench == bench.key and alarm.code == Code.BENCH_KILLED for alarm in self.alarms
        )

    def alarm(self, level: str, text: str, bench: str = "", code: Code | None = None) -> None:
        """Add an alarm of the desk."""
        run = self.bench.name if self.bench and self.bench.key == bench else ""
        self.alarms.appendleft(Alarm(math.nan, level, text, bench, code=code, run=run))

    def is_present(self, alarm: Alarm) -> bool:
        """Whether an alarm belongs to the bench that the desk follows, or to the desk."""
        return not alarm.bench or alarm.bench in {car.key for car in self.cars}

    # -- commands of an operator

    @property
    def table(self) -> signals.Table:
        """The signals of the vehicle that the page shows: that of its bench, or of a scenario."""
        return self.bench.table if self.bench else self._prepared_table

    def held(self) -> bool:
        """Whether the bench is held, so that it waits for its start."""
        return bool(self.doors and self.doors.state is State.HELD)

    @property
    def at_set_speed(self) -> bool:
        """Whether a held bench has rolled at its set speed for a while."""
        return bool(self.doors and self.doors.values.get("at_set_speed"))

    def running(self) -> bool:
        """Whether there is a bench that has not ended."""
        return bool(self.bench and not self.bench.ended)

    @property
    def stopped(self) -> bool:
        """Whether the emergency stop of the bench is set."""
        return bool(self.doors and self.doors.values.get("emergency_stop"))

    async def emergency_stop(self) -> None:
        """Request the emergency stop; it stays requested if it is already. Raises BusError."""
        self.stops += 1
        await self.door().write("emergency_stop", 1.0)

    async def reset_emergency_stop(self, confirmed_stops: int) -> None:
        """Reset the emergency stop, which an operator has confirmed (ISO 13850: deliberately).

        `confirmed_stops` is the value of `stops` when the operator was asked. Raises BusError if
        another stop was requested since then, or if the bench refuses.
        """
        if self.stops != confirmed_stops:
            raise BusError(
                "the emergency stop is not reset, because it was requested again in the meantime; "
                "reset it once more"
            )
        await self.door().write("emergency_stop", 0.0)

    async def prepare(
        self, scenario: str, unit: str, settings: Mapping[str, str], more: str = ""
    ) -> None:
        """Start a bench that is held.

        `settings` are keys and values of the scenario; empty values are left out. `more` has
        further ones, as in "adhesion.mu_cd=0.05". Raises ConfigError if a bench runs already, or if
        the scenario or the unit may not be chosen here.
        """
        for text in (scenario, unit, more, *settings.values()):
            if not text.isprintable():
                raise ConfigError(f"{text!r} contains a control character; remove it")
        self._check_that_no_bench_runs()
        self.check_file("scenario", scenario)
        if self.is_train(scenario):
            raise ConfigError(
                f"{scenario} is a train, which has no Modbus and cannot be held; run it under "
                "Automatic, or prepare the scenario of one vehicle"
            )
        given = [f"{key}={value}" for key, value in settings.items() if value]
        given += _settings_of(more)
        self.show_vehicle_of(scenario, tuple(given))
        words = ["run", "--start", "modbus", "--pacing", "wall", f"--wsp={self.checked(unit)}"]
        words += [f"--set={setting}" for setting in given]
        self.prepared = {"scenario": scenario, "unit": unit, "more": more, **settings}
        # behind `--` nothing is an option, so a typed name cannot become one
        self.start([*words, "--", scenario])

    def _check_that_no_bench_runs(self) -> None:
        """Make ready for a bench in real time. Raises ConfigError if one runs already."""
        if self.running() or self.choices or self._running_benches():
            raise ConfigError(
                "a bench runs already on this machine: stop it first, or wait until it has ended"
            )
        # the bench inherits the cores of the desk
        cores.restore(self._cores_before)
        self._left_cores = set()

    def is_train(self, name: str) -> bool:
        """Return whether a scenario is that of a train. Any error in it is that of the run."""
        file = self.folder / name
        with contextlib.suppress(ConfigError):
            return trains.find(str(file) if file.is_file() else name) is not None
        return False

    def run_train(self, name: str, pacing: str, unit: str, cars: str, more: str) -> Program:
        """Run a train, and write its report in the folder of its run.

        `pacing` is free, or lockstep or wall with the unit on the buses of `cars`: 2, or 1,3, or
        all. `more` has values such as "train.delay_s=0.2". Raises ConfigError for what may not be
        chosen here.
        """
        for text in (name, unit, more):
            if not text.isprintable():
                raise ConfigError(f"{text!r} contains a control character; remove it")
        self.check_file("train", name)
        if not self.is_train(name):
            raise ConfigError(
                f"{name} is no train; choose a train of the library, or a file with a table [train]"
            )
        words = ["run", f"--pacing={pacing}", f"--wsp={self.checked(unit)}"]
        if pacing != "free":
            if not _CARS.fullmatch(cars):
                raise ConfigError(f"cars {cars!r}: write numbers of cars, as in 2 or 1,3, or all")
            words.append(f"--car={cars}")
        if pacing == "wall":
            self._check_that_no_bench_runs()
        words += [f"--set={setting}" for setting in _settings_of(more)]
        words += ["--out", self.free_folder("runs", Path(name).stem)]
        # behind `--` nothing is an option, so a typed name cannot become one
        return self.start([*words, "--", name])

    @property
    def units(self) -> list[str]:
        """The units that the page offers: those that run no foreign code, and the allowed ones."""
        fmus = [f"{unit_choice.FMU}{file}" for file in self.allowed.files]
        commands = [f"{unit_choice.COMMAND}{command}" for command in self.allowed.commands]
        return [*unit_choice.NAMES, *fmus, *commands]

    def checked(self, unit: str) -> str:
        """Return the text of a unit with absolute paths.

        Raises ConfigError if the unit needs an FMU that is not allowed.
        """
        # a program resolves a path in the folder in which it is started
        files = [(self.folder / file).resolve() for file in unit_choice.fmus_of(unit)]
        absolute = ",".join(f"{unit_choice.FMU}{file}" for file in files)
        return self.allowed.check(absolute or unit, "WSP unit")

    def own_files(self, kind: str) -> list[str]:
        """The TOML files of the user that the page offers: those in a folder named `kind`.

        This folder is in the folder of the desk, or in an allowed one. Names are relative to the
        folder of the desk, where programs are started.
        """
        found = []
        for folder in self.scenario_folders:
            for file in sorted((folder / kind).glob("*.toml")):
                is_here = file.is_relative_to(self.folder)
                found.append(str(file.relative_to(self.folder) if is_here else file))
        return found

    def check_file(self, what: str, name: str) -> None:
        """Raise ConfigError if a scenario, sequence or programme is a file outside the folders."""
        path = (self.folder / name).resolve()
        if any(path.is_relative_to(folder) for folder in self.scenario_folders):
            return
        folders = ", ".join(map(str, self.scenario_folders))
        raise ConfigError(
            f"{what} {name}: this desk starts the {what}s of the library and files below "
            f"{folders}; to allow another folder, start the desk with --allow-folder DIR"
        )

    def show_vehicle_of(self, scenario: str, settings: tuple[str, ...] = ()) -> None:
        """Let the page show the vehicle of a scenario while there is no bench.

        Any error in the scenario is that of the bench, which reports it.
        """
        file = self.folder / scenario
        name = str(file) if file.is_file() else scenario
        with contextlib.suppress(ConfigError):
            self._prepared_table = scenarios.load(name, settings=settings).table

    def start(self, words: list[str]) -> Program:
        """Start a `rollerrig` command line. Raises ConfigError if it cannot start."""
        program = Program(words, self.folder)
        self.programs.append(program)
        return program

    async def set_friction(self, axle: int, mu: float) -> None:
        """Command the friction mu_cd under an axle; 0 restores that of the scenario.

        Raises BusError.
        """
        await self.free_door().send_as_harness(lambda harness: harness.friction(mu, (axle,)))
        self.frictions[axle] = mu

    def set_point(self, register: str) -> float | None:
        """The value of a set-point over Modbus, in its unit; None if none is set or known."""
        if not self.doors or not self.running():
            return None
        value = self.doors.values.get(register)
        return None if value is None or value < 0.0 else value

    def free_report(self, name: str) -> str:
        """The folder of a new report, relative to `folder`: no earlier report is replaced."""
        return self.free_folder("reports", name)

    def free_folder(self, kind: str, name: str) -> str:
        """A new folder below that of a kind, relative to `folder`: no earlier one is replaced."""
        out = f"{kind}/{name}"
        numbers = itertools.count(2)
        while (self.folder / out).exists():
            out = f"{kind}/{name}-{next(numbers)}"
        return out

    def door(self) -> Doors:
        """The ways into the bench. Raises BusError if none runs."""
        if self.doors and self.running():
            return self.doors
        if self.choices:
            count = len(self.choices)
            benches = "1 bench runs" if count == 1 else f"{count} benches run"
            raise BusError(
                f"{benches} on this machine that this desk does not follow: choose the bench of "
                "this desk first"
            )
        raise BusError("no bench runs here: prepare one first")

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


def _first_cars(benches: Sequence[reader.Bench]) -> list[reader.Bench]:
    """Return the first bench of each process: the cars of a train are benches of one."""
    first: dict[int, reader.Bench] = {}
    for bench in benches:
        first.setdefault(bench.pid, bench)
    return list(first.values())


def _settings_of(text: str) -> list[str]:
    """Return the settings in a text such as "adhesion.mu_cd=0.05 stand_s=2". Raises ConfigError."""
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(
            f"further values: {text!r} cannot be read ({error}); close each quotation mark, as in "
            "adhesion.mu_cd=0.05"
        ) from None
