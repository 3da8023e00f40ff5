"""Programs that send at the same instant of simulated time take turns, so that their order repeats.

In lockstep the simulated time waits until the WSP unit and the harness have answered. Both compute
at the same time, so the order in which their frames arrive depends on the load of the machine. A
`Partner` therefore holds back the frames of its connections until it has the turn: first the unit,
then the harness. Frames that come after the answer wait for the next turn.

The process data that a unit sends up to an answer go on together, in the order of arbitration; of
the same identifier the first goes first. A harness asks and waits for the reply, so its frames go
on in the order in which it sends them. So do services (NMT, SDO, heartbeats, LSS) of both.

Limits: a unit must not wait for a frame of the harness before it answers. A partner whose frames
come over CAN of the kernel is not held back, because its frames have an order there already. If a
partner sends more than `HELD_MAX` frames before its turn, they go on immediately.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rollerrig.wsp_interface.bus.client import Client
from rollerrig.wsp_interface.bus.connection_set import is_service
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.wire import arbitration_field

# more than any correct partner sends in a bus cycle
HELD_MAX = 1000

Carry = Callable[[], None]


class Held(NamedTuple):
    """A frame that waits for a turn; `answers`: it is an answer that was awaited."""

    frame: Frame
    carry: Carry
    answers: bool


class Partner:
    """The WSP unit or the harness, which answers in its turn.

    answered: set while the partner owes no answer.
    arbitrates: whether its process data up to an answer go on in the order of arbitration.

    Attributes:
    members: its connections.
    speaker: the connection that has to answer; None while the partner is unknown.
    """

    def __init__(self, arbitrates: bool) -> None:
        self.answered = asyncio.Event()
        self.answered.set()
        self.members: set[Client] = set()
        self.speaker: Client | None = None
        self._arbitrates = arbitrates
        self._has_turn = False
        self._held: deque[Held] = deque()
        self._answers_held = 0
        self._contending: list[Held] = []  # process data since the last answer

    @property
    def gone(self) -> bool:
        """Whether the connection that has to answer is closed."""
        return self.speaker is not None and self.speaker.lost.done()

    @contextlib.contextmanager
    def turn(self) -> Iterator[None]:
        """Let the partner send until its last answer, or until the end of the block."""
        self._has_turn = True
        self._go_on()
        try:
            yield
        finally:
            self._has_turn = False

    def take(self, frame: Frame, carry: Carry, answers: bool) -> None:
        """Take a frame; carry it now if it is the partner's turn, else later."""
        self._held.append(Held(frame, carry, answers))
        self._answers_held += answers
        self._go_on()
        if len(self._held) + len(self._contending) > HELD_MAX:
            self._release()

    def leave(self) -> None:
        """Forget the connections; what they have sent goes on now."""
        self.members.clear()
        self.speaker = None
        self._release()

    def _go_on(self) -> None:
        """Let held frames go on up to the last answer, or all as long as an answer is owed."""
        while self._held and self._has_turn:
            if self.answered.is_set() and not self._answers_held:
                return
            self._send(self._next())

    def _release(self) -> None:
        """Let everything that is held go on."""
        while self._held:
            self._send(self._next())
        self._arbitrate()

    def _next(self) -> Held:
        held = self._held.popleft()
        self._answers_held -= held.answers
        return held

    def _send(self, held: Held) -> None:
        if not self._arbitrates or is_service(held.frame):
            held.carry()
            return
        self._contending.append(held)
        if held.answers:
            self._arbitrate()

    def _arbitrate(self) -> None:
        contending = sorted(self._contending, key=lambda held: arbitration_field(held.frame))
        self._contending = []
        for held in contending:
            held.carry()
