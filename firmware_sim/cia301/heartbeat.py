"""Heartbeats of the node and of its partners, and node guarding for masters that still poll.

The node watches a partner from the partner's first heartbeat on. If the partner is silent for
longer than 1016h allows, the node reports 8130h, informs its application and changes its state as
1029h defines. Guarding answers a remote request with the state and a toggle bit, and notices when
the requests stop. Source: CiA 301, error control protocols. A boot-up message counts as a sign of
life only if the partner is already watched.
"""

from rollerrig.firmware_sim.cia301.emergency import HEARTBEAT_LOST
from rollerrig.firmware_sim.cia301.host import MS, Host, S
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

CONSUMERS = 4  # entries of 1016h
GUARD = 0  # the guarding master counts as partner 0


class Producer:
    """Sends the node's state every 1017h milliseconds."""

    def __init__(self, node: Host) -> None:
        self.node = node
        node.objects.attach(0x1017, effect=lambda _: self.configure())

    def configure(self) -> None:
        """Apply 1017h; the next heartbeat comes one period from now."""
        self.node.timers.cancel("heartbeat")
        period = self.node.objects.values[key(0x1017, 0)] * MS
        if period:
            self.node.timers.set("heartbeat", self.node.now_ns + period, self._send)

    def _send(self) -> None:
        self.node.transmit(HEARTBEAT + self.node.node_id, bytes([self.node.state]))
        self.configure()


class Consumer:
    """Watches the partners of 1016h, and a guarding master.

    `watched`: allowed silence in ns, by node. `lost`: the partners that are silent now. `toggle`:
    bit 7 of the next answer to the guarding master.
    """

    def __init__(self, node: Host) -> None:
        self.node = node
        self.toggle = 0
        self.watched: dict[int, int] = {}
        self.lost: set[int] = set()
        for sub in range(1, CONSUMERS + 1):
            node.objects.attach(
                0x1016,
                sub,
                check=lambda value, sub=sub: self._check(value, sub),
                effect=lambda _: node.rewire(),
            )

    def configure(self) -> None:
        """Apply 1016h; the supervision of entries that have not changed continues."""
        watched = {}
        for entry in self._entries():
            partner, time_ms = _partner_and_time(entry)
            if partner and time_ms:
                watched[partner] = time_ms * MS
        for partner in self.watched.keys() - watched.keys():
            self.node.timers.cancel(f"partner {partner}")
            self.lost.discard(partner)
            self.node.emergency.clear(HEARTBEAT_LOST, partner)
        self.watched = watched

    def forget(self) -> None:
        """Watch nobody until the first heartbeat or request, after a reset."""
        self.watched = {}
        self.lost = set()
        self.toggle = 0

    def on_frame(self, frame: Frame) -> None:
        """Take a heartbeat of a partner."""
        partner = frame.can_id - HEARTBEAT
        if len(frame.data) != 1 or partner not in self.watched:
            return
        boots = frame.data[0] & 0x7F == State.INITIALISING
        if not boots or self.node.timers.running(f"partner {partner}"):
            self._hear(partner, self.watched[partner])

    def on_request(self, _: Frame) -> None:
        """Answer a remote request for the node's state."""
        node = self.node
        values = node.objects.values
        # no answer while the node produces heartbeats, as the standard requires
        if values[key(0x1017, 0)]:
            return
        node.transmit(HEARTBEAT + node.node_id, bytes([self.toggle | node.state]))
        self.toggle ^= 0x80
        guard_time_ms = values[key(0x100C, 0)]
        life_time_factor = values[key(0x100D, 0)]
        self._hear(GUARD, guard_time_ms * life_time_factor * MS)

    def _hear(self, partner: int, patience_ns: int) -> None:
        """Take a sign of life. `patience_ns`: allowed time to the next one, 0 for any time."""
        node = self.node
        if patience_ns:
            node.timers.set(
                f"partner {partner}",
                node.now_ns + patience_ns,
                lambda: self._lose(partner),
                times_out=True,
            )
        if partner in self.lost:
            self.lost.discard(partner)
            if partner == GUARD:
                node.event(Code.GUARDING_BACK)
            else:
                node.event(Code.HEARTBEAT_BACK, partner=partner)
            node.emergency.clear(HEARTBEAT_LOST, partner)
            node.report_partner(partner, True)

    def _lose(self, partner: int) -> None:
        node = self.node
        self.lost.add(partner)
        if partner == GUARD:
            node.event(Code.GUARDING_LOST)
        else:
            node.event(Code.HEARTBEAT_LOST, partner=partner, silent_s=self.watched[partner] / S)
        node.report_partner(partner, False)
        node.emergency.report(HEARTBEAT_LOST, partner, bytes([partner]))
        node.communication_error()

    def _entries(self, without: int = 0) -> list[int]:
        """Return the entries of 1016h; `without` is a sub-index to leave out, 0 for none."""
        values = self.node.objects.values
        return [values[key(0x1016, sub)] for sub in range(1, CONSUMERS + 1) if sub != without]

    def _check(self, entry: int, sub: int) -> None:
        """Raise AbortError unless an entry may be written to a sub-index of 1016h."""
        if entry >> 24 or entry >> 16 & 0xFF > 127:
            raise AbortError(Abort.INVALID_VALUE)
        partner, time_ms = _partner_and_time(entry)
        if not (partner and time_ms):
            return
        for other in self._entries(without=sub):
            other_partner, other_time_ms = _partner_and_time(other)
            if other_time_ms and other_partner == partner:
                raise AbortError(Abort.INCOMPATIBLE)


def _partner_and_time(entry: int) -> tuple[int, int]:
    """Return node number and time in ms of an entry of 1016h."""
    return entry >> 16 & 0x7F, entry & 0xFFFF
