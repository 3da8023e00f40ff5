"""Starts a bench for a test: `rollerrig run` as a process, and a harness that joins its bus.

The requirements of the test (scenario, speed, load, adhesion, friction over time and place) become
a scenario file, which the command line gets. The bench waits for the harness before it begins. At
the end of the test the harness ends the run over the bus, and the bench completes its record. A
bench that does not exit is terminated.
"""

import contextlib
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import tomli_w

from rollerrig.configs import output_files, store, user_files
from rollerrig.configs.errors import BusError, ConfigError, RollerrigError, UnitError
from rollerrig.configs.processes import children, exits
from rollerrig.configs.vehicle import EQUIPMENT_KEYS, TRAIN, Kind, kind_of
from rollerrig.wsp_interface import unit_choice
from rollerrig.wsp_interface.bus import buses, plugin
from rollerrig.wsp_interface.bus.sdo_client import RefusedError
from rollerrig.wsp_interface.harness_client import Event, Harness

START_S = 900.0  # patience until the bench waits for the harness
END_S = 300.0  # patience until the bench exits
KILL_S = 10.0  # patience after each signal to a process
DEFAULT_SCENARIO = "velim_a1"
# a program or gateway that runs during a bench: called with the address of the bus
Companion = Callable[[str], contextlib.AbstractContextManager[Any]]
# after standstill the run continues until the harness ends it
_LONG_RUN = {"stand_s": 60.0, "duration_max_s": 3600.0}
# tables of a scenario that may also be the name of a packaged set, with the folder of these
_SETS = {
    "vehicle": "vehicles",
    "rig": "rigs",
    "adhesion": "adhesion",
    "bus": "buses",
    "pads": "pads",
}


def scenario_of(
    name: str = "",
    initial_speed_m_s: float | None = None,
    initial_speed_km_h: float | None = None,
    adhesion: str = "",
    tables: Mapping[str, Any] | None = None,
    title: str = "",
) -> dict[str, Any]:
    """Return a scenario as data: a packaged one, or a file, with changes.

    The scenario has no brake demand: the harness commands it. `tables` holds tables of the scenario
    ([vehicle], [[friction]] ...), whose keys replace those of the scenario. `title` replaces the
    title, which describes another run. Raises ConfigError.
    """
    packaged, _ = load(name)
    scenario = dict(packaged) | (_LONG_RUN if TRAIN not in packaged else {})
    scenario.pop("demand", None)
    scenario["title"] = title

    # a set by name goes into a separate key, so that a table of single values may join it
    for key in _SETS:
        if isinstance(scenario.get(key), str):
            scenario[f"{key}_set"] = scenario.pop(key)
    for key, value in (tables or {}).items():
        if isinstance(value, Mapping) and isinstance(scenario.get(key), Mapping):
            scenario[key] = {**scenario[key], **value}
        else:
            scenario[key] = value

    if adhesion:
        scenario["adhesion_set"] = adhesion
    if initial_speed_km_h is not None:
        initial_speed_m_s = initial_speed_km_h / 3.6
    if initial_speed_m_s is not None:
        scenario["initial_speed_m_s"] = round(float(initial_speed_m_s), 6)
    # a free port for the bus, and no Modbus server: several benches may run at the same time
    scenario["bus"] = {**scenario.get("bus", {}), "interface": "hub", "socketcand_port": 0}
    scenario["modbus"] = {**scenario.get("modbus", {}), "enabled": False}
    return scenario


def load(name: str) -> tuple[dict[str, Any], Path]:
    """Return the content of a scenario or train, and its file; "": the default scenario.

    Raises ConfigError.
    """
    kind = "trains" if name in store.names("trains") else "scenarios"
    return store.load(kind, name or DEFAULT_SCENARIO)


def kind_of_scenario(name: str, tables: Mapping[str, Any], where: str) -> Kind:
    """Return the kind of the vehicle of a scenario: a packaged one, or a file, with changes.

    Of a train it is the kind of the first car. `tables` are those of `scenario_of`. `where` begins
    messages. Raises ConfigError.
    """
    packaged, path = load(name)
    if TRAIN in packaged:
        packaged = _first_car(packaged)
    layers = []
    for key, folder in _SETS.items():
        chosen = _set_name(key, (tables, packaged))
        if chosen:
            content, _ = store.load(folder, chosen, path)
            layers.append(content)
    merged: dict[str, dict[str, Any]] = {}
    for layer in (*layers, packaged, tables):
        for section in ("vehicle", *EQUIPMENT_KEYS):
            values = layer.get(section)
            if isinstance(values, Mapping):
                merged.setdefault(section, {}).update(values)
    return kind_of(merged, where)


def _first_car(train: Mapping[str, Any]) -> dict[str, Any]:
    """Return a train as a scenario of its first car alone, as far as its vehicle is concerned."""
    cars = train[TRAIN].get("car") if isinstance(train[TRAIN], Mapping) else None
    first = cars[0] if isinstance(cars, list) and cars else {}
    own = {key: first[key] for key in ("vehicle", "vehicle_set") if key in first}
    return {**train, **own}


def _set_name(key: str, layers: Iterable[Mapping[str, Any]]) -> str:
    """Return the name of a packaged set that the first of some layers chooses; "" for none."""
    for layer in layers:
        for place in (f"{key}_set", key):
            if isinstance(layer.get(place), str):
                return str(layer[place])
    return ""


def scenarios_of(kind: Kind) -> tuple[str, ...]:
    """Return the names of the packaged scenarios with a kind of vehicle. Raises ConfigError."""
    names = store.names("scenarios")
    return tuple(name for name in names if kind_of_scenario(name, {}, name) == kind)


def text_of_running_bench(resolved: Mapping[str, Any]) -> str:
    """Return the resolved scenario of a bench that ran before its test began, as TOML."""
    return (
        "# resolved scenario of the bench, which ran already. A test commanded its brake, friction and "
        "faults:\n# start the bench again and play the test again to repeat the run\n"
        + tomli_w.dumps(resolved)
    )


class Observer:
    """Is informed of what a bench does for a test. This one does nothing with it."""

    def bench_wrote(self, line: str) -> None:
        """Take the last line that a bench has written while it starts; "" before the first."""

    def cycle(self, harness: Harness) -> None:
        """Take the values of the harness after a cycle."""

    def event(self, event: Event) -> None:
        """Take a new event of the harness."""


@contextlib.contextmanager
def start(
    folder: Path,
    scenario: str = "",
    *,
    wsp: str = "reference",
    unit: str = "",
    pacing: str = "lockstep",
    seed: int = 0,
    arguments: Sequence[str] = (),
    companions: Sequence[Companion] = (),
    observer: Observer | None = None,
    **requirements: Any,
) -> Iterator[Harness]:
    """Start a bench, and yield the harness that has joined it.

    folder: for the record of the run.
    scenario: a packaged scenario or a file.
    wsp, pacing, seed: as the options of `rollerrig run`.
    unit: the command that starts a WSP unit, as in "./unit {host} {port}"; it wins over `wsp`.
    arguments: further options of `rollerrig run`.
    companions: programs that run as long as the bench, such as a unit under test.
    observer: is informed of what the bench does.
    requirements: see `scenario_of`.

    Raises RollerrigError.
    """
    if unit:
        wsp = unit_choice.check(f"{unit_choice.COMMAND}{unit}")
    # not in the folder of the run: the bench clears that when it begins
    with (
        tempfile.TemporaryDirectory(prefix="rollerrig-") as place,
        (Path(place) / "stderr").open("w", encoding="utf-8") as log,
    ):
        path = Path(place) / f"{folder.name}.toml"
        data = scenario_of(scenario, **requirements)
        path.write_text(tomli_w.dumps(data), encoding="utf-8")
        command = children.command(
            *children.module(
                "rollerrig.realtime.cli",
                "run",
                str(path),
                "--pacing",
                pacing,
                "--wsp",
                wsp,
                "--seed",
                str(seed),
                "--harness",
                "--out",
                str(folder),
                "--json",
                *arguments,
            )
        )
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=log,
            text=True,
        )
        harness = None
        try:
            observer = observer or Observer()
            address = _address(process, Path(log.name), observer)
            harness = Harness(buses.open_client(address, 60.0))
            harness.on_event = observer.event
            with contextlib.ExitStack() as stack:
                started = []
                for companion in companions:
                    started.append(stack.enter_context(companion(address)))
                    if isinstance(started[-1], Helper):
                        # the companions after it may have another bus
                        address = started[-1].address or address
                programs = [one for one in started if isinstance(one, Program)]
                helpers = [one for one in started if isinstance(one, Helper)]
                harness.on_silence = partial(_check, programs, helpers)

                def on_cycle(joined: Harness = harness) -> None:
                    _check_helpers(helpers)
                    observer.cycle(joined)

                harness.on_cycle = on_cycle
                try:
                    yield harness.join()
                    _check_helpers(helpers)
                    for helper in helpers:
                        if helper.failure:
                            harness.log("unit", helper.failure)
                        for text in helper.notes():
                            harness.log("gateway", text)
                except RefusedError:
                    raise
                except BusError as error:
                    # a helper that has failed has ended the bench
                    _check_helpers(helpers)
                    causes = _last_words(process, Path(log.name))
                    _check_unit_came(Path(log.name), programs)
                    for program in programs:
                        causes += program.exit_text()
                    raise BusError(f"{error}{causes}") from None
        except KeyboardInterrupt:
            # the bench shall record that its run was interrupted, not that its harness has ended it
            if harness:
                harness.ends = False
            process.terminate()
            raise
        finally:
            if harness:
                harness.close()
            _end(process)


@runtime_checkable
class Helper(Protocol):
    """A companion that works for the unit in a thread of this process.

    `failure`: why the unit has failed; "" as long as it has not.
    `breakdown`: why the companion itself has failed; "" as long as it has not.
    `address`: the bus of the companions after it; "" for that of the bench.
    """

    failure: str
    breakdown: str
    address: str

    def notes(self) -> Iterable[str]:
        """Return what is remarkable so far, a sentence each."""


class Program(NamedTuple):
    """A unit under test that runs as a process, and the file with its output."""

    command: str
    process: subprocess.Popen[bytes]
    log: Path

    def exit_text(self) -> str:
        """Return the exit status and last output as a sentence; "" while the program runs."""
        status = self.process.poll()
        if status is None:
            return ""
        return (
            f"; --unit '{self.command}' {exits.exit_text(status)}"
            f"{children.last_words(self.log)} ({self.log})"
        )

    def silent_text(self) -> str:
        """Return the command, its state and its last output, as a part of a sentence."""
        status = self.process.poll()
        state = "still runs" if status is None else exits.exit_text(status)
        words = children.last_words(self.log) or "; it has written nothing"
        return f"'{self.command}' {state}{words} ({self.log})"


def _check(programs: Iterable[Program], helpers: Iterable[Helper]) -> None:
    """Raise RollerrigError when a helper has failed, and UnitError when a program has.

    A program that has exited with status 0 may have started another process.
    """
    _check_helpers(helpers)
    failed = [program.exit_text() for program in programs if program.process.poll()]
    if failed:
        raise UnitError("".join(failed).removeprefix("; "))


def _check_unit_came(bench_log: Path, programs: Sequence[Program]) -> None:
    """Raise UnitError if the bench has ended because no unit sent a heartbeat.

    The bench states this in a line of JSON. The message has what the `programs` did: a program that
    has exited with status 0 may have started another process, so it ends the run only now.
    """
    for line in bench_log.read_text(encoding="utf-8").splitlines():
        if not line.startswith('{"no_heartbeat"'):
            continue
        absent = json.loads(line)
        if not programs:
            raise UnitError(absent["error"])
        texts = [program.silent_text() for program in programs]
        raise UnitError(
            f"the program of --unit has sent no heartbeat on {absent['no_heartbeat']} within "
            f"{absent['waited_s']:g} s; {'; '.join(texts)}; {absent['instead']}; correct the program: a "
            "unit connects to the bus at {address}, or at {host} and {port}, and sends heartbeats"
        )


def _check_helpers(helpers: Iterable[Helper]) -> None:
    """Raise RollerrigError when a helper has failed; it has ended the run with the reason."""
    for helper in helpers:
        if helper.breakdown:
            raise RollerrigError(helper.breakdown)


def program(command: str, log: Path) -> Companion:
    """Return a companion that runs a command as the unit under test.

    The command may contain {address}, {host} and {port} of the bus. `log` gets its output.
    """

    @contextlib.contextmanager
    def run_program(address: str) -> Iterator[Program]:
        # an interface of the kernel has no port
        is_hub = address.startswith("socketcand:")
        host, port, _ = plugin.parse_address(address) if is_hub else ("", 0, "")
        words = unit_choice.command_words(command, address, host, port)
        with output_files.create(log) as output:
            process = subprocess.Popen(
                children.command(*words),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=children.users_environment(),
            )
        try:
            yield Program(command, process, log)
        finally:
            _end(process, 0.0)

    return run_program


def _address(process: subprocess.Popen[str], log: Path, observer: Observer) -> str:
    """Return the address at which the bench waits, from its line of JSON.

    Informs the observer of what the bench writes before.

    Raises BusError with the last output of the bench when there is no such line.
    """
    deadline = time.monotonic() + START_S
    last_line = ""
    while time.monotonic() < deadline:
        for line in log.read_text(encoding="utf-8").splitlines(keepends=True):
            if line.startswith('{"waiting_for"') and line.endswith("\n"):
                return str(json.loads(line)["address"])
            if line.endswith("\n"):
                last_line = line.rstrip()
        observer.bench_wrote(last_line)
        if process.poll() is not None:
            break
        time.sleep(0.02)
    raise BusError(f"the bench did not start{_last_words(process, log)}")


def _last_words(process: subprocess.Popen[str], log: Path) -> str:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(2.0)
    status = process.poll()
    text = "running" if status is None else str(status)
    return f" (status {text}{children.last_words(log)})"


def _end(process: subprocess.Popen[Any], patience_s: float = END_S) -> None:
    """Wait until a process exits; when it does not, terminate it, and then kill it."""
    for send_signal in (process.terminate, process.kill):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
            return
        send_signal()
        patience_s = KILL_S
    process.wait(patience_s)


def draw(folder: Path) -> Path:
    """Draw a finished run, as `rollerrig export --format svg` does; return the path of the picture.

    There is no picture if the record is empty.
    """
    out = folder / "stop.svg"
    command = children.module(
        "rollerrig.realtime.cli",
        "export",
        str(folder),
        "--format",
        "svg",
        "--out",
        str(out),
    )
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    return out


def summary(folder: Path) -> dict[str, Any]:
    """Return the summary of a run. Raises RollerrigError when there is none."""
    path = folder / "summary.json"
    try:
        return dict(user_files.read_json(path, within=folder))
    except (ConfigError, ValueError, TypeError) as error:
        raise RollerrigError(f"the bench has left no summary: {error}") from None


def check_valid(summary: Mapping[str, Any]) -> None:
    """Raise UnitError with the reasons if a run is not valid."""
    reasons = summary.get("invalid_because")
    if reasons:
        raise UnitError(f"the run is not valid: {'; '.join(reasons)}")
