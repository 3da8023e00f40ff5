"""The rig on its bus: hub or kernel CAN, the six nodes, the master, and what they tell the bench.

The nodes read a live row of all signals and write a small array of commands. This file joins them
to the bus and gives the bench two calls, `sync` (a SYNC is due) and `poll` (time has passed), and
one fact: whether the unit has answered this SYNC.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim import bench_node, encoder406, io401
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
from rollerrig.wsp_interface.bus import buses, plugin
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.connection_set import SYNC
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.rig_objects import HARNESS_ANSWER_ID, MAGNETS_ID

KERNEL_CHANNEL = "vcan0"


def address(scenario: Scenario) -> str:
    """The bus that a scenario's [bus] asks for: kernel CAN where it is up, else the hub."""
    bus = scenario["bus"]
    interface = bus["interface"]
    if interface == "auto":
        up = buses.available().up
        interface = f"socketcan:{KERNEL_CHANNEL}" if KERNEL_CHANNEL in up else "hub"
    if interface == "hub":
        return f"socketcand://{bus['host']}:{bus['socketcand_port']}/{signals.BUS_CHANNEL}"
    return interface


async def open_bus(scenario: Scenario, clock_ns: Callable[[], int],
                   on_lost: Callable[[BusError], None]) -> tuple[Hub, str]:
    """The bus of a scenario, and the address under which others reach it. Raises BusError."""
    place, bitrate = address(scenario), scenario["bus"]["bitrate"]
    if not place.startswith("socketcand:"):
        return await buses.open_hub(place, clock_ns, bitrate, on_lost), place
    host, port, name = plugin.parse_address(place)
    hub = Hub(clock_ns, bitrate, name)
    port = await hub.listen("socketcand", host, port)
    return hub, f"socketcand://{host}:{port}/{name}"


async def open_others(hub: Hub, scenario: Scenario) -> dict[str, int]:
    """Let in the clients of the other protocols that [bus] gives ports; the ports by protocol.

    Raises BusError for a port that cannot be used.
    """
    bus = scenario["bus"]
    wanted = {codec: bus[f"{codec}_port"] for codec in CODECS if codec != "socketcand"}
    return {codec: await hub.listen(codec, bus["host"], port)
            for codec, port in wanted.items() if port >= 0}


class RigBus:
    """Six nodes and a master on one bus.

    `row` is the live row of all signals, `command` (tick.COMMANDS,) float64 what the bus asks of the rig;
    `on_command(command)` is called when it has changed.
    """

    def __init__(self, hub: Hub, scenario: Scenario, row: np.ndarray,
                 on_command: Callable[[np.ndarray], None], on_event: Callable[[str, str], None],
                 clock_ns: Callable[[], int], pacing: str = "wall") -> None:
        self.hub, self.row, self.clock_ns = hub, row, clock_ns
        self.command = tick.first_command()
        self.answered, self.harness_answered = asyncio.Event(), asyncio.Event()
        # nobody asks for anything before all nodes stand
        self._on_command: Callable[[np.ndarray], None] = lambda command: None
        bus = scenario["bus"]
        beat_ms = round(1000.0 * bus["heartbeat_s"])
        self.master = NmtMaster(master=bus["master"], heartbeat_ms=beat_ms)
        parameters = {"rated_torque_Nm": scenario["drive"]["rated_torque_Nm"],
                      "max_speed_rad_s": scenario["drive"]["max_speed_rad_s"],
                      "thermal_time_constant_s": scenario["drive"]["thermal_time_constant_s"],
                      "teeth": float(scenario["sensor"]["teeth"]), "heartbeat_ms": float(beat_ms)}
        asked = self.command[tick.DRIVES:tick.FAULTS].reshape(len(signals.DRIVE_NODES), -1)
        store = {node: Path(bus["store"], f"node_{node:03d}.json") if bus["store"] else None
                 for node in signals.RIG_NODES}
        nodes = [drive.build(node_id, axle, row, parameters, asked[axle - 1], self.post,
                             scenario["rig"]["drives"], store[node_id])
                 for axle, node_id in enumerate(signals.DRIVE_NODES, start=1)]
        nodes.append(encoder406.build(row, parameters, store[signals.SPEED_NODE]))
        nodes.append(io401.build(row, self.command[:io401.COMMANDS], parameters, self.post,
                                 store[signals.BRAKE_NODE]))
        self.nodes = {node.node_id: node for node in nodes}
        self.bench_node = bench_node.build(row, self.command[tick.FRICTION:tick.DRIVES], self.post,
                                           pacing)
        self.harness: bench_node.BenchNode = self.bench_node.device
        self.rack = Rack()
        # the master first: it hears the boot-up of the others
        members: tuple[Any, ...] = (self.master, *nodes, self.bench_node)
        for member in members:
            member.on_event = on_event
            self.rack.add(member)
        self._produces_sync = bus["master"]
        self._arbitration = bus["arbitration"]
        self._port = hub.attach(self._from_bus, "rig")
        self._numbers = {id(node): node.node_id for node in nodes}
        self.gate = Gate(Controllers(hub.destroy))
        # SYNCs that the unit has still to answer; a frozen one shall answer them all when it is back
        self.owed, self.frozen = 0, False
        # SYNCs of somebody else, though the bench is to send them
        self.stray_syncs, self._stray = 0, False
        self._on_event = on_event
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
            self.hub.arrived = self._note_answer
            self.rack.deferred = self._port.send

    def _from_bus(self, frame: Frame) -> None:
        # the rig's own frames do not come this way
        self._stray = self._produces_sync and _is_sync(frame)
        if self._stray:
            self.stray_syncs += 1
            if self.stray_syncs == 1:
                self._on_event("warning", "somebody else sends SYNC (080h), which is the bench's to send: the "
                               "rig's nodes obey it, the run does not wait for an answer to it; let the "
                               "unit be silent there, or leave SYNC to it with bus.master=false")
        self.rack.on_frame(frame)

    def _listen(self, frame: Frame) -> None:
        if _is_sync(frame):
            stray, self._stray = self._stray, False
            if not stray:
                self.owed += 1
                self.answered.clear()
        elif self.hub.wire is None:
            self._note_answer(frame)

    def _note_answer(self, frame: Frame) -> None:
        """An answer counts when it has come to the bus, whenever the wire carries it."""
        if frame.can_id == MAGNETS_ID:
            self._count_answer()
        elif frame.can_id == HARNESS_ANSWER_ID:
            self.harness_answered.set()

    def _count_answer(self) -> None:
        self.owed = max(self.owed - 1, 0)
        if not self.owed:
            self.answered.set()

    def site(self, freeze: Callable[[bool], bool]) -> Site:
        """What faults act on. `freeze(on)` stops the WSP unit's process, where there is one."""
        def freezes(on: bool) -> bool:
            self.frozen = freeze(on) and on
            return self.frozen

        return Site(self.command[tick.FAULTS:], self.post, self.nodes, self.rack, self.gate,
                    self.clock_ns, self.hub.load.bitrate, self.disturb, freezes)

    def disturb(self) -> None:
        """Let the gate of faults see every frame while it has something to do, else none."""
        idle = self.gate.idle
        self.rack.gate = None if idle else self._from_rack
        self.hub.gate = None if idle else self._from_outside

    def _from_rack(self, member: Any, frame: Frame, carry: Callable[[], None]) -> bool:
        return self.gate.passes(frame, self._numbers.get(id(member), 0), carry)

    def _from_outside(self, sender: Any, frame: Frame, carry: Callable[[], None]) -> bool:
        if sender is self._port:
            return True  # the rack has asked already
        passes = self.gate.passes(frame, 0, carry)
        if not passes and frame.can_id == MAGNETS_ID:
            self._count_answer()
        return passes

    def sync(self) -> None:
        """Send SYNC; the nodes sample the row and send their PDOs before this returns."""
        self.harness_answered.clear()
        self.rack.tell_time(self.clock_ns())
        if not self.frozen:
            self.owed = 0
        if self._produces_sync:
            # a SYNC that does not get through is none to wait for: one that does clears this
            self.answered.set()
            self.master.sync()
        else:
            self.answered.clear()
        self.hub.flush()

    def poll(self) -> None:
        """Let heartbeats, time-outs and event timers pass."""
        self.rack.poll(self.clock_ns())


def _is_sync(frame: Frame) -> bool:
    # longer ones are errors, not SYNCs
    return frame.can_id == SYNC and len(frame.data) <= 1 and not frame.extended


def record_frames(hub: Hub, ring: rings.Ring, begun_ns: Callable[[], int] = lambda: 0) -> None:
    """Put every frame of the bus into a ring of frames.

    `begun_ns()`: when the run began by the clock of the bus; -1 while it has not (nothing is put).
    """
    row = np.zeros(rings.FRAME_WORDS, dtype=np.int64)
    body = row[3:].view(np.uint8)

    def put(frame: Frame) -> None:
        begun = begun_ns()
        if begun < 0:
            return
        row[0] = max(frame.time_ns - begun, 0)
        row[1] = (frame.can_id | (rings.EXTENDED_FLAG if frame.extended else 0)
                  | (rings.REMOTE_FLAG if frame.remote else 0)
                  | (rings.ERROR_FLAG if frame.error else 0))
        row[2] = frame.dlc if frame.remote else len(frame.data)
        row[3] = 0
        body[: len(frame.data)] = np.frombuffer(frame.data, dtype=np.uint8)
        ring.push(row)

    hub.tap(put)
