"""Heartbeats: a node's own, those of its partners, and node guarding for masters that still poll.

A partner is watched from its first heartbeat on; when it is silent for longer than 1016h allows,
the node reports 8130h, tells its application and does what 1029h says. Guarding answers a remote
request with the state and a toggle bit, and notices when the requests stop. Source: CiA 301, error
control protocols; boot-up counts as a sign of life only of a partner that is being watched.
"""

from rollerrig.firmware_sim.cia301.emergency import HEARTBEAT_LOST
from rollerrig.firmware_sim.cia301.host import MS, Host
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT
from rollerrig.wsp_interface.bus.frames import Frame

CONSUMERS = 4
_ON_ERROR = {0: State.PRE_OPERATIONAL, 2: State.STOPPED}


class Producer:
    """Sends the node's state every 1017h milliseconds."""

    def __init__(self, node: Host) -> None:
        self.node = node
        node.objects.effects[key(0x1017, 0)] = lambda _: self.configure()

    def configure(self) -> None:
        """Take 1017h over; the next heartbeat comes one period from now."""
        self.node.timers.cancel("heartbeat")
        period = self.node.objects.values[key(0x1017, 0)] * MS
        if period:
            self.node.timers.set("heartbeat", self.node.now_ns + period, self._send)

    def _send(self) -> None:
        node = self.node
        node.transmit(HEARTBEAT + node.node_id, bytes([node.state]))
        self.configure()


class Consumer:
    """Watches the partners of 1016h. `watched`: time in ns by node; `lost`: those now silent."""

    def __init__(self, node: Host) -> None:
        self.node = node
        self.watched: dict[int, int] = {}
        self.lost: set[int] = set()
        for sub in range(1, CONSUMERS + 1):
            at = key(0x1016, sub)
            node.objects.checks[at] = lambda value, at=at: self._check(value, at)
            node.objects.effects[at] = lambda _: node.rewire()

    def configure(self) -> None:
        """Take 1016h over; what has not changed goes on."""
        entries = [self.node.objects.values[key(0x1016, sub)] for sub in range(1, CONSUMERS + 1)]
        wanted = {entry >> 16 & 0x7F: (entry & 0xFFFF) * MS
                  for entry in entries if entry & 0xFFFF and entry >> 16 & 0x7F}
        for partner in self.watched.keys() - wanted.keys():
            self.node.timers.cancel(f"partner {partner}")
            self.lost.discard(partner)
            self.node.emergency.clear(HEARTBEAT_LOST, partner)
        self.watched = wanted

    def forget(self) -> None:
        """After a reset nobody is watched until the first heartbeat."""
        self.watched, self.lost = {}, set()

    def on_frame(self, frame: Frame) -> None:
        """A heartbeat of a partner."""
        partner, timers = frame.can_id - HEARTBEAT, self.node.timers
        if len(frame.data) != 1 or partner not in self.watched:
            return
        alarm = f"partner {partner}"
        if frame.data[0] & 0x7F == State.INITIALISING and not timers.running(alarm):
            return
        timers.set(alarm, self.node.now_ns + self.watched[partner], lambda: self._lose(partner))
        if partner in self.lost:
            self.lost.discard(partner)
            self.node.event("info", f"heartbeat of node {partner} is back")
            self.node.emergency.clear(HEARTBEAT_LOST, partner)
            self.node.tell_partner(partner, True)

    def _lose(self, partner: int) -> None:
        node = self.node
        self.lost.add(partner)
        after = self.watched[partner] / MS
        node.event("error", f"heartbeat of node {partner} lost: silent for more than {after:g} ms")
        node.tell_partner(partner, False)
        node.emergency.report(HEARTBEAT_LOST, partner, bytes([partner]))
        node.communication_error()

    def _check(self, value: int, at: int) -> None:
        partner, time = value >> 16 & 0xFF, value & 0xFFFF
        if value >> 24 or partner > 127:
            raise AbortError(Abort.INVALID_VALUE)
        others = (self.node.objects.values[key(0x1016, sub)] for sub in range(1, CONSUMERS + 1)
                  if key(0x1016, sub) != at)
        if time and partner and any(
                other & 0xFFFF and other >> 16 & 0x7F == partner for other in others):
            raise AbortError(Abort.INCOMPATIBLE)


class Guarding:
    """Node guarding: silent while the node produces heartbeats, as the standard wants."""

    def __init__(self, node: Host) -> None:
        self.node, self.toggle, self.lost = node, 0, False

    def forget(self) -> None:
        """After a reset the toggle bit begins with 0 and no request is expected."""
        self.toggle, self.lost = 0, False

    def on_request(self, _: Frame) -> None:
        """A remote request for the node's heartbeat."""
        node = self.node
        if node.objects.values[key(0x1017, 0)]:
            return
        node.transmit(HEARTBEAT + node.node_id, bytes([self.toggle | node.state]))
        self.toggle ^= 0x80
        values = node.objects.values
        life_ns = values[key(0x100C, 0)] * values[key(0x100D, 0)] * MS
        if life_ns:
            node.timers.set("guarding", node.now_ns + life_ns, self._lose)
        if self.lost:
            self.lost = False
            node.event("info", "node guarding is back")
            node.emergency.clear(HEARTBEAT_LOST)
            node.tell_partner(0, True)

    def _lose(self) -> None:
        node, self.lost = self.node, True
        node.event("error", "node guarding lost: the master has stopped asking")
        node.tell_partner(0, False)
        node.emergency.report(HEARTBEAT_LOST)
        node.communication_error()


def on_error_state(behaviour: int) -> State | None:
    """The NMT state that 1029h asks for after a communication error; None: stay."""
    return _ON_ERROR.get(behaviour)
