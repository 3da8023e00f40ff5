"""Files that tell other tools what stands on the bus: EDS for each node, one DBC, the signal table.

Everything is written from the object dictionaries and from the table of signals, so a description cannot say anything
else than the device. An EDS file carries what strict parsers ask for: mapping flags as 0 or 1, and the numbers of
objects and PDOs. Source: CiA 306-1 (EDS); the DBC keywords as cantools reads them.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes
from cantools.database import Database
from cantools.database.can import Message, Node, Signal
from cantools.database.conversion import BaseConversion

from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import connection_set

_VAR, _ARRAY, _RECORD, _DOMAIN = 0x7, 0x8, 0x9, 0x2
_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
# DeviceInfo: what a node can, and where canopen's dictionary says so; 0 where it does not
_ABILITIES = {
    "SimpleBootUpMaster": "simple_boot_up_master",
    "SimpleBootUpSlave": "simple_boot_up_slave",
    "Granularity": "granularity",
    "DynamicChannelsSupported": "dynamic_channels_supported",
    "CompactPDO": "",
    "GroupMessaging": "group_messaging",
    "NrOfRXPDO": "nr_of_RXPDO",
    "NrOfTXPDO": "nr_of_TXPDO",
    "LSS_Supported": "LSS_supported",
}
_INVALID, _EXTENDED = 1 << 31, 1 << 29
_MANDATORY = (0x1000, 0x1001, 0x1018)
_MANUFACTURER = range(0x2000, 0x6000)
# data types that a receive PDO may carry as fillers
_DUMMIES = (2, 3, 4, 5, 6, 7)
# fixed, so that the same dictionary gives the same file
_DATE, _TIME = "01-01-2025", "12:00PM"
_NMT_STATES = {0: "INITIALISING", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE_OPERATIONAL"}


# -- EDS


def eds(dictionary: ObjectDictionary) -> str:
    """The EDS file of a node, as text."""
    about = dictionary.device_information
    head: dict[str, dict[str, object]] = {
        "FileInfo": {
            "FileName": f"{file_name(dictionary)}.eds",
            "FileVersion": 1,
            "FileRevision": 1,
            "EDSVersion": "4.0",
            "Description": about.product_name,
            "CreationTime": _TIME,
            "CreationDate": _DATE,
            "CreatedBy": about.vendor_name,
            "ModificationTime": _TIME,
            "ModificationDate": _DATE,
            "ModifiedBy": about.vendor_name,
        },
        "DeviceInfo": {
            "VendorName": about.vendor_name,
            "VendorNumber": f"0x{about.vendor_number:08X}",
            "ProductName": about.product_name,
            "ProductNumber": f"0x{about.product_number:08X}",
            "RevisionNumber": f"0x{about.revision_number:08X}",
            "OrderCode": about.order_code,
            **{
                f"BaudRate_{rate}": int(rate * 1000 in about.allowed_baudrates)
                for rate in _BAUD_RATES
            },
            **{key: int(getattr(about, name, 0) or 0) for key, name in _ABILITIES.items()},
        },
        "DummyUsage": {f"Dummy{kind:04d}": int(kind in _DUMMIES) for kind in range(1, 8)},
        "Comments": {"Lines": 0},
    }
    return "\n".join(
        f"[{name}]\n" + "".join(f"{option}={value}\n" for option, value in body.items())
        for name, body in (*head.items(), *_object_sections(dictionary))
    )


def file_name(dictionary: ObjectDictionary) -> str:
    """The name of a node's files, without suffix: its number and what it is."""
    product = dictionary.device_information.product_name or "node"
    return f"node_{dictionary.node_id:03d}_{_slug(product)}"


def _object_sections(dictionary: ObjectDictionary) -> Iterator[tuple[str, dict[str, object]]]:
    groups: dict[str, list[int]] = {
        "MandatoryObjects": [],
        "OptionalObjects": [],
        "ManufacturerObjects": [],
    }
    for index in dictionary:
        groups[
            "MandatoryObjects"
            if index in _MANDATORY
            else "ManufacturerObjects"
            if index in _MANUFACTURER
            else "OptionalObjects"
        ].append(index)
    for name, indices in groups.items():
        yield (
            name,
            {"SupportedObjects": len(indices)}
            | {str(at): f"0x{index:04X}" for at, index in enumerate(indices, 1)},
        )
        for index in indices:
            thing = dictionary[index]
            if isinstance(thing, ODVariable):
                yield f"{index:04X}", _variable_section(thing)
                continue
            kind = _RECORD if isinstance(thing, ODRecord) else _ARRAY
            yield (
                f"{index:04X}",
                {
                    "ParameterName": thing.name,
                    "ObjectType": f"0x{kind:X}",
                    "SubNumber": len(thing.subindices),
                },
            )
            for sub in sorted(thing.subindices):
                yield f"{index:04X}sub{sub:X}", _variable_section(thing.subindices[sub])


def _variable_section(variable: ODVariable) -> dict[str, object]:
    kind = _DOMAIN if variable.data_type == datatypes.DOMAIN else _VAR
    found = {
        "ParameterName": variable.name,
        "ObjectType": f"0x{kind:X}",
        "DataType": f"0x{variable.data_type:04X}",
        "AccessType": variable.access_type,
        "DefaultValue": _default(variable),
        "PDOMapping": int(variable.pdo_mappable),
        "LowLimit": variable.min,
        "HighLimit": variable.max,
        # beyond the standard, and read by canopen: the value of one count
        "Factor": f"{variable.factor:.12g}" if variable.factor != 1 else None,
        "Unit": variable.unit or None,
        "Description": variable.description.replace(";", ",") or None,
    }
    return {option: value for option, value in found.items() if value is not None}


def _default(variable: ODVariable) -> str:
    if variable.relative:
        return str(getattr(variable, "default_raw"))  # noqa: B009
    if isinstance(variable.default, bool):
        return str(int(variable.default))
    if isinstance(variable.default, int) and variable.index < 0x2000 and variable.default > 9:
        return f"0x{variable.default:X}"
    return str(variable.default)


# -- DBC


def _messages(dictionary: ObjectDictionary) -> Iterator[Message]:
    """The PDOs that a node has by default, as CAN messages."""
    node = dictionary.node_id or 0
    here, other = (
        _node_name(node),
        _node_name(signals.BENCH_NODE if node == signals.WSP_NODE else signals.WSP_NODE),
    )
    for first, word in ((0x1400, "RPDO"), (0x1800, "TPDO")):
        for index in (at for at in dictionary if first <= at < first + 0x200):
            cob_id = _number(dictionary, index, 1)
            if not cob_id & _INVALID and _number(dictionary, index + 0x200, 0):
                sender, receiver = (here, other) if word == "TPDO" else (other, here)
                yield _message(
                    f"node_{node}_{word}{index - first + 1}",
                    cob_id,
                    sender,
                    list(_contents(dictionary, index + 0x200, receiver)),
                )


def _message(name: str, cob_id: int, sender: str, carried: list[Signal]) -> Message:
    length = (max((one.start + one.length for one in carried), default=0) + 7) // 8
    return Message(
        cob_id & 0x1FFFFFFF,
        name,
        length,
        carried,
        senders=[sender],
        is_extended_frame=bool(cob_id & _EXTENDED),
        strict=True,
    )


def _signal(
    name: str,
    start: int,
    bits: int,
    receiver: str | None,
    signed: bool = False,
    factor: float = 1,
    unit: str = "",
    text: str = "",
    choices: Any = None,
) -> Signal:
    """A signal over the whole range of its bits; `factor` and `unit` of one count."""
    low = -(1 << bits - 1) if signed else 0
    return Signal(
        name,
        start,
        bits,
        is_signed=signed,
        minimum=low * factor,
        maximum=(low + (1 << bits) - 1) * factor,
        conversion=BaseConversion.factory(scale=factor, choices=choices),
        unit=unit or None,
        comment=text or None,
        receivers=[receiver] if receiver else [],
    )


def _number(dictionary: ObjectDictionary, index: int, sub: int) -> int:
    """The default of an integer object; 0 where there is none."""
    variable = dictionary.get_variable(index, sub)
    return 0 if variable is None or variable.default is None else variable.default


def _contents(dictionary: ObjectDictionary, mapping: int, receiver: str) -> Iterator[Signal]:
    start = 0
    for entry in (
        _number(dictionary, mapping, at + 1) for at in range(_number(dictionary, mapping, 0))
    ):
        bits = entry & 0xFF
        variable = dictionary.get_variable(entry >> 16, entry >> 8 & 0xFF)
        if variable is not None:
            names = signal_names(dictionary.node_id or 0, variable)
            # one byte may carry a signal of all axles, a few bits each
            part = bits // len(names)
            yield from (
                _signal(
                    name,
                    start + part * at,
                    part,
                    receiver,
                    variable.data_type in datatypes.SIGNED_TYPES,
                    variable.factor,
                    variable.unit,
                    variable.description,
                )
                for at, name in enumerate(names)
            )
        start += bits


def signal_names(node: int, variable: ODVariable) -> tuple[str, ...]:
    """An object's names in the table of signals (several where axles share its bits), else its own and the axle."""
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


def _unit_message() -> Message:
    """What the WSP unit may tell the bench: the signals that stand at its node, in its TPDO1."""
    carried: list[Signal] = []
    for signal in signals.SIGNALS:
        for place in (one for one in signal.places if one.node == signals.WSP_NODE):
            start = carried[-1].start + carried[-1].length if carried else 0
            carried.append(
                _signal(
                    signals.columns(signal)[0],
                    start,
                    signals.bits(place),
                    _node_name(signals.BENCH_NODE),
                    place.kind[0] == "I",
                    place.scale,
                    signal.unit.replace("_", "/"),
                    signal.text,
                )
            )
    return _message(
        f"node_{signals.WSP_NODE}_TPDO1",
        connection_set.TPDO[0] + signals.WSP_NODE,
        _node_name(signals.WSP_NODE),
        carried,
    )


def dbc(dictionaries: Iterable[ObjectDictionary]) -> str:
    """One DBC file with the PDOs of all nodes, the SYNC and the heartbeats, as text."""
    dictionaries = list(dictionaries)
    nodes = dict.fromkeys(
        [*(one.node_id or 0 for one in dictionaries), signals.WSP_NODE, signals.BENCH_NODE]
    )
    messages = [_message("SYNC", connection_set.SYNC, _node_name(signals.BENCH_NODE), [])]
    messages += [message for one in dictionaries for message in _messages(one)]
    if signals.WSP_NODE not in [one.node_id for one in dictionaries]:
        messages.append(_unit_message())
    for node in nodes:
        state = _signal(f"{_node_name(node)}_nmt_state", 0, 7, None, choices=_NMT_STATES)
        messages.append(
            _message(
                f"{_node_name(node)}_heartbeat",
                connection_set.HEARTBEAT + node,
                _node_name(node),
                [state],
            )
        )
    return Database(
        messages, [Node(_node_name(node), None) for node in nodes], version=""
    ).as_dbc_string(sort_signals=None, shorten_long_names=False)


def _node_name(node: int) -> str:
    names = {
        signals.SPEED_NODE: "axle_speed_unit",
        signals.BRAKE_NODE: "brake_io",
        signals.SANDER_NODE: "sander_io",
        signals.WSP_NODE: "wsp_unit",
        signals.BENCH_NODE: "bench",
    }
    names |= {drive: f"drive_{axle}" for axle, drive in enumerate(signals.DRIVE_NODES, start=1)}
    return names.get(node, f"node_{node}")


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


# -- the table of signals, and all of it on disk


def signal_table() -> str:
    """The table of signals as markdown: name, unit, axles, direction, where it stands, meaning."""
    rows = [
        "| signal | unit | axles | direction | on the bus | meaning |",
        "|---|---|---|---|---|---|",
    ]
    for signal in signals.SIGNALS:
        places = "<br>".join(_place(place, signal.axles) for place in signal.places)
        unit = signal.unit.replace("_", "/") or "-"
        rows.append(
            f"| `{signal.name}` | {unit} | {signal.axles} | {signal.direction} | "
            f"{places or '-'} | {signal.text} |"
        )
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
