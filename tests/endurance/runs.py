"""A bench in a separate process that brakes repeatedly until it is stopped, seen from outside.

The coach rolls down a gradient of 3 % against the air, and brakes on soap for 5 s of every minute.
So a run may last ten hours, and its WSP unit always has work.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from process_tree import descendants

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.loop import ring
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code

# a word of the command line of each process that a bench starts
ROLES = {"recorder": "telemetry.recorder", "unit": " wsp "}
# of the run; until something happens; until the run has stopped
LONGEST_S = 36_000.0
WAIT_S = 300.0
STOP_WITHIN_S = 300.0
_LOOK_EVERY_S = 0.02
# the brake is applied at the start of each period
_PERIOD_S = 60
_BRAKING_S = 5
_PRESSURE_PA = 3.8e5
_SCENARIO = """title = "The coach brakes for 5 s of every minute on its way down 3 %"
vehicle_set = "uic_z1"
initial_speed_m_s = 40.0
mechanisms = { track_gradient_gradient = -0.03 }
vehicle = { resistance_C_N_s2_m2 = 2.0 }
"""
Seen = TypeVar("Seen")


class Run:
    """A run that has been started in a folder.

    `arguments` are further words of `rollerrig run`. The run finishes by itself after `seconds`.
    """

    def __init__(self, place: Path, *arguments: str, seconds: float = LONGEST_S) -> None:
        self.folder = place / "run"
        self._stderr = place / "stderr"
        scenario = place / "down.toml"
        scenario.write_text(_scenario(seconds), encoding="utf-8")
        words = [sys.executable, "-m", "rollerrig.realtime.cli"]
        words += ["run", str(scenario), "--out", str(self.folder)]
        for setting in ("bus.interface=hub", "bus.socketcand_port=0", "modbus.port=0"):
            words += ["--set", setting]
        words += arguments
        with self._stderr.open("wb") as stderr:
            self.process = subprocess.Popen(
                children.command(*words),
                stdin=subprocess.DEVNULL,
                stderr=stderr,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )

    def wait_for(
        self, condition: Callable[[], Seen | None], what: str, seconds: float = WAIT_S
    ) -> Seen:
        """Wait until a condition returns something other than None and False; return that.

        Raises RollerrigError, which names `what`, after `seconds` or when the run exits.
        """
        end_s = time.monotonic() + seconds
        while True:
            result = condition()
            if result is not None and result is not False:
                return result
            if time.monotonic() > end_s or self.process.poll() is not None:
                raise RollerrigError(
                    f"the run has not come to {what}; its last words: {self.stderr()[-300:]}"
                )
            time.sleep(_LOOK_EVERY_S)

    def stderr(self) -> str:
        """Return what the run has printed on standard error so far."""
        return self._stderr.read_text(encoding="utf-8", errors="replace")

    def event_fields(self, code: Code, **fields: Any) -> dict[str, Any] | None:
        """Return the fields of the first event of a code with these fields; None: none yet."""
        for event in records.each_event(self.folder):
            if event.code == code and fields.items() <= event.fields.items():
                return event.fields
        return None

    def rows(self) -> ring.Ring | None:
        """Return its samples in shared memory; None before the first one."""
        with contextlib.suppress(OSError, ValueError, RollerrigError, IndexError):
            rows = ring.Ring(self.rings("rows")[0], np.float64)
            if rows.header[ring.WRITTEN]:
                return rows
        return None

    def rings(self, kind: str) -> list[Path]:
        """Return the files of its rings in shared memory of a kind; "*": of all."""
        return list(ring.folder().glob(f"rollerrig-{self.process.pid}-*-{kind}"))

    def processes(self) -> dict[str, int]:
        """Return the process numbers by role: bench, and those of `ROLES` that run."""
        found = {"bench": self.process.pid}
        for pid, line in descendants(self.process.pid).items():
            for role, word in ROLES.items():
                if word in line:
                    found[role] = pid
        return found

    def stop(self, by: int = signal.SIGINT) -> int:
        """Stop the run by a signal, and return its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(by)
        return self.process.wait(STOP_WITHIN_S)


def _scenario(seconds: float) -> str:
    """Return the scenario of a run that finishes after `seconds`."""
    steps = []
    for at_s in range(0, int(seconds) + 1, _PERIOD_S):
        if at_s < LONGEST_S:
            steps.append(f"{{from_s = {at_s}, pressure_Pa = {_PRESSURE_PA}}}")
            steps.append(f"{{from_s = {at_s + _BRAKING_S}, pressure_Pa = 0}}")
    return f"duration_max_s = {seconds!r}\n{_SCENARIO}demand = [{', '.join(steps)}]\n"


@contextlib.contextmanager
def started(*arguments: str, seconds: float = LONGEST_S) -> Iterator[Run]:
    """Start a run in a temporary folder; after the block its processes and files are removed."""
    with tempfile.TemporaryDirectory(prefix="rollerrig-endures-") as place:
        run = Run(Path(place), *arguments, seconds=seconds)
        try:
            yield run
        finally:
            for pid in (*descendants(run.process.pid), run.process.pid):
                with contextlib.suppress(OSError):
                    os.kill(pid, signal.SIGKILL)
            run.process.wait()
            for path in run.rings("*"):
                path.unlink(missing_ok=True)


def last_s(rows: ring.Ring) -> float:
    """Return the simulated time of the newest row."""
    count = int(rows.header[ring.WRITTEN])
    if not count:
        return 0.0
    newest, _, _ = rows.read(count - 1)
    return float(newest[-1, signals.column("time")])
