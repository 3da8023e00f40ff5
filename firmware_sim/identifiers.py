"""Whether every identifier on the bus has one sender.

A master may give nodes other numbers (LSS) and other identifiers, and let them store these
(`bus.store`). With several groups of axles the next group is only 20h away, so a remapped
identifier easily is that of another group. On a CAN bus two senders of one identifier destroy the
frames of each other. So stored parameters are checked before a run.

Source: CiA 301, predefined connection set, COB-IDs of PDO, EMCY and SDO.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.cia301 import communication
from rollerrig.firmware_sim.cia301.communication import SDO_SERVERS
from rollerrig.firmware_sim.cia301.lss import UNCONFIGURED
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.connection_set import NMT, SYNC
from rollerrig.wsp_interface.rig_objects import unit_frames
from rollerrig.wsp_interface.signals import Table

_EMERGENCY_OBJECT = 0x1014
_SDO_OBJECT = 0x1200
_REMEDY = (
    "each has one sender on the bus: let the master store another value, or delete the file of a "
    "node to restore its defaults"
)


class _Sender(NamedTuple):
    """Who sends an identifier: the words for it, and the file of a node that has stored values."""

    words: str
    file: Path | None


def check(table: Table, nodes: Mapping[int, Node]) -> None:
    """Check the identifiers and numbers that nodes have after power-on, with what they have stored.

    `table`: the signals of the vehicle. `nodes` are those of the rig by their default number; they
    are powered on without a bus. Raises ConfigError for the first number or identifier with two
    senders.
    """
    for node in nodes.values():
        node.start(lambda frame: None, 0)
    _check_numbers(table, nodes)
    _check_identifiers(table, nodes)


def _check_numbers(table: Table, nodes: Mapping[int, Node]) -> None:
    taken = {signals.BENCH_NODE: _Sender("the bench", None)}
    for group, number in enumerate(table.wsp_nodes):
        taken[number] = _Sender(_unit(table, group), None)
    for number, node in nodes.items():
        if node.node_id != UNCONFIGURED:
            sender = _Sender(f"node {number}{_of_group(table, number)}", _file(node))
            _take(taken, node.node_id, sender, f"node number {node.node_id} (LSS)")


def _check_identifiers(table: Table, nodes: Mapping[int, Node]) -> None:
    taken = {NMT: _Sender("the bench", None), SYNC: _Sender("the bench", None)}
    for group in range(table.kind.groups):
        frames = unit_frames(table, group)
        of_unit = (
            frames.reference_speed.can_id,
            frames.magnets_id,
            frames.sand_id,
            frames.shares_id,
            frames.emergency_id,
        )
        taken |= dict.fromkeys(of_unit, _Sender(_unit(table, group), None))
    for number, node in nodes.items():
        if node.node_id == UNCONFIGURED:
            continue
        for can_id, service in _sent(node):
            sender = _Sender(f"node {number}{_of_group(table, number)} in {service}", _file(node))
            _take(taken, can_id, sender, f"identifier {can_id & communication.EXTENDED_MASK:X}h")


def _take(taken: dict[int, _Sender], value: int, sender: _Sender, what: str) -> None:
    """Note the sender of an identifier or number. Raises ConfigError if there is one already."""
    first = taken.setdefault(value, sender)
    if first is sender:
        return
    files = [str(one.file) for one in (sender, first) if one.file]
    raise ConfigError(
        f"{' and '.join(files)}: {first.words} and {sender.words} have the {what}; {_REMEDY}"
    )


def _sent(node: Node) -> Iterator[tuple[int, str]]:
    """Yield the identifiers that a node sends, and the object of each.

    An identifier of 29 bits has the flag of a COB-ID entry.
    """
    values = node.objects.values
    cob_ids = [(values[key(_EMERGENCY_OBJECT, 0)], _EMERGENCY_OBJECT, 0)]
    for server in range(SDO_SERVERS):
        request = values[key(_SDO_OBJECT + server, 1)]
        if communication.valid(request):
            cob_ids.append((values[key(_SDO_OBJECT + server, 2)], _SDO_OBJECT + server, 2))
    for tpdo in node.tpdos:
        if tpdo.keys:
            cob_ids.append((values[key(tpdo.index, 1)], tpdo.index, 1))
    for cob_id, index, sub in cob_ids:
        if communication.valid(cob_id):
            at = communication.dispatch_key(*communication.split(cob_id))
            yield at, f"object {index:X}h:{sub}"


def _file(node: Node) -> Path | None:
    """Return the file in which a node has stored values; None if there is none."""
    path = node.storage.path
    return path if path is not None and path.is_file() else None


def _unit(table: Table, group: int) -> str:
    return "the WSP unit" if table.kind.groups == 1 else f"the WSP unit of group {group + 1}"


def _of_group(table: Table, number: int) -> str:
    return "" if table.kind.groups == 1 else f" of group {signals.group_of(number) + 1}"
