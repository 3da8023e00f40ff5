"""Node 127 as NMT master and SYNC producer of the bus, unless an outside device has these roles.

The master starts a node once after its boot-up, or when the first heartbeat of the node reports
PRE-OPERATIONAL. It does not change what an outside master commands later. It knows the states of
all nodes, above all that of the WSP unit, from their heartbeats.
Source: CiA 301, NMT, SYNC and heartbeat.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rollerrig.firmware_sim.cia301.host import MS, Timers
from rollerrig.firmware_sim.cia301.nmt import Command, State
from rollerrig.firmware_sim.unit_answers import UnitAnswers
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY, HEARTBEAT, NMT, SYNC
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code, OnEvent
from rollerrig.wsp_interface.rig_objects import (
    UNIT_LOST_AFTER_MS,
    Layout,
    emergency_event,
    unit_frames,
)
from rollerrig.wsp_interface.signals import BENCH_NODE, Table

LOST_AFTER_MS = 500  # silence after which a node of the rig counts as lost


class Health:
    """The known state of a node: its NMT state (None: never heard), and whether it is lost.

    `started`: this master has started it since its last boot-up.
    """

    def __init__(self) -> None:
        self.state: State | None = None
        self.lost = False
        self.started = False


class NmtMaster:
    """Node 127. Its owner calls `on_frame`, `poll` and `sync`.

    `table`: the signals of the vehicle. `master`: whether it starts the nodes. `sync_overflow`:
    highest value of the SYNC counter (0: no counter). `further_nodes`: nodes of the rig besides
    those that every rig has. `unit_silent_after`: SYNCs without an answer after which a WSP unit is
    silent (0: it is not judged). `on_event(code, **fields)` takes the events of the run.
    """

    def __init__(
        self,
        table: Table,
        master: bool = True,
        sync_overflow: int = 0,
        heartbeat_ms: int = 100,
        unit_lost_after_ms: int = UNIT_LOST_AFTER_MS,
        further_nodes: Sequence[int] = (),
        unit_silent_after: int = 0,
    ) -> None:
        self.table = table
        nodes = (*table.rig_nodes, *further_nodes)
        self.patience_ms = dict.fromkeys(nodes, LOST_AFTER_MS)
        self.patience_ms |= dict.fromkeys(table.wsp_nodes, unit_lost_after_ms)
        self.master = master
        self.sync_overflow = sync_overflow
        self.heartbeat_ms = heartbeat_ms
        self.health = {node: Health() for node in (*nodes, *table.wsp_nodes)}
        # the WSP units, the one of the leading group first
        self.units = tuple(self.health[node] for node in table.wsp_nodes)
        self.unit = self.units[0]
        self.answers: dict[int, UnitAnswers] = {}
        if unit_silent_after:
            self.answers = {node: UnitAnswers(unit_silent_after) for node in table.wsp_nodes}
        # the reference speeds that the units send, NaN: none
        self.reference_speeds_m_s = [math.nan] * table.kind.groups
        self.now_ns = 0
        self.counter = 0
        self.on_event: OnEvent = events.ignore
        self.on_rewired: Callable[[], None] = lambda: None
        self.send: Callable[[Frame], Any] = lambda frame: None
        self.timers = Timers()
        self.handlers: dict[int, Callable[[Frame], None]] = {}
        self.remote_handlers: dict[int, Callable[[Frame], None]] = {}

    @property
    def unit_is_operational(self) -> bool:
        """Whether every WSP unit is heard and OPERATIONAL."""
        return all(unit.state is State.OPERATIONAL and not unit.lost for unit in self.units)

    def all_operational(self) -> bool:
        """Return whether every node of the rig (not the WSP unit) is OPERATIONAL."""
        return all(
            health.state is State.OPERATIONAL and not health.lost
            for node, health in self.health.items()
            if node not in self.table.wsp_nodes
        )

    def start(self, send: Callable[[Frame], Any], now_ns: int) -> None:
        """Send the boot-up message, and then heartbeats as OPERATIONAL."""
        self.send = send
        self.now_ns = now_ns
        self.handlers = {HEARTBEAT + node: self._on_heartbeat for node in self.health}
        self.handlers |= {EMERGENCY + node: self._on_emergency for node in self.health}
        for group in range(self.table.kind.groups):
            layout = unit_frames(self.table, group).reference_speed
            self.handlers[layout.can_id] = partial(self._on_reference_speed, group, layout)
        if self.answers and not self.master:
            self.handlers[SYNC] = self._on_sync
        for group, node in enumerate(self.answers):
            answer_id = unit_frames(self.table, group).magnets_id
            self.handlers[answer_id] = partial(self._on_answer, node)
        self.on_rewired()
        self._beat(State.INITIALISING)

    def power_off(self) -> None:
        """Send and receive nothing until the next `start`."""
        self.send = lambda frame: None
        self.handlers = {}
        self.timers.clear()
        self.on_rewired()

    def on_frame(self, frame: Frame) -> None:
        """Take a frame from the bus. Never raises, whatever the frame contains."""
        handler = None if frame.remote or frame.extended else self.handlers.get(frame.can_id)
        if handler is not None:
            handler(frame)

    def poll(self, now_ns: int) -> None:
        """Send what is due at `now_ns`, and notice which nodes are lost."""
        self.timers.poll(now_ns, self)

    def sync(self) -> None:
        """Send SYNC, with the counter if there is one."""
        self._count_sync()
        if not self.sync_overflow:
            self.send(Frame(SYNC, b""))
            return
        self.counter = self.counter % self.sync_overflow + 1
        self.send(Frame(SYNC, bytes([self.counter])))

    def command(self, command: Command, node: int = 0) -> None:
        """Send an NMT command to a node, or to all (0)."""
        self.send(Frame(NMT, bytes([command, node])))
        if command in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
            self.counter = 0

    def _beat(self, state: State = State.OPERATIONAL) -> None:
        self.send(Frame(HEARTBEAT + BENCH_NODE, bytes([state])))
        if self.heartbeat_ms:
            self.timers.set("heartbeat", self.now_ns + self.heartbeat_ms * MS, self._beat)

    def _on_heartbeat(self, frame: Frame) -> None:
        node = frame.can_id - HEARTBEAT
        if len(frame.data) != 1:
            return
        state = _STATES.get(frame.data[0] & 0x7F)
        if state is None:
            return
        health = self.health[node]
        if health.lost:
            back = Code.UNIT_BACK if node in self.table.wsp_nodes else Code.NODE_BACK
            self.on_event(back, node=node, state=state.title)
        elif node in self.table.wsp_nodes and health.state is not state:
            # the nodes of the rig report their states themselves
            seen = Code.UNIT_APPEARED if health.state is None else Code.UNIT_STATE
            self.on_event(seen, node=node, state=state.title)
        health.state = state
        health.lost = False
        lost_at_ns = self.now_ns + self.patience_ms[node] * MS
        self.timers.set(f"lost {node}", lost_at_ns, partial(self._lose, node), times_out=True)

        if state is State.INITIALISING:
            health.started = False
            if node in self.answers:
                self.answers[node].start_anew(self.now_ns)
        can_be_started = state in (State.INITIALISING, State.PRE_OPERATIONAL)
        if self.master and can_be_started and not health.started:
            health.started = True
            self.command(Command.START, node)

    def _lose(self, node: int) -> None:
        self.health[node].lost = True
        self.health[node].started = False
        lost = Code.UNIT_LOST if node in self.table.wsp_nodes else Code.NODE_LOST
        self.on_event(lost, node=node, silent_s=self.patience_ms[node] / 1e3)
        if node in self.table.wsp_nodes:
            self.reference_speeds_m_s[self.table.wsp_nodes.index(node)] = math.nan

    def _on_sync(self, _: Frame) -> None:
        """Another node has sent SYNC, and produces it."""
        self._count_sync()

    def _count_sync(self) -> None:
        """Count a SYNC, and report the units that are alive and no longer answer."""
        for node, answers in self.answers.items():
            if self.health[node].lost:
                # its loss is reported, and its silence is not judged until it is back
                answers.wait_again(self.now_ns)
                continue
            unanswered = answers.unanswered
            if answers.sync():
                silent_s = (self.now_ns - answers.since_ns) / 1e9
                self.on_event(Code.UNIT_SILENT, node=node, syncs=unanswered, silent_s=silent_s)

    def _on_answer(self, node: int, _: Frame) -> None:
        if self.answers[node].answer(self.now_ns):
            self.on_event(Code.UNIT_ANSWERS, node=node)

    def _on_emergency(self, frame: Frame) -> None:
        # SYNC has the identifier of an EMCY of node 0, which does not exist
        if len(frame.data) != 8:
            return
        error_code = int.from_bytes(frame.data[:2], "little")
        if error_code == 0:  # the error is over
            return
        node = frame.can_id - EMERGENCY
        self.on_event(
            emergency_event(self.table, node, error_code),
            node=node,
            error_code=error_code,
            error_register=frame.data[2],
        )

    def _on_reference_speed(self, group: int, layout: Layout, frame: Frame) -> None:
        # a unit may append other data
        for value in layout.read(frame.data[:2]).values():
            self.reference_speeds_m_s[group] = value


_STATES = {int(state): state for state in State}
