"""Reads the mapping of a unit with its DBC, and refuses what cannot work on the rig's bus.

    dbc = "unit.dbc"
    [[to_unit]]
    message = "AXLE_SPEEDS"
    signals = { V1 = "measured_speed_1", V2 = "measured_speed_2" }
    factor = 1.602                # km/h for rad/s at a radius of 0.445 m
    constants = { MODE = 2 }      # optional: values in the unit of the signal
    counter = "ALIVE"             # optional: grows by 1 with each message
    checksum = { signal = "CRC", kind = "crc8_sae_j1850", prefix = [0x1A] }    # optional
    [from_unit]
    message = "VALVES"
    hold = ["HOLD1", "HOLD2", "HOLD3", "HOLD4"]
    vent = ["VENT1", "VENT2", "VENT3", "VENT4"]
    reference = "V_REF"           # optional
    reference_factor = 0.27778    # m/s of one unit of V_REF
    checksum = { signal = "CRC", kind = "crc8_sae_j1850" }    # optional: it is checked

A DBC is judged by its mapped messages only: what is wrong with another message does not matter.
Messages of CAN FD are refused, because the bus carries 8 bytes. An FMU has the same mapping without
`dbc`, `message` and what fills messages: the signals are variables of the FMU.

Source: cantools for the DBC.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cantools
from cantools.database.can import Message as DbcMessage

from rollerrig.configs import store, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import known, nearest
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.connection_set import (
    LSS_ANSWER,
    LSS_REQUEST,
    NMT,
    NODE_MASK,
    SYNC,
    TIME,
)
from rollerrig.wsp_interface.signals import BENCH_NODE, Table
from rollerrig.wsp_interface.unit_map import fields, own_bus
from rollerrig.wsp_interface.unit_map.fields import CHECKSUMS, Checksum, Filled

# the service codes of nodes in the predefined connection set: EMCY to SDO, and heartbeat
_SERVICES = (*range(1, 13), 14)
_SERVICE_BITS = 7  # the service code is above the bits of the node's number

_TOP_KEYS = ("title", "dbc", "bus", "to_unit", "from_unit")
_TO_UNIT_KEYS = ("message", "signals", "factor", "constants", "counter", "checksum")
_FMU_KEYS = ("hold", "vent", "reference", "reference_factor")
_FROM_UNIT_KEYS = ("message", *_FMU_KEYS, "checksum")
_CHECKSUM_KEYS = ("signal", "kind", "prefix")
_CAN_BYTES = 8
_BOTH_WAYS = "a mapping has at least one [[to_unit]] and one [from_unit]"

# signals of a DBC, and of one message in it
_MOST_SIGNALS = 20_000
_MOST_OF_MESSAGE = 1_000
# a text of a DBC, and the beginning of a message or a signal; its lines have no meaning
_DBC_TEXT = re.compile(r'"(\\"|[^"])*?"')
_DBC_BEGIN = re.compile(r"\b(?P<message>BO_)\s|\bSG_\s+\w+\s*(M|m\d+M?)?\s*:")

MEASURED_SPEED = "measured_speed"
_QUANTITIES = (MEASURED_SPEED, "cylinder_pressure")


def source_of_column(table: Table) -> dict[str, str]:
    """Return the names of the quantities in a mapping: their columns without the unit."""
    found = {}
    for name in _QUANTITIES:
        for axle, column in enumerate(signals.columns(table.by_name[name]), start=1):
            found[column] = f"{name}_{axle}"
    return found


def sources_of_group(unit_axles: int) -> tuple[str, ...]:
    """Return the quantities of a unit that protects one group, with its axles counted from 1."""
    axles = range(1, unit_axles + 1)
    return tuple(f"{name}_{axle}" for name in _QUANTITIES for axle in axles)


@dataclass(frozen=True)
class Outgoing:
    """One message to the unit: the source of each of its signals, times a factor, and the rest."""

    message: DbcMessage
    sources: Mapping[str, str]
    factor: float
    filled: Filled = field(default_factory=Filled)


@dataclass(frozen=True)
class UnitMap:
    """A checked mapping of a unit with CAN messages."""

    vehicle: Table  # the signals of the vehicle
    outgoing: tuple[Outgoing, ...]
    incoming: DbcMessage
    hold: tuple[str, ...]  # the unit's signals of the hold magnets, one for each axle
    vent: tuple[str, ...]
    reference: str  # the unit's signal of the reference speed; "" for none
    reference_factor: float  # m/s of one unit of that signal
    checksum: Checksum | None  # of the unit's message
    bus: str = ""  # address of the unit's own bus; "" for the bus of the rig


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


def load_fmu_map(path: Path, unit_axles: int) -> FmuMap:
    """Return the mapping of an FMU with variables for so many axles. Raises ConfigError."""
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
        for name, source in _sources(table, where, sources_of_group(unit_axles)).items():
            inputs[name] = (source, factor)

    from_unit = content.get("from_unit")
    if not inputs or not isinstance(from_unit, dict):
        raise ConfigError(f"{path}: {_BOTH_WAYS}")
    where = f"{path} [from_unit]"
    known(from_unit, _FMU_KEYS, lambda key: where)
    hold, vent = _magnets(from_unit, where, unit_axles)
    return FmuMap(
        inputs=inputs,
        hold=hold,
        vent=vent,
        reference=str(from_unit.get("reference", "")),
        reference_factor=_factor(from_unit, "reference_factor", where),
    )


def load(path: Path, vehicle: Table) -> UnitMap:
    """Return a mapping with its DBC, for the vehicle with these signals.

    Raises ConfigError for an unknown message or signal, or an identifier that the rig uses.
    """
    content = store.parse(path)
    known(content, _TOP_KEYS, lambda key: str(path))
    database = _database(path, content.get("dbc"))
    bus = own_bus.check(content.get("bus", ""), str(path))
    # on a bus of its own the unit may use each identifier
    taken = vehicle if not bus else None

    outgoing = []
    for number, table in enumerate(content.get("to_unit", []), start=1):
        where = f"{path} [[to_unit]] {number}"
        outgoing.append(_outgoing(table, database, where, vehicle, taken))

    from_unit = content.get("from_unit")
    if not outgoing or not isinstance(from_unit, dict):
        raise ConfigError(f"{path}: {_BOTH_WAYS}")
    where = f"{path} [from_unit]"
    known(from_unit, _FROM_UNIT_KEYS, lambda key: where)
    incoming = _message(from_unit, database, where, taken)
    hold, vent = _magnets(from_unit, where, vehicle.kind.axles)
    _check_signals(hold, incoming, f"{where}: hold")
    _check_signals(vent, incoming, f"{where}: vent")
    reference = str(from_unit.get("reference", ""))
    if reference:
        _check_signals((reference,), incoming, f"{where}: reference")
    return UnitMap(
        vehicle=vehicle,
        outgoing=tuple(outgoing),
        incoming=incoming,
        hold=hold,
        vent=vent,
        reference=reference,
        reference_factor=_factor(from_unit, "reference_factor", where),
        checksum=_checksum(from_unit, incoming, where),
        bus=bus,
    )


def _database(path: Path, name: Any) -> Any:
    """Return the DBC of a mapping; its path is relative to the mapping.

    The messages are not checked yet, because only the mapped ones matter. Comments and units may
    be in any encoding, because nothing here depends on them.
    """
    dbc = path.parent / ("" if name is None else str(name))
    try:
        content = user_files.read_bytes(dbc, user_files.MESSAGES)
        if dbc.suffix.lower() != ".dbc":
            return cantools.database.load_file(dbc, strict=False)
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252", errors="replace")
        _check_sizes(text)
        return cantools.database.load_string(text, "dbc", strict=False)
    except (ConfigError, OSError, cantools.Error, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: dbc = {name!r}: cannot be read: {error}") from None


def _check_sizes(text: str) -> None:
    """Raise ConfigError if a DBC has so many signals that cantools takes minutes for it.

    It compares each multiplexed signal of a message with all others.
    """
    in_all = 0
    in_message = 0
    for begin in _DBC_BEGIN.finditer(_DBC_TEXT.sub("", text)):
        if begin["message"]:
            in_message = 0
            continue
        in_all += 1
        in_message += 1
        if in_all > _MOST_SIGNALS or in_message > _MOST_OF_MESSAGE:
            raise ConfigError(
                f"it has more than {_MOST_SIGNALS} signals, or a message with more than "
                f"{_MOST_OF_MESSAGE}; keep the messages of the unit only"
            )


def _outgoing(
    table: Any, database: Any, where: str, vehicle: Table, taken: Table | None
) -> Outgoing:
    known(table, _TO_UNIT_KEYS, lambda key: where)
    message = _message(table, database, where, taken)
    sources = _sources(table, where, tuple(source_of_column(vehicle).values()))
    _check_signals(tuple(sources), message, f"{where}: signals")
    filled = Filled(
        constants=_constants(table, message, where),
        counter=_counter(table, message, where),
        checksum=_checksum(table, message, where),
    )

    given = [*sources, *filled.names()]
    twice = sorted({name for name in given if given.count(name) > 1})
    if twice:
        raise ConfigError(f"{where}: {', '.join(twice)} is given twice; a signal has one content")
    for signal in message.signals:
        multiplexer = signal.multiplexer_signal
        if multiplexer is not None and multiplexer not in filled.constants:
            raise ConfigError(
                f"{where}: {message.name} is multiplexed by {multiplexer}; choose a group with "
                f"constants = {{ {multiplexer} = 0 }}, in a separate [[to_unit]] for each group"
            )
    carried = fields.selected_signals(message, filled.constants)
    surplus = sorted(set(given) - set(carried))
    if surplus:
        raise ConfigError(
            f"{where}: {', '.join(surplus)} is not in the multiplexed group that constants "
            "select; give each group a separate [[to_unit]]"
        )
    missing = sorted(set(carried) - set(given))
    if missing:
        raise ConfigError(
            f"{where}: signals: {message.name} also has {', '.join(missing)}; map all: quantities "
            "in signals, fixed values in constants = { NAME = 0 }, an alive counter in counter = "
            '"NAME", a checksum in checksum = { signal = "NAME", kind = "crc8_sae_j1850" }'
        )
    try:
        fields.encode(message, dict.fromkeys(carried, 0) | _raw_constants(message, filled))
    except (cantools.Error, ValueError) as error:
        raise ConfigError(f"{where}: {message.name} cannot be encoded: {error}") from None
    return Outgoing(message, sources, _factor(table, "factor", where), filled)


def _raw_constants(message: DbcMessage, filled: Filled) -> dict[str, float]:
    """Return the raw values of the constants of a message."""
    raw_values = {}
    for name, value in filled.constants.items():
        raw_values[name], _ = fields.limited(fields.signal_of(message, name), value)
    return raw_values


def _constants(table: Mapping[str, Any], message: DbcMessage, where: str) -> dict[str, float]:
    """Return the fixed values of a message by signal. Raises ConfigError if one does not fit."""
    constants = table.get("constants", {})
    where = f"{where}: constants"
    if not isinstance(constants, dict):
        raise ConfigError(f"{where} = {constants!r}: write {{ MODE = 2 }}")
    _check_signals(tuple(constants), message, where)
    checked = {}
    for name, value in constants.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{where}: {name} = {value!r}: allowed is a number")
        signal = fields.signal_of(message, name)
        _, was_limited = fields.limited(signal, value)
        if was_limited:
            low, high = fields.raw_range(signal)
            ends = sorted(signal.offset + signal.scale * raw for raw in (low, high))
            raise ConfigError(f"{where}: {name} = {value!r}: allowed is {ends[0]:g} to {ends[1]:g}")
        checked[name] = float(value)
    return checked


def _counter(table: Mapping[str, Any], message: DbcMessage, where: str) -> str:
    """Return the signal of the alive counter; "" if there is none. Raises ConfigError."""
    name = table.get("counter", "")
    if not isinstance(name, str):
        raise ConfigError(f'{where}: counter = {name!r}: write counter = "ALIVE"')
    if not name:
        return ""
    _check_signals((name,), message, f"{where}: counter")
    if fields.signal_of(message, name).is_float:
        raise ConfigError(f"{where}: counter: {name} is a floating-point signal; take an integer")
    return name


def _checksum(table: Mapping[str, Any], message: DbcMessage, where: str) -> Checksum | None:
    """Return the checksum of a message; None if there is none. Raises ConfigError."""
    given = table.get("checksum")
    if given is None:
        return None
    where = f"{where}: checksum"
    if not isinstance(given, dict):
        raise ConfigError(f'{where} = {given!r}: write {{ signal = "CRC", kind = "sum8" }}')
    known(given, _CHECKSUM_KEYS, lambda key: where)
    name = str(given.get("signal", ""))
    _check_signals((name,), message, where)
    kind = given.get("kind")
    if kind not in CHECKSUMS:
        raise ConfigError(f"{where}: kind = {kind!r}{nearest(str(kind), CHECKSUMS)}")

    bits = fields.checksum_bits(kind)
    signal = fields.signal_of(message, name)
    whole_bytes = fields.occupied_bytes(message, name)
    if signal.length != bits or not whole_bytes or signal.is_signed or signal.is_float:
        raise ConfigError(
            f"{where}: {kind} has {bits} bits, and {name} {signal.length} at bit {signal.start}; "
            f"allowed is an unsigned signal of {bits} bits that fills whole bytes"
        )
    prefix = given.get("prefix", [])
    is_list = isinstance(prefix, list)
    if not is_list or not all(type(byte) is int and 0 <= byte <= 255 for byte in prefix):
        raise ConfigError(f"{where}: prefix = {prefix!r}: allowed is a list of bytes from 0 to 255")
    return Checksum(name, kind, bytes(prefix))


def _sources(table: Mapping[str, Any], where: str, allowed: tuple[str, ...]) -> dict[str, str]:
    """Return the source of each of the unit's signals, one of the allowed sources."""
    sources = table.get("signals")
    if not isinstance(sources, dict) or not sources:
        raise ConfigError(f'{where}: signals = {sources!r}: write {{ V1 = "measured_speed_1" }}')
    for source in sources.values():
        if source not in allowed:
            raise ConfigError(f"{where}: signals: '{source}'{nearest(str(source), allowed)}")
    return dict(sources)


def _factor(table: Mapping[str, Any], key: str, where: str) -> float:
    factor = table.get(key, 1.0)
    is_number = isinstance(factor, int | float) and not isinstance(factor, bool)
    if not is_number or factor == 0:
        raise ConfigError(f"{where}: {key} = {factor!r}: allowed is a number that is not 0")
    return float(factor)


def _magnets(
    from_unit: Mapping[str, Any], where: str, axles: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the unit's signals of the hold and of the vent magnets, one for each axle."""
    for key in ("hold", "vent"):
        names = from_unit.get(key)
        if not isinstance(names, list) or len(names) != axles:
            raise ConfigError(f"{where}: {key} = {names!r}: {axles} signals, one for each axle")
    hold = tuple(str(name) for name in from_unit["hold"])
    vent = tuple(str(name) for name in from_unit["vent"])
    return hold, vent


def _message(
    table: Mapping[str, Any], database: Any, where: str, taken: Table | None
) -> DbcMessage:
    """Return the message of a table. Raises ConfigError when a vehicle's rig uses its identifier.

    `taken`: the signals of the vehicle on the same bus; None: the unit has a bus of its own.
    """
    name = table.get("message")
    messages: dict[str, DbcMessage] = {}
    for message in database.messages:
        if message.name == name and name in messages:
            raise ConfigError(f"{where}: message = {name!r}: the DBC has two messages of that name")
        messages[message.name] = message
    if name not in messages:
        raise ConfigError(
            f"{where}: message = {name!r}: the DBC has no such message"
            f"{nearest(str(name), messages)}"
        )
    message = messages[name]
    if message.length > _CAN_BYTES or message.is_fd:
        raise ConfigError(
            f"{where}: {name} has {message.length} bytes, so it is a message of CAN FD; the rig's "
            f"bus carries classic CAN, at most {_CAN_BYTES} bytes: give the unit such messages"
        )
    try:
        # what load_file(strict=True) checks of every message of a DBC
        message.refresh(strict=True)
    except (cantools.Error, ValueError) as error:
        raise ConfigError(f"{where}: message = {name!r}: {error}; correct the DBC") from None
    if taken is not None and _is_used_by_rig(message, taken):
        raise ConfigError(
            f"{where}: {name} has the identifier {message.frame_id:X}h, which the rig "
            f'uses{_group_of(message, taken)}; write bus = "{own_bus.OWN}" above the tables, and the '
            "unit has a bus of its own"
        )
    return message


def _is_used_by_rig(message: DbcMessage, vehicle: Table) -> bool:
    """Return whether a message is in the predefined connection set of the rig's nodes."""
    if message.is_extended_frame:
        return False
    can_id = message.frame_id
    if can_id in (NMT, SYNC, TIME, LSS_ANSWER, LSS_REQUEST):
        return True
    # a further group has a TPDO of the harness with the identifiers of a node below node 127
    of_bench = range(BENCH_NODE - vehicle.kind.groups + 1, BENCH_NODE + 1)
    nodes = (*vehicle.rig_nodes, *vehicle.wsp_nodes, *of_bench)
    return can_id & NODE_MASK in nodes and can_id >> _SERVICE_BITS in _SERVICES


def _group_of(message: DbcMessage, vehicle: Table) -> str:
    """Return which group of axles uses the identifier of a message, where there are several."""
    node = message.frame_id & NODE_MASK
    if vehicle.kind.groups == 1 or node not in (*vehicle.rig_nodes, *vehicle.wsp_nodes):
        return ""
    axles = vehicle.axles_of(signals.group_of(node))
    return f" for group {signals.group_of(node) + 1} (axles {axles[0]} to {axles[-1]})"


def _check_signals(names: tuple[str, ...], message: DbcMessage, where: str) -> None:
    present = [signal.name for signal in message.signals]
    for name in names:
        if name not in present:
            raise ConfigError(
                f"{where}: {message.name} has no signal '{name}'{nearest(name, present)}"
            )
