"""Emergency messages: what is wrong with a node, told once when it begins and once when it ends.

An error that is already reported stays silent; the error register and the history follow. Between
two messages lies at least the inhibit time; what has to wait is sent later, in order. Source: CiA
301, EMCY protocol, objects 1001h, 1003h, 1014h, 1015h.
"""

from collections import deque

from rollerrig.firmware_sim.cia301.communication import HISTORY, own_cob_id, valid
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key

_WAITING = 32
# error register bits by the first hexadecimal digit of the code; bit 0 is always set
_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x20, 0x6: 0x80}
SYNC_LENGTH, PDO_LENGTH, HEARTBEAT_LOST, RPDO_LATE = 0x8240, 0x8210, 0x8130, 0x8250
# no code of its own is defined for a SYNC that stays away: communication, generic
SYNC_MISSING = 0x8100


class Emergency:
    """The errors of a node. `active`: codes with their sources, which tell errors of one code apart."""

    def __init__(self, node: Host) -> None:
        self.node = node
        self.active: set[tuple[int, int]] = set()
        self.history: deque[int] = deque(maxlen=HISTORY)
        self._waiting: deque[bytes] = deque(maxlen=_WAITING)
        self._free_ns = 0
        objects = node.objects
        objects.own(0x1001, read=self.register)
        objects.own(0x1003, read=lambda: len(self.history), check=self._clear_history)
        for at in range(HISTORY):
            objects.own(
                0x1003, at + 1, read=lambda at=at: self.history[at] if at < len(self.history) else 0
            )
        own_cob_id(objects, 0x1014)
        objects.own(0x1015, check=self._check_inhibit)

    def register(self) -> int:
        """The error register 1001h."""
        bits = 1 if self.active else 0
        for code, _ in self.active:
            bits |= _REGISTER.get(code >> 12, 0)
        return bits

    def report(self, code: int, source: int = 0, information: bytes = b"") -> bool:
        """An error has begun. Nothing happens, and False comes back, if it is already known."""
        if (code, source) in self.active:
            return False
        self.active.add((code, source))
        self.history.appendleft(code | int.from_bytes(information[:2], "little") << 16)
        self._queue(code, information)
        return True

    def clear(self, code: int, source: int = 0) -> None:
        """An error has ended: tell it with code 0 and what is left in the error register."""
        if (code, source) in self.active:
            self.active.remove((code, source))
            self._queue(0, code.to_bytes(2, "little"))

    def forget(self, everything: bool) -> None:
        """After a reset: no communication error, or none at all, and nothing waits."""
        self.active = {
            (code, source) for code, source in self.active if code >> 12 != 8 and not everything
        }
        if everything:
            self.history.clear()
        self._waiting.clear()
        self._free_ns = 0

    def _queue(self, code: int, information: bytes) -> None:
        message = code.to_bytes(2, "little") + bytes([self.register()])
        self._waiting.append(message + information[:5].ljust(5, b"\0"))
        self.flush()

    def flush(self) -> None:
        """Send what waits, as far as state and inhibit time allow."""
        node = self.node
        cob_id = node.objects.values[key(0x1014, 0)]
        if not valid(cob_id):
            self._waiting.clear()
        while self._waiting and node.state.has_emergencies:
            if node.now_ns < self._free_ns:
                node.timers.set("emergency", self._free_ns, self.flush)
                return
            node.transmit(cob_id, self._waiting.popleft())
            self._free_ns = node.clock_ns() + node.objects.values[key(0x1015, 0)] * 100_000

    def _clear_history(self, value: int) -> None:
        if value != 0:
            raise AbortError(Abort.INVALID_VALUE)
        self.history.clear()

    def _check_inhibit(self, value: int) -> None:
        values = self.node.objects.values
        if value != values[key(0x1015, 0)] and valid(values[key(0x1014, 0)]):
            raise AbortError(Abort.DEVICE_STATE)
