"""Process data objects: values of several objects in one message, packed without gaps.

A transmit PDO is sent with every n-th SYNC, after a change, by a timer, or on a remote request. A
receive PDO takes effect immediately or with the next SYNC. When a PDO is configured, its mapping is
compiled to one struct and one list of functions. Source: CiA 301, PDO protocols and transmission
types.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.communication import split, valid
from rollerrig.firmware_sim.cia301.emergency import PDO_LENGTH, RPDO_LATE
from rollerrig.firmware_sim.cia301.host import MS, Host
from rollerrig.firmware_sim.cia301.objects import AbortError, key, packer
from rollerrig.firmware_sim.cia301.pdo_mapping import DUMMIES, attach_rules, mapped
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

# transmission types; 1 to 240: with every n-th SYNC
ACYCLIC = 0  # with a SYNC, if the content has changed
LAST_SYNCHRONOUS = 240
RTR_SYNCHRONOUS = 252  # sampled with SYNC, sent on a remote request
RTR = 253  # sampled and sent on a remote request
EVENT = 254  # and 255: after a change, or by the event timer


class Channel:
    """The common part of both directions.

    `live`: the PDO exists, carries an object, and the node is OPERATIONAL.
    """

    def __init__(self, node: Host, index: int, number: int) -> None:
        self.node = node
        self.index = index + number
        self.number = number + 1
        self.live = False
        self.alarm = f"{type(self).__name__.lower()} {self.number}"
        attach_rules(node, self.index, self.configure, isinstance(self, Tpdo))

    def configure(self, operational: bool) -> None:
        """Compile communication and mapping parameters."""
        (cob_id,) = self._parameters(1)
        self.can_id, self.extended = split(cob_id)
        self.entries = mapped(self.node.objects, self.index + 0x200)
        self.live = operational and valid(cob_id) and bool(self.entries)
        for alarm in (self.alarm, f"{self.alarm} inhibited"):
            self.node.timers.cancel(alarm)

    def _parameters(self, *subs: int) -> list[int]:
        return [self.node.objects.values[key(self.index, sub)] for sub in subs]


class Tpdo(Channel):
    """One transmit PDO. `on_sync(counter)` is called at a SYNC; None if a SYNC has no effect."""

    def configure(self, operational: bool) -> None:
        super().configure(operational)
        self.kind, inhibit, event, self.start = self._parameters(2, 3, 5, 6)
        if not self.live:
            return
        objects = self.node.objects
        self.getters = [objects.getter(at) for at in self.entries]
        self.pack = packer([objects.variables[at] for at in self.entries]).pack
        # the objects that enable the sending of changes
        enabling = self.node.event_enablers
        self.enablers = {enabling[at >> 8] for at in self.entries if at >> 8 in enabling}
        self.inhibit_ns = inhibit * 100_000
        self.event_ns = event * MS
        self.free_ns = 0  # when the inhibit time is over
        self.every = self.kind if 1 <= self.kind <= LAST_SYNCHRONOUS else 1
        self.passed = 0  # SYNCs since the last message
        self.last: bytes | None = None  # sent
        self.sampled: bytes | None = None
        self.on_sync = self._action_at_sync()
        self._await_event()

    def _action_at_sync(self) -> Callable[[int | None], None] | None:
        if self.kind == ACYCLIC:
            return self._on_change
        if self.kind == RTR_SYNCHRONOUS:
            return self._sample_only
        if self.kind == 1 and not self.start:
            return self._now
        return self._cyclic if self.kind <= LAST_SYNCHRONOUS else None

    def sample(self) -> bytes:
        """Return the present content of the message."""
        return self.pack(*[get() for get in self.getters])

    def on_remote(self, _: Frame) -> None:
        """Answer a remote request for this PDO."""
        if self.kind >= RTR or self.sampled is None:
            self._send(self.sample())
        else:
            self._send(self.sampled)

    def watch(self, now_ns: int) -> None:
        """Send changed content, as soon as the inhibit time allows (event-driven transmission)."""
        if now_ns < self.free_ns:
            return
        data = self.sample()
        values = self.node.objects.values
        enabled = not self.enablers or any(values[at] for at in self.enablers)
        if self.last is None or (data != self.last and enabled):
            self._send(data)

    def _await_event(self) -> None:
        if self.kind >= EVENT and self.event_ns:
            self.node.timers.set(self.alarm, self.node.now_ns + self.event_ns, self._event_timer)

    def _event_timer(self) -> None:
        if self.node.now_ns < self.free_ns:
            self.node.timers.set(self.alarm, self.free_ns, self._event_timer)
        else:
            self._send(self.sample())

    def _now(self, _: int | None) -> None:
        # the usual case (type 1), short because it is the inner loop of the bus thread
        data = self.pack(*[get() for get in self.getters])
        self.sampled = data
        self.node.send(Frame(self.can_id, data, self.extended))

    def _cyclic(self, counter: int | None) -> None:
        if self.start and counter is not None:
            # wait for the SYNC with this number, and count from there
            if counter != self.start:
                return
            self.start = 0
            self.passed = self.every - 1
        self.passed += 1
        if self.passed >= self.every:
            self.passed = 0
            self._now(counter)

    def _on_change(self, _: int | None) -> None:
        self.sampled = self.sample()
        if self.sampled != self.last:
            self._send(self.sampled)

    def _sample_only(self, _: int | None) -> None:
        self.sampled = self.sample()

    def _send(self, data: bytes) -> None:
        self.last = data
        self.node.send(Frame(self.can_id, data, self.extended))
        if self.kind >= EVENT and self.inhibit_ns:
            self.free_ns = self.node.clock_ns() + self.inhibit_ns
            alarm = f"{self.alarm} inhibited"
            self.node.timers.set(alarm, self.free_ns, lambda: self.watch(self.free_ns))
        self._await_event()


class Rpdo(Channel):
    """One receive PDO.

    `too_late(frame)` returns whether the window of synchronous messages (1007h) is over. `refused`:
    the objects whose last value was refused.
    """

    def __init__(
        self, node: Host, index: int, number: int, too_late: Callable[[Frame], bool]
    ) -> None:
        super().__init__(node, index, number)
        self.too_late = too_late
        self.refused: set[int] = set()

    def configure(self, operational: bool) -> None:
        super().configure(operational)
        kind, event = self._parameters(2, 5)
        self.synchronous = kind <= LAST_SYNCHRONOUS
        self.deadline_ns = event * MS
        self.waiting: bytes | None = None
        if self.live:
            variables = self.node.objects.variables
            layout = packer([DUMMIES.get(at) or variables[at] for at in self.entries])
            self.size = layout.size
            self.unpack = layout.unpack

    def on_frame(self, frame: Frame) -> None:
        """Take a message for this PDO. A message that is too short is reported and ignored."""
        node = self.node
        data = frame.data
        emergency = node.emergency
        if len(data) < self.size:
            information = bytes([self.number, len(data), self.size])
            if emergency.report(PDO_LENGTH, self.number, information):
                node.event(
                    Code.PDO_TOO_SHORT, pdo=self.number, length=len(data), expected=self.size
                )
            return
        if emergency.active:
            emergency.clear(PDO_LENGTH, self.number)
            emergency.clear(RPDO_LATE, self.number)
        if self.deadline_ns:
            node.timers.set(self.alarm, node.now_ns + self.deadline_ns, self._late)
        if not self.synchronous:
            self.apply(data)
        elif not self.too_late(frame):
            self.waiting = data

    def on_sync(self) -> None:
        """Apply the data that have come since the last SYNC."""
        if self.waiting is not None:
            data = self.waiting
            self.waiting = None
            self.apply(data)

    def apply(self, data: bytes) -> None:
        """Write the content into the objects, without values that an object refuses."""
        objects = self.node.objects
        for at, value in zip(self.entries, self.unpack(data[: self.size]), strict=True):
            if at in DUMMIES:
                continue
            try:
                objects.assign(at, value)
                self.refused.discard(at)
            except AbortError as refusal:
                if at in self.refused:
                    continue  # reported already
                self.refused.add(at)
                self.node.event(
                    Code.PDO_REFUSED,
                    pdo=self.number,
                    index=at >> 8,
                    sub=at & 0xFF,
                    value=value,
                    abort=refusal.code.name,
                )

    def _late(self) -> None:
        self.node.event(Code.PDO_LATE, pdo=self.number)
        self.node.emergency.report(RPDO_LATE, self.number, bytes([self.number]))
