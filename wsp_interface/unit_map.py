"""A unit with its own plain CAN messages: a DBC file and a mapping connect it to the rig.

A gateway translates between the unit and the rig. After each SYNC it waits for the axle speeds of
node 16 and sends the unit its messages, encoded as in the DBC. It turns the unit's answer into the
magnets of node 17, the unit's reference speed and the heartbeat of node 32. So such a unit runs the
same sequences. In lockstep it must answer the last message of each cycle; a unit that keeps its own
time is for real time only. If the unit is silent, its heartbeat stops and the brakes apply. If a
signal of the unit is no finite number, the unit has failed: the gateway sends its EMCY FF02h, its
heartbeat stops for the rest of the run, and no magnet is energised. Before the first SYNC the
gateway sends the speeds of a standing train until the unit answers.

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

An FMU has the same mapping without `dbc` and `message`: the signals are variables of the FMU.

Source: cantools for the DBC.
"""

import contextlib
import math
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import can
import cantools
from cantools.database.can import Message as DbcMessage

from rollerrig.configs import store, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import known, nearest
from rollerrig.wsp_interface import magnets, signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import (
    LSS_ANSWER,
    LSS_REQUEST,
    NMT,
    NODE_MASK,
    SYNC,
    TIME,
)
from rollerrig.wsp_interface.rig_objects import (
    GENERIC_ERROR,
    MAGNETS_ID,
    PRESSURES,
    REFERENCE_SPEED,
    SPEEDS,
    UNIT_EMERGENCY_ID,
    UNIT_HAS_FAILED,
    UNIT_HEARTBEAT_ID,
)
from rollerrig.wsp_interface.signals import AXLES, BENCH_NODE, WSP_NODE

OPERATIONAL = 5  # NMT state in a heartbeat
HEARTBEAT_SYNCS = 5  # SYNCs between two heartbeats
QUIET_S = 0.1

# data of frames for a unit that has failed: magnets that are all off, and the EMCY
_NO_MAGNETS = bytes([magnets.ALL_OFF])
_FAILED = struct.pack("<HB5x", UNIT_HAS_FAILED, GENERIC_ERROR)

_NODES = (*signals.RIG_NODES, WSP_NODE, BENCH_NODE)
# the service codes of nodes in the predefined connection set: EMCY to SDO, and heartbeat
_SERVICES = (*range(1, 13), 14)
_SERVICE_BITS = 7  # the service code is above the bits of the node's number

_TOP_KEYS = ("title", "dbc", "to_unit", "from_unit")
_TO_UNIT_KEYS = ("message", "signals", "factor")
_FROM_UNIT_KEYS = ("message", "hold", "vent", "reference", "reference_factor")
_BOTH_WAYS = "a mapping has at least one [[to_unit]] and one [from_unit]"

# the names of the quantities in a mapping: their columns without the unit
_SOURCE_OF_COLUMN = {
    column: f"{name}_{axle}"
    for name in ("measured_speed", "cylinder_pressure")
    for axle, column in enumerate(signals.columns(signals.BY_NAME[name]), start=1)
}
SOURCES = tuple(_SOURCE_OF_COLUMN.values())


@dataclass(frozen=True)
class Outgoing:
    """One message to the unit: the source of each of its signals, times a factor."""

    message: DbcMessage
    sources: Mapping[str, str]
    factor: float


@dataclass(frozen=True)
class UnitMap:
    """A checked mapping of a unit with CAN messages."""

    outgoing: tuple[Outgoing, ...]
    incoming: DbcMessage
    hold: tuple[str, ...]  # the unit's signals of the hold magnets, one for each axle
    vent: tuple[str, ...]
    reference: str  # the unit's signal of the reference speed; "" for none
    reference_factor: float  # m/s of one unit of that signal


class FmuMap(NamedTuple):
    """A mapping without messages.

    `inputs` holds the source and the factor of each input of the FMU; the other fields are as in
    `UnitMap`, with names of the FMU's outputs.
    """

    inputs: dict[str, tuple[str, float]]
    hold: tuple[str, ...]
    vent: tuple[str, ...]
    reference: str
    reference_factor: float


def load_fmu_map(path: Path) -> FmuMap:
    """Return the mapping of an FMU. Raises ConfigError."""
    content = store.parse(path)
    known(
        content,
        ("title", "to_unit", "from_unit"),
        lambda key: f"{path}: the mapping of an FMU has no messages",
    )
    inputs: dict[str, tuple[str, float]] = {}
    for number, table in enumerate(content.get("to_unit", []), start=1):
        where = f"{path} [[to_unit]] {number}"
        known(table, ("signals", "factor"), lambda key, where=where: where)
        factor = _factor(table, "factor", where)
        for name, source in _sources(table, where).items():
            inputs[name] = (source, factor)

    from_unit = content.get("from_unit")
    if not inputs or not isinstance(from_unit, dict):
        raise ConfigError(f"{path}: {_BOTH_WAYS}")
    where = f"{path} [from_unit]"
    known(from_unit, _FROM_UNIT_KEYS[1:], lambda key: where)
    hold, vent = _magnets(from_unit, where)
    return FmuMap(
        inputs=inputs,
        hold=hold,
        vent=vent,
        reference=str(from_unit.get("reference", "")),
        reference_factor=_factor(from_unit, "reference_factor", where),
    )


def load(path: Path) -> UnitMap:
    """Return a mapping with its DBC.

    Raises ConfigError for an unknown message or signal, or an identifier that the rig uses.
    """
    content = store.parse(path)
    known(content, _TOP_KEYS, lambda key: str(path))
    database = _database(path, content.get("dbc"))

    outgoing = []
    for number, table in enumerate(content.get("to_unit", []), start=1):
        outgoing.append(_outgoing(table, database, f"{path} [[to_unit]] {number}"))

    from_unit = content.get("from_unit")
    if not outgoing or not isinstance(from_unit, dict):
        raise ConfigError(f"{path}: {_BOTH_WAYS}")
    where = f"{path} [from_unit]"
    known(from_unit, _FROM_UNIT_KEYS, lambda key: where)
    incoming = _message(from_unit, database, where)
    hold, vent = _magnets(from_unit, where)
    _check_signals(hold, incoming, f"{where}: hold")
    _check_signals(vent, incoming, f"{where}: vent")
    reference = str(from_unit.get("reference", ""))
    if reference:
        _check_signals((reference,), incoming, f"{where}: reference")
    return UnitMap(
        outgoing=tuple(outgoing),
        incoming=incoming,
        hold=hold,
        vent=vent,
        reference=reference,
        reference_factor=_factor(from_unit, "reference_factor", where),
    )


def _database(path: Path, name: Any) -> Any:
    """Return the DBC of a mapping; its path is relative to the mapping."""
    dbc = path.parent / ("" if name is None else str(name))
    try:
        user_files.check(dbc, user_files.MESSAGES)
        return cantools.database.load_file(dbc)
    except (ConfigError, OSError, cantools.Error, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: dbc = {name!r}: cannot be read: {error}") from None


def _outgoing(table: Any, database: Any, where: str) -> Outgoing:
    known(table, _TO_UNIT_KEYS, lambda key: where)
    message = _message(table, database, where)
    sources = _sources(table, where)
    _check_signals(tuple(sources), message, f"{where}: signals")
    missing = sorted({signal.name for signal in message.signals} - set(sources))
    if missing:
        raise ConfigError(
            f"{where}: signals: {message.name} also has {', '.join(missing)}; map all"
        )
    return Outgoing(message, sources, _factor(table, "factor", where))


def _sources(table: Mapping[str, Any], where: str) -> dict[str, str]:
    """Return the source of each of the unit's signals."""
    sources = table.get("signals")
    if not isinstance(sources, dict) or not sources:
        raise ConfigError(f'{where}: signals = {sources!r}: write {{ V1 = "measured_speed_1" }}')
    for source in sources.values():
        if source not in SOURCES:
            raise ConfigError(f"{where}: signals: '{source}'{nearest(str(source), SOURCES)}")
    return dict(sources)


def _factor(table: Mapping[str, Any], key: str, where: str) -> float:
    factor = table.get(key, 1.0)
    is_number = isinstance(factor, int | float) and not isinstance(factor, bool)
    if not is_number or factor == 0:
        raise ConfigError(f"{where}: {key} = {factor!r}: allowed is a number that is not 0")
    return float(factor)


def _magnets(from_unit: Mapping[str, Any], where: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the unit's signals of the hold and of the vent magnets, one for each axle."""
    for key in ("hold", "vent"):
        names = from_unit.get(key)
        if not isinstance(names, list) or len(names) != AXLES:
            raise ConfigError(f"{where}: {key} = {names!r}: {AXLES} signals, one for each axle")
    hold = tuple(str(name) for name in from_unit["hold"])
    vent = tuple(str(name) for name in from_unit["vent"])
    return hold, vent


def _message(table: Mapping[str, Any], database: Any, where: str) -> DbcMessage:
    """Return the message of a table. Raises ConfigError when the rig uses its identifier."""
    name = table.get("message")
    messages = {message.name: message for message in database.messages}
    if name not in messages:
        raise ConfigError(
            f"{where}: message = {name!r}: the DBC has no such message"
            f"{nearest(str(name), messages)}"
        )
    message = messages[name]
    if _is_used_by_rig(message):
        raise ConfigError(
            f"{where}: {name} has the identifier {message.frame_id:X}h, which the rig "
            "uses; give the unit another, or 29-bit identifiers"
        )
    return message


def _is_used_by_rig(message: DbcMessage) -> bool:
    """Return whether a message is in the predefined connection set of the rig's nodes."""
    if message.is_extended_frame:
        return False
    can_id = message.frame_id
    if can_id in (NMT, SYNC, TIME, LSS_ANSWER, LSS_REQUEST):
        return True
    return can_id & NODE_MASK in _NODES and can_id >> _SERVICE_BITS in _SERVICES


def _check_signals(names: tuple[str, ...], message: DbcMessage, where: str) -> None:
    present = [signal.name for signal in message.signals]
    for name in names:
        if name not in present:
            raise ConfigError(
                f"{where}: {message.name} has no signal '{name}'{nearest(name, present)}"
            )


class Gateway:
    """Translates between the rig and a unit on the same bus. `run` returns when the bus ends.

    `values` holds the quantities of the rig by source, `answers` counts the unit's answers.
    `failure` is the reason why the unit has failed; it is empty as long as it has not.
    """

    def __init__(self, bus: can.BusABC, mapping: UnitMap) -> None:
        self.bus = bus
        self.mapping = mapping
        self.values = dict.fromkeys(SOURCES, 0.0)
        self.answers = 0
        self.failure = ""
        self._syncs = 0
        self._stopping = False
        self._alive = False  # the unit has answered since the last heartbeat

    def stop(self) -> None:
        """Make `run` return within 0.1 s."""
        self._stopping = True

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called."""
        try:
            next_poll_s = 0.0
            while not self._stopping:
                if self._syncs == 0 and time.monotonic() >= next_poll_s:
                    # before the first SYNC the bench waits for a heartbeat of the unit
                    next_poll_s = time.monotonic() + QUIET_S
                    self._send_to_unit()
                    if self._alive:
                        self._send_heartbeat()
                message = self.bus.recv(QUIET_S)
                if message is not None:
                    self._take(message)
        except can.CanError:
            return

    def _take(self, message: can.Message) -> None:
        incoming = self.mapping.incoming
        can_id = message.arbitration_id
        if can_id == SYNC:
            self._syncs += 1
            if self._syncs % HEARTBEAT_SYNCS == 0 and self._alive:
                self._send_heartbeat()
                self._alive = False
        elif can_id == incoming.frame_id and message.is_extended_id == incoming.is_extended_frame:
            self._translate_answer(bytes(message.data))
        elif can_id == SPEEDS.can_id:
            self._store(SPEEDS.read(message.data))
        elif can_id == PRESSURES.can_id:
            values = PRESSURES.read(message.data)
            self._store(values)
            if values:
                # pressures come last in a cycle, so all values are now of the same SYNC
                self._send_to_unit()

    def _store(self, values: Mapping[str, float]) -> None:
        for column, value in values.items():
            self.values[_SOURCE_OF_COLUMN[column]] = value

    def _send_to_unit(self) -> None:
        for outgoing in self.mapping.outgoing:
            content = {
                name: outgoing.factor * self.values[source]
                for name, source in outgoing.sources.items()
            }
            message = outgoing.message
            self.bus.send(
                can.Message(
                    arbitration_id=message.frame_id,
                    data=message.encode(content, strict=False),
                    is_extended_id=message.is_extended_frame,
                )
            )

    def _translate_answer(self, data: bytes) -> None:
        """Send the rig the unit's reference speed and magnets."""
        mapping = self.mapping
        try:
            content: Any = mapping.incoming.decode(data, decode_choices=False)
        except (cantools.Error, ValueError):
            return  # too short: the rig treats it as no answer
        if not self.failure:
            self._check(content)
        if self.failure:
            self._send(MAGNETS_ID, _NO_MAGNETS)
            return
        self._alive = True

        if mapping.reference:
            raw = signals.count(
                float(content[mapping.reference]) * mapping.reference_factor,
                signals.place("wsp_reference_speed", WSP_NODE),
            )
            self._send(REFERENCE_SPEED.can_id, REFERENCE_SPEED.struct.pack(raw))

        pairs = []
        for hold, vent in zip(mapping.hold, mapping.vent, strict=True):
            pairs.append(magnets.pair(bool(content[hold]), bool(content[vent])))
        self._send(MAGNETS_ID, bytes([magnets.pack(pairs)]))
        self.answers += 1

    def _check(self, content: Mapping[str, Any]) -> None:
        """Notice, and report by an EMCY, a signal of the unit that is no finite number."""
        mapping = self.mapping
        names = (*mapping.hold, *mapping.vent, *filter(None, (mapping.reference,)))
        for name in names:
            if not math.isfinite(content[name]):
                self.failure = (
                    f"the unit has failed: its signal {name} in {mapping.incoming.name} is "
                    f"{content[name]}; allowed are finite numbers"
                )
                self._send(UNIT_EMERGENCY_ID, _FAILED)
                return

    def _send_heartbeat(self) -> None:
        self._send(UNIT_HEARTBEAT_ID, bytes([OPERATIONAL]))

    def _send(self, can_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def companion(path: Path) -> Callable[[str], AbstractContextManager[Gateway]]:
    """Return a context manager that runs a gateway during a bench, given the address of its bus."""
    mapping = load(path)

    @contextlib.contextmanager
    def run_gateway(address: str) -> Iterator[Gateway]:
        with buses.open_client(address) as bus:
            gateway = Gateway(bus, mapping)
            thread = threading.Thread(target=gateway.run, name="unit gateway", daemon=True)
            thread.start()
            try:
                yield gateway
            finally:
                gateway.stop()
                thread.join(2.0)

    return run_gateway
