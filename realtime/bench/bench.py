"""The bench: composition root of a run, from a scenario to a folder with its record.

It builds plant, loop, bus, recorder and unit, runs one of the three pacings, and closes everything
in order whatever happens: the record of a run that failed, was interrupted or killed is kept.
"""

import asyncio
import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from rollerrig.configs.errors import ConfigError, RollerrigError, UnitError
from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.faults import catalogue, panel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import derailment, rig_bus, scenario, supervisor, wire_delay
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, loop, mailbox, tick
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop.held_rig import HOLDING
from rollerrig.realtime.loop.tick import (
    COMMANDS,
    DONE,
    HELD,
    HOLD,
    MISSED,
    SLOTS_OF_CONTROL,
    STOP,
    TICK,
    WORST_NS,
    Machine,
)
from rollerrig.realtime.record import channels, records, summary
from rollerrig.realtime.telemetry import recording
from rollerrig.rig.plant import Plant
from rollerrig.wsp_interface import signals

PACINGS = ("wall", "lockstep", "free")
UNITS = ("reference", "external", "none")
ANSWER_TIMEOUT_S = 1.0
HARNESS_TIMEOUT_S = 60.0
LINGER_S = 1.0
_ROWS, _FRAMES, _EVENTS = 1 << 14, 1 << 17, 1 << 12
_FREE_TICKS = 500
_EXCEPTIONS_TOLD = 20
_RECORD_FILES = ("scenario.toml", "channels.parquet", "run.rrd", "can.log", "events.jsonl",
                 "summary.json", "wsp.log")


class Options(NamedTuple):
    """How a run is run; the scenario says what."""

    pacing: str = "wall"
    unit: str = "reference"
    out: Path = Path("runs/run")
    live: bool = False
    strict: bool = False
    seed: int = 0
    unit_wait_s: float = 60.0
    start: str = "now"
    harness: bool = False


class Progress(NamedTuple):
    """What the progress line shows."""

    time_s: float
    speed_m_s: float
    sliding_m_s: float
    missed: int
    message: str = ""


class Bench:
    """One run. `say` is called with a `Progress` now and then."""

    def __init__(self, plan: Scenario, options: Options, say: Callable[[Progress], None]) -> None:
        check_options(options)
        self.plan, self.options, self.say = plan, options, say
        self.events: list[dict[str, Any]] = []
        self.histogram = np.zeros(loop.BINS, dtype=np.int64)
        self.ended_by = ""
        self.unit_exit: int | None = None
        self._unrecorded = False
        self._failure: RollerrigError | None = None
        self._exceptions: set[str] = set()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._begun_ns = 0
        self.bus: rig_bus.RigBus | None = None
        self.hub: Any = None
        self.supervisor: supervisor.Supervisor | None = None
        self.next_plan: Scenario | None = None
        self.ports: dict[str, int] = {}
        self._zero_ns = 0
        supervisor.check(plan, options.pacing, options.start)
        panel.check_pacing(plan.faults, options.pacing)
        wire_delay.check(plan, options.pacing)
        self.faults = panel.Panel(plan.faults, self.event)
        self.derailment = derailment.Watch(self.event, self.stop)
        if options.unit == "reference":
            logic.load(plan["wsp_config"])
        prepare_folder(options.out)
        (options.out / "scenario.toml").write_text(scenario.dump(plan), encoding="utf-8")
        rings.sweep()
        self.rows = rings.Ring(rings.place("rows"), np.float64, _ROWS, len(signals.COLUMNS))
        self.frames = rings.Ring(rings.place("frames"), np.int64, _FRAMES, rings.FRAME_WORDS)
        self.event_ring = rings.Ring(rings.place("events"), np.int64, _EVENTS, rings.EVENT_WORDS)
        self.machine = build_machine(plan, self.rows, seed=options.seed)
        self.row = self.machine.row.copy()

    # --- what happened ---

    def event(self, level: str, text: str) -> None:
        """Record an event at the present simulated time."""
        time_s = int(self.machine.control[TICK]) / self.plan["loop"]["tick_hz"]
        self.events.append({"time_s": time_s, "level": level, "text": text})
        rings.push_event(self.event_ring, time_s, level, text)
        if level != "info":
            self.report(f"{time_s:.3f} s: {level}: {text}")

    def report(self, message: str = "") -> None:
        """Tell how far the run is."""
        mailbox.fetch(self.machine.published, self.row)
        row = self.row
        self.say(Progress(row[signals.column("time")], row[signals.column("vehicle_speed")],
                          float(row[signals.span("sliding")].max()),
                          int(self.machine.control[MISSED]), message))

    # --- the run ---

    async def run(self) -> dict[str, Any]:
        """Run to the end and return the summary. Raises RollerrigError after closing the record."""
        failure: RollerrigError | None = None
        running = asyncio.get_running_loop()
        running.set_exception_handler(self._note_exception)
        for signum in (signal.SIGINT, signal.SIGTERM):
            running.add_signal_handler(signum, self.stop, "interrupted")
        try:
            await self._start_recorder()
            warm_up(self.machine, self.options.pacing, self.options.unit)
            await getattr(self, f"_run_{self.options.pacing}")()
            if self._failure:
                raise self._failure
        except RollerrigError as error:
            failure = error
            self.ended_by = "error"
            self.event("error", str(error))
        finally:
            self.machine.control[STOP] = 1
            result = await self._finish()
            for signum in (signal.SIGINT, signal.SIGTERM):
                running.remove_signal_handler(signum)
        if failure:
            raise failure
        return result

    def stop(self, why: str) -> None:
        """End the run at the next tick."""
        if not self.ended_by:
            self.ended_by = why
            self.event("warning", f"the run is {why}")
        self.machine.control[STOP] = 1
        if self.bus:
            self.bus.answered.set()

    @property
    def stopping(self) -> bool:
        control = self.machine.control
        return bool(control[STOP] or control[DONE])

    async def _run_free(self) -> None:
        unit = logic.new_unit(logic.load(self.plan["wsp_config"])) if self.options.unit == "reference" else None
        inputs = np.zeros(2 * tick.AXLES, dtype=np.int64)
        said = time.monotonic()
        self.faults.connect(panel.Site(self.machine.commands.values[tick.FAULTS:],
                                             lambda: None))
        while not self.stopping:
            ticks = self._poll_faults()
            if unit is None:
                tick.batch(self.machine, ticks)
            else:
                tick.batch_with_unit(self.machine, ticks, self.plan.sync_ticks, unit, inputs)
            await self._make_room()
            if time.monotonic() - said > 0.5:
                self.report()
                said = time.monotonic()

    async def _run_lockstep(self) -> None:
        await self._open_bus(lambda: self._simulated_ns())
        assert self.bus
        await self._await_unit()
        await self._await_joining()
        self.bus.start_wire(timed=False)
        said = time.monotonic()
        while not self.stopping:
            mailbox.fetch(self.machine.published, self.bus.row)
            frozen = self.bus.frozen
            self._poll_faults()
            if frozen and not self.bus.frozen:
                await self._catch_up()
            self.bus.sync()
            self.bus.poll()
            if self.hub.wire is None:
                await self._await_answers()
                tick.batch(self.machine, self.plan.sync_ticks)
            else:
                await self._cycle_on_wire()
            await self._make_room()
            if time.monotonic() - said > 0.5:
                self.report()
                said = time.monotonic()

    async def _await_answers(self) -> None:
        """Let unit and harness answer this SYNC; simulated time stands still meanwhile."""
        assert self.bus
        if self.options.unit != "none" and not self.bus.frozen:
            await self._await_answer()
        else:
            await asyncio.sleep(0)
        if self.bus.harness.joined:
            await self._await_harness()

    async def _cycle_on_wire(self) -> None:
        """A bus cycle whose frames take their time: ticks go on while the wire carries them.

        The answers count as ready when all that the SYNC has set off is through, or at the end of a
        cycle in which the wire never falls silent.
        """
        asked = False
        for _ in range(self.plan.sync_ticks):
            self.hub.advance(self._simulated_ns())
            if not asked and not self.hub.wire:
                asked = True
                await self._in_standstill()
            tick.batch(self.machine, 1)
        self.hub.advance(self._simulated_ns())
        if not asked and not self.stopping:
            await self._in_standstill()

    async def _in_standstill(self) -> None:
        self.hub.still = True
        try:
            await self._await_answers()
        finally:
            self.hub.still = False

    async def _run_wall(self) -> None:
        await self._open_bus(self._elapsed_ns)
        assert self.bus
        await self._open_modbus()
        await self._await_unit()
        await self._await_joining()
        descriptor, woken = clock.eventfd(), asyncio.Event()
        running = asyncio.get_running_loop()
        bus = self.bus

        def on_tick() -> None:
            os.read(descriptor, 8)
            mailbox.fetch(self.machine.published, bus.row)
            if self._zero_ns < 0 and self.machine.control[TICK]:
                self._zero_ns = self._elapsed_ns() - self._simulated_ns()
            if self.stopping:
                woken.set()
            else:
                bus.start_wire(timed=True)
                self._poll_faults()
                bus.sync()
            bus.poll()

        running.add_reader(descriptor, on_tick)
        loop.prefer_bus_thread(self.plan["loop"]["priority"])
        try:
            await self._run_thread(descriptor, woken)
            while self.next_plan and not self.ended_by:
                self._take_scenario(self.next_plan)
                await self._run_thread(descriptor, woken)
            if self.options.start == "modbus" and not self.ended_by:
                # a client that polls sees the run end before the connection does
                await asyncio.sleep(LINGER_S)
        finally:
            loop.prefer_bus_thread(0)
            running.remove_reader(descriptor)
            os.close(descriptor)

    async def _run_thread(self, descriptor: int, woken: asyncio.Event) -> None:
        """Run the real-time thread until the run is done, stopped or given another scenario."""
        running = asyncio.get_running_loop()
        woken.clear()
        thread = threading.Thread(target=self._real_time, args=(descriptor,), name="real-time")
        thread.start()
        try:
            while not woken.is_set() and thread.is_alive():
                self.report()
                self._watch_processes()
                try:
                    await asyncio.wait_for(woken.wait(), 0.5)
                except TimeoutError:
                    continue
        finally:
            self.machine.control[STOP] = 1
            await running.run_in_executor(None, thread.join)

    def _real_time(self, descriptor: int) -> None:
        rates = self.plan["loop"]
        for refused in loop.ask_for_priority(rates["priority"], rates["cpu"]):
            self.event("info", f"the real-time thread was refused {refused}")
        # locking memory may take a second: the clock starts after it
        begin_ns = clock.monotonic_ns()
        self._begun_ns = self._begun_ns or begin_ns
        with clock.awake(rates["priority"] > 0):
            loop.wall(self.machine, clock.SECOND_NS // rates["tick_hz"], self.plan.sync_ticks,
                      descriptor, self.histogram, np.zeros(3, dtype=np.int64), begin_ns)

    # --- clocks of the bus ---

    def _simulated_ns(self) -> int:
        return int(self.machine.control[TICK]) * (clock.SECOND_NS // self.plan["loop"]["tick_hz"])

    def _elapsed_ns(self) -> int:
        return clock.monotonic_ns() - self._begun_ns if self._begun_ns else 0

    # --- parts ---

    async def _open_bus(self, clock_ns: Callable[[], int]) -> None:
        self.hub, self.place = await rig_bus.open_bus(self.plan, clock_ns, self._lost_bus)
        rig_bus.record_frames(self.hub, self.frames, lambda: self._zero_ns)
        self.ports = await rig_bus.open_others(self.hub, self.plan)
        for codec, port in self.ports.items():
            self.event("info", f"the bus speaks {codec} on port {port}")
        mailbox.fetch(self.machine.published, self.row)
        self.bus = rig_bus.RigBus(self.hub, self.plan, self.row.copy(), self.post, self.event,
                                  clock_ns, self.options.pacing)
        self.bus.harness.wire(end=self._end_run, inject=self._inject, lift=self._lift,
                              left=self.bus.harness_answered.set)
        self.faults.connect(self.bus.site(self._freeze))
        self.event("info", f"the rig is on the bus {self.place}")

    def post(self) -> None:
        """Hand what bus and Modbus ask of the rig to the tick."""
        if self.bus:
            command = self.bus.command
            if self.supervisor:
                command = command.copy()
                self.supervisor.govern(command)
            mailbox.post(self.machine.commands, command)

    def _poll_faults(self) -> int:
        """Begin and lift what is due; how many ticks a batch may have until something is again."""
        self.faults.poll(self._simulated_ns() / clock.SECOND_NS)
        self.derailment.look(self.machine.buffer)
        rest_s = self.faults.next_change_s() - self.faults.now_s
        return max(1, min(_FREE_TICKS, round(min(rest_s, 3600.0) * self.plan["loop"]["tick_hz"])))

    def _freeze(self, on: bool) -> bool:
        """Stop the reference unit's process, or let it go on; False where there is none."""
        process = getattr(self, "unit_process", None)
        if process is None or process.poll() is not None:
            return False
        process.send_signal(signal.SIGSTOP if on else signal.SIGCONT)
        return True

    async def _open_modbus(self) -> None:
        if not self.plan["modbus"]["enabled"]:
            return
        held = self.options.start == "modbus"
        self.supervisor = supervisor.Supervisor(self)
        if held:
            self._hold(self.supervisor)
        await self.supervisor.open(needed=held)

    def _hold(self, plc: supervisor.Supervisor) -> None:
        self.machine.control[HOLD] = HOLDING
        self._zero_ns = -1
        plc.roll()

    def change_scenario(self, plan: Scenario) -> None:
        """Let a held rig go on with another scenario, at the speed that it has."""
        self.next_plan = plan
        self.machine.control[STOP] = 1

    def _take_scenario(self, plan: Scenario) -> None:
        assert self.supervisor
        before, self.plan, self.next_plan = self.machine, plan, None
        self.faults.schedule(plan.faults)
        self.machine = build_machine(plan, self.rows, float(before.state.vehicle_speed[0]),
                                     self.options.seed)
        self.machine.control[HELD] = before.control[HELD]
        for name in ("wheel_angle", "roller_angle"):
            getattr(self.machine.state, name)[:] = getattr(before.state, name)
            getattr(self.machine.roller_state, name)[:] = getattr(before.roller_state, name)
        self.machine.pulses[:] = before.pulses
        self._hold(self.supervisor)
        self.post()

    def _lost_bus(self, error: RollerrigError) -> None:
        """The bus is gone: the run ends here, as a failure, and its record is kept."""
        self._failure = self._failure or error
        self.stop("ended: its bus is lost")

    def _note_exception(self, running: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What fails inside the bus thread is told and recorded, and harms only who failed."""
        text = f"{context.get('message', 'bus thread')}: {context.get('exception')!r}"
        if text not in self._exceptions and len(self._exceptions) < _EXCEPTIONS_TOLD:
            self._exceptions.add(text)
            self.event("error", text)
            running.default_exception_handler(context)

    async def _await_unit(self) -> None:
        """Start the reference unit, or wait for anybody's heartbeat."""
        assert self.bus
        if self.options.unit == "none":
            return
        if self.options.unit == "reference":
            self._start_unit()
        else:
            self.report(f"waiting for a WSP unit's heartbeat (720h) on {self.place} ...")
        deadline = time.monotonic() + self.options.unit_wait_s
        heard = 0.0
        while not self.stopping:
            self.bus.poll()
            state = self.bus.master.unit.state
            now = time.monotonic()
            if state is not None:
                heard = heard or now
                # a simple unit may not obey NMT; half a second is enough for one that does
                if state == State.OPERATIONAL or now > heard + 0.5:
                    self.event("info", "the WSP unit is on the bus")
                    return
            if now > deadline:
                raise UnitError(
                    f"no WSP unit on {self.place}: no heartbeat on 720h within "
                    f"{self.options.unit_wait_s:g} s; start one ('rollerrig wsp --bus {self.place}') "
                    "or wait longer with --wait")
            self._watch_processes(starting=True)
            await asyncio.sleep(0.005)

    async def _await_joining(self) -> None:
        """With --harness the run begins when one has joined."""
        assert self.bus
        if not self.options.harness:
            return
        self.report(f"waiting for a harness (node {signals.BENCH_NODE}, 2000h:1) on {self.place} ...")
        deadline = time.monotonic() + self.options.unit_wait_s
        while not self.stopping and not self.bus.harness.joined:
            self.bus.poll()
            if time.monotonic() > deadline:
                raise UnitError(f"no harness on {self.place} within {self.options.unit_wait_s:g} s; "
                                "start one ('rollerrig sequence ... --bus "
                                f"{self.place}') or run without --harness")
            self._watch_processes(starting=True)
            await asyncio.sleep(0.005)

    async def _await_harness(self) -> None:
        assert self.bus
        try:
            await asyncio.wait_for(self.bus.harness_answered.wait(), HARNESS_TIMEOUT_S)
        except TimeoutError:
            raise UnitError(
                f"the harness has not answered SYNC within {HARNESS_TIMEOUT_S:g} s at "
                f"{self._simulated_ns() / 1e9:.3f} s: in lockstep one that has joined sends RPDO1 of "
                f"node {signals.BENCH_NODE} (27Fh) in every cycle, or leaves (2000h:1 = 0)") from None

    def _end_run(self) -> None:
        """The harness has seen enough."""
        self.event("info", "the harness ends the run")
        self.machine.control[DONE] = 1

    def _inject(self, text: str) -> None:
        fault = catalogue.parse(text)
        self.faults.inject(fault.kind.name, for_s=fault.for_s, **fault.values)

    def _lift(self, text: str) -> None:
        name, *aims = text.split() or [""]
        aim = catalogue.parse(text).values if aims else {}
        self.faults.clear(name, **{key: value for key, value in aim.items()
                                   if any(one.startswith(f"{key}=") for one in aims)})

    async def _await_answer(self) -> None:
        assert self.bus
        try:
            await asyncio.wait_for(self.bus.answered.wait(), ANSWER_TIMEOUT_S)
        except TimeoutError:
            self._watch_processes(starting=True)
            raise UnitError(
                f"the WSP unit has not answered SYNC within {ANSWER_TIMEOUT_S:g} s at "
                f"{self._simulated_ns() / 1e9:.3f} s: in lockstep a unit answers every SYNC with "
                f"RPDO1 of node {signals.BRAKE_NODE} (211h), changed or not") from None

    async def _catch_up(self) -> None:
        """Let a unit that was frozen answer what it has slept through; no time passes meanwhile."""
        assert self.bus
        while owed := self.bus.owed:
            try:
                await asyncio.wait_for(self.bus.answered.wait(), ANSWER_TIMEOUT_S)
            except TimeoutError:
                if self.bus.owed == owed:
                    self.event("warning", f"the WSP unit has left {owed} SYNCs unanswered")
                    return

    def _start_unit(self) -> None:
        command = [sys.executable, "-m", "rollerrig.realtime.cli", "wsp", "--bus", self.place,
                   "--config", self.plan["wsp_config"]]
        with open(self.options.out / "wsp.log", "wb") as log:
            self.unit_process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log,
                                                 stderr=log, start_new_session=True)
        self._processes.append(self.unit_process)

    def _watch_recorder(self) -> None:
        if self.recorder.poll() is not None and not self._unrecorded:
            self._unrecorded = True
            self.event("error", f"the recorder has ended with status {self.recorder.returncode}; the "
                       "run goes on, its record ends about here")

    def _watch_processes(self, starting: bool = False) -> None:
        self._watch_recorder()
        process = getattr(self, "unit_process", None)
        if process is None or self.unit_exit is not None or process.poll() is None:
            return
        self.unit_exit = process.returncode
        text = (f"the reference WSP unit has ended with status {process.returncode}; its last words "
                f"stand in {self.options.out / 'wsp.log'}")
        if starting:
            raise UnitError(text)
        self.event("error", text)

    def _identity(self) -> dict[str, Any]:
        """What a summary says of a run before it has begun."""
        return {"pacing": self.options.pacing, "seed": self.options.seed, "unit": self.options.unit,
                "config_hash": scenario.digest(self.plan), "scenario": self.plan.name}

    async def _start_recorder(self) -> None:
        self.recorder = recording.start(self.options.out, self.rows, self.frames, self.event_ring,
                                       self._identity())
        self._processes.append(self.recorder)
        ready = await asyncio.get_running_loop().run_in_executor(
            None, recording.wait_ready, self.recorder, self.rows)
        if not ready:
            raise RollerrigError("the recorder did not start; its message stands above")
        if self.options.live:
            from rollerrig.realtime.telemetry import live

            self._processes.append(live.start(self.options.out, self.rows, self.event_ring))

    async def _make_room(self) -> None:
        """Wait for the recorder while it is more than half a ring behind; yield to the bus."""
        header = self.rows.header
        while (header[rings.WRITTEN] - header[rings.READ] > _ROWS // 2
               and self.recorder.poll() is None and not self.stopping):
            await asyncio.sleep(0.005)
        self._watch_recorder()
        await asyncio.sleep(0)

    # --- the end ---

    async def _finish(self) -> dict[str, Any]:
        """Close bus, unit and recorder, and write the summary."""
        self.derailment.look(self.machine.buffer)
        bus_counts = self._bus_counts()
        requests = self.supervisor.counters.requests if self.supervisor else 0
        if self.supervisor:
            await self.supervisor.close()
        self._note_start()
        if self.hub is not None:
            await self.hub.close()
        unit = getattr(self, "unit_process", None)
        if unit is not None:
            self._freeze(False)  # a stopped process would not hear that it shall end
            await self._end(unit, 2.0)
        for ring in (self.rows, self.frames, self.event_ring):
            ring.close()
        await self._end(self.recorder, 30.0, ask=False)
        for process in self._processes:
            if process.poll() is None:
                process.terminate()
        for ring in (self.rows, self.frames, self.event_ring):
            ring.unlink()
        control = self.machine.control
        lost = sum(int(ring.header[rings.LOST]) for ring in (self.rows, self.frames, self.event_ring))
        counters = self._identity() | {
            "ended": self.ended_by or "finished",
            "loop": {"ticks": int(control[TICK]), "missed": int(control[MISSED]),
                     "lateness_us": loop.percentiles(self.histogram, int(control[WORST_NS]))},
            "bus": bus_counts, "modbus": {"requests": requests},
            "recorder": {"lost": lost},
        }
        table = self._recorded()
        result = summary.of(table, counters, self.plan.resolved) | {"events": self.events}
        records.write_summary(self.options.out, result)
        return result

    def _note_start(self) -> None:
        """The record's scenario is the one that was run, from the speed at which it began."""
        if self.options.start == "modbus":
            began = self.supervisor.speed_m_s if self.supervisor else self.plan["initial_speed_m_s"]
            resolved = self.plan.resolved | {"initial_speed_m_s": began}
            self.plan = dataclasses.replace(self.plan, resolved=resolved)
            text = scenario.dump(self.plan)
            (self.options.out / "scenario.toml").write_text(text, encoding="utf-8")

    def _recorded(self) -> pa.Table:
        """What the recorder wrote; nothing where it did not come that far: a summary stands anyway."""
        try:
            return channels.load(self.options.out)
        except ConfigError as error:
            self.event("error", str(error))
            return channels.schema().empty_table()

    def _bus_counts(self) -> dict[str, Any]:
        if self.hub is None:
            return {"frames": 0, "dropped": 0, "load_percent": 0.0}
        stats = self.hub.stats()
        counts = {key: stats[key] for key in ("frames", "dropped", "load_percent")}
        if self.hub.wire is not None:
            counts["longest_wait_us"] = stats["longest_wait_us"]
        if self.bus and self.bus.stray_syncs:
            counts["stray_syncs"] = self.bus.stray_syncs
        return counts

    async def _end(self, process: subprocess.Popen[bytes], patience_s: float, ask: bool = True) -> None:
        deadline = time.monotonic() + patience_s
        while process.poll() is None and time.monotonic() < deadline:
            await asyncio.sleep(0.01)
        if process.poll() is None:
            process.terminate() if ask else process.kill()
            process.wait(5.0)


def check_options(options: Options) -> None:
    """Refuse options that contradict each other. Raises ConfigError."""
    if options.pacing == "free" and options.unit == "external":
        raise ConfigError("--pacing free waits for no bus, so no external unit can answer; use "
                          "--pacing lockstep (repeatable) or wall (real time)")


def prepare_folder(out: Path) -> None:
    """Make the run's folder, without what an earlier run left there. Raises ConfigError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        foreign = [path.name for path in out.iterdir() if path.is_dir()]
        if foreign or (any(out.iterdir()) and not (out / "scenario.toml").is_file()):
            raise ConfigError(f"{out} is not empty and not a run's folder; give a new one with --out")
        for path in out.iterdir():
            path.unlink()
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}; give another folder with "
                          "--out") from None


def build_machine(plan: Scenario, ring: rings.Ring, speed_m_s: float | None = None,
                  seed: int = 0) -> Machine:
    """The machine of a scenario, at its initial (or another) speed, with no magnet energised."""
    speed_m_s = plan["initial_speed_m_s"] if speed_m_s is None else speed_m_s
    plant = Plant(plan.params, speed_m_s)
    rollers = Plant(plan.rollers, speed_m_s) if plan.rollers else plant
    tick_hz = plan["loop"]["tick_hz"]
    commands = mailbox.mailbox(COMMANDS)
    commands.values[:] = tick.first_command()
    width = len(signals.COLUMNS)
    machine = Machine(
        plan.params, plant.state, plant.buffer, plant.delay, np.zeros(SLOTS_OF_CONTROL, dtype=np.int64), commands,
        commands.values.copy(), mailbox.mailbox(width), np.zeros(width), tick.gather(), ring.header,
        ring.rows, int(plan.rollers is not None), rollers.params, rollers.state, rollers.buffer,
        rollers.delay, tick.gather(tick.OF_ROLLERS if plan.rollers else ()), plan.record_ticks,
        round(plan["duration_max_s"] * tick_hz), round(plan["stand_s"] * tick_hz),
        np.array([speed_m_s]), np.array(wire_delay.answer_ticks(plan) or (0, 0, 1)), sensor_of(plan),
        pole_wheel.memory(seed))
    tick.publish(machine)
    return machine


def sensor_of(plan: Scenario) -> pole_wheel.Sensor:
    """Pole wheels and speed unit as [sensor] says, times in ticks."""
    given, tick_hz = plan["sensor"], plan["loop"]["tick_hz"]
    return pole_wheel.Sensor(pole_wheel.MODELS[given["model"]], given["teeth"],
                             max(1, round(given["window_s"] * tick_hz)), given["dropout_rad_s"],
                             given["timer_Hz"], 1.0 / tick_hz)


def warm_up(machine: Machine, pacing: str, unit: str = "none") -> None:
    """Compile, or load, what the pacing calls with a unit, without running a tick."""
    if pacing == "wall":
        stop = machine.control[STOP]
        machine.control[STOP] = 1
        descriptor = clock.eventfd()
        loop.wall(machine, 1_000_000, 1, descriptor, np.zeros(loop.BINS, dtype=np.int64),
                  np.zeros(3, dtype=np.int64), 0)
        os.close(descriptor)
        machine.control[STOP] = stop
    elif pacing == "lockstep" or unit != "reference":
        # a free run with the reference unit calls that inside its own loop, and compiles it there
        tick.batch(machine, 0)
    # the bus thread's own calls: a compiler in the first SYNC cycle would look like a lost unit
    mailbox.fetch(machine.published, machine.row.copy())
    mailbox.post(machine.commands, machine.commands.values.copy())
