"""The rig on its bus: hub or kernel CAN, the six nodes, the master, and what they tell the bench.

The nodes read a live row of all signals and write a small array of commands. This file joins them to the bus and gives
the bench two calls, `sync` (a SYNC is due) and `poll` (time has passed), and one fact: whether the unit has answered.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim import bench_node, encoder406, io401, sander401
from rollerrig.firmware_sim.cia301.host import NEVER
from rollerrig.firmware_sim.drive402 import drive
from rollerrig.firmware_sim.faults.bus import Gate
from rollerrig.firmware_sim.faults.confinement import Controllers
from rollerrig.firmware_sim.faults.panel import Site
from rollerrig.firmware_sim.nmt_master import NmtMaster
from rollerrig.firmware_sim.rack import Rack
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import REFERENCE
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import buses, kernel, plugin
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.connection_set import (
    EMERGENCY,
    HEARTBEAT,
    NODE_MASK,
    SDO_REPLY,
    SYNC,
    TPDO,
)
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.bus.wire import Alarm
from rollerrig.wsp_interface.events import Code, OnEvent
from rollerrig.wsp_interface.rig_objects import (
    HARNESS_ANSWER_ID,
    MAGNETS_ID,
    SPEEDS,
    unit_lost_after_ms,
)

KERNEL_CHANNEL = "vcan0"
# longer than the heartbeat of a node of any bench, 100 ms
_LISTEN_S = 0.25
_SENT_BY_NODES = (EMERGENCY, *TPDO, SDO_REPLY, HEARTBEAT)


def address(scenario: Scenario) -> str:
    """The bus that a scenario's [bus] asks for: kernel CAN where it is up, else the hub."""
    bus, interface = scenario["bus"], scenario["bus"]["interface"]
    if interface == "auto":
        interface = (
            f"socketcan:{KERNEL_CHANNEL}" if KERNEL_CHANNEL in kernel.available().up else "hub"
        )
    if interface == "hub":
        return f"socketcand://{bus['host']}:{bus['socketcand_port']}/{signals.BUS_CHANNEL}"
    return interface


async def open_bus(
    scenario: Scenario,
    clock_ns: Callable[[], int],
    on_lost: Callable[[BusError], None],
    on_event: OnEvent,
    wall: bool,
) -> tuple[Hub, str]:
    """The bus of a scenario, and the address under which others reach it. Raises BusError.

    `wall`: clock_ns goes as the wall clock does.
    """
    place, bitrate = address(scenario), scenario["bus"]["bitrate"]
    if not place.startswith("socketcand:"):
        hub = await buses.open_hub(place, clock_ns, bitrate, on_lost, on_event, wall)
        await _refuse_namesakes(hub, place)
        return hub, place
    host, port, name = plugin.parse_address(place)
    hub = Hub(clock_ns, bitrate, name, on_event=on_event)
    port = await hub.listen("socketcand", host, port)
    return hub, f"socketcand://{host}:{port}/{name}"


async def _refuse_namesakes(hub: Hub, place: str) -> None:
    """Listen before the rig speaks. Raises BusError when a node with one of its numbers is there."""
    heard: set[int] = set()
    port = hub.attach(lambda frame: None if frame.extended else heard.add(frame.can_id), "listener")
    await asyncio.sleep(_LISTEN_S)
    port.close()
    for can_id in sorted(heard):
        if can_id & ~NODE_MASK in _SENT_BY_NODES and can_id & NODE_MASK in signals.RIG_NODES:
            await hub.close()
            raise BusError(
                f"bus {place}: a node {can_id & NODE_MASK} speaks there already ({can_id:X}h), as the "
                "rig's own will: end what emulates it, or use another bus (--set bus.interface=hub)"
            )


async def open_others(hub: Hub, place: str, scenario: Scenario) -> dict[str, int]:
    """Let in the clients of the other protocols that [bus] gives ports; the ports by protocol.

    On a bus of the kernel that is socketcand too. Raises BusError for a port that cannot be used.
    """
    bus, on_hub = scenario["bus"], place.startswith("socketcand:")
    return {
        codec: await hub.listen(codec, bus["host"], port)
        for codec in CODECS
        if not (codec == "socketcand" and on_hub) and (port := bus[f"{codec}_port"]) >= 0
    }


class RigBus:
    """Six nodes, a seventh where there are sanders, and a master on one bus.

    `row` is the live row of all signals, `command` (tick.COMMANDS,) float64 what the bus asks of the rig;
    `on_command(command)` is called when it has changed, `refresh(row)` before an alarm goes off.
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
    ) -> None:
        self.hub, self.row, self.clock_ns = hub, row, clock_ns
        self._refresh = lambda: refresh(row)
        self.command = tick.first_command()
        self.answered, self.harness_answered = asyncio.Event(), asyncio.Event()
        self.answered.set()
        # nobody asks for anything before all nodes stand
        self._on_command: Callable[[np.ndarray], None] = lambda command: None
        bus = scenario["bus"]
        beat_ms = round(1000.0 * bus["heartbeat_s"])
        lost_after_ms = unit_lost_after_ms(bus["sync_period_s"])
        numbers = (
            *signals.RIG_NODES,
            *((signals.SANDER_NODE,) if scenario.params.sanders.axles else ()),
        )
        self.master = NmtMaster(
            master=bus["master"],
            heartbeat_ms=beat_ms,
            unit_lost_after_ms=lost_after_ms,
            nodes=numbers,
        )
        parameters = {
            "teeth": float(scenario["sensor"]["teeth"]),
            "heartbeat_ms": float(beat_ms),
            "unit_lost_after_ms": float(lost_after_ms),
        } | {
            key: scenario["drive"][key]
            for key in ("rated_torque_Nm", "max_speed_rad_s", "thermal_time_constant_s")
        }
        asked = self.command[tick.DRIVES : tick.FAULTS].reshape(len(signals.DRIVE_NODES), -1)
        store = {
            node: Path(bus["store"], f"node_{node:03d}.json") if bus["store"] else None
            for node in numbers
        }
        nodes = [
            drive.build(
                node_id,
                axle,
                row,
                parameters,
                asked[axle - 1],
                self.post,
                scenario["rig"]["drives"],
                store[node_id],
            )
            for axle, node_id in enumerate(signals.DRIVE_NODES, start=1)
        ]
        nodes.append(encoder406.build(row, parameters, store[signals.SPEED_NODE]))
        nodes.append(
            io401.build(
                row,
                self.command[: io401.COMMANDS],
                parameters,
                self.post,
                store[signals.BRAKE_NODE],
            )
        )
        if signals.SANDER_NODE in numbers:
            nodes.append(
                sander401.build(
                    row,
                    self.command[tick.SAND : tick.DRIVES],
                    self.post,
                    store[signals.SANDER_NODE],
                    parameters,
                )
            )
        self.nodes = {node.node_id: node for node in nodes}
        self.bench_node = bench_node.build(
            row, self.command[tick.FRICTION : tick.SAND], self.post, pacing
        )
        self.harness: bench_node.BenchNode = self.bench_node.device
        self.rack = Rack()
        # the master first: it hears the boot-up of the others
        members: tuple[Any, ...] = (self.master, *nodes, self.bench_node)
        for member in members:
            member.on_event, member.clock_ns = on_event, clock_ns
            self.rack.add(member)
        self._produces_sync, self._arbitration = bus["master"], bus["arbitration"]
        self._port = hub.attach(self._from_bus, "rig")
        self._numbers = {id(node): node.node_id for node in nodes}
        self.gate = Gate(Controllers(hub.destroy))
        # SYNCs that the unit has still to answer; a frozen one shall answer them all when it is back
        self.owed, self.frozen = 0, False
        # the bench's own unit: it answers every SYNC, also strays, one without what sets off its cycle with the next
        self.own_unit, self._may_wait, self.awaited = False, 0, SPEEDS.can_id
        # SYNCs of somebody else, though the bench is to send them
        self.stray_syncs, self._stray = 0, False
        self._on_event = on_event
        # rings at `_armed_ns`, perhaps sooner than is needed
        self._alarm: Alarm | None = None
        self._armed_ns = NEVER
        hub.arrived = self._note_answer
        self.rack.start(self._port.send, clock_ns())
        hub.attach(self._listen, "bench")
        self._on_command = on_command

    def post(self) -> None:
        """Hand on what the bus asks of the rig."""
        self.command[REFERENCE] = self.master.reference_speed_m_s
        self._on_command(self.command)

    def start_wire(self, timed: bool) -> None:
        """From now on frames wait for the wire, where [bus] says so; `timed` as `Hub.arbitrate` has it."""
        if self._arbitration and self.hub.wire is None:
            self.hub.arbitrate(timed)
            self.rack.deferred = self._port.send

    def _from_bus(self, frame: Frame) -> None:
        # the rig's own frames do not come this way
        self._stray = self._produces_sync and _is_sync(frame)
        if self._stray:
            self.stray_syncs += 1
            if self.stray_syncs == 1:
                self._on_event(Code.SYNC_FOREIGN)
        self.rack.tell_time(frame.time_ns)
        self.rack.on_frame(frame)
        self._set_alarm()

    def _listen(self, frame: Frame) -> None:
        if _is_sync(frame):
            stray, self._stray = self._stray, False
            if stray and not self.own_unit:
                return
            self.owed += 1
            self._may_wait = int(self.own_unit)
        elif frame.can_id == self.awaited and len(frame.data) == SPEEDS.struct.size:
            self._may_wait = 0
        else:
            return
        self._look_at_answers()

    def _note_answer(self, frame: Frame, sender: Any) -> None:
        """An answer counts when it has come, whenever the bus carries it, and if faults let it get lost."""
        if sender is self._port:
            return
        if frame.can_id == MAGNETS_ID:
            self.owed = max(self.owed - 1, 0)
            self._look_at_answers()
        elif frame.can_id == HARNESS_ANSWER_ID:
            self.harness_answered.set()

    @property
    def late(self) -> bool:
        """Whether the bench's own unit has still to answer, as when a fault or a busy wire lets speeds come late."""
        return self.own_unit and not (self.frozen or self.answered.is_set())

    def forgive(self) -> None:
        """Wait for no answer that is owed."""
        self.owed = 0
        self.answered.set()

    def _look_at_answers(self) -> None:
        if self.owed <= self._may_wait:
            self.answered.set()
        else:
            self.answered.clear()

    def site(self, freeze: Callable[[bool], bool]) -> Site:
        """What faults act on. `freeze(on)` stops the WSP unit's process, where there is one."""

        def freezes(on: bool) -> bool:
            self.frozen = freeze(on) and on
            return self.frozen

        return Site(
            self.command[tick.FAULTS :],
            self.post,
            self.nodes,
            self.rack,
            self.gate,
            self.clock_ns,
            self.hub.load.bitrate,
            self.disturb,
            freezes,
        )

    def disturb(self) -> None:
        """Let the gate of faults see every frame while it has something to do, else none."""
        idle = self.gate.idle
        self.rack.gate = (
            None
            if idle
            else lambda member, frame, carry: self.gate.passes(
                frame, self._numbers.get(id(member), 0), carry
            )
        )
        self.hub.gate = None if idle else self._from_outside

    def _from_outside(self, sender: Any, frame: Frame, carry: Callable[[], None]) -> bool:
        if sender is self._port:
            return True  # the rack has asked already
        return self.gate.passes(frame, 0, carry)

    def sync(self) -> None:
        """Send SYNC; the nodes sample the row and send their PDOs before this returns."""
        # one that joins between two SYNCs answers from the next on
        (self.harness_answered.clear if self.harness.joined else self.harness_answered.set)()
        self.set_time()
        if not self.own_unit:
            self.forgive()
        if self._produces_sync:
            # a SYNC that does not get through is none to wait for
            self._look_at_answers()
            self.master.sync()
        else:
            self.answered.clear()
        self.hub.flush()

    def set_time(self) -> None:
        """Nodes note what time it is."""
        self.rack.tell_time(self.clock_ns())

    def poll(self) -> None:
        """Let devices go on, and heartbeats, time-outs and event timers pass."""
        self.rack.poll(self.clock_ns())
        self._set_alarm()

    # -- alarms between two SYNCs: in lockstep whoever runs the ticks asks for them, else a descriptor rings

    def ring(self) -> None:
        """Let heartbeats, time-outs and event timers pass that are due."""
        now_ns = self.clock_ns()
        if self.rack.next_ns() <= now_ns:
            self._refresh()
            self.rack.ring(now_ns)

    def keep_time(self) -> None:
        """From now on alarms go off by themselves, as the wall clock goes. To be called in the event loop."""
        self._alarm = Alarm()
        asyncio.get_running_loop().add_reader(self._alarm.fileno, self._hear)

    def close(self) -> None:
        """No more alarms."""
        if self._alarm is not None:
            asyncio.get_running_loop().remove_reader(self._alarm.fileno)
            self._alarm.close()
            self._alarm = None

    def _hear(self) -> None:
        if self._alarm is not None:
            self._alarm.hear()
            self._armed_ns = NEVER
            self.ring()
            self._set_alarm()

    def _set_alarm(self) -> None:
        if self._alarm is not None and (next_ns := self.rack.next_ns()) < self._armed_ns:
            self._armed_ns = next_ns
            self._alarm.set(next_ns - self.clock_ns())


def _is_sync(frame: Frame) -> bool:
    # longer ones are errors, not SYNCs
    return frame.can_id == SYNC and len(frame.data) <= 1 and not (frame.extended or frame.remote)


def record_frames(hub: Hub, ring: rings.Ring, begun_ns: Callable[[], int] = lambda: 0) -> None:
    """Put every frame of the bus into a ring of frames.

    `begun_ns()`: when the run began by the clock of the bus; -1 while it has not (nothing is put).
    """
    row = np.zeros(rings.FRAME_WORDS, dtype=np.int64)

    def put(frame: Frame) -> None:
        if (begun := begun_ns()) < 0:
            return
        row[0] = max(frame.time_ns - begun, 0)
        row[1] = (
            frame.can_id
            | (rings.EXTENDED_FLAG if frame.extended else 0)
            | (rings.REMOTE_FLAG if frame.remote else 0)
            | (rings.ERROR_FLAG if frame.error else 0)
        )
        row[2] = frame.dlc if frame.remote else len(frame.data)
        row[3] = int.from_bytes(frame.data.ljust(8, b"\0"), "little", signed=True)
        ring.push(row)

    hub.tap(put)
