"""One SDO server: answers a client's requests on one pair of identifiers, one transfer at a time.

Up to four bytes travel in the first exchange; longer values follow in segments with a toggle bit,
or in blocks of up to 127 segments for each confirmation: the receiver confirms the last segment that
came in sequence, the sender goes on from there, and the end carries a checksum over all the data.
Anything that breaks the protocol is answered by an abort code, and a transfer that the client leaves
lying is aborted after a time. Source: CiA 301, SDO protocols; checksum x^16 + x^12 + x^5 + 1,
initial value 0.
"""

from binascii import crc_hqx
from collections.abc import Callable
from typing import NamedTuple

from rollerrig.firmware_sim.cia301.objects import LARGEST_BYTES, Abort, AbortError, Objects

_SEGMENT, BLOCK = 7, 127
# client command specifiers
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)
_BLOCK_UPLOAD, _BLOCK_DOWNLOAD = 5, 6
_BLOCK_END, _BLOCK_ACKNOWLEDGE, _BLOCK_START = 1, 2, 3


class Place(NamedTuple):
    """Index and sub-index of a transfer, as three bytes and as numbers."""

    raw: bytes
    index: int  # type: ignore[assignment]
    sub: int


class Upload:
    """A segmented upload under way."""

    def __init__(self, place: Place, data: bytes) -> None:
        self.place, self.data, self.at, self.toggle = place, data, 0, 0

    def segment(self, request: bytes) -> tuple[bytes, bool]:
        """The answer to an upload-segment request, and whether it was the last one."""
        if request[0] >> 4 & 1 != self.toggle:
            raise AbortError(Abort.TOGGLE_BIT)
        part = self.data[self.at:self.at + _SEGMENT]
        self.at += len(part)
        last = self.at >= len(self.data)
        head = self.toggle << 4 | (_SEGMENT - len(part)) << 1 | last
        self.toggle ^= 1
        return bytes([head]) + part.ljust(_SEGMENT, b"\0"), last


class Download:
    """A segmented download under way. `size` None: the client did not tell it."""

    def __init__(self, place: Place, size: int | None) -> None:
        self.place, self.size, self.toggle = place, size, 0
        self.data = bytearray()

    def segment(self, request: bytes) -> tuple[bytes, bool]:
        """The answer to a download segment, and whether it was the last one."""
        if request[0] >> 4 & 1 != self.toggle:
            raise AbortError(Abort.TOGGLE_BIT)
        self.data += request[1:8 - (request[0] >> 1 & 7)]
        if len(self.data) > (LARGEST_BYTES if self.size is None else self.size):
            raise AbortError(Abort.OUT_OF_MEMORY if self.size is None else Abort.LENGTH_MISMATCH)
        answer = bytes([0x20 | self.toggle << 4]).ljust(8, b"\0")
        self.toggle ^= 1
        return answer, bool(request[0] & 1)


class BlockDownload:
    """A block download under way; the client may check the data by `checksum`."""

    def __init__(self, place: Place, size: int | None, checksum: bool) -> None:
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

    def __init__(self, place: Place, data: bytes, block: int, checksum: bool) -> None:
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


class SdoServer:
    """Answers requests by calling `reply(data)`; `active` is the transfer under way, if any."""

    def __init__(self, objects: Objects, reply: Callable[[bytes], None]) -> None:
        self.objects, self.reply = objects, reply
        self.active: Upload | Download | BlockUpload | BlockDownload | None = None
        self._steps: dict[int, Callable[[bytes], None]] = {
            _DOWNLOAD_SEGMENT: self._download_segment, _DOWNLOAD: self._download,
            _UPLOAD: self._upload, _UPLOAD_SEGMENT: self._upload_segment,
            _BLOCK_UPLOAD: self._block_upload, _BLOCK_DOWNLOAD: self._block_download,
        }

    def on_request(self, data: bytes) -> None:
        """A message from the client. One that has not eight bytes is not an SDO: no answer."""
        if len(data) != 8:
            return
        if data[0] == _ABORT << 5:
            self.active = None
            return
        try:
            if isinstance(self.active, BlockDownload) and self.active.takes_segments:
                self._answer(self.active.segment(data))
                return
            step = self._steps.get(data[0] >> 5)
            if step is None:
                raise AbortError(Abort.UNKNOWN_COMMAND)
            step(data)
        except AbortError as refused:
            place = self.active.place if self.active else _place(data)
            if data[0] >> 5 in (_DOWNLOAD, _UPLOAD):
                place = _place(data)
            self._abort(place, refused.code)

    def time_out(self) -> None:
        """The client has been silent for too long: give the transfer up and say so."""
        if self.active is not None:
            self._abort(self.active.place, Abort.TIME_OUT)

    def _abort(self, place: Place, code: Abort) -> None:
        self.active = None
        self.reply(b"\x80" + place.raw + code.to_bytes(4, "little"))

    def _answer(self, answer: bytes | None) -> None:
        if answer is not None:
            self.reply(answer)

    def _upload(self, request: bytes) -> None:
        place = _place(request)
        self.active = None
        self._begin_upload(place, self.objects.upload(place.index, place.sub))

    def _begin_upload(self, place: Place, data: bytes) -> None:
        if 0 < len(data) <= 4:
            self.reply(bytes([0x43 | (4 - len(data)) << 2]) + place.raw + data.ljust(4, b"\0"))
            return
        self.active = Upload(place, data)
        self.reply(b"\x41" + place.raw + len(data).to_bytes(4, "little"))

    def _upload_segment(self, request: bytes) -> None:
        if not isinstance(self.active, Upload):
            raise AbortError(Abort.UNKNOWN_COMMAND)
        answer, last = self.active.segment(request)
        if last:
            self.active = None
        self.reply(answer)

    def _download(self, request: bytes) -> None:
        place, head = _place(request), request[0]
        self.active = None
        if head & 2:
            size = 4 - (head >> 2 & 3) if head & 1 else None
            variable = self.objects.announce(place.index, place.sub, size)
            if size is None:
                size = min(4, len(variable) // 8) if variable.fixed_size else 4
            self.objects.download(place.index, place.sub, request[4:4 + size])
        else:
            size = int.from_bytes(request[4:], "little") if head & 1 else None
            self.objects.announce(place.index, place.sub, size)
            self.active = Download(place, size)
        self.reply(b"\x60" + place.raw + bytes(4))

    def _download_segment(self, request: bytes) -> None:
        transfer = self.active
        if not isinstance(transfer, Download):
            raise AbortError(Abort.UNKNOWN_COMMAND)
        answer, last = transfer.segment(request)
        if last:
            if transfer.size is not None and transfer.size != len(transfer.data):
                raise AbortError(Abort.LENGTH_MISMATCH)
            self.objects.download(transfer.place.index, transfer.place.sub, bytes(transfer.data))
            self.active = None
        self.reply(answer)

    def _block_download(self, request: bytes) -> None:
        if request[0] & 1:
            if not isinstance(self.active, BlockDownload):
                raise AbortError(Abort.UNKNOWN_COMMAND)
            data = self.active.end(request)
            self.objects.download(self.active.place.index, self.active.place.sub, data)
            self.active = None
            self.reply(b"\xa1".ljust(8, b"\0"))
            return
        place = _place(request)
        self.active = None
        size = int.from_bytes(request[4:], "little") if request[0] & 2 else None
        self.objects.announce(place.index, place.sub, size)
        transfer = self.active = BlockDownload(place, size, bool(request[0] & 4))
        self.reply(transfer.confirmation())

    def _block_upload(self, request: bytes) -> None:
        command = request[0] & 3
        if command == 0:
            self._begin_block_upload(request)
            return
        if not isinstance(self.active, BlockUpload):
            raise AbortError(Abort.UNKNOWN_COMMAND)
        transfer = self.active
        frames = transfer.step(command, request)
        if transfer.done:
            self.active = None
        for frame in frames:
            self.reply(frame)

    def _begin_block_upload(self, request: bytes) -> None:
        place, block, threshold = _place(request), request[4], request[5]
        self.active = None
        data = self.objects.upload(place.index, place.sub)
        if not 1 <= block <= BLOCK:
            raise AbortError(Abort.BLOCK_SIZE)
        if threshold and len(data) <= threshold:
            # the client asked for the ordinary protocol where the value is short
            self._begin_upload(place, data)
            return
        self.active = BlockUpload(place, data, block, bool(request[0] & 4))
        self.reply(b"\xc6" + place.raw + len(data).to_bytes(4, "little"))


def _place(data: bytes) -> Place:
    return Place(bytes(data[1:4]), int.from_bytes(data[1:3], "little"), data[3])
