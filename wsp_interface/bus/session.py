"""A protocol's side of one TCP client: bytes in, events out.

A session does not know the socket or the hub. It turns the bytes of a client into frames for the
bus, answers for the client and changes of mode. TCP may cut the bytes anywhere. A session answers
with an error, or skips, what it cannot parse; only a binary stream that is out of step closes its
client.
"""

from collections.abc import Iterator
from enum import IntEnum
from functools import lru_cache
from typing import TypeAlias

from rollerrig.wsp_interface.bus.frames import (
    BASE_ID_MAX,
    DATA_MAX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    REMOTE_FLAG,
    Frame,
)

COMMAND_MAX = 256  # bytes; the longest legal text command has about 60


class Mode(IntEnum):
    """What the hub does with a client from now on."""

    LISTEN = 1  # send it the frames of the bus
    MUTE = 2  # send it no more frames
    CLOSE = 3  # send it what still waits, then close it
    FOREIGN = 4  # it began with another protocol: close it and log a warning
    ERRORS = 5  # send it error frames as well


# a frame for the bus, an answer for the client, a change of mode
Event: TypeAlias = Frame | bytes | Mode


class Session:
    """The protocol state of one client.

    greeting: the events when the client connects.
    has_spoken: whether the client has sent a valid message. For socketcand it opens the bus.
    """

    greeting: tuple[Event, ...] = ()

    def __init__(self, *bus_names: str) -> None:
        self._bus_names = [name.encode() for name in bus_names]
        self._rest = b""  # the beginning of a message whose end has not arrived
        self._began = False  # the first bytes are not those of another protocol
        self.has_spoken = False  # a valid message has come

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the events that follow from the next bytes."""
        raise NotImplementedError


@lru_cache(4096)
def hex_id(can_id: int, extended: bool) -> bytes:
    """Return an identifier as text: eight digits when extended, else three."""
    if extended:
        return b"%08X" % can_id
    return b"%03X" % can_id


def flagged_frame(can_id: int, dlc: int, data: bytes) -> Frame | None:
    """Return the frame of an identifier with the flags of linux/can.h.

    None for an error frame, for a frame of CAN FD, and for a long identifier without its flag.
    """
    extended = bool(can_id & EXTENDED_FLAG)
    remote = bool(can_id & REMOTE_FLAG)
    plain_id = can_id & EXTENDED_ID_MAX
    if can_id & ERROR_FLAG or dlc > DATA_MAX:
        return None
    if plain_id > BASE_ID_MAX and not extended:
        return None
    if remote:
        return Frame(plain_id, b"", extended, True, dlc)
    return Frame(plain_id, data[:dlc], extended)
