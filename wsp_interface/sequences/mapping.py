"""A unit that speaks plain CAN messages of its own: a DBC file and a mapping lead it to the rig.

After each SYNC the gateway waits for the axle speeds of node 16, sends the unit its messages,
encoded as the DBC says, and turns the unit's answer into the magnets of node 17, its
reference speed and the heartbeat of node 32. So such a unit runs the same sequences, in
lockstep too if it answers each of the last messages to it; one that keeps its own time is for real
time. A unit that is silent is soon without heartbeat, and the brakes apply. Before the first SYNC it
is asked with the speeds of a standing train until it answers.

    dbc = "unit.dbc"
    [[to_unit]]
    message = "AXLE_SPEEDS"
    signals = { V1 = "measured_speed_1", V2 = "measured_speed_2" }
    factor = 1.602                # km/h for rad/s at a radius of 0.445 m
    [from_unit]
    message = "VALVES"
    hold = ["HOLD1", "HOLD2", "HOLD3", "HOLD4"]
    vent = ["VENT1", "VENT2", "VENT3", "VENT4"]
    reference = "V_REF"           # optional
    reference_factor = 0.27778    # m/s of one unit of V_REF

Source: cantools for the DBC.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import cantools
from cantools.database.can import Message as DbcMessage

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import LSS_ANSWER, LSS_REQUEST, NMT, NODE_MASK, SYNC, TIME
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, PRESSURES, REFERENCE_SPEED, SPEEDS, UNIT_HEARTBEAT_ID
from rollerrig.wsp_interface.signals import AXLES, BENCH_NODE, WSP_NODE

OPERATIONAL, HEARTBEAT_SYNCS, QUIET_S = 5, 5, 0.1
_NODES = (*signals.RIG_NODES, WSP_NODE, BENCH_NODE)
_KEYS = ("title", "dbc", "to_unit", "from_unit")
_TO, _FROM = ("message", "signals", "factor"), ("message", "hold", "vent", "reference",
                                                "reference_factor")
# what a mapping calls the quantities: their columns without unit
_PLAIN = {column: f"{one}_{axle}" for one in ("measured_speed", "cylinder_pressure")
          for axle, column in enumerate(signals.columns(signals.BY_NAME[one]), start=1)}
_SOURCES = tuple(_PLAIN.values())


@dataclass(frozen=True)
class Outgoing:
    """One message to the unit: which of its signals carries which quantity, times a factor."""

    message: DbcMessage
    sources: Mapping[str, str]
    factor: float


@dataclass(frozen=True)
class UnitMap:
    """A checked mapping."""

    outgoing: tuple[Outgoing, ...]
    incoming: DbcMessage
    hold: tuple[str, ...]
    vent: tuple[str, ...]
    reference: str
    reference_factor: float


def load(path: Path) -> UnitMap:
    """A mapping and its DBC. Raises ConfigError: unknown message or signal, identifier in use."""
    given = store.parse(path)
    _known(given, _KEYS, str(path))
    dbc = path.parent / str(given.get("dbc", ""))
    try:
        database: Any = cantools.database.load_file(dbc)
    except (OSError, cantools.Error, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: dbc = {given.get('dbc')!r}: cannot be read: {error}") from None
    outgoing = tuple(_outgoing(one, database, f"{path} [[to_unit]] {at}")
                     for at, one in enumerate(given.get("to_unit", []), start=1))
    back = given.get("from_unit")
    if not outgoing or not isinstance(back, dict):
        raise ConfigError(f"{path}: a mapping has at least one [[to_unit]] and one [from_unit]")
    where = f"{path} [from_unit]"
    _known(back, _FROM, where)
    incoming = _message(back, database, where)
    hold, vent = tuple(back.get("hold", ())), tuple(back.get("vent", ()))
    for key, names in (("hold", hold), ("vent", vent)):
        if len(names) != AXLES:
            raise ConfigError(f"{where}: {key} = {list(names)}: {AXLES} signals, one for each axle")
        _check_signals(names, incoming, f"{where}: {key}")
    reference = str(back.get("reference", ""))
    if reference:
        _check_signals((reference,), incoming, f"{where}: reference")
    return UnitMap(outgoing, incoming, hold, vent, reference,
                   float(back.get("reference_factor", 1.0)))


def _outgoing(given: Any, database: Any, where: str) -> Outgoing:
    _known(given, _TO, where)
    message = _message(given, database, where)
    sources = given.get("signals")
    if not isinstance(sources, dict) or not sources:
        raise ConfigError(f"{where}: signals = {sources!r}: write {{ V1 = \"measured_speed_1\" }}")
    _check_signals(tuple(sources), message, f"{where}: signals")
    for source in sources.values():
        if source not in _SOURCES:
            raise ConfigError(f"{where}: signals: '{source}'{nearest(str(source), _SOURCES)}")
    missing = sorted({one.name for one in message.signals} - set(sources))
    if missing:
        raise ConfigError(f"{where}: signals: {message.name} also has {', '.join(missing)}; map all")
    return Outgoing(message, dict(sources), float(given.get("factor", 1.0)))


def _message(given: Mapping[str, Any], database: Any, where: str) -> DbcMessage:
    name = given.get("message")
    found = {one.name: one for one in database.messages}
    if name not in found:
        raise ConfigError(f"{where}: message = {name!r}: the DBC has none called so"
                          f"{nearest(str(name), found)}")
    message = found[name]
    if not message.is_extended_frame and _is_taken(message.frame_id):
        raise ConfigError(f"{where}: {name} has the identifier {message.frame_id:X}h, which the rig "
                          "uses; give the unit another, or 29-bit identifiers")
    return message


def _is_taken(can_id: int) -> bool:
    """Whether the predefined connection set of the rig's nodes has an identifier."""
    return can_id in (NMT, SYNC, TIME, LSS_ANSWER, LSS_REQUEST) or (
        can_id & NODE_MASK in _NODES and can_id >> 7 in (*range(1, 13), 14))


def _known(given: Any, allowed: tuple[str, ...], where: str) -> None:
    if not isinstance(given, dict):
        raise ConfigError(f"{where}: a table is wanted")
    for key in given:
        if key not in allowed:
            raise ConfigError(f"{where}: unknown key '{key}'{nearest(key, allowed)}")


def _check_signals(names: tuple[str, ...], message: DbcMessage, where: str) -> None:
    there = [one.name for one in message.signals]
    for name in names:
        if name not in there:
            raise ConfigError(f"{where}: {message.name} has no signal '{name}'{nearest(name, there)}")


class Gateway:
    """Between a bus of the rig and a unit on the same bus. `run` returns when the bus ends."""

    def __init__(self, bus: can.BusABC, mapping: UnitMap) -> None:
        self.bus, self.mapping = bus, mapping
        self.values = dict.fromkeys(_SOURCES, 0.0)
        self.answers = 0
        self._syncs, self._stopping, self._alive = 0, False, False

    def stop(self) -> None:
        """Ask `run` to end; it does within 0.1 s."""
        self._stopping = True

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called."""
        try:
            quiet_s = 0.0
            while not self._stopping:
                if self._syncs == 0 and time.monotonic() >= quiet_s:
                    # no SYNC yet: the bench waits for a heartbeat, and the unit is asked for it
                    quiet_s = time.monotonic() + QUIET_S
                    self._tell_unit()
                    if self._alive:
                        self._send(UNIT_HEARTBEAT_ID, bytes([OPERATIONAL]))
                message = self.bus.recv(QUIET_S)
                if message is not None and message.arbitration_id == SYNC:
                    self._sync()
                elif message is not None:
                    self._take(message)
        except can.CanError:
            return

    def _sync(self) -> None:
        self._syncs += 1
        if self._syncs % HEARTBEAT_SYNCS == 0 and self._alive:
            self._send(UNIT_HEARTBEAT_ID, bytes([OPERATIONAL]))
            self._alive = False

    def _take(self, message: can.Message) -> None:
        can_id, data = message.arbitration_id, message.data
        if message.is_extended_id == self.mapping.incoming.is_extended_frame and (
                can_id == self.mapping.incoming.frame_id):
            self._answer(bytes(data))
            return
        for layout in (SPEEDS, PRESSURES):
            if can_id == layout.can_id and (found := layout.read(data)):
                self.values |= {_PLAIN[name]: value for name, value in found.items()}
                # pressures come last in a cycle: what the unit gets is then of one SYNC
                if layout is PRESSURES:
                    self._tell_unit()

    def _tell_unit(self) -> None:
        for one in self.mapping.outgoing:
            content = {name: one.factor * self.values[source] for name, source in one.sources.items()}
            data = one.message.encode(content, strict=False)
            self.bus.send(can.Message(arbitration_id=one.message.frame_id, data=data,
                                      is_extended_id=one.message.is_extended_frame))

    def _answer(self, data: bytes) -> None:
        try:
            message: Any = self.mapping.incoming.decode(data, decode_choices=False)
        except (cantools.Error, ValueError):
            return  # too short: as if it had not been sent
        self._alive = True
        mapping = self.mapping
        if mapping.reference:
            raw = signals.count(float(message[mapping.reference]) * mapping.reference_factor,
                                signals.place("wsp_reference_speed", WSP_NODE))
            self._send(REFERENCE_SPEED.can_id, REFERENCE_SPEED.struct.pack(raw))
        magnets = 0
        for at, (hold, vent) in enumerate(zip(mapping.hold, mapping.vent, strict=True)):
            magnets |= (bool(message[hold]) | bool(message[vent]) << 1) << 2 * at
        self._send(MAGNETS_ID, bytes([magnets]))
        self.answers += 1

    def _send(self, can_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def companion(path: Path) -> Callable[[str], AbstractContextManager[Gateway]]:
    """A gateway that runs beside a bench: call the result with the bus's address."""
    mapping = load(path)

    @contextlib.contextmanager
    def beside(address: str) -> Iterator[Gateway]:
        with buses.open_client(address) as bus:
            gateway = Gateway(bus, mapping)
            thread = threading.Thread(target=gateway.run, name="unit gateway", daemon=True)
            thread.start()
            try:
                yield gateway
            finally:
                gateway.stop()
                thread.join(2.0)

    return beside
