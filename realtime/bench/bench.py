"""The bench: composition root of a run, from a scenario to a folder with its record.

It builds the parts, runs one of the three pacings, and closes everything in order whatever happens: the record of a
run that failed, was interrupted or killed is kept.
"""

import asyncio
import contextlib
import dataclasses
import signal
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from typing import Any

import pyarrow as pa

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.firmware_sim.faults import panel
from rollerrig.firmware_sim.modbus.access import tls_context
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, lockstep, options, scenario, tick_data, wall, wire_delay
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, loop, ring
from rollerrig.realtime.loop.tick import MISSED, STALLED_NS, STOP, TICK, WORST_NS
from rollerrig.realtime.record import channels, records, run_folder, summary
from rollerrig.realtime.record.files import writing
from rollerrig.wsp_interface.events import Code, Event

PACINGS: dict[str, Callable[[Parts], Awaitable[None]]] = {
    "wall": wall.run,
    "lockstep": lockstep.run,
    "free": free.run,
}
_EXCEPTIONS_RECORDED = 20


class Bench:
    """One run. `say` is called with a `Progress` now and then. Raises ConfigError."""

    def __init__(self, plan: Scenario, given: Options, say: Callable[[Progress], None]) -> None:
        options.check(given, plan["modbus"]["enabled"])
        panel.check_pacing(plan.faults, given.pacing)
        wire_delay.check(plan, given.pacing)
        if given.unit == "reference":
            logic.load(plan["wsp_config"])
        if given.fmus:
            from rollerrig.firmware_sim.fmu import fmu_file

            fmu_file.fit_all(given.fmus, given.unit_map, plan["bus"]["sync_period_s"])
        if plan["modbus"]["enabled"]:
            tls_context(plan["modbus"])
        run_folder.begin(given.out)
        with writing(given.out):
            (given.out / run_folder.SCENARIO).write_text(scenario.dump(plan), encoding="utf-8")
        ring.sweep()
        self.parts = Parts(plan, given, say)
        self._exceptions: set[tuple[str, str]] = set()

    async def run(self) -> dict[str, Any]:
        """Run to the end and return the summary. Raises RollerrigError after closing the record."""
        parts, failure = self.parts, None
        given = parts.options
        running = asyncio.get_running_loop()
        running.set_exception_handler(self._note_exception)
        # a run under nohup goes on when its terminal closes
        heard = [
            signal.SIGINT,
            signal.SIGTERM,
            *[signal.SIGHUP] * (signal.getsignal(signal.SIGHUP) != signal.SIG_IGN),
        ]
        for signum in heard:
            running.add_signal_handler(
                signum, partial(parts.stop, Code.RUN_INTERRUPTED, signal=signum.name)
            )
        try:
            parts.processes.start_recorder(*parts.rings, parts.identity())
            tick_data.warm_up(parts.data, given.pacing, given.unit)
            if given.hold:
                parts.report("held until a viewer has joined the live view")
            await parts.processes.await_viewer(parts.rows, lambda: parts.ended_by)
            if not parts.ended_by:
                await PACINGS[given.pacing](parts)
            if parts.failure:
                raise parts.failure
        except RollerrigError as error:
            failure = error
            parts.ended_by = "error"
            parts.event(Code.RUN_FAILED, reason=str(error))
        finally:
            parts.data.control[STOP] = 1
            for signum in heard:  # the event loop's end takes the handlers away
                running.add_signal_handler(signum, lambda: None)
            result = await self._close()
        if failure := failure or parts.processes.unwritten:
            raise failure
        return result

    def _note_exception(self, running: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What fails inside the bus thread is said and recorded, and harms only who failed."""
        message = str(context.get("message", "bus thread"))
        exception = repr(context.get("exception"))
        new = (message, exception) not in self._exceptions
        if new and len(self._exceptions) < _EXCEPTIONS_RECORDED:
            self._exceptions.add((message, exception))
            self.parts.event(Code.BENCH_EXCEPTION, message=message, exception=exception)
            running.default_exception_handler(context)

    async def _close(self) -> dict[str, Any]:
        """Close bus, unit and recorder, and write the summary."""
        parts, out = self.parts, self.parts.options.out
        parts.derailment.look(parts.data.buffer)
        bus_counts = self._bus_counts()
        if parts.options.start == "modbus":
            # the record's scenario is the one that was run, from the speed at which it began
            resolved = parts.plan.resolved | {"initial_speed_m_s": parts.speed_m_s}
            parts.plan = dataclasses.replace(parts.plan, resolved=resolved)
            with contextlib.suppress(OSError):  # a full disk is told by what became of the record
                (out / run_folder.SCENARIO).write_text(scenario.dump(parts.plan), encoding="utf-8")
        if parts.hub is not None:
            await parts.hub.close()
        await parts.processes.end_unit()
        for one in parts.rings:
            one.close()
        await parts.processes.end_recorder()
        for one in parts.rings:
            one.unlink()
        control = parts.data.control
        counters = parts.identity() | {
            "ended": parts.ended_by or "finished",
            "loop": {
                "ticks": int(control[TICK]),
                "missed": int(control[MISSED]),
                "stalled_s": int(control[STALLED_NS]) / clock.SECOND_NS,
                "lateness_us": loop.percentiles(parts.histogram, int(control[WORST_NS])),
                **parts.interruptions,
            },
            "bus": bus_counts,
            "modbus": {"requests": parts.modbus.requests},
            "recorder": {"lost": sum(int(one.header[ring.LOST]) for one in parts.rings)},
        }
        try:
            found: channels.Columns | pa.Table = channels.Columns(out)
        except ConfigError as error:  # the recorder did not come that far: a summary stands anyway
            parts.event(Code.RECORD_UNREADABLE, reason=str(error))
            found = channels.schema().empty_table()
        told: Iterable[Event] = parts.events
        if parts.events.left_out:  # judged by all of them, as far as they were recorded
            with contextlib.suppress(ConfigError):
                if sum(1 for _ in records.each_event(out)) > len(list(parts.events)):
                    told = records.each_event(out)
        result = summary.of(found, counters, parts.plan.resolved, told) | {
            "events": [event._asdict() for event in parts.events]
        }
        try:
            records.write_summary(out, result)
        except ConfigError as error:
            parts.processes.unwritten = error
        return result

    def _bus_counts(self) -> dict[str, Any]:
        hub, bus = self.parts.hub, self.parts.bus
        if hub is None:
            return {"frames": 0, "dropped": 0, "load_percent": 0.0}
        names = (
            "frames",
            "dropped",
            "load_percent",
            *(("longest_wait_us",) if hub.wire is not None else ()),
        )
        counts = {name: hub.stats()[name] for name in names}
        return counts | ({"stray_syncs": bus.stray_syncs} if bus and bus.stray_syncs else {})
