"""SYNC: the moment at which all nodes sample and act together.

What came for synchronous receive PDOs is taken over first, then every synchronous transmit PDO is
sampled and sent. A SYNC may carry a counter from 1 to the overflow value 1019h; one of another
length is reported and still obeyed. Source: CiA 301, SYNC protocol, objects 1005h and 1019h.
"""

from typing import TYPE_CHECKING

from rollerrig.firmware_sim.cia301 import identifiers
from rollerrig.firmware_sim.cia301.abort import Abort, AbortError
from rollerrig.firmware_sim.cia301.emergency import SYNC_LENGTH
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import key

if TYPE_CHECKING:
    from rollerrig.firmware_sim.cia301.node import Node
    from rollerrig.wsp_interface.frames import Frame


class SyncConsumer:
    """What a node does at a SYNC."""

    def __init__(self, node: "Node") -> None:
        self.node = node
        self._length = 0
        node.objects.checks[key(0x1005, 0)] = self._check_cob_id
        node.objects.effects[key(0x1005, 0)] = lambda _: node.rewire()
        node.objects.checks[key(0x1019, 0)] = self._check_overflow
        node.objects.effects[key(0x1019, 0)] = lambda _: node.rewire()

    def configure(self) -> None:
        """Take 1005h, 1019h and the PDOs over."""
        node = self.node
        self._length = 1 if node.objects.values[key(0x1019, 0)] else 0
        self._receive = [rpdo.on_sync for rpdo in node.rpdos if rpdo.live and rpdo.synchronous]
        self._transmit = [tpdo.on_sync for tpdo in node.tpdos if tpdo.live and tpdo.on_sync]

    @property
    def cob_id(self) -> int:
        return self.node.objects.values[key(0x1005, 0)]

    def on_frame(self, frame: "Frame") -> None:
        """A SYNC message."""
        node, data = self.node, frame.data
        if len(data) != self._length:
            node.emergency.report(SYNC_LENGTH, 0, bytes([len(data), self._length]))
        elif node.emergency.active:
            node.emergency.clear(SYNC_LENGTH)
        for take in self._receive:
            take()
        for react in node.on_sync:
            react()
        if node.state is State.OPERATIONAL:
            counter = data[0] if data else None
            for transmit in self._transmit:
                transmit(counter)

    def _check_cob_id(self, wanted: int) -> None:
        # bit 30 would make this node the producer of SYNC, which it cannot be
        if wanted & identifiers.FLAG:
            raise AbortError(Abort.INVALID_VALUE)
        if identifiers.split(wanted)[0] != 0x80 or wanted & identifiers.EXTENDED:
            identifiers.check_identifier(wanted)

    def _check_overflow(self, value: int) -> None:
        if value == 1:
            raise AbortError(Abort.INVALID_VALUE)


class TimeConsumer:
    """Takes TIME messages: milliseconds of the day, and days since 1 January 1984."""

    def __init__(self, node: "Node") -> None:
        self.node = node
        node.objects.checks[key(0x1012, 0)] = self._check_cob_id
        node.objects.effects[key(0x1012, 0)] = lambda _: node.rewire()

    @property
    def cob_id(self) -> int:
        return self.node.objects.values[key(0x1012, 0)]

    def consumes(self) -> bool:
        """Whether bit 31 of 1012h is set: it means "consume" there."""
        return bool(self.cob_id & identifiers.INVALID)

    def on_frame(self, frame: "Frame") -> None:
        """A TIME message; one that has not six bytes is left alone."""
        if len(frame.data) == 6:
            milliseconds = int.from_bytes(frame.data[:4], "little") & 0x0FFFFFFF
            self.node.time_of_day = int.from_bytes(frame.data[4:], "little"), milliseconds

    def _check_cob_id(self, wanted: int) -> None:
        if wanted & identifiers.FLAG:
            raise AbortError(Abort.INVALID_VALUE)
        identifiers.check_identifier(wanted & ~identifiers.INVALID)
