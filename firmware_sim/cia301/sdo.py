"""One SDO server: answers a client's requests on one pair of identifiers, one transfer at a time.

Up to four bytes travel in the first exchange; longer values follow in segments with a toggle bit, or in blocks of up
to 127 segments for each confirmation: the receiver confirms the last segment that came in sequence, the sender goes
on from there, and the end carries a checksum over all the data. Anything that breaks the protocol is answered by an
abort code, and a transfer that the client leaves lying is aborted after a time. Source: CiA 301, SDO protocols;
checksum x^16 + x^12 + x^5 + 1, initial value 0.
"""

from binascii import crc_hqx
from collections.abc import Callable
from typing import TypeVar, cast

from rollerrig.firmware_sim.cia301.objects import LARGEST_BYTES, Abort, AbortError, Objects

_SEGMENT, BLOCK = 7, 127
# client command specifiers
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD = (
    range(7)
)
_BLOCK_INITIATE, _BLOCK_END, _BLOCK_ACKNOWLEDGE, _BLOCK_START = range(4)


class Transfer:
    """A transfer under way. `place`: index and sub-index as they stand in the messages, three bytes."""

    def __init__(self, place: bytes) -> None:
        self.place, self.toggle = place, 0

    def turn(self, request: bytes) -> int:
        """The toggle bit of a segment's request, in its place. AbortError if it is not the one that is due."""
        if request[0] >> 4 & 1 != self.toggle:
            raise AbortError(Abort.TOGGLE_BIT)
        self.toggle ^= 1
        return request[0] & 0x10


class Upload(Transfer):
    """A segmented upload under way."""

    def __init__(self, place: bytes, data: bytes) -> None:
        super().__init__(place)
        self.rest = data

    def segment(self, request: bytes) -> bytes:
        """The answer to an upload-segment request; bit 0 tells the last one."""
        toggle, part, self.rest = self.turn(request), self.rest[:_SEGMENT], self.rest[_SEGMENT:]
        head = toggle | (_SEGMENT - len(part)) << 1 | (not self.rest)
        return bytes([head]) + part.ljust(_SEGMENT, b"\0")


class Download(Transfer):
    """A segmented download under way. `size` None: the client did not tell it."""

    def __init__(self, place: bytes, size: int | None) -> None:
        super().__init__(place)
        self.size, self.data = size, bytearray()

    def segment(self, request: bytes) -> bytes:
        """The answer to a download segment."""
        toggle = self.turn(request)
        self.data += request[1 : 8 - (request[0] >> 1 & 7)]
        if len(self.data) > (LARGEST_BYTES if self.size is None else self.size):
            raise AbortError(Abort.OUT_OF_MEMORY if self.size is None else Abort.LENGTH_MISMATCH)
        return bytes([0x20 | toggle]).ljust(8, b"\0")

    def whole(self) -> bytes:
        """All the data. AbortError if the client has announced another length."""
        if self.size not in (None, len(self.data)):
            raise AbortError(Abort.LENGTH_MISMATCH)
        return bytes(self.data)


class BlockDownload(Download):
    """A block download under way; the client may check the data by `checksum`."""

    def __init__(self, place: bytes, size: int | None, checksum: bool) -> None:
        super().__init__(place, size)
        self.checksum, self.sequence, self.takes_segments = checksum, 0, True

    def block_segment(self, data: bytes) -> bytes | None:
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
        self.sequence, self.takes_segments = 0, not (last and in_sequence)
        return answer

    def end(self, request: bytes) -> bytes:
        """The whole data, when the client's end agrees with what came. Raises AbortError."""
        if self.takes_segments:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        filling = request[0] >> 2 & 7
        self.data = self.data[: len(self.data) - filling]
        if self.checksum and crc_hqx(self.data, 0) != int.from_bytes(request[1:3], "little"):
            raise AbortError(Abort.CRC)
        return self.whole()


class BlockUpload(Transfer):
    """A block upload under way: `at` is the byte that the next block begins with."""

    def __init__(self, place: bytes, data: bytes, block: int, checksum: bool) -> None:
        super().__init__(place)
        self.data, self.block, self.checksum, self.at, self.sent = data, block, checksum, 0, 0
        # what the client has to send next
        self._due = _BLOCK_START

    def step(self, request: bytes) -> list[bytes]:
        """The frames that answer the client's start or acknowledgement; none after its end. Raises AbortError."""
        command = request[0] & 3
        if command != self._due:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        if command == _BLOCK_ACKNOWLEDGE:
            return self._acknowledged(request[1], request[2])
        self._due = _BLOCK_ACKNOWLEDGE
        return self._block() if command == _BLOCK_START else []

    def _acknowledged(self, number: int, block: int) -> list[bytes]:
        if number > self.sent:
            raise AbortError(Abort.SEQUENCE_NUMBER)
        if not 1 <= block <= BLOCK:
            raise AbortError(Abort.BLOCK_SIZE)
        whole = self.at + number * _SEGMENT >= len(self.data) and number == self.sent
        self.at, self.block = min(self.at + number * _SEGMENT, len(self.data)), block
        if not whole:
            return self._block()
        self._due = _BLOCK_END
        filling = -len(self.data) % _SEGMENT if self.data else _SEGMENT
        checksum = crc_hqx(self.data, 0) if self.checksum else 0
        return [bytes([0xC1 | filling << 2]) + checksum.to_bytes(2, "little") + bytes(5)]

    def _block(self) -> list[bytes]:
        parts = [self.data[at : at + _SEGMENT] for at in range(self.at, len(self.data), _SEGMENT)]
        parts = parts[: self.block] or [b""]
        last = self.at + len(parts) * _SEGMENT >= len(self.data)
        self.sent = len(parts)
        return [
            bytes([number | (last and number == len(parts)) << 7]) + part.ljust(_SEGMENT, b"\0")
            for number, part in enumerate(parts, 1)
        ]


T = TypeVar("T", bound=Transfer)


class SdoServer:
    """Answers requests by calling `reply(data)`; `active` is the transfer under way, if any."""

    def __init__(self, objects: Objects, reply: Callable[[bytes], None]) -> None:
        self.objects, self.reply = objects, reply
        self.active: Transfer | None = None
        self._steps: dict[int, Callable[[bytes], None]] = {
            _DOWNLOAD_SEGMENT: self._download_segment,
            _DOWNLOAD: self._download,
            _UPLOAD: self._upload,
            _UPLOAD_SEGMENT: self._upload_segment,
            _BLOCK_UPLOAD: self._block_upload,
            _BLOCK_DOWNLOAD: self._block_download,
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
                answer = self.active.block_segment(data)
                if answer is not None:
                    self.reply(answer)
                return
            step = self._steps.get(data[0] >> 5)
            if step is None:
                raise AbortError(Abort.UNKNOWN_COMMAND)
            step(data)
        except AbortError as refused:
            transfer = None if data[0] >> 5 in (_DOWNLOAD, _UPLOAD) else self.active
            self._abort(transfer.place if transfer else data[1:4], refused.code)

    def time_out(self) -> None:
        """The client has been silent for too long: give the transfer up and say so."""
        if self.active is not None:
            self._abort(self.active.place, Abort.TIME_OUT)

    def _abort(self, place: bytes, code: Abort) -> None:
        self.active = None
        self.reply(b"\x80" + place + code.to_bytes(4, "little"))

    def _running(self, kind: type[T]) -> T:
        """The transfer under way. AbortError if it is not of this kind."""
        if type(self.active) is not kind:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        return cast(T, self.active)

    def _finish(self, transfer: Download, data: bytes) -> None:
        """Store what has been downloaded."""
        self.objects.download(*_at(transfer.place), data)
        self.active = None

    def _upload(self, request: bytes) -> None:
        self.active = None
        self._begin_upload(request[1:4], self.objects.upload(*_at(request[1:4])))

    def _begin_upload(self, place: bytes, data: bytes) -> None:
        if 0 < len(data) <= 4:
            self.reply(bytes([0x43 | (4 - len(data)) << 2]) + place + data.ljust(4, b"\0"))
            return
        self.active = Upload(place, data)
        self.reply(b"\x41" + place + len(data).to_bytes(4, "little"))

    def _upload_segment(self, request: bytes) -> None:
        answer = self._running(Upload).segment(request)
        if answer[0] & 1:
            self.active = None
        self.reply(answer)

    def _download(self, request: bytes) -> None:
        place, head = request[1:4], request[0]
        self.active = None
        if head & 2:
            size = 4 - (head >> 2 & 3) if head & 1 else None
            variable = self.objects.announce(*_at(place), size)
            if size is None:
                size = min(4, len(variable) // 8) if variable.fixed_size else 4
            self.objects.download(*_at(place), request[4 : 4 + size])
        else:
            size = int.from_bytes(request[4:], "little") if head & 1 else None
            self.objects.announce(*_at(place), size)
            self.active = Download(place, size)
        self.reply(b"\x60" + place + bytes(4))

    def _download_segment(self, request: bytes) -> None:
        transfer = self._running(Download)
        answer = transfer.segment(request)
        if request[0] & 1:
            self._finish(transfer, transfer.whole())
        self.reply(answer)

    def _block_download(self, request: bytes) -> None:
        if request[0] & 1:
            transfer = self._running(BlockDownload)
            self._finish(transfer, transfer.end(request))
            self.reply(b"\xa1".ljust(8, b"\0"))
            return
        place, self.active = request[1:4], None
        size = int.from_bytes(request[4:], "little") if request[0] & 2 else None
        self.objects.announce(*_at(place), size)
        self.active = BlockDownload(place, size, bool(request[0] & 4))
        self.reply(b"\xa4" + place + bytes([BLOCK, 0, 0, 0]))

    def _block_upload(self, request: bytes) -> None:
        if request[0] & 3 != _BLOCK_INITIATE:
            frames = self._running(BlockUpload).step(request)
            if not frames:
                self.active = None
            for frame in frames:
                self.reply(frame)
            return
        place, block, threshold = request[1:4], request[4], request[5]
        self.active = None
        data = self.objects.upload(*_at(place))
        if not 1 <= block <= BLOCK:
            raise AbortError(Abort.BLOCK_SIZE)
        if threshold and len(data) <= threshold:
            # the client asked for the ordinary protocol where the value is short
            self._begin_upload(place, data)
            return
        self.active = BlockUpload(place, data, block, bool(request[0] & 4))
        self.reply(b"\xc6" + place + len(data).to_bytes(4, "little"))


def _at(place: bytes) -> tuple[int, int]:
    return int.from_bytes(place[:2], "little"), place[2]
