"""Lockstep: each bus cycle waits for the answers of unit and harness, so that a run repeats."""

import asyncio

from rollerrig.configs.errors import UnitError
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus
from rollerrig.realtime.loop import clock, mailbox, tick
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.rig_objects import HARNESS, HARNESS_ANSWER_ID, MAGNETS_ID

ANSWER_TIMEOUT_S = 1.0
HARNESS_TIMEOUT_S = 60.0


async def run(parts: Parts) -> None:
    """Run bus cycles until the run is done. Raises UnitError when an answer does not come."""
    bus = await parts.open_bus(parts.simulated_ns)
    await parts.await_unit(bus)
    bus.start_wire(timed=False)
    while not parts.stopping:
        mailbox.fetch(parts.data.published, bus.row)
        frozen = bus.frozen
        parts.poll_faults()
        if frozen and not bus.frozen:
            await _catch_up(parts, bus)
        bus.sync()
        bus.poll()
        if bus.hub.wire is None:
            await _answers(parts, bus)
            tick.run_ticks(parts.data, parts.plan.sync_ticks)
        else:
            await _cycle_on_wire(parts, bus, bus.hub)
        await parts.pause()


async def _answers(parts: Parts, bus: RigBus) -> None:
    """Let unit and harness answer this SYNC; simulated time stands still meanwhile."""
    if parts.options.unit != "none" and not bus.frozen:
        try:
            await asyncio.wait_for(bus.answered.wait(), ANSWER_TIMEOUT_S)
        except TimeoutError:
            parts.processes.watch(starting=True)
            raise _silent(parts, "WSP unit", ANSWER_TIMEOUT_S, "a unit answers every SYNC with RPDO1 of node "
                          f"{signals.BRAKE_NODE} ({MAGNETS_ID:X}h), changed or not") from None
    else:
        await asyncio.sleep(0)
    if bus.harness.joined:
        try:
            await asyncio.wait_for(bus.harness_answered.wait(), HARNESS_TIMEOUT_S)
        except TimeoutError:
            raise _silent(parts, "harness", HARNESS_TIMEOUT_S, "one that has joined sends RPDO1 of node "
                          f"{signals.BENCH_NODE} ({HARNESS_ANSWER_ID:X}h) in every cycle, or leaves "
                          f"({HARNESS:X}h:1 = 0)") from None


def _silent(parts: Parts, who: str, timeout_s: float, rule: str) -> UnitError:
    return UnitError(f"the {who} has not answered SYNC within {timeout_s:g} s at "
                     f"{parts.simulated_ns() / clock.SECOND_NS:.3f} s: in lockstep {rule}")


async def _cycle_on_wire(parts: Parts, bus: RigBus, hub: Hub) -> None:
    """A bus cycle whose frames take their time: ticks go on while the wire carries them.

    The answers count as ready when all that the SYNC has set off is through, or at the end of a
    cycle in which the wire never falls silent.
    """
    asked = False
    for _ in range(parts.plan.sync_ticks):
        hub.advance(parts.simulated_ns())
        if not asked and not hub.wire:
            asked = True
            await _answers_in_standstill(parts, bus, hub)
        tick.run_ticks(parts.data, 1)
    hub.advance(parts.simulated_ns())
    if not asked and not parts.stopping:
        await _answers_in_standstill(parts, bus, hub)


async def _answers_in_standstill(parts: Parts, bus: RigBus, hub: Hub) -> None:
    hub.still = True
    try:
        await _answers(parts, bus)
    finally:
        hub.still = False


async def _catch_up(parts: Parts, bus: RigBus) -> None:
    """Let a unit that was frozen answer what it has slept through; no time passes meanwhile."""
    while owed := bus.owed:
        try:
            await asyncio.wait_for(bus.answered.wait(), ANSWER_TIMEOUT_S)
        except TimeoutError:
            if bus.owed == owed:
                parts.event("warning", f"the WSP unit has left {owed} SYNCs unanswered")
                return
