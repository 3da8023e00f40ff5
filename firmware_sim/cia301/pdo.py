"""Process data objects: values of several objects in one message, packed without gaps.

A transmit PDO goes out with every n-th SYNC, on a change or a timer, or when it is asked for; a
receive PDO is taken at once or with the next SYNC. Both are compiled to one struct and one list of
calls when they are configured. Source: CiA 301, PDO protocols and transmission types.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.communication import split, valid
from rollerrig.firmware_sim.cia301.emergency import PDO_LENGTH, RPDO_LATE
from rollerrig.firmware_sim.cia301.host import MS, Host
from rollerrig.firmware_sim.cia301.objects import AbortError, key, packer
from rollerrig.firmware_sim.cia301.pdo_mapping import DUMMIES, govern, mapped
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

ACYCLIC, LAST_SYNCHRONOUS, RTR_SYNCHRONOUS, RTR, EVENT = 0, 240, 252, 253, 254


class Channel:
    """What both directions share. `live`: it exists, carries something, and the node is OPERATIONAL."""

    def __init__(self, node: Host, index: int, number: int) -> None:
        self.node, self.index, self.number, self.live = node, index + number, number + 1, False
        self.alarm = f"{type(self).__name__.lower()} {self.number}"
        govern(node, self.index, self.configure, isinstance(self, Tpdo))

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
    """One transmit PDO. `on_sync(counter)`: what a SYNC sets off, None: nothing."""

    def configure(self, operational: bool) -> None:
        super().configure(operational)
        self.kind, inhibit, event, self.start = self._parameters(2, 3, 5, 6)
        if not self.live:
            return
        objects, enabling = self.node.objects, self.node.event_enablers
        self.getters = [objects.getter(at) for at in self.entries]
        self.pack = packer([objects.variables[at] for at in self.entries]).pack
        self.enablers = {enabling[at >> 8] for at in self.entries if at >> 8 in enabling}
        self.inhibit_ns, self.event_ns, self.free_ns = inhibit * 100_000, event * MS, 0
        self.every, self.passed = self.kind if 1 <= self.kind <= LAST_SYNCHRONOUS else 1, 0
        self.last: bytes | None = None
        self.sampled: bytes | None = None
        every_sync = self.kind == 1 and not self.start
        cyclic = (
            self._now if every_sync else self._cyclic if self.kind <= LAST_SYNCHRONOUS else None
        )
        self.on_sync = {ACYCLIC: self._on_change, RTR_SYNCHRONOUS: self._keep}.get(
            self.kind, cyclic
        )
        self._await_event()

    def sample(self) -> bytes:
        """The message's content now."""
        return self.pack(*[get() for get in self.getters])

    def on_remote(self, _: Frame) -> None:
        """Somebody asks for this PDO."""
        self._send(self.sample() if self.kind >= RTR or self.sampled is None else self.sampled)

    def watch(self, now_ns: int) -> None:
        """Event-driven transmission: send what has changed, as soon as the inhibit time allows."""
        if now_ns < self.free_ns:
            return
        data, values = self.sample(), self.node.objects.values
        if self.last is None or (
            data != self.last and (not self.enablers or any(values[at] for at in self.enablers))
        ):
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
        # the everyday case (type 1), kept short: it is the bus thread's inner loop
        data = self.sampled = self.pack(*[get() for get in self.getters])
        self.node.send(Frame(self.can_id, data, self.extended))

    def _cyclic(self, counter: int | None) -> None:
        if self.start and counter is not None:
            # wait for the SYNC with this number, and count from there
            if counter != self.start:
                return
            self.start, self.passed = 0, self.every - 1
        self.passed += 1
        if self.passed >= self.every:
            self.passed = 0
            self._now(counter)

    def _on_change(self, _: int | None) -> None:
        self.sampled = self.sample()
        if self.sampled != self.last:
            self._send(self.sampled)

    def _keep(self, _: int | None) -> None:
        self.sampled = self.sample()

    def _send(self, data: bytes) -> None:
        self.last = data
        self.node.send(Frame(self.can_id, data, self.extended))
        if self.kind >= EVENT and self.inhibit_ns:
            self.free_ns = self.node.clock_ns() + self.inhibit_ns
            self.node.timers.set(
                f"{self.alarm} inhibited", self.free_ns, lambda: self.watch(self.free_ns)
            )
        self._await_event()


class Rpdo(Channel):
    """One receive PDO. `too_late(frame)`: the window of synchronous messages is over (1007h)."""

    def __init__(
        self, node: Host, index: int, number: int, too_late: Callable[[Frame], bool]
    ) -> None:
        super().__init__(node, index, number)
        self.too_late = too_late
        self.refused: set[int] = set()

    def configure(self, operational: bool) -> None:
        super().configure(operational)
        kind, event = self._parameters(2, 5)
        self.synchronous, self.deadline_ns = kind <= LAST_SYNCHRONOUS, event * MS
        self.waiting: bytes | None = None
        if self.live:
            variables = self.node.objects.variables
            layout = packer([DUMMIES.get(at) or variables[at] for at in self.entries])
            self.size, self.unpack = layout.size, layout.unpack

    def on_frame(self, frame: Frame) -> None:
        """A message for this PDO: one that is too short is reported and not used."""
        node, data, emergency = self.node, frame.data, self.node.emergency
        if len(data) < self.size:
            if emergency.report(
                PDO_LENGTH, self.number, bytes([self.number, len(data), self.size])
            ):
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
        """Take over what came since the last SYNC."""
        if self.waiting is not None:
            data, self.waiting = self.waiting, None
            self.apply(data)

    def apply(self, data: bytes) -> None:
        """Write the content into the objects; a value that its object refuses is left out."""
        objects = self.node.objects
        for at, value in zip(self.entries, self.unpack(data[: self.size]), strict=True):
            if at in DUMMIES:
                continue
            try:
                objects.assign(at, value)
                self.refused.discard(at)
            except AbortError as refused:
                # told once, not with every message
                if at not in self.refused:
                    self.refused.add(at)
                    self.node.event(
                        Code.PDO_REFUSED,
                        pdo=self.number,
                        index=at >> 8,
                        sub=at & 0xFF,
                        value=value,
                        abort=refused.code.name,
                    )

    def _late(self) -> None:
        self.node.event(Code.PDO_LATE, pdo=self.number)
        self.node.emergency.report(RPDO_LATE, self.number, bytes([self.number]))
