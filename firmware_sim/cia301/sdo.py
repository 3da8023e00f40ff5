"""One SDO server: answers a client's requests on one pair of identifiers, one transfer at a time.

Up to four bytes are transferred in the first exchange. Longer values follow in segments with a
toggle bit, or in blocks of up to 127 segments. The receiver confirms the last segment of a block
that came in sequence, and the sender continues from there. The end of a block transfer has a
checksum of all data. The server answers a violation of the protocol with an abort code. It aborts a
transfer if the client is silent for too long. Source: CiA 301, SDO protocols; checksum x^16 + x^12
+ x^5 + 1, initial value 0.
"""

from binascii import crc_hqx
from collections.abc import Callable
from typing import TypeVar, cast

from rollerrig.firmware_sim.cia301.objects import LARGEST_BYTES, Abort, AbortError, Objects

_SEGMENT = 7  # bytes of data in a segment
BLOCK = 127  # segments in a block at most

# client command specifiers: bits 5 to 7 of the first byte
_DOWNLOAD_SEGMENT = 0
_DOWNLOAD = 1
_UPLOAD = 2
_UPLOAD_SEGMENT = 3
_ABORT = 4
_BLOCK_UPLOAD = 5
_BLOCK_DOWNLOAD = 6
# server command specifiers: the first byte of an answer, without its flags
_SEGMENT_DOWNLOADED = 0x20
_UPLOAD_INITIATED = 0x40
_DOWNLOAD_INITIATED = 0x60
_ABORTED = 0x80
_BLOCK_DOWNLOAD_INITIATED = 0xA0
_BLOCK_DOWNLOAD_ENDED = 0xA1
_BLOCK_ACKNOWLEDGED = 0xA2
_BLOCK_UPLOAD_INITIATED = 0xC0
_BLOCK_UPLOAD_ENDED = 0xC1
# flags of the first byte
_SIZE_GIVEN = 0x01
_EXPEDITED = 0x02
_LAST_SEGMENT = 0x01
_TOGGLE = 0x10
_BLOCK_SIZE_GIVEN = 0x02
_BLOCK_CHECKSUM = 0x04
_LAST_OF_BLOCKS = 0x80  # of a block segment, next to its number
# client subcommands of a block upload: bits 0 and 1 of the first byte
_BLOCK_INITIATE = 0
_BLOCK_END = 1
_BLOCK_ACKNOWLEDGE = 2
_BLOCK_START = 3


class Transfer:
    """A transfer in progress. `place`: index and sub-index as in the messages, three bytes."""

    def __init__(self, place: bytes) -> None:
        self.place = place
        self.toggle = 0

    def check_toggle(self, request: bytes) -> int:
        """Return the toggle bit of a segment's request, at its position in the byte.

        Raises AbortError if the bit is not the expected one.
        """
        if request[0] >> 4 & 1 != self.toggle:
            raise AbortError(Abort.TOGGLE_BIT)
        self.toggle ^= 1
        return request[0] & _TOGGLE


class Upload(Transfer):
    """A segmented upload in progress."""

    def __init__(self, place: bytes, data: bytes) -> None:
        super().__init__(place)
        self.rest = data

    def segment(self, request: bytes) -> bytes:
        """Return the answer to an upload-segment request; bit 0 is set in the last one."""
        toggle = self.check_toggle(request)
        part = self.rest[:_SEGMENT]
        self.rest = self.rest[_SEGMENT:]
        unused = _SEGMENT - len(part)
        last = not self.rest
        return bytes([toggle | unused << 1 | last]) + part.ljust(_SEGMENT, b"\0")


class Download(Transfer):
    """A segmented download in progress. `size` None: the client has not announced it."""

    def __init__(self, place: bytes, size: int | None) -> None:
        super().__init__(place)
        self.size = size
        self.data = bytearray()

    def segment(self, request: bytes) -> bytes:
        """Return the answer to a download segment."""
        toggle = self.check_toggle(request)
        unused = request[0] >> 1 & 7
        self.data += request[1 : 8 - unused]
        if self.size is not None and len(self.data) > self.size:
            raise AbortError(Abort.LENGTH_MISMATCH)
        if self.size is None and len(self.data) > LARGEST_BYTES:
            raise AbortError(Abort.OUT_OF_MEMORY)
        return bytes([_SEGMENT_DOWNLOADED | toggle]).ljust(8, b"\0")

    def complete_data(self) -> bytes:
        """Return all data. Raises AbortError if the client has announced another length."""
        if self.size not in (None, len(self.data)):
            raise AbortError(Abort.LENGTH_MISMATCH)
        return bytes(self.data)


class BlockDownload(Download):
    """A block download in progress.

    `checksum`: the end of the transfer has a checksum. `sequence`: number of the last segment of
    the block that came in sequence. `takes_segments`: the next message is a segment.
    """

    def __init__(self, place: bytes, size: int | None, checksum: bool) -> None:
        super().__init__(place, size)
        self.checksum = checksum
        self.sequence = 0
        self.takes_segments = True

    def block_segment(self, data: bytes) -> bytes | None:
        """Take one segment. Returns an answer only after the last one of a block."""
        number = data[0] & ~_LAST_OF_BLOCKS
        last = bool(data[0] & _LAST_OF_BLOCKS)
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
        answer = bytes([_BLOCK_ACKNOWLEDGED, self.sequence, BLOCK]).ljust(8, b"\0")
        self.sequence = 0
        self.takes_segments = not (last and in_sequence)
        return answer

    def end(self, request: bytes) -> bytes:
        """Return all data at the end. Raises AbortError if length or checksum differ."""
        if self.takes_segments:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        unused = request[0] >> 2 & 7
        self.data = self.data[: len(self.data) - unused]
        checksum = int.from_bytes(request[1:3], "little")
        if self.checksum and crc_hqx(self.data, 0) != checksum:
            raise AbortError(Abort.CRC)
        return self.complete_data()


class BlockUpload(Transfer):
    """A block upload in progress.

    `block`: segments in a block. `at`: the byte with which the next block begins. `sent`: segments
    in the last block.
    """

    def __init__(self, place: bytes, data: bytes, block: int, checksum: bool) -> None:
        super().__init__(place)
        self.data = data
        self.block = block
        self.checksum = checksum
        self.at = 0
        self.sent = 0
        self._due = _BLOCK_START  # the subcommand that the client must send next

    def step(self, request: bytes) -> list[bytes]:
        """Return the frames that answer the client's start or acknowledgement; none after its end.

        Raises AbortError.
        """
        command = request[0] & 3
        if command != self._due:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        if command == _BLOCK_ACKNOWLEDGE:
            return self._acknowledged(request[1], request[2])
        self._due = _BLOCK_ACKNOWLEDGE
        return self._block() if command == _BLOCK_START else []

    def _acknowledged(self, number: int, block: int) -> list[bytes]:
        """Return the next frames after the client has confirmed the segments up to `number`.

        `block` is the number of segments that the client allows in the next block.
        """
        if number > self.sent:
            raise AbortError(Abort.SEQUENCE_NUMBER)
        if not 1 <= block <= BLOCK:
            raise AbortError(Abort.BLOCK_SIZE)
        confirmed = self.at + number * _SEGMENT
        complete = confirmed >= len(self.data) and number == self.sent
        self.at = min(confirmed, len(self.data))
        self.block = block
        if not complete:
            return self._block()

        self._due = _BLOCK_END
        # an empty value has one empty segment
        unused = -len(self.data) % _SEGMENT if self.data else _SEGMENT
        checksum = crc_hqx(self.data, 0) if self.checksum else 0
        command = _BLOCK_UPLOAD_ENDED | unused << 2
        return [bytes([command]) + checksum.to_bytes(2, "little") + bytes(5)]

    def _block(self) -> list[bytes]:
        """Return the segments of the next block. The last one of the transfer has bit 7."""
        parts = [self.data[at : at + _SEGMENT] for at in range(self.at, len(self.data), _SEGMENT)]
        parts = parts[: self.block]
        if not parts:
            parts = [b""]
        self.sent = len(parts)
        reaches_end = self.at + len(parts) * _SEGMENT >= len(self.data)
        frames = []
        for number, part in enumerate(parts, 1):
            last = reaches_end and number == len(parts)
            first_byte = number | _LAST_OF_BLOCKS if last else number
            frames.append(bytes([first_byte]) + part.ljust(_SEGMENT, b"\0"))
        return frames


T = TypeVar("T", bound=Transfer)


class SdoServer:
    """Answers requests by calling `reply(data)`; `active` is the transfer in progress, if any."""

    def __init__(self, objects: Objects, reply: Callable[[bytes], None]) -> None:
        self.objects = objects
        self.reply = reply
        self.active: Transfer | None = None
        self._services: dict[int, Callable[[bytes], None]] = {
            _DOWNLOAD_SEGMENT: self._download_segment,
            _DOWNLOAD: self._download,
            _UPLOAD: self._upload,
            _UPLOAD_SEGMENT: self._upload_segment,
            _BLOCK_UPLOAD: self._block_upload,
            _BLOCK_DOWNLOAD: self._block_download,
        }

    def on_request(self, data: bytes) -> None:
        """Take a message from the client. A message without eight bytes is no SDO: no answer."""
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
            service = self._services.get(data[0] >> 5)
            if service is None:
                raise AbortError(Abort.UNKNOWN_COMMAND)
            service(data)
        except AbortError as refusal:
            # a request that begins a transfer has its place; others concern the active transfer
            begins = data[0] >> 5 in (_DOWNLOAD, _UPLOAD)
            place = data[1:4] if begins or self.active is None else self.active.place
            self._abort(place, refusal.code)

    def time_out(self) -> None:
        """Abort the transfer, because the client has been silent for too long."""
        if self.active is not None:
            self._abort(self.active.place, Abort.TIME_OUT)

    def _abort(self, place: bytes, code: Abort) -> None:
        self.active = None
        self.reply(bytes([_ABORTED]) + place + code.to_bytes(4, "little"))

    def _running(self, kind: type[T]) -> T:
        """Return the transfer in progress. Raises AbortError if it is not of this kind."""
        if type(self.active) is not kind:
            raise AbortError(Abort.UNKNOWN_COMMAND)
        return cast(T, self.active)

    def _finish(self, transfer: Download, data: bytes) -> None:
        """Store the downloaded data."""
        self.objects.download(*_index_and_sub(transfer.place), data)
        self.active = None

    def _upload(self, request: bytes) -> None:
        self.active = None
        place = request[1:4]
        self._begin_upload(place, self.objects.upload(*_index_and_sub(place)))

    def _begin_upload(self, place: bytes, data: bytes) -> None:
        """Send a short value in the answer (expedited), or begin a segmented upload."""
        if 0 < len(data) <= 4:
            unused = 4 - len(data)
            command = _UPLOAD_INITIATED | _EXPEDITED | _SIZE_GIVEN | unused << 2
            self.reply(bytes([command]) + place + data.ljust(4, b"\0"))
            return
        self.active = Upload(place, data)
        command = _UPLOAD_INITIATED | _SIZE_GIVEN
        self.reply(bytes([command]) + place + len(data).to_bytes(4, "little"))

    def _upload_segment(self, request: bytes) -> None:
        answer = self._running(Upload).segment(request)
        if answer[0] & _LAST_SEGMENT:
            self.active = None
        self.reply(answer)

    def _download(self, request: bytes) -> None:
        place = request[1:4]
        expedited = request[0] & _EXPEDITED
        size_given = request[0] & _SIZE_GIVEN
        self.active = None
        if expedited:
            self._download_expedited(request)
        else:
            size = int.from_bytes(request[4:], "little") if size_given else None
            self.objects.announce(*_index_and_sub(place), size)
            self.active = Download(place, size)
        self.reply(bytes([_DOWNLOAD_INITIATED]) + place + bytes(4))

    def _download_expedited(self, request: bytes) -> None:
        """Store a value of up to four bytes that the request itself contains."""
        place = request[1:4]
        size_given = request[0] & _SIZE_GIVEN
        size = 4 - (request[0] >> 2 & 3) if size_given else None
        variable = self.objects.announce(*_index_and_sub(place), size)
        if size is None:
            size = 4
            if variable.fixed_size:
                size = min(4, len(variable) // 8)
        self.objects.download(*_index_and_sub(place), request[4 : 4 + size])

    def _download_segment(self, request: bytes) -> None:
        transfer = self._running(Download)
        answer = transfer.segment(request)
        if request[0] & _LAST_SEGMENT:
            self._finish(transfer, transfer.complete_data())
        self.reply(answer)

    def _block_download(self, request: bytes) -> None:
        ends = request[0] & 1
        if ends:
            transfer = self._running(BlockDownload)
            self._finish(transfer, transfer.end(request))
            self.reply(bytes([_BLOCK_DOWNLOAD_ENDED]).ljust(8, b"\0"))
            return
        place = request[1:4]
        size_given = request[0] & _BLOCK_SIZE_GIVEN
        checksum = bool(request[0] & _BLOCK_CHECKSUM)
        self.active = None
        size = int.from_bytes(request[4:], "little") if size_given else None
        self.objects.announce(*_index_and_sub(place), size)
        self.active = BlockDownload(place, size, checksum)
        command = _BLOCK_DOWNLOAD_INITIATED | _BLOCK_CHECKSUM
        self.reply(bytes([command]) + place + bytes([BLOCK, 0, 0, 0]))

    def _block_upload(self, request: bytes) -> None:
        if request[0] & 3 != _BLOCK_INITIATE:
            frames = self._running(BlockUpload).step(request)
            if not frames:
                self.active = None
            for frame in frames:
                self.reply(frame)
            return
        place = request[1:4]
        block = request[4]
        threshold = request[5]  # bytes; up to this length the client prefers the ordinary protocol
        checksum = bool(request[0] & _BLOCK_CHECKSUM)
        self.active = None
        data = self.objects.upload(*_index_and_sub(place))
        if not 1 <= block <= BLOCK:
            raise AbortError(Abort.BLOCK_SIZE)
        if threshold and len(data) <= threshold:
            self._begin_upload(place, data)
            return
        self.active = BlockUpload(place, data, block, checksum)
        command = _BLOCK_UPLOAD_INITIATED | _BLOCK_CHECKSUM | _BLOCK_SIZE_GIVEN
        self.reply(bytes([command]) + place + len(data).to_bytes(4, "little"))


def _index_and_sub(place: bytes) -> tuple[int, int]:
    """Return index and sub-index of a place in a message."""
    return int.from_bytes(place[:2], "little"), place[2]
