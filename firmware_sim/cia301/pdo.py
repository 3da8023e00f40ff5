"""Process data objects: values of several objects in one message, packed without gaps.

A transmit PDO goes out with every n-th SYNC, on a change or a timer, or when it is asked for; a
receive PDO is taken at once or with the next SYNC. Both are compiled to one struct and one list of
calls when they are configured. Source: CiA 301, PDO protocols and transmission types.
"""

from collections.abc import Callable
from typing import Any

from rollerrig.firmware_sim.cia301.communication import split, valid
from rollerrig.firmware_sim.cia301.emergency import PDO_LENGTH, RPDO_LATE
from rollerrig.firmware_sim.cia301.host import MS, Host
from rollerrig.firmware_sim.cia301.objects import AbortError, key, packer
from rollerrig.firmware_sim.cia301.pdo_mapping import DUMMIES, mapped
from rollerrig.wsp_interface.bus.frames import Frame

ACYCLIC, LAST_SYNCHRONOUS, RTR_SYNCHRONOUS, RTR, EVENT = 0, 240, 252, 253, 254


class Tpdo:
    """One transmit PDO. `live`: it exists, carries something, and the node is OPERATIONAL."""

    def __init__(self, node: Host, number: int) -> None:
        self.node, self.index, self.number = node, 0x1800 + number, number + 1
        self.live, self.can_id, self.extended = False, 0, False
        self.kind, self.every, self.passed = EVENT, 1, 0
        self.inhibit_ns = self.event_ns = self.free_ns = 0
        self.getters: list[Callable[[], Any]] = []
        self.enablers: set[int] = set()
        self.last: bytes | None = None
        self.sampled: bytes | None = None
        self.on_sync: Callable[[int | None], None] | None = None

    def configure(self, operational: bool) -> None:
        """Compile communication and mapping parameters."""
        objects, alarm = self.node.objects, f"tpdo {self.number}"
        cob_id, self.kind, inhibit, event, start = (
            objects.values[key(self.index, sub)] for sub in (1, 2, 3, 5, 6))
        entries = mapped(objects, self.index + 0x200)
        self.live = operational and valid(cob_id) and bool(entries)
        self.node.timers.cancel(alarm)
        if not self.live:
            return
        self.can_id, self.extended = split(cob_id)
        self.getters = [objects.getter(at) for at in entries]
        self.pack = packer([objects.variables[at] for at in entries]).pack
        enabling = self.node.event_enablers
        self.enablers = {enabling[at >> 8] for at in entries if at >> 8 in enabling}
        self.inhibit_ns, self.event_ns, self.free_ns = inhibit * 100_000, event * MS, 0
        self.every = self.kind if 1 <= self.kind <= LAST_SYNCHRONOUS else 1
        self.passed, self.start = 0, start
        self.last = self.sampled = None
        self.on_sync = {ACYCLIC: self._on_change, RTR_SYNCHRONOUS: self._keep}.get(
            self.kind, self._cyclic if self.kind <= LAST_SYNCHRONOUS else None)
        if self.kind == 1 and not start:
            self.on_sync = self._now
        if self.kind >= EVENT and self.event_ns:
            self.node.timers.set(alarm, self.node.now_ns + self.event_ns, self._event_timer)

    def sample(self) -> bytes:
        """The message's content now."""
        return self.pack(*[get() for get in self.getters])

    def on_remote(self, _: Frame) -> None:
        """Somebody asks for this PDO."""
        if self.kind >= RTR or self.sampled is None:
            self._send(self.sample())
        else:
            self._send(self.sampled)

    def watch(self, now_ns: int) -> None:
        """Event-driven transmission: send what has changed, as soon as the inhibit time allows."""
        if now_ns < self.free_ns:
            return
        data = self.sample()
        if self.last is None or (data != self.last and self._enabled()):
            self._send(data)

    def _enabled(self) -> bool:
        values = self.node.objects.values
        return not self.enablers or any(values[at] for at in self.enablers)

    def _event_timer(self) -> None:
        self.free_ns = 0
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
        node, self.last = self.node, data
        self.free_ns = node.now_ns + self.inhibit_ns
        node.send(Frame(self.can_id, data, self.extended))
        if self.kind >= EVENT and self.event_ns:
            node.timers.set(f"tpdo {self.number}", node.now_ns + self.event_ns, self._event_timer)


class Rpdo:
    """One receive PDO. `too_late(frame)`: the window of synchronous messages is over (1007h)."""

    def __init__(self, node: Host, number: int, too_late: Callable[[Frame], bool]) -> None:
        self.node, self.index, self.number = node, 0x1400 + number, number + 1
        self.too_late = too_late
        self.live, self.synchronous, self.size = False, False, 0
        self.entries: list[int] = []
        self.refused: set[int] = set()
        self.waiting: bytes | None = None
        self.deadline_ns = 0

    def configure(self, operational: bool) -> None:
        """Compile communication and mapping parameters."""
        objects = self.node.objects
        cob_id, kind, event = (objects.values[key(self.index, sub)] for sub in (1, 2, 5))
        self.entries = mapped(objects, self.index + 0x200)
        self.live = operational and valid(cob_id) and bool(self.entries)
        self.node.timers.cancel(f"rpdo {self.number}")
        self.waiting = None
        if not self.live:
            return
        self.can_id, self.extended = split(cob_id)
        self.synchronous = kind <= LAST_SYNCHRONOUS
        self.deadline_ns = event * MS
        layout = packer([DUMMIES.get(at) or objects.variables[at] for at in self.entries])
        self.size, self.unpack = layout.size, layout.unpack

    def on_frame(self, frame: Frame) -> None:
        """A message for this PDO: one that is too short is reported and not used."""
        node, data = self.node, frame.data
        if len(data) < self.size:
            if node.emergency.report(PDO_LENGTH, self.number,
                                     bytes([self.number, len(data), self.size])):
                node.event("warning", f"RPDO {self.number} ignored: {len(data)} bytes instead of "
                                      f"{self.size}")
            return
        if node.emergency.active:
            node.emergency.clear(PDO_LENGTH, self.number)
            node.emergency.clear(RPDO_LATE, self.number)
        if self.deadline_ns:
            node.timers.set(f"rpdo {self.number}", node.now_ns + self.deadline_ns, self._late)
        if self.synchronous:
            if not self.too_late(frame):
                self.waiting = data
        else:
            self.apply(data)

    def on_sync(self) -> None:
        """Take over what came since the last SYNC."""
        if self.waiting is not None:
            data, self.waiting = self.waiting, None
            self.apply(data)

    def apply(self, data: bytes) -> None:
        """Write the content into the objects; a value that its object refuses is left out."""
        objects = self.node.objects
        for at, value in zip(self.entries, self.unpack(data[:self.size]), strict=True):
            if at in DUMMIES:
                continue
            try:
                objects.assign(at, value)
                self.refused.discard(at)
            except AbortError as refused:
                self._refuse(at, value, refused)

    def _refuse(self, at: int, value: Any, refused: AbortError) -> None:
        # told once, not with every message
        if at not in self.refused:
            self.refused.add(at)
            self.node.event("warning", f"RPDO {self.number}: object {at >> 8:04X}h:{at & 0xFF} "
                                       f"refuses {value} ({refused.code.name})")

    def _late(self) -> None:
        self.node.event("warning", f"RPDO {self.number} is late")
        self.node.emergency.report(RPDO_LATE, self.number, bytes([self.number]))
