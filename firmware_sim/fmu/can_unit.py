"""WSP units that are CAN nodes in FMUs, and the bridge that exchanges their frames with the bus of
the rig.

A cycle begins after a SYNC and the pressures of node 17. The FMUs receive what the bus has carried
since the last cycle. Then their time advances by the SYNC period, in their internal steps, by the
interval of their Tx_Clock, or by 1 ms.

A frame that an FMU sends meanwhile is confirmed to the sender and received by the other FMUs. If
several FMUs send at one time, the identifiers decide the order, as in arbitration. At the end of
the cycle all frames go to the bus. Heartbeat and magnets are the last ones, because the bench
continues when it has received them. So a run in lockstep is repeatable.

Before the first SYNC, time advances until the heartbeat of the unit (720h). After an NMT command
to the unit, time advances until the unit is OPERATIONAL, but by a second at most.

Source: FMI 3.0.2, co-simulation with event mode and clocks; FMI-LS-BUS 1.0, importer with
integrated bus simulation.

Limits: a frame is confirmed when it has been handed over to the bus. The bus is classical CAN: any
other frame is answered with a bus error (format). Error frames of the bus of the rig are reported
without an Arbitration Lost, and with the identifier 0 if the bus does not give it.
"""

import contextlib
import ctypes
import logging
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import can

from rollerrig.configs.errors import UnitError
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.fmu import ls_bus
from rollerrig.firmware_sim.fmu.fmu_file import CheckedFmu
from rollerrig.firmware_sim.fmu.fmu_log import FmuLog
from rollerrig.firmware_sim.fmu.ls_bus import Code, Operation, Parameter
from rollerrig.firmware_sim.fmu.signal_unit import (
    Watch,
    flush_every_line,
    initialisation_of,
    open_fmu,
)
from rollerrig.firmware_sim.wsp import node as wsp_node
from rollerrig.wsp_interface.bus.connection_set import NMT, SYNC
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.bus.plugin import frame_of, message_of
from rollerrig.wsp_interface.bus.wire import arbitration_field
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, PRESSURES_ID, UNIT_HEARTBEAT_ID
from rollerrig.wsp_interface.signals import WSP_NODE

log = logging.getLogger(__name__)

_STEP_NS = 1_000_000  # step of an FMU whose Tx_Clock is triggered
_QUIET_S = 0.1  # without a SYNC for so long, time advances by the wall clock
_BOOT_S = 10.0  # time of the FMUs within which the unit must send a heartbeat
_OPERATIONAL_S = 1.0  # time of the FMUs within which it follows an NMT command
_NEVER_NS = 1 << 62
_ROUNDS_MAX = 1000  # of events at one time; a node that needs more never comes to rest

# frames that go to the bus after all others, in this order
_LAST_FRAMES = {UNIT_HEARTBEAT_ID: 1, MAGNETS_ID: 2}
_NMT_STATE_MASK = 0x7F  # in a heartbeat
_ALL_NODES = 0  # in an NMT command
_LOGGED_BYTES = 32  # of an operation that is not understood

# fmi3IntervalQualifier: the interval has changed
_INTERVAL_CHANGED = 2
# variability of the interval of a Tx_Clock: the importer sets it, or the FMU announces it
_SETTABLE = ("fixed", "tunable")
_ANNOUNCED = ("changing", "countdown")

# an error frame has eight bytes as in Linux can/error.h, then the identifier of the destroyed frame
_PROTOCOL_BYTE = 2
_ERROR_IN_TRANSMISSION = 0x80
_DESTROYED_ID = slice(8, 12)


class Interval(NamedTuple):
    """The interval that an FMU announces for its Tx_Clock."""

    ns: int
    changed: bool


class Offer(NamedTuple):
    """A frame that a node wants to send, with the bytes of its operation."""

    arbitration: int
    node: "Node"
    frame: Frame
    raw: bytes


class Node:
    """An FMU with a CAN port.

    `received` is what the FMU will receive at its next event. `sent` is what it has sent: the bytes
    of each operation, and the operation (None if it is corrupt).
    """

    def __init__(self, checked: CheckedFmu, folder: Path, watch: Watch) -> None:
        """Extract the FMU into a folder and load it. Raises ConfigError."""
        assert checked.terminal
        self.name = checked.path.name
        self.terminal = checked.terminal
        self.step_ns = round(checked.step_s * S_NS)  # internal step, 0 for any
        self.received = b""
        self.sent: list[tuple[bytes, Operation | None]] = []
        self.discards = False  # a frame that loses the arbitration is discarded
        self.last_sent = 0  # identifier
        self.next_ns = _NEVER_NS  # when the Tx_Clock ticks next
        self.now_ns = 0
        self._watch = watch
        self._needs_event = True
        self._interval_ns = round((self.terminal.interval_s or 0.0) * S_NS) or _STEP_NS
        self._description = checked.description
        self._fmu = open_fmu(checked, folder)
        self._log = FmuLog()

    def begin(self) -> None:
        """Initialise the FMU, including its first event. Raises UnitError."""
        fmu = self._fmu
        terminal = self.terminal
        with (
            initialisation_of(self.name, self._log),
            self._watch.call(0.0, self.name, "its initialisation", self._log),
        ):
            self._log.instantiate(fmu, self._description, eventModeUsed=True)
            if terminal.notify is not None:
                self._enable_notifications(terminal.notify)
            fmu.enterInitializationMode(startTime=0.0)
            if terminal.clock in _SETTABLE:
                fmu.setIntervalDecimal(*_arrays(terminal.tx_clock, self._interval_ns / S_NS))
            fmu.exitInitializationMode()
            if terminal.clock == "calculated":
                self._interval_ns = self._announced_interval().ns
            if terminal.clock in _ANNOUNCED:
                self._plan_tick(True)
            elif terminal.clock != "triggered":
                self.next_ns = round(terminal.shift_s * S_NS)
            self._iterate()

    def _enable_notifications(self, parameter: int) -> None:
        """Set the parameter with which the FMU waits for confirmations."""
        if self.terminal.structural:
            self._fmu.enterConfigurationMode()
        try:
            self._fmu.setBoolean([parameter], [True])
        finally:
            if self.terminal.structural:
                self._fmu.exitConfigurationMode()

    @property
    def due(self) -> bool:
        """Whether an event is due now."""
        return bool(self.received) or self._needs_event or self.next_ns <= self.now_ns

    def advance(self, now_ns: int) -> None:
        """Advance the time of the FMU. Raises UnitError."""
        begin_s = self.now_ns / S_NS
        with self._watch.call(begin_s, self.name, log=self._log):
            needs_event, terminates, *_ = self._fmu.doStep(begin_s, (now_ns - self.now_ns) / S_NS)
        self.now_ns = now_ns
        self._needs_event = needs_event
        self._refuse_termination(terminates)

    def event(self) -> None:
        """Let the FMU receive and send. Raises UnitError."""
        with self._watch.call(self.now_ns / S_NS, self.name, "its event", self._log):
            self._fmu.enterEventMode()
            self._iterate()

    def close(self) -> None:
        """Terminate the FMU as far as possible."""
        # the run is over, and a failure has been reported already
        with contextlib.suppress(Exception):
            self._fmu.terminate()
            self._fmu.freeInstance()

    def _iterate(self) -> None:
        """Update the discrete states until the event is complete. Raises UnitError."""
        fmu = self._fmu
        terminal = self.terminal
        for _ in range(_ROUNDS_MAX):
            ticks = self.next_ns <= self.now_ns
            received = self.received
            self.received = b""

            active_clocks = []
            if received:
                active_clocks.append(terminal.rx_clock)
            if ticks:
                active_clocks.append(terminal.tx_clock)
            if active_clocks:
                fmu.setClock(active_clocks, [True] * len(active_clocks))
            if received:
                fmu.setBinary([terminal.rx_data], [received])

            if ticks or (terminal.clock == "triggered" and fmu.getClock([terminal.tx_clock])[0]):
                self.sent += ls_bus.read(fmu.getBinary([terminal.tx_data])[0] or b"")

            needs_update, terminates, *_ = fmu.updateDiscreteStates()
            self._refuse_termination(terminates)
            self._plan_tick(ticks)
            if not needs_update and self.next_ns > self.now_ns:
                self._needs_event = False
                fmu.enterStepMode()
                return
        raise UnitError(
            f"{self.name}: the events at {self.now_ns / S_NS:.3f} s never end: "
            "fmi3UpdateDiscreteStates requests further updates, or the interval of Tx_Clock is 0"
        )

    def _plan_tick(self, ticked: bool) -> None:
        """Plan the next tick of the Tx_Clock."""
        clock = self.terminal.clock
        if clock == "triggered":
            return
        if clock == "countdown":
            interval = self._announced_interval()
            if interval.changed:
                self.next_ns = self.now_ns + interval.ns
            elif ticked:
                self.next_ns = _NEVER_NS
        elif clock == "changing":
            if ticked:
                self.next_ns = self.now_ns + self._announced_interval().ns
        elif ticked:
            self.next_ns += self._interval_ns

    def _announced_interval(self) -> Interval:
        references, intervals_s = _arrays(self.terminal.tx_clock, 0.0)
        qualifiers = (ctypes.c_int * 1)()
        self._fmu.getIntervalDecimal(references, intervals_s, qualifiers)
        return Interval(round(intervals_s[0] * S_NS), qualifiers[0] == _INTERVAL_CHANGED)

    def _refuse_termination(self, terminates: bool) -> None:
        if terminates:
            raise UnitError(
                f"{self.name} requests the end of the simulation at {self.now_ns / S_NS:.3f} s"
            )


def _arrays(
    reference: int, value: float
) -> tuple["ctypes.Array[ctypes.c_uint]", "ctypes.Array[ctypes.c_double]"]:
    """Return a reference and a value as C arrays with one item each."""
    return (ctypes.c_uint * 1)(reference), (ctypes.c_double * 1)(value)


class Bridge:
    """The nodes of a unit on a bus of `bitrate` bit/s (0: any). It is a `node.Serving`.

    `period_s`: SYNC period. `run` returns when the bus ends or after `stop`.
    """

    def __init__(
        self, bus: can.BusABC, nodes: list[Node], period_s: float, lockstep: bool, bitrate: int = 0
    ) -> None:
        """Connect the nodes. Raises UnitError if their internal steps differ."""
        self._bus = bus
        self._nodes = nodes
        self._lockstep = lockstep
        self._bitrate = bitrate
        self._period_ns = round(period_s * S_NS)
        self._plan_steps()
        self._now_ns = 0
        self._synced = False  # a SYNC has been received
        self._awaiting = False  # the cycle of the last SYNC has not been run
        self._stopping = False
        self._state = 0  # NMT state of the unit, from its heartbeat
        self._outgoing: list[Frame] = []  # for the bus, at the end of the cycle
        self._due_s = 0.0  # when a cycle is due without a SYNC
        self._logged: set[str] = set()

    def _plan_steps(self) -> None:
        """Choose the grid of time on which all nodes step. Raises UnitError."""
        steps_ns = {node.step_ns for node in self._nodes if node.step_ns}
        if len(steps_ns) > 1:
            steps = ", ".join(f"{step_ns / S_NS:g} s" for step_ns in sorted(steps_ns))
            raise UnitError(
                f"the FMUs have different internal steps: {steps}; export them with the same step"
            )
        self._fixed_steps = bool(steps_ns)
        self._grid_ns = min(steps_ns, default=self._period_ns)
        triggered = any(node.terminal.clock == "triggered" for node in self._nodes)
        if not self._fixed_steps and triggered and self._period_ns % _STEP_NS == 0:
            self._grid_ns = _STEP_NS

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
        """Request `run` to end; it does so within 0.1 s."""
        self._stopping = True

    # -- time

    def _boot(self) -> None:
        """Advance time until the unit sends its heartbeat. Raises UnitError."""
        self._advance_until((State.STOPPED, State.OPERATIONAL, State.PRE_OPERATIONAL), _BOOT_S)
        if self._state:
            return
        names = ", ".join(node.name for node in self._nodes)
        raise UnitError(
            f"{names}: there is no heartbeat of the unit ({UNIT_HEARTBEAT_ID:X}h with a state other "
            f"than 0) within {_BOOT_S:g} s of its time; a unit on the bus must send its state there, "
            "see docs/units.md"
        )

    def _advance_until(self, states: tuple[State, ...], most_s: float) -> None:
        """Advance time until the heartbeat of the unit has one of these states."""
        cycles = max(round(most_s * S_NS / self._period_ns), 1)
        for _ in range(cycles):
            if self._state in states:
                return
            self._cycle()

    def _wait(self) -> None:
        """Handle the next frame of the bus, or what is due without one."""
        rest_s = _QUIET_S if self._lockstep else max(self._due_s - time.monotonic(), 0.0)
        message = self._bus.recv(rest_s)
        if message is not None:
            self._on_message(message)
        elif not self._lockstep:
            # there is no SYNC, so time advances by the wall clock
            for _ in range(max(round(_QUIET_S * S_NS / self._period_ns), 1)):
                self._cycle()

    def _cycle(self) -> None:
        """Deliver what has been received, step by a SYNC period, and send to the bus."""
        self._awaiting = False
        self._due_s = time.monotonic() + _QUIET_S
        self._exchange()
        end_ns = self._now_ns + self._period_ns
        while self._now_ns < end_ns:
            self._now_ns = self._next_time_ns(end_ns)
            for node in self._nodes:
                node.advance(self._now_ns)
            self._exchange()

        outgoing = sorted(self._outgoing, key=lambda frame: _LAST_FRAMES.get(frame.can_id, 0))
        self._outgoing = []
        for frame in outgoing:
            self._bus.send(message_of(frame))

    def _next_time_ns(self, end_ns: int) -> int:
        """Return the end of the next step: a point of the grid, or a tick of a clock before it."""
        time_ns = self._now_ns - self._now_ns % self._grid_ns + self._grid_ns
        if self._fixed_steps:
            return time_ns
        return min(time_ns, end_ns, *(node.next_ns for node in self._nodes))

    # -- from the bus to the nodes

    def _on_message(self, message: can.Message) -> None:
        if message.is_error_frame:
            self._on_error_frame(bytes(message.data))
        frame = frame_of(message)
        if frame is None:
            return
        can_id = None if frame.extended or frame.remote else frame.can_id

        # the last SYNC had no pressures behind it
        if can_id == SYNC and self._awaiting:
            self._cycle()

        for node in self._nodes:
            node.received += ls_bus.transmit(frame)

        if can_id == SYNC:
            self._synced = True
            self._awaiting = True
        elif can_id == PRESSURES_ID and self._awaiting:
            self._cycle()
        elif can_id == NMT and not self._synced:
            addressed = frame.data[1:] in (bytes([_ALL_NODES]), bytes([WSP_NODE]))
            if addressed:
                self._advance_until((State.OPERATIONAL,), _OPERATIONAL_S)

    def _on_error_frame(self, content: bytes) -> None:
        """Report an error frame of the bus to the nodes."""
        by_sender = len(content) > _PROTOCOL_BYTE and bool(
            content[_PROTOCOL_BYTE] & _ERROR_IN_TRANSMISSION
        )
        can_id = int.from_bytes(content[_DESTROYED_ID], "little")
        sender = None
        for node in self._nodes:
            if can_id and node.last_sent == can_id:
                sender = node
                break
        error = ls_bus.BIT_ERROR if by_sender else ls_bus.STUFF_ERROR
        self._report_bus_error(sender, can_id, error, not by_sender)

    def _report_bus_error(
        self, sender: Node | None, can_id: int, error: int, found_outside: bool
    ) -> None:
        """Report a bus error to all nodes.

        `found_outside`: another device than the sender found it.
        """
        for node in self._nodes:
            is_sender = node is sender
            is_first = is_sender and not found_outside
            rank = ls_bus.PRIMARY if is_first else ls_bus.SECONDARY
            node.received += ls_bus.build(Code.BUS_ERROR, can_id, error, rank, is_sender)

    # -- from the nodes to one another and to the bus

    def _exchange(self) -> None:
        """Run all events of this time, and deliver the frames that they send. Raises UnitError."""
        for _ in range(_ROUNDS_MAX):
            for node in self._nodes:
                if node.due:
                    node.event()
            if not any(node.sent for node in self._nodes):
                return
            self._deliver()
        raise UnitError(f"the FMUs answer each other without end at {self._now_ns / S_NS:.3f} s")

    def _deliver(self) -> None:
        """Deliver what the nodes have sent: frames in the order of arbitration, other operations
        first.
        """
        offers: list[Offer] = []
        for node in self._nodes:
            sent = node.sent
            node.sent = []
            for raw, operation in sent:
                frame = None
                if operation and operation.code == Code.TRANSMIT:
                    frame = operation.frame
                if frame is None:
                    self._execute(node, raw, operation)
                else:
                    offers.append(Offer(arbitration_field(frame), node, frame, raw))

        for offer in sorted(offers, key=lambda offer: offer.arbitration):
            if offer.node.discards and _loses(offer, offers):
                offer.node.received += ls_bus.build(Code.ARBITRATION_LOST, offer.frame.can_id)
            else:
                self._transmit(offer.node, offer.frame, offer.raw)

    def _transmit(self, node: Node, frame: Frame, raw: bytes) -> None:
        """Send a frame of a node to the other nodes and to the bus, and confirm it."""
        self._outgoing.append(frame)
        node.last_sent = frame.can_id
        if frame.can_id == UNIT_HEARTBEAT_ID and frame.data:
            self._state = frame.data[0] & _NMT_STATE_MASK
        self._send_to_others(node, raw)
        if node.terminal.notify is not None:
            node.received += ls_bus.build(Code.CONFIRM, frame.can_id)

    def _send_to_others(self, sender: Node, raw: bytes) -> None:
        for node in self._nodes:
            if node is not sender:
                node.received += raw

    def _execute(self, node: Node, raw: bytes, operation: Operation | None) -> None:
        """Execute an operation that is not a frame of classical CAN. Raises UnitError."""
        if operation is None or operation.code == Code.TRANSMIT:
            node.received += ls_bus.build(Code.FORMAT_ERROR, len(raw), data=raw)
            self._log_once(
                f"{node.name} has sent bytes that are not an operation of FMI-LS-BUS: "
                f"{raw[:_LOGGED_BYTES].hex(' ')}"
            )
        elif operation.code in (Code.FD_TRANSMIT, Code.XL_TRANSMIT):
            self._log_once(
                f"{node.name} sends frames of CAN FD or XL, which are errors on the bus of the rig "
                "(classical CAN)"
            )
            self._report_bus_error(node, operation.values[0], ls_bus.FORM_ERROR, False)
        elif operation.code == Code.CONFIGURATION:
            self._configure(node, operation.values[0], operation.data)
        elif operation.code == Code.STATUS:
            state = operation.values[0]
            self._log_once(f"{node.name} is {ls_bus.STATES.get(state, state)}")
        elif operation.code == Code.WAKEUP:
            self._send_to_others(node, raw)
        elif operation.code == Code.FORMAT_ERROR:
            self._log_once(
                f"{node.name} does not understand the operation "
                f"{operation.data[:_LOGGED_BYTES].hex(' ')}"
            )

    def _configure(self, node: Node, parameter: int, data: bytes) -> None:
        """Set a parameter of a CAN controller. Raises UnitError for another bit rate."""
        value = int.from_bytes(data, "little")
        if parameter == Parameter.ARBITRATION_LOST_BEHAVIOUR:
            node.discards = value == ls_bus.DISCARD
        elif parameter == Parameter.BAUD_RATE and self._bitrate and value != self._bitrate:
            raise UnitError(
                f"{node.name} sets its CAN controller to {value} bit/s, and the bus of the rig has "
                f"{self._bitrate} bit/s; change the FMU, or set bus.bitrate={value}"
            )

    def _log_once(self, text: str) -> None:
        """Print a text into the log of the unit, but each text only once."""
        if text not in self._logged:
            self._logged.add(text)
            print(text, flush=True)


def _loses(offer: Offer, offers: list[Offer]) -> bool:
    """Return whether a frame loses the arbitration to the frame of another node."""
    rivals = [rival for rival in offers if rival.node is not offer.node]
    return any(rival.arbitration < offer.arbitration for rival in rivals)


def main(
    checked: list[CheckedFmu],
    bus_address: str,
    priority: int = 0,
    lockstep_s: float = 0.0,
    patience_s: float = 10.0,
    bitrate: int = 0,
) -> int:
    """Run FMUs on a bus until the bus ends, as `node.main`. Returns 0.

    Raises ConfigError, BusError, UnitError.
    """
    flush_every_line()
    watch = Watch(patience_s)
    with contextlib.ExitStack() as cleanup:
        nodes = []
        for fmu in checked:
            folder = cleanup.enter_context(tempfile.TemporaryDirectory(prefix="rollerrig-fmu-"))
            node = Node(fmu, Path(folder), watch)
            nodes.append(node)
            cleanup.callback(node.close)
        period_s = checked[0].period_s
        return wsp_node.serve(
            lambda bus: Bridge(bus, nodes, period_s, bool(lockstep_s), bitrate),
            bus_address,
            priority,
            lockstep_s,
            errors=True,
        )
