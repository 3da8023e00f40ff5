"""What rig, unit and harness have agreed on: identifiers and contents of their messages, node 127's objects.

An identifier is a service's first one plus the node, its literal stands beside it: a search for 211h
or 2010h ends here. Objects that carry signals stand in `signals`, those of a device profile with the
device. Magnets are one byte: bit 2j is the hold magnet of axle j + 1, bit 2j + 1 its vent magnet.
"""

import struct
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
from rollerrig.wsp_interface.signals import (
    BENCH_NODE,
    BRAKE_NODE,
    SANDER_NODE,
    SPEED_NODE,
    WSP_NODE,
)

# assumption
UNIT_LOST_AFTER_MS = 200
_LETTERS = {"U8": "B", "I8": "b", "U16": "H", "I16": "h", "U32": "I", "I32": "i"}


def unit_lost_after_ms(sync_period_s: float) -> int:
    """After how long a silence in ms the rig believes the unit lost: in lockstep SYNCs are its clock, two at least."""
    return max(UNIT_LOST_AFTER_MS, round(2000.0 * sync_period_s))


@dataclass(frozen=True)
class Layout:
    """A frame that carries whole signals of a node, all axles of each: columns and a scale for each."""

    can_id: int
    struct: struct.Struct
    names: tuple[str, ...]
    scales: tuple[float, ...]

    def read(self, data: bytes | bytearray) -> dict[str, float]:
        """Values by column; none where the frame has another length."""
        if len(data) != self.struct.size:
            return {}
        return {
            name: count * scale
            for name, scale, count in zip(
                self.names, self.scales, self.struct.unpack(data), strict=True
            )
        }


def layout(can_id: int, *names: str) -> Layout:
    """The layout of the frame in which a node sends these signals."""
    rows = [(signals.BY_NAME[name], signals.place(name, can_id & NODE_MASK)) for name in names]
    return Layout(
        can_id,
        struct.Struct("<" + "".join(_LETTERS[place.kind] * signal.axles for signal, place in rows)),
        tuple(column for signal, _ in rows for column in signals.columns(signal)),
        tuple(place.scale for signal, place in rows for _ in range(signal.axles)),
    )


def letter(place: signals.Place) -> str:
    """The struct letter of an object, little-endian."""
    return "<" + _LETTERS[place.kind]


# what the rig tells the unit, and the unit the rig
SPEEDS = layout(TPDO[0] + SPEED_NODE, "measured_speed")  # 190h
PRESSURES = layout(TPDO[0] + BRAKE_NODE, "cylinder_pressure")  # 191h
REFERENCE_SPEED = layout(TPDO[0] + WSP_NODE, "wsp_reference_speed")  # 1A0h
MAGNETS_ID = RPDO[0] + BRAKE_NODE  # 211h
SAND_ID, ALL_SANDERS = RPDO[0] + SANDER_NODE, 0x55  # 212h: bit 2j asks the sander of axle j + 1
UNIT_HEARTBEAT_ID = HEARTBEAT + WSP_NODE  # 720h
UNIT_EMERGENCY_ID = EMERGENCY + WSP_NODE  # 0A0h
# all that the unit takes or sends
UNIT_FRAMES = (
    NMT,
    SYNC,
    SPEEDS.can_id,
    REFERENCE_SPEED.can_id,
    MAGNETS_ID,
    UNIT_HEARTBEAT_ID,
    UNIT_EMERGENCY_ID,
)
# any byte: a harness on a bench in lockstep has seen this cycle
HARNESS_ANSWER_ID = RPDO[0] + BENCH_NODE  # 27Fh

# what a harness asks of node 127, by object and sub-index
HARNESS, JOINED, CYCLE, END = 0x2000, 1, 2, 3  # 2000h
PACING, PACINGS = 0x2001, ("wall", "lockstep")  # 2001h
FAULT, INJECT, LIFT = 0x2010, 1, 2  # 2010h
FRICTION, FRICTION_SCALE = 0x2020, 1e-4  # 2020h, one sub-index an axle
NOTE = 0x2030  # 2030h
