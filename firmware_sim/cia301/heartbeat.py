"""Heartbeats: a node's own, those of its partners, and node guarding for masters that still poll.

A partner is watched from its first heartbeat on; when it is silent for longer than 1016h allows,
the node reports 8130h, tells its application and does what 1029h says. Guarding answers a remote
request with the state and a toggle bit, and notices when the requests stop. Source: CiA 301, error
control protocols; boot-up counts as a sign of life only of a partner that is being watched.
"""

from rollerrig.firmware_sim.cia301.emergency import HEARTBEAT_LOST
from rollerrig.firmware_sim.cia301.host import MS, Host, S
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

# entries of 1016h; the master that guards counts as partner 0
CONSUMERS, GUARD = 4, 0


class Producer:
    """Sends the node's state every 1017h milliseconds."""

    def __init__(self, node: Host) -> None:
        self.node = node
        node.objects.own(0x1017, effect=lambda _: self.configure())

    def configure(self) -> None:
        """Take 1017h over; the next heartbeat comes one period from now."""
        self.node.timers.cancel("heartbeat")
        period = self.node.objects.values[key(0x1017, 0)] * MS
        if period:
            self.node.timers.set("heartbeat", self.node.now_ns + period, self._send)

    def _send(self) -> None:
        self.node.transmit(HEARTBEAT + self.node.node_id, bytes([self.node.state]))
        self.configure()


class Consumer:
    """Watches the partners of 1016h, and a master that guards.

    `watched`: time in ns by node; `lost`: those now silent; `toggle`: bit 7 of the next answer to a guard.
    """

    def __init__(self, node: Host) -> None:
        self.node, self.toggle = node, 0
        self.watched: dict[int, int] = {}
        self.lost: set[int] = set()
        for sub in range(1, CONSUMERS + 1):
            node.objects.own(
                0x1016,
                sub,
                check=lambda value, sub=sub: self._check(value, sub),
                effect=lambda _: node.rewire(),
            )

    def configure(self) -> None:
        """Take 1016h over; what has not changed goes on."""
        wanted = {
            entry >> 16 & 0x7F: (entry & 0xFFFF) * MS
            for entry in self._entries()
            if entry & 0xFFFF and entry >> 16 & 0x7F
        }
        for partner in self.watched.keys() - wanted.keys():
            self.node.timers.cancel(f"partner {partner}")
            self.lost.discard(partner)
            self.node.emergency.clear(HEARTBEAT_LOST, partner)
        self.watched = wanted

    def forget(self) -> None:
        """After a reset nobody is watched until the first heartbeat or request."""
        self.watched, self.lost, self.toggle = {}, set(), 0

    def on_frame(self, frame: Frame) -> None:
        """A heartbeat of a partner."""
        partner = frame.can_id - HEARTBEAT
        if len(frame.data) != 1 or partner not in self.watched:
            return
        boots = frame.data[0] & 0x7F == State.INITIALISING
        if not boots or self.node.timers.running(f"partner {partner}"):
            self._hear(partner, self.watched[partner])

    def on_request(self, _: Frame) -> None:
        """A remote request for the node's heartbeat."""
        node, values = self.node, self.node.objects.values
        # silent while the node produces heartbeats, as the standard wants
        if values[key(0x1017, 0)]:
            return
        node.transmit(HEARTBEAT + node.node_id, bytes([self.toggle | node.state]))
        self.toggle ^= 0x80
        self._hear(GUARD, values[key(0x100C, 0)] * values[key(0x100D, 0)] * MS)

    def _hear(self, partner: int, patience_ns: int) -> None:
        """A sign of life; `patience_ns` 0: the next one is not waited for."""
        node = self.node
        if patience_ns:
            node.timers.set(
                f"partner {partner}", node.now_ns + patience_ns, lambda: self._lose(partner)
            )
        if partner in self.lost:
            self.lost.discard(partner)
            if partner == GUARD:
                node.event(Code.GUARDING_BACK)
            else:
                node.event(Code.HEARTBEAT_BACK, partner=partner)
            node.emergency.clear(HEARTBEAT_LOST, partner)
            node.tell_partner(partner, True)

    def _lose(self, partner: int) -> None:
        node = self.node
        self.lost.add(partner)
        if partner == GUARD:
            node.event(Code.GUARDING_LOST)
        else:
            node.event(Code.HEARTBEAT_LOST, partner=partner, silent_s=self.watched[partner] / S)
        node.tell_partner(partner, False)
        node.emergency.report(HEARTBEAT_LOST, partner, bytes([partner]))
        node.communication_error()

    def _entries(self, but: int = 0) -> list[int]:
        values = self.node.objects.values
        return [values[key(0x1016, sub)] for sub in range(1, CONSUMERS + 1) if sub != but]

    def _check(self, value: int, sub: int) -> None:
        partner, time = value >> 16 & 0xFF, value & 0xFFFF
        if value >> 24 or partner > 127:
            raise AbortError(Abort.INVALID_VALUE)
        if (
            time
            and partner
            and any(
                other & 0xFFFF and other >> 16 & 0x7F == partner for other in self._entries(sub)
            )
        ):
            raise AbortError(Abort.INCOMPATIBLE)
