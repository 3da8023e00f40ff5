"""A CANopen slave: NMT state machine, and the services of CiA 301 around one object dictionary.

The owner of the node passes frames and the time to it. The node answers immediately through the
`send` with which it was started, and never blocks. A frame that does not concern the node in its
present state costs one look into a table. Source: CiA 301, NMT slave, boot-up and error control.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ObjectDictionary

from rollerrig.firmware_sim.cia301 import communication
from rollerrig.firmware_sim.cia301.communication import PDOS, SDO_SERVERS
from rollerrig.firmware_sim.cia301.emergency import Emergency
from rollerrig.firmware_sim.cia301.heartbeat import Consumer, Producer
from rollerrig.firmware_sim.cia301.host import MS, Host
from rollerrig.firmware_sim.cia301.lss import UNCONFIGURED, LssSlave
from rollerrig.firmware_sim.cia301.nmt import STATE_AFTER, Command, State
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.firmware_sim.cia301.pdo import EVENT, Rpdo, Tpdo
from rollerrig.firmware_sim.cia301.sdo import SdoServer
from rollerrig.firmware_sim.cia301.storage import Storage
from rollerrig.firmware_sim.cia301.sync import SyncConsumer, check_consumed
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT, LSS_REQUEST, NMT
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

SDO_TIME_OUT_MS = 1000
# the state that a communication error leads to, by the value of 1029h; other values keep the state
_ON_ERROR = {0: State.PRE_OPERATIONAL, 2: State.STOPPED}
Handler = Callable[[Frame], None]


class Node(Host):
    """One slave. `device` is the object of its device profile.

    Hooks for the device profile besides those of `Host` (lists of calls):
    - `on_state(old, new)`: the NMT state has changed.
    - `on_reset()`: before values return to their power-on state.
    - `on_power_off()`.
    - `on_poll(now_ns)`.

    `handlers` and `remote_handlers` map identifiers to calls. `on_rewired()` is called when they
    have changed. `time_of_day` is the last TIME message: days since 1 January 1984, and
    milliseconds.
    """

    def __init__(self, dictionary: ObjectDictionary, storage: Path | None = None) -> None:
        super().__init__(dictionary)
        self.time_of_day: tuple[int, int] | None = None
        self.device: Any = None
        self.on_state: list[Callable[[State, State], None]] = []
        self.on_reset: list[Callable[[], None]] = []
        self.on_power_off: list[Callable[[], None]] = []
        self.on_poll: list[Callable[[int], None]] = []
        self.on_rewired: Callable[[], None] = lambda: None
        self.emergency = Emergency(self)
        self.producer = Producer(self)
        self.consumer = Consumer(self)
        self.sync = SyncConsumer(self)
        tpdo_count = sum(0x1800 <= index < 0x1A00 for index in dictionary)
        self.tpdos = [Tpdo(self, 0x1800, number) for number in range(tpdo_count)]
        self.rpdos = [
            Rpdo(self, 0x1400, number, self.sync.window_is_over) for number in range(PDOS)
        ]
        self.storage = Storage(self, storage)
        self.lss = LssSlave(self, self.storage)
        self._servers = [
            SdoServer(self.objects, partial(self._reply, server)) for server in range(SDO_SERVERS)
        ]
        self._watched: list[Tpdo] = []  # event-driven TPDOs, which each poll checks for changes
        self.handlers: dict[int, Handler] = {}
        self.remote_handlers: dict[int, Handler] = {}
        self.objects.attach(0x1012, check=check_consumed, effect=lambda _: self.rewire())
        for server in range(1, SDO_SERVERS):
            for sub in (1, 2):
                communication.attach_cob_id(
                    self.objects, 0x1200 + server, sub, lambda _: self.rewire()
                )

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None:
        """Power on: power-on values, boot-up message, PRE-OPERATIONAL."""
        self.send = send
        self.now_ns = now_ns
        self.lss.power_on()
        self.reset_node()

    def power_off(self) -> None:
        """Switch the power off: the node sends and receives nothing until the next `start`."""
        self.send = lambda frame: None
        self.state = State.INITIALISING
        self.timers.clear()
        self.handlers = {}
        self.remote_handlers = {}
        self._watched = []
        self.on_rewired()
        for call in self.on_power_off:
            call()

    def on_frame(self, frame: Frame) -> None:
        """Take a frame from the bus. Never raises, whatever the frame contains."""
        at = communication.dispatch_key(frame.can_id, frame.extended)
        handlers = self.remote_handlers if frame.remote else self.handlers
        handler = handlers.get(at)
        if handler is not None:
            handler(frame)

    def poll(self, now_ns: int) -> None:
        """Do what is due at `now_ns`. Call it every millisecond, or every bus cycle."""
        self.timers.poll(now_ns, self)
        for call in self.on_poll:
            call(now_ns)
        for tpdo in self._watched:
            tpdo.watch(now_ns)

    def communication_error(self) -> None:
        state = _ON_ERROR.get(self.objects.values[key(0x1029, 1)])
        if state is State.STOPPED or (
            state is State.PRE_OPERATIONAL and self.state is State.OPERATIONAL
        ):
            self._enter(state)

    def reset_node(self, everything: bool = True) -> None:
        old = self.state
        self.state = State.INITIALISING
        self._report_state(old)
        if everything:
            for call in self.on_reset:
                call()
        self.timers.clear()
        self.node_id = self.lss.pending
        self.objects.node_id = self.node_id
        first, last = (0, 0xFFFF) if everything else (0x1000, 0x1FFF)
        self.objects.power_on(first, last, self.storage.load())
        self.consumer.forget()
        self.sync.forget()
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
        old = self.state
        self.state = state
        self.rebuild()
        self._report_state(old)
        if boot_up:
            # when everything is in place: a master may answer before this call returns
            self.transmit(HEARTBEAT + self.node_id, boot_up)
        self.emergency.flush()

    def _report_state(self, old: State) -> None:
        if old is not self.state:
            self.event(Code.NMT_STATE, state=self.state.title)
        for call in self.on_state:
            call(old, self.state)

    def _on_nmt(self, frame: Frame) -> None:
        if len(frame.data) != 2 or frame.data[1] not in (0, self.node_id):
            return
        command = frame.data[0]
        if command in STATE_AFTER:
            self._enter(STATE_AFTER[Command(command)])
        elif command in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
            self.reset_node(everything=command == Command.RESET_NODE)

    def _on_time(self, frame: Frame) -> None:
        if len(frame.data) == 6:
            milliseconds = int.from_bytes(frame.data[:4], "little") & 0x0FFFFFFF
            self.time_of_day = int.from_bytes(frame.data[4:], "little"), milliseconds

    def _on_sdo(self, server: int, frame: Frame) -> None:
        transfer = self._servers[server]
        alarm = f"sdo {server}"
        transfer.on_request(frame.data)
        if transfer.active is not None:
            self.timers.set(
                alarm, self.now_ns + SDO_TIME_OUT_MS * MS, transfer.time_out, times_out=True
            )
        else:
            self.timers.cancel(alarm)

    def _reply(self, server: int, data: bytes) -> None:
        self.transmit(self.objects.values[key(0x1200 + server, 2)], data)

    def rebuild(self) -> None:
        """Apply every communication parameter, for the present NMT state."""
        for pdo in (*self.rpdos, *self.tpdos):
            pdo.configure(self.state is State.OPERATIONAL)
        self.rewire()

    def rewire(self) -> None:
        self.sync.configure(
            [rpdo.on_sync for rpdo in self.rpdos if rpdo.live and rpdo.synchronous],
            [tpdo.on_sync for tpdo in self.tpdos if tpdo.live and tpdo.on_sync],
        )
        self.consumer.configure()
        self._watched = [tpdo for tpdo in self.tpdos if tpdo.live and tpdo.kind >= EVENT]
        self.handlers = {LSS_REQUEST: self.lss.on_frame}
        self.remote_handlers = {}
        self.on_rewired()
        if self.node_id == UNCONFIGURED:
            return
        self.handlers[NMT] = self._on_nmt
        self.remote_handlers[HEARTBEAT + self.node_id] = self.consumer.on_request
        for partner in self.consumer.watched:
            self._listen(HEARTBEAT + partner, self.consumer.on_frame)
        if self.state.has_services:
            self._listen_to_services()
        # PDOs are live only in OPERATIONAL
        for rpdo in self.rpdos:
            if rpdo.live:
                self._listen(self.objects.values[key(rpdo.index, 1)], rpdo.on_frame)
        for tpdo in self.tpdos:
            cob_id = self.objects.values[key(tpdo.index, 1)]
            remote_allowed = not cob_id & communication.FLAG
            if tpdo.live and remote_allowed:
                at = communication.dispatch_key(*communication.split(cob_id))
                self.remote_handlers[at] = tpdo.on_remote

    def _listen_to_services(self) -> None:
        values = self.objects.values
        for server in range(SDO_SERVERS):
            request = values[key(0x1200 + server, 1)]
            reply = values[key(0x1200 + server, 2)]
            if communication.valid(request) and communication.valid(reply):
                self._listen(request, partial(self._on_sdo, server))
        self._listen(values[key(0x1005, 0)], self.sync.on_frame)
        # bit 31 of 1012h means "consume", not "does not exist"
        if values[key(0x1012, 0)] & communication.INVALID:
            self._listen(values[key(0x1012, 0)], self._on_time)

    def _listen(self, cob_id: int, handler: Handler) -> None:
        """Call a handler for an identifier, after those that are there already."""
        at = communication.dispatch_key(*communication.split(cob_id))
        first = self.handlers.get(at)
        if first is None:
            self.handlers[at] = handler
        else:

            def both(frame: Frame) -> None:
                first(frame)
                handler(frame)

            self.handlers[at] = both
