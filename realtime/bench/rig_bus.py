"""The rig on its bus: hub or kernel CAN, the nodes, the NMT master, and the answers of the unit.

The nodes read a live row of all signals and write a small row of commands. This file connects them
to the bus and gives the bench two calls: `sync` (a SYNC is due) and `poll` (time has passed). It
also keeps count of the answers that the WSP unit owes.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import BusError, PortInUseError
from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.firmware_sim import (
    bench_node,
    encoder406,
    identifiers,
    io401,
    sander401,
    traction401,
)
from rollerrig.firmware_sim.cia301.host import NEVER
from rollerrig.firmware_sim.cia301.nmt import Command
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.drive402 import drive
from rollerrig.firmware_sim.faults.bus import Gate
from rollerrig.firmware_sim.faults.confinement import Controllers
from rollerrig.firmware_sim.faults.panel import Site
from rollerrig.firmware_sim.nmt_master import NmtMaster
from rollerrig.firmware_sim.rack import Rack
from rollerrig.firmware_sim.unit_answers import silent_after_syncs
from rollerrig.realtime.bench.scenario import AUTOMATIC_PORT, Scenario
from rollerrig.realtime.bench.unit_identity import Identities
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick
from rollerrig.wsp_interface import events, frame_forms, signals
from rollerrig.wsp_interface.bus import buses, kernel, plugin
from rollerrig.wsp_interface.bus.client import Client
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.connection_set import (
    EMERGENCY,
    HEARTBEAT,
    NMT,
    NODE_MASK,
    SDO_REPLY,
    SDO_REQUEST,
    SYNC,
    TPDO,
)
from rollerrig.wsp_interface.bus.frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Frame
from rollerrig.wsp_interface.bus.hub import Hub, Port
from rollerrig.wsp_interface.bus.turns import Carry, Partner
from rollerrig.wsp_interface.bus.wire import Alarm
from rollerrig.wsp_interface.events import Code, OnEvent
from rollerrig.wsp_interface.rig_objects import (
    HARNESS_ANSWER_ID,
    UnitFrames,
    unit_frames,
    unit_lost_after_ms,
)

HUB = "hub"  # the interface in [bus] that is the bench's own hub
KERNEL_CHANNEL = "vcan0"
# how long to listen for foreign nodes: longer than the heartbeat time of any bench, 100 ms
_LISTEN_S = 0.25
_VEHICLE_SPEED = signals.column("vehicle_speed")
# what a harness sends to node 127: its answers, and requests by SDO
_OF_HARNESS = (HARNESS_ANSWER_ID, SDO_REQUEST + signals.BENCH_NODE)
# of an SDO: object 6200h:1 as its bytes 1 to 3, and the command in its byte 0 (CiA 301)
_MAGNETS_OBJECT = b"\x00\x62\x01"
_INITIATE_DOWNLOAD = 1
# bytes of an NMT command, and the commands after which a node does not do its work
_NMT_BYTES = 2
_STOPPING = frozenset(Command) - {Command.START}
# identifiers in a message
_MOST_HEARD = 8
_SENT_BY_NODES = (EMERGENCY, *TPDO, SDO_REPLY, HEARTBEAT)


def interface(scenario: Scenario) -> str:
    """Return what [bus] interface means here: `hub`, or the address of another bus.

    With `auto` it is kernel CAN where it is up, else the hub.
    """
    given = scenario["bus"]["interface"]
    if given != "auto":
        return str(given)
    if KERNEL_CHANNEL in kernel.available().up:
        return f"socketcan:{KERNEL_CHANNEL}"
    return HUB


async def open_bus(
    scenario: Scenario,
    clock_ns: Callable[[], int],
    on_lost: Callable[[BusError], None],
    on_event: OnEvent,
    wall: bool,
    awaits_others: bool,
) -> tuple[Hub, str]:
    """Return the bus of a scenario, and the address at which others reach it. Raises BusError.

    `wall`: clock_ns runs as the wall clock does. `awaits_others`: as in `_listen`.
    """
    place = interface(scenario)
    bitrate = scenario["bus"]["bitrate"]
    if place == HUB:
        hub = Hub(clock_ns, bitrate, signals.BUS_CHANNEL, on_event=on_event)
        port = await _listen(hub, "socketcand", scenario, on_event, awaits_others)
        return hub, _hub_address(scenario, port)
    if not place.startswith("socketcand:"):
        hub = await buses.open_hub(place, clock_ns, bitrate, on_lost, on_event, wall)
        await _refuse_foreign_nodes(hub, place, scenario.table)
        return hub, place
    host, port, name = plugin.parse_address(place)
    hub = Hub(clock_ns, bitrate, name, on_event=on_event)
    port = await hub.listen("socketcand", host, port)
    return hub, f"socketcand://{host}:{port}/{name}"


def _hub_address(scenario: Scenario, port: int) -> str:
    return f"socketcand://{scenario['bus']['host']}:{port}/{signals.BUS_CHANNEL}"


async def _listen(
    hub: Hub, protocol: str, scenario: Scenario, on_event: OnEvent, awaits_others: bool
) -> int:
    """Listen for a protocol on its port in [bus] and return the port. Raises BusError.

    Where nobody has chosen a port, it is the usual one. If another program has the usual port, the
    bench takes a free one and reports it. With `awaits_others`, the run waits for an outside
    program. That looks for the bench on the usual port, and would join another bench there, so a
    usual port in use is then an error.
    """
    bus = scenario["bus"]
    host = bus["host"]
    key = f"{protocol}_port"
    chosen = bus[key]
    if chosen != AUTOMATIC_PORT:
        return await hub.listen(protocol, host, chosen, f"bus.{key}")
    try:
        return await hub.listen(protocol, host, None, f"bus.{key}")
    except PortInUseError:
        if awaits_others:
            raise
    port = await hub.listen(protocol, host, 0)
    usual_port = CODECS[protocol].port
    on_event(Code.BUS_PORT_IN_USE, port=usual_port, address=_hub_address(scenario, port))
    return port


async def _refuse_foreign_nodes(hub: Hub, place: str, table: signals.Table) -> None:
    """Listen before the rig sends. Raises BusError when a node has a number of the rig."""
    heard: set[int] = set()

    def hear(frame: Frame) -> None:
        if not frame.extended:
            heard.add(frame.can_id)

    port = hub.attach(hear, "listener")
    await asyncio.sleep(_LISTEN_S)
    port.close()
    for can_id in sorted(heard):
        node = can_id & NODE_MASK
        if can_id & ~NODE_MASK in _SENT_BY_NODES and node in table.rig_nodes:
            await hub.close()
            raise BusError(
                f"bus {place}: a node {node} sends there already ({can_id:X}h), and the rig has a "
                "node with this number: stop the other one, or use another bus "
                "(--set bus.interface=hub)"
            )


async def open_others(
    hub: Hub, place: str, scenario: Scenario, on_event: OnEvent, awaits_others: bool
) -> dict[str, int]:
    """Listen for the other protocols that have a port in [bus]; return the ports by protocol.

    On a bus of the kernel that includes socketcand. `awaits_others`: as in `_listen`. Raises
    BusError for a port that cannot be used.
    """
    ports: dict[str, int] = {}
    for protocol in CODECS:
        if protocol == "socketcand":
            is_required = not place.startswith("socketcand:")
        else:
            is_required = scenario["bus"][f"{protocol}_port"] >= 0
        if is_required:
            ports[protocol] = await _listen(hub, protocol, scenario, on_event, awaits_others)
    return ports


class UnitSeat:
    """The WSP unit of a group of axles, and the SYNCs that it still has to answer.

    A frozen unit answers all of them when it continues. `awaited` is the frame that starts its
    cycle. `has_commanded`: before the end of the stop it has sent a command of the valves that the
    rig does not refuse.
    """

    def __init__(self, frames: UnitFrames) -> None:
        self.frames = frames
        self.partner = Partner(arbitrates=True)
        self.awaited = frames.speeds
        self.owed = 0
        self.may_wait = 0
        self.has_commanded = False
        # the connection that has sent the last command of the valves
        self._commander: Client | None = None
        # a fault has stopped its process
        self.frozen = False

    def look(self) -> None:
        """Note whether the unit has answered."""
        if self.owed <= self.may_wait:
            self.partner.answered.set()
        else:
            self.partner.answered.clear()

    def forgive(self) -> None:
        """No longer wait for the answers that are owed."""
        self.owed = 0
        self.partner.answered.set()

    def note(self, frame: Frame, sender: Client) -> None:
        """Note a connection of the unit; the one that sends the magnets has to answer."""
        unit = self.partner
        unit.members.add(sender)
        sends_magnets = frame.can_id == self.frames.magnets_id
        if sends_magnets or unit.speaker is None or unit.gone:
            unit.speaker = sender
        if sends_magnets:
            self._commander = sender

    def is_commanded_by_another(self, frame: Frame, sender: Client) -> bool:
        """Return whether a frame commands the valves, and another program that runs does so too."""
        commander = self._commander
        sends_magnets = frame.can_id == self.frames.magnets_id
        if not sends_magnets or commander is None or commander is sender:
            return False
        return not commander.lost.done()


class RigBus:
    """The nodes of the rig, the NMT master and the bench's node on one bus.

    `row` is the live row of all signals. `command` (tick.COMMANDS,) float64 is what the bus
    requires of the rig; `on_command(command)` is called when it has changed, `refresh(row)` before
    an alarm goes off. `train_deceleration_m_s2` as for `encoder406.build`.
    """

    def __init__(
        self,
        hub: Hub,
        scenario: Scenario,
        row: np.ndarray,
        on_command: Callable[[np.ndarray], None],
        on_event: OnEvent,
        clock_ns: Callable[[], int],
        pacing: str = "wall",
        refresh: Callable[[np.ndarray], Any] = lambda row: None,
        train_deceleration_m_s2: np.ndarray | None = None,
    ) -> None:
        bus = scenario["bus"]
        table = scenario.table
        self.table = table
        self.hub = hub
        self.row = row
        self.clock_ns = clock_ns
        self._refresh = lambda: refresh(row)
        self._on_event = on_event
        self._produces_sync = bus["master"]
        self._arbitration = bus["arbitration"]
        self.command = tick.first_command()
        # no command is passed on before all nodes have started
        self._on_command: Callable[[np.ndarray], None] = lambda command: None

        # the units, that of the leading group first
        groups = range(table.kind.groups)
        self.seats = tuple(UnitSeat(unit_frames(table, group)) for group in groups)
        self._seats_by_id: dict[int, UnitSeat] = {}
        # by the identifier of an SDO request to the node with the magnets of the group
        self._seats_by_sdo: dict[int, UnitSeat] = {}
        for seat in self.seats:
            self._seats_by_id[seat.frames.magnets_id] = seat
            self._seats_by_id[seat.frames.heartbeat_id] = seat
            brake_node = signals.in_group(signals.BRAKE_NODE, seat.frames.group)
            self._seats_by_sdo[SDO_REQUEST + brake_node] = seat
        # units, and the nodes with their speeds and magnets; 0 addresses all nodes
        self._nodes_of_units = {
            0,
            *table.wsp_nodes,
            *table.nodes(signals.SPEED_NODE),
            *table.nodes(signals.BRAKE_NODE),
        }
        # whether another program has set magnets, or stopped a node of them, during the stop
        self.others_act = False
        self.harness_partner = Partner(arbitrates=False)
        # the last refusal of each identifier of a frame from outside, and what has been reported
        self._refusals: dict[int, frame_forms.Refusal] = {}
        self._reported: set[tuple[Code, int]] = set()
        # identifiers of process data and heartbeats from outside, as text
        self._heard: dict[str, None] = {}
        self._turns_taken_by: tuple[Partner, ...] = ()
        # whether the run has a WSP unit at all
        self.has_unit = True
        # the units of the bench answer every SYNC, also foreign ones; if the frame that starts the
        # cycle of a unit is missing, it answers at the next SYNC
        self.own_unit = False
        # whether the vehicle stands after it has rolled
        self._has_rolled = False
        self._has_stopped = False
        # SYNCs of another node, although the bench is the producer
        self.stray_syncs = 0
        self._stray = False

        # goes off at `_armed_ns`, perhaps earlier than is needed
        self._alarm: Alarm | None = None
        self._armed_ns = NEVER

        self.master = _build_master(scenario, pacing)
        self.nodes = _build_nodes(scenario, row, self.command, self.post, train_deceleration_m_s2)
        self._numbers = {id(node): number for number, node in self.nodes.items()}
        friction = self.command[tick.FRICTION : tick.SAND]
        self.bench_node = bench_node.build(table, row, friction, self.post, pacing)
        self.harness: bench_node.BenchNode = self.bench_node.device

        self.rack = Rack()
        # the master first: it must receive the boot-up of the others
        members: tuple[Any, ...] = (self.master, *self.nodes.values(), self.bench_node)
        for member in members:
            member.on_event = on_event
            member.clock_ns = clock_ns
            self.rack.add(member)
        self._port = hub.attach(self._from_bus, "rig")
        self.identities = Identities(self._port.send)
        self.gate = Gate(Controllers(hub.destroy))
        hub.order = self._order
        self.rack.start(self._port.send, clock_ns())
        hub.attach(self._listen, "bench")
        self._on_command = on_command

    def post(self) -> None:
        """Pass on what the bus requires of the rig."""
        speeds_m_s = self.master.reference_speeds_m_s
        self.command[tick.REFERENCE : tick.REFERENCE + len(speeds_m_s)] = speeds_m_s
        self._on_command(self.command)

    def start_wire(self, timed: bool) -> None:
        """Let frames wait for the wire from now on, where [bus] says so.

        `timed` as in `Hub.arbitrate`.
        """
        if self._arbitration and self.hub.wire is None:
            self.hub.arbitrate(timed)
            self.rack.deferred = self._port.send

    def _from_bus(self, frame: Frame) -> None:
        """Handle a frame of another member of the bus; frames of the rig do not come here."""
        self._stray = self._produces_sync and _is_sync(frame)
        if self._stray:
            self.stray_syncs += 1
            if self.stray_syncs == 1:
                self._on_event(Code.SYNC_FOREIGN)
        self.rack.advance_clock(frame.time_ns)
        self.rack.on_frame(frame)
        self.identities.hear(frame)
        self._set_alarm()

    # -- answers of the unit and the harness

    def _listen(self, frame: Frame) -> None:
        """Count the SYNCs that the unit has to answer."""
        if _is_sync(frame):
            stray = self._stray
            self._stray = False
            if stray and not self.own_unit:
                return
            for seat in self.seats:
                seat.owed += 1
                seat.may_wait = int(self.own_unit)
                seat.look()
            return
        for seat in self.seats:
            awaited = seat.awaited
            if frame.can_id == awaited.can_id and len(frame.data) == awaited.struct.size:
                seat.may_wait = 0
                seat.look()

    def await_pressures(self) -> None:
        """From now on the pressures start the cycle of a unit, as with FMUs."""
        for seat in self.seats:
            seat.awaited = seat.frames.pressures

    def take_turns(self, unit_answers: bool) -> None:
        """From now on units and harness send in turns; the bench gives each its turn.

        `unit_answers`: whether the bench waits for units.
        """
        self._turns_taken_by = (self.harness_partner,)
        if unit_answers:
            self._turns_taken_by = (*(seat.partner for seat in self.seats), self.harness_partner)

    def stop_waiting(self) -> None:
        """Let the code that waits for an answer continue, because the run ends."""
        for seat in self.seats:
            seat.partner.answered.set()
        self.harness_partner.answered.set()

    def seat_harness(self) -> None:
        """The sender of the present frame is the harness, which has joined."""
        sender = self.hub.carries_from
        if isinstance(sender, Client):
            self.harness_partner.members = {sender}
            self.harness_partner.speaker = sender

    def dismiss_harness(self) -> None:
        """The harness has left; nothing waits for it any more."""
        self.harness_partner.answered.set()
        self.harness_partner.leave()

    def _order(self, sender: Port | Client, frame: Frame, carry: Carry) -> bool:
        """Count answers, and let the frames of unit and harness wait for their turns."""
        if sender is self._port:
            return True
        self._note_heard(frame)
        refused = self._refuse(frame)
        if self.has_unit and not refused and not self._has_stopped:
            self._look_at_magnets(frame, sender)
            self._look_at_nmt(frame)
        answers = not refused and self._count_answer(frame)
        if not isinstance(sender, Client):
            return True
        seat = self._seats_by_id.get(frame.can_id)
        if seat is not None and not refused:
            if self.has_unit and seat.is_commanded_by_another(frame, sender):
                fields = {"node": seat.frames.node, "can_id": frame.can_id}
                self._report_once(Code.UNIT_TWO_SENDERS, frame.can_id, fields)
            seat.note(frame, sender)
        partners = [one for one in self._turns_taken_by if sender in one.members]
        if len(partners) != 1:
            # not a partner, or a program that is unit and harness: its frames have an order
            return True
        partners[0].take(frame, carry, answers)
        return False

    def _count_answer(self, frame: Frame) -> bool:
        """Count an answer when it is sent, even if the bus carries it later or a fault loses it.

        Return whether the frame is an answer that was owed.
        """
        seat = self._seats_by_id.get(frame.can_id)
        if seat is not None and frame.can_id == seat.frames.magnets_id:
            if not self._has_stopped:
                seat.has_commanded = True
            if seat.owed:
                seat.owed -= 1
                seat.look()
                return True
        harness = self.harness_partner
        if frame.can_id == HARNESS_ANSWER_ID and not harness.answered.is_set():
            harness.answered.set()
            return True
        return False

    # -- what the rig refuses

    def _refuse(self, frame: Frame) -> bool:
        """Return whether the rig refuses a frame because of its form; report the first such one."""
        refusal = frame_forms.refusal(frame, self.table, self.rack.hears)
        if refusal is None:
            return False
        self._refusals[frame.can_id] = refusal
        self._report_once(refusal.code, frame.can_id, refusal.fields)
        return True

    def _report_once(self, code: Code, about: int, fields: Mapping[str, int]) -> None:
        """Record an event about an identifier or a node once in a run."""
        if (code, about) not in self._reported:
            self._reported.add((code, about))
            self._on_event(code, **fields)

    def _look_at_magnets(self, frame: Frame, sender: Port | Client) -> None:
        """Note who sets magnets by SDO during the stop: the unit, or another program."""
        seat = self._seats_by_sdo.get(frame.can_id)
        is_command = seat is not None and frame.data[1:4] == _MAGNETS_OBJECT
        is_download = is_command and frame.data[0] >> 5 == _INITIATE_DOWNLOAD
        if seat is None or not is_download:
            return
        # on a CAN interface of the kernel nobody knows which program has sent a frame
        is_unit = sender in seat.partner.members or not isinstance(sender, Client)
        if is_unit:
            seat.has_commanded = True
            return
        self.others_act = True
        node = frame.can_id - SDO_REQUEST
        self._report_once(Code.MAGNETS_FOREIGN, node, {"node": node})

    def _look_at_nmt(self, frame: Frame) -> None:
        """Note a command of another program that stops a unit, or a node that a unit needs."""
        if frame.can_id != NMT or len(frame.data) != _NMT_BYTES or not self._has_rolled:
            return
        command, node = frame.data
        if command in _STOPPING and node in self._nodes_of_units:
            self.others_act = True
            self._report_once(Code.NMT_FOREIGN, node, {"node": node, "command": command})

    def _note_heard(self, frame: Frame) -> None:
        """Note which process data and heartbeats come from outside, for messages."""
        if frame.can_id in _OF_HARNESS or len(self._heard) >= _MOST_HEARD:
            return
        digits = 8 if frame.extended else 3
        self._heard[f"{frame.can_id:0{digits}X}h"] = None

    def what_came_instead(self, can_ids: Iterable[int]) -> str:
        """Return what has come in place of awaited frames, as the middle of a message.

        It is the refusal of one of these frames, or else the identifiers that programs have sent.
        """
        for can_id in can_ids:
            refusal = self._refusals.get(can_id)
            if refusal is not None:
                return events.text(refusal.code, refusal.fields)
        if not self._heard:
            return "no program has sent anything"
        return f"programs have sent {', '.join(self._heard)}"

    def report_uncommanded(self) -> None:
        """Record an event for each unit that has given no valid command of the valves."""
        for seat in self.seats:
            if not seat.has_commanded:
                frames = seat.frames
                fields = {"node": frames.node, "can_id": frames.magnets_id}
                self._report_once(Code.UNIT_NO_COMMAND, frames.magnets_id, fields)

    def _look_at_answers(self) -> None:
        for seat in self.seats:
            seat.look()

    @property
    def late(self) -> bool:
        """Whether a unit of the bench still has to answer: a fault or a wire may delay speeds."""
        if not self.own_unit:
            return False
        return not all(seat.frozen or seat.partner.answered.is_set() for seat in self.seats)

    def forgive(self) -> None:
        """No longer wait for the answers that are owed."""
        for seat in self.seats:
            seat.forgive()

    # -- faults

    def site(self, freeze: Callable[[bool, frozenset[int]], bool]) -> Site:
        """Return what faults act on.

        `freeze(on, groups)` stops the processes of the WSP units of some groups, if there are any.
        """

        def freeze_units(on: bool, groups: frozenset[int]) -> bool:
            frozen = freeze(on, groups) and on
            for seat in self.seats:
                if seat.frames.group in groups:
                    seat.frozen = frozen
                    if frozen:
                        seat.partner.answered.set()  # nothing waits for a frozen unit
                    elif not on:
                        seat.look()
            return frozen

        return Site(
            self.command[tick.FAULTS : tick.MOTORS],
            self.post,
            self.nodes,
            self.rack,
            self.gate,
            self.clock_ns,
            self.hub.load.bitrate,
            self.disturb,
            freeze_units,
        )

    def disturb(self) -> None:
        """Let the gate of faults see every frame while it has something to do, else none."""
        if self.gate.idle:
            self.rack.gate = None
            self.hub.gate = None
        else:
            self.rack.gate = self._from_rig
            self.hub.gate = self._from_outside

    def _from_rig(self, member: Any, frame: Frame, carry: Callable[[], None]) -> bool:
        return self.gate.passes(frame, self._numbers.get(id(member), 0), carry)

    def _from_outside(self, sender: Any, frame: Frame, carry: Callable[[], None]) -> bool:
        if sender is self._port:
            return True  # the gate of the rack has decided already
        return self.gate.passes(frame, 0, carry)

    # -- time

    def sync(self) -> None:
        """Send SYNC; the nodes sample the row and send their PDOs before this returns."""
        # a harness that joins between two SYNCs answers from the next one on
        if self.harness.joined:
            self.harness_partner.answered.clear()
        else:
            self.harness_partner.answered.set()
        self.set_time()
        self._look_at_vehicle()
        if not self.own_unit:
            self.forgive()
        if self._produces_sync:
            # nothing is to be waited for if the SYNC does not get through
            self._look_at_answers()
            self.master.sync()
        else:
            for seat in self.seats:
                seat.partner.answered.clear()
        self.hub.flush()

    def _look_at_vehicle(self) -> None:
        rolls = self.row[_VEHICLE_SPEED] != 0.0
        self._has_stopped = self._has_rolled and not rolls
        self._has_rolled = self._has_rolled or rolls

    def set_time(self) -> None:
        """Let the nodes know the present time."""
        self.rack.advance_clock(self.clock_ns())

    def poll(self) -> None:
        """Let the devices, heartbeats, time-outs and event timers advance to the present time."""
        self.rack.poll(self.clock_ns())
        self._set_alarm()

    # -- alarms between two SYNCs: the bench calls `ring` in lockstep, a descriptor in real time

    def ring(self) -> None:
        """Run the heartbeats, time-outs and event timers that are due."""
        now_ns = self.clock_ns()
        if self.rack.next_ns() <= now_ns:
            self._refresh()
            self.rack.ring(now_ns)

    def keep_time(self) -> None:
        """From now on alarms go off by themselves, by the wall clock. Call it in the event loop."""
        self._alarm = Alarm()
        self.rack.in_real_time()
        asyncio.get_running_loop().add_reader(self._alarm.fileno, self._hear)

    def close(self) -> None:
        """Stop the alarms."""
        if self._alarm is not None:
            asyncio.get_running_loop().remove_reader(self._alarm.fileno)
            self._alarm.close()
            self._alarm = None

    def _hear(self) -> None:
        if self._alarm is not None:
            self._alarm.acknowledge()
            self._armed_ns = NEVER
            self.ring()
            self._set_alarm()

    def _set_alarm(self) -> None:
        if self._alarm is None:
            return
        next_ns = self.rack.next_ns()
        if next_ns < self._armed_ns:
            self._armed_ns = next_ns
            self._alarm.set(next_ns - self.clock_ns())


def _heartbeat_ms(scenario: Scenario) -> int:
    return round(1000.0 * scenario["bus"]["heartbeat_s"])


def _further_nodes(scenario: Scenario) -> tuple[int, ...]:
    """Return the nodes of the rig besides those that every rig has."""
    numbers: tuple[int, ...] = ()
    if scenario.params.sanders.axles:
        numbers += scenario.table.nodes(signals.SANDER_NODE)
    if scenario.kind.dynamic_brake:
        numbers += scenario.table.nodes(signals.TRACTION_NODE)
    return numbers


def _build_master(scenario: Scenario, pacing: str) -> NmtMaster:
    bus = scenario["bus"]
    # in lockstep the bench waits for each answer, and a run without one ends
    silent_after = 0
    if pacing == "wall":
        silent_after = silent_after_syncs(bus["sync_period_s"])
    return NmtMaster(
        scenario.table,
        master=bus["master"],
        heartbeat_ms=_heartbeat_ms(scenario),
        unit_lost_after_ms=unit_lost_after_ms(bus["sync_period_s"]),
        further_nodes=_further_nodes(scenario),
        unit_silent_after=silent_after,
    )


def _build_nodes(
    scenario: Scenario,
    row: np.ndarray,
    command: np.ndarray,
    post: Callable[[], None],
    train_deceleration_m_s2: np.ndarray | None = None,
) -> dict[int, Node]:
    """Return the nodes of the rig by number. They read `row`, write `command` and call `post()`."""
    bus, motors = scenario["bus"], scenario["drive"]
    table = scenario.table
    parameters = {
        "teeth": float(scenario["sensor"]["teeth"]),
        "heartbeat_ms": float(_heartbeat_ms(scenario)),
        "unit_lost_after_ms": float(unit_lost_after_ms(bus["sync_period_s"])),
        "rated_torque_Nm": motors["rated_torque_Nm"],
        "max_speed_rad_s": motors["max_speed_rad_s"],
        "thermal_time_constant_s": motors["thermal_time_constant_s"],
    }

    def store(number: int) -> Path | None:
        """The file in which a node keeps stored parameters."""
        return Path(bus["store"], f"node_{number:03d}.json") if bus["store"] else None

    nodes: dict[int, Node] = {}
    drive_commands = command[tick.DRIVES : tick.FAULTS].reshape(MOST_AXLES, -1)
    for axle, number in enumerate(table.drive_nodes, start=1):
        nodes[number] = drive.build(
            number,
            axle,
            row,
            parameters,
            drive_commands[axle - 1],
            post,
            scenario["rig"]["drives"],
            store(number),
        )
    for group, number in enumerate(table.nodes(signals.SPEED_NODE)):
        nodes[number] = encoder406.build(
            table, row, parameters, store(number), group, train_deceleration_m_s2
        )
    for group, number in enumerate(table.nodes(signals.BRAKE_NODE)):
        commands = command[: io401.COMMANDS]
        track_brake = command[tick.TRACK_BRAKE :]
        nodes[number] = io401.build(
            table, row, commands, parameters, post, store(number), group, track_brake
        )
    if scenario.params.sanders.axles:
        for group, number in enumerate(table.nodes(signals.SANDER_NODE)):
            commands = command[tick.SAND : tick.DRIVES]
            nodes[number] = sander401.build(
                table, row, commands, post, store(number), parameters, group
            )
    if scenario.kind.dynamic_brake:
        for group, number in enumerate(table.nodes(signals.TRACTION_NODE)):
            commands = command[tick.MOTORS : tick.TRACK_BRAKE]
            nodes[number] = traction401.build(
                table, row, commands, post, store(number), parameters, group
            )
    return nodes


def check_stored(scenario: Scenario) -> None:
    """Refuse stored parameters by which two nodes, or node and unit, send one identifier.

    Raises ConfigError.
    """
    if scenario["bus"]["store"]:
        row = np.zeros(signals.WIDTH)
        nodes = _build_nodes(scenario, row, tick.first_command(), lambda: None)
        identifiers.check(scenario.table, nodes)


def _is_sync(frame: Frame) -> bool:
    """Whether a frame is a SYNC; longer frames with its identifier are errors."""
    return frame.can_id == SYNC and len(frame.data) <= 1 and not (frame.extended or frame.remote)


def record_frames(hub: Hub, ring: rings.Ring, begun_ns: Callable[[], int] = lambda: 0) -> None:
    """Put every frame of the bus into a ring of frames.

    `begun_ns()` is when the run began by the clock of the bus; -1 while it has not begun, and no
    frame is put into the ring.
    """
    row = np.zeros(rings.FRAME_WORDS, dtype=np.int64)

    def put(frame: Frame) -> None:
        begun = begun_ns()
        if begun < 0:
            return
        flags = 0
        if frame.extended:
            flags |= EXTENDED_FLAG
        if frame.remote:
            flags |= REMOTE_FLAG
        if frame.error:
            flags |= ERROR_FLAG
        row[rings.FRAME_TIME_NS] = max(frame.time_ns - begun, 0)
        row[rings.FRAME_ID] = frame.can_id | flags
        row[rings.FRAME_LENGTH] = frame.dlc if frame.remote else len(frame.data)
        row[rings.FRAME_DATA] = int.from_bytes(frame.data.ljust(8, b"\0"), "little", signed=True)
        ring.push(row)

    hub.tap(put)
