"""How long a WSP unit's answer is on its way where frames wait for the wire, for runs without a bus.

Free pacing calls the reference unit in the tick. Where the bus has a wire (`wsp_interface.bus.wire`) the magnets must
act as late as they do in lockstep, so the rig's own nodes are put on that wire for a few cycles, and the ticks are
counted from a SYNC to the end of the frame that answers it; longer in a cycle with heartbeats.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import rig_bus
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, REFERENCE_SPEED


def _rehearse(plan: Scenario, cycles: int) -> list[int | None]:
    """Ticks from each cycle's SYNC to the tick that has the answer; None: not in the cycle."""
    now, answered_at, tick_ns = 0, None, S_NS // plan["loop"]["tick_hz"]

    def now_ns() -> int:
        return now * tick_ns

    def note(frame: Frame) -> None:
        nonlocal answered_at
        if frame.can_id == MAGNETS_ID:
            answered_at = now

    hub = Hub(now_ns, plan["bus"]["bitrate"])
    # the nodes shall not find or keep anything in a folder
    alone = dataclasses.replace(plan, resolved=plan.resolved | {"bus": plan["bus"] | {"store": ""}})
    bus = rig_bus.RigBus(
        hub,
        alone,
        np.zeros(len(signals.COLUMNS)),
        lambda row: None,
        events.ignore,
        now_ns,
        "lockstep",
    )
    unit = hub.attach(lambda frame: None, "unit")
    delays: list[int | None] = []
    hub.tap(note)
    bus.start_wire(timed=False)
    for _ in range(cycles):
        begin, asked, answered_at = now, False, None
        bus.sync()
        bus.poll()
        for _ in range(plan.sync_ticks):
            hub.advance(now_ns())
            if not asked and not hub.wire:
                asked = True
                unit.send(Frame(REFERENCE_SPEED.can_id, bytes(2)))
                unit.send(Frame(MAGNETS_ID, bytes(1)))
            now += 1
        delays.append(None if answered_at is None else answered_at - begin)
    return delays


def answer_ticks(plan: Scenario) -> tuple[int, int, int] | None:
    """Delay in ticks of an answer, in an ordinary cycle and in one with heartbeats, and cycles between these.

    (0, 0, 1) on an ideal bus; None where the wire cannot carry an answer within a bus cycle.
    """
    if not plan["bus"]["arbitration"]:
        return 0, 0, 1
    bus: dict[str, Any] = plan["bus"]
    beat_cycles = math.ceil(bus["heartbeat_s"] / bus["sync_period_s"] - 1e-9)
    delays = _rehearse(plan, 2 * beat_cycles + 1)
    plain, beating = delays[max(1, beat_cycles - 1)], delays[beat_cycles]
    return None if plain is None or beating is None else (plain, beating, beat_cycles)


def check(plan: Scenario, pacing: str) -> None:
    """Refuse a run without a bus on a wire that cannot carry its answers. Raises ConfigError."""
    if pacing == "free" and answer_ticks(plan) is None:
        bus = plan["bus"]
        raise ConfigError(
            f"[bus] bitrate = {bus['bitrate']} bit/s cannot carry SYNC, process data and the unit's "
            f"answer within sync_period_s = {bus['sync_period_s']:g} s, as --pacing free with "
            "arbitration = true needs it; raise one of them, or see it overload with --pacing lockstep"
        )
