"""A small SDO client: it writes and reads one object of a node at a time over an open bus.

Values of up to four bytes go expedited, longer ones (texts) in segments of seven bytes. What else
arrives while an answer is awaited is handed on to whoever watches the bus, so nothing is lost.
Source: CiA 301, SDO protocols (initiate, segment, abort).
"""

import struct
import time
from collections.abc import Callable

import can

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SDO_REQUEST

PATIENCE_S = 30.0
_ABORT, _DOWNLOADED, _SEGMENT_TAKEN, _UPLOAD = 0x80, 0x60, 0x20, 0x40


class RefusedError(BusError):
    """A node has refused a transfer with an SDO abort."""


class SdoClient:
    """One client. `read(timeout_s)` gives the next message or None; `pass_on` gets the others."""

    def __init__(
        self,
        send: Callable[[can.Message], None],
        read: Callable[[float], can.Message | None],
        pass_on: Callable[[can.Message], None],
    ) -> None:
        self._send, self._read, self._pass_on = send, read, pass_on

    def write(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Download bytes to an object. Raises RefusedError, or BusError when nobody answers."""
        head = struct.pack("<HB", index, sub)
        if 0 < len(data) <= 4:
            self._ask(
                node, bytes([0x33 - 4 * len(data)]) + head + data.ljust(4, b"\0"), _DOWNLOADED
            )
            return
        self._ask(node, b"\x21" + head + struct.pack("<I", len(data)), _DOWNLOADED)
        for at in range(0, max(len(data), 1), 7):
            part = data[at : at + 7]
            command = (at // 7 % 2) << 4 | (7 - len(part)) << 1 | (at + 7 >= len(data))
            self._ask(node, bytes([command]) + part.ljust(7, b"\0"), _SEGMENT_TAKEN)

    def read(self, node: int, index: int, sub: int) -> bytes:
        """Upload an object of up to four bytes. Raises RefusedError, or BusError."""
        reply = self._ask(node, b"\x40" + struct.pack("<HB", index, sub) + bytes(4), _UPLOAD)
        if not reply[0] & 2:
            raise BusError(f"node {node}, object {index:04X}h:{sub}: longer than four bytes")
        size = 4 - (reply[0] >> 2 & 3) if reply[0] & 1 else 4
        return reply[4 : 4 + size]

    def _ask(self, node: int, data: bytes, wanted: int) -> bytes:
        self._send(can.Message(arbitration_id=SDO_REQUEST + node, data=data, is_extended_id=False))
        deadline = time.monotonic() + PATIENCE_S
        while (rest_s := deadline - time.monotonic()) > 0.0:
            message = self._read(rest_s)
            if message is None:
                continue
            reply = bytes(message.data)
            if message.arbitration_id != SDO_REPLY + node or len(reply) != 8:
                self._pass_on(message)
            elif reply[0] == _ABORT:
                index, sub, code = struct.unpack_from("<HBI", reply, 1)
                raise RefusedError(
                    f"node {node}, object {index:04X}h:{sub}: refused with SDO abort {code:08X}h"
                )
            elif reply[0] & 0xE0 == wanted:
                return reply
        raise BusError(
            f"node {node} has not answered an SDO request within {PATIENCE_S:g} s; is it "
            "on the bus, and not stopped?"
        )
