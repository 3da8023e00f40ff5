"""A bench of one's own for a test: `rollerrig run` as a process, with a harness joined to its bus.

What the test asks for (scenario, speed, load, adhesion, friction over time and place) is written as a scenario into the
run's folder and given to the command line; the bench then waits for the harness before it begins. When the test ends
the run is ended over the bus and its record is closed; a bench that does not end is terminated.
"""

import contextlib
import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import BusError, RollerrigError, UnitError
from rollerrig.configs.processes import children
from rollerrig.wsp_interface.bus import buses, plugin
from rollerrig.wsp_interface.harness_client import Harness

START_S, END_S = 900.0, 300.0
DEFAULT_SCENARIO = "velim_a1"
Companion = Callable[[str], contextlib.AbstractContextManager[Any]]
# the run goes on after standstill until the harness ends it
_GOES_ON = {"stand_s": 60.0, "duration_max_s": 3600.0}


def scenario_of(
    name: str = "",
    initial_speed_m_s: float | None = None,
    initial_speed_km_h: float | None = None,
    adhesion: str = "",
    tables: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """A scenario as data: a packaged or own one with changes. Its brake demand is the harness's.

    `tables` are tables of the scenario ([vehicle], [[friction]] ...) that win key by key. Raises ConfigError.
    """
    given, _ = store.load("scenarios", name or DEFAULT_SCENARIO)
    given = dict(given) | _GOES_ON
    given.pop("demand", None)
    for short in ("vehicle", "rig", "adhesion", "bus", "pads"):
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
    return given | {
        "bus": {**given.get("bus", {}), "interface": "hub", "socketcand_port": 0},
        "modbus": {**given.get("modbus", {}), "enabled": False},
    }


@contextlib.contextmanager
def start(
    folder: Path,
    scenario: str = "",
    *,
    wsp: str = "reference",
    pacing: str = "lockstep",
    seed: int = 0,
    arguments: Sequence[str] = (),
    companions: Sequence[Companion] = (),
    **asked: Any,
) -> Iterator[Harness]:
    """The harness that has joined a bench; `asked` goes to `scenario_of`. Raises RollerrigError.

    `companions` are called with the bus's address and live as long as the run: a unit of one's own.
    """
    # beside the folder's own files: the bench clears its folder when it begins
    with (
        tempfile.TemporaryDirectory(prefix="rollerrig-") as place,
        (Path(place) / "stderr").open("w", encoding="utf-8") as log,
    ):
        path = Path(place) / f"{folder.name}.toml"
        path.write_text(tomli_w.dumps(scenario_of(scenario, **asked)), encoding="utf-8")
        process = subprocess.Popen(
            children.command(
                sys.executable,
                "-m",
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
            ),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=log,
            text=True,
        )
        harness = None
        try:
            address = _address(process, Path(log.name))
            harness = Harness(buses.open_client(address, 60.0))
            with contextlib.ExitStack() as beside:
                there = [beside.enter_context(companion(address)) for companion in companions]
                programs = [one for one in there if isinstance(one, Program)]
                harness.watch = partial(_check, programs)
                try:
                    yield harness.join()
                except BusError as error:
                    words = _last_words(process, Path(log.name)) + "".join(
                        one.ended() for one in programs
                    )
                    raise BusError(f"{error}{words}") from None
        finally:
            if harness:
                harness.close()
            _end(process)


class Program(NamedTuple):
    """A unit of one's own that has been started, and where its words stand."""

    command: str
    process: subprocess.Popen[bytes]
    log: Path

    def ended(self) -> str:
        """With which status and words it has ended; empty while it runs."""
        status = self.process.poll()
        return (
            ""
            if status is None
            else (
                f"; --unit '{self.command}' has ended with status {status}"
                f"{children.last_words(self.log)} ({self.log})"
            )
        )


def _check(programs: Iterable[Program]) -> None:
    """Raises UnitError where a unit has failed; one with status 0 may have started another process."""
    if failed := [one.ended() for one in programs if one.process.poll()]:
        raise UnitError("".join(failed).removeprefix("; "))


def program(command: str, log: Path) -> Companion:
    """A unit of one's own as a companion: a command in which {address}, {host} and {port} are put in."""

    @contextlib.contextmanager
    def beside(address: str) -> Iterator[Program]:
        host, port, _ = plugin.parse_address(address)
        words = [
            word.format(address=address, host=host, port=port) for word in shlex.split(command)
        ]
        with log.open("wb") as said:
            process = subprocess.Popen(
                children.command(*words), stdin=subprocess.DEVNULL, stdout=said, stderr=said
            )
        try:
            yield Program(command, process, log)
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
    return f" (status {status if status is not None else 'running'}{children.last_words(log)})"


def _end(process: subprocess.Popen[Any], patience_s: float = END_S) -> None:
    """Wait for a process to end, then ask it to, then make it."""
    for ask in (process.terminate, process.kill):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
            return
        ask()
        patience_s = 10.0
    process.wait(patience_s)


def draw(folder: Path) -> Path:
    """Draw a run that has ended, as `rollerrig export --format svg` does, where there is something to draw."""
    out = folder / "stop.svg"
    subprocess.run(
        [
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "export",
            str(folder),
            "--format",
            "svg",
            "--out",
            str(out),
        ],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
    )
    return out


def summary(folder: Path) -> dict[str, Any]:
    """What the bench says of its run. Raises RollerrigError when it has left no summary."""
    path = folder / "summary.json"
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise RollerrigError(f"{path}: the bench has left no summary: {error}") from None


def check_valid(summary: Mapping[str, Any]) -> None:
    """Raise UnitError with the reasons where a run is not valid."""
    if because := summary.get("invalid_because"):
        raise UnitError(f"the run is not valid: {'; '.join(because)}")
