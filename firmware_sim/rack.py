"""Several nodes on one port of the bus: one look into a table finds the listeners of a frame.

Most frames of the rig are its process data, which none of its nodes receives. If each of six nodes
looked at each frame, that would cost more time than the sampling of the signals. Inside the rack
all nodes except the sender hear a frame, as on a wire. They hear it in the order in which they were
added.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol

from rollerrig.firmware_sim.cia301.communication import EXTENDED
from rollerrig.firmware_sim.cia301.host import MS, NEVER, Timers
from rollerrig.wsp_interface.bus.frames import Frame

# an alarm that is this late shows that the process stood still
_STOOD_STILL_NS = 20 * MS
# in this time it takes the frames that have come meanwhile
_GRACE_NS = 50 * MS

Handler = Callable[[Frame], None]
Gate = Callable[[Any, Frame, Callable[[], None]], bool]


class Member(Protocol):
    """What a rack requires of a node; `cia301.node.Node` and `nmt_master.NmtMaster` have it."""

    now_ns: int
    timers: Timers
    handlers: dict[int, Handler]
    remote_handlers: dict[int, Handler]
    on_rewired: Callable[[], None]

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None:
        """Power on."""

    def power_off(self) -> None:
        """Power off."""

    def poll(self, now_ns: int) -> None:
        """Do what is due at `now_ns`."""


class Rack:
    """Nodes that share a port.

    Sets of members, by `id`:
    - `off`: without power. They neither hear nor send.
    - `muted`: their CAN controller is off the bus. They neither hear nor send, but run on.
    - `deaf`: their CAN controller receives nothing, but sends.

    Optional hooks:
    - `gate(member, frame, carry)` returns whether a frame is carried now; it may call `carry`
      later.
    - `deferred(frame, then, origin)` puts a frame on a bus that takes time. Members hear the frame
      when it calls `then`.
    """

    def __init__(self) -> None:
        self.members: list[Member] = []
        self.off: set[int] = set()
        self.muted: set[int] = set()
        self.deaf: set[int] = set()
        self.deferred: Callable[[Frame, Callable[[], None], int], Any] | None = None
        self.gate: Gate | None = None
        self._send: Callable[[Frame], Any] = lambda frame: None
        self._in_real_time = False
        # the listeners of each identifier, and of each remote request (~identifier); empty: not
        # built
        self._table: dict[int, list[tuple[Member, Handler]]] = {}

    def add(self, member: Member) -> None:
        """Put a node into the rack, before or after `start`."""
        self.members.append(member)
        member.on_rewired = self._forget
        self._forget()

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None:
        """Power on all members, in the order in which they were added."""
        self._send = send
        for member in self.members:
            member.start(partial(self.transmit, member), now_ns)

    def power(self, member: Member, on: bool, now_ns: int) -> None:
        """Switch one member off, or on again (it boots)."""
        self._forget()
        if not on:
            self.off.add(id(member))
            member.power_off()
        elif id(member) in self.off:
            self.off.discard(id(member))
            member.start(partial(self.transmit, member), now_ns)

    def mute(self, member: Member, on: bool) -> None:
        """Take a member's CAN controller off the bus, or put it back; the member runs on."""
        self._mark(self.muted, member, on)

    def deafen(self, member: Member, on: bool) -> None:
        """Let a member's CAN controller receive nothing, or everything again. It still sends."""
        self._mark(self.deaf, member, on)

    def _mark(self, marked: set[int], member: Member, on: bool) -> None:
        if on:
            marked.add(id(member))
        else:
            marked.discard(id(member))
        self._forget()

    def transmit(self, sender: Member, frame: Frame) -> None:
        """Take a frame from a member."""
        if id(sender) in self.off or id(sender) in self.muted:
            return
        carry = partial(self._carry, sender, frame)
        if self.gate is None or self.gate(sender, frame, carry):
            carry()

    def on_frame(self, frame: Frame) -> None:
        """Take a frame from outside the rack."""
        for _, handler in self._listeners(frame):
            handler(frame)

    def hears(self, frame: Frame) -> bool:
        """Return whether a member listens to frames with this identifier in this form."""
        return bool(self._listeners(frame))

    def in_real_time(self) -> None:
        """Count real time from now on: it continues while this process is stopped."""
        self._in_real_time = True

    def advance_clock(self, now_ns: int) -> None:
        """Advance the clocks of all members to `now_ns`; they do nothing yet."""
        for member in self.members:
            member.now_ns = max(member.now_ns, now_ns)

    def poll(self, now_ns: int) -> None:
        """Let all members do what is due at `now_ns`."""
        self._excuse_silence(now_ns)
        for member in self._powered():
            member.poll(now_ns)

    def next_ns(self) -> int:
        """Return the time of the first alarm of any member."""
        return min((member.timers.next_ns for member in self._powered()), default=NEVER)

    def ring(self, now_ns: int) -> None:
        """Let the alarms go off that are due; everything else waits for `poll`."""
        self._excuse_silence(now_ns)
        for member in self._powered():
            member.timers.poll(now_ns, member)

    def _excuse_silence(self, now_ns: int) -> None:
        """Put off the time-outs if this process stood still.

        Frames that came meanwhile have not been read, and members have not sent theirs. A member
        would take their senders for silent.
        """
        if self._in_real_time and now_ns - self.next_ns() > _STOOD_STILL_NS:
            for member in self.members:
                member.timers.excuse(now_ns + _GRACE_NS)

    def _powered(self) -> Iterable[Member]:
        return (member for member in self.members if id(member) not in self.off)

    def _carry(self, sender: Member, frame: Frame) -> None:
        """Put a frame on the bus, and let the other members hear it."""
        if self.deferred is not None:
            self.deferred(frame, partial(self._hear, sender, frame), id(sender))
            return
        self._send(frame)
        self._hear(sender, frame)

    def _hear(self, sender: Member, frame: Frame) -> None:
        for member, handler in self._listeners(frame):
            if member is not sender:
                handler(frame)

    def _listeners(self, frame: Frame) -> Iterable[tuple[Member, Handler]]:
        identifier = frame.can_id
        if frame.extended:
            identifier |= EXTENDED
        if frame.remote:
            identifier = ~identifier
        if not self._table:
            self._build()
        return self._table.get(identifier, ())

    def _forget(self) -> None:
        """Forget the table: the next frame builds it again."""
        self._table = {}

    def _build(self) -> None:
        not_listening = self.off | self.muted | self.deaf
        for member in self.members:
            if id(member) in not_listening:
                continue
            handlers = dict(member.handlers)
            for identifier, handler in member.remote_handlers.items():
                handlers[~identifier] = handler
            for identifier, handler in handlers.items():
                self._table.setdefault(identifier, []).append((member, handler))
