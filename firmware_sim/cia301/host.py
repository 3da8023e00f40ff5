"""A node as its services see it: state, time, objects, alarms, bus and events.

The services (emergencies, heartbeats, SYNC, PDOs, LSS, storage) see their node as a `Host`. Only
`node` knows all services. The owner of a node passes the time to it, in simulated or in wall
nanoseconds.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from canopen.objectdictionary import ObjectDictionary

from rollerrig.firmware_sim.cia301 import communication
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Objects
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code, OnEvent

NEVER = 1 << 62  # a time in ns
MS = 1_000_000  # ns
S = 1_000_000_000  # ns
# A late alarm sees the time for which it was set, so that repeated alarms do not drift. If it is
# later than this, it sees a time that much before the present one.
_CATCH_UP_NS = 5 * MS


class Alarm(NamedTuple):
    """A call at a time; `times_out` as in `Timers.set`."""

    due_ns: int
    call: Callable[[], None]
    times_out: bool


class Timers:
    """A few named alarms. The caller of `poll` passes the time.

    Setting a name again moves its alarm. No alarm is due before `next_ns`, so an idle poll costs
    one comparison.
    """

    def __init__(self) -> None:
        self._due: dict[str, Alarm] = {}
        self.next_ns = NEVER

    def set(
        self, name: str, due_ns: int, call: Callable[[], None], times_out: bool = False
    ) -> None:
        """Call once at `due_ns`. `times_out`: the alarm means that another node is silent."""
        self._due[name] = Alarm(due_ns, call, times_out)
        self.next_ns = min(self.next_ns, due_ns)

    def cancel(self, name: str) -> None:
        """Forget an alarm; a name that is not set is no error."""
        self._due.pop(name, None)

    def clear(self) -> None:
        """Forget every alarm."""
        self._due.clear()
        self.next_ns = NEVER

    def running(self, name: str) -> bool:
        """Return whether an alarm of this name waits."""
        return name in self._due

    def excuse(self, until_ns: int) -> None:
        """Let no time-out go off before `until_ns`: the frames that it waits for may be there."""
        for name, alarm in self._due.items():
            if alarm.times_out and alarm.due_ns < until_ns:
                self._due[name] = alarm._replace(due_ns=until_ns)

    def poll(self, now_ns: int, owner: Any) -> None:
        """Call every alarm that is due, the earliest first.

        `owner.now_ns` is the time of the alarm during its call, and `now_ns` afterwards.
        """
        while self.next_ns <= now_ns:
            due_ns, name = self._earliest()
            self.next_ns = due_ns
            if due_ns <= now_ns:
                owner.now_ns = max(due_ns, now_ns - _CATCH_UP_NS)
                self._due.pop(name).call()
        owner.now_ns = now_ns

    def _earliest(self) -> tuple[int, str]:
        """Return time and name of the earliest alarm; at equal times the first by name."""
        times = [(alarm.due_ns, name) for name, alarm in self._due.items()]
        return min(times, default=(NEVER, ""))


class Host:
    """The part of a node that its services share.

    `dictionary` is the object dictionary (the content of the EDS file), `emergency` the EMCY
    producer.

    Calls:
    - `on_sync()`: before PDOs are sampled.
    - `on_partner(node, alive)`: a partner's heartbeat is lost or back (node 0: the guarding
      master).
    - `on_event(code, **fields)`: an event of the run.

    `event_enablers`: by the index of an object, the key of the object that enables its event-driven
    PDO. `commands`: objects that a master writes in each cycle, so that they are never stored.
    """

    emergency: Any

    def __init__(self, dictionary: ObjectDictionary) -> None:
        assert dictionary.node_id is not None
        self.dictionary = dictionary
        self.node_id = int(dictionary.node_id)
        self.state = State.INITIALISING
        self.now_ns = 0
        # the clock for inhibit times: `now_ns` may be a little past while an alarm is called
        self.clock_ns: Callable[[], int] = lambda: self.now_ns
        self.objects = Objects(dictionary, self.node_id)
        self.timers = Timers()
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

    def report_partner(self, partner: int, alive: bool) -> None:
        """Inform the application that a partner's heartbeat is lost or back."""
        for call in self.on_partner:
            call(partner, alive)

    def communication_error(self) -> None:
        """Change the NMT state after a communication error as 1029h:1 defines."""

    def reset_node(self, everything: bool = True) -> None:
        """Restore the power-on values and boot up.

        `everything` False: only the values of the communication (1000h to 1FFFh).
        """

    def rewire(self) -> None:
        """Update the identifiers to which the node listens, and the actions of a SYNC."""
