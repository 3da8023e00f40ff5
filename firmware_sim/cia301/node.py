"""A CANopen slave: NMT state machine, and the services of CiA 301 around one object dictionary.

Whoever runs the node hands it frames and the time; it answers through the `send` it was started
with, at once and without blocking. A frame that means nothing to it in its present state costs one
look into a table. Source: CiA 301, NMT slave, boot-up and error control.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ObjectDictionary

from rollerrig.firmware_sim.cia301 import communication, heartbeat, pdo_mapping, sync
from rollerrig.firmware_sim.cia301.communication import PDOS, SDO_SERVERS
from rollerrig.firmware_sim.cia301.emergency import Emergency
from rollerrig.firmware_sim.cia301.host import MS, Timers
from rollerrig.firmware_sim.cia301.lss import UNCONFIGURED, LssSlave
from rollerrig.firmware_sim.cia301.nmt import COMMANDED, Command, State
from rollerrig.firmware_sim.cia301.objects import Objects, key
from rollerrig.firmware_sim.cia301.pdo import EVENT, Rpdo, Tpdo
from rollerrig.firmware_sim.cia301.sdo import SdoServer
from rollerrig.firmware_sim.cia301.storage import Storage
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT, LSS_REQUEST, NMT
from rollerrig.wsp_interface.bus.frames import Frame

SDO_TIME_OUT_MS = 1000
Handler = Callable[[Frame], None]


class Node:
    """One slave.

    Hooks for the device profile, lists of calls: `on_state(old, new)`, `on_reset()` before values
    go back to their power-on state, `on_power_off()`, `on_sync()` before PDOs are sampled, `on_poll(now_ns)`,
    `on_partner(node, alive)` for heartbeats (node 0: the guarding master). `on_event(level, text)`
    is for the run's events. `device` is the profile's own object. `handlers` and `remote_handlers`
    say what is called for which identifier; `on_rewired()` tells that they are new.
    """

    def __init__(self, dictionary: ObjectDictionary, storage: Path | None = None) -> None:
        assert dictionary.node_id is not None
        self.node_id: int = dictionary.node_id
        self.state, self.now_ns = State.INITIALISING, 0
        self.time_of_day: tuple[int, int] | None = None
        self.device: Any = None
        self.on_event: Callable[[str, str], None] = lambda level, text: None
        self.on_state: list[Callable[[State, State], None]] = []
        self.on_reset: list[Callable[[], None]] = []
        self.on_power_off: list[Callable[[], None]] = []
        self.on_sync: list[Callable[[], None]] = []
        self.on_poll: list[Callable[[int], None]] = []
        self.on_partner: list[Callable[[int, bool], None]] = []
        self.on_rewired: Callable[[], None] = lambda: None
        self.event_enablers: dict[int, int] = {}
        self.send: Callable[[Frame], Any] = lambda frame: None
        self.timers = Timers()
        self.objects = Objects(dictionary, self.node_id)
        self.emergency = Emergency(self)
        self.producer, self.consumer = heartbeat.Producer(self), heartbeat.Consumer(self)
        self.guarding = heartbeat.Guarding(self)
        self.tpdos = [Tpdo(self, number) for number in range(PDOS)]
        self.sync, self.time = sync.SyncConsumer(self), sync.TimeConsumer(self)
        self.rpdos = [Rpdo(self, number, self.sync.window_is_over) for number in range(PDOS)]
        self.storage = Storage(self, storage)
        self.lss = LssSlave(self, self.storage)
        self._servers = [SdoServer(self.objects, partial(self._reply, server))
                         for server in range(SDO_SERVERS)]
        self._watched: list[Tpdo] = []
        self.handlers: dict[int, Handler] = {}
        self.remote_handlers: dict[int, Handler] = {}
        self._govern()

    @property
    def dictionary(self) -> ObjectDictionary:
        """The node's object dictionary (what its EDS file says)."""
        return self.objects.dictionary

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None:
        """Power on: power-on values, boot-up message, PRE-OPERATIONAL."""
        self.send, self.now_ns = send, now_ns
        self.lss.power_on()
        self.reset_node()

    def power_off(self) -> None:
        """Power is gone: the node is silent and deaf until the next `start`."""
        self.send = lambda frame: None
        self.state = State.INITIALISING
        self.timers.clear()
        self.handlers, self.remote_handlers, self._watched = {}, {}, []
        self.on_rewired()
        for call in self.on_power_off:
            call()

    def on_frame(self, frame: Frame) -> None:
        """A frame from the bus. Never raises, whatever it contains."""
        at = frame.can_id | communication.EXTENDED if frame.extended else frame.can_id
        handler = (self.remote_handlers if frame.remote else self.handlers).get(at)
        if handler is not None:
            handler(frame)

    def poll(self, now_ns: int) -> None:
        """It is `now_ns`: do what is due. Call it every millisecond, or every bus cycle."""
        self.now_ns = now_ns
        if now_ns >= self.timers.next_ns:
            self.timers.poll(now_ns)
        for call in self.on_poll:
            call(now_ns)
        for tpdo in self._watched:
            tpdo.watch(now_ns)

    def transmit(self, cob_id: int, data: bytes) -> None:
        """Send a message on the identifier of a COB-ID entry."""
        can_id, extended = communication.split(cob_id)
        self.send(Frame(can_id, data, extended))

    def event(self, level: str, text: str) -> None:
        """Tell the run's events about something that happened to this node."""
        self.on_event(level, f"node {self.node_id}: {text}")

    def tell_partner(self, partner: int, alive: bool) -> None:
        """Tell the application that a partner's heartbeat is lost or back."""
        for call in self.on_partner:
            call(partner, alive)

    def communication_error(self) -> None:
        """What 1029h:1 says about the NMT state after a communication error."""
        wanted = heartbeat.on_error_state(self.objects.values[key(0x1029, 1)])
        if wanted is State.STOPPED or (wanted and self.state is State.OPERATIONAL):
            self._enter(wanted)

    def reset_node(self) -> None:
        """The application's and the communication's power-on values, and boot-up."""
        self._reset(0, everything=True)

    def reset_communication(self) -> None:
        """The communication's power-on values, and boot-up."""
        self._reset(0x1000, everything=False)

    def _reset(self, first: int, everything: bool) -> None:
        old, self.state = self.state, State.INITIALISING
        self._tell_state(old)
        for call in self.on_reset if everything else ():
            call()
        self.timers.clear()
        self.node_id = self.objects.node_id = self.lss.pending
        self.objects.power_on(first, 0xFFFF if everything else 0x1FFF, self.storage.load())
        for part in (self.consumer, self.guarding, self.sync):
            part.forget()
        self.emergency.forget(everything)
        for server in self._servers:
            server.active = None
        if self.node_id == UNCONFIGURED:
            self.rebuild()
            return
        self.producer.configure()
        self._enter(State.PRE_OPERATIONAL, bytes(1))

    def _enter(self, state: State, boot_up: bytes = b"") -> None:
        if state is self.state:
            return
        old, self.state = self.state, state
        self.rebuild()
        self._tell_state(old)
        if boot_up:
            # last, and after all is in place: a master may answer before this call returns
            self.transmit(HEARTBEAT + self.node_id, boot_up)
        self.emergency.flush()

    def _tell_state(self, old: State) -> None:
        if old is not self.state:
            self.event("info", f"NMT {self.state.title}")
        for call in self.on_state:
            call(old, self.state)

    def _on_nmt(self, frame: Frame) -> None:
        if len(frame.data) != 2 or frame.data[1] not in (0, self.node_id):
            return
        command = frame.data[0]
        if command in COMMANDED:
            self._enter(COMMANDED[Command(command)])
        elif command == Command.RESET_NODE:
            self.reset_node()
        elif command == Command.RESET_COMMUNICATION:
            self.reset_communication()

    def _on_sdo(self, server: int, frame: Frame) -> None:
        transfer = self._servers[server]
        transfer.on_request(frame.data)
        alarm = f"sdo {server}"
        if transfer.active is not None:
            self.timers.set(alarm, self.now_ns + SDO_TIME_OUT_MS * MS, transfer.time_out)
        else:
            self.timers.cancel(alarm)

    def _reply(self, server: int, data: bytes) -> None:
        self.transmit(self.objects.values[key(0x1200 + server, 2)], data)

    def rebuild(self) -> None:
        """Take every communication parameter over, for the present NMT state."""
        operational = self.state is State.OPERATIONAL
        for receives in self.rpdos:
            receives.configure(operational)
        for transmits in self.tpdos:
            transmits.configure(operational)
        self.rewire()

    def rewire(self) -> None:
        """Decide anew which identifiers the node listens to, and what a SYNC sets off."""
        self.sync.configure([rpdo.on_sync for rpdo in self.rpdos if rpdo.live and rpdo.synchronous],
                            [tpdo.on_sync for tpdo in self.tpdos if tpdo.live and tpdo.on_sync])
        self.consumer.configure()
        self._watched = [one for one in self.tpdos if one.live and one.kind >= EVENT]
        self.handlers, self.remote_handlers = {LSS_REQUEST: self.lss.on_frame}, {}
        self.on_rewired()
        if self.node_id == UNCONFIGURED:
            return
        self.handlers[NMT] = self._on_nmt
        self.remote_handlers[HEARTBEAT + self.node_id] = self.guarding.on_request
        for partner in self.consumer.watched:
            self._listen(HEARTBEAT + partner, self.consumer.on_frame)
        if self.state.has_emergencies:
            self._listen_to_services()
        if self.state is State.OPERATIONAL:
            self._listen_to_pdos()

    def _listen_to_services(self) -> None:
        values = self.objects.values
        for server in range(SDO_SERVERS):
            request, reply = values[key(0x1200 + server, 1)], values[key(0x1200 + server, 2)]
            if communication.valid(request) and communication.valid(reply):
                self._listen(request, partial(self._on_sdo, server))
        self._listen(self.sync.cob_id, self.sync.on_frame)
        if self.time.consumes():
            self._listen(self.time.cob_id, self.time.on_frame)

    def _listen_to_pdos(self) -> None:
        for rpdo in self.rpdos:
            if rpdo.live:
                self._listen(communication.dispatch_key(rpdo.can_id, rpdo.extended), rpdo.on_frame)
        for tpdo in self.tpdos:
            cob_id = self.objects.values[key(tpdo.index, 1)]
            if tpdo.live and not cob_id & communication.FLAG:
                at = communication.dispatch_key(tpdo.can_id, tpdo.extended)
                self.remote_handlers[at] = tpdo.on_remote

    def _listen(self, cob_id: int, handler: Handler) -> None:
        at = communication.dispatch_key(*communication.split(cob_id))
        first = self.handlers.get(at)
        if first is None:
            self.handlers[at] = handler
        else:
            def both(frame: Frame) -> None:
                first(frame)
                handler(frame)

            self.handlers[at] = both

    def _govern(self) -> None:
        for rpdo, tpdo in zip(self.rpdos, self.tpdos, strict=True):
            pdo_mapping.govern(self, rpdo.index, rpdo.configure, False)
            pdo_mapping.govern(self, tpdo.index, tpdo.configure, True)
        values, checks = self.objects.values, self.objects.checks
        for server in range(1, SDO_SERVERS):
            for sub in (1, 2):
                at = key(0x1200 + server, sub)
                checks[at] = lambda wanted, at=at: communication.check_change(values[at], wanted)
                self.objects.effects[at] = lambda _: self.rewire()
