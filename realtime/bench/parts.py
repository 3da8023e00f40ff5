"""What the pacings of a run share: scenario, tick data, rings, bus and faults, and what all of them do.

The bench builds it, hands it to one pacing and closes it. `data` and `plan` change when a held rig is given another
scenario. Clocks: `simulated_ns` counts ticks, `elapsed_ns` the time since the real-time thread began.
"""

import asyncio
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rollerrig.configs.errors import RollerrigError, UnitError
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.faults import catalogue, panel
from rollerrig.firmware_sim.modbus.access import Counters
from rollerrig.realtime.bench import derailment, rig_bus, scenario, tick_data
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.processes import Processes
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, loop, mailbox, ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.loop.tick import DONE, MISSED, STALLED_NS, STOP, TICK
from rollerrig.realtime.record.events import Events
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import (
    HARNESS,
    JOINED,
    PRESSURES,
    SPEEDS,
    UNIT_HEARTBEAT_ID,
)

_ROWS, _FRAMES, _EVENTS = 1 << 14, 1 << 17, 1 << 14
_REPORT_S = 0.5
# how a run ended early, as its summary has it
ENDED_BY = {
    Code.RUN_INTERRUPTED: "interrupted",
    Code.RUN_STOPPED: "stopped over Modbus",
    Code.RUN_DERAILED: "derailed",
    Code.RUN_BUS_LOST: "ended: its bus is lost",
}


class Parts:
    """One run. `say` is called with a `Progress` now and then; `ended_by` is "" as long as nobody ended it."""

    def __init__(self, plan: Scenario, options: Options, say: Callable[[Progress], None]) -> None:
        self.plan, self.options, self.say = plan, options, say
        self.events = Events()
        self.ended_by, self.place = "", ""
        self.failure: RollerrigError | None = None
        self.histogram = np.zeros(loop.BINS, dtype=np.int64)
        self.interruptions: dict[str, int] = {}
        # when the real-time thread began, by CLOCK_MONOTONIC; 0: it has not
        self.begun_ns = 0
        # when the run began, by the clock of the bus; -1: it has not, the rig is held
        self.zero_ns = 0
        # a held rig: the scenario that it is given, and the speed at which it rolls (then: began)
        self.next_plan: Scenario | None = None
        self.speed_m_s = float(plan["initial_speed_m_s"])
        self.hub: Hub | None = None
        self.bus: rig_bus.RigBus | None = None
        self.ports: dict[str, int] = {}
        self.modbus = Counters()
        # changes a row of commands on its way from the bus to the tick
        self.govern: Callable[[np.ndarray], None] = lambda command: None
        self.faults = panel.Panel(plan.faults, self.event)
        self.derailment = derailment.Watch(self.event, lambda: self.stop(Code.RUN_DERAILED))
        self.processes = Processes(options, self.event)
        self.rows = Ring(ring.place("rows"), np.float64, _ROWS, len(signals.COLUMNS))
        self.frames = Ring(ring.place("frames"), np.int64, _FRAMES, ring.FRAME_WORDS)
        self.event_ring = Ring(ring.place("events"), np.int64, _EVENTS, ring.EVENT_WORDS)
        # what the recorder reads
        self.rings = self.rows, self.frames, self.event_ring
        self.data = tick_data.build(plan, self.rows, seed=options.seed)
        self.row = self.data.row.copy()
        self._reported_s = self._stalled_s = 0.0
        # a master on the bus shall move the drives, and has not been looked for
        self._master_awaited = plan["rig"]["drives"] == "bus"

    def identity(self) -> dict[str, Any]:
        """What a summary says of a run before it has begun."""
        return {
            "pacing": self.options.pacing,
            "seed": self.options.seed,
            "unit": self.options.unit,
            "config_hash": scenario.digest(self.plan),
            "scenario": self.plan.name,
        }

    # --- what happens ---

    def event(self, code: Code, /, **fields: Any) -> None:
        """Record an event at the present simulated time."""
        time_s = int(self.data.control[TICK]) / self.plan["loop"]["tick_hz"]
        event = events.make(time_s, code, **fields)
        self.events.add(event)
        ring.push_event(self.event_ring, event)
        if event.level != events.INFO:
            self.report(f"{time_s:.3f} s: {event.level}: {event.text}")

    def report(self, message: str = "") -> None:
        """Say how far the run is."""
        mailbox.fetch(self.data.published, self.row)
        time_s, speed_m_s = (
            float(self.row[signals.column(name)]) for name in ("time", "vehicle_speed")
        )
        self.say(
            Progress(
                time_s,
                speed_m_s,
                float(self.row[signals.span("sliding")].max()),
                int(self.data.control[MISSED]),
                message,
            )
        )

    def stop(self, code: Code, /, **fields: Any) -> None:
        """End the run at the next tick; `code` is one of `ENDED_BY`."""
        if not self.ended_by:
            self.ended_by = ENDED_BY[code]
            self.event(code, **fields)
        self.data.control[STOP] = 1
        if self.bus:
            self.bus.answered.set()
            self.bus.harness_answered.set()

    def tell_stall(self) -> None:
        """Say where the loop has stood still since it was last asked: the two clocks of a record part there."""
        stalled_s = int(self.data.control[STALLED_NS]) / clock.SECOND_NS
        if stalled_s > self._stalled_s:
            self.event(Code.LOOP_STALLED, stalled_s=stalled_s - self._stalled_s, ahead_s=stalled_s)
            self._stalled_s = stalled_s

    @property
    def stopping(self) -> bool:
        """Whether no further tick shall be run."""
        return bool(self.data.control[STOP] or self.data.control[DONE])

    def simulated_ns(self) -> int:
        """Simulated time by the ticks that have been run."""
        return int(self.data.control[TICK]) * (clock.SECOND_NS // self.plan["loop"]["tick_hz"])

    def elapsed_ns(self) -> int:
        """Wall time since the real-time thread began; 0 before."""
        return time.monotonic_ns() - self.begun_ns if self.begun_ns else 0

    def poll_faults(self) -> None:
        """Begin and lift faults that are due, and see whether the coach has derailed and drives have their master."""
        self.faults.poll(self.simulated_ns() / clock.SECOND_NS)
        self.derailment.look(self.data.buffer)
        if self._master_awaited and self.simulated_ns() >= clock.SECOND_NS and self.bus:
            self._master_awaited = False
            off = [node for node in signals.DRIVE_NODES if not self.bus.nodes[node].device.enabled]
            if off:
                self.event(Code.DRIVES_WITHOUT_MASTER, nodes=off)

    async def pause(self) -> None:
        """Between two batches of ticks: yield to the bus, and to a recorder that is half a ring behind."""
        while (
            any(one.room < one.header[ring.CAPACITY] // 2 for one in self.rings)
            and self.processes.recording
            and not self.stopping
        ):
            await asyncio.sleep(0.005)
        self.processes.watch_recorder()
        await asyncio.sleep(0)
        if time.monotonic() - self._reported_s > _REPORT_S:
            self.report()
            self._reported_s = time.monotonic()

    # --- the bus ---

    async def open_bus(self, clock_ns: Callable[[], int]) -> rig_bus.RigBus:
        """Open the scenario's bus with the rig on it. Raises BusError."""
        self.hub, self.place = await rig_bus.open_bus(
            self.plan, clock_ns, self._lost_bus, self.event, self.options.pacing == "wall"
        )
        rig_bus.record_frames(self.hub, self.frames, lambda: self.zero_ns)
        self.ports = await rig_bus.open_others(self.hub, self.place, self.plan)
        for codec, port in self.ports.items():
            self.event(Code.BUS_PORT, protocol=codec, port=port)
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
        )
        bus.harness.wire(
            end=self._end_run, inject=self._inject, lift=self._lift, left=bus.harness_answered.set
        )
        bus.own_unit = self.options.own_unit
        bus.awaited = PRESSURES.can_id if self.options.fmus else SPEEDS.can_id
        self.faults.connect(bus.site(self.processes.freeze))
        self.bus = bus
        self.event(Code.BUS_PLACE, address=self.place)
        return bus

    def _post(self, command: np.ndarray) -> None:
        """Hand what the bus asks of the rig to the tick."""
        command = command.copy()
        self.govern(command)
        mailbox.post(self.data.commands, command)

    def _lost_bus(self, error: RollerrigError) -> None:
        """The bus is gone: the run ends here, as a failure, and its record is kept."""
        self.failure = self.failure or error
        self.stop(Code.RUN_BUS_LOST)

    def _end_run(self) -> None:
        self.event(Code.RUN_ENDED_BY_HARNESS)
        self.data.control[DONE] = 1

    def _inject(self, text: str) -> None:
        fault = catalogue.parse(text)
        self.faults.inject(fault.kind.name, for_s=fault.for_s, **fault.values)

    def _lift(self, text: str) -> None:
        name, *aims = text.split() or [""]
        named = {one.partition("=")[0] for one in aims}
        values = catalogue.parse(text).values if aims else {}
        self.faults.clear(name, **{key: value for key, value in values.items() if key in named})

    async def await_unit(self, bus: rig_bus.RigBus) -> None:
        """Start the bench's own unit, or wait for anybody's heartbeat, then for a harness. Raises UnitError."""
        if self.options.own_unit:
            priority = self.plan["loop"]["priority"] if self.options.pacing == "wall" else 0
            self.processes.start_unit(
                self.place,
                self.plan["wsp_config"],
                priority and max(int(loop.UNIT_SHARE * priority), 1),
                self.plan["bus"]["sync_period_s"],
                self.plan["bus"]["bitrate"],
            )
        elif self.options.unit == "external":
            self._say_waiting(f"a WSP unit's heartbeat ({UNIT_HEARTBEAT_ID:X}h)")
        if self.options.unit != "none":
            heard_s: list[float] = []

            def there() -> bool:
                if bus.master.unit.state is not None:
                    heard_s.append(time.monotonic())
                # a simple unit may not obey NMT; half a second is enough for one that does
                longer = bool(heard_s) and not bus.own_unit and heard_s[-1] > heard_s[0] + 0.5
                return longer or bus.master.unit.state == State.OPERATIONAL

            await self._await(
                bus,
                there,
                f"no WSP unit on {self.place}: no heartbeat on {UNIT_HEARTBEAT_ID:X}h",
                f"start one ('rollerrig wsp --bus {self.place}') or wait longer with --wait",
            )
            if not self.stopping:
                self.event(Code.UNIT_READY)
        if self.options.harness:
            self._say_waiting(f"a harness (node {signals.BENCH_NODE}, {HARNESS:X}h:{JOINED})")
            await self._await(
                bus,
                lambda: bus.harness.joined,
                f"no harness on {self.place}",
                f"start one ('rollerrig sequence ... --bus {self.place}') or run without --harness",
            )
        await self.processes.await_recorder(self.rows)

    def _say_waiting(self, what: str) -> None:
        self.report(f"waiting for {what} on {self.place} ...")
        if self.options.harness:  # for the program that has started this bench
            self.report(json.dumps({"waiting_for": what, "address": self.place}))

    async def _await(
        self, bus: rig_bus.RigBus, there: Callable[[], bool], missing: str, mend: str
    ) -> None:
        # the bench's own unit, whose process lives, may come late on a busy machine
        patience = 10 if bus.own_unit and bus.master.unit.state is None else 1
        deadline_s = time.monotonic() + patience * self.options.unit_wait_s
        while not self.stopping:
            bus.poll()
            if there():
                return
            if time.monotonic() > deadline_s:
                raise UnitError(f"{missing} within {self.options.unit_wait_s:g} s; {mend}")
            self.processes.watch(starting=True)
            await asyncio.sleep(0.005)
