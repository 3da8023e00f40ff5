"""Faults of the bus: a gate that each frame passes on its way.

A frame may be lost, held until later or sent twice, or destroyed by error frames, which the
controllers count (`confinement`). A babbling node sends as fast as it is told to.

Limits: on an ideal bus error frames and babbling cost load, but delay nobody; with `[bus]
arbitration` they take the wire's time.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rollerrig.firmware_sim.cia301.host import NEVER
from rollerrig.firmware_sim.faults.confinement import Controllers
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, REFERENCE_SPEED, UNIT_HEARTBEAT_ID

# what carries a frame on, once the gate lets it
Carry = Callable[[], None]
LOST, HELD, TWICE = "lost", "held", "twice"
_WHAT = {
    "frame_lost": LOST,
    "frame_duplicated": TWICE,
    "frame_delayed": HELD,
    "heartbeat_late": HELD,
}


@dataclass(eq=False)
class Rule:
    """What happens to frames of one identifier. `count`: those seen so far, `hit` those it met."""

    what: str
    can_id: int
    every: int = 1
    delay_ns: int = 0
    count: int = 0
    hit: int = 0


@dataclass
class Babble:
    """Frames of `can_id` from a node since `since_ns`: `sent` so far."""

    can_id: int
    rate_Hz: float
    since_ns: int
    sent: int = 0

    def go_on(self, now_ns: int, transmit: Callable[[Frame], None]) -> None:
        """Send what should have been sent by now."""
        wanted = int((now_ns - self.since_ns) * self.rate_Hz / S_NS)
        for _ in range(self.sent, wanted):
            transmit(Frame(self.can_id, b"\xff" * 8))
        self.sent = max(self.sent, wanted)


@dataclass
class Gate:
    """What frames pass between their sender and everybody else.

    `controllers` say whether error frames destroy it; rules are by identifier. Times are those of the bus's clock.
    """

    controllers: Controllers
    rules: dict[int, list[Rule]] = field(default_factory=dict)
    now_ns: int = 0
    _held: list[tuple[int, Rule, Carry]] = field(default_factory=list)

    @property
    def idle(self) -> bool:
        """Whether nothing is to be done to any frame."""
        return not (self.rules or self.controllers.nodes or self._held)

    def add(self, rule: Rule) -> Rule:
        """Let a rule act from now on."""
        self.rules.setdefault(rule.can_id, []).append(rule)
        return rule

    def remove(self, rules: list[Rule]) -> None:
        """End rules; what they hold back goes out now."""
        for rule in rules:
            self.rules[rule.can_id].remove(rule)
            if not self.rules[rule.can_id]:
                del self.rules[rule.can_id]
        self._release(lambda due_ns, rule: rule in rules)

    def passes(self, frame: Frame, node: int, carry: Carry) -> bool:
        """Whether the frame goes on now; if not it is lost, or `carry` is called later."""
        if self.controllers.nodes and not self.controllers.passes(frame, node):
            return False
        if frame.extended:
            return True
        return all([self._judge(rule, carry) for rule in self.rules.get(frame.can_id, ())])

    def poll(self, now_ns: int) -> None:
        """It is `now_ns`: what was held long enough goes out, in the order of its sending."""
        self.now_ns = now_ns
        self._release(lambda due_ns, rule: due_ns <= now_ns)

    def _release(self, ends: Callable[[int, Rule], bool]) -> None:
        due = [one for one in self._held if ends(one[0], one[1])]
        self._held = [one for one in self._held if not ends(one[0], one[1])]
        for _, _, carry in sorted(due, key=lambda one: one[0]):
            carry()

    def _judge(self, rule: Rule, carry: Carry) -> bool:
        rule.count += 1
        if rule.count % rule.every:
            return True
        rule.hit += 1
        if rule.what == HELD:
            self._held.append((self.now_ns + rule.delay_ns, rule, carry))
        elif rule.what == TWICE:
            carry()
        return rule.what == TWICE


def rules_of(name: str, values: dict[str, Any]) -> list[Rule]:
    """The rules of a fault of the catalogue, none where it needs none."""
    if name == "wsp_frozen":
        # what a WSP unit sends: heartbeat, PDO1 to the brake I/O, reference speed
        return [
            Rule(HELD, one, 1, NEVER)
            for one in (UNIT_HEARTBEAT_ID, MAGNETS_ID, REFERENCE_SPEED.can_id)
        ]
    if name not in _WHAT:
        return []
    can_id = values["can_id"] if "can_id" in values else HEARTBEAT + values["node"]
    return [
        Rule(_WHAT[name], can_id, values.get("every", 1), round(values.get("delay_s", 0.0) * S_NS))
    ]
