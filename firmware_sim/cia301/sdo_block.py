"""SDO block transfer: up to 127 segments for each confirmation, with a checksum over all the data.

The receiver confirms the last segment that came in sequence, and the sender goes on from there; the
end carries how many bytes of the last segment are filling, and the checksum. Source: CiA 301, SDO
block download and upload protocols; checksum x^16 + x^12 + x^5 + 1, initial value 0.
"""

from binascii import crc_hqx
from typing import Any

from rollerrig.firmware_sim.cia301.abort import Abort, AbortError
from rollerrig.firmware_sim.cia301.objects import LARGEST_BYTES

BLOCK = 127
_SEGMENT = 7
_BLOCK_END, _BLOCK_ACKNOWLEDGE, _BLOCK_START = 1, 2, 3


class BlockDownload:
    """A block download under way; the client may check the data by `checksum`."""

    def __init__(self, place: Any, size: int | None, checksum: bool) -> None:
        self.place, self.size, self.checksum = place, size, checksum
        self.data = bytearray()
        self.sequence, self.takes_segments = 0, True

    def confirmation(self) -> bytes:
        """The answer to the client's initiate request."""
        return b"\xa4" + self.place.raw + bytes([BLOCK, 0, 0, 0])

    def segment(self, data: bytes) -> bytes | None:
        """Take one segment; an answer is due after the last of the block or of the transfer."""
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if number == 0:
            raise AbortError(Abort.SEQUENCE_NUMBER)
        in_sequence = number == self.sequence + 1
        if in_sequence:
            self.sequence = number
            self.data += data[1:]
            if len(self.data) > LARGEST_BYTES + _SEGMENT:
                raise AbortError(Abort.OUT_OF_MEMORY)
        if not last and number != BLOCK:
            return None
        answer = bytes([0xA2, self.sequence, BLOCK]).ljust(8, b"\0")
        self.sequence = 0
        self.takes_segments = not (last and in_sequence)
        return answer

    def end(self, request: bytes) -> bytes:
        """The whole data, when the client's end agrees with what came. Raises AbortError."""
        if self.takes_segments:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        filling = request[0] >> 2 & 7
        data = bytes(self.data[:len(self.data) - filling])
        if self.checksum and crc_hqx(data, 0) != int.from_bytes(request[1:3], "little"):
            raise AbortError(Abort.CRC)
        if self.size is not None and self.size != len(data):
            raise AbortError(Abort.LENGTH_MISMATCH)
        return data


class BlockUpload:
    """A block upload under way: `at` is the byte that the next block begins with."""

    def __init__(self, place: Any, data: bytes, block: int, checksum: bool) -> None:
        self.place, self.data, self.block, self.checksum = place, data, block, checksum
        self.at, self.sent, self.done = 0, 0, False
        self._started = self._ending = False

    def step(self, command: int, request: bytes) -> list[bytes]:
        """The frames that answer the client's start, acknowledgement or end. Raises AbortError."""
        if command == _BLOCK_END and self._ending:
            self.done = True
            return []
        if command == _BLOCK_START and not self._started:
            self._started = True
            return self._block()
        if command == _BLOCK_ACKNOWLEDGE and self._started and not self._ending:
            return self._acknowledged(request[1], request[2])
        raise AbortError(Abort.UNKNOWN_COMMAND)

    def _acknowledged(self, number: int, block: int) -> list[bytes]:
        if number > self.sent:
            raise AbortError(Abort.SEQUENCE_NUMBER)
        if not 1 <= block <= BLOCK:
            raise AbortError(Abort.BLOCK_SIZE)
        whole = self.at + number * _SEGMENT >= len(self.data) and number == self.sent
        self.at, self.block = min(self.at + number * _SEGMENT, len(self.data)), block
        if not whole:
            return self._block()
        self._ending = True
        filling = -len(self.data) % _SEGMENT if self.data else _SEGMENT
        checksum = crc_hqx(self.data, 0) if self.checksum else 0
        return [bytes([0xC1 | filling << 2]) + checksum.to_bytes(2, "little") + bytes(5)]

    def _block(self) -> list[bytes]:
        parts = [self.data[at:at + _SEGMENT] for at in range(self.at, len(self.data), _SEGMENT)]
        parts = parts[:self.block] or [b""]
        last = self.at + len(parts) * _SEGMENT >= len(self.data)
        self.sent = len(parts)
        return [bytes([number | (last and number == len(parts)) << 7]) + part.ljust(_SEGMENT, b"\0")
                for number, part in enumerate(parts, 1)]
