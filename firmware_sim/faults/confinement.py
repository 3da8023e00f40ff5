"""Fault confinement: what destroyed frames do to the CAN controllers of the rig's nodes.

Each controller has two counters. An error frame costs the sender of what it destroys 8 [C1], every
receiver 1 and the receiver that has found the error 8 more [C2]; a frame that gets through gives
each of them 1 back [C3]. Above 127 in either counter a node is error passive: its error flags
destroy nothing, and a receiver that goes on finding errors then misses the frames by itself. Above
255 in the transmit counter it is off the bus until 128 times 11 recessive bits have passed.

    [C1] TEC += 8    [C2] REC += 1, the finder's += 9, at most 255
    [C3] TEC -= 1, REC -= 1, not below 0; a REC above 127 becomes 127

Source: ISO 11898-1, fault confinement; CiA 301, EMCY 8120h (error passive), 8140h (recovered from
bus-off). Limits: only while a fault is at work or its counters are still above 0; a faulty receiver
transmits well; programs outside count for themselves.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.events import Code

ERROR_PASSIVE, RECOVERED = 0x8120, 0x8140
PASSIVE_ABOVE, OFF_ABOVE, HIGHEST, RECOVERY_BITS = 127, 255, 255, 128 * 11
_SENDER, _RECEIVER, _FINDER = 8, 1, 9

# a frame that is destroyed; the counters (transmit, receive) of who says so, and whether he sent it
Destroyed = Callable[[Frame, int, int, bool], None]


@dataclass
class Controller:
    """One node's controller.

    `attempts`: how often each of its own frames is destroyed; `finds`: how often it takes a frame
    of somebody else for faulty; `reported_passive`: it has said that it is error passive.
    """

    attempts: int = 0
    finds: int = 0
    transmit: int = 0
    receive: int = 0
    reported_passive: bool = False
    off_until_ns: int = 0

    @property
    def passive(self) -> bool:
        """Whether its error flags destroy nothing."""
        return self.transmit > PASSIVE_ABOVE or self.receive > PASSIVE_ABOVE

    @property
    def deaf(self) -> bool:
        """Whether it misses every frame, and nobody else does."""
        return bool(self.finds) and self.passive


@dataclass
class Controllers:
    """The counters of all nodes; empty while no fault is at work."""

    destroyed: Destroyed
    nodes: dict[int, Controller] = field(default_factory=dict)

    def passes(self, frame: Frame, node: int) -> bool:
        """Whether a frame of a node (0: of a program outside) gets through, after how many errors ever."""
        sender = self.nodes.get(node)
        if sender is not None and sender.transmit > OFF_ABOVE:
            return False
        finders = [] if sender is None else [(sender, sender.attempts)]
        finders += [
            (one, one.finds)
            for one in self.nodes.values()
            if one is not sender and not one.off_until_ns
        ]
        for finder, times in finders:
            for _ in range(times):
                # a receiver's flags destroy nothing once they are passive
                if finder is not sender and finder.passive:
                    break
                self._destroy(frame, sender, finder)
                if sender is not None and sender.transmit > OFF_ABOVE:
                    return False
        self._succeed(sender)
        return True

    def _destroy(self, frame: Frame, sender: Controller | None, finder: Controller) -> None:
        for one in self.nodes.values():
            if one is sender:
                one.transmit += _SENDER  # [C1]
            elif not one.off_until_ns:
                one.receive = min(
                    one.receive + (_FINDER if one is finder else _RECEIVER), HIGHEST
                )  # [C2]
        self.destroyed(frame, min(finder.transmit, HIGHEST), finder.receive, finder is sender)

    def _succeed(self, sender: Controller | None) -> None:
        for one in self.nodes.values():
            if one is sender:
                one.transmit = max(one.transmit - 1, 0)  # [C3]
            elif one.deaf:
                one.receive = min(one.receive + _RECEIVER, HIGHEST)
            else:
                one.receive = min(max(one.receive - 1, 0), PASSIVE_ABOVE)


class Confinement:
    """What the counters mean for the nodes: EMCY, bus-off and recovery, deafness.

    `members` are the nodes by number, `mute(node, on)` takes one off the wire, `deafen(node, on)` keeps frames from it.
    """

    def __init__(
        self,
        controllers: Controllers,
        members: dict[int, Any],
        mute: Callable[[int, bool], None],
        deafen: Callable[[int, bool], None],
        bitrate: int,
    ) -> None:
        self.controllers, self.members, self.mute, self.deafen = controllers, members, mute, deafen
        self._recovery_ns = RECOVERY_BITS * S_NS // bitrate
        self._deaf: set[int] = set()

    @property
    def busy(self) -> bool:
        """Whether any counter has still to be followed."""
        return bool(self.controllers.nodes)

    def disturb(self, node: int, **often: Any) -> None:
        """Let error frames begin, or end (0): `attempts` on what a node sends, `finds` on what it receives."""
        nodes = self.controllers.nodes
        if not nodes:
            nodes.update((number, Controller()) for number in self.members)
        nodes[node] = replace(nodes[node], **often)

    def poll(self, now_ns: int) -> None:
        """Follow the counters; forget them when all nodes are sound."""
        nodes = self.controllers.nodes
        for node, one in nodes.items():
            if one.off_until_ns:
                if now_ns >= one.off_until_ns:
                    one.transmit = one.receive = one.off_until_ns = 0
                    one.reported_passive = False
                    self.mute(node, False)
                    recover(self.members[node])
            elif one.transmit > OFF_ABOVE:
                one.off_until_ns = now_ns + self._recovery_ns
                self.mute(node, True)
                self.members[node].event(Code.CAN_BUS_OFF)
            elif one.passive != one.reported_passive:
                self._tell(node, one)
            if one.deaf != (node in self._deaf):
                (self._deaf.add if one.deaf else self._deaf.discard)(node)
                self.deafen(node, one.deaf)
        # nothing is the matter with any of them
        if all(one == Controller() for one in nodes.values()):
            nodes.clear()

    def _tell(self, node: int, one: Controller) -> None:
        member, one.reported_passive = self.members[node], one.passive
        if not one.passive:
            member.event(Code.CAN_ERROR_ACTIVE)
            member.emergency.clear(ERROR_PASSIVE)
            return
        which = "transmit" if one.transmit > PASSIVE_ABOVE else "receive"
        member.event(Code.CAN_ERROR_PASSIVE, counter=which)
        member.emergency.report(ERROR_PASSIVE)


def recover(member: Any) -> None:
    """Let a node tell that it is back from bus-off."""
    member.emergency.clear(ERROR_PASSIVE)
    member.emergency.report(RECOVERED)
    member.emergency.clear(RECOVERED)
