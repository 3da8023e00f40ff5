"""A node as its services know it: state, time, objects, alarms, and the way to the bus and to the events.

The services (emergencies, heartbeats, SYNC, PDOs, LSS, storage) know their node as a `Host`; only `node` knows them
all. Whoever runs a node says what time it is, in simulated or in wall nanoseconds.
"""

from collections.abc import Callable
from typing import Any

from canopen.objectdictionary import ObjectDictionary

from rollerrig.firmware_sim.cia301 import communication
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Objects
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code, OnEvent

NEVER = 1 << 62
MS = 1_000_000
S = 1_000_000_000
# an alarm that is called late is told its own time, so that what repeats does not drift, but none before this
_CATCH_UP_NS = 5 * MS


class Timers:
    """A few named alarms on a time that somebody else tells; setting a name again moves its alarm.

    Nothing is done before `next_ns`, so an idle poll costs one comparison.
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

    def poll(self, now_ns: int, owner: Any) -> None:
        """Call every alarm that is due, the earliest first, with its time in `owner.now_ns`; then that is `now_ns`."""
        while self.next_ns <= now_ns:
            at, name = min(((at, name) for name, (at, _) in self._due.items()), default=(NEVER, ""))
            self.next_ns = at
            if at <= now_ns:
                owner.now_ns = max(at, now_ns - _CATCH_UP_NS)
                self._due.pop(name)[1]()
        owner.now_ns = now_ns


class Host:
    """The part of a node that its services share: `dictionary` is what its EDS file says, `emergency` its errors.

    `on_sync()` is called before PDOs are sampled, `on_partner(node, alive)` for heartbeats (node 0: the guarding
    master), `on_event(code, **fields)` for the run's events. `event_enablers`: which object lets changes of another go
    out. `commands`: objects that may be mapped and are asked for from cycle to cycle, so that they are never stored.
    """

    emergency: Any

    def __init__(self, dictionary: ObjectDictionary) -> None:
        assert dictionary.node_id is not None
        self.dictionary, self.node_id = dictionary, int(dictionary.node_id)
        self.state, self.now_ns = State.INITIALISING, 0
        # what the sender of a frame looks at that must not follow too soon: an alarm's own time may be a little past
        self.clock_ns: Callable[[], int] = lambda: self.now_ns
        self.objects, self.timers = Objects(dictionary, self.node_id), Timers()
        self.send: Callable[[Frame], Any] = lambda frame: None
        self.on_event: OnEvent = events.ignore
        self.on_sync: list[Callable[[], None]] = []
        self.on_partner: list[Callable[[int, bool], None]] = []
        self.event_enablers: dict[int, int] = {}
        self.commands: frozenset[int] = frozenset()

    def transmit(self, cob_id: int, data: bytes) -> None:
        """Send a message on the identifier of a COB-ID entry."""
        can_id, extended = communication.split(cob_id)
        self.send(Frame(can_id, data, extended))

    def event(self, code: Code, **fields: Any) -> None:
        """Add an event of this node to the events of the run."""
        self.on_event(code, node=self.node_id, **fields)

    def tell_partner(self, partner: int, alive: bool) -> None:
        """Tell the application that a partner's heartbeat is lost or back."""
        for call in self.on_partner:
            call(partner, alive)

    def communication_error(self) -> None:
        """Do what 1029h:1 says about the NMT state after a communication error."""

    def reset_node(self, everything: bool = True) -> None:
        """The application's and the communication's power-on values, or the latter alone, and boot-up."""

    def rewire(self) -> None:
        """Decide anew which identifiers the node listens to, and what a SYNC sets off."""
