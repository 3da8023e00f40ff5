"""Files that describe the bus to other tools: an EDS for each node, one DBC, two tables.

All are written from the object dictionaries and from the table of signals, so a description always
agrees with the device. An EDS file contains what strict parsers require: mapping flags as 0 or 1,
the numbers of objects and PDOs, and no keys beyond those of CiA 306. Units and factors of objects,
for which CiA 306 has no keys, are in a table of their own.

Source: CiA 306-1 (EDS); the DBC keywords as cantools reads them.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes
from cantools.database import Database
from cantools.database.can import Message, Node, Signal
from cantools.database.conversion import BaseConversion

from rollerrig.configs import output_files
from rollerrig.wsp_interface import magnets, signals
from rollerrig.wsp_interface.bus import connection_set
from rollerrig.wsp_interface.signals import Table

# object types of CiA 301
_DOMAIN = 0x2
_VAR = 0x7
_ARRAY = 0x8
_RECORD = 0x9

_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)  # kbit/s
# DeviceInfo: abilities of a node, and the attribute of canopen's dictionary that has each; else 0
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
_MANDATORY = (0x1000, 0x1001, 0x1018)
_COMMUNICATION_END = 0x2000  # objects below it belong to CiA 301
_MANUFACTURER = range(0x2000, 0x6000)
# data types that a receive PDO may carry as fillers
_DUMMIES = (2, 3, 4, 5, 6, 7)
# fixed, so that the same dictionary gives the same file
_DATE = "01-01-2025"
_TIME = "12:00PM"

# PDO communication parameters: first index, and the distance to the mapping parameters
_RPDO = 0x1400
_TPDO = 0x1800
_PDOS = 0x200
_TO_MAPPING = 0x200
# bits of a PDO's COB-ID
_INVALID = 1 << 31
_EXTENDED = 1 << 29
_ID_MASK = 0x1FFFFFFF
# transmission types of a PDO: with every n-th SYNC up to 240; after changes from 254 on
_LAST_SYNCHRONOUS = 240
_EVENT_DRIVEN = 254

# A unit is lost 200 ms after its last heartbeat, so it sends one in half of this time.
_UNIT_HEARTBEAT_ms = 100

# the names of the pairs of magnets in the DBC
_MAGNET_NAMES = {
    magnets.ALL_OFF: "fill",
    magnets.HOLDING: "hold",
    magnets.VENT_MAGNET: "vent_without_hold",
    magnets.VENTING: "vent",
}

_NMT_STATES = {0: "INITIALISING", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE_OPERATIONAL"}

Options: TypeAlias = dict[str, object]  # of a section of an EDS file


# -- EDS


def eds(dictionary: ObjectDictionary) -> str:
    """Return the EDS file of a node, as text."""
    sections: list[tuple[str, Options]] = [
        ("FileInfo", _file_info(dictionary)),
        ("DeviceInfo", _device_info(dictionary)),
        ("DummyUsage", {f"Dummy{kind:04d}": int(kind in _DUMMIES) for kind in range(1, 8)}),
        ("Comments", {"Lines": 0}),
        *_object_sections(dictionary),
    ]
    texts = []
    for name, options in sections:
        lines = [f"{option}={value}\n" for option, value in options.items()]
        texts.append(f"[{name}]\n" + "".join(lines))
    return "\n".join(texts)


def file_name(dictionary: ObjectDictionary) -> str:
    """Return the name of a node's files, without suffix: its number and its product name."""
    product = dictionary.device_information.product_name or "node"
    return f"node_{dictionary.node_id:03d}_{_slug(product)}"


def _file_info(dictionary: ObjectDictionary) -> Options:
    device = dictionary.device_information
    return {
        "FileName": f"{file_name(dictionary)}.eds",
        "FileVersion": 1,
        "FileRevision": 1,
        "EDSVersion": "4.0",
        "Description": device.product_name,
        "CreationTime": _TIME,
        "CreationDate": _DATE,
        "CreatedBy": device.vendor_name,
        "ModificationTime": _TIME,
        "ModificationDate": _DATE,
        "ModifiedBy": device.vendor_name,
    }


def _device_info(dictionary: ObjectDictionary) -> Options:
    device = dictionary.device_information
    options: Options = {
        "VendorName": device.vendor_name,
        "VendorNumber": f"0x{device.vendor_number:08X}",
        "ProductName": device.product_name,
        "ProductNumber": f"0x{device.product_number:08X}",
        "RevisionNumber": f"0x{device.revision_number:08X}",
        "OrderCode": device.order_code,
    }
    for rate in _BAUD_RATES:
        options[f"BaudRate_{rate}"] = int(rate * 1000 in device.allowed_baudrates)
    for key, attribute in _ABILITIES.items():
        options[key] = int(getattr(device, attribute, 0) or 0)
    return options


def _object_sections(dictionary: ObjectDictionary) -> Iterator[tuple[str, Options]]:
    """Yield the lists of objects, each followed by the sections of its objects."""
    groups: dict[str, list[int]] = {
        "MandatoryObjects": [],
        "OptionalObjects": [],
        "ManufacturerObjects": [],
    }
    for index in dictionary:
        groups[_group(index)].append(index)

    for group, indices in groups.items():
        listed: Options = {"SupportedObjects": len(indices)}
        for number, index in enumerate(indices, start=1):
            listed[str(number)] = f"0x{index:04X}"
        yield group, listed

        for index in indices:
            entry = dictionary[index]
            if isinstance(entry, ODVariable):
                yield f"{index:04X}", _variable_section(entry)
                continue
            kind = _RECORD if isinstance(entry, ODRecord) else _ARRAY
            options: Options = {
                "ParameterName": entry.name,
                "ObjectType": f"0x{kind:X}",
                "SubNumber": len(entry.subindices),
            }
            yield f"{index:04X}", options
            for sub in sorted(entry.subindices):
                yield f"{index:04X}sub{sub:X}", _variable_section(entry.subindices[sub])


def _group(index: int) -> str:
    if index in _MANDATORY:
        return "MandatoryObjects"
    if index in _MANUFACTURER:
        return "ManufacturerObjects"
    return "OptionalObjects"


def _variable_section(variable: ODVariable) -> Options:
    kind = _DOMAIN if variable.data_type == datatypes.DOMAIN else _VAR
    options = {
        "ParameterName": variable.name,
        "ObjectType": f"0x{kind:X}",
        "DataType": f"0x{variable.data_type:04X}",
        "AccessType": variable.access_type,
        "DefaultValue": _default(variable),
        "PDOMapping": int(variable.pdo_mappable),
        "LowLimit": variable.min,
        "HighLimit": variable.max,
    }
    return {option: value for option, value in options.items() if value is not None}


def _default(variable: ODVariable) -> str:
    if variable.relative:
        return str(getattr(variable, "default_raw"))  # noqa: B009
    default = variable.default
    if isinstance(default, bool):
        return str(int(default))
    if isinstance(default, int) and variable.index < _COMMUNICATION_END and default > 9:
        return f"0x{default:X}"
    return str(default)


def object_table(dictionaries: Iterable[ObjectDictionary]) -> str:
    """Return what an EDS file cannot hold of all objects, as CSV: unit, value of a count, meaning.

    A row has the node, index and sub-index (hexadecimal, as in the EDS), name, unit, the value of
    one count in that unit, and the meaning.
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("node", "index", "sub", "name", "unit", "value_of_a_count", "meaning"))
    for dictionary in dictionaries:
        for index in dictionary:
            entry = dictionary[index]
            variables = [entry] if isinstance(entry, ODVariable) else entry.subindices.values()
            for variable in variables:
                rows.writerow(
                    (
                        dictionary.node_id,
                        f"{index:04X}",
                        f"{variable.subindex:X}",
                        variable.name,
                        variable.unit,
                        f"{variable.factor:.12g}",
                        variable.description,
                    )
                )
    return text.getvalue()


# -- DBC


def dbc(table: Table, dictionaries: Iterable[ObjectDictionary], sync_period_s: float) -> str:
    """Return one DBC file with the PDOs of all nodes, the SYNC and the heartbeats, as text.

    `table`: the signals of the vehicle. Messages that are sent regularly have their cycle time:
    with every n-th SYNC, or the producer time of a heartbeat.
    """
    dictionaries = list(dictionaries)
    sync_ms = round(1000 * sync_period_s)
    heartbeats_ms = {
        dictionary.node_id: _number(dictionary, 0x1017, 0) for dictionary in dictionaries
    }
    for unit in table.wsp_nodes:
        heartbeats_ms[unit] = _UNIT_HEARTBEAT_ms
    described = [dictionary.node_id or 0 for dictionary in dictionaries]
    nodes = dict.fromkeys([*described, *table.wsp_nodes, signals.BENCH_NODE])

    bench_name = _node_name(table, signals.BENCH_NODE)
    messages = [_message("SYNC", connection_set.SYNC, bench_name, [], sync_ms)]
    for dictionary in dictionaries:
        messages += _pdo_messages(table, dictionary, sync_ms)
    for group, unit in enumerate(table.wsp_nodes):
        if unit not in described:
            messages.append(_unit_message(table, group))
    for node in nodes:
        messages.append(_heartbeat_message(table, node, heartbeats_ms.get(node, 0)))

    of_nodes = [Node(_node_name(table, node), None) for node in nodes]
    database = Database(messages, of_nodes, version="")
    return database.as_dbc_string(sort_signals=None, shorten_long_names=False)


def _pdo_messages(table: Table, dictionary: ObjectDictionary, sync_ms: int) -> Iterator[Message]:
    """Yield the PDOs that a node has by default, as CAN messages."""
    node = dictionary.node_id or 0
    own_name = _node_name(table, node)
    partner = table.wsp_nodes[signals.group_of(node)]
    if node in table.wsp_nodes or node in table.drive_nodes:
        partner = signals.BENCH_NODE
    partner_name = _node_name(table, partner)
    for first, word, sender, receiver in (
        (_RPDO, "RPDO", partner_name, own_name),
        (_TPDO, "TPDO", own_name, partner_name),
    ):
        for index in dictionary:
            if not first <= index < first + _PDOS:
                continue
            mapping = index + _TO_MAPPING
            cob_id = _number(dictionary, index, 1)
            is_empty = _number(dictionary, mapping, 0) == 0
            if cob_id & _INVALID or is_empty:
                continue
            name = f"node_{node}_{word}{index - first + 1}"
            carried = list(_contents(table, dictionary, mapping, receiver))
            cycle_ms = 0
            if node in table.nodes(signals.BRAKE_NODE) and word == "RPDO":
                cycle_ms = sync_ms  # the magnets: a unit answers every SYNC
            elif word == "TPDO":
                cycle_ms = _cycle_ms(dictionary, index, sync_ms)
            # the harness commands the bench, and is no node
            from_harness = node == signals.BENCH_NODE and word == "RPDO"
            source = None if from_harness else sender
            yield _message(name, cob_id, source, carried, cycle_ms)


def _cycle_ms(dictionary: ObjectDictionary, index: int, sync_ms: int) -> int:
    """Return the cycle time of a transmit PDO; 0 if it is sent after changes only.

    `index` is that of its communication parameters.
    """
    transmission_type = _number(dictionary, index, 2)
    if 1 <= transmission_type <= _LAST_SYNCHRONOUS:
        return transmission_type * sync_ms
    if transmission_type >= _EVENT_DRIVEN:
        return _number(dictionary, index, 5)
    return 0


def _message(
    name: str, cob_id: int, sender: str | None, carried: list[Signal], cycle_ms: int = 0
) -> Message:
    bits = max((signal.start + signal.length for signal in carried), default=0)
    return Message(
        cob_id & _ID_MASK,
        name,
        (bits + 7) // 8,
        carried,
        senders=[sender] if sender else [],
        is_extended_frame=bool(cob_id & _EXTENDED),
        cycle_time=cycle_ms or None,
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
    """Return a signal over the whole range of its bits; `factor` is the value of one count."""
    low = -(1 << bits - 1) if signed else 0
    high = low + (1 << bits) - 1
    return Signal(
        name,
        start,
        bits,
        is_signed=signed,
        minimum=low * factor,
        maximum=high * factor,
        conversion=BaseConversion.factory(scale=factor, choices=choices),
        unit=unit or None,
        comment=text or None,
        receivers=[receiver] if receiver else [],
    )


def _number(dictionary: ObjectDictionary, index: int, sub: int) -> int:
    """Return the default of an integer object; 0 where there is none."""
    variable = dictionary.get_variable(index, sub)
    if variable is None or variable.default is None:
        return 0
    return variable.default


def _contents(
    table: Table, dictionary: ObjectDictionary, mapping: int, receiver: str
) -> Iterator[Signal]:
    """Yield the signals of a PDO by its mapping parameters."""
    start = 0
    for number in range(1, _number(dictionary, mapping, 0) + 1):
        entry = _number(dictionary, mapping, number)
        index = entry >> 16
        sub = entry >> 8 & 0xFF
        bits = entry & 0xFF
        variable = dictionary.get_variable(index, sub)
        if variable is not None:
            names = signal_names(table, dictionary.node_id or 0, variable)
            # one byte may carry a signal of all axles of a group, which may have two or four
            bits_each = bits if len(names) == 1 else magnets.BITS_PER_AXLE
            are_magnets = set(names) <= set(signals.columns(table.by_name["magnets"]))
            for position, name in enumerate(names):
                yield _signal(
                    name,
                    start + bits_each * position,
                    bits_each,
                    receiver,
                    signed=variable.data_type in datatypes.SIGNED_TYPES,
                    factor=variable.factor,
                    unit=variable.unit,
                    text=variable.description,
                    choices=_MAGNET_NAMES if are_magnets else None,
                )
        start += bits


def signal_names(table: Table, node: int, variable: ODVariable) -> tuple[str, ...]:
    """Return the names of an object's signals, of a node of a vehicle.

    An object in the table of signals has their columns, several where the axles share its bits. Any
    other object has its name, with the axle if the node is a drive.
    """
    if node in table.drive_nodes:
        axle = table.drive_nodes.index(node) + 1
        return (_drive_signal_name(table, axle, variable),)

    leading = signals.in_leading_group(node)
    for signal in table.signals:
        for place in signal.places:
            if place.node != leading or place.index != variable.index:
                continue
            axles = table.axles_at(signal, node)
            columns = signals.columns(signal)[axles[0] - 1 : axles[-1]]
            offset = variable.subindex - place.sub
            if place.kind == "U8" and signal.axles > 1:
                # one byte has two bits for each axle
                if offset == 0:
                    return columns
                continue
            if 0 <= offset < len(columns):
                return (columns[offset],)
    return (_slug(variable.name),)


def _drive_signal_name(table: Table, axle: int, variable: ODVariable) -> str:
    for signal in table.signals:
        for place in signal.places:
            if place.node == signals.DRIVE_UNDER_AXLE and place.index == variable.index:
                return signals.columns(signal)[axle - 1]
    return f"{_slug(variable.name)}_{axle}"


def _unit_message(table: Table, group: int) -> Message:
    """Return TPDO1 of the WSP unit of a group: the reference speed that it may send the bench."""
    node = table.wsp_nodes[group]
    signal = table.by_name[signals.reference_speed_name(group)]
    place = table.place(signals.reference_speed_name(0), signals.WSP_NODE)
    reference_speed = _signal(
        signals.columns(signal)[0],
        0,
        signals.bits(place),
        _node_name(table, signals.BENCH_NODE),
        signed=place.kind[0] == "I",
        factor=place.scale,
        unit=signal.unit.replace("_", "/"),
        text=signal.text,
    )
    return _message(
        f"node_{node}_TPDO1",
        connection_set.TPDO[0] + node,
        _node_name(table, node),
        [reference_speed],
    )


def _heartbeat_message(table: Table, node: int, cycle_ms: int) -> Message:
    name = _node_name(table, node)
    state = _signal(f"{name}_nmt_state", 0, 7, None, choices=_NMT_STATES)
    return _message(f"{name}_heartbeat", connection_set.HEARTBEAT + node, name, [state], cycle_ms)


def _node_name(table: Table, node: int) -> str:
    names = {
        signals.SPEED_NODE: "axle_speed_unit",
        signals.BRAKE_NODE: "brake_io",
        signals.SANDER_NODE: "sander_io",
        signals.TRACTION_NODE: "traction_io",
        signals.WSP_NODE: "wsp_unit",
        signals.BENCH_NODE: "bench",
    }
    for axle, drive in enumerate(table.drive_nodes, start=1):
        names[drive] = f"drive_{axle}"
    group = signals.group_of(node)
    leading = signals.in_leading_group(node)
    if group > 0 and leading in names and node not in names:
        return f"{names[leading]}_{group + 1}"
    return names.get(node, f"node_{node}")


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


# -- the table of signals, and all of it on disk


def signal_table(table: Table) -> str:
    """Return the table of signals of a vehicle as markdown."""
    rows = [
        "| signal | unit | axles | direction | on the bus | meaning |",
        "|---|---|---|---|---|---|",
    ]
    for signal in table.signals:
        places = "<br>".join(_place_text(table, place, signal.axles) for place in signal.places)
        unit = signal.unit.replace("_", "/") or "-"
        rows.append(
            f"| `{signal.name}` | {unit} | {signal.axles} | {signal.direction} | "
            f"{places or '-'} | {signal.text} |"
        )
    return "\n".join(rows) + "\n"


def _place_text(table: Table, place: signals.Place, axles: int) -> str:
    if place.node == signals.DRIVE_UNDER_AXLE:
        first = table.drive_nodes[0]
        last = table.drive_nodes[-1]
        text = f"nodes {first}..{last} {place.index:04X}h"
    else:
        text = f"node {place.node} {place.index:04X}h:{place.sub}"
        # the bits of a byte belong to the axles; other types have a sub-index for each axle
        if axles > 1 and place.kind != "U8":
            text += f"..{place.sub + axles - 1}"
    text += f", {place.kind}, {place.scale:g}"
    if place.of:
        text += f" x {place.of}"
    if place.wraps:
        text += ", wraps"
    return text


def write(
    folder: Path,
    table: Table,
    dictionaries: Iterable[ObjectDictionary],
    sync_period_s: float = 0.01,
) -> list[Path]:
    """Write the EDS of every node, `rig.dbc` and two tables into a folder; return their paths.

    `table`: the signals of the vehicle. The two tables are `objects.csv` (units and factors of all
    objects) and `signals.md`.
    """
    dictionaries = list(dictionaries)
    texts = {}
    for dictionary in dictionaries:
        texts[f"{file_name(dictionary)}.eds"] = eds(dictionary)
    texts["rig.dbc"] = dbc(table, dictionaries, sync_period_s)
    texts["objects.csv"] = object_table(dictionaries)
    texts["signals.md"] = signal_table(table)

    output_files.make_folder(folder)
    for name, text in texts.items():
        output_files.write_text(folder / name, text)
    return [folder / name for name in texts]
