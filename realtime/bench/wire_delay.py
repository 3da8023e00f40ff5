"""The delay of a unit's answer where frames wait for the wire, for runs without a bus.

Free pacing calls the reference unit in the tick. Where the bus has a wire
(`wsp_interface.bus.wire`) the magnets must act as late as they do in lockstep. So the nodes of the
rig run on that wire for a few cycles, and the ticks are counted from a SYNC to the end of the frame
that answers it. The delay is longer in a cycle with heartbeats.
"""

import dataclasses
import math

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import rig_bus
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, REFERENCE_SPEED_ID

# a ratio of times that is whole but for rounding errors
_ROUNDING = 1e-9


def _rehearse(plan: Scenario, cycles: int) -> list[int | None]:
    """Return the ticks from the SYNC of each cycle to the tick that has the answer.

    None: no answer.
    """
    tick_ns = S_NS // plan["loop"]["tick_hz"]
    now_tick = 0
    answered_at: int | None = None

    def now_ns() -> int:
        return now_tick * tick_ns

    def note(frame: Frame) -> None:
        nonlocal answered_at
        if frame.can_id == MAGNETS_ID:
            answered_at = now_tick

    hub = Hub(now_ns, plan["bus"]["bitrate"])
    # without a folder: the nodes must neither find nor store parameters there
    resolved = plan.resolved | {"bus": plan["bus"] | {"store": ""}}
    bus = rig_bus.RigBus(
        hub,
        dataclasses.replace(plan, resolved=resolved),
        np.zeros(signals.WIDTH),
        lambda row: None,
        events.ignore,
        now_ns,
        "lockstep",
    )
    unit = hub.attach(lambda frame: None, "unit")
    hub.tap(note)
    bus.start_wire(timed=False)

    delays: list[int | None] = []
    for _ in range(cycles):
        begin = now_tick
        answered_at = None
        has_sent = False
        bus.sync()
        bus.poll()
        for _ in range(plan.sync_ticks):
            hub.advance(now_ns())
            if not has_sent and not hub.wire:
                has_sent = True
                unit.send(Frame(REFERENCE_SPEED_ID, bytes(2)))
                unit.send(Frame(MAGNETS_ID, bytes(1)))
            now_tick += 1
        delays.append(None if answered_at is None else answered_at - begin)
    return delays


def answer_ticks(plan: Scenario) -> tuple[int, int, int] | None:
    """Return the delay of an answer in ticks, that in a cycle with heartbeats, and their period.

    The period is in cycles. (0, 0, 1) on an ideal bus; None where the wire cannot carry an answer
    within a bus cycle.
    """
    bus = plan["bus"]
    if not bus["arbitration"]:
        return 0, 0, 1
    beat_cycles = math.ceil(bus["heartbeat_s"] / bus["sync_period_s"] - _ROUNDING)
    delays = _rehearse(plan, 2 * beat_cycles + 1)
    without_beats = delays[max(1, beat_cycles - 1)]
    with_beats = delays[beat_cycles]
    if without_beats is None or with_beats is None:
        return None
    return without_beats, with_beats, beat_cycles


def check(plan: Scenario, pacing: str) -> None:
    """Refuse a run without a bus on a wire that cannot carry its answers. Raises ConfigError."""
    if pacing == "free" and answer_ticks(plan) is None:
        bus = plan["bus"]
        raise ConfigError(
            f"[bus] bitrate = {bus['bitrate']} bit/s cannot carry SYNC, process data and the answer of "
            f"the unit within sync_period_s = {bus['sync_period_s']:g} s, and --pacing free with "
            "arbitration = true requires that; raise one of them, or observe the overload with "
            "--pacing lockstep"
        )
