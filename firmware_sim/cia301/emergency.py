"""Emergency messages: one when an error of a node begins, and one when it ends.

An error that is active already causes no further message. The error register and the history follow
the errors. Between two messages there is at least the inhibit time; messages that must wait are
sent later, in order. Source: CiA 301, EMCY protocol, objects 1001h, 1003h, 1014h, 1015h.
"""

from collections import deque
from functools import partial

from rollerrig.firmware_sim.cia301.communication import HISTORY, attach_cob_id, valid
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key

_MOST_WAITING = 32  # messages
# error register bits by the first hexadecimal digit of the code; bit 0 is always set
_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x20, 0x6: 0x80}
# error codes
SYNC_LENGTH = 0x8240
PDO_LENGTH = 0x8210
HEARTBEAT_LOST = 0x8130
RPDO_LATE = 0x8250
SYNC_MISSING = 0x8100  # the standard defines no special code for it: communication, generic


class Emergency:
    """The errors of a node.

    `active`: codes with their sources. The source distinguishes errors with the same code.
    """

    def __init__(self, node: Host) -> None:
        self.node = node
        self.active: set[tuple[int, int]] = set()
        self.history: deque[int] = deque(maxlen=HISTORY)
        self._waiting: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self._free_ns = 0  # when the next message may be sent
        objects = node.objects
        objects.attach(0x1001, read=self.register)
        objects.attach(0x1003, read=lambda: len(self.history), check=self._clear_history)
        for at in range(HISTORY):
            objects.attach(0x1003, at + 1, read=partial(self._history_entry, at))
        attach_cob_id(objects, 0x1014)
        objects.attach(0x1015, check=self._check_inhibit)

    def register(self) -> int:
        """Return the error register 1001h."""
        bits = 1 if self.active else 0
        for code, _ in self.active:
            bits |= _REGISTER.get(code >> 12, 0)
        return bits

    def report(self, code: int, source: int = 0, information: bytes = b"") -> bool:
        """Report that an error has begun. Returns False without a message if it is active."""
        if (code, source) in self.active:
            return False
        self.active.add((code, source))
        self.history.appendleft(code | int.from_bytes(information[:2], "little") << 16)
        self._queue(code, information)
        return True

    def clear(self, code: int, source: int = 0) -> None:
        """Report that an error has ended: code 0 and the remaining error register."""
        if (code, source) in self.active:
            self.active.remove((code, source))
            self._queue(0, code.to_bytes(2, "little"))

    def forget(self, everything: bool) -> None:
        """Forget the errors of communication, or with `everything` all errors, after a reset."""
        if everything:
            self.active = set()
            self.history.clear()
        else:
            self.active = {(code, source) for code, source in self.active if code >> 12 != 8}
        self._waiting.clear()
        self._free_ns = 0

    def _queue(self, code: int, information: bytes) -> None:
        message = code.to_bytes(2, "little") + bytes([self.register()])
        self._waiting.append(message + information[:5].ljust(5, b"\0"))
        self.flush()

    def flush(self) -> None:
        """Send waiting messages, as far as state and inhibit time allow."""
        node = self.node
        cob_id = node.objects.values[key(0x1014, 0)]
        if not valid(cob_id):
            self._waiting.clear()
        while self._waiting and node.state.has_services:
            if node.now_ns < self._free_ns:
                node.timers.set("emergency", self._free_ns, self.flush)
                return
            node.transmit(cob_id, self._waiting.popleft())
            inhibit_100us = node.objects.values[key(0x1015, 0)]
            self._free_ns = node.clock_ns() + inhibit_100us * 100_000

    def _history_entry(self, at: int) -> int:
        """Return the entry of the history at a position, the newest first; 0 if there is none."""
        return self.history[at] if at < len(self.history) else 0

    def _clear_history(self, value: int) -> None:
        if value != 0:
            raise AbortError(Abort.INVALID_VALUE)
        self.history.clear()

    def _check_inhibit(self, value: int) -> None:
        values = self.node.objects.values
        if value != values[key(0x1015, 0)] and valid(values[key(0x1014, 0)]):
            raise AbortError(Abort.DEVICE_STATE)
