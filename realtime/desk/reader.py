"""The bench that runs on this machine, read from its rings in shared memory by one reader for all pages.

The bench knows nothing of it: a ring's writer waits for nobody. Rows are thinned to ten pairs a second of simulated
time, each pair the least and largest value of every signal, so that no spike is lost; the last minute is kept as it
is, the whole run thinner and thinner. Where the bench listens stands in its first events.
"""

import re
import time
from collections import deque
from collections.abc import Collection
from pathlib import Path

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.telemetry import live
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, Event

PERIOD_S, SPAN_S = 0.1, 60.0
# what a page draws; `time` first
SHOWN = (
    "time",
    "vehicle_speed",
    "position",
    "wsp_reference_speed",
    "brake_demand",
    "tick_lateness",
    "ticks_missed",
    "wheel_circumferential_speed",
    "sliding",
    "adhesion",
    "adhesion_degraded",
    "adhesion_recovered",
    "cylinder_pressure",
    "valve",
    "friction_degraded",
)
_COLUMNS = np.concatenate([np.arange(len(signals.COLUMNS))[signals.span(name)] for name in SHOWN])
COLUMNS = tuple(signals.COLUMNS[at] for at in _COLUMNS)
_RECENT, _WHOLE = round(2 * SPAN_S / PERIOD_S), 2000
_RING = re.compile(r"rollerrig-(\d+)-(\d+)-rows")


class Bench:
    """One bench: its rings, what of them has been read, and what its events tell of it."""

    def __init__(self, pid: int, rows: Ring, events: Ring) -> None:
        self.pid, self.rows, self._event_ring = pid, rows, events
        self.key = f"{pid}-{int(rows.header[ring.CREATED_NS])}"
        self.events: list[Event] = []
        self.bus, self.modbus = "", ("", 0)
        self.faults: list[str] = []
        self.harness = self.started = self.unit_lost = self.over_tls = False
        self.newest = np.full(len(_COLUMNS), np.nan)
        self.heard_s = time.monotonic()
        self.points = 0  # pairs' rows that there have been so far
        self._recent: deque[np.ndarray] = deque(maxlen=_RECENT)
        self._whole = np.empty((0, len(_COLUMNS)))
        self._pending = np.empty((0, len(_COLUMNS)))
        self._cursor = max(0, int(rows.header[ring.WRITTEN]) - int(rows.header[ring.CAPACITY]) + 1)
        self._event_cursor = 0

    @property
    def ended(self) -> str:
        """How it ended; empty while it lives."""
        if self.rows.closed:
            return "closed"
        return "" if self.rows.writer_alive else "killed"

    @property
    def time_s(self) -> float:
        """Simulated time of the newest row; 0 before the first."""
        return float(np.nan_to_num(self.newest[0]))

    def value(self, name: str, axle: int = 1) -> float:
        """The newest value of a signal that is shown."""
        return float(self.newest[COLUMNS.index(signals.columns(signals.BY_NAME[name])[axle - 1])])

    def poll(self) -> list[Event]:
        """Take in what is new; the new events."""
        rows, self._cursor, _ = self.rows.read(self._cursor)
        if len(rows):
            self.heard_s = time.monotonic()
            self._take(rows[:, _COLUMNS])
        found, self._event_cursor, _ = self._event_ring.read(self._event_cursor)
        events = [ring.read_event(one) for one in found]
        for event in events:
            self._learn(event)
        self.events = (self.events + events)[-2000:]
        return events

    def since(self, point: int) -> list[np.ndarray]:
        """Points after the one of a number (0: all of the last minute)."""
        new = (
            min(self.points - point, len(self._recent))
            if point <= self.points
            else len(self._recent)
        )
        return list(self._recent)[len(self._recent) - new :] if new else []

    @property
    def whole(self) -> np.ndarray:
        """The whole run so far, thinned: shape (n, columns)."""
        return self._whole

    def _take(self, rows: np.ndarray) -> None:
        self.newest = rows[-1]
        rows = np.vstack([self._pending, rows])
        number = np.floor(rows[:, 0] / PERIOD_S + 1e-6)
        full = number < number[-1]
        self._pending, rows, number = rows[~full], rows[full], number[full]
        if not len(rows):
            return
        first = np.flatnonzero(np.diff(number, prepend=-1.0))
        pairs = np.stack(
            [np.minimum.reduceat(rows, first), np.maximum.reduceat(rows, first)], axis=1
        )
        pairs = pairs.reshape(-1, len(_COLUMNS))
        self._recent.extend(pairs)
        self.points += len(pairs)
        self._whole = np.vstack([self._whole, pairs])
        if len(self._whole) > 2 * _WHOLE:
            self._whole = live.thin(self._whole, _WHOLE)

    def _learn(self, event: Event) -> None:
        """Take from an event where the bench listens and what state it is in."""
        fields = event.fields
        match event.code:
            case Code.BUS_PLACE:
                self.bus = fields["address"]
            case Code.MODBUS_SERVED:
                self.modbus = fields["host"], fields["port"]
                self.over_tls = fields["transport"] == "TLS"
            case Code.FAULT_BEGINS:
                self.faults = [one for one in self.faults if one != fields["fault"]]
                self.faults.append(fields["fault"])
            case Code.FAULT_LIFTED:
                self.faults = [one for one in self.faults if one != fields["fault"]]
            case Code.HARNESS_JOINED | Code.HARNESS_LEFT:
                self.harness = event.code == Code.HARNESS_JOINED
            case Code.UNIT_LOST | Code.UNIT_BACK:
                self.unit_lost = event.code == Code.UNIT_LOST


def find(beside: str = "", among: Collection[int] | None = None) -> Bench | None:
    """The newest bench that lives on this machine, but for the one of a key; `among`: only of these processes."""
    found: dict[int, tuple[Path, int]] = {}
    for path in ring.folder().glob("rollerrig-*-rows"):
        if (name := _RING.fullmatch(path.name)) and (among is None or int(name[1]) in among):
            found[int(name[2])] = path, int(name[1])
    for at_ns in sorted(found, reverse=True):
        path, pid = found[at_ns]
        try:
            bench = Bench(pid, Ring(path, np.float64), Ring(_events(path, pid, at_ns), np.int64))
        except (OSError, ValueError, RollerrigError):
            continue  # it ends, or is only being made
        if bench.key != beside and not bench.ended:
            return bench
    return None


def _events(rows: Path, pid: int, at_ns: int) -> Path:
    """The ring of events that a process made next after a ring of rows. Raises FileNotFoundError."""
    later = [
        (number, path)
        for path in rows.parent.glob(f"rollerrig-{pid}-*-events")
        if (number := int(path.name.split("-")[2])) > at_ns
    ]
    if not later:
        raise FileNotFoundError(f"{rows}: no ring of events beside it")
    return min(later)[1]
