"""The bench: composition root of a run, from a scenario to a folder with its record.

It builds the parts, runs one of the three pacings, and closes everything in order whatever happens:
the record of a run that failed, was interrupted or killed is kept.
"""

import asyncio
import dataclasses
import signal
from collections.abc import Awaitable, Callable
from typing import Any

import pyarrow as pa

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.firmware_sim.faults import panel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, lockstep, options, scenario, supervisor, tick_data, wall, wire_delay
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import loop, ring
from rollerrig.realtime.loop.tick import MISSED, STOP, TICK, WORST_NS
from rollerrig.realtime.record import channels, records, run_folder, summary

PACINGS: dict[str, Callable[[Parts], Awaitable[None]]] = {
    "wall": wall.run, "lockstep": lockstep.run, "free": free.run}
_EXCEPTIONS_RECORDED = 20


class Bench:
    """One run. `say` is called with a `Progress` now and then. Raises ConfigError."""

    def __init__(self, plan: Scenario, given: Options, say: Callable[[Progress], None]) -> None:
        options.check_options(given)
        supervisor.check(plan, given.pacing, given.start)
        panel.check_pacing(plan.faults, given.pacing)
        wire_delay.check(plan, given.pacing)
        if given.unit == "reference":
            logic.load(plan["wsp_config"])
        run_folder.begin(given.out)
        (given.out / run_folder.SCENARIO).write_text(scenario.dump(plan), encoding="utf-8")
        ring.sweep()
        self.parts = Parts(plan, given, say)
        self._exceptions: set[str] = set()

    async def run(self) -> dict[str, Any]:
        """Run to the end and return the summary. Raises RollerrigError after closing the record."""
        parts, failure = self.parts, None
        given = parts.options
        running = asyncio.get_running_loop()
        running.set_exception_handler(self._note_exception)
        for signum in (signal.SIGINT, signal.SIGTERM):
            running.add_signal_handler(signum, parts.stop, "interrupted")
        try:
            await parts.processes.start_recorder(*parts.rings, parts.identity())
            tick_data.warm_up(parts.data, given.pacing, given.unit)
            await PACINGS[given.pacing](parts)
            if parts.failure:
                raise parts.failure
        except RollerrigError as error:
            failure = error
            parts.ended_by = "error"
            parts.event("error", str(error))
        finally:
            parts.data.control[STOP] = 1
            result = await self._close()
            for signum in (signal.SIGINT, signal.SIGTERM):
                running.remove_signal_handler(signum)
        if failure:
            raise failure
        return result

    def _note_exception(self, running: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What fails inside the bus thread is said and recorded, and harms only who failed."""
        text = f"{context.get('message', 'bus thread')}: {context.get('exception')!r}"
        if text not in self._exceptions and len(self._exceptions) < _EXCEPTIONS_RECORDED:
            self._exceptions.add(text)
            self.parts.event("error", text)
            running.default_exception_handler(context)

    async def _close(self) -> dict[str, Any]:
        """Close bus, unit and recorder, and write the summary."""
        parts = self.parts
        parts.derailment.look(parts.data.buffer)
        bus_counts = self._bus_counts()
        self._note_start()
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
            "loop": {"ticks": int(control[TICK]), "missed": int(control[MISSED]),
                     "lateness_us": loop.percentiles(parts.histogram, int(control[WORST_NS]))},
            "bus": bus_counts, "modbus": {"requests": parts.modbus.requests},
            "recorder": {"lost": sum(int(one.header[ring.LOST]) for one in parts.rings)},
        }
        table = self._recorded()
        result = summary.of(table, counters, parts.plan.resolved) | {"events": parts.events}
        records.write_summary(parts.options.out, result)
        return result

    def _note_start(self) -> None:
        """The record's scenario is the one that was run, from the speed at which it began."""
        parts = self.parts
        if parts.options.start == "modbus":
            resolved = parts.plan.resolved | {"initial_speed_m_s": parts.speed_m_s}
            parts.plan = dataclasses.replace(parts.plan, resolved=resolved)
            (parts.options.out / run_folder.SCENARIO).write_text(scenario.dump(parts.plan), encoding="utf-8")

    def _recorded(self) -> pa.Table:
        """What the recorder wrote; nothing where it did not come that far: a summary stands anyway."""
        try:
            return channels.load(self.parts.options.out)
        except ConfigError as error:
            self.parts.event("error", str(error))
            return channels.schema().empty_table()

    def _bus_counts(self) -> dict[str, Any]:
        hub, bus = self.parts.hub, self.parts.bus
        if hub is None:
            return {"frames": 0, "dropped": 0, "load_percent": 0.0}
        stats = hub.stats()
        counts = {key: stats[key] for key in ("frames", "dropped", "load_percent")}
        if hub.wire is not None:
            counts["longest_wait_us"] = stats["longest_wait_us"]
        if bus and bus.stray_syncs:
            counts["stray_syncs"] = bus.stray_syncs
        return counts
