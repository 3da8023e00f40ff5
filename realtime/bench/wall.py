"""Real time: a thread with the ticks on their deadlines, which wakes the bus thread for each SYNC.

Modbus is open meanwhile. A rig that waits for a Modbus client is held and rolls until the client
starts the run. If the client selects another scenario, the rig goes on with it at its present
speed.
"""

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import memory
from rollerrig.realtime.bench import tick_data
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, cores, interrupts, loop, mailbox
from rollerrig.realtime.loop.held_rig import HOLDING
from rollerrig.realtime.loop.tick import HELD, HOLD, STALLED_NS, STOP, TICK
from rollerrig.wsp_interface.events import Code

if TYPE_CHECKING:  # it loads pymodbus
    from rollerrig.realtime.bench.plc import Plc

# a client that polls Modbus sees the end of the run before its connection ends
LINGER_S = 1.0
_REPORT_S = 0.5


class _Car(NamedTuple):
    """A vehicle alone, or a car of a train, and its bus."""

    parts: Parts
    bus: RigBus


async def run(*parts: Parts) -> None:
    """Run the ticks of a vehicle, or of a train with buses, on their deadlines until all is done.

    Only a vehicle alone has Modbus, and can be held. Raises BusError, UnitError.
    """
    from rollerrig.realtime.bench.plc import Plc

    cars = [_Car(one, await one.open_bus(one.elapsed_ns)) for one in parts]
    first = parts[0]
    plc = Plc(*cars[0])
    try:
        if first.plan["modbus"]["enabled"] and first.car == 0:
            held = first.options.start == "modbus"
            if held:
                _hold(first, plc)
            await plc.open(needed=held)
        for car in cars:
            car.parts.start_unit()
        for car in cars:
            with car.parts.named():
                await car.parts.await_unit(car.bus)
        await _run_held_and_free(cars, plc)
    finally:
        await plc.close()


async def _run_held_and_free(cars: Sequence[_Car], plc: "Plc") -> None:
    """Run the real-time thread, and again with each scenario that a held rig is given."""
    parts, bus = cars[0]
    descriptor = clock.eventfd()
    woken = asyncio.Event()
    running = asyncio.get_running_loop()
    running.add_reader(descriptor, _on_tick, cars, descriptor, woken)
    for car in cars:
        car.bus.keep_time()
    loop.prefer_bus_thread(parts.plan["loop"]["priority"])
    try:
        await _run_thread(cars, descriptor, woken)
        while parts.next_plan and not parts.ended_by:
            _take_scenario(parts, parts.next_plan)
            _hold(parts, plc)
            bus.post()
            await _run_thread(cars, descriptor, woken)
        for car in cars:
            car.bus.close()  # what nodes would still send is not part of the run
        if parts.options.start == "modbus" and not parts.ended_by:
            await asyncio.sleep(LINGER_S)
    finally:
        loop.prefer_bus_thread(0)
        memory.unlock()
        for car in cars:
            car.bus.close()
        running.remove_reader(descriptor)
        os.close(descriptor)


@contextlib.contextmanager
def own_core(parts: Parts) -> Iterator[None]:
    """Let the loop own a core inside the block: all else of the bench leaves it.

    Without a real-time priority the loop would be worse off there than on any core.
    """
    rates = parts.plan["loop"]
    wanted = rates["cpu"]
    if not rates["priority"] or loop.priority_refused(rates["priority"]):
        wanted = wanted if wanted >= 0 else cores.ANY
    parts.real_time.core = cores.claim(wanted)
    if parts.real_time.core.number < 0:
        yield
        return
    left = {}
    # also what a child has started: the viewer is a grandchild
    for pid in cores.family(os.getpid()):
        left.update(cores.leave({parts.real_time.core.number}, pid))
    try:
        with interrupts.kept_off(parts.real_time.core):
            yield
    finally:
        cores.restore(left)


def _on_tick(cars: Sequence[_Car], descriptor: int, woken: asyncio.Event) -> None:
    """A SYNC is due, or the real-time thread has ended."""
    os.read(descriptor, 8)
    is_over = any(car.parts.stopping for car in cars)
    if is_over:
        woken.set()
    for car in cars:
        _cycle(*car, is_over)


def _cycle(parts: Parts, bus: RigBus, is_over: bool) -> None:
    """Run a bus cycle of a vehicle; without SYNC when the run is over."""
    mailbox.fetch(parts.data.published, bus.row)

    begins_now = parts.zero_ns < 0 and parts.data.control[TICK]
    if begins_now:
        parts.zero_ns = parts.elapsed_ns() - parts.simulated_ns()
        parts.data.control[STALLED_NS] = 0
    if parts.zero_ns >= 0:
        parts.report_stall()

    if not is_over:
        bus.start_wire(timed=True)
        bus.set_time()
        parts.poll_faults()
        bus.sync()
    bus.poll()


async def _run_thread(cars: Sequence[_Car], descriptor: int, woken: asyncio.Event) -> None:
    """Run the real-time thread until the run is done, stopped or given another scenario."""
    woken.clear()
    failures: list[Exception] = []
    thread = threading.Thread(
        target=_guarded_real_time, args=(cars[0].parts, descriptor, failures), name="real-time"
    )
    thread.start()
    try:
        while not woken.is_set() and thread.is_alive():
            for car in cars:
                car.parts.report()
                car.parts.processes.watch()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(woken.wait(), _REPORT_S)
    finally:
        for car in cars:
            car.parts.data.control[STOP] = 1
        await asyncio.get_running_loop().run_in_executor(None, thread.join)
    for error in failures:
        raise RollerrigError(
            f"the real-time thread has failed ({type(error).__name__}: {error}); this is a fault "
            "of rollerrig and not of the unit: please report it with the scenario"
        ) from error


def _guarded_real_time(parts: Parts, descriptor: int, failures: list[Exception]) -> None:
    """Run the real-time thread; an exception that ends it goes into `failures`."""
    try:
        _real_time(parts, descriptor)
    except Exception as error:
        failures.append(error)


def _real_time(parts: Parts, descriptor: int) -> None:
    """The real-time thread."""
    rates = parts.plan["loop"]
    for refused in loop.ask_for_priority(rates["priority"], parts.real_time.core.number):
        parts.event(Code.LOOP_REFUSED, refused=refused)
    if parts.real_time.core.number >= 0 and os.sched_getaffinity(0) != {
        parts.real_time.core.number
    }:
        # the system refused the core: the loop runs on any
        parts.real_time.core.close()
        parts.real_time.core = cores.Claim()
    early_us = rates["wake_early_us"] if parts.real_time.core.owned else 0
    # locking memory may take a second: the clock starts after it
    begin_ns = time.monotonic_ns()
    parts.real_time.begun_ns = parts.real_time.begun_ns or begin_ns
    with clock.awake(rates["priority"] > 0), loop.interruptions(parts.real_time.interruptions):
        parts.wall(
            parts.data,
            clock.SECOND_NS // rates["tick_hz"],
            parts.plan.sync_ticks,
            1000 * early_us,
            descriptor,
            parts.real_time.histogram,
            np.zeros(3, dtype=np.int64),
            begin_ns,
        )


def _hold(parts: Parts, plc: "Plc") -> None:
    """Let the rig be held from its next tick on."""
    parts.data.control[HOLD] = HOLDING
    parts.zero_ns = -1
    plc.roll()


def _take_scenario(parts: Parts, plan: Scenario) -> None:
    """Continue with another scenario, at the present speed and with the present angles."""
    before = parts.data
    parts.plan = plan
    parts.next_plan = None
    parts.faults.begin(plan.faults, plan.resolved)

    speed_m_s = float(before.state.vehicle_speed[0])
    after = tick_data.build(plan, parts.rows, speed_m_s, parts.options.seed)
    after.control[HELD] = before.control[HELD]
    after.hold[:] = before.hold
    for old, new in ((before.state, after.state), (before.roller_state, after.roller_state)):
        new.wheel_angle[:] = old.wheel_angle
        new.roller_angle[:] = old.roller_angle
    after.pulses[:] = before.pulses
    parts.data = after
