"""Asks WSP units for their identity object (1018h): who made them, what they are, and their number.

The bench asks by SDO before the run, one sub-index after another. A unit need not have an SDO
server. Source: CiA 301, SDO protocol and object 1018h.
"""

import struct
from collections.abc import Callable, Iterable
from typing import Any

from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SDO_REQUEST
from rollerrig.wsp_interface.bus.frames import Frame

_IDENTITY = 0x1018
# the values of the object, by their sub-indices from 1
_NAMES = ("vendor_id", "product_code", "revision", "serial")
_UPLOAD = 0x40
# an answer with a value of four bytes, which need not state its size
_EXPEDITED = (0x42, 0x43)
_SDO_BYTES = 8


class Identities:
    """The identities of units, as far as they have answered. `send(frame)` puts a frame on the bus.

    open: nodes that have been asked and have not answered everything.
    """

    def __init__(self, send: Callable[[Frame], Any]) -> None:
        self._send = send
        self._found: dict[int, dict[str, int]] = {}
        self.open: set[int] = set()

    def ask(self, nodes: Iterable[int]) -> None:
        """Send the first request to some nodes."""
        for node in nodes:
            self._found[node] = {}
            self.open.add(node)
            self._request(node)

    def hear(self, frame: Frame) -> None:
        """Take a frame of the bus; the answer of a node that was asked leads to the next request.

        A node that aborts the transfer has no further values.
        """
        node = frame.can_id - SDO_REPLY
        has_form = not (frame.extended or frame.remote) and len(frame.data) == _SDO_BYTES
        if node not in self.open or not has_form:
            return
        found = self._found[node]
        command, index, sub, value = struct.unpack("<BHBI", frame.data)
        if (index, sub) != (_IDENTITY, len(found) + 1):
            return
        has_value = command in _EXPEDITED
        if has_value:
            found[_NAMES[len(found)]] = value
        is_last = len(found) == len(_NAMES)
        if is_last or not has_value:
            self.open.discard(node)
        else:
            self._request(node)

    def finish(self) -> list[dict[str, int | None]]:
        """Return node and values of each unit that has answered; a missing value is None.

        A later answer leads to no further request, so that none comes during the run.
        """
        self.open.clear()
        return [
            {"node": node, **dict.fromkeys(_NAMES), **values}
            for node, values in self._found.items()
            if values
        ]

    def _request(self, node: int) -> None:
        sub = len(self._found[node]) + 1
        data = struct.pack("<BHBI", _UPLOAD, _IDENTITY, sub, 0)
        self._send(Frame(SDO_REQUEST + node, data))
