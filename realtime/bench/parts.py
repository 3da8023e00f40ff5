"""The parts of a run that its pacings share: scenario, tick data, rings, bus, faults and processes.

The bench builds a `Parts`, hands it to one pacing and closes it. `data` and `plan` change when a
held rig gets another scenario. There are two clocks: `simulated_ns` counts ticks, and `elapsed_ns`
is the time since the real-time thread began.
"""

import asyncio
import contextlib
import json
import math
import shlex
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from rollerrig.configs.errors import RollerrigError, UnitError
from rollerrig.configs.vehicle import COACH, MOST_AXLES
from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.faults import catalogue, panel
from rollerrig.firmware_sim.modbus.access import Counters
from rollerrig.firmware_sim.unit_answers import SILENT_AFTER_S
from rollerrig.realtime.bench import brake_demand, derailment, rig_bus, scenario, tick_data
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.processes import Processes
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, cores, loop, mailbox, ring, tick
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.loop.tick import DONE, MISSED, STALLED_NS, STOP, TICK
from rollerrig.realtime.record import played, validity
from rollerrig.realtime.record.events import Events
from rollerrig.realtime.record.set_points import SetPoints
from rollerrig.realtime.record.validity import ENDED_BY
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.diagnosis import Diagnosis, Sample
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import (
    HARNESS,
    JOINED,
    unit_frames,
)

# capacities of the rings, in rows
_ROWS = 1 << 14
_FRAMES = 1 << 17
_EVENTS = 1 << 14
# wall time between two reports of a run without deadlines
_REPORT_S = 0.5
# a recorder that is behind: how long to wait before the next look
_RECORDER_WAIT_S = 0.005
# time between two looks at a unit or harness that has not come yet
_POLL_S = 0.005
# a unit that does not obey NMT is there when its heartbeats have come for this time
_UNIT_SETTLES_S = 0.5
# the unit of the bench may start slowly on a busy machine: it gets so many times --wait
_OWN_UNIT_PATIENCE = 10
# how long to wait for the identity of units; most have none
_IDENTITY_S = 0.2
# when drives that wait for a master on the bus must be enabled
_MASTER_AFTER_NS = clock.SECOND_NS

# columns of the row of all signals
_TIME = signals.column("time")
_VEHICLE_SPEED = signals.column("vehicle_speed")
_REFERENCE = signals.column("wsp_reference_speed")
_BRAKE_DEMAND = signals.column("brake_demand")


def _sample(row: np.ndarray, table: signals.Table, faults: list[str]) -> Sample:
    """Return what the diagnosis needs of a row of all signals, and of the faults of each axle."""
    return Sample(
        time_s=row.item(_TIME),
        speed_m_s=row.item(_VEHICLE_SPEED),
        sliding_m_s=row[table.span("sliding")].tolist(),
        valves=row[table.span("valve")].tolist(),
        reference_m_s=row.item(_REFERENCE),
        brake_demand_Pa=row.item(_BRAKE_DEMAND),
        faults=faults,
    )


class RealTime:
    """What the real-time thread tells: the cars of a train share it.

    `histogram` is the lateness of its ticks, `interruptions` what the system counted against it,
    `begun_ns` when it began, on CLOCK_MONOTONIC; 0: it has not begun.
    """

    def __init__(self) -> None:
        self.histogram = np.zeros(loop.BINS, dtype=np.int64)
        self.interruptions: dict[str, int] = {}
        self.core = cores.Claim()
        self.begun_ns = 0


class Parts:
    """The parts of one run, or of the `car` of a train (from 1; 0: a vehicle alone) with its bus.

    `on_progress` is called with a `Progress` now and then. `ended_by` says how the run ended early;
    it is empty as long as it has not.
    """

    def __init__(
        self,
        plan: Scenario,
        options: Options,
        on_progress: Callable[[Progress], None],
        car: int = 0,
    ) -> None:
        self.car = car
        self.plan = plan
        self.table = plan.table
        self.options = options
        self.on_progress = on_progress
        self.events = Events()
        self.ended_by = ""
        self.failure: RollerrigError | None = None

        self.real_time = RealTime()
        # when the run began, on the clock of the bus; -1: the rig is held, it has not begun
        self.zero_ns = 0

        # a held rig: its next scenario, and the speed at which it rolls (later: at which it began)
        self.next_plan: Scenario | None = None
        self.speed_m_s = float(plan["initial_speed_m_s"])

        # the bus and Modbus
        self.hub: Hub | None = None
        self.bus: rig_bus.RigBus | None = None
        self.place = ""
        # for each server: closes the clients that have sent nothing valid
        self.close_silent: list[Callable[[], None]] = []
        # when asyncio has tried again to accept clients, after it was out of descriptors
        self.accepts_again_s = 0.0
        self.ports: dict[str, int] = {}
        self.modbus = Counters()
        self.modbus_demand = brake_demand.ModbusDemand(plan["modbus"]["emergency_pressure_Pa"])

        self.faults = panel.Panel(plan.faults, self.event, plan.resolved)
        self.set_points = SetPoints(self.event)
        # what the nodes on the bus required last
        self._demand_of_node_Pa = math.nan
        self._friction_of_node = np.zeros(MOST_AXLES)
        self.derailment = derailment.Watch(
            self.table.kind.axles, self.event, lambda: self.stop(Code.RUN_DERAILED)
        )
        self.diagnosis = Diagnosis(self.table.kind, self.event)
        self.processes = Processes(options, self.event)
        self.unit_played = played.unit_of(options.unit, options.unit_map, options.started_unit)

        self.rows = Ring(ring.place("rows"), np.float64, _ROWS, len(self.table.columns))
        self.rows.header[ring.CAR] = car
        self.frames = Ring(ring.place("frames"), np.int64, _FRAMES, ring.FRAME_WORDS)
        self.event_ring = Ring(ring.place("events"), np.int64, _EVENTS, ring.EVENT_WORDS)
        self.rings = (self.rows, self.frames, self.event_ring)
        self.data = tick_data.build(plan, self.rows, seed=options.seed)
        # what runs the ticks of `data` in lockstep, and on their deadlines; a train also runs those
        # of its other cars
        self.ticks_of: Callable[[tick.TickData], tick.RunsTicks] = tick.Ticks
        self.wall: Callable[..., object] = loop.wall
        # (1,), what the cars of a train are told; None: a vehicle alone
        self.train_deceleration_m_s2: np.ndarray | None = None
        self.row = self.data.row.copy()

        self._reported_s = 0.0
        self._stalled_s = 0.0
        # whether a master on the bus must still be checked for: it moves the drives
        self._master_awaited = plan["rig"]["drives"] == "bus"

    def identity(self) -> dict[str, Any]:
        """Return what is known of a run before it has begun, for its summary."""
        return {
            "pacing": self.options.pacing,
            "seed": self.options.seed,
            "unit": self.options.unit,
            "unit_played": self.unit_played._asdict(),
            "config_hash": scenario.digest(self.plan),
            "scenario": self.plan.name,
        }

    @property
    def is_random(self) -> bool:
        """Whether the rig has drawn a random number in this run, so that its seed matters."""
        first = pole_wheel.memory(self.options.seed, self.table.kind.axles)
        return not np.array_equal(self.data.pulses[pole_wheel.RANDOM], first[pole_wheel.RANDOM])

    def _configuration(self) -> str:
        """Return what the bench plays as JSON in ASCII, for a harness on the bus."""
        return json.dumps({**self.identity(), "resolved": self.plan.resolved})

    # --- what happens ---

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Let errors inside the block begin with the car of a train."""
        try:
            yield
        except RollerrigError as error:
            if self.car == 0:
                raise
            raise type(error)(f"car {self.car}: {error}") from error

    def event(self, code: Code, /, **fields: Any) -> None:
        """Record an event at the present simulated time."""
        time_s = int(self.data.control[TICK]) / self.plan["loop"]["tick_hz"]
        event = events.make(time_s, code, **fields)
        self.events.add(event)
        ring.push_event(self.event_ring, event)
        if event.level != events.INFO:
            self.report(f"{time_s:.3f} s: {event.level}: {event.text}")

    def report(self, message: str = "") -> None:
        """Report the progress of the run."""
        mailbox.fetch(self.data.published, self.row)
        self.on_progress(
            Progress(
                time_s=float(self.row[signals.column("time")]),
                speed_m_s=float(self.row[signals.column("vehicle_speed")]),
                sliding_m_s=float(self.row[self.table.span("sliding")].max()),
                missed=int(self.data.control[MISSED]),
                message=message,
            )
        )

    def stop(self, code: Code, /, **fields: Any) -> None:
        """End the run at the next tick; `code` is one of `ENDED_BY`."""
        if not self.ended_by:
            self.ended_by = ENDED_BY[code]
            self.event(code, **fields)
        self._halt()

    def _halt(self) -> None:
        """Let the loop end at the next tick, and whatever waits for an answer notice it."""
        self.data.control[STOP] = 1
        if self.bus:
            self.bus.stop_waiting()

    def report_stall(self) -> None:
        """Record where the loop has stood still since the last call: the clocks diverge there."""
        stalled_s = int(self.data.control[STALLED_NS]) / clock.SECOND_NS
        if stalled_s > self._stalled_s:
            new_s = stalled_s - self._stalled_s
            self.event(Code.LOOP_STALLED, stalled_s=new_s, ahead_s=stalled_s)
            self._stalled_s = stalled_s
            self.diagnosis.start_anew()
            if new_s >= validity.LONG_STALL_S:
                self.diagnosis.end()

    @property
    def stopping(self) -> bool:
        """Whether no further tick shall be run."""
        return bool(self.data.control[STOP] or self.data.control[DONE])

    def simulated_ns(self) -> int:
        """Return the simulated time by the ticks that have been run."""
        return int(self.data.control[TICK]) * (clock.SECOND_NS // self.plan["loop"]["tick_hz"])

    def elapsed_ns(self) -> int:
        """Return the wall time since the real-time thread began; 0 before."""
        begun_ns = self.real_time.begun_ns
        return time.monotonic_ns() - begun_ns if begun_ns else 0

    def report_scenario(self) -> None:
        """Record a value of the scenario that does not act, although a file states it."""
        replaced = self.plan.replaced
        if replaced is not None:
            self.event(Code.SCENARIO_ADHESION_REPLACED, **replaced._asdict())

    def poll_faults(self) -> None:
        """Begin and lift the faults that are due; check for a derailed coach and for the master."""
        self.faults.poll(self.simulated_ns() / clock.SECOND_NS)
        self.set_points.poll(self._bus_s())
        self.derailment.look(self.data.buffer)
        self.diagnose()
        if self._master_awaited and self.bus and self.simulated_ns() >= _MASTER_AFTER_NS:
            self._master_awaited = False
            self._check_master(self.bus)

    def diagnose(self) -> None:
        """Look at what the run shows of the unit; call it once a bus cycle.

        Events of a sealed rig do not show what it hides, for example swapped axles.
        """
        if self.options.unit == "none" or self.plan["sealed"]:
            return
        if self._others_act:
            self.diagnosis.end()
        mailbox.fetch(self.data.published, self.row)
        self.diagnosis.look(_sample(self.row, self.table, self.faults.explanations))

    @property
    def _others_act(self) -> bool:
        """Whether an emergency stop or another program decides what the run shows of the unit.

        A master on the bus that moves the drives always does.
        """
        if self.plan["rig"]["drives"] == "bus":
            return True
        if self.bus is not None and self.bus.others_act:
            return True
        has_begun = bool(self.data.control[TICK])
        return has_begun and self.modbus_demand.emergency_stop

    def report_uncommanded(self) -> None:
        """Record which units have given no valid command in a run in real time.

        In lockstep a run without a command ends with an error.
        """
        awaits_commands = self.options.unit != "none" and self.options.pacing == "wall"
        was_long_enough = self.simulated_ns() >= SILENT_AFTER_S * clock.SECOND_NS
        if self.bus is not None and awaits_commands and was_long_enough:
            self.bus.report_uncommanded()

    def _check_master(self, bus: rig_bus.RigBus) -> None:
        """Record an event if no master on the bus has enabled the drives."""
        off = [node for node in self.table.drive_nodes if not bus.nodes[node].device.enabled]
        if off:
            self.event(Code.DRIVES_WITHOUT_MASTER, nodes=off)

    async def pause(self) -> None:
        """Yield to the bus between two batches of ticks, and wait for a recorder that is behind."""
        while self._recorder_is_behind() and self.processes.recording and not self.stopping:
            await asyncio.sleep(_RECORDER_WAIT_S)
        self.processes.watch_recorder()
        await asyncio.sleep(0)
        if time.monotonic() - self._reported_s > _REPORT_S:
            self.report()
            self._reported_s = time.monotonic()

    def _recorder_is_behind(self) -> bool:
        """Whether a ring is more than half full."""
        return any(one.room < one.header[ring.CAPACITY] // 2 for one in self.rings)

    # --- the bus ---

    async def open_bus(self, clock_ns: Callable[[], int]) -> rig_bus.RigBus:
        """Open the bus of the scenario with the rig on it, and return it. Raises BusError."""
        wall = self.options.pacing == "wall"
        self.hub, self.place = await rig_bus.open_bus(
            self.plan, clock_ns, self._lose_bus, self.event, wall, self._awaits_others
        )
        self.close_silent.append(self.hub.close_silent)
        rig_bus.record_frames(self.hub, self.frames, lambda: self.zero_ns)

        self.ports = await rig_bus.open_others(
            self.hub, self.place, self.plan, self.event, self._awaits_others
        )
        for protocol, port in self.ports.items():
            self.event(Code.BUS_PORT, protocol=protocol, port=port)

        mailbox.fetch(self.data.published, self.row)
        bus = rig_bus.RigBus(
            self.hub,
            self.plan,
            self.row.copy(),
            self._post,
            self.event,
            clock_ns,
            self.options.pacing,
            lambda row: mailbox.fetch(self.data.published, row),
            self.train_deceleration_m_s2,
        )
        bus.harness.wire(
            end=self._end_by_harness,
            fail=self._fail,
            inject=self._inject,
            lift=self._lift,
            joined=bus.seat_harness,
            left=bus.dismiss_harness,
        )
        bus.harness.configuration = self._configuration
        bus.has_unit = self.options.unit != "none"
        bus.own_unit = self.options.own_unit
        # an FMU answers when it has the pressures, the reference unit when it has the speeds
        if self.options.fmus:
            bus.await_pressures()
        self.faults.connect(bus.site(self.processes.freeze))
        self.bus = bus
        self.event(Code.BUS_PLACE, address=self.place)
        return bus

    async def await_accepting(self) -> None:
        """Wait until asyncio has tried again to accept clients; call it before a server closes.

        Without descriptors, asyncio tries again later. That fails if the server is closed by then.
        """
        rest_s = self.accepts_again_s - time.monotonic()
        if rest_s > 0.0:
            await asyncio.sleep(rest_s)

    @property
    def _awaits_others(self) -> bool:
        """Whether the run waits for an outside program on the bus: unit, harness or master."""
        has_outside_master = not self.plan["bus"]["master"] or self.plan["rig"]["drives"] == "bus"
        return self.options.unit == "external" or self.options.harness or has_outside_master

    def _post(self, command: np.ndarray) -> None:
        """Hand a command row of the bus to the tick, with the brake demand that counts."""
        command = command.copy()
        node_Pa = float(command[tick.DEMAND])
        self._note_set_points(node_Pa, command[tick.FRICTION : tick.SAND])
        command[tick.DEMAND] = brake_demand.decide(self.modbus_demand, node_Pa)
        mailbox.post(self.data.commands, command)

    def _note_set_points(self, demand_Pa: float, friction: np.ndarray) -> None:
        """Record what a master on the bus has changed; a harness records its commands itself."""
        both_none = math.isnan(demand_Pa) and math.isnan(self._demand_of_node_Pa)
        if demand_Pa != self._demand_of_node_Pa and not both_none:
            self._demand_of_node_Pa = demand_Pa
            if self._is_set_by_master:
                self.note_demand("node 17", demand_Pa)
        for at in np.flatnonzero(friction != self._friction_of_node).tolist():
            mu = float(friction[at])
            self._friction_of_node[at] = mu
            if self._is_set_by_master:
                axle = at + 1
                name = f"friction {axle}"
                if mu:
                    self.note_set_point(name, Code.SET_POINT_FRICTION, axle=axle, mu=mu)
                else:
                    self.note_set_point(name, Code.SET_POINT_FRICTION_NONE, axle=axle)

    @property
    def _is_set_by_master(self) -> bool:
        """Whether a change on the bus is not that of a harness."""
        return self.bus is not None and not self.bus.harness.joined

    def note_demand(self, source: str, pressure_Pa: float) -> None:
        """Record that a source has changed its brake demand in Pa; NaN: it has none any more."""
        name = f"brake demand by {source}"
        if math.isnan(pressure_Pa):
            self.note_set_point(name, Code.SET_POINT_BRAKE_DEMAND_NONE, source=source)
        else:
            self.note_set_point(
                name, Code.SET_POINT_BRAKE_DEMAND, source=source, pressure_Pa=pressure_Pa
            )

    def note_set_point(self, name: str, code: Code, **fields: Any) -> None:
        """Record that a set-point has changed, without an event for each step of a ramp."""
        self.set_points.change(name, self._bus_s(), code, **fields)

    def _bus_s(self) -> float:
        """Return the time of the bus, which goes on while a rig is held."""
        return self.bus.clock_ns() / clock.SECOND_NS if self.bus else 0.0

    def _lose_bus(self, error: RollerrigError) -> None:
        """End the run as a failure because the bus is gone; its record is kept."""
        self.failure = self.failure or error
        self.stop(Code.RUN_BUS_LOST)

    def _fail(self, reason: str) -> None:
        """End the run with an error from outside the loop, such as a gateway to the unit."""
        self.failure = self.failure or RollerrigError(reason)
        self._halt()

    def _end_by_harness(self) -> None:
        self.event(Code.RUN_ENDED_BY_HARNESS)
        self.data.control[DONE] = 1

    def _inject(self, text: str) -> None:
        fault = catalogue.parse(text, self.table.kind, "fault")
        at_s = max(fault.at_s, self.faults.now_s)
        self.faults.inject(fault.kind.name, at_s=at_s, for_s=fault.for_s, **fault.values)

    def _lift(self, text: str) -> None:
        """Lift the faults of a name, and of the parameters that the text gives."""
        name, *aims = text.split() or [""]
        if not aims:
            if name:  # an empty text lifts all faults
                catalogue.kind_of(name, self.table.kind, f"fault '{text}'")
            self.faults.clear(name)
            return
        given = {aim.partition("=")[0] for aim in aims}
        values = catalogue.parse(text, self.table.kind, "fault").values
        self.faults.clear(name, **{key: value for key, value in values.items() if key in given})

    # --- waiting for the unit and the harness ---

    def start_unit(self) -> None:
        """Start the unit of the bench, or report that another is awaited. Raises ConfigError."""
        if self.options.command:
            self.processes.start_command(self.place, max(self.car, 1))
        elif self.options.own_unit:
            self._start_own_unit()
        elif self.options.unit == "external":
            self._report_waiting(f"a WSP unit's heartbeat ({self._heartbeat_ids()})")

    async def await_unit(self, bus: rig_bus.RigBus) -> None:
        """Wait for the heartbeat of the unit, then for the harness and the recorder.

        Raises UnitError.
        """
        if self.options.unit != "none":
            await self._await_heartbeats(bus)
        if self.options.harness:
            await self._await_harness(bus)
        await self.processes.await_recorder(self.rows)

    def _start_own_unit(self) -> None:
        # only in real time does the unit need a real-time priority, and cores without the loop
        priority = 0
        loop_core = -1
        if self.options.pacing == "wall":
            priority = self.plan["loop"]["priority"]
            loop_core = self.real_time.core.number
        if priority:
            priority = max(int(loop.UNIT_SHARE * priority), 1)
        self.processes.start_unit(
            self.place,
            self.plan["wsp_config"],
            priority,
            loop_core,
            self.plan["bus"]["sync_period_s"],
            self.plan["bus"]["bitrate"],
            self.table.kind,
        )

    async def _await_heartbeats(self, bus: rig_bus.RigBus) -> None:
        """Wait until the unit is OPERATIONAL, or sends heartbeats without obeying NMT."""
        first_s: float | None = None

        def is_there() -> bool:
            nonlocal first_s
            units = bus.master.units
            all_heard = all(unit.state is not None for unit in units)
            if all_heard and first_s is None:
                first_s = time.monotonic()
            if all(unit.state == State.OPERATIONAL for unit in units):
                return True
            # a simple unit may not obey NMT; half a second is enough for a unit that does
            if first_s is None or bus.own_unit:
                return False
            return time.monotonic() > first_s + _UNIT_SETTLES_S

        try:
            await self._await(
                bus,
                is_there,
                lambda: (
                    f"no WSP unit on {self.place}: no heartbeat on "
                    f"{self._heartbeat_ids(_groups_without_unit(bus), described=True)}"
                ),
                lambda: (
                    f"{_instead_of_heartbeats(bus)}; "
                    f"{self._remedy_without_unit(_groups_without_unit(bus))}"
                ),
            )
        except _AbsentError as error:
            if self.options.harness:  # for the program that has started this bench
                silent = self._heartbeat_ids(_groups_without_unit(bus), described=True)
                waited_s = self.options.unit_wait_s
                absent = {
                    "no_heartbeat": silent,
                    "instead": _instead_of_heartbeats(bus),
                    "waited_s": waited_s,
                    "error": str(error),
                }
                self.report(json.dumps(absent))
            raise
        if not self.stopping:
            self.event(Code.UNIT_READY)
            await self._ask_for_identity(bus)

    async def _ask_for_identity(self, bus: rig_bus.RigBus) -> None:
        """Ask units that are not of this project for their identity, and wait a moment for it.

        Only the master of a bus uses the SDO channel of a node.
        """
        if self.options.own_unit or not self.plan["bus"]["master"]:
            return
        bus.identities.ask(self.table.wsp_nodes)
        deadline_s = time.monotonic() + _IDENTITY_S
        while bus.identities.open and time.monotonic() < deadline_s and not self.stopping:
            bus.poll()
            await asyncio.sleep(_POLL_S)
        found = bus.identities.finish()
        for identity in found:
            self.event(Code.UNIT_IDENTITY, **identity)
        self.unit_played = self.unit_played._replace(identity=found or None)

    async def _await_harness(self, bus: rig_bus.RigBus) -> None:
        self._report_waiting(f"a harness (node {signals.BENCH_NODE}, {HARNESS:X}h:{JOINED})")
        await self._await(
            bus,
            lambda: bus.harness.joined,
            lambda: f"no harness on {self.place}",
            lambda: (
                f"start one ('rollerrig sequence ... --bus {shlex.quote(self.place)}') or run "
                "without --harness"
            ),
        )

    def _remedy_without_unit(self, groups: list[int]) -> str:
        """Return what helps if no unit of some groups has appeared, as the end of a message."""
        if not self.options.command:
            command = f"rollerrig wsp --bus {shlex.quote(self.place)}"
            kind = self.table.kind
            if kind != COACH:
                command += f" --axles {kind.axles}"
            if kind.dynamic_brake:
                command += " --dynamic-brake"
            if kind.groups == 1:
                return f"start one ('{command}') or wait longer with --wait"
            starts = [f"'{command} --group {group + 1}'" for group in groups]
            return f"start a unit for each ({', '.join(starts)}) or wait longer with --wait"
        return (
            f"correct the unit '{self.options.command}', or wait longer with --wait"
            f"{self.processes.unit_words()}"
        )

    def _heartbeat_ids(self, groups: Iterable[int] | None = None, described: bool = False) -> str:
        """Return the identifiers of the heartbeats of units, as in "720h and 740h".

        They are those of some groups, or of all. `described`: with the group and its axles, as in
        "740h (group 2, axles 5 to 6)", where the vehicle has several.
        """
        words = []
        number = self.table.kind.groups
        for group in range(number) if groups is None else groups:
            word = f"{unit_frames(self.table, group).heartbeat_id:X}h"
            if described and number > 1:
                axles = self.table.axles_of(group)
                word += f" (group {group + 1}, axles {axles[0]} to {axles[-1]})"
            words.append(word)
        return " and ".join(words)

    def _report_waiting(self, awaited: str) -> None:
        self.report(f"waiting for {awaited} on {self.place} ...")
        if self.options.harness:  # for the program that has started this bench
            self.report(json.dumps({"waiting_for": awaited, "address": self.place}))

    async def _await(
        self,
        bus: rig_bus.RigBus,
        is_there: Callable[[], bool],
        missing: Callable[[], str],
        remedy: Callable[[], str],
    ) -> None:
        """Poll the bus until `is_there()`. Raises _AbsentError when the time for it is over."""
        starting = bus.own_unit and any(unit.state is None for unit in bus.master.units)
        patience = _OWN_UNIT_PATIENCE if starting else 1
        deadline_s = time.monotonic() + patience * self.options.unit_wait_s
        while not self.stopping:
            bus.poll()
            if is_there():
                return
            if time.monotonic() > deadline_s:
                raise _AbsentError(f"{missing()} within {self.options.unit_wait_s:g} s; {remedy()}")
            self.processes.watch(starting=True)
            await asyncio.sleep(_POLL_S)


class _AbsentError(UnitError):
    """A unit or a harness did not come in time."""


def _groups_without_unit(bus: rig_bus.RigBus) -> list[int]:
    """Return the groups (from 0) whose unit has sent no heartbeat; all groups if each has."""
    silent = [group for group, unit in enumerate(bus.master.units) if unit.state is None]
    return silent or list(range(len(bus.master.units)))


def _instead_of_heartbeats(bus: rig_bus.RigBus) -> str:
    """Return what has come in place of the awaited heartbeats, as a part of a message."""
    frames = (bus.seats[group].frames for group in _groups_without_unit(bus))
    return bus.what_came_instead([one.heartbeat_id for one in frames])
