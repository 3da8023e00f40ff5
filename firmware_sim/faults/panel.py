"""The panel from which faults are injected and lifted, by their schedule or by hand.

Each change is an event of the run. What acts in the tick or on the bus is set anew from all faults that are active,
so faults may overlap and the last to be lifted leaves a sound rig. A drive that has tripped is reset and enabled
again when its fault is lifted, if the rig control has it; a master on the bus has to reset its drives itself.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.faults import bus, catalogue, confinement, effects
from rollerrig.firmware_sim.faults.bus import Babble, Gate, Rule
from rollerrig.firmware_sim.faults.catalogue import LASTS, TICK, Fault
from rollerrig.firmware_sim.faults.confinement import Confinement, Controllers
from rollerrig.firmware_sim.rack import Rack
from rollerrig.wsp_interface.events import Code, OnEvent
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, VENT_MAGNET
from rollerrig.wsp_interface.signals import DRIVE_NODES

# below this the supply of the electronics is gone too
ELECTRONICS_V = 200.0

# what a fault writes into the array of the tick: (slot, axle, value) from its values
_EFFECTS: dict[str, Callable[[dict[str, Any]], list[tuple[int, int, float]]]] = {
    "speed_sensor_stuck": lambda v: [(effects.STUCK, v["axle"], 1.0)],
    "speed_sensor_dropout": lambda v: [(effects.DROPOUT, v["axle"], 1.0)],
    "missing_tooth": lambda v: [(effects.MISSING_TEETH, v["axle"], float(v["teeth"]))],
    "swapped_axles": lambda v: [
        (effects.SOURCE, v["axle"], float(v["other"])),
        (effects.SOURCE, v["other"], float(v["axle"])),
    ],
    "speed_noise_burst": lambda v: [(effects.NOISE_rad_s, v["axle"], v["std_rad_s"])],
    "wheel_diameter_mismatch": lambda v: [
        (effects.LARGER, v["axle"], v["difference_percent"] / 100.0)
    ],
    "hold_magnet_stuck": lambda v: [(effects.MAGNETS_ON, v["axle"], HOLD_MAGNET)],
    "hold_magnet_dead": lambda v: [(effects.MAGNETS_OFF, v["axle"], HOLD_MAGNET)],
    "vent_magnet_stuck": lambda v: [(effects.MAGNETS_ON, v["axle"], VENT_MAGNET)],
    "vent_magnet_dead": lambda v: [(effects.MAGNETS_OFF, v["axle"], VENT_MAGNET)],
    "cylinder_leak": lambda v: [(effects.LEAK_per_s, v["axle"], 1.0 / v["time_constant_s"])],
    "drive_over_temperature": lambda v: [(effects.MOTOR_LOAD, v["axle"], v["load"])],
    "sander_empty": lambda v: [(effects.SAND_EMPTY, v["axle"], 1.0)],
    "sander_blocked": lambda v: [(effects.SAND_FLAW, v["axle"], -1.0)],
    "sander_wrong_orifice": lambda v: [(effects.SAND_FLAW, v["axle"], v["factor"] - 1.0)],
    "sander_late": lambda v: [(effects.SAND_LATE_s, v["axle"], v["delay_s"])],
    "torque_ripple": lambda v: [
        (effects.RIPPLE_Nm, v["axle"], v["amplitude_Nm"]),
        (effects.RIPPLE_ORDER, v["axle"], v["order"]),
    ],
}
# what a fault of error frames sets of the node's controller
_DISTURBS = {"error_frame": "attempts", "receive_error": "finds"}


@dataclass
class Site:
    """What faults act on. `array` (effects.SIZE,) is part of the commands, `post()` hands it to the tick; without a
    bus there is nothing else. `freeze(on)` stops a unit's process, and says whether there was one.
    """

    array: np.ndarray
    post: Callable[[], None]
    nodes: dict[int, Node] = field(default_factory=dict)
    rack: Rack = field(default_factory=Rack)
    gate: Gate = field(default_factory=lambda: Gate(Controllers(lambda *lost: None)))
    clock_ns: Callable[[], int] = lambda: 0
    bitrate: int = 500_000
    disturb: Callable[[], None] = lambda: None
    freeze: Callable[[bool], bool] = lambda on: False


@dataclass
class Active:
    """A fault that holds, until when, and what it has set up on the bus."""

    fault: Fault
    until_s: float
    rules: list[Rule] = field(default_factory=list)
    babble: Babble | None = None


class Panel:
    """Faults to come and faults that hold, on `site`. `on_event(code, **fields)` records each change."""

    site: Site

    def __init__(self, planned: Iterable[Fault], on_event: OnEvent) -> None:
        self.active: dict[tuple[str, Any], Active] = {}
        self.now_s = 0.0
        self._on_event = on_event
        self.schedule(planned)

    def schedule(self, planned: Iterable[Fault]) -> None:
        """Plan the faults of a scenario, in place of those planned before."""
        self.waiting = sorted(planned, key=lambda one: one.at_s)

    def connect(self, site: Site) -> None:
        """Say what the faults act on."""
        self.site = site
        self._confinement = Confinement(
            site.gate.controllers,
            dict(site.nodes),
            lambda node, on: site.rack.mute(site.nodes[node], on),
            lambda node, on: site.rack.deafen(site.nodes[node], on),
            site.bitrate,
        )
        self._links_V = {
            node: site.nodes[node].device.axis.dc_link_V
            for node in DRIVE_NODES
            if node in site.nodes
        }

    def inject(self, name: str, **values: Any) -> Fault:
        """Let a fault begin now, in place of one of its kind and target; it holds for `for_s`. Raises ConfigError."""
        fault = catalogue.make({"kind": name, "at_s": self.now_s} | values, f"fault {name}")
        check_pacing((fault,), "lockstep" if self.site.nodes else "free")
        self._begin(fault)
        return fault

    def clear(self, name: str = "", **aim: Any) -> int:
        """Lift the active faults of a name (of all, without one) and aim; returns how many."""
        lifted = [
            key
            for key, one in self.active.items()
            if name in ("", one.fault.kind.name)
            and all(one.fault.values.get(what) == value for what, value in aim.items())
        ]
        for key in lifted:
            self._lift(key)
        return len(lifted)

    def poll(self, now_s: float) -> None:
        """It is `now_s` of simulated time: begin, lift and go on with what is due."""
        self.now_s = now_s
        if not (self.active or self._confinement.busy) and not (
            self.waiting and self.waiting[0].at_s <= now_s
        ):
            return
        for key in [key for key, one in self.active.items() if one.until_s <= now_s]:
            self._lift(key)
        while self.waiting and self.waiting[0].at_s <= now_s:
            self._begin(self.waiting.pop(0))
        self._go_on()

    def next_change_s(self) -> float:
        """When the schedule has something to do again; inf if never."""
        ends = (one.until_s for one in self.active.values())
        return min([*ends, *(one.at_s for one in self.waiting[:1])], default=LASTS)

    def _begin(self, fault: Fault) -> None:
        if fault.target in self.active:
            self._lift(fault.target)
        one = self.active[fault.target] = Active(fault, self.now_s + fault.for_s)
        if fault.told:
            self._on_event(Code.FAULT_BEGINS, **fault.event_fields)
        self._act(one, True)
        self._settle()
        self._go_on()

    def _lift(self, target: tuple[str, Any]) -> None:
        one = self.active.pop(target)
        if one.fault.told:
            frames_met = sum(rule.hit for rule in one.rules) if one.rules else None
            self._on_event(Code.FAULT_LIFTED, **one.fault.event_fields, frames_met=frames_met)
        self._act(one, False)
        self._settle()

    def _act(self, one: Active, on: bool) -> None:
        """Set up what a fault does on the bus and in devices, or put it back."""
        site, name, values = self.site, one.fault.kind.name, one.fault.values
        frozen = name == "wsp_frozen" and site.freeze(on)
        if on:
            # the frames of a unit whose process cannot be stopped are held back
            one.rules = [] if frozen else bus.rules_of(name, values)
            for rule in one.rules:
                site.gate.add(rule)
        else:
            site.gate.remove(one.rules)
        if name in _DISTURBS:
            self._confinement.disturb(
                values["node"], **{_DISTURBS[name]: values["attempts"] if on else 0}
            )
        elif name == "node_babbling" and on:
            one.babble = Babble(values["can_id"], values["rate_Hz"], site.clock_ns())
        elif name == "drive_over_temperature":
            self._drive(values).axis.heat.load = values["load"] if on else 0.0
        if not on and name in ("drive_trip", "drive_over_temperature"):
            self._drive(values).recover()
        elif not on and name == "power_dip":
            for node, volt in self._links_V.items():
                site.nodes[node].device.axis.dc_link_V = volt
                site.nodes[node].device.recover()

    def _settle(self) -> None:
        """Set the tick's array, power, controllers and gate as all active faults want them."""
        array, wanted = self.site.array, np.zeros(effects.SIZE)
        for one in self.active.values():
            writes = _EFFECTS.get(one.fault.kind.name)
            for kind, axle, value in writes(one.fault.values) if writes else ():
                at = effects.slot(kind, axle)
                wanted[effects.ANY] = 1.0
                magnets = kind in (effects.MAGNETS_ON, effects.MAGNETS_OFF)
                wanted[at] = float(int(wanted[at]) | int(value)) if magnets else value
        if not np.array_equal(array, wanted):
            array[:] = wanted
            self.site.post()
        self._settle_nodes()
        self.site.disturb()

    def _settle_nodes(self) -> None:
        site = self.site
        without, muted, link_V = set[int](), set[int](), None
        for one in self.active.values():
            name, values = one.fault.kind.name, one.fault.values
            if name == "node_off":
                without.add(values["node"])
            elif name == "bus_off":
                muted.add(values["node"])
            elif name == "power_dip":
                link_V = values["dc_link_V"]
                without |= set(site.nodes) if link_V < ELECTRONICS_V else set()
        for number, node in site.nodes.items():
            if (id(node) in site.rack.off) != (number in without):
                site.rack.power(node, number not in without, site.clock_ns())
            if (id(node) in site.rack.muted) != (number in muted):
                site.rack.mute(node, number in muted)
                if number not in muted:
                    confinement.recover(node)
            if link_V is not None and number in self._links_V:
                node.device.axis.dc_link_V = link_V

    def _go_on(self) -> None:
        """What active faults do again and again."""
        site, now_ns = self.site, self.site.clock_ns()
        site.gate.poll(now_ns)
        if self._confinement.busy:
            self._confinement.poll(now_ns)
            if not self._confinement.busy:
                site.disturb()
        for one in list(self.active.values()):
            name, values = one.fault.kind.name, one.fault.values
            if one.babble:
                one.babble.go_on(now_ns, partial(site.rack.transmit, site.nodes[values["node"]]))
            elif name == "drive_trip":
                self._drive(values).trip(values["code"], "injected")
            elif name == "drive_over_temperature":
                heat = self._drive(values).axis.heat
                heat.load = max(heat.load, values["load"])

    def _drive(self, values: dict[str, Any]) -> Any:
        return self.site.nodes[DRIVE_NODES[values["axle"] - 1]].device


def check_pacing(planned: Iterable[Fault], pacing: str) -> None:
    """Refuse faults of the bus where there is none. Raises ConfigError."""
    for fault in planned:
        if pacing == "free" and fault.kind.acts != TICK:
            raise ConfigError(
                f"fault {fault.kind.name} acts on the bus, and --pacing free has none; "
                "use --pacing lockstep or wall"
            )
