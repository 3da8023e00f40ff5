"""Fault confinement: the effect of destroyed frames on the CAN controllers of the rig's nodes.

Each controller has two counters. An error frame adds 8 to the counter of the sender of the
destroyed frame [C1]. It adds 1 to that of every receiver, and 8 more to that of the receiver that
has found the error [C2]. A frame that gets through subtracts 1 from each of them [C3]. A node with
a counter above 127 is error passive: its error flags destroy nothing, so if it still finds errors,
it alone misses the frames. A node with a transmit counter above 255 is off the bus until 128 times
11 recessive bits have passed.

    [C1] TEC += 8    [C2] REC += 1, the finder's += 9, at most 255
    [C3] TEC -= 1, REC -= 1, not below 0; a REC above 127 becomes 127

Source: ISO 11898-1, fault confinement; CiA 301, EMCY 8120h (error passive), 8140h (recovered from
bus-off). Limits: counters are followed only while a fault is active or a counter is above 0; a
faulty receiver transmits without errors; programs outside have counters of their own.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.events import Code

# error codes of EMCY
ERROR_PASSIVE = 0x8120
RECOVERED = 0x8140

# counters
PASSIVE_ABOVE = 127
OFF_ABOVE = 255
HIGHEST = 255
RECOVERY_BITS = 128 * 11
# what an error frame adds
_SENDER = 8
_RECEIVER = 1
_FINDER = 9

# called with the destroyed frame, the counters (transmit, receive) of the node that found the
# error, and whether that node sent the frame
Destroyed = Callable[[Frame, int, int, bool], None]


@dataclass
class Controller:
    """The controller of one node.

    `attempts`: how often each of its frames is destroyed. `finds`: how often it finds an error in a
    frame of another node. `transmit`, `receive`: the counters. `reported_passive`: it has reported
    that it is error passive. `off_until_ns`: end of bus-off, 0 if it is on the bus.
    """

    attempts: int = 0
    finds: int = 0
    transmit: int = 0
    receive: int = 0
    reported_passive: bool = False
    off_until_ns: int = 0

    @property
    def passive(self) -> bool:
        """Whether it is error passive, so that its error flags destroy nothing."""
        return self.transmit > PASSIVE_ABOVE or self.receive > PASSIVE_ABOVE

    @property
    def deaf(self) -> bool:
        """Whether it alone misses every frame."""
        return bool(self.finds) and self.passive


@dataclass
class Controllers:
    """The counters of all nodes; empty while no fault is active."""

    destroyed: Destroyed
    nodes: dict[int, Controller] = field(default_factory=dict)

    def passes(self, frame: Frame, node: int) -> bool:
        """Whether a frame of a node (0: of a program outside) gets through, after any number of
        errors.
        """
        sender = self.nodes.get(node)
        if sender is not None and sender.transmit > OFF_ABOVE:
            return False
        # who finds an error in this frame, and how many times
        finders: list[tuple[Controller, int]] = []
        if sender is not None:
            finders.append((sender, sender.attempts))
        for receiver in self.nodes.values():
            if receiver is not sender and not receiver.off_until_ns:
                finders.append((receiver, receiver.finds))

        for finder, times in finders:
            for _ in range(times):
                # passive error flags of a receiver destroy nothing
                if finder is not sender and finder.passive:
                    break
                self._destroy(frame, sender, finder)
                if sender is not None and sender.transmit > OFF_ABOVE:
                    return False
        self._succeed(sender)
        return True

    def _destroy(self, frame: Frame, sender: Controller | None, finder: Controller) -> None:
        """Count an error frame."""
        for controller in self.nodes.values():
            if controller is sender:
                controller.transmit += _SENDER  # [C1]
            elif not controller.off_until_ns:
                step = _FINDER if controller is finder else _RECEIVER
                controller.receive = min(controller.receive + step, HIGHEST)  # [C2]
        self.destroyed(frame, min(finder.transmit, HIGHEST), finder.receive, finder is sender)

    def _succeed(self, sender: Controller | None) -> None:
        """Count a frame that gets through [C3]."""
        for controller in self.nodes.values():
            if controller is sender:
                controller.transmit = max(controller.transmit - 1, 0)
            elif controller.deaf:
                controller.receive = min(controller.receive + _RECEIVER, HIGHEST)
            else:
                controller.receive = min(max(controller.receive - 1, 0), PASSIVE_ABOVE)


class Confinement:
    """The effects of the counters on the nodes: EMCY, bus-off and recovery, missed frames.

    `members` are the nodes by number. `mute(node, on)` takes a node off the wire, `deafen(node,
    on)` keeps frames from it.
    """

    def __init__(
        self,
        controllers: Controllers,
        members: dict[int, Any],
        mute: Callable[[int, bool], None],
        deafen: Callable[[int, bool], None],
        bitrate: int,
    ) -> None:
        self.controllers = controllers
        self.members = members
        self.mute = mute
        self.deafen = deafen
        self._recovery_ns = RECOVERY_BITS * S_NS // bitrate
        self._deaf: set[int] = set()

    @property
    def busy(self) -> bool:
        """Whether any counter must still be followed."""
        return bool(self.controllers.nodes)

    def disturb(self, node: int, **often: Any) -> None:
        """Begin error frames, or end them (0).

        `attempts` concerns the frames that a node sends, `finds` those that it receives.
        """
        nodes = self.controllers.nodes
        if not nodes:
            nodes.update((number, Controller()) for number in self.members)
        nodes[node] = replace(nodes[node], **often)

    def poll(self, now_ns: int) -> None:
        """Follow the counters; forget them when all controllers are free of errors."""
        nodes = self.controllers.nodes
        for node, controller in nodes.items():
            if controller.off_until_ns:
                if now_ns >= controller.off_until_ns:
                    self._end_bus_off(node, controller)
            elif controller.transmit > OFF_ABOVE:
                controller.off_until_ns = now_ns + self._recovery_ns
                self.mute(node, True)
                self.members[node].event(Code.CAN_BUS_OFF)
            elif controller.passive != controller.reported_passive:
                self._report_passive(node, controller)
            self._follow_deafness(node, controller)
        if all(controller == Controller() for controller in nodes.values()):
            nodes.clear()

    def _end_bus_off(self, node: int, controller: Controller) -> None:
        controller.transmit = 0
        controller.receive = 0
        controller.off_until_ns = 0
        controller.reported_passive = False
        self.mute(node, False)
        recover(self.members[node])

    def _follow_deafness(self, node: int, controller: Controller) -> None:
        if controller.deaf == (node in self._deaf):
            return
        if controller.deaf:
            self._deaf.add(node)
        else:
            self._deaf.discard(node)
        self.deafen(node, controller.deaf)

    def _report_passive(self, node: int, controller: Controller) -> None:
        """Report that a node has become error passive, or error active again."""
        member = self.members[node]
        controller.reported_passive = controller.passive
        if not controller.passive:
            member.event(Code.CAN_ERROR_ACTIVE)
            member.emergency.clear(ERROR_PASSIVE)
            return
        which = "transmit" if controller.transmit > PASSIVE_ABOVE else "receive"
        member.event(Code.CAN_ERROR_PASSIVE, counter=which)
        member.emergency.report(ERROR_PASSIVE)


def recover(member: Any) -> None:
    """Let a node report that it is back from bus-off."""
    member.emergency.clear(ERROR_PASSIVE)
    member.emergency.report(RECOVERED)
    member.emergency.clear(RECOVERED)
