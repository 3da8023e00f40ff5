"""SYNC: the moment at which all nodes sample and act together.

What came for synchronous receive PDOs is taken over first, then every synchronous transmit PDO is sampled and sent. A
SYNC may carry a counter from 1 to the overflow value 1019h; one of another length is reported and still obeyed. Where
1006h tells the cycle, a SYNC that stays away for half as long again is reported; where 1007h tells the window, what
comes for synchronous receive PDOs after its end is too late for the next SYNC. Source: CiA 301, SYNC protocol,
objects 1005h, 1006h, 1007h and 1019h; how long a node waits for a SYNC is left to it there.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.communication import FLAG, check_identifier
from rollerrig.firmware_sim.cia301.emergency import SYNC_LENGTH, SYNC_MISSING
from rollerrig.firmware_sim.cia301.host import Host, S
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

US = 1000


class SyncConsumer:
    """What a node does at a SYNC. `at_ns`: when the last one came, None before the first."""

    def __init__(self, node: Host) -> None:
        self.node = node
        self.at_ns: int | None = None
        self._length = self._patience_ns = self._window_ns = 0
        checks = {0x1005: check_consumed, 0x1006: None, 0x1007: None, 0x1019: self._check_overflow}
        for index, check in checks.items():
            node.objects.own(index, check=check, effect=lambda _: node.rewire())

    def configure(
        self, receive: list[Callable[[], None]], transmit: list[Callable[[int | None], None]]
    ) -> None:
        """Take 1006h, 1007h and 1019h over, and what the PDOs do at a SYNC."""
        node, values = self.node, self.node.objects.values
        self._length = 1 if values[key(0x1019, 0)] else 0
        self._patience_ns = values[key(0x1006, 0)] * US * 3 // 2
        self._window_ns = values[key(0x1007, 0)] * US
        if not self._patience_ns or not node.state.has_emergencies:
            node.timers.cancel("sync")
            node.emergency.clear(SYNC_MISSING)
        self._receive, self._transmit = receive, transmit

    def on_frame(self, frame: Frame) -> None:
        """A SYNC message."""
        node, data = self.node, frame.data
        if len(data) != self._length:
            node.emergency.report(SYNC_LENGTH, 0, bytes([len(data), self._length]))
        elif node.emergency.active:
            node.emergency.clear(SYNC_LENGTH)
            node.emergency.clear(SYNC_MISSING)
        self.at_ns = max(frame.time_ns, node.now_ns)
        if self._patience_ns:
            node.timers.set("sync", self.at_ns + self._patience_ns, self._miss)
        for take in self._receive:
            take()
        for react in node.on_sync:
            react()
        if node.state is State.OPERATIONAL:
            counter = data[0] if data else None
            for transmit in self._transmit:
                transmit(counter)

    def forget(self) -> None:
        """After a reset no SYNC has come."""
        self.at_ns = None

    def window_is_over(self, frame: Frame) -> bool:
        """Whether a message comes too late for the next SYNC."""
        if not self._window_ns or self.at_ns is None:
            return False
        return max(frame.time_ns, self.node.now_ns) > self.at_ns + self._window_ns

    def _check_overflow(self, value: int) -> None:
        values = self.node.objects.values
        if value == 1:
            raise AbortError(Abort.INVALID_VALUE)
        if values[key(0x1006, 0)] and value != values[key(0x1019, 0)]:
            raise AbortError(Abort.DEVICE_STATE)

    def _miss(self) -> None:
        self.node.event(Code.SYNC_MISSING, silent_s=self._patience_ns / S)
        self.node.emergency.report(SYNC_MISSING)


def check_consumed(cob_id: int) -> None:
    """AbortError unless SYNC or TIME may have this COB-ID."""
    # bit 30 would make this node the producer, which it cannot be
    if cob_id & FLAG:
        raise AbortError(Abort.INVALID_VALUE)
    check_identifier(cob_id)
