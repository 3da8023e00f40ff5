"""What rig, unit and harness have agreed on: their frames and the objects of node 127.

An identifier is the first one of a service plus the node's number. Its literal is in the comment
next to it, so a search for 211h or 2010h finds this file. Objects that carry signals are in
`signals`, those of a device profile are with the device, and the byte of the magnets is in
`magnets`.
"""

import functools
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.connection_set import (
    EMERGENCY,
    HEARTBEAT,
    NMT,
    NODE_MASK,
    RPDO,
    SYNC,
    TPDO,
)
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.signals import (
    BENCH_NODE,
    BRAKE_NODE,
    SANDER_NODE,
    SPEED_NODE,
    TRACTION_NODE,
    WSP_NODE,
    Table,
)

# ms; an assumption: the rig takes a unit for lost after this silence
UNIT_LOST_AFTER_MS = 200

# letters of the struct module
_LETTERS = {"U8": "B", "I8": "b", "U16": "H", "I16": "h", "U32": "I", "I32": "i"}


def unit_lost_after_ms(sync_period_s: float) -> int:
    """Return the silence in ms after which the rig takes the unit for lost.

    It is at least two SYNC periods, because SYNCs are the unit's clock in lockstep.
    """
    return max(UNIT_LOST_AFTER_MS, round(2000.0 * sync_period_s))


@dataclass(frozen=True)
class Layout:
    """A frame that carries whole signals of a node, all axles of each.

    struct: the format of the data.
    names: the columns that the frame carries, in its order.
    scales: the value of one count of each column, in the signal's unit.
    """

    can_id: int
    struct: struct.Struct
    names: tuple[str, ...]
    scales: tuple[float, ...]

    def read(self, data: bytes | bytearray) -> dict[str, float]:
        """Return the values by column; an empty dict when the data have another length."""
        if len(data) != self.struct.size:
            return {}
        counts = self.struct.unpack(data)
        return {
            name: count * scale
            for name, scale, count in zip(self.names, self.scales, counts, strict=True)
        }


def layout(
    table: Table, can_id: int, *names: str, node: int = 0, group: int | None = None
) -> Layout:
    """Return the layout of the frame in which a node of a vehicle sends these signals.

    node: the sender; 0 is the node of the identifier.
    group: the group of axles whose values the frame carries; None is that of the node.
    """
    node = node or can_id & NODE_MASK
    if group is None:
        group = signals.group_of(node)
    axles = table.axles_of(group)
    letters = "<"
    columns: list[str] = []
    scales: list[float] = []
    for name in names:
        signal = table.by_name[name]
        place = table.place(name, signals.in_leading_group(node))
        carried = signals.columns(signal)
        if signal.axles > 1:
            carried = carried[axles[0] - 1 : axles[-1]]
        letters += _LETTERS[place.kind] * len(carried)
        columns += carried
        scales += [place.scale] * len(carried)
    return Layout(can_id, struct.Struct(letters), tuple(columns), tuple(scales))


def struct_format(place: signals.Place) -> str:
    """Return the format of an object for the struct module, little-endian."""
    return "<" + _LETTERS[place.kind]


# how much the centre of mass of a train slows down, in m/s2: an object of each speed unit, only on
# the buses of a train's cars. It is sent with every SYNC
TRAIN_DECELERATION = signals.Place(SPEED_NODE, 0x2103, 0, "I16", 1e-3)
TRAIN_DECELERATION_ID = TPDO[3] + SPEED_NODE  # 490h, two bytes

# frames between the rig and the unit of the leading group
SPEEDS_ID = TPDO[0] + SPEED_NODE  # 190h
PRESSURES_ID = TPDO[0] + BRAKE_NODE  # 191h
REFERENCE_SPEED_ID = TPDO[0] + WSP_NODE  # 1A0h
MAGNETS_ID = RPDO[0] + BRAKE_NODE  # 211h, one byte: see `magnets`
SAND_ID = RPDO[0] + SANDER_NODE  # 212h, one byte: bit 2j commands the sander of axle j + 1
ALL_SANDERS = 0b01_01_01_01
SHARES_ID = RPDO[0] + TRACTION_NODE  # 213h, the permitted share of each motor, I16, per mille
WHOLE_SHARE = 1000  # count of the whole force
UNIT_HEARTBEAT_ID = HEARTBEAT + WSP_NODE  # 720h
UNIT_EMERGENCY_ID = EMERGENCY + WSP_NODE  # 0A0h
# error code in an EMCY of the unit (CiA 301 Table 26: device specific): it has failed, for example
# because its outputs are no numbers
UNIT_HAS_FAILED = 0xFF02
GENERIC_ERROR = 0x01  # bit 0 of the error register in an EMCY


@dataclass(frozen=True)
class UnitFrames:
    """The frames between the rig and the unit of a group (0: the leading one).

    node: that of the unit.
    """

    group: int
    node: int
    speeds: Layout
    pressures: Layout
    reference_speed: Layout
    magnets_id: int
    sand_id: int
    shares_id: int
    heartbeat_id: int
    emergency_id: int


def unit_frames(table: Table, group: int) -> UnitFrames:
    """Return the frames of the unit of a group: identifiers are higher by 20h for each group."""
    offset = signals.NODES_OF_GROUP * group
    place = signals.first_place(signals.reference_speed_name(0))
    reference_speed = table.by_name[signals.reference_speed_name(group)]
    return UnitFrames(
        group=group,
        node=WSP_NODE + offset,
        speeds=layout(table, SPEEDS_ID + offset, "measured_speed"),
        pressures=layout(table, PRESSURES_ID + offset, "cylinder_pressure"),
        reference_speed=Layout(
            REFERENCE_SPEED_ID + offset,
            struct.Struct(struct_format(place)),
            signals.columns(reference_speed),
            (place.scale,),
        ),
        magnets_id=MAGNETS_ID + offset,
        sand_id=SAND_ID + offset,
        shares_id=SHARES_ID + offset,
        heartbeat_id=UNIT_HEARTBEAT_ID + offset,
        emergency_id=UNIT_EMERGENCY_ID + offset,
    )


@functools.cache
def units_by_frame(table: Table) -> Mapping[int, tuple[int, ...]]:
    """Return the nodes of the units that receive or send a frame, by its identifier."""
    found: dict[int, tuple[int, ...]] = {NMT: table.wsp_nodes, SYNC: table.wsp_nodes}
    for group, node in enumerate(table.wsp_nodes):
        frames = unit_frames(table, group)
        for can_id in (
            frames.speeds.can_id,
            frames.pressures.can_id,
            frames.reference_speed.can_id,
            frames.magnets_id,
            frames.heartbeat_id,
            frames.emergency_id,
        ):
            found[can_id] = (node,)
    return found


def emergency_event(table: Table, node: int, error_code: int) -> Code:
    """Return the code of the event for an EMCY of a node of a vehicle."""
    if node not in table.wsp_nodes:
        return Code.NODE_EMERGENCY
    if error_code == UNIT_HAS_FAILED:
        return Code.UNIT_FAILED
    return Code.UNIT_EMERGENCY


# 27Fh, one byte of any value: a harness on a bench in lockstep has processed this cycle
HARNESS_ANSWER_ID = RPDO[0] + BENCH_NODE

# objects of node 127 for a harness, each followed by its sub-indices
HARNESS = 0x2000  # 2000h
JOINED = 1
CYCLE = 2
END = 3

PACING = 0x2001  # 2001h
PACINGS = ("wall", "lockstep")  # the names of its values

FAULT = 0x2010  # 2010h
INJECT = 1
LIFT = 2

FRICTION = 0x2020  # 2020h, one sub-index for each axle
FRICTION_SCALE = 1e-4  # friction coefficient of one count

NOTE = 0x2030  # 2030h
FAILURE = 0x2031  # 2031h: why the test cannot go on; ends the run as a failure

REFUSAL = 0x2040  # 2040h, why the last command was refused
# 2041h, what the bench plays, as JSON: the resolved scenario, its hash, pacing, seed and unit
CONFIGURATION = 0x2041
