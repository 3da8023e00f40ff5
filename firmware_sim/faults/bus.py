"""Faults of the bus: a gate that each frame passes on its way.

A frame may be lost, held until later or sent twice, or destroyed by error frames, which the
controllers count (`confinement`). A babbling node sends as fast as it is told to.

Limits: on an ideal bus error frames and babbling cost load, but delay nobody; with `[bus]
arbitration` they take the wire's time.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from rollerrig.firmware_sim.faults.confinement import Controllers
from rollerrig.wsp_interface.bus.connection_set import HEARTBEAT
from rollerrig.wsp_interface.bus.frames import S_NS, Frame
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, REFERENCE_SPEED, UNIT_HEARTBEAT_ID

# what carries a frame on, once the gate lets it
Carry = Callable[[], None]
LOST, HELD, TWICE = "lost", "held", "twice"
# what a WSP unit sends: heartbeat, PDO1 to the brake I/O, reference speed
UNIT_IDS = (UNIT_HEARTBEAT_ID, MAGNETS_ID, REFERENCE_SPEED.can_id)
FOREVER_NS = 1 << 62


@dataclass
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


@dataclass
class Gate:
    """What frames pass between their sender and everybody else.

    `controllers` say whether error frames destroy it; rules are by identifier. Times are those of
    the bus's clock.
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

    def remove(self, rules: Iterable[Rule]) -> None:
        """End rules; what they hold back goes out now."""
        ended = list(rules)
        for rule in ended:
            self.rules[rule.can_id].remove(rule)
            if not self.rules[rule.can_id]:
                del self.rules[rule.can_id]
        due = [one for one in self._held if any(one[1] is rule for rule in ended)]
        self._held = [one for one in self._held if not any(one[1] is rule for rule in ended)]
        for _, _, carry in due:
            carry()

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
        due = [one for one in self._held if one[0] <= now_ns]
        self._held = [one for one in self._held if one[0] > now_ns]
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


def babble(one: Babble, now_ns: int, transmit: Callable[[Frame], None]) -> None:
    """Send what a babbling node should have sent by now."""
    wanted = int((now_ns - one.since_ns) * one.rate_Hz / S_NS)
    frame = Frame(one.can_id, b"\xff" * 8)
    for _ in range(one.sent, wanted):
        transmit(frame)
    one.sent = max(one.sent, wanted)


def rules_of(name: str, values: dict[str, Any]) -> list[Rule]:
    """The rules of a fault of the catalogue, none where it needs none."""
    make = {
        "frame_lost": lambda: [Rule(LOST, values["can_id"], values["every"])],
        "frame_duplicated": lambda: [Rule(TWICE, values["can_id"], values["every"])],
        "frame_delayed": lambda: [Rule(HELD, values["can_id"], 1, _ns(values["delay_s"]))],
        "heartbeat_late": lambda: [Rule(HELD, HEARTBEAT + values["node"], 1, _ns(values["delay_s"]))],
    }
    return make.get(name, list)()


def hold_unit() -> list[Rule]:
    """The rules that hold back what a WSP unit sends."""
    return [Rule(HELD, can_id, 1, FOREVER_NS) for can_id in UNIT_IDS]


def _ns(delay_s: float) -> int:
    return round(delay_s * S_NS)
