"""Follows a bench that runs on this machine: reads its rings in shared memory, once for all pages.

The bench is not affected, because the writer of a ring never waits. The width of its rows shows the
kind of its vehicle. Rows are thinned to ten pairs a second of simulated time. Each pair has the
least and the largest value of every signal, so that no spike is lost. All pairs of the last minute
are kept. The whole run is thinned further as it grows. The first events of a bench report where it
listens.
"""

import functools
import itertools
import math
import re
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.vehicle import ALLOWED_AXLES, MOST_GROUPS, Kind
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.telemetry import live
from rollerrig.wsp_interface import braking, signals
from rollerrig.wsp_interface.events import Code, Event

PERIOD_S = 0.1  # of the pairs
SPAN_S = 60.0  # of the part that a page shows in full
# the signals that a page draws, where the vehicle has them; `time` must be the first
SHOWN = (
    "time",
    "vehicle_speed",
    "position",
    *map(signals.reference_speed_name, range(MOST_GROUPS)),
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
    "dynamic_torque",
    "dynamic_torque_demand",
    "dynamic_share",
    "track_brake_force",
    "track_brake_lowered",
)
# a wheel that turns faster shows its radius, in rad/s; before that, the radius of the coach UIC-Z1
_TURNS_rad_s = 1.0
USUAL_RADIUS_M = 0.445
_RECENT_POINTS = round(2 * SPAN_S / PERIOD_S)  # two points a pair
_WHOLE_POINTS = 2000
_KEPT_EVENTS = 2000
_RING_NAME = re.compile(r"rollerrig-(\d+)-(\d+)-rows")  # process, time in ns
_EVENT_RING_NAME = re.compile(r"rollerrig-(\d+)-(\d+)-events")


class Columns:
    """What a page draws of a vehicle: columns of its record, and measured speeds behind them.

    table : the signals of the vehicle
    measured : the columns of the speeds in m/s that the sensors show at the rims of the wheels
    names : the names of all columns, in their order
    """

    def __init__(self, table: signals.Table) -> None:
        self.table = table
        recorded: list[str] = []
        for name in SHOWN:
            if name in table.by_name:
                recorded += signals.columns(table.by_name[name])
        self.measured = tuple(f"measured_rim_speed_{axle}_m_s" for axle in table.axles)
        self.names = (*recorded, *self.measured)
        self._recorded = [table.columns.index(name) for name in recorded]
        self._rim_speed = self._of_axles("wheel_circumferential_speed")
        self._wheel_speed = self._of_axles("wheel_speed")
        self._measured_speed = self._of_axles("measured_speed")
        self.time = self.names.index("time_s")
        self.demand = self.names.index("brake_demand_Pa")
        self.position = self.names.index("position_m")

    def _of_axles(self, name: str) -> list[int]:
        """The places of a signal of axles in a row of the ring."""
        return [self.table.columns.index(one) for one in signals.columns(self.table.by_name[name])]

    def of(self, rows: np.ndarray, radius_m: np.ndarray) -> np.ndarray:
        """Rows of these columns for rows of the ring, (n, columns).

        `radius_m` has the radius of each wheel, and gets those that the rows show.
        """
        turns_rad_s = rows[:, self._wheel_speed]
        for j, rim in enumerate(self._rim_speed):
            turning = np.flatnonzero(turns_rad_s[:, j] > _TURNS_rad_s)
            if turning.size:
                at = turning[-1]
                radius_m[j] = rows[at, rim] / turns_rad_s[at, j]
        return np.hstack([rows[:, self._recorded], rows[:, self._measured_speed] * radius_m])


@functools.cache
def columns_of(table: signals.Table) -> Columns:
    """What a page draws of a vehicle."""
    return Columns(table)


@functools.cache
def _tables() -> dict[int, signals.Table]:
    """The signals of each kind of vehicle, by the width of its rows, which differs for each."""
    found = {}
    for kind in itertools.product(ALLOWED_AXLES, (False, True), (False, True)):
        table = signals.table(Kind(*kind))
        found[len(table.columns)] = table
    return found


def table_of(rows: Ring) -> signals.Table:
    """The signals of the vehicle of a bench, by its ring of rows. Raises RollerrigError."""
    width = int(rows.header[ring.WIDTH])
    if width not in _tables():
        raise RollerrigError(
            f"{rows.path}: its rows have {width} items, and no vehicle has so many columns; use one "
            "version of rollerrig for the bench and the desk"
        )
    return _tables()[width]


class Bench:
    """One bench: its rings, the samples read from them, and its state as its events report it.

    Each `car` of a train that has a bus is a bench of one process, counted from 1; 0: a vehicle.

    `columns` is what a page draws of its vehicle. `name` is its process and its folder. `bus` is
    the address of its CAN bus and `modbus` host and port of its server, empty before they are
    open. `faults` are the titles of active faults. `points` counts the points read so far, two a
    pair.
    """

    def __init__(self, pid: int, rows: Ring, events: Ring) -> None:
        self.pid = pid
        self.rows = rows
        self.columns = columns_of(table_of(rows))
        self._event_ring = events
        self.key = f"{pid}-{int(rows.header[ring.CREATED_NS])}"
        self.car = int(rows.header[ring.CAR])
        self.name = f"{_name(pid)}, car {self.car}" if self.car else _name(pid)
        # as its events report it
        self.events: list[Event] = []
        self.bus = ""
        self.modbus = ("", 0)
        self.over_tls = False
        self.faults: list[str] = []
        self.harness = False  # whether a harness has joined
        self.unit_lost = False
        self.unit_silent = False
        # samples
        self.newest = np.full(len(self.columns.names), np.nan)
        self._radius_m = np.full(self.table.kind.axles, USUAL_RADIUS_M)
        self._demanded = False  # a brake demand was seen
        self._braked_from_m = math.nan  # place of the first brake demand
        self.heard_s = time.monotonic()  # when the last sample arrived
        self.points = 0
        self._recent: deque[np.ndarray] = deque(maxlen=_RECENT_POINTS)
        self._whole = np.empty((0, len(self.columns.names)))
        # rows of the pair that is not yet complete
        self._pending = np.empty((0, len(self.columns.names)))
        written = int(rows.header[ring.WRITTEN])
        capacity = int(rows.header[ring.CAPACITY])
        self._cursor = max(0, written - capacity + 1)
        self._event_cursor = 0

    @property
    def table(self) -> signals.Table:
        """The signals of its vehicle."""
        return self.columns.table

    @property
    def ended(self) -> str:
        """How it ended, "closed" or "killed"; empty while it runs."""
        if self.rows.closed:
            return "closed"
        return "" if self.rows.writer_alive else "killed"

    @property
    def time_s(self) -> float:
        """Simulated time of the newest row; 0 before the first."""
        return float(np.nan_to_num(self.newest[self.columns.time]))

    @property
    def braked_m(self) -> float:
        """The distance since the first brake demand in m; NaN if none was seen.

        At standstill it is the stopping distance.
        """
        return self.value("position") - self._braked_from_m

    def value(self, name: str, axle: int = 1) -> float:
        """The newest value of a signal that a page draws; NaN if the vehicle has no such axle."""
        names = signals.columns(self.table.by_name[name])
        if axle > len(names):
            return math.nan
        return float(self.newest[self.columns.names.index(names[axle - 1])])

    def poll(self) -> list[Event]:
        """Read new rows and events, and return the new events.

        Raises RollerrigError if another program has cut off one of the rings.
        """
        rows, self._cursor, _ = self.rows.read(self._cursor)
        if len(rows):
            self.heard_s = time.monotonic()
            shown = self.columns.of(rows, self._radius_m)
            self._note_braking(np.vstack([self.newest, shown]))
            self._take(shown)
        event_rows, self._event_cursor, _ = self._event_ring.read(self._event_cursor)
        events = [ring.read_event(row) for row in event_rows]
        for event in events:
            self._learn(event)
        self.events = (self.events + events)[-_KEPT_EVENTS:]
        return events

    @property
    def fault_marks(self) -> list[tuple[float, str, bool]]:
        """When faults began and were lifted: time in s, the fault, and whether it began."""
        return [
            (event.time_s, event.fields["fault"], event.code == Code.FAULT_BEGINS)
            for event in self.events
            if event.code in (Code.FAULT_BEGINS, Code.FAULT_LIFTED)
        ]

    def since(self, point: int) -> list[np.ndarray]:
        """The points after the one with this number (0: all of the last minute)."""
        new = len(self._recent)
        if point <= self.points:
            new = min(self.points - point, new)
        return list(self._recent)[len(self._recent) - new :]

    @property
    def whole(self) -> np.ndarray:
        """The whole run so far, thinned: shape (n, columns)."""
        return self._whole

    def _note_braking(self, rows: np.ndarray) -> None:
        """Note the place of the first brake demand; `rows` begin with the last row before."""
        begin = braking.begin(rows[:, self.columns.demand])
        if begin is not None and not self._demanded:
            self._demanded = True
            # NaN for a bench that braked already when the desk found it
            self._braked_from_m = float(rows[begin, self.columns.position])

    def _take(self, rows: np.ndarray) -> None:
        """Process rows of shape (n, columns): reduce each complete period to a pair of points."""
        self.newest = rows[-1]
        rows = np.vstack([self._pending, rows])
        period = np.floor(rows[:, self.columns.time] / PERIOD_S + 1e-6)
        complete = period < period[-1]
        self._pending = rows[~complete]
        rows = rows[complete]
        period = period[complete]
        if not len(rows):
            return

        # the first row of each period; then the extremes between two of these rows
        first = np.flatnonzero(np.diff(period, prepend=-1.0))
        least = np.minimum.reduceat(rows, first)
        largest = np.maximum.reduceat(rows, first)
        pairs = np.stack([least, largest], axis=1).reshape(-1, len(self.columns.names))
        self._recent.extend(pairs)
        self.points += len(pairs)
        self._whole = np.vstack([self._whole, pairs])
        if len(self._whole) > 2 * _WHOLE_POINTS:
            self._whole = live.thin(self._whole, _WHOLE_POINTS)

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
                self._forget_fault(fields["fault"])
                self.faults.append(fields["fault"])
            case Code.FAULT_LIFTED:
                self._forget_fault(fields["fault"])
            case Code.HARNESS_JOINED | Code.HARNESS_LEFT:
                self.harness = event.code == Code.HARNESS_JOINED
            case Code.UNIT_LOST | Code.UNIT_BACK:
                self.unit_lost = event.code == Code.UNIT_LOST
            case Code.UNIT_SILENT | Code.UNIT_ANSWERS:
                self.unit_silent = event.code == Code.UNIT_SILENT

    def _forget_fault(self, fault: str) -> None:
        self.faults = [active for active in self.faults if active != fault]


def running(among: Callable[[int], bool] = lambda pid: True) -> list[Bench]:
    """Return the benches that run on this machine, the oldest first.

    `among` returns for the number of a process whether its bench counts.
    """
    found: list[tuple[int, Bench]] = []  # by the time of their rings in ns
    for path in ring.folder().glob("rollerrig-*-rows"):
        name = _RING_NAME.fullmatch(path.name)
        if name is None:
            continue
        pid = int(name[1])
        created_ns = int(name[2])
        if not among(pid):
            continue
        try:
            rows = Ring(path, np.float64)
            bench = Bench(pid, rows, _event_ring(path, pid, created_ns))
        except (OSError, ValueError, RollerrigError):
            continue  # the bench is starting or stopping, or it is not a bench of this user
        if not bench.ended:
            found.append((created_ns, bench))
    found.sort(key=lambda entry: entry[0])
    return [bench for _, bench in found]


def _name(pid: int) -> str:
    """Return a name for the bench of a process: its number, and the folder in which it runs."""
    try:
        return f"process {pid} in {Path(f'/proc/{pid}/cwd').readlink()}"
    except OSError:
        return f"process {pid}"  # it has exited, or the system does not report its folder


def _event_ring(rows: Path, pid: int, created_ns: int) -> Ring:
    """The event ring that a process made next after a ring of rows.

    The folder is open to all users, so files with such a name that are not a ring of this user are
    passed over. Raises FileNotFoundError.
    """
    later: list[tuple[int, Path]] = []
    for path in rows.parent.glob(f"rollerrig-{pid}-*-events"):
        name = _EVENT_RING_NAME.fullmatch(path.name)
        if name is not None and int(name[2]) > created_ns:
            later.append((int(name[2]), path))
    for _, path in sorted(later):
        try:
            return Ring(path, np.int64, width=ring.EVENT_WORDS)
        except (OSError, ValueError, RollerrigError):
            continue
    raise FileNotFoundError(f"{rows}: no ring of events belongs to it")
