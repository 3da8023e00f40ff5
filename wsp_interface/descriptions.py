"""Files that tell other tools what stands on the bus: EDS for each node, one DBC, the signal table.

Everything is written from the object dictionaries and from the table of signals, so a description
cannot say anything else than the device. An EDS file carries what strict parsers ask for: mapping
flags as 0 or 1, and the numbers of objects and PDOs. Source: CiA 306-1 (EDS); the DBC keywords as
cantools reads them.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import connection_set

_VAR, _ARRAY, _RECORD, _DOMAIN = 0x7, 0x8, 0x9, 0x2
_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_INVALID, _EXTENDED = 1 << 31, 1 << 29
_MANDATORY = (0x1000, 0x1001, 0x1018)
_MANUFACTURER = range(0x2000, 0x6000)
# data types that a receive PDO may carry as fillers
_DUMMIES = (2, 3, 4, 5, 6, 7)
# fixed, so that the same dictionary gives the same file
_DATE, _TIME = "01-01-2025", "12:00PM"


# -- EDS

def eds(dictionary: ObjectDictionary) -> str:
    """The EDS file of a node, as text."""
    about = dictionary.device_information
    head: dict[str, dict[str, object]] = {
        "FileInfo": {
            "FileName": f"{file_name(dictionary)}.eds", "FileVersion": 1, "FileRevision": 1,
            "EDSVersion": "4.0", "Description": about.product_name, "CreationTime": _TIME,
            "CreationDate": _DATE, "CreatedBy": about.vendor_name, "ModificationTime": _TIME,
            "ModificationDate": _DATE, "ModifiedBy": about.vendor_name,
        },
        "DeviceInfo": _device_info(dictionary),
        "DummyUsage": {f"Dummy{kind:04d}": int(kind in _DUMMIES) for kind in range(1, 8)},
        "Comments": {"Lines": 0},
    }
    sections = [*head.items(), *_object_sections(dictionary)]
    return "\n".join(
        f"[{name}]\n" + "".join(f"{option}={value}\n" for option, value in body.items())
        for name, body in sections)


def file_name(dictionary: ObjectDictionary) -> str:
    """The name of a node's files, without suffix: its number and what it is."""
    product = dictionary.device_information.product_name or "node"
    return f"node_{dictionary.node_id:03d}_{_slug(product)}"


def _device_info(dictionary: ObjectDictionary) -> dict[str, object]:
    about = dictionary.device_information
    found: dict[str, object] = {
        "VendorName": about.vendor_name, "VendorNumber": f"0x{about.vendor_number:08X}",
        "ProductName": about.product_name, "ProductNumber": f"0x{about.product_number:08X}",
        "RevisionNumber": f"0x{about.revision_number:08X}", "OrderCode": about.order_code,
    }
    found |= {f"BaudRate_{rate}": int(rate * 1000 in about.allowed_baudrates)
              for rate in _BAUD_RATES}
    return found | {
        "SimpleBootUpMaster": int(bool(about.simple_boot_up_master)),
        "SimpleBootUpSlave": int(bool(about.simple_boot_up_slave)),
        "Granularity": int(about.granularity or 0),
        "DynamicChannelsSupported": int(bool(about.dynamic_channels_supported)),
        "CompactPDO": 0, "GroupMessaging": int(bool(about.group_messaging)),
        "NrOfRXPDO": int(about.nr_of_RXPDO or 0), "NrOfTXPDO": int(about.nr_of_TXPDO or 0),
        "LSS_Supported": int(bool(about.LSS_supported)),
    }


def _object_sections(dictionary: ObjectDictionary) -> Iterator[tuple[str, dict[str, object]]]:
    groups = {
        "MandatoryObjects": [at for at in dictionary if at in _MANDATORY],
        "OptionalObjects": [at for at in dictionary
                            if at not in _MANDATORY and at not in _MANUFACTURER],
        "ManufacturerObjects": [at for at in dictionary if at in _MANUFACTURER],
    }
    for name, indices in groups.items():
        listed: dict[str, object] = {"SupportedObjects": len(indices)}
        yield name, listed | {str(at): f"0x{index:04X}" for at, index in enumerate(indices, 1)}
        for index in indices:
            yield from _sections_of(index, dictionary[index])


def _sections_of(index: int, thing: ODVariable | ODArray | ODRecord
                 ) -> Iterator[tuple[str, dict[str, object]]]:
    if isinstance(thing, ODVariable):
        yield f"{index:04X}", _variable_section(thing)
        return
    kind = _RECORD if isinstance(thing, ODRecord) else _ARRAY
    yield f"{index:04X}", {"ParameterName": thing.name, "ObjectType": f"0x{kind:X}",
                           "SubNumber": len(thing.subindices)}
    for sub in sorted(thing.subindices):
        yield f"{index:04X}sub{sub:X}", _variable_section(thing.subindices[sub])


def _variable_section(variable: ODVariable) -> dict[str, object]:
    kind = _DOMAIN if variable.data_type == datatypes.DOMAIN else _VAR
    found: dict[str, object] = {
        "ParameterName": variable.name, "ObjectType": f"0x{kind:X}",
        "DataType": f"0x{variable.data_type:04X}", "AccessType": variable.access_type,
        "DefaultValue": _default(variable), "PDOMapping": int(variable.pdo_mappable),
    }
    if variable.min is not None:
        found["LowLimit"] = variable.min
    if variable.max is not None:
        found["HighLimit"] = variable.max
    # beyond the standard, and read by canopen: the value of one count
    if variable.factor != 1:
        found["Factor"] = f"{variable.factor:.12g}"
    if variable.unit:
        found["Unit"] = variable.unit
    if variable.description:
        found["Description"] = variable.description.replace(";", ",")
    return found


def _default(variable: ODVariable) -> str:
    if variable.relative:
        return str(getattr(variable, "default_raw"))  # noqa: B009
    if isinstance(variable.default, bool):
        return str(int(variable.default))
    if isinstance(variable.default, int) and variable.index < 0x2000 and variable.default > 9:
        return f"0x{variable.default:X}"
    return str(variable.default)


# -- DBC

class Carried(NamedTuple):
    """One signal in a message: `start` in bits, `factor` and `unit` of one count."""

    name: str
    start: int
    bits: int
    signed: bool
    factor: float
    unit: str
    text: str


class Message(NamedTuple):
    """One PDO as a CAN message; `transmits`: sent by the node (a TPDO)."""

    name: str
    can_id: int
    extended: bool
    node: int
    transmits: bool
    carried: tuple[Carried, ...]


def messages(dictionary: ObjectDictionary) -> list[Message]:
    """The PDOs that a node has by default."""
    found = []
    for first, word in ((0x1400, "RPDO"), (0x1800, "TPDO")):
        for index in (at for at in dictionary if first <= at < first + 0x200):
            cob_id = _number(dictionary, index, 1)
            if cob_id & _INVALID or not _number(dictionary, index + 0x200, 0):
                continue
            name = f"node_{_node(dictionary)}_{word}{index - first + 1}"
            found.append(Message(name, cob_id & 0x1FFFFFFF, bool(cob_id & _EXTENDED),
                                 _node(dictionary), word == "TPDO",
                                 tuple(_contents(dictionary, index + 0x200))))
    return found


def _node(dictionary: ObjectDictionary) -> int:
    return dictionary.node_id or 0


def _number(dictionary: ObjectDictionary, index: int, sub: int) -> int:
    """The default of an integer object; 0 where there is none."""
    variable = dictionary.get_variable(index, sub)
    return 0 if variable is None or variable.default is None else variable.default


def _contents(dictionary: ObjectDictionary, mapping: int) -> Iterator[Carried]:
    start = 0
    for at in range(1, _number(dictionary, mapping, 0) + 1):
        entry = _number(dictionary, mapping, at)
        index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        variable = dictionary.get_variable(index, sub)
        if variable is not None:
            names = signal_names(_node(dictionary), variable)
            # one byte may carry a signal of all axles, a few bits each
            part = bits // len(names)
            yield from (Carried(name, start + part * at, part,
                                variable.data_type in datatypes.SIGNED_TYPES, variable.factor,
                                variable.unit, variable.description)
                        for at, name in enumerate(names))
        start += bits


def signal_names(node: int, variable: ODVariable) -> tuple[str, ...]:
    """The names that an object has in the table of signals, or its own, with the axle of a drive.

    More than one where the object's bits are shared by all axles.
    """
    axle = signals.DRIVE_NODES.index(node) + 1 if node in signals.DRIVE_NODES else 0
    for signal in signals.SIGNALS:
        for place in signal.places:
            offset = variable.subindex - place.sub
            if place.node != (0 if axle else node) or place.index != variable.index:
                continue
            if axle:
                return (signals.columns(signal)[axle - 1],)
            if place.kind == "U8" and signal.axles > 1 and offset == 0:
                return signals.columns(signal)
            if 0 <= offset < signal.axles:
                return (signals.columns(signal)[offset],)
    return (_slug(variable.name) + (f"_{axle}" if axle else ""),)


def unit_message() -> Message:
    """What the WSP unit may tell the bench: the signals that stand at its node, in its TPDO1."""
    carried: list[Carried] = []
    start = 0
    for signal in signals.SIGNALS:
        for place in (one for one in signal.places if one.node == signals.WSP_NODE):
            carried.append(Carried(signals.columns(signal)[0], start, signals.bits(place), place.kind[0] == "I",
                                   place.scale, signal.unit.replace("_", "/"), signal.text))
            start += carried[-1].bits
    return Message(f"node_{signals.WSP_NODE}_TPDO1", connection_set.TPDO[0] + signals.WSP_NODE, False,
                   signals.WSP_NODE, True, tuple(carried))


def dbc(dictionaries: Iterable[ObjectDictionary]) -> str:
    """One DBC file with the PDOs of all nodes, the SYNC and the heartbeats, as text."""
    dictionaries = list(dictionaries)
    nodes = {_node(one): _node_name(_node(one)) for one in dictionaries}
    others = {node: _node_name(node) for node in (signals.WSP_NODE, signals.BENCH_NODE)}
    every = [message for one in dictionaries for message in messages(one)]
    if signals.WSP_NODE not in nodes:
        every.append(unit_message())
    names = list((nodes | others).values())
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", f"BU_: {' '.join(names)}", ""]
    lines += [f"BO_ {connection_set.SYNC} SYNC: 0 {others[signals.BENCH_NODE]}", ""]
    for message in every:
        lines += _message_lines(message, nodes | others)
    for node, name in (nodes | others).items():
        lines += [f"BO_ {connection_set.HEARTBEAT + node} {name}_heartbeat: 1 {name}",
                  f' SG_ {name}_nmt_state : 0|7@1+ (1,0) [0|127] "" Vector__XXX', ""]
    lines += [f'CM_ SG_ {_dbc_id(message)} {one.name} "{one.text}";'
              for message in every for one in message.carried if one.text]
    lines += [f'VAL_ {connection_set.HEARTBEAT + node} {name}_nmt_state 0 "INITIALISING" 4 "STOPPED" '
              '5 "OPERATIONAL" 127 "PRE_OPERATIONAL" ;' for node, name in (nodes | others).items()]
    return "\n".join(lines) + "\n"


def _message_lines(message: Message, nodes: Mapping[int, str]) -> list[str]:
    node, unit = nodes[message.node], nodes[signals.WSP_NODE]
    partner = nodes[signals.BENCH_NODE] if message.node == signals.WSP_NODE else unit
    sender, receiver = (node, partner) if message.transmits else (partner, node)
    length = (max(one.start + one.bits for one in message.carried) + 7) // 8
    lines = [f"BO_ {_dbc_id(message)} {message.name}: {length} {sender}"]
    for one in message.carried:
        low = -(1 << one.bits - 1) if one.signed else 0
        high = low + (1 << one.bits) - 1
        lines.append(f" SG_ {one.name} : {one.start}|{one.bits}@1{'-' if one.signed else '+'} "
                     f"({one.factor:.12g},0) [{low * one.factor:.12g}|{high * one.factor:.12g}] "
                     f'"{one.unit}" {receiver}')
    return [*lines, ""]


def _dbc_id(message: Message) -> int:
    return message.can_id | _INVALID if message.extended else message.can_id


def _node_name(node: int) -> str:
    names = {signals.SPEED_NODE: "axle_speed_unit", signals.BRAKE_NODE: "brake_io",
             signals.WSP_NODE: "wsp_unit", signals.BENCH_NODE: "bench"}
    if node in signals.DRIVE_NODES:
        return f"drive_{signals.DRIVE_NODES.index(node) + 1}"
    return names.get(node, f"node_{node}")


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


# -- the table of signals, and all of it on disk

def signal_table() -> str:
    """The table of signals as markdown: name, unit, axles, direction, where it stands, meaning."""
    rows = ["| signal | unit | axles | direction | on the bus | meaning |",
            "|---|---|---|---|---|---|"]
    for signal in signals.SIGNALS:
        places = "<br>".join(_place(place, signal.axles) for place in signal.places)
        unit = signal.unit.replace("_", "/") or "-"
        rows.append(f"| `{signal.name}` | {unit} | {signal.axles} | {signal.direction} | "
                    f"{places or '-'} | {signal.text} |")
    return "\n".join(rows) + "\n"


def _place(place: signals.Place, axles: int) -> str:
    if place.node == 0:
        first, last = signals.DRIVE_NODES[0], signals.DRIVE_NODES[-1]
        where = f"nodes {first}..{last} {place.index:04X}h"
    else:
        several = axles > 1 and place.kind != "U8"
        last_sub = f"..{place.sub + axles - 1}" if several else ""
        where = f"node {place.node} {place.index:04X}h:{place.sub}{last_sub}"
    scale = f"{place.scale:g}" + (f" x {place.of}" if place.of else "")
    return f"{where}, {place.kind}, {scale}{', wraps' if place.wraps else ''}"


def write(folder: Path, dictionaries: Iterable[ObjectDictionary]) -> list[Path]:
    """Write the EDS of every node, `rig.dbc` and `signals.md` into a folder; what was written."""
    dictionaries = list(dictionaries)
    texts = {f"{file_name(one)}.eds": eds(one) for one in dictionaries}
    texts |= {"rig.dbc": dbc(dictionaries), "signals.md": signal_table()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]
