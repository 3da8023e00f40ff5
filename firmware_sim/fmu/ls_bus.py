"""What an FMU and its CAN bus tell one another: the operations of FMI-LS-BUS, as bytes of a binary variable.

Each operation is a code and its length in bytes, then its arguments, little-endian without gaps; a variable may hold
several. Source: FMI-LS-BUS 1.0, network abstraction (low-cut) and CAN.
"""

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

from rollerrig.wsp_interface.bus.frames import Frame, check

MEDIA_TYPE = "application/org.fmi-standard.fmi-ls-bus."
# of Bus Error: what is wrong, and whether the node was the first to find it
BIT_ERROR, STUFF_ERROR, FORM_ERROR = 1, 2, 3
PRIMARY, SECONDARY = 1, 2
# of Status
STATES = {1: "error active", 2: "error passive", 3: "bus-off"}


class Code(IntEnum):
    """Operations of CAN, CAN FD and CAN XL."""

    FORMAT_ERROR = 0x01
    TRANSMIT = 0x10
    FD_TRANSMIT = 0x11
    XL_TRANSMIT = 0x12
    CONFIRM = 0x20
    ARBITRATION_LOST = 0x30
    BUS_ERROR = 0x31
    CONFIGURATION = 0x40
    STATUS = 0x41
    WAKEUP = 0x42


class Parameter(IntEnum):
    """What a Configuration sets."""

    BAUD_RATE = 1
    FD_BAUD_RATE = 2
    XL_BAUD_RATE = 3
    ARBITRATION_LOST_BEHAVIOUR = 4


# of ARBITRATION_LOST_BEHAVIOUR; else a frame waits for the bus
DISCARD = 2
_HEADER = struct.Struct("<II")
_ARGUMENTS = {
    code: struct.Struct(layout)
    for code, layout in {
        Code.FORMAT_ERROR: "<H",
        Code.TRANSMIT: "<IBBH",
        Code.FD_TRANSMIT: "<IBBBH",
        Code.XL_TRANSMIT: "<IBBBBIH",
        Code.CONFIRM: "<I",
        Code.ARBITRATION_LOST: "<I",
        Code.BUS_ERROR: "<IBBB",
        Code.CONFIGURATION: "<B",
        Code.STATUS: "<B",
        Code.WAKEUP: "",
    }.items()
}
# their last argument is how many bytes of data follow
_WITH_DATA = (Code.FORMAT_ERROR, Code.TRANSMIT, Code.FD_TRANSMIT, Code.XL_TRANSMIT)


class Operation(NamedTuple):
    """One operation: its fixed arguments, and what follows them."""

    code: Code
    values: tuple[int, ...]
    data: bytes

    @property
    def frame(self) -> Frame | None:
        """The frame of a TRANSMIT; None where no CAN controller could send it."""
        can_id, extended, remote, size = self.values
        try:
            return check(
                Frame(
                    can_id,
                    b"" if remote else self.data,
                    bool(extended),
                    bool(remote),
                    size if remote else 0,
                )
            )
        except ValueError:
            return None


def build(code: Code, *values: int, data: bytes = b"") -> bytes:
    """The bytes of an operation."""
    arguments = _ARGUMENTS[code].pack(*values)
    return _HEADER.pack(code, _HEADER.size + len(arguments) + len(data)) + arguments + data


def transmit(frame: Frame) -> bytes:
    """The operation that carries a frame."""
    return build(
        Code.TRANSMIT, frame.can_id, frame.extended, frame.remote, len(frame.data), data=frame.data
    )


def read(wire: bytes) -> Iterator[tuple[bytes, Operation | None]]:
    """Each operation with its bytes; None stands for one that is corrupt, as a Format Error tells."""
    while wire:
        code, size = _HEADER.unpack_from(wire) if len(wire) >= _HEADER.size else (0, 0)
        # where a length makes no sense, nothing behind it can be read
        sound = _HEADER.size <= size <= len(wire)
        raw = wire[:size] if sound else wire
        wire = wire[len(raw) :]
        yield raw, _operation(code, raw) if sound else None


def _operation(code: int, raw: bytes) -> Operation | None:
    if code not in _ARGUMENTS or len(raw) < _HEADER.size + _ARGUMENTS[Code(code)].size:
        return None
    layout = _ARGUMENTS[Code(code)]
    values, data = layout.unpack_from(raw, _HEADER.size), raw[_HEADER.size + layout.size :]
    follows = values[-1] if code in _WITH_DATA else 0
    if code == Code.CONFIGURATION:
        follows = 1 if values[0] == Parameter.ARBITRATION_LOST_BEHAVIOUR else 4
    return Operation(Code(code), values, data) if len(data) == follows else None
