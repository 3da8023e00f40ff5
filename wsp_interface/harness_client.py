"""A test harness on the bus: it commands the rig, observes it and records what happens.

The harness is a member of the bus like any other. It sends the brake demand by SDO to node 17, and
friction, faults and notes to node 127. Node 127 sends it by PDO how vehicle, wheels and brakes
really move, which no fault of a sensor or a node of the rig changes. Beside that it receives what
the unit receives and sends: measured speeds, magnets and the unit's reference speed. On a bench in
lockstep it answers every SYNC: simulated time passes only when the test lets it pass, so a test
repeats bit for bit. In real time the harness follows the bench.
"""

import contextlib
import functools
import json
import linecache
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self

import can

from rollerrig.configs.errors import BusError, ConfigError, RollerrigError
from rollerrig.configs.table import nearest
from rollerrig.configs.vehicle import ALLOWED_AXLES, Kind
from rollerrig.wsp_interface import events, magnets, rig_objects, signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY, NODE_MASK, RPDO, TPDO
from rollerrig.wsp_interface.bus.sdo_client import RefusedError, SdoClient
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import Layout
from rollerrig.wsp_interface.signals import BENCH_NODE, BRAKE_NODE, Table

# How long the harness waits for a silent bench. Before the first cycle other programs may still be
# starting or compiling; later the bench itself waits for a slow unit.
FIRST_CYCLE_S = 600
SILENCE_S = 90
# tolerance when simulated times are compared
_TINY_S = 1e-9
_STANDSTILL_M_S = 0.005
# parameters of TPDO 1, from CiA 301; those of the others follow
_TPDO_COMMUNICATION = 0x1800
_TPDO_MAPPING = 0x1A00
_PDO_OFF = 1 << 31  # bit of a PDO's COB-ID


class TimeOutError(RollerrigError):
    """A condition has not come true within its time."""


class _Mapped(NamedTuple):
    """A TPDO of node 127 that the harness maps: its identifier, signals, and group of axles."""

    can_id: int
    names: tuple[str, ...]
    group: int


# the signals of the axles of a group, one TPDO each
_OF_AXLES = (
    "adhesion",
    "valve",
    "sliding",
    "wheel_circumferential_speed",
    "cylinder_pressure",
)


def _tpdos(groups: int) -> Iterator[_Mapped]:
    """Yield the TPDOs of node 127 in their order; the last one ends a cycle.

    The predefined connection set has identifiers for four TPDOs. The others of the leading group
    take those of the RPDOs 2 to 4 of node 127, which it does not use. Those of a further group take
    the identifiers of a node 126 or 125, which no rig has. The highest identifier, 57Fh, is the
    last one.
    """
    *first, last = (*TPDO, *RPDO[1:])
    *of_axles, ends_cycle = _OF_AXLES
    names = (
        ("time", "vehicle_speed"),
        ("position", "vehicle_acceleration", "brake_demand"),
        *((name,) for name in of_axles),
    )
    for service, carried in zip(first, names, strict=True):
        yield _Mapped(service + BENCH_NODE, carried, 0)
    for group in range(1, groups):
        services = (*TPDO, RPDO[1])
        for service, name in zip(services, _OF_AXLES, strict=True):
            yield _Mapped(service + BENCH_NODE - group, (name,), group)
    yield _Mapped(last + BENCH_NODE, (ends_cycle,), 0)


class Reception(NamedTuple):
    """What a harness receives of a vehicle in each cycle, and what it can read.

    tpdos: the TPDOs of node 127 that the harness maps, and `mapped` their layouts.
    layouts: of the frames with signals, by identifier: those of node 127, and the speeds that the
        units receive and send.
    cycle_ends: the identifier of the last frame of a cycle.
    magnets: the columns of the magnets, by the identifier of their frame.
    columns: all columns that are received.
    received, readable: the names of the signals that are received, and of those of node 127.
    """

    tpdos: tuple[_Mapped, ...]
    mapped: tuple[Layout, ...]
    layouts: Mapping[int, Layout]
    cycle_ends: int
    magnets: Mapping[int, tuple[str, ...]]
    columns: tuple[str, ...]
    received: tuple[str, ...]
    readable: tuple[str, ...]


@functools.cache
def reception(table: Table) -> Reception:
    """Return what a harness receives of the vehicle with these signals."""
    tpdos = tuple(_tpdos(table.kind.groups))
    mapped = tuple(
        rig_objects.layout(table, tpdo.can_id, *tpdo.names, node=BENCH_NODE, group=tpdo.group)
        for tpdo in tpdos
    )
    units = [rig_objects.unit_frames(table, group) for group in range(table.kind.groups)]
    heard = (
        *mapped,
        *(unit.speeds for unit in units),
        *(unit.reference_speed for unit in units),
    )
    all_magnets = signals.columns(table.by_name["magnets"])
    of_units = {}
    for unit in units:
        axles = table.axles_of(unit.group)
        of_units[unit.magnets_id] = all_magnets[axles[0] - 1 : axles[-1]]

    columns = (*(name for frame in heard for name in frame.names), *all_magnets)
    received = []
    readable = []
    for signal in table.signals:
        if set(signals.columns(signal)) <= set(columns):
            received.append(signal.name)
        if any(place.node == BENCH_NODE for place in signal.places):
            readable.append(signal.name)
    return Reception(
        tpdos=tpdos,
        mapped=mapped,
        layouts={frame.can_id: frame for frame in heard},
        cycle_ends=mapped[-1].can_id,
        magnets=of_units,
        columns=columns,
        received=tuple(received),
        readable=tuple(readable),
    )


class Values(dict[str, float]):
    """Values by the names of their columns; a wrong name gets a message with the right ones."""

    def __missing__(self, name: str) -> float:
        raise ConfigError(f"the harness has no value '{name}'{nearest(name, self)}")


def _check_name(name: str, allowed: tuple[str, ...]) -> None:
    """Raise ConfigError if a name is not one of the allowed signals."""
    if name not in allowed:
        raise ConfigError(f"no signal is called '{name}'{nearest(name, allowed)}")


def _source_of(condition: Callable[[], bool]) -> str:
    """Return where a condition is in the source, and its line, for a message."""
    code = getattr(condition, "__code__", None)
    if code is None:
        return repr(condition)
    line = linecache.getline(code.co_filename, code.co_firstlineno).strip()
    return f"({Path(code.co_filename).name}, line {code.co_firstlineno}: {line})"


@dataclass(frozen=True)
class Event:
    """An event of the rig or an action of the harness.

    time_s: simulated time.
    who: the source, such as "harness" or "node 17".
    text: the sentence for people; programs use `code` and `fields`.
    code: None only in records of older versions.
    """

    time_s: float
    who: str
    text: str
    code: Code | None = None
    fields: dict[str, Any] = field(default_factory=dict)


class Harness:
    """A bench, as a test sees it.

    bus: an open python-can bus; the harness closes it.
    ends: whether closing the harness also ends the run.

    Attributes:
    table: the signals of the vehicle. A dynamic brake is not in it, as node 127 does not show it.
    columns: the names of the values that the harness receives.
    values: the newest values, by these names.
    trace: the values of every cycle, in the order of `columns`.
    events: what has happened so far.
    demands: the commanded brake demands, as (simulated time in s, pressure in Pa).
    lockstep: whether simulated time waits for the harness.
    on_silence: called every second while the bench is silent; may raise a RollerrigError.
    on_cycle: called after every cycle; may raise a RollerrigError.
    on_event: called with each new event.

    Use it as a context manager: it joins the bench, and at the end it leaves the bus.
    """

    def __init__(self, bus: can.BusABC, ends: bool = True) -> None:
        """Ask the bench for its vehicle. Raises BusError, and has closed the bus then."""
        self.bus = bus
        self.ends = ends
        self.trace: list[tuple[float, ...]] = []
        self.events: list[Event] = []
        self.demands: list[tuple[float, float]] = []
        self.lockstep = False
        self.joined = False
        self.on_silence: Callable[[], None] = lambda: None
        self.on_cycle: Callable[[], None] = lambda: None
        self.on_event: Callable[[Event], None] = lambda event: None
        self._owes_answer = False
        # messages that arrived while the harness waited for an SDO answer
        self._inbox: deque[can.Message] = deque()
        self._sdo = SdoClient(bus.send, bus.recv, self._inbox.append)
        try:
            self.table = signals.table(self._ask_vehicle())
        except BusError:
            bus.shutdown()
            raise
        self._reception = reception(self.table)
        self.columns = self._reception.columns
        self.values = Values.fromkeys(self.columns, float("nan"))

    def __repr__(self) -> str:
        """Return the state of the bench in one line; pytest prints it for a failed test."""
        speeds = zip(self.table.axles, self.axles("wheel_circumferential_speed"), strict=True)
        standing = ", ".join(str(axle) for axle, speed in speeds if speed == 0.0)
        pressures = ", ".join(f"{value / 1e5:.2f}" for value in self.axles("cylinder_pressure"))
        left = "" if self.joined else ", has left"
        return (
            f"<Harness at {self.time_s:.2f} s: {3.6 * self.vehicle_speed_m_s:.1f} km/h after "
            f"{self.position_m:.1f} m, cylinders {pressures} bar, "
            f"standing axles: {standing or 'none'}{left}>"
        )

    # -- what the bench plays

    def _ask_vehicle(self) -> Kind:
        """Return the kind of the bench's vehicle, as the objects of node 127 show it.

        An object with a value for each axle has their number in its sub-index 0, and only a vehicle
        with a magnetic track brake has the object of its force. Raises BusError.
        """
        of_axles = signals.first_place("adhesion").index
        of_magnets = signals.first_place("track_brake_force").index
        axles = int.from_bytes(self._call(self._sdo.read, BENCH_NODE, of_axles, 0), "little")
        if axles not in ALLOWED_AXLES:
            raise BusError(
                f"node {BENCH_NODE} has {axles} axles (object {of_axles:X}h:0); allowed are "
                f"{', '.join(map(str, ALLOWED_AXLES))}: is it a bench of this version?"
            )
        try:
            self._call(self._sdo.read, BENCH_NODE, of_magnets, 0)
        except RefusedError:
            return Kind(axles)
        return Kind(axles, magnetic_track_brake=True)

    def configuration(self) -> dict[str, Any]:
        """Return what the bench plays, before or after joining.

        The keys: `resolved` (the resolved scenario), `scenario` (its name), `config_hash`,
        `pacing`, `seed` and `unit`. Raises BusError if the bench does not state it.
        """
        unknown = (
            f"the bench does not state what it plays (object {rig_objects.CONFIGURATION:X}h of node "
            f"{BENCH_NODE}): start it with 'rollerrig run' of this version"
        )
        try:
            data = self._call(self._sdo.read, BENCH_NODE, rig_objects.CONFIGURATION, 0)
            found = json.loads(data)
        except RefusedError:
            raise BusError(unknown) from None
        except (ValueError, RecursionError):
            raise BusError(unknown) from None
        if not isinstance(found, dict) or not isinstance(found.get("resolved"), dict):
            raise BusError(unknown)
        return found

    def commanded_friction(self) -> dict[int, float]:
        """Return the kinematic friction commanded under each axle; 0 is that of the scenario."""
        found = {}
        for axle in self.table.axles:
            data = self._call(self._sdo.read, BENCH_NODE, rig_objects.FRICTION, axle)
            (count,) = struct.unpack("<H", data)
            found[axle] = count * rig_objects.FRICTION_SCALE
        return found

    # -- joining and leaving

    def join(self) -> Self:
        """Map the bench's quantities, join, and wait for the first cycle. Raises BusError."""
        pacing = self._call(self._sdo.read, BENCH_NODE, rig_objects.PACING, 0)
        self.lockstep = bool(pacing[0])
        for number, tpdo in enumerate(self._reception.tpdos):
            self._map(number, tpdo)
        self._write(rig_objects.HARNESS, rig_objects.JOINED, b"\x01")
        self.joined = True
        self._cycle()
        return self

    def _map(self, number: int, tpdo: _Mapped) -> None:
        """Make TPDO `number` (from 0) of the bench carry signals, at every SYNC."""
        axles = self.table.axles_of(tpdo.group)
        entries: list[int] = []
        for name in tpdo.names:
            place = self.table.place(name, BENCH_NODE)
            subs = range(place.sub, place.sub + 1)
            if self.table.by_name[name].axles > 1:
                first = place.sub - 1
                subs = range(first + axles[0], first + axles[-1] + 1)
            for sub in subs:
                entries.append(place.index << 16 | sub << 8 | signals.bits(place))

        can_id = tpdo.can_id
        communication = _TPDO_COMMUNICATION + number
        mapping = _TPDO_MAPPING + number
        # a mapping can only change while the PDO is off and its number of entries is 0
        self._write(communication, 1, struct.pack("<I", _PDO_OFF | can_id))
        self._write(mapping, 0, b"\x00")
        for sub, entry in enumerate(entries, start=1):
            self._write(mapping, sub, struct.pack("<I", entry))
        self._write(mapping, 0, bytes([len(entries)]))
        self._write(communication, 2, b"\x01")  # at every SYNC
        self._write(communication, 1, struct.pack("<I", can_id))

    def close(self) -> None:
        """Leave the bench, end its run if the harness owns it, and close the bus. Never raises."""
        with contextlib.suppress(RollerrigError):  # the bench may have exited
            if self.joined and self.ends:
                self._write(rig_objects.HARNESS, rig_objects.END, b"\x01")
            if self.joined:
                self._write(rig_objects.HARNESS, rig_objects.JOINED, b"\x00")
        self.joined = False
        self.bus.shutdown()

    def __enter__(self) -> Self:
        return self if self.joined else self.join()

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- commands

    def brake(self, pressure_Pa: float | None = None, bar: float | None = None) -> None:
        """Command a brake cylinder pressure, in Pa or bar."""
        if pressure_Pa is None:
            pressure_Pa = (bar or 0.0) * 1e5
        place = signals.first_place("brake_demand")
        data = struct.pack(rig_objects.struct_format(place), signals.count(pressure_Pa, place))
        self._write(place.index, place.sub, data, BRAKE_NODE)
        self.demands.append((self.time_s, pressure_Pa))

    def release(self) -> None:
        """Release the brakes."""
        self.brake(0.0)

    def friction(self, mu: float, axles: Iterable[int] | None = None) -> None:
        """Set the kinematic friction under axles from now on; 0 returns to that of the scenario.

        axles: counted from 1; None for all.
        """
        axles = tuple(self.table.axles if axles is None else axles)
        data = struct.pack("<H", round(mu / rig_objects.FRICTION_SCALE))
        for axle in axles:
            self._write(rig_objects.FRICTION, axle, data)
        if mu:
            self.record("harness", Code.TEST_FRICTION, mu=mu, axles=list(axles))
        else:
            self.record("harness", Code.TEST_FRICTION_DEFAULT)

    def sand(self, on: bool = True) -> None:
        """Switch all sanders of the vehicle, like a driver. Raises BusError if it has none."""
        place = signals.first_place("sand_demand")
        sanders = rig_objects.ALL_SANDERS if on else 0
        self._write(place.index, place.sub, bytes([sanders]), signals.SANDER_NODE)
        self.record("harness", Code.TEST_SAND_ON if on else Code.TEST_SAND_OFF)

    def inject(self, fault: str) -> None:
        """Start a fault of the catalogue: `inject("speed_sensor_stuck axle=2 for=3")`.

        Raises RefusedError, which lists the faults if there is none of this name.
        """
        self._write_fault(rig_objects.INJECT, fault)
        self.record("harness", Code.TEST_FAULT, fault=fault)

    def lift(self, fault: str) -> None:
        """End the faults of a name (and its values): `lift("speed_sensor_stuck axle=2")`."""
        self._write_fault(rig_objects.LIFT, fault)
        self.record("harness", Code.TEST_FAULT_LIFTED, fault=fault)

    def note(self, text: str) -> None:
        """Put an operator's note into the events of the run."""
        self._write(rig_objects.NOTE, 0, text.encode("ascii", "replace"))
        self.record("note", Code.OPERATOR_NOTE, note=text)

    def log(self, who: str, text: str) -> None:
        """Record a sentence at the present simulated time. `who` is its source."""
        self.record(who, Code.HARNESS_TEXT, message=text)

    def record(self, who: str, code: Code, /, **fields: Any) -> None:
        """Record an event with its fields at the present simulated time. `who` is its source."""
        made = events.make(self.time_s, code, **fields)
        event = Event(made.time_s, who, made.text, code, fields)
        self.events.append(event)
        self.on_event(event)

    # -- time

    def step(self) -> None:
        """Let one bus cycle pass. Raises BusError when the bench has exited."""
        if self._owes_answer:
            self._owes_answer = False
            answer = can.Message(
                arbitration_id=rig_objects.HARNESS_ANSWER_ID,
                is_extended_id=False,
                data=[len(self.trace) & 0xFF],
            )
            self._call(self.bus.send, answer)
        self._cycle()

    def wait(self, duration_s: float) -> None:
        """Let simulated time pass: `duration_s`, in whole bus cycles."""
        end_s = self.time_s + duration_s - _TINY_S
        while self.time_s < end_s:
            self.step()

    def until(
        self,
        reached: Callable[[], bool],
        timeout_s: float = 300.0,
        hold_s: float = 0.0,
        name: str = "",
        readings: Callable[[], str] | None = None,
    ) -> None:
        """Let time pass until a condition has held for `hold_s`. Raises TimeOutError.

        The message of a time-out has the `name` of the condition (default: its place in the source)
        and the last values, which `readings()` returns (default: the state of the bench).
        """
        begin_s = self.time_s
        since_s: float | None = None  # when the condition became true
        while True:
            if not reached():
                since_s = None
            elif since_s is None:
                since_s = self.time_s
            if since_s is not None and self.time_s >= since_s + hold_s - _TINY_S:
                return
            if self.time_s > begin_s + timeout_s:
                last_values = readings() if readings else repr(self)
                held = f" and held for {hold_s:g} s" if hold_s else ""
                raise TimeOutError(
                    f"at {self.time_s:.2f} s: the condition {name or _source_of(reached)} has not "
                    f"come true{held} in {timeout_s:g} s; last values: {last_values}"
                )
            self.step()

    def stop(self, timeout_s: float = 300.0) -> None:
        """Let time pass until the vehicle stands. Raises TimeOutError."""
        self.until(
            lambda: self.vehicle_speed_m_s < _STANDSTILL_M_S,
            timeout_s,
            name=f"vehicle_speed < {_STANDSTILL_M_S} m/s",
        )

    # -- values

    @property
    def time_s(self) -> float:
        """Simulated time; 0 before the first cycle."""
        time_s = self.values["time_s"]
        return time_s if time_s == time_s else 0.0

    @property
    def vehicle_speed_m_s(self) -> float:
        """Speed of the vehicle."""
        return self.values["vehicle_speed_m_s"]

    @property
    def position_m(self) -> float:
        """Distance run by the vehicle."""
        return self.values["position_m"]

    @property
    def longest_lock_s(self) -> float:
        """The longest lock of any wheelset so far."""
        return max(self.read("longest_lock"))

    def axles(self, name: str) -> tuple[float, ...]:
        """Return the newest values of a signal for all axles, such as "cylinder_pressure".

        Raises ConfigError for a signal that the harness does not receive.
        """
        _check_name(name, self._reception.received)
        columns = signals.columns(self.table.by_name[name])
        return tuple(self.values[column] for column in columns)

    def read(self, name: str) -> tuple[float, ...]:
        """Read a signal of the bench by SDO; return the values of all its axles.

        Raises ConfigError for an unknown signal, and BusError.
        """
        _check_name(name, self._reception.readable)
        signal = self.table.by_name[name]
        place = self.table.place(name, BENCH_NODE)
        form = rig_objects.struct_format(place)
        values = []
        for offset in range(signal.axles):
            data = self._call(self._sdo.read, BENCH_NODE, place.index, place.sub + offset)
            (raw,) = struct.unpack(form, data)
            values.append(signals.value(raw, place))
        return tuple(values)

    # -- the bus

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the bus. Raises BusError when the connection is lost."""
        try:
            return function(*arguments)
        except can.CanError as error:
            raise BusError(f"the connection to the bench is lost: {error}") from None

    def _write(self, index: int, sub: int, data: bytes, node: int = BENCH_NODE) -> None:
        self._call(self._sdo.write, node, index, sub, data)

    def _write_fault(self, sub: int, fault: str) -> None:
        """Command a fault. Raises RefusedError with the reason that the bench gives."""
        try:
            self._write(rig_objects.FAULT, sub, fault.encode())
        except RefusedError as error:
            reason = self._call(self._sdo.read, BENCH_NODE, rig_objects.REFUSAL, 0)
            raise RefusedError(reason.decode("ascii", "replace") or str(error)) from None

    def _cycle(self) -> None:
        """Take all frames of a cycle, and add a row to the trace."""
        # The silence is counted in time-outs of `recv`, not by the clock: if the test itself was
        # suspended, the bench has not been silent.
        patience_s = SILENCE_S if self.trace else FIRST_CYCLE_S
        silent_s = 0
        while True:
            message = self._inbox.popleft() if self._inbox else self._call(self.bus.recv, 1.0)
            if message is None:
                self.on_silence()
                silent_s += 1
            elif self._take(message):
                break
            if silent_s > patience_s:
                raise BusError(
                    f"the bench has been silent for {patience_s} s "
                    f"at {self.time_s:.3f} s of simulated time"
                )
        self._owes_answer = self.lockstep
        self.trace.append(tuple(self.values.values()))
        self.on_cycle()

    def _take(self, message: can.Message) -> bool:
        """Take one frame; return True when it ends the cycle."""
        can_id = message.arbitration_id
        data = message.data
        expected = self._reception
        if can_id in expected.layouts:
            values = expected.layouts[can_id].read(data)
            self.values |= values
            return can_id == expected.cycle_ends and bool(values)
        if can_id in expected.magnets:
            columns = expected.magnets[can_id]
            if len(data) == 1:
                pairs = magnets.unpack(data[0], len(columns))
                for column, pair in zip(columns, pairs, strict=True):
                    self.values[column] = float(pair)
        elif EMERGENCY < can_id <= EMERGENCY + NODE_MASK and len(data) == 8:
            self._take_emergency(can_id - EMERGENCY, data)
        return False

    def _take_emergency(self, node: int, data: bytearray) -> None:
        error_code = int.from_bytes(data[:2], "little")
        if error_code == 0:
            return  # the error is over
        self.record(
            f"node {node}",
            rig_objects.emergency_event(self.table, node, error_code),
            node=node,
            error_code=error_code,
            error_register=data[2],
        )


def connect(address: str = signals.DEFAULT_ADDRESS, ends: bool = False) -> Harness:
    """Return a harness for a bench that already runs. Raises BusError.

    ends: whether closing the harness also ends the run.
    """
    return Harness(buses.open_client(address), ends)
