"""cannelloni over TCP: frames of a SocketCAN tunnel, one after the other without delimiters.

Both sides first send CANNELLONIv1. Then a frame is:

    4 bytes  identifier with the flags of linux/can.h, big-endian
    1 byte   data length code; bit 7 marks a frame of CAN FD
    1 byte   flags, only of a frame of CAN FD
    n bytes  data, none in a remote frame

Frames of CAN FD are read and dropped.

Source: cannelloni `doc/tcp_protocol.md`.
"""

from collections.abc import Iterator

from rollerrig.wsp_interface.bus.frames import DATA_MAX, EXTENDED_FLAG, REMOTE_FLAG, Frame, length
from rollerrig.wsp_interface.bus.session import Event, Mode, Session, flagged_frame

HELLO = b"CANNELLONIv1"
_FD_FLAG = 0x80
_FD_DATA_MAX = 64
_HEAD_BYTES = 5  # identifier and length
_FD_HEAD_BYTES = 6


class CannelloniSession(Session):
    """The server's side of one client."""

    greeting = (HELLO,)

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the frames in the chunk; FOREIGN for another protocol, CLOSE for a wrong length."""
        rest = self._rest + chunk
        if not self._began:
            if not HELLO.startswith(rest[: len(HELLO)]):
                yield Mode.FOREIGN
                return
            if len(rest) >= len(HELLO):
                self._began = True
                self.has_spoken = True
                rest = rest[len(HELLO) :]
                yield Mode.LISTEN

        while self._began and len(rest) >= _HEAD_BYTES:
            can_id = int.from_bytes(rest[:4], "big")
            is_fd = bool(rest[4] & _FD_FLAG)
            dlc = rest[4] & ~_FD_FLAG
            if dlc > (_FD_DATA_MAX if is_fd else DATA_MAX):
                yield Mode.CLOSE
                return
            start = _FD_HEAD_BYTES if is_fd else _HEAD_BYTES
            end = start if can_id & REMOTE_FLAG else start + dlc
            if len(rest) < end:
                break
            data = rest[start:end]
            rest = rest[end:]
            if is_fd:
                continue
            frame = flagged_frame(can_id, dlc, data)
            if frame is not None:
                yield frame
        self._rest = rest


def encode_event(frame: Frame) -> bytes:
    """Return identifier with flags, length and data; a remote frame ends with its length."""
    can_id = frame.can_id
    if frame.extended:
        can_id |= EXTENDED_FLAG
    if frame.remote:
        can_id |= REMOTE_FLAG
    return can_id.to_bytes(4, "big") + bytes((length(frame),)) + frame.data
