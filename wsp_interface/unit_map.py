"""A unit that speaks plain CAN messages of its own: a DBC file and a mapping lead it to the rig.

After each SYNC the gateway waits for the axle speeds of node 16, sends the unit its messages, encoded as the DBC says,
and turns the unit's answer into the magnets of node 17, its reference speed and the heartbeat of node 32. So such a
unit runs the same sequences, in lockstep too if it answers each of the last messages to it; one that keeps its own time
is for real time. A unit that is silent is soon without heartbeat, and the brakes apply. Before the first SYNC it is
asked with the speeds of a standing train until it answers.

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

from rollerrig.configs import store
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
    MAGNETS_ID,
    PRESSURES,
    REFERENCE_SPEED,
    SPEEDS,
    UNIT_HEARTBEAT_ID,
)
from rollerrig.wsp_interface.signals import AXLES, BENCH_NODE, WSP_NODE

OPERATIONAL, HEARTBEAT_SYNCS, QUIET_S = 5, 5, 0.1
_NODES = (*signals.RIG_NODES, WSP_NODE, BENCH_NODE)
_KEYS, _TO = ("title", "dbc", "to_unit", "from_unit"), ("message", "signals", "factor")
_FROM = ("message", "hold", "vent", "reference", "reference_factor")
# what a mapping calls the quantities: their columns without unit
_PLAIN = {
    column: f"{one}_{axle}"
    for one in ("measured_speed", "cylinder_pressure")
    for axle, column in enumerate(signals.columns(signals.BY_NAME[one]), start=1)
}
SOURCES = tuple(_PLAIN.values())
_BOTH_WAYS = "a mapping has at least one [[to_unit]] and one [from_unit]"


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


class Names(NamedTuple):
    """A mapping without messages: to each name of an input its quantity and factor, and the names of the outputs."""

    inputs: dict[str, tuple[str, float]]
    hold: tuple[str, ...]
    vent: tuple[str, ...]
    reference: str
    reference_factor: float


def names(path: Path) -> Names:
    """The mapping of an FMU. Raises ConfigError."""
    given = store.parse(path)
    known(
        given,
        ("title", "to_unit", "from_unit"),
        lambda key: f"{path}: the mapping of an FMU has no messages",
    )
    inputs: dict[str, tuple[str, float]] = {}
    for at, one in enumerate(given.get("to_unit", []), start=1):
        where = f"{path} [[to_unit]] {at}"
        known(one, _TO[1:], lambda key, where=where: where)
        inputs |= {
            name: (source, _factor(one, "factor", where))
            for name, source in _sources(one, where).items()
        }
    back = given.get("from_unit")
    if not inputs or not isinstance(back, dict):
        raise ConfigError(f"{path}: {_BOTH_WAYS}")
    where = f"{path} [from_unit]"
    known(back, _FROM[1:], lambda key: where)
    return Names(
        inputs,
        *_valves(back, where),
        str(back.get("reference", "")),
        _factor(back, "reference_factor", where),
    )


def load(path: Path) -> UnitMap:
    """A mapping and its DBC. Raises ConfigError: unknown message or signal, identifier in use."""
    given = store.parse(path)
    known(given, _KEYS, lambda key: str(path))
    dbc = path.parent / str(given.get("dbc", ""))
    try:
        database: Any = cantools.database.load_file(dbc)
    except (OSError, cantools.Error, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: dbc = {given.get('dbc')!r}: cannot be read: {error}") from None
    outgoing = tuple(
        _outgoing(one, database, f"{path} [[to_unit]] {at}")
        for at, one in enumerate(given.get("to_unit", []), start=1)
    )
    back = given.get("from_unit")
    if not outgoing or not isinstance(back, dict):
        raise ConfigError(f"{path}: {_BOTH_WAYS}")
    where = f"{path} [from_unit]"
    known(back, _FROM, lambda key: where)
    incoming = _message(back, database, where)
    hold, vent = _valves(back, where)
    _check_signals(hold, incoming, f"{where}: hold")
    _check_signals(vent, incoming, f"{where}: vent")
    reference = str(back.get("reference", ""))
    _check_signals((reference,) if reference else (), incoming, f"{where}: reference")
    return UnitMap(
        outgoing, incoming, hold, vent, reference, _factor(back, "reference_factor", where)
    )


def _outgoing(given: Any, database: Any, where: str) -> Outgoing:
    known(given, _TO, lambda key: where)
    message = _message(given, database, where)
    sources = _sources(given, where)
    _check_signals(tuple(sources), message, f"{where}: signals")
    missing = sorted({one.name for one in message.signals} - set(sources))
    if missing:
        raise ConfigError(
            f"{where}: signals: {message.name} also has {', '.join(missing)}; map all"
        )
    return Outgoing(message, dict(sources), _factor(given, "factor", where))


def _sources(given: Mapping[str, Any], where: str) -> dict[str, str]:
    """Which quantity each of the unit's signals carries."""
    sources = given.get("signals")
    if not isinstance(sources, dict) or not sources:
        raise ConfigError(f'{where}: signals = {sources!r}: write {{ V1 = "measured_speed_1" }}')
    for source in sources.values():
        if source not in SOURCES:
            raise ConfigError(f"{where}: signals: '{source}'{nearest(str(source), SOURCES)}")
    return dict(sources)


def _factor(given: Mapping[str, Any], key: str, where: str) -> float:
    factor = given.get(key, 1.0)
    if isinstance(factor, bool) or not isinstance(factor, int | float) or not factor:
        raise ConfigError(f"{where}: {key} = {factor!r}: a number, and not 0")
    return float(factor)


def _valves(back: Mapping[str, Any], where: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The unit's signals of hold and vent magnets, one for each axle."""
    for key in ("hold", "vent"):
        given = back.get(key)
        if not isinstance(given, list) or len(given) != AXLES:
            raise ConfigError(f"{where}: {key} = {given!r}: {AXLES} signals, one for each axle")
    return tuple(map(str, back["hold"])), tuple(map(str, back["vent"]))


def _message(given: Mapping[str, Any], database: Any, where: str) -> DbcMessage:
    name = given.get("message")
    found = {one.name: one for one in database.messages}
    if name not in found:
        raise ConfigError(
            f"{where}: message = {name!r}: the DBC has none called so{nearest(str(name), found)}"
        )
    message = found[name]
    if not message.is_extended_frame and (
        # the predefined connection set of the rig's nodes
        message.frame_id in (NMT, SYNC, TIME, LSS_ANSWER, LSS_REQUEST)
        or (message.frame_id & NODE_MASK in _NODES and message.frame_id >> 7 in (*range(1, 13), 14))
    ):
        raise ConfigError(
            f"{where}: {name} has the identifier {message.frame_id:X}h, which the rig "
            "uses; give the unit another, or 29-bit identifiers"
        )
    return message


def _check_signals(names: tuple[str, ...], message: DbcMessage, where: str) -> None:
    there = [one.name for one in message.signals]
    for name in names:
        if name not in there:
            raise ConfigError(
                f"{where}: {message.name} has no signal '{name}'{nearest(name, there)}"
            )


class Gateway:
    """Between a bus of the rig and a unit on the same bus. `run` returns when the bus ends."""

    def __init__(self, bus: can.BusABC, mapping: UnitMap) -> None:
        self.bus, self.mapping = bus, mapping
        self.values = dict.fromkeys(SOURCES, 0.0)
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
                if (message := self.bus.recv(QUIET_S)) is not None:
                    self._take(message)
        except can.CanError:
            return

    def _take(self, message: can.Message) -> None:
        can_id, data, incoming = message.arbitration_id, message.data, self.mapping.incoming
        if can_id == SYNC:
            self._syncs += 1
            if self._syncs % HEARTBEAT_SYNCS == 0 and self._alive:
                self._send(UNIT_HEARTBEAT_ID, bytes([OPERATIONAL]))
                self._alive = False
        elif (can_id, message.is_extended_id) == (incoming.frame_id, incoming.is_extended_frame):
            self._answer(bytes(data))
        elif found := next(
            (one.read(data) for one in (SPEEDS, PRESSURES) if one.can_id == can_id), None
        ):
            self.values |= {_PLAIN[name]: value for name, value in found.items()}
            # pressures come last in a cycle: what the unit gets is then of one SYNC
            if can_id == PRESSURES.can_id:
                self._tell_unit()

    def _tell_unit(self) -> None:
        for one in self.mapping.outgoing:
            content = {
                name: one.factor * self.values[source] for name, source in one.sources.items()
            }
            data = one.message.encode(content, strict=False)
            self.bus.send(
                can.Message(
                    arbitration_id=one.message.frame_id,
                    data=data,
                    is_extended_id=one.message.is_extended_frame,
                )
            )

    def _answer(self, data: bytes) -> None:
        try:
            message: Any = self.mapping.incoming.decode(data, decode_choices=False)
        except (cantools.Error, ValueError):
            return  # too short: as if it had not been sent
        self._alive, mapping = True, self.mapping
        if mapping.reference:
            raw = signals.count(
                float(message[mapping.reference]) * mapping.reference_factor,
                signals.place("wsp_reference_speed", WSP_NODE),
            )
            self._send(REFERENCE_SPEED.can_id, REFERENCE_SPEED.struct.pack(raw))
        pairs = []
        for hold, vent in zip(mapping.hold, mapping.vent, strict=True):
            pairs.append(magnets.pair(bool(message[hold]), bool(message[vent])))
        self._send(MAGNETS_ID, bytes([magnets.pack(pairs)]))
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
