"""A bench of one's own for a test: `rollerrig run` as a process, with a harness joined to its bus.

What the test asks for (scenario, speed, load, adhesion, friction over time and place) is written as
a scenario into the run's folder and given to the command line; the bench then waits for the harness
before it begins. When the test ends the run is ended over the bus and its record is closed; a bench
that does not end is terminated.
"""

import contextlib
import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import BusError, RollerrigError, UnitError
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.harness_client import Harness

START_S, END_S = 900.0, 60.0
DEFAULT_SCENARIO = "velim_a1"
Companion = Callable[[str], contextlib.AbstractContextManager[Any]]
# the run goes on after standstill until the harness ends it
_GOES_ON = {"stand_s": 60.0, "duration_max_s": 3600.0}


@dataclass
class OwnBench:
    """A running bench: its process, its folder, its harness and the scenario it was given."""

    folder: Path
    harness: Harness
    process: subprocess.Popen[str]
    scenario: dict[str, Any] = field(default_factory=dict)


def scenario_of(name: str = "", initial_speed_m_s: float | None = None,
                initial_speed_km_h: float | None = None, adhesion: str = "",
                tables: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """A scenario as data: a packaged or own one with changes. Its brake demand is the harness's.

    `tables` are tables of the scenario ([vehicle], [[friction]] ...) that win key by key.
    Raises ConfigError.
    """
    given, _ = store.load("scenarios", name or DEFAULT_SCENARIO)
    given = dict(given) | _GOES_ON
    given.pop("demand", None)
    for short in ("vehicle", "rig", "adhesion", "bus"):
        # a set by name, so that a table of single values may stand beside it
        if isinstance(given.get(short), str):
            given[f"{short}_set"] = given.pop(short)
    for key, value in (tables or {}).items():
        both = isinstance(value, Mapping) and isinstance(given.get(key), Mapping)
        given[key] = {**given[key], **value} if both else value
    if adhesion:
        given["adhesion_set"] = adhesion
    if initial_speed_km_h is not None:
        initial_speed_m_s = initial_speed_km_h / 3.6
    if initial_speed_m_s is not None:
        given["initial_speed_m_s"] = round(float(initial_speed_m_s), 6)
    bus = {"interface": "hub", "socketcand_port": 0}
    return given | {"bus": {**given.get("bus", {}), **bus}} | {
        "modbus": {**given.get("modbus", {}), "enabled": False}}


@contextlib.contextmanager
def start(folder: Path, scenario: str = "", *, wsp: str = "reference", pacing: str = "lockstep",
          seed: int = 0, arguments: Sequence[str] = (),
          companions: Sequence[Companion] = (), **asked: Any) -> Iterator[OwnBench]:
    """A bench with its harness joined; `asked` goes to `scenario_of`. Raises RollerrigError.

    `companions` are called with the bus's address and live as long as the run: a unit of one's own.
    """
    content = scenario_of(scenario, **asked)
    # beside the folder's own files: the bench clears its folder when it begins
    with tempfile.TemporaryDirectory(prefix="rollerrig-") as place:
        path = Path(place) / f"{folder.name}.toml"
        path.write_text(tomli_w.dumps(content), encoding="utf-8")
        log = (Path(place) / "stderr").open("w+", encoding="utf-8")
        process = subprocess.Popen(
            [sys.executable, "-m", "rollerrig.realtime.cli", "run", str(path), "--pacing", pacing,
             "--wsp", wsp, "--seed", str(seed), "--harness", "--out", str(folder), "--json",
             *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, text=True)
        harness = None
        try:
            address = _address(process, Path(log.name))
            harness = Harness(buses.open_client(address))
            try:
                with contextlib.ExitStack() as beside:
                    for companion in companions:
                        beside.enter_context(companion(address))
                    harness.join()
                    yield OwnBench(folder, harness, process, content)
            except BusError as error:
                raise BusError(f"{error}{_last_words(process, Path(log.name))}") from None
        finally:
            if harness:
                harness.close()
            _end(process)
            log.close()


def program(command: str) -> Companion:
    """A unit of one's own as a companion: a command in which {address}, {host} and {port} are put in."""
    @contextlib.contextmanager
    def beside(address: str) -> Iterator[subprocess.Popen[bytes]]:
        place = address.removeprefix("socketcand://").partition("/")[0]
        host, _, port = place.rpartition(":")
        words = [word.format(address=address, host=host, port=port) for word in shlex.split(command)]
        try:
            process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=sys.stderr)
        except OSError as error:
            raise UnitError(f"--unit '{command}': cannot be started: {error.strerror}") from None
        try:
            yield process
        finally:
            _end(process, 0.0)

    return beside


def _address(process: subprocess.Popen[str], log: Path) -> str:
    """Where the bench waits, from its line of JSON. Raises BusError with its own words when there is none."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        for line in log.read_text(encoding="utf-8").splitlines(keepends=True):
            if line.startswith('{"waiting_for"') and line.endswith("\n"):
                return str(json.loads(line)["address"])
        if process.poll() is not None:
            break
        time.sleep(0.02)
    raise BusError(f"the bench did not start{_last_words(process, log)}")


def _last_words(process: subprocess.Popen[str], log: Path) -> str:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(2.0)
    status = process.poll()
    lines = [line for line in log.read_text(encoding="utf-8").splitlines() if line.strip()]
    words = f"; its last words: {lines[-1]}" if lines else ""
    return f" (status {status if status is not None else 'running'}{words})"


def _end(process: subprocess.Popen[Any], patience_s: float = END_S) -> None:
    """Wait for a process to end, then ask it to, then make it."""
    for ask in (process.terminate, process.kill):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
            return
        ask()
        patience_s = 10.0
    process.wait(patience_s)


def summary(folder: Path) -> dict[str, Any]:
    """What the bench says of its run. Raises RollerrigError when it has left no summary."""
    path = folder / "summary.json"
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RollerrigError(f"{path}: the bench has left no summary: {error}") from None
    return found
