"""virtualcan: a binary protocol of virtual CAN buses over TCP. gocanopen uses it as well.

A packet is its length (four bytes, big-endian, always 14) and a frame:

    4 bytes  identifier, big-endian; bit 30 marks a remote frame
    1 byte   flags; bit 0 marks an extended identifier
    1 byte   data length code
    8 bytes  data

There is no handshake. A client gets every frame from the start. A packet of another length is
skipped, unless the length is so large that the stream must be out of step.

Sources: virtualcan's `can_message.py`; gocanopen's virtual bus.
"""

import struct
from collections.abc import Iterator

from rollerrig.wsp_interface.bus.frames import EXTENDED_FLAG, REMOTE_FLAG, Frame, length
from rollerrig.wsp_interface.bus.session import Event, Mode, Session, flagged_frame

_PACKET = struct.Struct(">IBB8s")  # identifier, flags, length, data
_PACKET_MAX = 64  # bytes; a longer packet shows that the stream is out of step
_LENGTH_BYTES = 4
_EXTENDED_BIT = 1  # of the flags


class VirtualcanSession(Session):
    """The server's side of one client."""

    greeting = (Mode.LISTEN,)

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the frames that are now complete.

        After a length above the limit nothing more can be parsed. The last event is then FOREIGN
        when it was the first length of all (the client uses another protocol), else CLOSE.
        """
        rest = self._rest + chunk
        while len(rest) >= _LENGTH_BYTES:
            size = int.from_bytes(rest[:_LENGTH_BYTES], "big")
            if size > _PACKET_MAX:
                # the client is closed a little later, and may send more until then: what is
                # parsed already must not be parsed again
                self._rest = rest
                yield Mode.CLOSE if self._began else Mode.FOREIGN
                return

            end = _LENGTH_BYTES + size
            if len(rest) < end:
                break  # the end of the packet has not arrived

            packet = rest[_LENGTH_BYTES:end]
            rest = rest[end:]
            self._began = True
            frame = _parse_packet(packet)
            if frame is not None:
                self.has_spoken = True
                yield frame
        self._rest = rest


def _parse_packet(packet: bytes) -> Frame | None:
    """Return the frame of a packet without its length, None when it is not a classical frame."""
    if len(packet) != _PACKET.size:
        return None
    can_id, flags, dlc, data = _PACKET.unpack(packet)
    if flags & _EXTENDED_BIT:
        can_id |= EXTENDED_FLAG
    # bit 30 is where REMOTE_FLAG is, so `flagged_frame` recognises a remote frame
    return flagged_frame(can_id, dlc, data)


def encode_event(frame: Frame) -> bytes:
    """Return the packet of a frame, with its length in front."""
    can_id = frame.can_id
    if frame.remote:
        can_id |= REMOTE_FLAG
    flags = _EXTENDED_BIT if frame.extended else 0
    # the format pads the data with zeros to eight bytes
    packet = _PACKET.pack(can_id, flags, length(frame), frame.data)
    return len(packet).to_bytes(_LENGTH_BYTES, "big") + packet
