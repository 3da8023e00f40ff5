"""The panel from which faults are injected and lifted, by their schedule or by hand.

Each change is an event of the run. After each change the effects in the tick and on the bus are
computed again from all active faults. So faults may overlap, and when the last one is lifted, the
rig is free of faults. A drive that has tripped is reset and enabled again when its fault is lifted,
if the rig control moves it. A master on the bus must reset its drives itself.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES_OF_BOGIE, kind_of
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.faults import bus, catalogue, confinement, effects
from rollerrig.firmware_sim.faults.bus import Babble, Gate, Rule
from rollerrig.firmware_sim.faults.catalogue import LASTS, TICK, Fault
from rollerrig.firmware_sim.faults.confinement import Confinement, Controllers
from rollerrig.firmware_sim.rack import Rack
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, OnEvent
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, VENT_MAGNET

ELECTRONICS_V = 200.0  # below this voltage of the DC link the electronics have no supply either

# the entries of a fault in the array of the tick: (kind of value, axle, value) from its parameters
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
    "speed_sensor_drift": lambda v: [
        (effects.STEP, v["axle"], v["step_percent"] / 100.0),
        (effects.DRIFT_per_s, v["axle"], v["rate_percent_s"] / 100.0),
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
    "dynamic_brake_lost": lambda v: [(effects.MOTOR_LOST, v["axle"], 1.0)],
    "track_brake_dead": lambda v: [
        (effects.TRACK_BRAKE_DEAD, AXLES_OF_BOGIE * (v["bogie"] - 1) + place, 1.0)
        for place in range(1, AXLES_OF_BOGIE + 1)
    ],
    "torque_ripple": lambda v: [
        (effects.RIPPLE_Nm, v["axle"], v["amplitude_Nm"]),
        (effects.RIPPLE_ORDER, v["axle"], v["order"]),
    ],
}
# the field of a node's controller that a fault with error frames sets
_DISTURBS = {"error_frame": "attempts", "receive_error": "finds"}


@dataclass
class Site:
    """The parts of a rig on which faults act.

    `array`, shape (effects.SIZE,), is part of the commands; `post()` passes it to the tick. A rig
    without a bus has nothing else. `disturb()` is called when the gate may have changed.
    `freeze(on, groups)` stops the processes of the units of some groups, or lets them continue, and
    returns whether there is one.
    """

    array: np.ndarray
    post: Callable[[], None]
    nodes: dict[int, Node] = field(default_factory=dict)
    rack: Rack = field(default_factory=Rack)
    gate: Gate = field(default_factory=lambda: Gate(Controllers(lambda *lost: None)))
    clock_ns: Callable[[], int] = lambda: 0
    bitrate: int = 500_000
    disturb: Callable[[], None] = lambda: None
    freeze: Callable[[bool, frozenset[int]], bool] = lambda on, groups: False


@dataclass
class Active:
    """An active fault, its end, and what it has set up on the bus."""

    fault: Fault
    until_s: float
    rules: list[Rule] = field(default_factory=list)
    babble: Babble | None = None


class Panel:
    """Planned and active faults on `site`. `on_event(code, **fields)` records each change.

    `sections` are those of the resolved scenario: they state the vehicle, and list the axles and
    bogies with equipment that can fail. `vehicle` is its kind. `explanations` has one text an axle:
    the active fault that explains a strange behaviour of the unit there, or nothing.
    """

    site: Site

    def __init__(
        self, planned: Iterable[Fault], on_event: OnEvent, sections: Mapping[str, Any]
    ) -> None:
        self.active: dict[tuple[str, Any], Active] = {}
        self.now_s = 0.0
        self._on_event = on_event
        self.begin(planned, sections)
        self.explanations = [""] * self.vehicle.axles

    def begin(self, planned: Iterable[Fault], sections: Mapping[str, Any]) -> None:
        """Take the faults and the sections of another scenario."""
        self._sections = sections
        self.vehicle = kind_of(sections, "the running rig")
        self.schedule(planned)

    def schedule(self, planned: Iterable[Fault]) -> None:
        """Plan these faults, instead of those planned before."""
        self.waiting = sorted(planned, key=lambda fault: fault.at_s)

    def connect(self, site: Site) -> None:
        """Set the parts of the rig on which the faults act."""
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
            for node in signals.table(self.vehicle).drive_nodes
            if node in site.nodes
        }

    def inject(self, name: str, **values: Any) -> Fault:
        """Let a fault begin now, or plan it if its `at_s` is still to come.

        It lasts for `for_s`, and replaces a fault with the same target. Raises ConfigError.
        """
        given = {"kind": name, "at_s": self.now_s} | values
        fault = catalogue.make(given, self.vehicle, f"fault {name}")
        check_pacing((fault,), "lockstep" if self.site.nodes else "free")
        catalogue.check_equipped(fault, self._sections, "the running rig")
        if fault.at_s > self.now_s:
            self.schedule((*self.waiting, fault))
        else:
            self._begin(fault)
        return fault

    def report_waiting(self) -> None:
        """Report, at the end of a run, the planned faults that have not begun."""
        for fault in self.waiting:
            if fault.reported:
                self._on_event(
                    Code.FAULT_NEVER_BEGAN,
                    fault=fault.title,
                    kind=fault.kind.name,
                    at_s=fault.at_s,
                )

    def clear(self, name: str = "", **aim: Any) -> int:
        """Lift the active faults with a name (empty: any) and an aim; returns how many."""
        targets = []
        for target, active in self.active.items():
            fault = active.fault
            name_fits = name in ("", fault.kind.name)
            aim_fits = all(fault.values.get(key) == value for key, value in aim.items())
            if name_fits and aim_fits:
                targets.append(target)
        for target in targets:
            self._lift(target)
        return len(targets)

    def poll(self, now_s: float) -> None:
        """Begin and lift the faults that are due at `now_s` of simulated time, and continue the
        others.
        """
        self.now_s = now_s
        begins = bool(self.waiting) and self.waiting[0].at_s <= now_s
        if not (self.active or self._confinement.busy or begins):
            return
        ended = [target for target, active in self.active.items() if active.until_s <= now_s]
        for target in ended:
            self._lift(target)
        while self.waiting and self.waiting[0].at_s <= now_s:
            self._begin(self.waiting.pop(0))
        self._continue()

    def next_change_s(self) -> float:
        """The time of the next change by the schedule; inf if there is none."""
        times_s = [active.until_s for active in self.active.values()]
        if self.waiting:
            times_s.append(self.waiting[0].at_s)
        return min(times_s, default=LASTS)

    def _begin(self, fault: Fault) -> None:
        if fault.target in self.active:
            self._lift(fault.target)
        active = Active(fault, self.now_s + fault.for_s)
        self.active[fault.target] = active
        if fault.reported:
            self._on_event(Code.FAULT_BEGINS, **fault.event_fields)
        self._act(active, True)
        self._settle()
        self._continue()

    def _lift(self, target: tuple[str, Any]) -> None:
        active = self.active.pop(target)
        if active.fault.reported:
            frames_met = sum(rule.hit for rule in active.rules) if active.rules else None
            self._on_event(Code.FAULT_LIFTED, **active.fault.event_fields, frames_met=frames_met)
        self._act(active, False)
        self._settle()

    def _act(self, active: Active, on: bool) -> None:
        """Set up the effect of a fault on the bus and in devices, or remove it."""
        site = self.site
        name = active.fault.kind.name
        values = active.fault.values
        frozen = name == "wsp_frozen" and site.freeze(on, self._groups_of(active))
        if on:
            # the frames of a unit whose process cannot be stopped are held back
            active.rules = [] if frozen else bus.rules_of(active.fault)
            for rule in active.rules:
                site.gate.add(rule)
        else:
            site.gate.remove(active.rules)

        if name in _DISTURBS:
            times = values["attempts"] if on else 0
            self._confinement.disturb(values["node"], **{_DISTURBS[name]: times})
        elif name == "node_babbling" and on:
            active.babble = Babble(values["can_id"], values["rate_Hz"], site.clock_ns())
        elif name == "drive_over_temperature":
            self._drive(values).axis.heat.load = values["load"] if on else 0.0
        if not on and name in ("drive_trip", "drive_over_temperature"):
            self._drive(values).recover()
        elif not on and name == "power_dip":
            for node, volt in self._links_V.items():
                site.nodes[node].device.axis.dc_link_V = volt
                site.nodes[node].device.recover()

    def _groups_of(self, active: Active) -> frozenset[int]:
        """Return the groups whose units a fault stops and no other fault keeps stopped."""
        groups = bus.frozen_groups(active.fault)
        for other in self.active.values():
            if other is not active and other.fault.kind.name == active.fault.kind.name:
                groups -= bus.frozen_groups(other.fault)
        return groups

    def _settle(self) -> None:
        """Set the array of the tick, power, controllers and gate for all active faults together."""
        self._explain()
        array = np.zeros(effects.SIZE)
        for active in self.active.values():
            entries = _EFFECTS.get(active.fault.kind.name)
            if entries is None:
                continue
            for kind, axle, value in entries(active.fault.values):
                at = effects.slot(kind, axle)
                if kind in (effects.MAGNETS_ON, effects.MAGNETS_OFF):
                    value = float(int(array[at]) | int(value))  # bits of several faults
                array[at] = value
                array[effects.ANY] = 1.0
        if not np.array_equal(self.site.array, array):
            self.site.array[:] = array
            self.site.post()
        self._settle_nodes()
        self.site.disturb()

    def _explain(self) -> None:
        """Set `explanations` for all active faults; a fault that events do not report is secret."""
        self.explanations = [""] * self.vehicle.axles
        reported = [active.fault for active in self.active.values() if active.fault.reported]
        # a fault of all axles comes last: it explains more than that of a valve
        for fault in sorted(reported, key=lambda fault: len(fault.explains)):
            for axle in fault.explains:
                self.explanations[axle - 1] = fault.title

    def _settle_nodes(self) -> None:
        """Switch power and controllers of the nodes for all active faults together."""
        site = self.site
        unpowered: set[int] = set()
        muted: set[int] = set()
        link_V: float | None = None
        for active in self.active.values():
            name = active.fault.kind.name
            values = active.fault.values
            if name == "node_off":
                unpowered.add(values["node"])
            elif name == "bus_off":
                muted.add(values["node"])
            elif name == "power_dip":
                link_V = values["dc_link_V"]
                if values["dc_link_V"] < ELECTRONICS_V:
                    unpowered |= set(site.nodes)

        for number, node in site.nodes.items():
            if (id(node) in site.rack.off) != (number in unpowered):
                site.rack.power(node, number not in unpowered, site.clock_ns())
            if (id(node) in site.rack.muted) != (number in muted):
                site.rack.mute(node, number in muted)
                if number not in muted:
                    confinement.recover(node)
            if link_V is not None and number in self._links_V:
                node.device.axis.dc_link_V = link_V

    def _continue(self) -> None:
        """Do what active faults do repeatedly."""
        site = self.site
        now_ns = site.clock_ns()
        site.gate.poll(now_ns)
        if self._confinement.busy:
            self._confinement.poll(now_ns)
            if not self._confinement.busy:
                site.disturb()
        for active in list(self.active.values()):
            name = active.fault.kind.name
            values = active.fault.values
            if active.babble:
                transmit = partial(site.rack.transmit, site.nodes[values["node"]])
                active.babble.go_on(now_ns, transmit)
            elif name == "drive_trip":
                self._drive(values).trip(values["code"], "injected")
            elif name == "drive_over_temperature":
                heat = self._drive(values).axis.heat
                heat.load = max(heat.load, values["load"])

    def _drive(self, values: dict[str, Any]) -> Any:
        """The drive under the axle of a fault."""
        return self.site.nodes[signals.drive_node(values["axle"])].device


def check_without_bus(planned: Iterable[Fault], place: str, remedy: str) -> None:
    """Raise ConfigError for a fault that acts on the bus, because `place` has no bus.

    `remedy` states what the user can do there.
    """
    for fault in planned:
        if fault.kind.acts != TICK:
            raise ConfigError(
                f"fault {fault.kind.name} acts on the bus, and {place} has none; {remedy}"
            )


def check_pacing(planned: Iterable[Fault], pacing: str) -> None:
    """Raise ConfigError for faults of the bus in a pacing without a bus."""
    if pacing == "free":
        check_without_bus(planned, "--pacing free", "use --pacing lockstep or wall")
