"""Faults of the bus: a gate that each frame passes between its sender and the other nodes.

The gate may lose a frame, hold it back, or send it twice. Error frames may destroy it; the
controllers count these (`confinement`). A babbling node floods the bus at a given rate.

Limits: on an ideal bus error frames and babbling increase the load, but delay no frame. With `[bus]
arbitration` they take time on the wire.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from rollerrig.firmware_sim.cia301.host import NEVER
from rollerrig.firmware_sim.faults.catalogue import ALL_GROUPS, Fault
from rollerrig.firmware_sim.faults.confinement import Controllers
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.rig_objects import unit_frames

Carry = Callable[[], None]  # passes a frame on to the other nodes
# effects of a rule
LOST = "lost"
HELD = "held"
TWICE = "twice"
_EFFECTS = {
    "frame_lost": LOST,
    "frame_duplicated": TWICE,
    "frame_delayed": HELD,
    "heartbeat_late": HELD,
}


@dataclass(eq=False)
class Rule:
    """The effect on frames of one identifier.

    `every`: 1 for each frame, 2 for every second one. `count`: frames so far; `hit`: those
    affected.
    """

    effect: str
    can_id: int
    every: int = 1
    delay_ns: int = 0
    count: int = 0
    hit: int = 0


@dataclass
class Babble:
    """A flood of frames with one identifier since `since_ns`; `sent` frames so far."""

    can_id: int
    rate_Hz: float
    since_ns: int
    sent: int = 0

    def go_on(self, now_ns: int, transmit: Callable[[Frame], None]) -> None:
        """Send the frames that are due at `now_ns`."""
        due = int((now_ns - self.since_ns) * self.rate_Hz / S_NS)
        for _ in range(self.sent, due):
            transmit(Frame(self.can_id, b"\xff" * 8))
        self.sent = max(self.sent, due)


class HeldFrame(NamedTuple):
    """A frame that is held back until `due_ns`, and the rule that holds it."""

    due_ns: int
    rule: Rule
    carry: Carry


@dataclass
class Gate:
    """The gate that frames pass between their sender and the other nodes.

    `controllers` decide whether error frames destroy a frame. `rules` are by identifier. Times are
    those of the clock of the bus.
    """

    controllers: Controllers
    rules: dict[int, list[Rule]] = field(default_factory=dict)
    now_ns: int = 0
    _held: list[HeldFrame] = field(default_factory=list)

    @property
    def idle(self) -> bool:
        """Whether the gate passes every frame unchanged."""
        return not (self.rules or self.controllers.nodes or self._held)

    def add(self, rule: Rule) -> Rule:
        """Let a rule act from now on."""
        self.rules.setdefault(rule.can_id, []).append(rule)
        return rule

    def remove(self, rules: list[Rule]) -> None:
        """End rules; the frames that they hold back are sent now."""
        for rule in rules:
            self.rules[rule.can_id].remove(rule)
            if not self.rules[rule.can_id]:
                del self.rules[rule.can_id]
        self._release(lambda held: held.rule in rules)

    def passes(self, frame: Frame, node: int, carry: Carry) -> bool:
        """Whether a frame is passed on now. If not, it is lost, or `carry` is called later."""
        if self.controllers.nodes and not self.controllers.passes(frame, node):
            return False
        if frame.extended:
            return True
        # every rule counts the frame, also after another one has stopped it
        verdicts = [self._judge(rule, carry) for rule in self.rules.get(frame.can_id, ())]
        return all(verdicts)

    def poll(self, now_ns: int) -> None:
        """Pass on the held frames that are due at `now_ns`, the earliest first."""
        self.now_ns = now_ns
        self._release(lambda held: held.due_ns <= now_ns)

    def _release(self, ends: Callable[[HeldFrame], bool]) -> None:
        """Pass on the held frames for which `ends` is true."""
        released = [held for held in self._held if ends(held)]
        self._held = [held for held in self._held if not ends(held)]
        for held in sorted(released, key=lambda held: held.due_ns):
            held.carry()

    def _judge(self, rule: Rule, carry: Carry) -> bool:
        """Whether a rule passes a frame on now."""
        rule.count += 1
        if rule.count % rule.every:
            return True
        rule.hit += 1
        if rule.effect == TWICE:
            carry()
            return True
        if rule.effect == HELD:
            self._held.append(HeldFrame(self.now_ns + rule.delay_ns, rule, carry))
        return False


def frozen_groups(fault: Fault) -> frozenset[int]:
    """Return the groups (from 0) whose units a fault `wsp_frozen` stops."""
    group = fault.values.get("group", ALL_GROUPS)
    if group == ALL_GROUPS:
        return frozenset(range(fault.vehicle.groups))
    return frozenset((group - 1,))


def rules_of(fault: Fault) -> list[Rule]:
    """The rules of a fault of the catalogue; empty if it needs none."""
    name = fault.kind.name
    values = fault.values
    if name == "wsp_frozen":
        of_units: list[int] = []
        for group in frozen_groups(fault):
            frames = unit_frames(fault.table, group)
            of_units += (frames.heartbeat_id, frames.magnets_id, frames.reference_speed.can_id)
        return [Rule(HELD, can_id, delay_ns=NEVER) for can_id in of_units]
    if name not in _EFFECTS:
        return []
    can_id = values["can_id"] if "can_id" in values else HEARTBEAT + values["node"]
    delay_ns = round(values.get("delay_s", 0.0) * S_NS)
    return [Rule(_EFFECTS[name], can_id, values.get("every", 1), delay_ns)]
