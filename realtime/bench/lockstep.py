"""Lockstep: each bus cycle waits for the answers of unit and harness, so that a run repeats.

No wall clock acts, but one that ends a run whose unit or harness does not answer any more.
"""

import asyncio
import contextlib

from rollerrig.configs.errors import UnitError
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus
from rollerrig.realtime.loop import clock, mailbox, tick
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import HARNESS, HARNESS_ANSWER_ID, MAGNETS_ID

_LOOK_S = 0.1
# times --answer-wait for who is there but may be slow: a unit whose process lives, a harness at a breakpoint
_PATIENCE = 6


async def run(parts: Parts) -> None:
    """Run bus cycles until the run is done. Raises UnitError when an answer does not come."""
    # as parts.simulated_ns(), which is asked for each frame
    tick_ns, slot = clock.SECOND_NS // parts.plan["loop"]["tick_hz"], parts.data.control.item
    bus = await parts.open_bus(lambda: slot(tick.TICK) * tick_ns)
    await parts.await_unit(bus)
    bus.start_wire(timed=False)
    ticks = tick.Ticks(parts.data)
    while not parts.stopping:
        mailbox.fetch(parts.data.published, bus.row)
        frozen = bus.frozen
        bus.tell_time()
        parts.poll_faults()
        if frozen and not bus.frozen:
            await _catch_up(parts, bus)
        if bus.late:
            await _answers(parts, bus)
        bus.sync()
        bus.poll()
        if bus.hub.wire is None:
            await _answers(parts, bus)
            await _run_ticks(parts, bus, ticks)
        else:
            await _cycle_on_wire(parts, bus, bus.hub, ticks)
        await parts.pause()


async def _run_ticks(parts: Parts, bus: RigBus, ticks: tick.Ticks) -> None:
    """The ticks of a bus cycle; alarms of the nodes between two SYNCs go off at the tick after their time."""
    tick_ns = clock.SECOND_NS // parts.plan["loop"]["tick_hz"]
    left = parts.plan.sync_ticks
    while left and not parts.stopping:
        until_alarm = -((parts.simulated_ns() - bus.rack.next_ns()) // tick_ns)
        part = min(max(until_alarm, 1), left)
        ticks.run(part)
        left -= part
        if left:  # what is due with the SYNC comes after it
            bus.ring()
            if bus.late:
                await _answers(parts, bus)


async def _answers(parts: Parts, bus: RigBus) -> None:
    """Let unit and harness answer this SYNC; simulated time stands still meanwhile."""
    if parts.options.unit != "none" and not bus.frozen:
        await _answer(
            parts,
            bus.answered,
            "WSP unit",
            _PATIENCE if bus.own_unit else 1,
            "a unit answers every SYNC "
            f"with RPDO1 of node {signals.BRAKE_NODE} ({MAGNETS_ID:X}h), changed or not",
        )
    else:
        await asyncio.sleep(0)
    await _answer(
        parts,
        bus.harness_answered,
        "harness",
        _PATIENCE,
        "one that has joined sends RPDO1 of "
        f"node {signals.BENCH_NODE} ({HARNESS_ANSWER_ID:X}h) in every cycle, or leaves ({HARNESS:X}h:1 = 0)",
    )


async def _answer(parts: Parts, heard: asyncio.Event, who: str, patience: int, rule: str) -> None:
    wait_s = patience * parts.options.answer_wait_s
    if not await _comes(parts, heard, wait_s):
        raise UnitError(
            f"the {who} has not answered SYNC within {wait_s:g} s at "
            f"{parts.simulated_ns() / clock.SECOND_NS:.3f} s: in lockstep {rule}; one that needs longer "
            "gets it with --answer-wait"
        )


async def _comes(parts: Parts, heard: asyncio.Event, wait_s: float) -> bool:
    """Wait for an answer; False where none came. Raises UnitError when the bench's own unit has ended.

    The wait is counted in looks, not by the clock: a bench that was stopped itself has not waited.
    """
    for _ in range(max(round(wait_s / _LOOK_S), 1)):
        if heard.is_set() or parts.stopping:
            return True
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LOOK_S):
                await heard.wait()
        if not heard.is_set():
            parts.processes.watch(starting=True)
    return heard.is_set()


async def _cycle_on_wire(parts: Parts, bus: RigBus, hub: Hub, ticks: tick.Ticks) -> None:
    """A bus cycle whose frames take their time: ticks go on while the wire carries them.

    The answers count as ready when all that the SYNC has set off is through, or at the end of a cycle in which the wire
    never falls silent.
    """
    asked = False
    for _ in range(parts.plan.sync_ticks):
        hub.advance(parts.simulated_ns())
        if not asked and not hub.wire:
            asked = True
            await _answers_in_standstill(parts, bus, hub)
        ticks.run(1)
        bus.ring()
    hub.advance(parts.simulated_ns())
    if (bus.late or not asked) and not parts.stopping:
        await _answers_in_standstill(parts, bus, hub)


async def _answers_in_standstill(parts: Parts, bus: RigBus, hub: Hub) -> None:
    hub.still = True
    try:
        await _answers(parts, bus)
    finally:
        hub.still = False


async def _catch_up(parts: Parts, bus: RigBus) -> None:
    """Let a unit that was frozen answer what it has slept through; no time passes meanwhile."""
    owed = -1
    while bus.owed != owed and not bus.answered.is_set():
        owed = bus.owed
        await _comes(parts, bus.answered, parts.options.answer_wait_s)
    if not bus.answered.is_set():  # its connection held no more
        parts.event(Code.UNIT_UNANSWERED, syncs=owed)
        bus.forgive()
