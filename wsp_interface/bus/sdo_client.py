"""A small SDO client: it writes and reads one object of a node at a time over an open bus.

Values of up to four bytes go expedited. Longer ones (texts) go in segments of seven bytes. Other
messages that arrive while an answer is awaited are passed on to the owner of the bus, so nothing
is lost.

Source: CiA 301, SDO protocols (initiate, segment, abort).
"""

import struct
import time
from collections.abc import Callable

import can

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SDO_REQUEST

PATIENCE_S = 30.0
EXPEDITED_MAX = 4  # bytes
SEGMENT_MAX = 7  # bytes

# command bytes that the client sends
_DOWNLOAD_EXPEDITED = 0x23  # bits 2 and 3 hold the number of unused bytes
_DOWNLOAD_SEGMENTED = 0x21
_UPLOAD = 0x40
_UPLOAD_SEGMENT = 0x60
# command bytes of the answers, without their size bits
_ABORTED = 0x80
_DOWNLOAD_ACCEPTED = 0x60
_SEGMENT_ACCEPTED = 0x20
_UPLOADED = 0x40
_SEGMENT_UPLOADED = 0x00
_COMMAND_MASK = 0xE0


class RefusedError(BusError):
    """A node has refused a transfer with an SDO abort."""


class SdoClient:
    """An SDO client on an open bus.

    send(message): puts a message on the bus.
    read(timeout_s): returns the next message of the bus, or None.
    pass_on(message): receives the messages that are no answers to this client.
    """

    def __init__(
        self,
        send: Callable[[can.Message], None],
        read: Callable[[float], can.Message | None],
        pass_on: Callable[[can.Message], None],
    ) -> None:
        self._send = send
        self._read = read
        self._pass_on = pass_on

    def write(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Download bytes to an object. Raises RefusedError, or BusError without an answer."""
        place = struct.pack("<HB", index, sub)
        if 0 < len(data) <= EXPEDITED_MAX:
            unused = EXPEDITED_MAX - len(data)
            command = bytes([_DOWNLOAD_EXPEDITED | unused << 2])
            value = data.ljust(EXPEDITED_MAX, b"\0")
            self._request(node, command + place + value, _DOWNLOAD_ACCEPTED)
            return

        command = bytes([_DOWNLOAD_SEGMENTED])
        self._request(node, command + place + struct.pack("<I", len(data)), _DOWNLOAD_ACCEPTED)
        for number, begin in enumerate(range(0, max(len(data), 1), SEGMENT_MAX)):
            segment = data[begin : begin + SEGMENT_MAX]
            toggle = number % 2
            unused = SEGMENT_MAX - len(segment)
            is_last = begin + SEGMENT_MAX >= len(data)
            command = bytes([toggle << 4 | unused << 1 | is_last])
            self._request(node, command + segment.ljust(SEGMENT_MAX, b"\0"), _SEGMENT_ACCEPTED)

    def read(self, node: int, index: int, sub: int) -> bytes:
        """Upload an object. Raises RefusedError, or BusError without an answer."""
        place = struct.pack("<HB", index, sub)
        reply = self._request(node, bytes([_UPLOAD]) + place + bytes(4), _UPLOADED)
        is_expedited = reply[0] & 2
        if not is_expedited:
            return self._read_segments(node)
        size = EXPEDITED_MAX
        has_size = reply[0] & 1
        if has_size:
            size -= reply[0] >> 2 & 3
        return reply[4 : 4 + size]

    def _read_segments(self, node: int) -> bytes:
        """Return the data of an upload that has begun, segment by segment."""
        content = b""
        toggle = 0
        while True:
            command = bytes([_UPLOAD_SEGMENT | toggle << 4])
            reply = self._request(node, command + bytes(7), _SEGMENT_UPLOADED)
            unused = reply[0] >> 1 & 7
            content += reply[1 : 1 + SEGMENT_MAX - unused]
            is_last = reply[0] & 1
            if is_last:
                return content
            toggle ^= 1

    def _request(self, node: int, data: bytes, wanted: int) -> bytes:
        """Send a request and return the answer whose command byte is `wanted`."""
        self._send(can.Message(arbitration_id=SDO_REQUEST + node, data=data, is_extended_id=False))
        deadline_s = time.monotonic() + PATIENCE_S
        while (rest_s := deadline_s - time.monotonic()) > 0.0:
            message = self._read(rest_s)
            if message is None:
                continue
            reply = bytes(message.data)
            if message.arbitration_id != SDO_REPLY + node or len(reply) != 8:
                self._pass_on(message)
            elif reply[0] == _ABORTED:
                index, sub, code = struct.unpack_from("<HBI", reply, 1)
                raise RefusedError(
                    f"node {node}, object {index:04X}h:{sub}: refused with SDO abort {code:08X}h"
                )
            elif reply[0] & _COMMAND_MASK == wanted:
                return reply
        raise BusError(
            f"node {node} has not answered an SDO request within {PATIENCE_S:g} s; is it "
            "on the bus, and not stopped?"
        )
