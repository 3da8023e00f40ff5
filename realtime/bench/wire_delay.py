"""How long a WSP unit's answer is on its way where frames wait for the wire, for runs without a bus.

Free pacing calls the reference unit in the tick. Where the scenario's bus has a wire the magnets must
act as late as they do in lockstep, so the rig's own nodes are put on that wire for a few cycles, and
the ticks are counted from a SYNC to the end of the frame that answers it. A cycle in which the nodes
also send their heartbeats is longer. Source: `wsp_interface.bus.wire`; lockstep's rule is the bench's.
"""

import math
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import rig_bus
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, REFERENCE_SPEED


class Rehearsal:
    """The rig's nodes on a wire, in simulated time, with somebody who answers."""

    def __init__(self, plan: Scenario) -> None:
        self.plan, self.tick = plan, 0
        self.tick_ns = S_NS // plan["loop"]["tick_hz"]
        self.hub = Hub(self._now_ns, plan["bus"]["bitrate"])
        self.bus = rig_bus.RigBus(self.hub, _without_store(plan), np.zeros(len(signals.COLUMNS)), lambda row: None,
                                  lambda level, text: None, self._now_ns, "lockstep")
        self.unit = self.hub.attach(lambda frame: None, "unit")
        self.answered_at: int | None = None
        self.hub.tap(self._note)
        self.bus.start_wire(timed=False)

    def _now_ns(self) -> int:
        return self.tick * self.tick_ns

    def _note(self, frame: Frame) -> None:
        if frame.can_id == MAGNETS_ID:
            self.answered_at = self.tick

    def cycle(self) -> int | None:
        """Ticks from this cycle's SYNC to the tick that has the answer; None: not in this cycle."""
        begin, asked, self.answered_at = self.tick, False, None
        self.bus.sync()
        self.bus.poll()
        for _ in range(self.plan.sync_ticks):
            self.hub.advance(self._now_ns())
            if not asked and not self.hub.wire:
                asked = True
                self.unit.send(Frame(REFERENCE_SPEED.can_id, bytes(2)))
                self.unit.send(Frame(MAGNETS_ID, bytes(1)))
            self.tick += 1
        last = self.answered_at
        return None if last is None else last - begin


def answer_ticks(plan: Scenario) -> tuple[int, int, int] | None:
    """Delay in ticks of an answer, in an ordinary cycle and in one with heartbeats, and cycles between these.

    (0, 0, 1) on an ideal bus; None where the wire cannot carry an answer within a bus cycle.
    """
    if not plan["bus"]["arbitration"]:
        return 0, 0, 1
    bus: dict[str, Any] = plan["bus"]
    beat_cycles = math.ceil(bus["heartbeat_s"] / bus["sync_period_s"] - 1e-9)
    rehearsal = Rehearsal(plan)
    delays = [rehearsal.cycle() for _ in range(2 * beat_cycles + 1)]
    plain, beating = delays[max(1, beat_cycles - 1)], delays[beat_cycles]
    return None if plain is None or beating is None else (plain, beating, beat_cycles)


def check(plan: Scenario, pacing: str) -> None:
    """Refuse a run without a bus on a wire that cannot carry its answers. Raises ConfigError."""
    if pacing == "free" and answer_ticks(plan) is None:
        bus = plan["bus"]
        raise ConfigError(f"[bus] bitrate = {bus['bitrate']} bit/s cannot carry SYNC, process data and the unit's "
                          f"answer within sync_period_s = {bus['sync_period_s']:g} s, as --pacing free with "
                          "arbitration = true needs it; raise one of them, or see it overload with --pacing lockstep")


def _without_store(plan: Scenario) -> Any:
    """What the bus reads of a plan; its nodes shall not find or keep anything in a folder."""
    return plan.resolved | {"bus": plan["bus"] | {"store": ""}}
