"""The panel from which faults are injected and lifted, by their schedule or by hand.

Each change is an event of the run. What acts in the tick or on the bus is set anew from all faults
that are active, so faults may overlap and the last to be lifted leaves a sound rig. A drive that
has tripped is reset and enabled again when its fault is lifted, if the rig control has it; a master
on the bus has to reset its drives itself.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.faults import bus, confinement
from rollerrig.firmware_sim.faults import catalogue as faults
from rollerrig.firmware_sim.faults import effects as fault_effects
from rollerrig.firmware_sim.faults.bus import Babble, Gate, Rule
from rollerrig.firmware_sim.faults.catalogue import LASTS, TICK, Fault
from rollerrig.firmware_sim.faults.confinement import Confinement, Controllers
from rollerrig.firmware_sim.rack import Rack
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.signals import DRIVE_NODES

# below this the supply of the electronics is gone too
ELECTRONICS_V = 200.0
HOLD, VENT = 1.0, 2.0

# what a fault writes into the array of the tick: (slot, axle, value) from its values
_EFFECTS: dict[str, Callable[[dict[str, Any]], list[tuple[int, int, float]]]] = {
    "speed_sensor_stuck": lambda v: [(fault_effects.STUCK, v["axle"], 1.0)],
    "speed_sensor_dropout": lambda v: [(fault_effects.DROPOUT, v["axle"], 1.0)],
    "missing_tooth": lambda v: [(fault_effects.MISSING_TEETH, v["axle"], float(v["teeth"]))],
    "swapped_axles": lambda v: [(fault_effects.SOURCE, v["axle"], float(v["other"])),
                                (fault_effects.SOURCE, v["other"], float(v["axle"]))],
    "speed_noise_burst": lambda v: [(fault_effects.NOISE_rad_s, v["axle"], v["std_rad_s"])],
    "wheel_diameter_mismatch": lambda v: [(fault_effects.LARGER, v["axle"],
                                           v["difference_percent"] / 100.0)],
    "hold_magnet_stuck": lambda v: [(fault_effects.MAGNETS_ON, v["axle"], HOLD)],
    "hold_magnet_dead": lambda v: [(fault_effects.MAGNETS_OFF, v["axle"], HOLD)],
    "vent_magnet_stuck": lambda v: [(fault_effects.MAGNETS_ON, v["axle"], VENT)],
    "vent_magnet_dead": lambda v: [(fault_effects.MAGNETS_OFF, v["axle"], VENT)],
    "cylinder_leak": lambda v: [(fault_effects.LEAK_per_s, v["axle"], 1.0 / v["time_constant_s"])],
    "drive_over_temperature": lambda v: [(fault_effects.MOTOR_LOAD, v["axle"], v["load"])],
    "torque_ripple": lambda v: [(fault_effects.RIPPLE_Nm, v["axle"], v["amplitude_Nm"]),
                                (fault_effects.RIPPLE_ORDER, v["axle"], v["order"])],
}


@dataclass
class Site:
    """What faults act on. `array` (fault_effects.SIZE,) is part of the commands, `post()` hands it
    to the tick; without a bus there is nothing else. `freeze(on)` stops a unit's process, and says
    whether there was one.
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
    """Faults to come and faults that hold. `on_event(level, text)` records each change."""

    def __init__(self, schedule: Iterable[Fault], on_event: Callable[[str, str], None]) -> None:
        self.active: dict[tuple[str, Any], Active] = {}
        self.site: Site | None = None
        self.now_s = 0.0
        self._on_event = on_event
        self.schedule(schedule)

    def schedule(self, faults: Iterable[Fault]) -> None:
        """Plan the faults of a scenario, in place of those planned before."""
        self.waiting = sorted(faults, key=lambda one: one.at_s)

    def connect(self, site: Site) -> None:
        """Say what the faults act on."""
        self.site = site
        self._confinement = Confinement(site.gate.controllers, dict(site.nodes), self._mute, self._deafen,
                                        site.bitrate)
        self._links_V = {node: site.nodes[node].device.axis.dc_link_V
                         for node in DRIVE_NODES if node in site.nodes}

    # -- by hand

    def inject(self, name: str, **values: Any) -> Fault:
        """Let a fault begin now; `for_s` says how long it holds. Raises ConfigError.

        One of the same kind and target that holds already is replaced.
        """
        fault = faults.make({"kind": name, "at_s": self.now_s} | values, f"fault {name}")
        assert self.site is not None, "connect the panel first"
        if fault.kind.acts != TICK and not self.site.nodes:
            raise ConfigError(f"fault {name} acts on the bus, and this run has none: use --pacing "
                              "lockstep or wall")
        self._begin(fault)
        return fault

    def clear(self, name: str = "", **aim: Any) -> int:
        """Lift the active faults of a name (of all, without one) and aim; returns how many."""
        lifted = [key for key, one in self.active.items()
                  if name in ("", one.fault.kind.name)
                  and all(one.fault.values.get(what) == value for what, value in aim.items())]
        for key in lifted:
            self._lift(key)
        return len(lifted)

    # -- by time

    def poll(self, now_s: float) -> None:
        """It is `now_s` of simulated time: begin, lift and go on with what is due."""
        self.now_s = now_s
        if not (self.active or self._confinement.busy) and not (self.waiting and self.waiting[0].at_s <= now_s):
            return
        for key in [key for key, one in self.active.items() if one.until_s <= now_s]:
            self._lift(key)
        while self.waiting and self.waiting[0].at_s <= now_s:
            self._begin(self.waiting.pop(0))
        self._go_on()

    def next_change_s(self) -> float:
        """When the schedule has something to do again; inf if never."""
        times = [one.until_s for one in self.active.values()]
        return min([*times, *(one.at_s for one in self.waiting[:1])], default=LASTS)

    # -- how

    def _begin(self, fault: Fault) -> None:
        if fault.target in self.active:
            self._lift(fault.target)
        one = Active(fault, self.now_s + fault.for_s)
        self.active[fault.target] = one
        self._on_event("warning", f"fault {fault.title}: begins")
        self._set_up(one)
        self._settle()
        self._go_on()

    def _lift(self, key: tuple[str, Any]) -> None:
        one = self.active.pop(key)
        met = sum(rule.hit for rule in one.rules)
        met_text = f", it met {met} frames" if one.rules else ""
        self._on_event("info", f"fault {one.fault.title}: lifted{met_text}")
        self._tear_down(one)
        self._settle()

    def _set_up(self, one: Active) -> None:
        site, name, values = self._site, one.fault.kind.name, one.fault.values
        one.rules = bus.rules_of(name, values)
        if name == "wsp_frozen" and not site.freeze(True):
            one.rules = bus.hold_unit()
        for rule in one.rules:
            site.gate.add(rule)
        if name == "error_frame":
            self._confinement.disturb(values["node"], attempts=values["attempts"])
        elif name == "receive_error":
            self._confinement.disturb(values["node"], finds=values["attempts"])
        elif name == "node_babbling":
            one.babble = Babble(values["can_id"], values["rate_Hz"], site.clock_ns())
        elif name == "drive_over_temperature":
            self._drive(values).axis.heat.load = values["load"]

    def _tear_down(self, one: Active) -> None:
        site, name, values = self._site, one.fault.kind.name, one.fault.values
        site.gate.remove(one.rules)
        if name == "wsp_frozen":
            site.freeze(False)
        elif name == "error_frame":
            self._confinement.disturb(values["node"], attempts=0)
        elif name == "receive_error":
            self._confinement.disturb(values["node"], finds=0)
        elif name == "drive_over_temperature":
            self._drive(values).axis.heat.load = 0.0
        if name in ("drive_trip", "drive_over_temperature"):
            _restore(self._drive(values))
        elif name == "power_dip":
            for node, volt in self._links_V.items():
                site.nodes[node].device.axis.dc_link_V = volt
                _restore(site.nodes[node].device)

    def _settle(self) -> None:
        """Set the tick's array, power, controllers and gate as all active faults want them."""
        site = self._site
        array, wanted = site.array, np.zeros(fault_effects.SIZE)
        for one in self.active.values():
            effects = _EFFECTS.get(one.fault.kind.name)
            for kind, axle, value in effects(one.fault.values) if effects else ():
                at = fault_effects.slot(kind, axle)
                wanted[fault_effects.ANY] = 1.0
                wanted[at] = float(int(wanted[at]) | int(value)) if kind in (
                    fault_effects.MAGNETS_ON, fault_effects.MAGNETS_OFF) else value
        if not np.array_equal(array, wanted):
            array[:] = wanted
            site.post()
        self._settle_nodes()
        site.disturb()

    def _settle_nodes(self) -> None:
        site = self._site
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
                self._mute(number, number in muted)
                if number not in muted:
                    confinement.recover(node)
            if link_V is not None and number in self._links_V:
                node.device.axis.dc_link_V = link_V

    def _go_on(self) -> None:
        """What active faults do again and again."""
        site, now_ns = self._site, self._site.clock_ns()
        site.gate.poll(now_ns)
        if self._confinement.busy:
            self._confinement.poll(now_ns)
            if not self._confinement.busy:
                site.disturb()
        for one in list(self.active.values()):
            name, values = one.fault.kind.name, one.fault.values
            if one.babble:
                node = site.nodes[values["node"]]
                bus.babble(one.babble, now_ns, lambda frame, node=node: self._send(node, frame))
            elif name == "drive_trip":
                self._drive(values).trip(values["code"], "injected")
            elif name == "drive_over_temperature":
                axis = self._drive(values).axis
                axis.heat.load = max(axis.heat.load, values["load"])

    def _send(self, node: Node, frame: Frame) -> None:
        self._site.rack.transmit(node, frame)

    def _mute(self, number: int, on: bool) -> None:
        self._site.rack.mute(self._site.nodes[number], on)

    def _deafen(self, number: int, on: bool) -> None:
        self._site.rack.deafen(self._site.nodes[number], on)

    def _drive(self, values: dict[str, Any]) -> Any:
        return self._site.nodes[DRIVE_NODES[values["axle"] - 1]].device

    @property
    def _site(self) -> Site:
        assert self.site is not None, "connect the panel first"
        return self.site


def _restore(drive: Any) -> None:
    """Reset a drive and enable it again, if the rig control has it."""
    if drive.local:
        drive.reset_fault()
        drive.control_from_rig()


def check_pacing(planned: Iterable[Fault], pacing: str) -> None:
    """Refuse faults of the bus where there is none. Raises ConfigError."""
    for fault in planned:
        if pacing == "free" and fault.kind.acts != TICK:
            raise ConfigError(f"fault {fault.kind.name} acts on the bus, and --pacing free has none; "
                              "use --pacing lockstep or wall")
