"""The bench: composition root of a run, from a scenario to a folder with its record.

It builds the parts, runs one of the three pacings, and closes everything in order whatever happens:
the record of a run that failed, was interrupted or killed is kept.
"""

import asyncio
import contextlib
import dataclasses
import resource
import time
from asyncio.constants import ACCEPT_RETRY_DELAY
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import Any

import pyarrow as pa

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.output_files import write_text, writing
from rollerrig.configs.processes import interruption
from rollerrig.firmware_sim.faults import catalogue, panel
from rollerrig.firmware_sim.modbus.access import tls_context
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import (
    free,
    lockstep,
    options,
    rig_bus,
    scenario,
    tick_data,
    wall,
    wire_delay,
)
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, loop, ring
from rollerrig.realtime.loop.tick import MISSED, STALLED_NS, STOP, TICK, WORST_NS
from rollerrig.realtime.record import channels, records, run_folder, summary, validity
from rollerrig.rig.compiled import compile_progress
from rollerrig.wsp_interface import places
from rollerrig.wsp_interface.events import Code, Event

# free pacing has no bus, and takes the parts of one vehicle; the others those of several cars
PACINGS: dict[str, Callable[..., Awaitable[None]]] = {
    "wall": wall.run,
    "lockstep": lockstep.run,
    "free": free.run,
}
# different failures inside the bus thread that are recorded; more would flood the events
_EXCEPTIONS_RECORDED = 20


def check(plan: Scenario, given: Options) -> None:
    """Refuse what cannot be run, before a file is written. Raises ConfigError."""
    options.check(given, plan["modbus"]["enabled"])
    vehicle = plan.kind
    if vehicle.groups > 1 and given.pacing == "free" and plan["bus"]["arbitration"]:
        raise ConfigError(
            f"{plan.name}: bus.arbitration with --pacing free and {vehicle.axles} axles: how long the "
            "frames of several units wait is known on the bus only; use --pacing lockstep, or "
            "bus.arbitration=false"
        )
    panel.check_pacing(plan.faults, given.pacing)
    for fault in plan.faults:
        catalogue.check_equipped(fault, plan.resolved, plan.name)
    wire_delay.check(plan, given.pacing)
    if given.pacing != "free":
        rig_bus.check_stored(plan)
    if given.unit == "reference":
        logic.load(plan["wsp_config"])
    if given.fmus:
        from rollerrig.firmware_sim.fmu import fmu_file

        period_s = plan["bus"]["sync_period_s"]
        fmus = fmu_file.check_all(given.fmus, given.unit_map, period_s, vehicle.unit_axles)
        if vehicle.groups > 1 and fmus[0].terminal:
            raise ConfigError(
                f"{plan.name}: {fmus[0].path.name} has a CAN port and is the unit of the leading "
                f"group of axles, and a vehicle with {vehicle.axles} axles has {vehicle.groups} "
                "groups, each with a unit; allowed are an FMU without a CAN port (the bench starts one "
                "instance for each group), --wsp reference, external and none"
            )
    if plan["modbus"]["enabled"]:
        tls_context(plan["modbus"])


class Bench:
    """One run, or the part of it that has the `car` of a train with its bus, counted from 1.

    `on_progress` is called with a `Progress` now and then. Raises ConfigError.
    """

    def __init__(
        self,
        plan: Scenario,
        given: Options,
        on_progress: Callable[[Progress], None],
        car: int = 0,
    ) -> None:
        check(plan, given)
        run_folder.begin(given.out)
        with writing(given.out):
            write_text(given.out / run_folder.SCENARIO, scenario.dump(plan, given.harness))
        ring.sweep()
        self.parts = Parts(plan, given, on_progress, car)
        # message and exception of the failures that are recorded already
        self._exceptions: set[tuple[str, str]] = set()
        self._out_of_descriptors = False

    async def run(self) -> dict[str, Any]:
        """Run to the end and return the summary. Raises RollerrigError after closing the record."""
        (result,) = await run([self])
        return result

    def record_exception(self, running: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Record and print a failure inside the bus thread, once; the run goes on."""
        if places.is_out_of_descriptors(context):
            self._make_room(context["exception"])
            return
        message = str(context.get("message", "bus thread"))
        exception = repr(context.get("exception"))
        is_new = (message, exception) not in self._exceptions
        if is_new and len(self._exceptions) < _EXCEPTIONS_RECORDED:
            self._exceptions.add((message, exception))
            self.parts.event(Code.BENCH_EXCEPTION, message=message, exception=exception)
            running.default_exception_handler(context)

    def _make_room(self, error: OSError) -> None:
        """Record, once, that no client can be accepted; disconnect those that are silent."""
        parts = self.parts
        parts.accepts_again_s = time.monotonic() + ACCEPT_RETRY_DELAY
        if not self._out_of_descriptors:
            self._out_of_descriptors = True
            soft_limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            reason = error.strerror or str(error)
            parts.event(Code.SERVER_OUT_OF_DESCRIPTORS, reason=reason, limit=soft_limit)
        for close_silent in parts.close_silent:
            close_silent()

    # --- the end ---

    async def close(self) -> dict[str, Any]:
        """Close bus, unit and recorder, write the summary and return it."""
        parts = self.parts
        parts.derailment.look(parts.data.buffer)
        has_begun = bool(parts.data.control[TICK])
        if has_begun:
            parts.faults.report_waiting()
            parts.set_points.report_all()
            parts.report_uncommanded()
        bus_counts = self._bus_counts()
        if parts.options.start == "modbus":
            self._rewrite_scenario()
        if parts.hub is not None:
            await parts.await_accepting()
            await parts.hub.close()
        await parts.processes.end_unit()
        for one in parts.rings:
            one.close()
        await parts.processes.end_recorder()
        for one in parts.rings:
            one.unlink()
        return self._write_summary(self._counters(bus_counts))

    def _rewrite_scenario(self) -> None:
        """Write the scenario that was run, from the speed at which it began, into the record."""
        parts = self.parts
        resolved = parts.plan.resolved | {"initial_speed_m_s": parts.speed_m_s}
        parts.plan = dataclasses.replace(parts.plan, resolved=resolved)
        # the recorder reports a full disk
        with contextlib.suppress(OSError):
            path = parts.options.out / run_folder.SCENARIO
            write_text(path, scenario.dump(parts.plan, parts.options.harness))

    def _counters(self, bus_counts: dict[str, Any]) -> dict[str, Any]:
        """Return what only the bench knows of the run, for the summary."""
        parts = self.parts
        control = parts.data.control
        return parts.identity() | {
            "ended": parts.ended_by or "finished",
            "random": parts.is_random,
            "loop": {
                "ticks": int(control[TICK]),
                "core": parts.real_time.core.number,
                "missed": int(control[MISSED]),
                "stalled_s": int(control[STALLED_NS]) / clock.SECOND_NS,
                "lateness_us": loop.percentiles(parts.real_time.histogram, int(control[WORST_NS])),
                **parts.real_time.interruptions,
            },
            "bus": bus_counts,
            "modbus": {"requests": parts.modbus.requests},
            "recorder": {"lost": sum(int(one.header[ring.LOST]) for one in parts.rings)},
        }

    def _write_summary(self, counters: dict[str, Any]) -> dict[str, Any]:
        """Write the summary and return it."""
        parts = self.parts
        out = parts.options.out
        try:
            recorded: channels.Columns | pa.Table = channels.Columns(out)
        except ConfigError as error:  # the recorder did not get as far; there is a summary anyway
            parts.event(Code.RECORD_UNREADABLE, reason=str(error))
            recorded = channels.schema(parts.plan.table.columns).empty_table()
        result = summary.of(recorded, counters, parts.plan.resolved, self._all_events())
        result["events"] = [event._asdict() for event in parts.events]
        try:
            records.write_summary(out, result)
        except ConfigError as error:
            parts.processes.unwritten = error
        return result

    def _all_events(self) -> Iterable[Event]:
        """Return all events of the run, as far as they were recorded."""
        parts = self.parts
        if parts.events.left_out:
            with contextlib.suppress(ConfigError):
                recorded = sum(1 for _ in records.each_event(parts.options.out))
                if recorded > len(list(parts.events)):
                    return records.each_event(parts.options.out)
        return parts.events

    def _bus_counts(self) -> dict[str, Any]:
        """Return the counters of the bus, for the summary."""
        hub, bus = self.parts.hub, self.parts.bus
        if hub is None:
            return {"frames": 0, "dropped": 0, "load_percent": 0.0}
        stats = hub.stats()
        counts = {name: stats[name] for name in ("frames", "dropped", "load_percent")}
        if hub.wire is not None:
            counts["longest_wait_us"] = stats["longest_wait_us"]
        if bus and bus.stray_syncs:
            counts["stray_syncs"] = bus.stray_syncs
        return counts


async def run(benches: Sequence[Bench]) -> list[dict[str, Any]]:
    """Run a vehicle, or the cars of a train that have buses, to the end; return their summaries.

    The first one has the real-time thread and runs the ticks. Raises RollerrigError after closing
    all records.
    """
    cars = [one.parts for one in benches]
    for car in cars:
        car.real_time = cars[0].real_time
    failure: RollerrigError | None = None
    running = asyncio.get_running_loop()
    running.set_exception_handler(benches[0].record_exception)
    signals = interruption.ending_signals()
    for signum in signals:
        running.add_signal_handler(signum, _interrupt, cars, signum.name)
    try:
        await _run_pacing(cars)
    except RollerrigError as error:
        failure = error
        for car in cars:
            car.ended_by = validity.ENDED_BY[Code.RUN_FAILED]
            car.event(Code.RUN_FAILED, reason=str(error))
    finally:
        for car in cars:
            car.data.control[STOP] = 1
            # what has ended one car has ended the train
            car.ended_by = car.ended_by or next((one.ended_by for one in cars if one.ended_by), "")
        # from now on signals are ignored; the end of the event loop removes the handlers
        for signum in signals:
            running.add_signal_handler(signum, lambda: None)
        results = await asyncio.gather(*(one.close() for one in benches))
    failure = failure or next((car.processes.unwritten for car in cars), None)
    if failure:
        raise failure
    return results


def _interrupt(cars: Sequence[Parts], name: str) -> None:
    """End the run because of a signal."""
    for car in cars:
        car.stop(Code.RUN_INTERRUPTED, signal=name)


async def _run_pacing(cars: Sequence[Parts]) -> None:
    """Start the recorders and run the pacing. Raises RollerrigError."""
    first = cars[0]
    given = first.options
    for car in cars:
        car.processes.start_recorder(car.plan.kind, *car.rings, car.identity())
        car.report_scenario()
    ticks = first.ticks_of(first.data)
    tick_data.warm_up(first.data, given.pacing, given.unit, ticks, first.wall)
    if given.prepare_free and compile_progress.has_compiled():
        tick_data.warm_up(first.data, "free", "none")
    if given.hold:
        first.report("held until a viewer has joined the live view")
    await first.processes.await_viewer(first.rows, lambda: first.ended_by)
    if not first.ended_by:
        with wall.own_core(first) if given.pacing == "wall" else contextlib.nullcontext():
            await PACINGS[given.pacing](*cars)
    for car in cars:
        if car.failure:
            with car.named():
                raise car.failure
