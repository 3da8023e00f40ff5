"""WSP units that are CAN nodes in FMUs: their frames to the bus of the rig, and those of the bus to them.

After a SYNC and the pressures of node 17 the FMUs hear what the bus has carried since the last, and their time goes
on by the SYNC period, in steps of their own, of the interval of their Tx_Clock, or of 1 ms. What they send on the way
is confirmed to the sender and heard by the other FMUs, where several send at a time by their identifiers as in
arbitration, and goes to the bus at the end of these steps; heartbeat and magnets last, since with them the bench goes
on. So in lockstep a run repeats. Before the first SYNC their time goes on until the unit's heartbeat (720h), and with
each NMT command to a unit that is not OPERATIONAL until it is, a second at most.
Source: FMI 3.0.2, co-simulation with event mode and clocks; FMI-LS-BUS 1.0, importer with integrated bus simulation.
Limits: confirmed is what has been handed to the bus; classical CAN, another frame is a Bus Error of form; error frames
of the rig's bus are told without an Arbitration Lost, and with the identifier 0 where the bus does not say it.
"""

import contextlib
import ctypes
import logging
import tempfile
import time
from pathlib import Path

import can

from rollerrig.configs.errors import UnitError
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.fmu import ls_bus
from rollerrig.firmware_sim.fmu.fmu_file import Fitted
from rollerrig.firmware_sim.fmu.ls_bus import Code, Operation, Parameter
from rollerrig.firmware_sim.fmu.signal_unit import Watch, initialising, open_fmu, print_at_once
from rollerrig.firmware_sim.wsp import node as serving
from rollerrig.wsp_interface.bus.connection_set import NMT, SYNC
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.bus.plugin import frame_of, message_of
from rollerrig.wsp_interface.bus.wire import arbitration_field
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, PRESSURES, UNIT_HEARTBEAT_ID
from rollerrig.wsp_interface.signals import WSP_NODE

log = logging.getLogger(__name__)

_STEP_NS, _QUIET_S, _BOOT_S, _ANSWER_S, _NEVER = 1_000_000, 0.1, 10.0, 1.0, 1 << 62
# events at one time, and hands a frame goes through: more is a node that never rests
_ROUNDS = 1000
_LAST = {UNIT_HEARTBEAT_ID: 1, MAGNETS_ID: 2}
_CHANGED, _SETTABLE, _ANNOUNCED = 2, ("fixed", "tunable"), ("changing", "countdown")


class Node:
    """An FMU with a CAN port. `received` is what it shall hear, `sent` what it has sent: bytes with their meaning."""

    def __init__(self, fitted: Fitted, folder: Path, watch: Watch) -> None:
        """Load it, extracted into a folder. Raises ConfigError."""
        assert fitted.terminal
        self.name, self.terminal, self._watch = fitted.path.name, fitted.terminal, watch
        self.step_ns = round(fitted.step_s * S_NS)
        self.received = b""
        self.sent: list[tuple[bytes, Operation | None]] = []
        self.discards, self.last_sent = False, 0
        self.next_ns, self.now_ns = _NEVER, 0
        self._eventful = True
        self._interval_ns = round((self.terminal.interval_s or 0.0) * S_NS) or _STEP_NS
        self._fmu = open_fmu(fitted, folder)

    def begin(self) -> None:
        """Initialise it, up to its first event. Raises UnitError."""
        fmu, terminal = self._fmu, self.terminal
        with initialising(self.name), self._watch.over(0.0, self.name, "its initialisation"):
            fmu.instantiate(eventModeUsed=True)
            if terminal.notify is not None:
                with contextlib.ExitStack() as end:
                    if terminal.structural:
                        fmu.enterConfigurationMode()
                        end.callback(fmu.exitConfigurationMode)
                    fmu.setBoolean([terminal.notify], [True])
            fmu.enterInitializationMode(startTime=0.0)
            if terminal.clock in _SETTABLE:
                fmu.setIntervalDecimal(*_array(terminal.tx_clock, self._interval_ns / S_NS))
            fmu.exitInitializationMode()
            if terminal.clock == "calculated":
                self._interval_ns = self._announced()[0]
            if terminal.clock in _ANNOUNCED:
                self._plan(True)
            elif terminal.clock != "triggered":
                self.next_ns = round(terminal.shift_s * S_NS)
            self._iterate()

    @property
    def due(self) -> bool:
        """Whether an event is due now."""
        return bool(self.received) or self._eventful or self.next_ns <= self.now_ns

    def advance(self, now_ns: int) -> None:
        """Let its time go on. Raises UnitError."""
        with self._watch.over(self.now_ns / S_NS, self.name):
            eventful, ends, *_ = self._fmu.doStep(self.now_ns / S_NS, (now_ns - self.now_ns) / S_NS)
        self.now_ns, self._eventful = now_ns, eventful
        self._refuse_end(ends)

    def event(self) -> None:
        """Let it hear and speak. Raises UnitError."""
        with self._watch.over(self.now_ns / S_NS, self.name, "its event"):
            self._fmu.enterEventMode()
            self._iterate()

    def close(self) -> None:
        """Let it end in order, as far as it still can."""
        with contextlib.suppress(Exception):  # its run is over, and what has failed has been told
            self._fmu.terminate()
            self._fmu.freeInstance()

    def _iterate(self) -> None:
        fmu, terminal = self._fmu, self.terminal
        for _ in range(_ROUNDS):
            ticks = self.next_ns <= self.now_ns
            heard, self.received = self.received, b""
            if active := [terminal.rx_clock] * bool(heard) + [terminal.tx_clock] * ticks:
                fmu.setClock(active, [True] * len(active))
            if heard:
                fmu.setBinary([terminal.rx_data], [heard])
            if ticks or (terminal.clock == "triggered" and fmu.getClock([terminal.tx_clock])[0]):
                self.sent += ls_bus.read(fmu.getBinary([terminal.tx_data])[0] or b"")
            again, ends, *_ = fmu.updateDiscreteStates()
            self._refuse_end(ends)
            self._plan(ticks)
            if not again and self.next_ns > self.now_ns:
                self._eventful = False
                fmu.enterStepMode()
                return
        raise UnitError(
            f"{self.name}: its events at {self.now_ns / S_NS:.3f} s do not end: fmi3UpdateDiscreteStates "
            "asks for more, or its Tx_Clock for an interval of 0"
        )

    def _plan(self, ticked: bool) -> None:
        """When its Tx_Clock ticks next."""
        kind = self.terminal.clock
        if kind == "countdown" or (kind == "changing" and ticked):
            interval_ns, changed = self._announced()
            if changed or kind == "changing":
                self.next_ns = self.now_ns + interval_ns
            elif ticked:
                self.next_ns = _NEVER
        elif ticked and kind != "triggered":
            self.next_ns += self._interval_ns

    def _announced(self) -> tuple[int, bool]:
        """The interval that it tells in ns, and whether that is new."""
        references, intervals = _array(self.terminal.tx_clock, 0.0)
        qualifiers = (ctypes.c_int * 1)()
        self._fmu.getIntervalDecimal(references, intervals, qualifiers)
        return round(intervals[0] * S_NS), qualifiers[0] == _CHANGED

    def _refuse_end(self, ends: bool) -> None:
        if ends:
            raise UnitError(f"{self.name} asks to end at {self.now_ns / S_NS:.3f} s")


def _array(
    reference: int, value: float
) -> tuple["ctypes.Array[ctypes.c_uint]", "ctypes.Array[ctypes.c_double]"]:
    return (ctypes.c_uint * 1)(reference), (ctypes.c_double * 1)(value)


class Bridge:
    """The nodes of a unit on a bus of `bitrate` bit/s (0: any). `run` returns when the bus ends or after `stop`."""

    def __init__(
        self, bus: can.BusABC, nodes: list[Node], period_s: float, lockstep: bool, bitrate: int = 0
    ) -> None:
        self._bus, self._nodes, self._lockstep, self._bitrate = bus, nodes, lockstep, bitrate
        self._period_ns = round(period_s * S_NS)
        steps = {one.step_ns for one in nodes if one.step_ns}
        if len(steps) > 1:
            raise UnitError(
                "the FMUs have different steps of their own, "
                f"{', '.join(f'{one / S_NS:g} s' for one in sorted(steps))}: export them with one"
            )
        # where all take any step, the ticks of their clocks come in between
        self._fixed, self._grid_ns = bool(steps), min(steps, default=self._period_ns)
        if (
            not steps
            and any(one.terminal.clock == "triggered" for one in nodes)
            and not self._period_ns % _STEP_NS
        ):
            self._grid_ns = _STEP_NS
        self._now_ns = 0
        self._synced = self._awaiting = self._stopping = False
        # the unit's, by its heartbeat
        self._state = 0
        # what goes to the bus at the end of the cycle
        self._outgoing: list[Frame] = []
        self._due_s = 0.0
        self._told: set[str] = set()

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called. Raises UnitError."""
        try:
            for node in self._nodes:
                node.begin()
            self._boot()
            while not self._stopping:
                self._wait()
        except can.CanError as error:
            log.info("WSP unit: the bus has ended: %s", error)

    def stop(self) -> None:
        """Ask `run` to end; it does within 0.1 s."""
        self._stopping = True

    def _wait(self) -> None:
        rest_s = _QUIET_S if self._lockstep else max(self._due_s - time.monotonic(), 0.0)
        message = self._bus.recv(rest_s)
        if message is not None:
            self._hear(message)
        elif not self._lockstep:
            # no SYNC comes: their time goes on by the clock
            for _ in range(max(round(_QUIET_S * S_NS / self._period_ns), 1)):
                self._cycle()

    def _hear(self, message: can.Message) -> None:
        frame = frame_of(message)
        if message.is_error_frame:
            self._tell_error(bytes(message.data))
        if frame is None:
            return
        plain = not (frame.extended or frame.remote)
        if plain and frame.can_id == SYNC and self._awaiting:
            self._cycle()
        for node in self._nodes:
            node.received += ls_bus.transmit(frame)
        if plain and frame.can_id == SYNC:
            self._synced = self._awaiting = True
        elif plain and frame.can_id == PRESSURES.can_id and self._awaiting:
            self._cycle()
        elif (
            plain
            and frame.can_id == NMT
            and frame.data[1:] in (b"\0", bytes([WSP_NODE]))
            and not self._synced
        ):
            self._go_on(_ANSWER_S, (State.OPERATIONAL,))

    def _go_on(self, most_s: float, wanted: tuple[State, ...]) -> None:
        """Let time go on until the unit's heartbeat tells a state that is wanted."""
        for _ in range(max(round(most_s * S_NS / self._period_ns), 1)):
            if self._state not in wanted:
                self._cycle()

    def _boot(self) -> None:
        """Let time go on until the unit is there. Raises UnitError."""
        self._go_on(_BOOT_S, (State.STOPPED, State.OPERATIONAL, State.PRE_OPERATIONAL))
        if self._state:
            return
        raise UnitError(
            f"{', '.join(one.name for one in self._nodes)}: no heartbeat of the unit "
            f"({UNIT_HEARTBEAT_ID:X}h, state other than 0) within {_BOOT_S:g} s of its time; a unit on "
            "the bus tells its state there, see docs/units.md"
        )

    def _cycle(self) -> None:
        """A period of the SYNC: what has been heard, then steps."""
        self._awaiting, self._due_s = False, time.monotonic() + _QUIET_S
        self._exchange()
        end_ns = self._now_ns + self._period_ns
        while self._now_ns < end_ns:
            begin_ns = self._now_ns
            self._now_ns = begin_ns - begin_ns % self._grid_ns + self._grid_ns
            if not self._fixed:
                self._now_ns = min(self._now_ns, end_ns, *(one.next_ns for one in self._nodes))
            for node in self._nodes:
                node.advance(self._now_ns)
            self._exchange()
        outgoing, self._outgoing = self._outgoing, []
        for frame in sorted(outgoing, key=lambda one: _LAST.get(one.can_id, 0)):
            self._bus.send(message_of(frame))

    def _exchange(self) -> None:
        """All events of this time, and the frames that go round by them. Raises UnitError."""
        for _ in range(_ROUNDS):
            for node in self._nodes:
                if node.due:
                    node.event()
            if not any(node.sent for node in self._nodes):
                return
            self._carry()
        raise UnitError(f"the FMUs answer one another without end at {self._now_ns / S_NS:.3f} s")

    def _carry(self) -> None:
        offered: list[tuple[int, Node, Frame, bytes]] = []
        for node in self._nodes:
            sent, node.sent = node.sent, []
            for raw, one in sent:
                frame = one.frame if one and one.code == Code.TRANSMIT else None
                if frame is not None:
                    offered.append((arbitration_field(frame), node, frame, raw))
                else:
                    self._obey(node, raw, one)
        for field, node, frame, raw in sorted(offered, key=lambda one: one[0]):
            if node.discards and any(
                other is not node and rival < field for rival, other, *_ in offered
            ):
                node.received += ls_bus.build(Code.ARBITRATION_LOST, frame.can_id)
                continue
            self._outgoing.append(frame)
            node.last_sent = frame.can_id
            if frame.can_id == UNIT_HEARTBEAT_ID and frame.data:
                self._state = frame.data[0] & 0x7F
            self._pass_on(node, raw)
            if node.terminal.notify is not None:
                node.received += ls_bus.build(Code.CONFIRM, frame.can_id)

    def _obey(self, node: Node, raw: bytes, one: Operation | None) -> None:
        """What is no frame of classical CAN."""
        if one is None or one.code == Code.TRANSMIT:
            node.received += ls_bus.build(Code.FORMAT_ERROR, len(raw), data=raw)
            self._say(
                f"{node.name} has sent what is no operation of FMI-LS-BUS: {raw[:32].hex(' ')}"
            )
        elif one.code in (Code.FD_TRANSMIT, Code.XL_TRANSMIT):
            self._say(
                f"{node.name} sends frames of CAN FD or XL, which are errors on the rig's bus of classical CAN"
            )
            self._bus_error(node, one.values[0], ls_bus.FORM_ERROR, False)
        elif one.code == Code.CONFIGURATION:
            self._configure(node, one.values[0], one.data)
        elif one.code == Code.STATUS:
            self._say(f"{node.name} is {ls_bus.STATES.get(one.values[0], one.values[0])}")
        elif one.code == Code.WAKEUP:
            self._pass_on(node, raw)
        elif one.code == Code.FORMAT_ERROR:
            self._say(f"{node.name} does not understand the operation {one.data[:32].hex(' ')}")

    def _configure(self, node: Node, parameter: int, data: bytes) -> None:
        value = int.from_bytes(data, "little")
        if parameter == Parameter.ARBITRATION_LOST_BEHAVIOUR:
            node.discards = value == ls_bus.DISCARD
        elif parameter == Parameter.BAUD_RATE and self._bitrate and value != self._bitrate:
            raise UnitError(
                f"{node.name}: sets its CAN controller to {value} bit/s, and the bus of the rig has "
                f"{self._bitrate} bit/s: change the FMU, or set bus.bitrate={value}"
            )

    def _tell_error(self, state: bytes) -> None:
        """An error frame of the bus: content as in Linux can/error.h, and behind it what it has destroyed."""
        by_sender = len(state) > 2 and bool(state[2] & 0x80)
        can_id = int.from_bytes(state[8:12], "little")
        sender = next((one for one in self._nodes if can_id and one.last_sent == can_id), None)
        self._bus_error(
            sender, can_id, ls_bus.BIT_ERROR if by_sender else ls_bus.STUFF_ERROR, not by_sender
        )

    def _bus_error(self, sender: Node | None, can_id: int, code: int, found_outside: bool) -> None:
        for node in self._nodes:
            first = node is sender and not found_outside
            node.received += ls_bus.build(
                Code.BUS_ERROR,
                can_id,
                code,
                ls_bus.PRIMARY if first else ls_bus.SECONDARY,
                node is sender,
            )

    def _pass_on(self, sender: Node, raw: bytes) -> None:
        for node in self._nodes:
            if node is not sender:
                node.received += raw

    def _say(self, text: str) -> None:
        """Into the unit's log, the same only once."""
        if text not in self._told:
            self._told.add(text)
            print(text, flush=True)


def main(
    fitted: list[Fitted],
    bus_address: str,
    priority: int = 0,
    lockstep_s: float = 0.0,
    patience_s: float = 10.0,
    bitrate: int = 0,
) -> int:
    """Run FMUs on a bus until that ends; as `node.main`. Raises ConfigError, BusError, UnitError."""
    print_at_once()
    watch = Watch(patience_s)
    with contextlib.ExitStack() as ending:
        nodes = []
        for one in fitted:
            folder = ending.enter_context(tempfile.TemporaryDirectory(prefix="rollerrig-fmu-"))
            nodes.append(Node(one, Path(folder), watch))
            ending.callback(nodes[-1].close)
        return serving.serve(
            lambda bus: Bridge(bus, nodes, fitted[0].period_s, bool(lockstep_s), bitrate),
            bus_address,
            priority,
            lockstep_s,
            errors=True,
        )
