"""A bench in a process of its own that brakes again and again until it is ended, seen as anybody may see it.

The coach rolls down a gradient of 3 % against the air, and brakes on soap for 5 s of every minute: so a run may last
for ten hours, and its WSP unit always has to do.
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

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.loop import ring
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code

ROLES = {"recorder": "telemetry.recorder", "unit": " wsp "}
LONGEST_S, START_S, END_S = 36_000.0, 300.0, 300.0
_EVERY_S, _BRAKES_S, _BRAKE_PA = 60, 5, 3.8e5
_HEAD = """title = "The coach brakes for 5 s of every minute on its way down 3 %"
vehicle_set = "uic_z1"
initial_speed_m_s = 40.0
mechanisms = { track_gradient_gradient = -0.03 }
vehicle = { resistance_C_N_s2_m2 = 2.0 }
"""
Seen = TypeVar("Seen")


class Run:
    """A run that has been started in a folder. `seconds`: it ends then by itself; raises RollerrigError in vain."""

    def __init__(self, place: Path, *arguments: str, seconds: float = LONGEST_S) -> None:
        self.folder, self.said = place / "run", place / "stderr"
        scenario = place / "down.toml"
        steps = (
            f"{{from_s = {at}, pressure_Pa = {_BRAKE_PA}}}, {{from_s = {at + _BRAKES_S}, pressure_Pa = 0}}"
            for at in range(0, int(seconds) + 1, _EVERY_S)
            if at < LONGEST_S
        )
        scenario.write_text(
            f"duration_max_s = {seconds!r}\n{_HEAD}demand = [{', '.join(steps)}]\n",
            encoding="utf-8",
        )
        command = [
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "run",
            str(scenario),
            "--out",
            str(self.folder),
            "--set",
            "bus.interface=hub",
            "--set",
            "bus.socketcand_port=0",
            "--set",
            "modbus.port=0",
            *arguments,
        ]
        with self.said.open("wb") as said:
            self.process = subprocess.Popen(
                children.command(*command),
                stdin=subprocess.DEVNULL,
                stderr=said,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )

    def until(
        self, condition: Callable[[], Seen | None], what: str, seconds: float = START_S
    ) -> Seen:
        """Wait until something can be seen of the run, which lives."""
        end_s = time.monotonic() + seconds
        while (found := condition()) is None or found is False:
            if time.monotonic() > end_s or self.process.poll() is not None:
                raise RollerrigError(
                    f"the run has not come to {what}; its last words: {self.words()[-300:]}"
                )
            time.sleep(0.02)
        return found

    def words(self) -> str:
        """What it has said so far."""
        return self.said.read_text(encoding="utf-8", errors="replace")

    def heard(self, code: Code, **fields: Any) -> dict[str, Any] | None:
        """Return the fields of the first recorded event of a code with these fields; None: not yet."""
        for event in records.each_event(self.folder):
            if event.code == code and fields.items() <= event.fields.items():
                return event.fields
        return None

    def rows(self) -> ring.Ring | None:
        """Its samples in shared memory once it has begun."""
        with contextlib.suppress(OSError, ValueError, RollerrigError, IndexError):
            found = ring.Ring(self.rings("rows")[0], np.float64)
            return found if found.header[ring.WRITTEN] else None
        return None

    def rings(self, kind: str) -> list[Path]:
        """Its rings of a kind."""
        return list(ring.folder().glob(f"rollerrig-{self.process.pid}-*-{kind}"))

    def members(self) -> dict[str, int]:
        """Its processes by their role."""
        lines = below(self.process.pid)
        return {"bench": self.process.pid} | {
            role: pid for role, word in ROLES.items() for pid, line in lines.items() if word in line
        }

    def end(self, by: int = signal.SIGINT) -> int:
        """End it, and wait for its status."""
        if self.process.poll() is None:
            self.process.send_signal(by)
        return self.process.wait(END_S)


@contextlib.contextmanager
def started(*arguments: str, seconds: float = LONGEST_S) -> Iterator[Run]:
    """A run in a folder that is there as long as the block; nothing of it is left."""
    with tempfile.TemporaryDirectory(prefix="rollerrig-endures-") as place:
        run = Run(Path(place), *arguments, seconds=seconds)
        try:
            yield run
        finally:
            for pid in (*below(run.process.pid), run.process.pid):
                with contextlib.suppress(OSError):
                    os.kill(pid, signal.SIGKILL)
            run.process.wait()
            for path in run.rings("*"):
                path.unlink(missing_ok=True)


def last_s(rows: ring.Ring) -> float:
    """The simulated time of the newest row."""
    count = int(rows.header[ring.WRITTEN])
    return (
        float(rows.rows[(count - 1) % rows.rows.shape[0], signals.column("time")]) if count else 0.0
    )


def below(pid: int) -> dict[int, str]:
    """Numbers and command lines of all processes below one."""
    found: dict[int, str] = {}
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in map(int, task.read_text(encoding="ascii").split()):
                line = Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8").replace("\0", " ")
                found |= {child: line} | below(child)
    return found


def alive(pid: int) -> bool:
    """Whether a process runs: a zombie does not."""
    with contextlib.suppress(OSError):
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return False
