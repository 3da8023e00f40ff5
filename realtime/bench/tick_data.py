"""Builds what a tick works on from a scenario, and compiles the kernels of a pacing."""

import os
from collections.abc import Callable

import numpy as np

from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.wsp import logic, node
from rollerrig.realtime.bench import wire_delay
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import clock, held_rig, loop, mailbox, tick
from rollerrig.realtime.loop.ring import Memory, Ring
from rollerrig.realtime.loop.tick import STOP, TickData
from rollerrig.rig.compiled import compile_progress
from rollerrig.rig.plant import Plant
from rollerrig.wsp_interface import signals

# kernels that the first run of each pacing compiles (a test counts them); the messages need them
KERNELS = {"free": 222, "lockstep": 221, "wall": 233}
# a unit that answers in the tick of its SYNC, in every cycle: an ideal bus
_IMMEDIATE_ANSWER = (0, 0, 1)


def build(
    plan: Scenario,
    ring: Ring | Memory,
    speed_m_s: float | None = None,
    seed: int = 0,
    seat: tuple[np.ndarray, int] | None = None,
) -> TickData:
    """Return what the ticks of a scenario work on, with no magnet energised.

    The speed is `speed_m_s`, or the initial speed of the scenario; `seat` as for `Plant`.
    """
    if speed_m_s is None:
        speed_m_s = plan["initial_speed_m_s"]
    plant = Plant(plan.params, speed_m_s, seat)
    rollers = Plant(plan.rollers, speed_m_s) if plan.rollers else plant
    tick_hz = plan["loop"]["tick_hz"]
    width = signals.WIDTH
    kind = plan.kind
    commands = mailbox.mailbox(tick.COMMANDS)
    commands.values[:] = tick.first_command()
    commands.second[:] = commands.values
    # only the writer of a ring has its memory
    assert isinstance(ring.header, np.ndarray)
    data = TickData(
        params=plan.params,
        state=plant.state,
        buffer=plant.buffer,
        delay=plant.delay,
        control=np.zeros(tick.SLOTS_OF_CONTROL, dtype=np.int64),
        commands=commands,
        command=commands.values.copy(),
        published=mailbox.mailbox(width),
        row=np.zeros(width),
        kept=plan.table.kept,
        gather=tick.gather(kind, rig=plant.number),
        ring_header=ring.header,
        ring_rows=ring.rows,
        virtual=int(plan.rollers is not None),
        roller_params=rollers.params,
        roller_state=rollers.state,
        roller_buffer=rollers.buffer,
        roller_delay=rollers.delay,
        gather_rollers=tick.gather(kind, tick.OF_ROLLERS if plan.rollers else ()),
        record_ticks=plan.record_ticks,
        end_tick=round(plan["duration_max_s"] * tick_hz),
        stand_ticks=round(plan["stand_s"] * tick_hz),
        hold=held_rig.steady(speed_m_s),
        answer=np.array(wire_delay.answer_ticks(plan) or _IMMEDIATE_ANSWER),
        pulses=pole_wheel.memory(seed, kind.axles),
        sensor=_sensor(plan),
    )
    tick.publish(data)
    return data


def _sensor(plan: Scenario) -> pole_wheel.Sensor:
    sensor = plan["sensor"]
    tick_hz = plan["loop"]["tick_hz"]
    return pole_wheel.Sensor(
        pole_wheel.MODELS[sensor["model"]],
        sensor["teeth"],
        max(1, round(sensor["window_s"] * tick_hz)),
        sensor["dropout_rad_s"],
        sensor["timer_Hz"],
        1.0 / tick_hz,
        plan["flats"]["noise_rad_s_m"],
        sensor["noise_rad_s"],
    )


def warm_up(
    data: TickData,
    pacing: str,
    unit: str = "none",
    ticks: tick.RunsTicks | None = None,
    wall: Callable[..., object] = loop.wall,
) -> None:
    """Compile, or load, the kernels that the pacing calls with a unit, without running a tick.

    `ticks` and `wall` run the ticks of `data`, as in `Parts`; default: those of a vehicle alone.
    """
    if pacing == "wall":
        _warm_up_wall(data, wall)
    elif pacing == "lockstep" or unit != "reference":
        # a free run with the reference unit calls the ticks inside its loop, and compiles them
        # there
        (ticks or tick.Ticks(data)).run(0)
    if pacing == "free":
        return  # it has no bus, and its unit is called inside the loop
    if unit == "reference" and compile_progress.has_compiled():
        # what the process of the unit would compile while the bench waits for its heartbeat
        node.warm(logic.load("reference"))
    # the calls of the bus thread: a compiler in the first SYNC cycle would look like a lost unit
    mailbox.fetch(data.published, data.row.copy())
    mailbox.post(data.commands, data.commands.values.copy())


def _warm_up_wall(data: TickData, wall: Callable[..., object]) -> None:
    """Call the real-time loop with STOP set, so that it returns before its first tick."""
    stop = data.control[STOP]
    data.control[STOP] = 1
    descriptor = clock.eventfd()
    wall(
        data,
        1_000_000,
        1,
        0,
        descriptor,
        np.zeros(loop.BINS, dtype=np.int64),
        np.zeros(3, dtype=np.int64),
        0,
    )
    os.close(descriptor)
    data.control[STOP] = stop
