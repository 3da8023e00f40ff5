"""The operations that an FMU and its CAN bus exchange (FMI-LS-BUS), as bytes of a binary variable.

Each operation is its code and its length in bytes, followed by its arguments, little-endian without
gaps. A variable may hold several operations.
Source: FMI-LS-BUS 1.0, network abstraction (low-cut) and CAN.
"""

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

from rollerrig.wsp_interface.bus.frames import Frame, check

MEDIA_TYPE = "application/org.fmi-standard.fmi-ls-bus."

# Bus Error: the kind of error
BIT_ERROR = 1
STUFF_ERROR = 2
FORM_ERROR = 3
# Bus Error: whether the node was the first to find it
PRIMARY = 1
SECONDARY = 2

# Status: the states of a CAN controller
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
    """The parameters that a Configuration can set."""

    BAUD_RATE = 1
    FD_BAUD_RATE = 2
    XL_BAUD_RATE = 3
    ARBITRATION_LOST_BEHAVIOUR = 4


# value of ARBITRATION_LOST_BEHAVIOUR: the frame is discarded; with any other value it waits
DISCARD = 2

_HEADER = struct.Struct("<II")  # code and length
_ARGUMENTS = {
    Code.FORMAT_ERROR: struct.Struct("<H"),
    Code.TRANSMIT: struct.Struct("<IBBH"),
    Code.FD_TRANSMIT: struct.Struct("<IBBBH"),
    Code.XL_TRANSMIT: struct.Struct("<IBBBBIH"),
    Code.CONFIRM: struct.Struct("<I"),
    Code.ARBITRATION_LOST: struct.Struct("<I"),
    Code.BUS_ERROR: struct.Struct("<IBBB"),
    Code.CONFIGURATION: struct.Struct("<B"),
    Code.STATUS: struct.Struct("<B"),
    Code.WAKEUP: struct.Struct("<"),
}
# the last argument of these is the number of data bytes that follow
_WITH_DATA = (Code.FORMAT_ERROR, Code.TRANSMIT, Code.FD_TRANSMIT, Code.XL_TRANSMIT)
# the data bytes of a Configuration depend on its parameter
_BEHAVIOUR_BYTES = 1
_BAUD_RATE_BYTES = 4


class Operation(NamedTuple):
    """One operation: its arguments of fixed size, and the data that follow them."""

    code: Code
    values: tuple[int, ...]
    data: bytes

    @property
    def frame(self) -> Frame | None:
        """The frame of a TRANSMIT; None if no CAN controller could send it."""
        can_id, extended, remote, size = self.values
        try:
            if remote:
                return check(Frame(can_id, b"", bool(extended), True, size))
            return check(Frame(can_id, self.data, bool(extended), False, 0))
        except ValueError:
            return None


def build(code: Code, *values: int, data: bytes = b"") -> bytes:
    """Return the bytes of an operation."""
    arguments = _ARGUMENTS[code].pack(*values)
    size = _HEADER.size + len(arguments) + len(data)
    return _HEADER.pack(code, size) + arguments + data


def transmit(frame: Frame) -> bytes:
    """Return the operation that carries a frame."""
    return build(
        Code.TRANSMIT,
        frame.can_id,
        frame.extended,
        frame.remote,
        len(frame.data),
        data=frame.data,
    )


def read(wire: bytes) -> Iterator[tuple[bytes, Operation | None]]:
    """Yield each operation with its bytes.

    A corrupt operation is None; the sender of its bytes is answered with a Format Error.
    """
    while wire:
        code = 0
        size = 0
        if len(wire) >= _HEADER.size:
            code, size = _HEADER.unpack_from(wire)
        if not _HEADER.size <= size <= len(wire):
            # the length is wrong, so nothing behind this operation can be read
            yield wire, None
            return
        raw = wire[:size]
        wire = wire[size:]
        yield raw, _operation(code, raw)


def _operation(number: int, raw: bytes) -> Operation | None:
    """Return the operation with a code number and its bytes; None if it is corrupt."""
    if number not in _ARGUMENTS:
        return None
    code = Code(number)
    layout = _ARGUMENTS[code]
    if len(raw) < _HEADER.size + layout.size:
        return None
    values = layout.unpack_from(raw, _HEADER.size)
    data = raw[_HEADER.size + layout.size :]

    expected_bytes = 0
    if code in _WITH_DATA:
        expected_bytes = values[-1]
    elif code == Code.CONFIGURATION:
        is_behaviour = values[0] == Parameter.ARBITRATION_LOST_BEHAVIOUR
        expected_bytes = _BEHAVIOUR_BYTES if is_behaviour else _BAUD_RATE_BYTES
    if len(data) != expected_bytes:
        return None
    return Operation(code, values, data)
