"""Several nodes on one port of the bus: a frame finds those that listen by one look into a table.

Most frames of the rig (its own process data) concern none of its nodes, so six nodes that each look
at each frame cost more than the sampling itself. Inside the rack nodes hear one another as on a
wire: everybody but the sender. The order is that of adding.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol

from rollerrig.firmware_sim.cia301.communication import EXTENDED
from rollerrig.firmware_sim.cia301.host import NEVER, Timers
from rollerrig.wsp_interface.bus.frames import Frame

Handler = Callable[[Frame], None]
Gate = Callable[[Any, Frame, Callable[[], None]], bool]


class Member(Protocol):
    """What a rack wants of a node; `cia301.node.Node` and `nmt_master.NmtMaster` have it."""

    now_ns: int
    timers: Timers
    handlers: dict[int, Handler]
    remote_handlers: dict[int, Handler]
    on_rewired: Callable[[], None]

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None: ...  # power on
    def power_off(self) -> None: ...
    def poll(self, now_ns: int) -> None: ...  # it is `now_ns`


class Rack:
    """Nodes that share a port.

    `off`: members without power; `muted`: members whose controller is off the bus; neither hear nor speak.
    `gate(member, frame, carry)`, where there is one, decides whether a frame goes on now; it may call `carry` later.
    `deferred(frame, then, origin)`, where there is one, puts a frame on a bus that takes time: members hear one
    another when it calls `then`. `deaf`: members whose controller takes in nothing, though it sends.
    """

    def __init__(self) -> None:
        self.members: list[Member] = []
        self.off: set[int] = set()
        self.muted: set[int] = set()
        self.deaf: set[int] = set()
        self.deferred: Callable[[Frame, Callable[[], None], int], Any] | None = None
        self.gate: Gate | None = None
        self._send: Callable[[Frame], Any] = lambda frame: None
        # who listens to which identifier, and to which remote request (~identifier)
        self._table: dict[int, list[tuple[Member, Handler]]] = {}

    def add(self, member: Member) -> None:
        """Put a node into the rack, before or after `start`."""
        self.members.append(member)
        member.on_rewired = self._forget
        self._forget()

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None:
        """Power on all members, in the order of adding."""
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
        """Take a member's controller off the bus, or put it back; the member runs on."""
        (self.muted.add if on else self.muted.discard)(id(member))
        self._forget()

    def deafen(self, member: Member, on: bool) -> None:
        """Let a member's controller take in nothing, or everything again; it sends on."""
        (self.deaf.add if on else self.deaf.discard)(id(member))
        self._forget()

    def transmit(self, sender: Member, frame: Frame) -> None:
        """A frame from a member."""
        if id(sender) in self.off or id(sender) in self.muted:
            return
        if self.gate is None or self.gate(sender, frame, partial(self._carry, sender, frame)):
            self._carry(sender, frame)

    def on_frame(self, frame: Frame) -> None:
        """A frame from outside the rack."""
        for _, handler in self._listeners(frame):
            handler(frame)

    def tell_time(self, now_ns: int) -> None:
        """It is `now_ns`: members note it, and do nothing yet."""
        for member in self.members:
            member.now_ns = max(member.now_ns, now_ns)

    def poll(self, now_ns: int) -> None:
        """It is `now_ns`, for all members."""
        for member in self._powered():
            member.poll(now_ns)

    def next_ns(self) -> int:
        """When the first alarm of any member is due."""
        return min((member.timers.next_ns for member in self._powered()), default=NEVER)

    def ring(self, now_ns: int) -> None:
        """Let alarms go off that are due; all else waits for `poll`."""
        for member in self._powered():
            member.timers.poll(now_ns, member)

    def _powered(self) -> Iterable[Member]:
        return (member for member in self.members if id(member) not in self.off)

    def _carry(self, sender: Member, frame: Frame) -> None:
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
        at = frame.can_id | EXTENDED if frame.extended else frame.can_id
        return (self._table or self._build()).get(~at if frame.remote else at, ())

    def _forget(self) -> None:
        self._table = {}

    def _build(self) -> dict[int, list[tuple[Member, Handler]]]:
        for member in self.members:
            if id(member) not in self.off | self.muted | self.deaf:
                remote = {~at: handler for at, handler in member.remote_handlers.items()}
                for at, handler in (member.handlers | remote).items():
                    self._table.setdefault(at, []).append((member, handler))
        return self._table
