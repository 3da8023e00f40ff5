"""A test harness on the bus: it sets what the rig shall do, watches, and writes down what it sees.

It is a member of the bus like any other. Brake demand goes by SDO to node 17, friction, faults and notes to node 127;
speeds, pressures, magnets and the rig's own quantities come by PDO. On a bench in lockstep it answers every SYNC, so
simulated time passes only when the test lets it, and a test repeats bit for bit; in real time it follows.
"""

import contextlib
import struct
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Self

import can

from rollerrig.configs.errors import BusError, RollerrigError
from rollerrig.wsp_interface import events, magnets, rig_objects, signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY, NODE_MASK, TPDO
from rollerrig.wsp_interface.bus.sdo_client import SdoClient
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import layout
from rollerrig.wsp_interface.signals import AXLES, BENCH_NODE, BRAKE_NODE, WSP_NODE

# before the first cycle others may still be starting or compiling; later a bench waits for a slow unit itself
FIRST_CYCLE_S, SILENCE_S = 600, 90
_AXLES = range(1, AXLES + 1)


class TimeOutError(RollerrigError):
    """What was waited for has not come within its time."""


# what the bench's node is asked to send, TPDO by TPDO; the last of them ends a cycle
_MAPPED_SIGNALS = (
    ("time", "vehicle_speed"),
    ("position", "vehicle_acceleration", "brake_demand"),
    ("adhesion",),
    ("valve",),
)
MAPPED = tuple(
    layout(first + BENCH_NODE, *names) for first, names in zip(TPDO, _MAPPED_SIGNALS, strict=True)
)
HEARD = (*MAPPED, rig_objects.SPEEDS, rig_objects.PRESSURES, rig_objects.REFERENCE_SPEED)
CYCLE_ENDS = MAPPED[-1].can_id
COLUMNS: tuple[str, ...] = tuple(name for one in HEARD for name in one.names) + tuple(
    f"magnets_{axle}" for axle in _AXLES
)


@dataclass(frozen=True)
class Event:
    """Something that happened, or was done: simulated time, who, the sentence, and code and fields.

    The code is None only in records from before there were codes.
    """

    time_s: float
    who: str
    text: str
    code: Code | None = None
    fields: dict[str, Any] = field(default_factory=dict)


class Harness:
    """A bench, as a test sees it. `values` are the newest by column name, `trace` one row a cycle.

    Use it as a context: it leaves the bus at the end, and ends the run if it `ends` it.
    """

    def __init__(self, bus: can.BusABC, ends: bool = True) -> None:
        self.bus, self.ends = bus, ends
        self.values = dict.fromkeys(COLUMNS, float("nan"))
        self.trace: list[tuple[float, ...]] = []
        self.events: list[Event] = []
        self.demands: list[tuple[float, float]] = []
        self.lockstep = self.joined = False
        # called while the bench is silent; may raise a RollerrigError that says why
        self.watch: Callable[[], None] = lambda: None
        # called with each event that is written down
        self.tell: Callable[[Event], None] = lambda event: None
        self._owes = False
        self._inbox: deque[can.Message] = deque()
        self._sdo = SdoClient(bus.send, bus.recv, self._inbox.append)
        self._heard = {one.can_id: one for one in HEARD}

    def __repr__(self) -> str:
        """Where the bench stands, by what came last."""
        stand = ", ".join(
            str(axle) for axle in _AXLES if self.values[f"measured_speed_{axle}_rad_s"] == 0.0
        )
        pressures = ", ".join(f"{value / 1e5:.2f}" for value in self.axles("cylinder_pressure"))
        return (
            f"<Harness at {self.time_s:.2f} s: {3.6 * self.vehicle_speed_m_s:.1f} km/h after "
            f"{self.position_m:.1f} m, cylinders {pressures} bar, axles that stand: {stand or 'none'}"
            f"{'' if self.joined else ', has left'}>"
        )

    # -- joining and leaving

    def join(self) -> Self:
        """Map the bench's quantities, join, and wait for the first cycle. Raises BusError."""
        self.lockstep = bool(self._call(self._sdo.read, BENCH_NODE, rig_objects.PACING, 0)[0])
        for number, names in enumerate(_MAPPED_SIGNALS):
            self._map(number, names)
        self._write(rig_objects.HARNESS, rig_objects.JOINED, b"\x01")
        self.joined = True
        self._cycle()
        return self

    def _map(self, number: int, names: Iterable[str]) -> None:
        """Let TPDO `number` (from 0) of the bench carry signals, at every SYNC."""
        places = [(signals.place(name, BENCH_NODE), signals.BY_NAME[name].axles) for name in names]
        entries = [
            place.index << 16 | (place.sub + at) << 8 | signals.bits(place)
            for place, axles in places
            for at in range(axles)
        ]
        can_id, parameters, mapping = MAPPED[number].can_id, 0x1800 + number, 0x1A00 + number
        # bit 31 switches the PDO off, and so does a mapping of no objects
        steps = [
            (parameters, 1, struct.pack("<I", 1 << 31 | can_id)),
            (mapping, 0, b"\x00"),
            *((mapping, at, struct.pack("<I", entry)) for at, entry in enumerate(entries, start=1)),
            (mapping, 0, bytes([len(entries)])),
            (parameters, 2, b"\x01"),
            (parameters, 1, struct.pack("<I", can_id)),
        ]
        for index, sub, data in steps:
            self._write(index, sub, data)

    def close(self) -> None:
        """Leave the bench, end its run where it is ours, and close the bus. Never raises."""
        with contextlib.suppress(RollerrigError):  # a bench that has gone needs no farewell
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

    # -- setting

    def brake(self, pressure_Pa: float | None = None, bar: float | None = None) -> None:
        """Ask for a brake cylinder pressure, in Pa or bar."""
        wanted_Pa = pressure_Pa if pressure_Pa is not None else (bar or 0.0) * 1e5
        place = signals.place("brake_demand", BRAKE_NODE)
        data = struct.pack("<h", signals.count(wanted_Pa, place))
        self._write(place.index, place.sub, data, BRAKE_NODE)
        self.demands.append((self.time_s, wanted_Pa))

    def release(self) -> None:
        """Release the brakes."""
        self.brake(0.0)

    def friction(self, mu: float, axles: Iterable[int] = _AXLES) -> None:
        """Set the kinematic friction under axles from now on; 0 gives it back to the scenario."""
        axles = tuple(axles)
        for axle in axles:
            self._write(
                rig_objects.FRICTION,
                axle,
                struct.pack("<H", round(mu / rig_objects.FRICTION_SCALE)),
            )
        if mu:
            self.record("harness", Code.TEST_FRICTION, mu=mu, axles=list(axles))
        else:
            self.record("harness", Code.TEST_FRICTION_DEFAULT)

    def sand(self, on: bool = True) -> None:
        """Switch all sanders that the vehicle has, as a driver does. Raises BusError where it has none."""
        place = signals.place("sand_demand", signals.SANDER_NODE)
        self._write(
            place.index, place.sub, bytes((rig_objects.ALL_SANDERS * on,)), signals.SANDER_NODE
        )
        self.record("harness", Code.TEST_SAND_ON if on else Code.TEST_SAND_OFF)

    def inject(self, fault: str) -> None:
        """Let a fault of the catalogue begin: `inject("speed_sensor_stuck axle=2 for=3")`."""
        self._write(rig_objects.FAULT, rig_objects.INJECT, fault.encode())
        self.record("harness", Code.TEST_FAULT, fault=fault)

    def lift(self, fault: str) -> None:
        """Lift the faults of a name (and aim): `lift("speed_sensor_stuck axle=2")`."""
        self._write(rig_objects.FAULT, rig_objects.LIFT, fault.encode())
        self.record("harness", Code.TEST_FAULT_LIFTED, fault=fault)

    def note(self, text: str) -> None:
        """Put an operator's note into the events of the run."""
        self._write(rig_objects.NOTE, 0, text.encode("ascii", "replace"))
        self.record("note", Code.OPERATOR_NOTE, note=text)

    def log(self, who: str, text: str) -> None:
        """Write down a sentence at the present simulated time."""
        self.record(who, Code.HARNESS_TEXT, message=text)

    def record(self, who: str, code: Code, /, **fields: Any) -> None:
        """Write down an event, with its fields, at the present simulated time."""
        event = events.make(self.time_s, code, **fields)
        self.events.append(Event(event.time_s, who, event.text, code, fields))
        self.tell(self.events[-1])

    # -- letting time pass

    def step(self) -> None:
        """Let one bus cycle pass. Raises BusError when the bench has gone."""
        if self._owes:
            self._owes = False
            self._call(
                self.bus.send,
                can.Message(
                    arbitration_id=rig_objects.HARNESS_ANSWER_ID,
                    is_extended_id=False,
                    data=[len(self.trace) & 0xFF],
                ),
            )
        self._cycle()

    def wait(self, duration_s: float) -> None:
        """Let simulated time pass."""
        end_s = self.time_s + duration_s - 1e-9
        while self.time_s < end_s:
            self.step()

    def until(
        self, reached: Callable[[], bool], timeout_s: float = 300.0, hold_s: float = 0.0
    ) -> None:
        """Go on until a condition has held for a time. Raises TimeOutError."""
        begin_s, since_s = self.time_s, None
        while True:
            since_s = (self.time_s if since_s is None else since_s) if reached() else None
            if since_s is not None and self.time_s >= since_s + hold_s - 1e-9:
                return
            if self.time_s > begin_s + timeout_s:
                raise TimeOutError(
                    f"at {self.time_s:.2f} s: what was waited for has not come within {timeout_s:g} s"
                )
            self.step()

    def stop(self, timeout_s: float = 300.0) -> None:
        """Go on until the vehicle stands."""
        self.until(lambda: self.vehicle_speed_m_s < 0.005, timeout_s)

    # -- seeing

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
        """The newest values of a signal of all axles, such as "cylinder_pressure"."""
        return tuple(self.values[column] for column in signals.columns(signals.BY_NAME[name]))

    def read(self, name: str) -> tuple[float, ...]:
        """A quantity of the bench by SDO, all its axles. Raises BusError, KeyError if unknown."""
        signal = signals.BY_NAME[name]
        try:
            place = signals.place(name, BENCH_NODE)
        except LookupError as error:
            raise BusError(f"the bench: {error}") from None
        read = (
            self._call(self._sdo.read, BENCH_NODE, place.index, place.sub + at)
            for at in range(signal.axles)
        )
        return tuple(
            signals.value(struct.unpack(rig_objects.struct_format(place), data)[0], place)
            for data in read
        )

    # -- the bus

    def _call(self, what: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return what(*arguments)
        except can.CanError as error:
            raise BusError(f"the bench has gone: {error}") from None

    def _write(self, index: int, sub: int, data: bytes, node: int = BENCH_NODE) -> None:
        self._call(self._sdo.write, node, index, sub, data)

    def _cycle(self) -> None:
        """Take frames up to the end of a cycle's burst, and write a row."""
        # counted, not by the clock: a test that was stopped itself has not waited
        silent_s, patience_s = 0, SILENCE_S if self.trace else FIRST_CYCLE_S
        while True:
            message = self._inbox.popleft() if self._inbox else self._call(self.bus.recv, 1.0)
            if message is not None and self._take(message):
                break
            if message is None:
                self.watch()
                silent_s += 1
            if silent_s > patience_s:
                raise BusError(
                    f"the bench has been silent for {patience_s} s at {self.time_s:.3f} s of simulated time"
                )
        self._owes = self.lockstep
        self.trace.append(tuple(self.values.values()))

    def _take(self, message: can.Message) -> bool:
        """Take one frame; True when it ends the cycle."""
        can_id, data = message.arbitration_id, message.data
        if can_id in self._heard and (found := self._heard[can_id].read(data)):
            self.values |= found
            return can_id == CYCLE_ENDS
        if can_id == rig_objects.MAGNETS_ID and len(data) == 1:
            for axle, pair in zip(_AXLES, magnets.unpack(data[0]), strict=True):
                self.values[f"magnets_{axle}"] = float(pair)
        elif EMERGENCY < can_id <= EMERGENCY + NODE_MASK and len(data) == 8 and any(data[:2]):
            node = can_id - EMERGENCY
            self.record(
                f"node {node}",
                Code.UNIT_EMERGENCY if node == WSP_NODE else Code.NODE_EMERGENCY,
                node=node,
                error_code=int.from_bytes(data[:2], "little"),
                error_register=data[2],
            )
        return False


def connect(address: str = signals.DEFAULT_ADDRESS, ends: bool = False) -> Harness:
    """A harness on a bench that runs already. Raises BusError."""
    return Harness(buses.open_client(address), ends)
