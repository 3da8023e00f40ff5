"""SYNC: the moment at which all nodes sample and act together.

At a SYNC the node first applies the data that synchronous receive PDOs have brought. Then it
samples and sends every synchronous transmit PDO. A SYNC may carry a counter from 1 to the overflow
value 1019h. The node reports a SYNC of another length, but still obeys it.

If 1006h gives the cycle period, the node reports a SYNC that is half a period late. If 1007h gives
the synchronous window, data for synchronous receive PDOs after its end are too late for the next
SYNC. Source: CiA 301, SYNC protocol, objects 1005h, 1006h, 1007h and 1019h. The standard leaves to
the node how long it waits for a SYNC.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.communication import FLAG, check_identifier
from rollerrig.firmware_sim.cia301.emergency import SYNC_LENGTH, SYNC_MISSING
from rollerrig.firmware_sim.cia301.host import Host, S
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

US = 1000  # ns


class SyncConsumer:
    """The actions of a node at a SYNC. `at_ns`: time of the last one, None before the first."""

    def __init__(self, node: Host) -> None:
        self.node = node
        self.at_ns: int | None = None
        self._length = 0  # of a SYNC in bytes
        self._patience_ns = 0  # allowed time to the next SYNC; 0: any
        self._window_ns = 0  # synchronous window; 0: none
        checks = {0x1005: check_consumed, 0x1006: None, 0x1007: None, 0x1019: self._check_overflow}
        for index, check in checks.items():
            node.objects.attach(index, check=check, effect=lambda _: node.rewire())

    def configure(
        self, receive: list[Callable[[], None]], transmit: list[Callable[[int | None], None]]
    ) -> None:
        """Apply 1006h, 1007h and 1019h, and set the actions of the PDOs at a SYNC."""
        node = self.node
        values = node.objects.values
        self._length = 1 if values[key(0x1019, 0)] else 0
        self._patience_ns = values[key(0x1006, 0)] * US * 3 // 2
        self._window_ns = values[key(0x1007, 0)] * US
        if not self._patience_ns or not node.state.has_services:
            node.timers.cancel("sync")
            node.emergency.clear(SYNC_MISSING)
        self._receive = receive
        self._transmit = transmit

    def on_frame(self, frame: Frame) -> None:
        """Take a SYNC message."""
        node = self.node
        data = frame.data
        if len(data) != self._length:
            node.emergency.report(SYNC_LENGTH, 0, bytes([len(data), self._length]))
        elif node.emergency.active:
            node.emergency.clear(SYNC_LENGTH)
            node.emergency.clear(SYNC_MISSING)
        self.at_ns = max(frame.time_ns, node.now_ns)
        if self._patience_ns:
            node.timers.set("sync", self.at_ns + self._patience_ns, self._miss, times_out=True)
        for apply in self._receive:
            apply()
        for call in node.on_sync:
            call()
        if node.state is State.OPERATIONAL:
            counter = data[0] if data else None
            for transmit in self._transmit:
                transmit(counter)

    def forget(self) -> None:
        """Forget the last SYNC, after a reset."""
        self.at_ns = None

    def window_is_over(self, frame: Frame) -> bool:
        """Return whether a message for a synchronous PDO is too late for the next SYNC."""
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
    """Raise AbortError unless SYNC or TIME may have this COB-ID."""
    # bit 30 would make this node the producer, and it has none
    if cob_id & FLAG:
        raise AbortError(Abort.INVALID_VALUE)
    check_identifier(cob_id)
