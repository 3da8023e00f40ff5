"""Lockstep: each bus cycle waits for the answers of unit and harness, so that a run repeats.

The wall clock has one effect only: it ends a run whose unit or harness no longer answers.
"""

import asyncio
import contextlib
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

from rollerrig.configs.errors import UnitError, UnitLostError
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus, UnitSeat
from rollerrig.realtime.loop import clock, mailbox, tick
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.bus.turns import Partner
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import HARNESS, HARNESS_ANSWER_ID

_LOOK_S = 0.1
# looks until the unit of the bench, whose connection is closed, should have exited
_LOOKS_AFTER_END = 20
# looks that a harness which has ended the run has to leave
_LOOKS_TO_LEAVE = 50
# a partner that is there but may be slow gets so many times --answer-wait: a unit whose process
# runs, a harness at a breakpoint
_PATIENCE = 6


class _Rule(NamedTuple):
    """What a partner has to do in lockstep, and the identifier of its answer."""

    text: str
    can_id: int


_HARNESS_RULE = _Rule(
    f"a harness that has joined sends RPDO1 of node {signals.BENCH_NODE} ({HARNESS_ANSWER_ID:X}h) "
    f"in every cycle, or leaves ({HARNESS:X}h:1 = 0)",
    HARNESS_ANSWER_ID,
)


def _unit_rule(seat: UnitSeat) -> str:
    brake_io = signals.in_group(signals.BRAKE_NODE, seat.frames.group)
    can_id = seat.frames.magnets_id
    return f"a unit answers every SYNC with RPDO1 of node {brake_io} ({can_id:X}h), changed or not"


class _Answer(Enum):
    """How a wait for an answer has ended."""

    HERE = 1
    MISSING = 2
    GONE = 3  # the partner has closed its connection


class _Car(NamedTuple):
    """A vehicle alone, or a car of a train, and its bus."""

    parts: Parts
    bus: RigBus


async def run(*parts: Parts) -> None:
    """Run bus cycles of a vehicle, or of the cars of a train with buses, until the run is done.

    Raises UnitError when a unit does not come, and UnitLostError when it is there and an answer
    does not come.
    """
    # the same as parts.simulated_ns(), faster: the bus calls it for each frame
    tick_ns = clock.SECOND_NS // parts[0].plan["loop"]["tick_hz"]
    slot = parts[0].data.control.item
    cars = [_Car(one, await one.open_bus(lambda: slot(tick.TICK) * tick_ns)) for one in parts]
    for car in cars:
        car.parts.start_unit()
    for car in cars:
        with car.parts.named():
            await car.parts.await_unit(car.bus)
        car.bus.start_wire(timed=False)
        car.bus.take_turns(unit_answers=car.parts.options.unit != "none")
    try:
        await _cycles(cars)
    except UnitError as error:
        raise UnitLostError(str(error)) from error


def _stops(cars: Sequence[_Car]) -> bool:
    return any(car.parts.stopping for car in cars)


async def _cycles(cars: Sequence[_Car]) -> None:
    parts, bus = cars[0]
    ticks = parts.ticks_of(parts.data)
    while not _stops(cars):
        for car in cars:
            with car.parts.named():
                await _begin_cycle(*car)
        if bus.hub.wire is None:
            for car in cars:
                with car.parts.named():
                    await _await_answers(*car)
            await _run_ticks(cars, ticks)
        else:  # never in a train
            await _cycle_on_wire(parts, bus, bus.hub, ticks)
        for car in cars:
            await car.parts.pause()


async def _begin_cycle(parts: Parts, bus: RigBus) -> None:
    """Poll the faults and send SYNC."""
    mailbox.fetch(parts.data.published, bus.row)
    frozen = [seat for seat in bus.seats if seat.frozen]
    bus.set_time()
    parts.poll_faults()
    for seat in frozen:
        if not seat.frozen:
            await _catch_up(parts, bus, seat)
    if bus.late:
        await _await_answers(parts, bus)
    bus.sync()
    bus.poll()


async def _run_ticks(cars: Sequence[_Car], ticks: tick.RunsTicks) -> None:
    """Run the ticks of a bus cycle.

    An alarm of a node between two SYNCs goes off at the tick after its time.
    """
    parts = cars[0].parts
    tick_ns = clock.SECOND_NS // parts.plan["loop"]["tick_hz"]
    left = parts.plan.sync_ticks
    while left and not _stops(cars):
        next_ns = min(car.bus.rack.next_ns() for car in cars)
        # rounded up: no alarm goes off early
        until_alarm = -((parts.simulated_ns() - next_ns) // tick_ns)
        count = min(max(until_alarm, 1), left)
        ticks.run(count)
        left -= count
        if left:  # an alarm that is due with the SYNC comes after it
            for car in cars:
                car.bus.ring()
                if car.bus.late:
                    with car.parts.named():
                        await _await_answers(*car)


async def _await_answers(parts: Parts, bus: RigBus) -> None:
    """Wait for the answers of the unit and then of the harness to this SYNC.

    Simulated time stands still meanwhile. Each sends in its turn, so the frames of the harness
    (faults, demands, friction) take effect after the answer of the unit, whichever came first.
    """
    awaited = [seat for seat in bus.seats if not seat.frozen]
    if parts.options.unit != "none" and awaited:
        patience = _PATIENCE if bus.own_unit else 1
        for seat in awaited:
            name = "WSP unit" if len(bus.seats) == 1 else f"WSP unit (node {seat.frames.node})"
            rule = _Rule(_unit_rule(seat), seat.frames.magnets_id)
            await _await_answer(parts, bus, seat.partner, name, patience, rule)
    else:
        await asyncio.sleep(0)
    await _await_answer(parts, bus, bus.harness_partner, "harness", _PATIENCE, _HARNESS_RULE)


async def _await_answer(
    parts: Parts, bus: RigBus, partner: Partner, name: str, patience: int, rule: _Rule
) -> None:
    """Wait for the answer of one partner.

    Raises UnitError when it does not come in time, or when it cannot come any more.
    """
    wait_s = patience * parts.options.answer_wait_s
    with partner.turn():
        answer = await _wait(parts, bus, partner, wait_s)
    if answer is _Answer.HERE:
        return
    at = f"at {parts.simulated_ns() / clock.SECOND_NS:.3f} s"
    output = parts.processes.unit_words() if partner is not bus.harness_partner else ""
    if answer is _Answer.GONE:
        raise UnitError(
            f"the {name} has closed its connection {at}, before it answered SYNC: its program has "
            f"perhaps failed, look at its output, correct it and run again{output}"
        )
    raise UnitError(
        f"the {name} has not answered SYNC within {wait_s:g} s {at}: "
        f"{bus.what_came_instead((rule.can_id,))}; in lockstep {rule.text}; give a slower partner "
        f"more time with --answer-wait{output}"
    )


async def _wait(parts: Parts, bus: RigBus, partner: Partner, wait_s: float) -> _Answer:
    """Wait for an answer. Raises UnitError when the unit of the bench has exited.

    The wait is counted in looks, not by the clock: a bench that was stopped itself has not waited.
    """
    looks_after_end = 0
    looks_after_stop = 0
    for _ in range(max(round(wait_s / _LOOK_S), 1)):
        if partner.answered.is_set():
            return _Answer.HERE
        if parts.stopping:
            # a harness that has ended the run leaves next, and the log shall have that always
            leaves = partner is bus.harness_partner and bus.harness.joined and not partner.gone
            if not leaves or looks_after_stop >= _LOOKS_TO_LEAVE:
                return _Answer.HERE
            looks_after_stop += 1
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LOOK_S):
                await partner.answered.wait()
        if partner.answered.is_set():
            return _Answer.HERE
        parts.processes.watch(starting=True)
        if partner.gone and not parts.stopping:
            looks_after_end += 1
            # the exit of a process tells more than the end of its connection
            may_exit = parts.options.starts_unit and partner is not bus.harness_partner
            if not may_exit or looks_after_end > _LOOKS_AFTER_END:
                return _Answer.GONE
    return _Answer.MISSING


async def _cycle_on_wire(parts: Parts, bus: RigBus, hub: Hub, ticks: tick.RunsTicks) -> None:
    """Run a bus cycle whose frames take their time: ticks go on while the wire carries them.

    Unit and harness answer when all frames that the SYNC has caused are through, or at the end of a
    cycle in which the wire is never silent.
    """
    waited = False
    for _ in range(parts.plan.sync_ticks):
        hub.advance(parts.simulated_ns())
        if not waited and not hub.wire:
            waited = True
            await _await_answers_in_standstill(parts, bus, hub)
        ticks.run(1)
        bus.ring()
    hub.advance(parts.simulated_ns())
    if (bus.late or not waited) and not parts.stopping:
        await _await_answers_in_standstill(parts, bus, hub)


async def _await_answers_in_standstill(parts: Parts, bus: RigBus, hub: Hub) -> None:
    hub.services_bypass_wire = True
    try:
        await _await_answers(parts, bus)
    finally:
        hub.services_bypass_wire = False


async def _catch_up(parts: Parts, bus: RigBus, seat: UnitSeat) -> None:
    """Let a unit that was frozen answer the SYNCs that it has missed; no time passes meanwhile."""
    owed = -1
    unit = seat.partner
    with unit.turn():
        while seat.owed != owed and not unit.answered.is_set():
            owed = seat.owed
            await _wait(parts, bus, unit, parts.options.answer_wait_s)
    if not unit.answered.is_set():  # its connection had no room for more frames
        parts.event(Code.UNIT_UNANSWERED, syncs=owed)
        seat.forgive()
