"""What a service of CiA 301 needs of the node it belongs to, and the alarms of that node.

The services (emergencies, heartbeats, SYNC, PDOs, LSS, storage) know their node as a `Host`; only
`node` knows them all. A node owns no clock: whoever runs it says what time it is, in simulated or in
wall nanoseconds.
"""

from collections.abc import Callable
from typing import Any, Protocol

from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Objects
from rollerrig.wsp_interface.bus.frames import Frame

NEVER = 1 << 62
MS = 1_000_000


class Timers:
    """A few named alarms on a time that somebody else tells; setting a name again moves its alarm.

    Nothing is done before the earliest alarm is due, so an idle poll costs one comparison.
    """

    def __init__(self) -> None:
        self._due: dict[str, tuple[int, Callable[[], None]]] = {}
        self.next_ns = NEVER

    def set(self, name: str, due_ns: int, call: Callable[[], None]) -> None:
        """Call once at `due_ns`."""
        self._due[name] = (due_ns, call)
        self.next_ns = min(self.next_ns, due_ns)

    def cancel(self, name: str) -> None:
        """Forget an alarm; a name that is not set is no error."""
        self._due.pop(name, None)

    def clear(self) -> None:
        """Forget every alarm."""
        self._due.clear()
        self.next_ns = NEVER

    def running(self, name: str) -> bool:
        """Whether an alarm of this name waits."""
        return name in self._due

    def poll(self, now_ns: int) -> None:
        """Call every alarm that is due, the earliest first."""
        if now_ns < self.next_ns:
            return
        due = sorted((at, name) for name, (at, _) in self._due.items() if at <= now_ns)
        for at, name in due:
            # an earlier alarm may have cancelled or moved this one
            waiting = self._due.get(name)
            if waiting is not None and waiting[0] == at:
                del self._due[name]
                waiting[1]()
        self.next_ns = min((at for at, _ in self._due.values()), default=NEVER)


class Errors(Protocol):
    """The errors of a node, as `emergency.Emergency` keeps them."""

    @property
    def active(self) -> object:
        """True-like while there is any."""

    def report(self, code: int, source: int = 0, information: bytes = b"") -> bool:
        """An error has begun; False if it is already known."""

    def clear(self, code: int, source: int = 0) -> None:
        """An error has ended, if it was there."""


class Host(Protocol):
    """A node, as its services see it."""

    node_id: int
    state: State
    now_ns: int
    time_of_day: tuple[int, int] | None
    objects: Objects
    timers: Timers
    event_enablers: dict[int, int]
    send: Callable[[Frame], Any]
    on_sync: list[Callable[[], None]]

    @property
    def emergency(self) -> Errors:
        """Where errors are reported."""

    def transmit(self, cob_id: int, data: bytes) -> None:
        """Send a message on the identifier of a COB-ID entry."""

    def event(self, level: str, text: str) -> None:
        """Tell the run's events about something that happened to this node."""

    def tell_partner(self, partner: int, alive: bool) -> None:
        """Tell the application that a partner's heartbeat is lost or back."""

    def communication_error(self) -> None:
        """Do what 1029h:1 says after a communication error."""

    def reset_communication(self) -> None:
        """Begin anew with the communication's power-on values."""

    def rewire(self) -> None:
        """Decide anew which identifiers the node listens to, and what a SYNC sets off."""
