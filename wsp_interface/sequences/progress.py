"""What the sequences that are played now do: name, speed, and the time that is left.

Each sequence has a small file, which the process that plays it writes four times a second. Any
number of worker processes can do that without waiting for one another.
"""

import contextlib
import json
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rollerrig.wsp_interface.own_bench import Observer

if TYPE_CHECKING:
    from rollerrig.wsp_interface.harness_client import Event, Harness

# between two writings of the file of a sequence
_WRITING_PERIOD_S = 0.25
# less of the work says too little about the time that is left
_LEAST_DONE = 0.1


class Status(NamedTuple):
    """What a sequence does.

    begun_s: of time.monotonic, when its bench began; 0 before.
    speed_m_s, fastest_m_s: the speed of the vehicle, and its highest speed so far.
    words: the last line of the bench before it began.
    """

    begun_s: float = 0.0
    speed_m_s: float = 0.0
    fastest_m_s: float = 0.0
    words: str = ""

    @property
    def fraction_done(self) -> float:
        """The fraction of the work that is done, by the speed that is lost."""
        if self.fastest_m_s <= 0.0:
            return 0.0
        return 1.0 - self.speed_m_s / self.fastest_m_s

    @property
    def text(self) -> str:
        """The status in a few words."""
        if self.begun_s:
            return f"{self.speed_m_s:.1f} m/s"
        return f"starting: {self.words}" if self.words else "starting"


class StatusFile(Observer):
    """Writes the status of a sequence into a file while it is played.

    `on_event` is called with each event. Worker processes get this object, so it can be pickled.
    """

    def __init__(self, path: Path, on_event: Callable[["Event"], None]) -> None:
        self._path = path
        self._on_event = on_event
        self._status = Status()
        self._written_s = -_WRITING_PERIOD_S

    def bench_wrote(self, line: str) -> None:
        """Write the last line of the bench."""
        self._write(self._status._replace(words=line))

    def cycle(self, harness: "Harness") -> None:
        """Write the speed of the vehicle."""
        speed_m_s = abs(harness.vehicle_speed_m_s)
        self._write(
            self._status._replace(
                begun_s=self._status.begun_s or time.monotonic(),
                speed_m_s=speed_m_s,
                fastest_m_s=max(speed_m_s, self._status.fastest_m_s),
            )
        )

    def event(self, event: "Event") -> None:
        """Pass an event on."""
        self._on_event(event)

    def _write(self, status: Status) -> None:
        self._status = status
        now_s = time.monotonic()
        if now_s - self._written_s < _WRITING_PERIOD_S:
            return
        self._written_s = now_s
        # a full disk shall not end a sequence that could still be played
        with contextlib.suppress(OSError):
            self._path.write_text(json.dumps(status), encoding="utf-8")


class Progress:
    """The progress of sequences, whose processes write files into a folder."""

    def __init__(self, names: Collection[str], folder: Path, before: int = 0) -> None:
        """`before` sequences of the same work were played earlier."""
        self._names = tuple(names)
        self._folder = folder
        self._before = before
        self._finished: set[str] = set()

    def file_of(self, name: str) -> Path:
        """Return the file for the status of a sequence."""
        return self._folder / f"{self._names.index(name)}.json"

    def finish(self, name: str) -> None:
        """Count a sequence as played."""
        self._finished.add(name)

    def text(self) -> str:
        """Return how far the sequences are, in one line."""
        total = self._before + len(self._names)
        parts = [f"{self._before + len(self._finished)} of {total} sequences played"]
        statuses = self._statuses()
        running = {name: status for name, status in statuses.items() if name not in self._finished}
        parts += [f"{name} {status.text}" for name, status in running.items()]

        begun_s = [status.begun_s for status in statuses.values() if status.begun_s]
        done = len(self._finished) + sum(status.fraction_done for status in running.values())
        if begun_s and _LEAST_DONE <= done < len(self._names):
            so_far_s = time.monotonic() - min(begun_s)
            left_s = so_far_s / done * (len(self._names) - done)
            parts.append(f"about {_duration_text(left_s)} left")
        return ", ".join(parts)

    def _statuses(self) -> dict[str, Status]:
        """Return the statuses of the sequences that have begun, in their order."""
        statuses = {}
        for name in self._names:
            # a file that is just being written may be empty
            with contextlib.suppress(OSError, ValueError, TypeError):
                statuses[name] = Status(*json.loads(self.file_of(name).read_text(encoding="utf-8")))
        return statuses


def _duration_text(duration_s: float) -> str:
    if duration_s < 90.0:
        return f"{duration_s:.0f} s"
    return f"{duration_s / 60.0:.0f} min"
