"""The fault catalogue: the faults that can be injected into the rig, one row each.

A [[fault]] table of a scenario, `--fault` on the command line, or a call of the bench injects a
fault. It begins at a time, lasts for a while, and is lifted again. A row gives the target of the
fault, its parameters with their bounds, its effect, and the place where it acts: in the compiled
tick (`effects`), on the bus (`bus`), or in a device (`panel`).
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from rollerrig.configs import table, toml_text
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import Row, integer, number
from rollerrig.configs.vehicle import (
    AXLES_OF_BOGIE,
    DYNAMIC_BRAKE,
    EQUIPMENT_KEYS,
    MAGNETIC_TRACK_BRAKE,
    MOST_AXLES,
    MOST_GROUPS,
)
from rollerrig.configs.vehicle import Kind as VehicleKind
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.rig_objects import SPEEDS_ID, units_by_frame
from rollerrig.wsp_interface.signals import BRAKE_NODE, SPEED_NODE

# where a fault acts
TICK = "tick"
BUS = "bus"
DEVICE = "device"
LASTS = math.inf  # a fault that lasts to the end of the run

# bounds of axles, bogies and groups are those of the largest vehicle; `of` has those of any other
_AXLE = integer("axle", 1, 1, MOST_AXLES, "axle, counted from the leading end")
_NODE = integer("node", BRAKE_NODE, 1, 127, "a node of the rig")
_CAN_ID = integer("can_id", SPEEDS_ID, 0, 0x7FF, "11-bit identifier")
_EVERY = integer("every", 1, 1, 100_000, "1 is each frame, 2 every second one")
ALL_GROUPS = 0
_GROUP = integer("group", ALL_GROUPS, 0, MOST_GROUPS, "group of axles of the unit; 0: all units")
_LOSES_UNIT = ("wsp_frozen", "node_babbling", "error_frame", "receive_error")
_SILENCES_NODE = ("node_off", "bus_off")
# the nodes with which the leading unit exchanges its frames
_PARTNERS_OF_UNIT = (SPEED_NODE, BRAKE_NODE)
# the unit cannot command the valve of the axle as it should
_OF_VALVE = ("hold_magnet_stuck", "hold_magnet_dead", "vent_magnet_stuck", "vent_magnet_dead")
# the unit cannot measure the speed of the axle as it should
_OF_SPEED = (
    "speed_sensor_stuck",
    "speed_sensor_dropout",
    "missing_tooth",
    "speed_noise_burst",
    "wheel_diameter_mismatch",
    "speed_sensor_drift",
)
WHEN = (
    number("at_s", 0.0, 0.0, 36000.0, "simulated time at which it begins"),
    number("for_s", LASTS, 1e-3, LASTS, "how long it lasts; inf: to the end"),
)


@dataclass(frozen=True)
class Kind:
    """One row of the catalogue. `parameters` have their unit in the name, and bounds.

    `number` identifies it over Modbus (register 20 of unit 1). Programs of plants use it, so it
    never changes. `equipment`: only vehicles with it have the fault; "" all vehicles.
    """

    number: int
    name: str
    acts: str
    text: str
    parameters: tuple[Row, ...] = ()
    equipment: str = ""


@dataclass(frozen=True)
class Fault:
    """One planned fault: its kind, the kind of the vehicle, its time, the values of its parameters,
    and whether events report it.
    """

    kind: Kind
    vehicle: VehicleKind
    at_s: float = 0.0
    for_s: float = LASTS
    values: dict[str, Any] = field(default_factory=dict)
    reported: bool = True

    @property
    def table(self) -> signals.Table:
        """The signals of the vehicle."""
        return signals.table(self.vehicle)

    @property
    def target(self) -> tuple[str, Any]:
        """Its kind and its aim. Two faults with the same target replace each other."""
        for aim in ("axle", "bogie", "group", "node", "can_id"):
            if aim in self.values:
                return self.kind.name, self.values[aim]
        return self.kind.name, 0

    @property
    def reaches_unit(self) -> bool:
        """Whether the rig may lose a WSP unit by it.

        That is a fault of the unit, of frames from or to the unit, or of the whole bus.
        """
        if self.kind.name in _LOSES_UNIT:
            return True
        of_unit = self.values.get("node") in self.table.wsp_nodes
        return of_unit or self.values.get("can_id") in units_by_frame(self.table)

    @property
    def units(self) -> list[int]:
        """The nodes of the WSP units that may be lost by it, or have nothing to answer.

        The latter are the units whose speed unit or brake I/O is off.
        """
        wsp_nodes = self.table.wsp_nodes
        if self.kind.name == "wsp_frozen" and self.values.get("group", ALL_GROUPS) != ALL_GROUPS:
            return [wsp_nodes[self.values["group"] - 1]]
        if self.kind.name in _LOSES_UNIT or self.kind.name == "power_dip":
            return [*wsp_nodes]
        if "can_id" in self.values:
            return [*units_by_frame(self.table).get(self.values["can_id"], ())]
        if "node" not in self.values:
            return []
        node = self.values["node"]
        if node in wsp_nodes:
            return [node]
        is_partner = signals.in_leading_group(node) in _PARTNERS_OF_UNIT
        if self.kind.name in _SILENCES_NODE and is_partner:
            return [wsp_nodes[signals.group_of(node)]]
        return []

    @property
    def explains(self) -> frozenset[int]:
        """The axles (from 1) at which it explains a strange behaviour of the unit.

        A fault of one speed explains it at all axles of the unit, because the reference speed comes
        from all of them; so does a fault by which the unit may be lost. Swapped axles explain
        nothing: they are a wrong wiring, which a run shall show.
        """
        if self.kind.name in _OF_VALVE:
            return frozenset({self.values["axle"]})
        if self.kind.name in _OF_SPEED:
            group = signals.group_of_axle(self.values["axle"])
            return frozenset(self.table.axles_of(group))
        groups = [signals.group_of(node) for node in self.units]
        return frozenset(axle for group in groups for axle in self.table.axles_of(group))

    @property
    def title(self) -> str:
        """Name and parameters, for events."""
        words = [self.kind.name]
        for name, value in self.values.items():
            words.append(f"{name}={value:#x}" if name == "can_id" else f"{name}={value:g}")
        return " ".join(words)

    @property
    def event_fields(self) -> dict[str, Any]:
        """The fields of the events of this fault."""
        return {
            "fault": self.title,
            "kind": self.kind.name,
            "reaches_unit": self.reaches_unit,
            "units": self.units,
        }


CATALOGUE: tuple[Kind, ...] = (
    Kind(
        0,
        "speed_sensor_stuck",
        TICK,
        "the measured speed of an axle stays constant, and no pulses are counted",
        (_AXLE,),
    ),
    Kind(
        1, "speed_sensor_dropout", TICK, "the sensor of an axle gives no pulses: speed 0", (_AXLE,)
    ),
    Kind(
        2,
        "missing_tooth",
        TICK,
        "teeth of an axle's pole wheel are missing: once a turn the speed measured from "
        "pulses dips",
        (_AXLE, integer("teeth", 1, 1, 50, "missing teeth")),
    ),
    Kind(
        3,
        "swapped_axles",
        TICK,
        "the sensors of two axles are connected the wrong way round",
        (_AXLE, integer("other", 2, 1, MOST_AXLES, "the other axle")),
    ),
    Kind(
        4,
        "speed_noise_burst",
        TICK,
        "Gaussian noise on the measured speed of an axle, seeded",
        (_AXLE, number("std_rad_s", 5.0, 0.01, 100.0, "standard deviation")),
    ),
    Kind(
        5,
        "wheel_diameter_mismatch",
        TICK,
        "the wheels of an axle are larger than configured in the unit: they turn slower "
        "at the same speed of the train",
        (
            _AXLE,
            number("difference_percent", 5.0, -50.0, 50.0, "real over nominal diameter, less 1"),
        ),
    ),
    Kind(6, "hold_magnet_stuck", TICK, "the hold magnet of an axle stays energised", (_AXLE,)),
    Kind(7, "hold_magnet_dead", TICK, "the hold magnet of an axle is never energised", (_AXLE,)),
    Kind(8, "vent_magnet_stuck", TICK, "the vent magnet of an axle stays energised", (_AXLE,)),
    Kind(9, "vent_magnet_dead", TICK, "the vent magnet of an axle is never energised", (_AXLE,)),
    Kind(
        10,
        "cylinder_leak",
        TICK,
        "the brake cylinders of an axle leak: dp/dt = -p / T",
        (_AXLE, number("time_constant_s", 2.0, 0.1, 1000.0, "T")),
    ),
    Kind(
        11,
        "torque_ripple",
        TICK,
        "a roller motor's torque demand ripples with its angle",
        (
            _AXLE,
            number("amplitude_Nm", 2000.0, 0.0, 30000.0, "amplitude"),
            number("order", 6.0, 0.1, 100.0, "periods in a turn"),
        ),
    ),
    Kind(
        12,
        "drive_trip",
        DEVICE,
        "a drive trips with an error code; it can be reset when the fault is lifted",
        (_AXLE, integer("code", 0x5112, 1, 0xFFFF, "603Fh error code")),
    ),
    Kind(
        13,
        "drive_over_temperature",
        DEVICE,
        "a motor is hot: above 1 the drive warns, above 1.2 it trips",
        (_AXLE, number("load", 1.25, 1.0, 3.0, "thermal load; the motor can bear 1 for any time")),
    ),
    Kind(14, "node_off", BUS, "a node has no power; it boots when the fault is lifted", (_NODE,)),
    Kind(
        15,
        "node_babbling",
        BUS,
        "a node floods the bus with frames of one identifier",
        (
            _NODE,
            integer("can_id", 0x07F, 0, 0x7FF, "identifier of the frames"),
            number("rate_Hz", 2000.0, 1.0, 20000.0, "frames a second"),
        ),
    ),
    Kind(16, "frame_lost", BUS, "frames of an identifier are lost", (_CAN_ID, _EVERY)),
    Kind(
        17,
        "frame_delayed",
        BUS,
        "frames of an identifier are delayed",
        (_CAN_ID, number("delay_s", 0.05, 0.001, 10.0, "delay")),
    ),
    Kind(18, "frame_duplicated", BUS, "frames of an identifier are sent twice", (_CAN_ID, _EVERY)),
    Kind(
        19,
        "error_frame",
        BUS,
        "error frames destroy each frame of a node, and it is sent again; the error counter "
        "rises, to error passive (EMCY 8120h) and bus-off",
        (_NODE, integer("attempts", 2, 1, 31, "destroyed attempts of each frame")),
    ),
    Kind(
        20,
        "bus_off",
        BUS,
        "a node's CAN controller is off the bus: the node neither receives nor sends, but runs "
        "on; EMCY 8140h when it is back",
        (_NODE,),
    ),
    Kind(
        21,
        "heartbeat_late",
        BUS,
        "the heartbeats of a node are delayed",
        (
            integer("node", BRAKE_NODE, 1, 127, "a node of the rig, or the WSP unit"),
            number("delay_s", 0.6, 0.01, 10.0, "delay"),
        ),
    ),
    Kind(
        22,
        "wsp_frozen",
        DEVICE,
        "the WSP unit freezes: the process of the reference unit is stopped, the frames of an "
        "external unit are held back",
        (_GROUP,),
    ),
    Kind(
        23,
        "power_dip",
        DEVICE,
        "the supply of the rig dips: below their lowest voltage the drives trip (3220h), below "
        "200 V all nodes of the rig are without power",
        (number("dc_link_V", 300.0, 0.0, 1000.0, "remaining voltage of the DC link"),),
    ),
    Kind(
        24,
        "receive_error",
        BUS,
        "a node finds an error in every frame of other nodes and destroys it, until its "
        "receive error counter makes it error passive (EMCY 8120h); then it alone misses them",
        (_NODE, integer("attempts", 1, 1, 31, "destroyed attempts of each frame")),
    ),
    Kind(
        25,
        "sander_empty",
        TICK,
        "the sand box of an axle is empty; it stays empty when the fault is lifted",
        (_AXLE,),
    ),
    Kind(
        26,
        "sander_blocked",
        TICK,
        "the sander of an axle is blocked: no sand leaves its box",
        (_AXLE,),
    ),
    Kind(
        27,
        "sander_wrong_orifice",
        TICK,
        "the sander of an axle has a wrong orifice, and so another rate",
        (_AXLE, number("factor", 0.3, 0.0, 10.0, "of the rate")),
    ),
    Kind(
        28,
        "sander_late",
        TICK,
        "the sand of an axle is late: the lag of its hose is longer",
        (_AXLE, number("delay_s", 3.0, 0.01, 60.0, "additional lag of the hose")),
    ),
    Kind(
        29,
        "dynamic_brake_lost",
        TICK,
        "the traction motor of an axle gives no torque; the friction brake takes over",
        (_AXLE,),
        DYNAMIC_BRAKE,
    ),
    Kind(
        30,
        "track_brake_dead",
        TICK,
        "the magnets of a bogie do not drop, or rise if they are down",
        (integer("bogie", 1, 1, MOST_AXLES // AXLES_OF_BOGIE, "bogie, from the leading end"),),
        MAGNETIC_TRACK_BRAKE,
    ),
    Kind(
        31,
        "speed_sensor_drift",
        TICK,
        "the measured speed of an axle jumps by a step, and then drifts away from the true speed; "
        "its pulses are counted as before",
        (
            _AXLE,
            number("step_percent", 0.0, -90.0, 400.0, "jump when the fault begins"),
            number("rate_percent_s", 2.0, -50.0, 50.0, "drift, in percent of the speed a second"),
        ),
    ),
)
BY_NAME = {kind.name: kind for kind in CATALOGUE}
# the option of the command line that gives a fault
OPTION = "--fault"
_SHORT = {"at": "at_s", "for": "for_s"}


@functools.cache
def of(kind: VehicleKind) -> Mapping[str, Kind]:
    """Return the faults of a kind of vehicle by name, with the bounds of its axles."""
    equipped = {
        "": True,
        DYNAMIC_BRAKE: kind.dynamic_brake,
        MAGNETIC_TRACK_BRAKE: kind.magnetic_track_brake,
    }
    highest = {
        "axle": kind.axles,
        "other": kind.axles,
        "bogie": kind.bogies,
        "group": kind.groups,
    }
    found = {}
    for fault in CATALOGUE:
        if not equipped[fault.equipment]:
            continue
        parameters = []
        for row in fault.parameters:
            # with one group of axles there is one unit, and nothing to choose
            if row.name != "group" or kind.groups > 1:
                parameters.append(row._replace(high=highest.get(row.name, row.high)))
        found[fault.name] = replace(fault, parameters=tuple(parameters))
    return found


def make(given: Mapping[str, Any], kind: VehicleKind, where: str) -> Fault:
    """A checked fault of a kind of vehicle, from a table with `kind`, times and parameters.

    Raises ConfigError, whose message begins with `where`.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where}: {given!r}: it must be a table with kind, at_s and for_s")
    given = {_SHORT.get(key, key): value for key, value in given.items()}
    name = given.pop("kind", None)
    row = kind_of(name, kind, where)
    read = table.read((*WHEN, *row.parameters), given, f"{where} {name}")
    fault = Fault(row, kind, read.pop("at_s"), read.pop("for_s"), read)
    _check_target(fault, where)
    return fault


def kind_of(name: Any, kind: VehicleKind, where: str) -> Kind:
    """Return the row of a fault by its name, with the bounds of a kind of vehicle.

    Raises ConfigError, whose message begins with `where`.
    """
    allowed = of(kind)
    if name in allowed:
        return allowed[name]
    if name in BY_NAME:
        equipment = BY_NAME[name].equipment
        raise ConfigError(
            f"{where}: {name} is a fault of vehicles with [{equipment}] "
            f"{EQUIPMENT_KEYS[equipment]}, and this vehicle has none; remove the fault, or "
            "give the vehicle this equipment"
        )
    wrong = f"kind = {name!r} is not a fault" if name else "kind, the name of the fault, is missing"
    # a dump valve has two magnets, and the faults are those of a magnet
    meant = str(name or "").replace("dump_valve", "magnet").replace("valve", "magnet")
    raise ConfigError(f"{where}: {wrong}{table.nearest(meant, allowed)}")


def parse(text: str, kind: VehicleKind, source: str = OPTION) -> Fault:
    """A fault of a kind of vehicle from a text: 'speed_sensor_stuck axle=2 at=5 for=3'.

    `source` is what gave the text, for messages. Raises ConfigError.
    """
    where = f"{source} '{text}'"
    name, *pairs = text.split() or [""]
    given: dict[str, Any] = {"kind": name}
    for pair in pairs:
        key, _, value = pair.partition("=")
        try:
            given[key] = toml_text.value(value, f"{where}: '{key}'")
        except ValueError:
            hint = f"write key=number, as in axle=2 or can_id={SPEEDS_ID:#x}"
            raise ConfigError(f"{where}: '{pair}': {hint}") from None
    return make(given, kind, where)


def plain(fault: Fault) -> dict[str, Any]:
    """The fault as a table that `make` takes, for the resolved scenario."""
    return {"kind": fault.kind.name, "at_s": fault.at_s, "for_s": fault.for_s, **fault.values}


def all_of(given: list[Any], kind: VehicleKind, where: str) -> tuple[Fault, ...]:
    """The faults of the [[fault]] tables of a scenario, for its kind of vehicle.

    Raises ConfigError.
    """
    return tuple(
        make(fault, kind, f"{where} [[fault]] {at}") for at, fault in enumerate(given, start=1)
    )


def check_equipped(fault: Fault, sections: Mapping[str, Any], where: str) -> None:
    """Check that the axle or bogie of a fault has the equipment that fails.

    `sections` are those of the resolved scenario. Raises ConfigError, whose message begins with
    `where`.
    """
    equipment = fault.kind.equipment
    if not equipment:
        return
    key = EQUIPMENT_KEYS[equipment]
    fitted = [int(place) for place in sections[equipment][key]]
    (aim,) = fault.values
    if fault.values[aim] not in fitted:
        raise ConfigError(
            f"{where}: fault {fault.title}: {aim} {fault.values[aim]} has no such brake; "
            f"allowed are {', '.join(map(str, fitted))} ([{equipment}] {key})"
        )


def markdown() -> str:
    """The catalogue as a page of the documentation, in Markdown."""
    lines = [
        "# Faults",
        "",
        "This page is for engineers who test how a unit behaves when something fails. After reading it "
        "you know every fault, what it does, and its parameters. `make docs` writes this page. "
        "[Inject a fault](howto_fault.md) is the guide.",
        "",
        "A `[[fault]]` table of a scenario injects a fault, and so does the option "
        "`--fault 'NAME parameter=value at=5 for=3'`. The fault begins at the time `at` and is lifted "
        'after `for` seconds (in a table: `at_s` and `for_s`). The column "acts in" has the place: the '
        "tick of the loop, a simulated device, or the bus.",
        "",
        "An axle, a bogie and a group must be one that the vehicle has. `group` is for vehicles with "
        "more than four axles. `dynamic_brake_lost` and `track_brake_dead` are for vehicles with this "
        "brake.",
        "",
        "| fault | acts in | effect | parameters: default (allowed) |",
        "|---|---|---|---|",
    ]
    for kind in CATALOGUE:
        parameters = "; ".join(
            f"`{row.name}` {row.default:g} ({row.low:g} to {row.high:g}): {row.source}"
            for row in kind.parameters
        )
        lines.append(f"| `{kind.name}` | {kind.acts} | {kind.text} | {parameters or 'none'} |")
    return "\n".join(lines) + "\n"


def _check_target(fault: Fault, where: str) -> None:
    """Raise ConfigError unless the axles and nodes of a fault are allowed."""
    values = fault.values
    at = f"{where} {fault.kind.name}"
    if values.get("other") == values.get("axle", 0):
        raise ConfigError(f"{at}: axle and other are both {values['axle']}; give two axles")
    allowed = fault.table.rig_nodes
    if fault.kind.name == "heartbeat_late":
        allowed += fault.table.wsp_nodes
    if "node" in values and values["node"] not in allowed:
        raise ConfigError(
            f"{at}: node = {values['node']}; allowed are {', '.join(map(str, allowed))}"
        )
