"""Real time: a thread with the ticks on their deadlines, which wakes the bus thread for each SYNC.

Modbus is open meanwhile. A rig that waits for a Modbus client is held, rolling, until that starts
the run; given another scenario, it goes on with that at the speed that it has.
"""

import asyncio
import contextlib
import os
import threading
import time
from typing import TYPE_CHECKING

import numpy as np

from rollerrig.realtime.bench import tick_data
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, loop, mailbox
from rollerrig.realtime.loop.held_rig import HOLDING
from rollerrig.realtime.loop.tick import HELD, HOLD, STALLED_NS, STOP, TICK
from rollerrig.wsp_interface.events import Code

if TYPE_CHECKING:  # it loads pymodbus
    from rollerrig.realtime.bench.plc import Supervisor

LINGER_S = 1.0
_REPORT_S = 0.5


async def run(parts: Parts) -> None:
    """Run ticks on their deadlines until the run is done. Raises BusError, UnitError."""
    from rollerrig.realtime.bench.plc import Supervisor

    bus = await parts.open_bus(parts.elapsed_ns)
    plc = Supervisor(parts, bus)
    parts.govern = plc.govern
    try:
        if parts.plan["modbus"]["enabled"]:
            held = parts.options.start == "modbus"
            if held:
                _hold(parts, plc)
            await plc.open(needed=held)
        await parts.await_unit(bus)
        await _run_held_and_free(parts, bus, plc)
    finally:
        await plc.close()


async def _run_held_and_free(parts: Parts, bus: RigBus, plc: "Supervisor") -> None:
    descriptor, woken = clock.eventfd(), asyncio.Event()
    running = asyncio.get_running_loop()
    running.add_reader(descriptor, _on_tick, parts, bus, descriptor, woken)
    bus.keep_time()
    loop.prefer_bus_thread(parts.plan["loop"]["priority"])
    try:
        await _run_thread(parts, descriptor, woken)
        while parts.next_plan and not parts.ended_by:
            _take_scenario(parts, parts.next_plan)
            _hold(parts, plc)
            bus.post()
            await _run_thread(parts, descriptor, woken)
        bus.close()  # what nodes would still send is no part of the run
        if parts.options.start == "modbus" and not parts.ended_by:
            # a client that polls sees the run end before the connection does
            await asyncio.sleep(LINGER_S)
    finally:
        loop.prefer_bus_thread(0)
        clock.unlock_memory()
        bus.close()
        running.remove_reader(descriptor)
        os.close(descriptor)


def _on_tick(parts: Parts, bus: RigBus, descriptor: int, woken: asyncio.Event) -> None:
    """A SYNC is due, or the real-time thread has ended."""
    os.read(descriptor, 8)
    mailbox.fetch(parts.data.published, bus.row)
    if parts.zero_ns < 0 and parts.data.control[TICK]:
        parts.zero_ns = parts.elapsed_ns() - parts.simulated_ns()
        parts.data.control[STALLED_NS] = 0
    if parts.zero_ns >= 0:
        parts.tell_stall()
    if parts.stopping:
        woken.set()
    else:
        bus.start_wire(timed=True)
        bus.tell_time()
        parts.poll_faults()
        bus.sync()
    bus.poll()


async def _run_thread(parts: Parts, descriptor: int, woken: asyncio.Event) -> None:
    """Run the real-time thread until the run is done, stopped or given another scenario."""
    woken.clear()
    thread = threading.Thread(target=_real_time, args=(parts, descriptor), name="real-time")
    thread.start()
    try:
        while not woken.is_set() and thread.is_alive():
            parts.report()
            parts.processes.watch()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(woken.wait(), _REPORT_S)
    finally:
        parts.data.control[STOP] = 1
        await asyncio.get_running_loop().run_in_executor(None, thread.join)


def _real_time(parts: Parts, descriptor: int) -> None:
    rates = parts.plan["loop"]
    for refused in loop.ask_for_priority(rates["priority"], rates["cpu"]):
        parts.event(Code.LOOP_REFUSED, refused=refused)
    # locking memory may take a second: the clock starts after it
    begin_ns = time.monotonic_ns()
    parts.begun_ns = parts.begun_ns or begin_ns
    with clock.awake(rates["priority"] > 0), loop.interruptions(parts.interruptions):
        loop.wall(
            parts.data,
            clock.SECOND_NS // rates["tick_hz"],
            parts.plan.sync_ticks,
            descriptor,
            parts.histogram,
            np.zeros(3, dtype=np.int64),
            begin_ns,
        )


def _hold(parts: Parts, plc: "Supervisor") -> None:
    parts.data.control[HOLD] = HOLDING
    parts.zero_ns = -1
    plc.roll()


def _take_scenario(parts: Parts, plan: Scenario) -> None:
    """Go on with another scenario, at the speed and with the angles of before."""
    before, parts.plan, parts.next_plan = parts.data, plan, None
    parts.faults.schedule(plan.faults)
    after = tick_data.build(
        plan, parts.rows, float(before.state.vehicle_speed[0]), parts.options.seed
    )
    after.control[HELD] = before.control[HELD]
    for old, new in ((before.state, after.state), (before.roller_state, after.roller_state)):
        new.wheel_angle[:], new.roller_angle[:] = old.wheel_angle, old.roller_angle
    after.pulses[:] = before.pulses
    parts.data = after
