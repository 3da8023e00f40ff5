"""The table of signals: every quantity of the rig that is recorded, drawn or carried by a bus.

One row is one signal: its name, unit, number of axles, meaning, direction as seen from the rig, the
group in which it is drawn, its places on the bus, and the vehicles that have it. Recording columns,
Rerun paths, PDO maps, EDS and DBC files and the documentation derive from these rows; no other file
names a signal again.

In memory a row of all signals has the same columns for every vehicle (`column`, `WIDTH`): it has
room for the most axles and for all equipment. What a vehicle has is in its `Table`; only that is
recorded.
"""

import functools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import (
    AXLES_OF_GROUP,
    DYNAMIC_BRAKE,
    MAGNETIC_TRACK_BRAKE,
    MOST_AXLES,
    MOST_GROUPS,
    Kind,
)

BUS_CHANNEL = "rig0"
DEFAULT_ADDRESS = "socketcand://127.0.0.1:29536/rig0"

# node identifiers of the leading group of axles
SPEED_NODE = 16
BRAKE_NODE = 17
SANDER_NODE = 18  # only where the vehicle has sanders
TRACTION_NODE = 19  # only where the vehicle has a dynamic brake
WSP_NODE = 32
# the command of the magnetic track brake, a byte of the brake I/O
TRACK_BRAKE_OBJECT = 0x6200
TRACK_BRAKE_SUB = 2
# the nodes of each further group have numbers that are higher by this
NODES_OF_GROUP = 32
BENCH_NODE = 127


def drive_node(axle: int) -> int:
    """Return the node of the drive under an axle (from 1)."""
    group, place = divmod(axle - 1, AXLES_OF_GROUP)
    return NODES_OF_GROUP * group + place + 1


def group_of_axle(axle: int) -> int:
    """Return the group of an axle (from 1), 0 the leading one."""
    return (axle - 1) // AXLES_OF_GROUP


def group_of(node: int) -> int:
    """Return the group of a node, 0 the leading one; the bench belongs to all, and to the first."""
    return 0 if node == BENCH_NODE else (node - 1) // NODES_OF_GROUP


def in_group(leading: int, group: int) -> int:
    """Return the node of a group (from 0) with the task of a node of the leading one."""
    return NODES_OF_GROUP * group + leading


def in_leading_group(node: int) -> int:
    """Return the node of the leading group with the same task; the bench is itself."""
    return node - NODES_OF_GROUP * group_of(node)


# lower and upper bounds of the integer types that objects carry on the bus
KINDS = {
    "U8": (0, 2**8 - 1),
    "I8": (-(2**7), 2**7 - 1),
    "U16": (0, 2**16 - 1),
    "I16": (-(2**15), 2**15 - 1),
    "U32": (0, 2**32 - 1),
    "I32": (-(2**31), 2**31 - 1),
}


class Place(NamedTuple):
    """The place of a signal in an object dictionary, and how a value becomes an integer there."""

    # of the leading group. DRIVE_UNDER_AXLE: the drive under the axle of the signal
    node: int
    index: int  # type: ignore[assignment]
    # sub-index of axle 1; the other axles follow. A drive has the same one for each axle.
    # BEHIND_OTHERS: behind the values of another signal for all axles of a group
    sub: int
    kind: str  # integer type, a key of KINDS
    scale: float  # value of one count, in the signal's unit
    of: str = ""  # name of a parameter whose value multiplies the scale
    wraps: bool = False  # a counter wraps round; other signals saturate


DRIVE_UNDER_AXLE = 0
BEHIND_OTHERS = -1

# directions, as seen from the rig
OUT = "out"
IN = "in"


class Signal(NamedTuple):
    """One row of the table."""

    name: str
    unit: str  # also the suffix of its columns; "" for a pure number
    axles: int  # number of values: one, or one for each axle (in `ALL_SIGNALS` for the most axles)
    text: str  # meaning
    group: str = ""  # the plot in which it is drawn; "" for none
    direction: str = OUT
    places: tuple[Place, ...] = ()
    equipment: str = ""  # only vehicles with it have the signal; "" all vehicles
    groups: int = 1  # only vehicles with so many groups of axles have it


ALL_SIGNALS: tuple[Signal, ...] = (
    Signal(
        "time",
        "s",
        1,
        "simulated time since the run began",
        places=(Place(BENCH_NODE, 0x2100, 0, "U32", 1e-3, wraps=True),),
    ),
    Signal(
        "vehicle_speed",
        "m_s",
        1,
        "speed of the (virtual) vehicle",
        group="speeds",
        places=(Place(BENCH_NODE, 0x2101, 0, "I32", 1e-4),),
    ),
    Signal(
        "position",
        "m",
        1,
        "distance run by the vehicle",
        places=(Place(BENCH_NODE, 0x2102, 0, "I32", 1e-3),),
    ),
    Signal(
        "vehicle_acceleration",
        "m_s2",
        1,
        "acceleration of the vehicle, negative in braking",
        group="acceleration",
        places=(Place(BENCH_NODE, 0x2103, 0, "I16", 1e-3),),
    ),
    Signal(
        "brake_demand",
        "Pa",
        1,
        "requested brake cylinder pressure",
        group="pressures",
        places=(
            Place(BRAKE_NODE, 0x6411, 1, "I16", 100.0),
            Place(BENCH_NODE, 0x210B, 0, "I16", 100.0),
        ),
    ),
    Signal("wheel_speed", "rad_s", MOST_AXLES, "rotation of the wheelset"),
    Signal(
        "wheel_circumferential_speed",
        "m_s",
        MOST_AXLES,
        "radius times wheel speed",
        group="speeds",
        places=(Place(BENCH_NODE, 0x2115, 1, "I16", 0.005),),
    ),
    Signal(
        "measured_speed",
        "rad_s",
        MOST_AXLES,
        "rotation of the wheelset as its speed sensor measures it",
        places=(
            Place(SPEED_NODE, 0x6030, 1, "I16", 0.01),
            Place(SPEED_NODE, 0x2102, 1, "I32", 1e-4),
        ),
    ),
    Signal("wheel_angle", "rad", MOST_AXLES, "angle turned by the wheelset since the run began"),
    Signal(
        "tooth_frequency",
        "Hz",
        MOST_AXLES,
        "teeth of the pole wheel passing the sensor",
        places=(Place(SPEED_NODE, 0x2100, 1, "U32", 1e-3),),
    ),
    Signal(
        "pulse_count",
        "",
        MOST_AXLES,
        "teeth that have passed the sensor",
        places=(Place(SPEED_NODE, 0x2101, 1, "U32", 1.0, wraps=True),),
    ),
    Signal(
        "roller_speed",
        "rad_s",
        MOST_AXLES,
        "rotation of the roller (0: plain track)",
        places=(Place(DRIVE_UNDER_AXLE, 0x606C, 0, "I32", 1e-4),),
    ),
    Signal(
        "roller_angle",
        "rad",
        MOST_AXLES,
        "angle turned by the roller since the run began",
        places=(Place(DRIVE_UNDER_AXLE, 0x6064, 0, "I32", 1e-3, wraps=True),),
    ),
    Signal(
        "sliding",
        "m_s",
        MOST_AXLES,
        "surface speed minus radius times wheel speed",
        group="sliding",
        places=(Place(BENCH_NODE, 0x2114, 1, "I16", 0.005),),
    ),
    Signal("creepage", "", MOST_AXLES, "sliding over surface speed"),
    Signal(
        "adhesion",
        "",
        MOST_AXLES,
        "contact force over wheel load",
        group="adhesion",
        places=(Place(BENCH_NODE, 0x2104, 1, "I16", 1e-4),),
    ),
    Signal(
        "adhesion_degraded", "", MOST_AXLES, "lower limit f_d at this sliding", group="adhesion"
    ),
    Signal(
        "adhesion_recovered", "", MOST_AXLES, "upper limit f_r at this sliding", group="adhesion"
    ),
    Signal(
        "transition",
        "",
        MOST_AXLES,
        "lambda: 0 degraded, 1 recovered; where cleaning fades at large sliding, it is less than "
        "1 - exp(-tau W_sp)",
        group="transition",
    ),
    Signal(
        "dissipated_energy",
        "J_m",
        MOST_AXLES,
        "W_sp: energy dissipated per metre, one wheel; also that which cleans nothing, at large "
        "sliding",
        group="energy",
    ),
    Signal(
        "sliding_work",
        "J",
        MOST_AXLES,
        "energy dissipated in the contacts of the wheelset so far",
        places=(Place(BENCH_NODE, 0x2108, 1, "U32", 1.0),),
    ),
    Signal(
        "friction_degraded",
        "",
        MOST_AXLES,
        "kinematic friction mu_cd of the contaminant under the axle",
        group="friction",
    ),
    Signal(
        "film",
        "",
        MOST_AXLES,
        "contaminant on the roller under the wheel, as a share of the prepared film",
        group="film",
    ),
    Signal(
        "wheel_load",
        "N",
        MOST_AXLES,
        "vertical load of the wheelset (both wheels)",
        group="loads",
        places=(Place(BENCH_NODE, 0x2109, 1, "U32", 1.0),),
    ),
    Signal(
        "brake_torque",
        "Nm",
        MOST_AXLES,
        "brake torque on the wheelset, positive when it brakes",
        group="torques",
    ),
    Signal(
        "cylinder_pressure",
        "Pa",
        MOST_AXLES,
        "brake cylinder pressure",
        group="pressures",
        places=(
            Place(BRAKE_NODE, 0x6401, 1, "I16", 100.0),
            Place(BENCH_NODE, 0x2116, 1, "I16", 100.0),
        ),
    ),
    Signal(
        "valve",
        "",
        MOST_AXLES,
        "dump valve: 0 fill, 1 hold, 2 vent",
        group="valves",
        places=(Place(BENCH_NODE, 0x2105, 1, "U16", 1.0),),
    ),
    Signal(
        "vents",
        "",
        MOST_AXLES,
        "number of times that the dump valve began to vent",
        places=(Place(BENCH_NODE, 0x210A, 1, "U32", 1.0),),
    ),
    Signal(
        "longest_lock",
        "s",
        MOST_AXLES,
        "longest lock of the wheelset so far above lock_above_m_s",
        places=(Place(BENCH_NODE, 0x2107, 1, "U32", 1e-3),),
    ),
    Signal(
        "flat_length",
        "m",
        MOST_AXLES,
        "longest flat on the wheels of the wheelset",
        group="flats",
        places=(Place(BENCH_NODE, 0x2110, 1, "U16", 1e-4),),
    ),
    Signal(
        "air_consumption",
        "NL",
        1,
        "air used by the brake cylinders so far",
        group="air",
        places=(Place(BENCH_NODE, 0x2106, 0, "U32", 0.01),),
    ),
    Signal(
        "reservoir_pressure",
        "Pa",
        1,
        "pressure of the auxiliary reservoir (0: the supply of air is unlimited)",
        group="pressures",
        places=(Place(BENCH_NODE, 0x210E, 0, "U16", 100.0),),
    ),
    Signal(
        "reservoir_least",
        "Pa",
        1,
        "lowest pressure of the auxiliary reservoir so far",
        places=(Place(BENCH_NODE, 0x210F, 0, "U16", 100.0),),
    ),
    Signal(
        "air_supplied",
        "NL",
        1,
        "air that the supply has fed into the reservoir so far",
        group="air",
    ),
    Signal(
        "sand_rate",
        "kg_s",
        MOST_AXLES,
        "sand that leaves the hose of the axle's sander",
        group="sand",
        places=(Place(SANDER_NODE, 0x6401, 1, "I16", 1e-4),),
    ),
    Signal(
        "sand_box",
        "kg",
        MOST_AXLES,
        "sand left in the box of the axle's sander",
        places=(
            # behind the rates of all axles of a group
            Place(SANDER_NODE, 0x6401, BEHIND_OTHERS, "I16", 0.01),
            Place(BENCH_NODE, 0x2112, 1, "U16", 0.01),
        ),
    ),
    Signal(
        "sand_taken",
        "kg",
        MOST_AXLES,
        "sand that the axle's sander took from its box",
        places=(Place(BENCH_NODE, 0x2113, 1, "U16", 0.01),),
    ),
    Signal(
        "sand_dose",
        "kg_m",
        MOST_AXLES,
        "sand that the wheels meet on a metre of track",
        group="sand_dose",
    ),
    Signal(
        "sand_demand",
        "",
        MOST_AXLES,
        "sanders that are commanded to sand",
        direction=IN,
        places=(Place(SANDER_NODE, 0x6200, 1, "U8", 1.0),),
    ),
    Signal(
        "motor_torque_demand",
        "Nm",
        MOST_AXLES,
        "torque commanded from the roller motor",
        group="motors",
    ),
    Signal(
        "motor_torque",
        "Nm",
        MOST_AXLES,
        "torque of the roller motor on the roller shaft",
        group="motors",
        places=(Place(DRIVE_UNDER_AXLE, 0x6077, 0, "I16", 1e-3, of="rated_torque_Nm"),),
    ),
    Signal(
        "disc_temperature",
        "K",
        MOST_AXLES,
        "temperature of the brake discs of the wheelset, as one body",
        group="temperatures",
        places=(Place(BENCH_NODE, 0x210C, 1, "U16", 0.1),),
    ),
    Signal(
        "motor_temperature",
        "K",
        MOST_AXLES,
        ("temperature of the winding of the roller motor (on plain track: of the air)"),
        group="temperatures",
        places=(Place(BENCH_NODE, 0x210D, 1, "U16", 0.1),),
    ),
    Signal(
        "tracking_error",
        "m_s",
        MOST_AXLES,
        (
            "speed of the roller rim minus that of the vehicle; on a virtual "
            "track, of the real minus the virtual wheel rim"
        ),
        group="tracking",
    ),
    Signal(
        "wsp_reference_speed",
        "m_s",
        1,
        "reference speed that the WSP unit sends (NaN: it sends none)",
        group="speeds",
        direction=IN,
        places=(Place(WSP_NODE, 0x2110, 1, "I16", 0.01),),
    ),
    Signal(
        "magnets",
        "",
        MOST_AXLES,
        "energised magnets: bit 0 hold, bit 1 vent",
        direction=IN,
        places=(Place(BRAKE_NODE, 0x6200, 1, "U8", 1.0),),
    ),
    Signal("tick_lateness", "us", 1, "latest start of a tick since the last sample", group="loop"),
    Signal("tick_duration", "us", 1, "longest tick since the last sample", group="loop"),
    Signal("ticks_missed", "", 1, "ticks so far that began after the next one was due"),
)


def reference_speed_name(group: int) -> str:
    """Return the name of the signal with the reference speed of the unit of a group (from 0)."""
    return "wsp_reference_speed" if group == 0 else f"wsp_reference_speed_{group + 1}"


# a further unit sends its reference speed in the same object as that of the leading group
ALL_SIGNALS += tuple(
    Signal(
        reference_speed_name(group),
        "m_s",
        1,
        f"reference speed that the WSP unit of group {group + 1} sends (NaN: it sends none)",
        group="speeds",
        direction=IN,
        groups=group + 1,
    )
    for group in range(1, MOST_GROUPS)
)

OF_DYNAMIC_BRAKE: tuple[Signal, ...] = (
    Signal(
        "dynamic_torque",
        "Nm",
        MOST_AXLES,
        "torque of the traction motor on the wheelset, positive when it brakes",
        group="dynamic_torques",
        places=(Place(TRACTION_NODE, 0x6401, 1, "I16", 1.0),),
    ),
    Signal(
        "dynamic_torque_demand",
        "Nm",
        MOST_AXLES,
        "torque that blending or traction demands from the motor, before slide control",
        group="dynamic_torques",
    ),
    Signal(
        "dynamic_share",
        "",
        MOST_AXLES,
        "share of the motor's force that slide control permits",
        group="dynamic_share",
        places=(
            # behind the torques of all axles of a group
            Place(TRACTION_NODE, 0x6401, BEHIND_OTHERS, "I16", 1e-3),
        ),
    ),
    Signal(
        "friction_demand",
        "Pa",
        MOST_AXLES,
        "pressure that blending demands from the friction brake",
        group="pressures",
    ),
    Signal(
        "dynamic_work",
        "J",
        MOST_AXLES,
        "energy that the traction motor took from the wheelset so far, negative in traction",
    ),
    Signal(
        "traction_demand",
        "",
        1,
        "demanded share of the traction force",
        group="dynamic_share",
    ),
)
# an axle has half of the magnets of its bogie
OF_TRACK_BRAKE: tuple[Signal, ...] = (
    Signal(
        "track_brake_force",
        "N",
        MOST_AXLES,
        "force of the magnets of the axle's bogie on the rail, one half for each of its axles",
        group="track_brake",
        places=(Place(BENCH_NODE, 0x2117, 1, "U16", 1.0),),
    ),
    Signal(
        "track_brake_lowered",
        "",
        MOST_AXLES,
        "magnets of the axle's bogie: 0 raised, 1 on the rail",
        group="track_brake_lowered",
        places=(Place(BENCH_NODE, 0x2118, 1, "U16", 1e-3),),
    ),
    Signal(
        "track_brake_cleaning",
        "J_m",
        MOST_AXLES,
        "work of all magnets ahead on the metre of rail that the axle meets",
        group="track_brake_cleaning",
    ),
    Signal(
        "track_brake_work",
        "J",
        1,
        "energy that all magnets took from the vehicle so far",
    ),
    Signal(
        "track_brake_demand",
        "",
        MOST_AXLES,
        "1: the magnets of the axle's bogie are demanded, by an emergency or over the bus",
        group="track_brake_lowered",
        places=(Place(BRAKE_NODE, TRACK_BRAKE_OBJECT, TRACK_BRAKE_SUB, "U8", 1.0),),
        direction=IN,
    ),
)
ALL_SIGNALS += tuple(signal._replace(equipment=DYNAMIC_BRAKE) for signal in OF_DYNAMIC_BRAKE)
ALL_SIGNALS += tuple(signal._replace(equipment=MAGNETIC_TRACK_BRAKE) for signal in OF_TRACK_BRAKE)

# the first column of each signal in a row of all signals, and the number of columns of such a row
_FIRST_COLUMN: dict[str, int] = {}
WIDTH = 0
for _signal in ALL_SIGNALS:
    _FIRST_COLUMN[_signal.name] = WIDTH
    WIDTH += _signal.axles


def column(name: str, axle: int = 1) -> int:
    """Return the position of a signal of an axle (from 1) in a row of all signals.

    Raises KeyError for an unknown signal.
    """
    return _FIRST_COLUMN[name] + axle - 1


def first_place(name: str) -> Place:
    """Return the first place of a signal on the bus, as in `ALL_SIGNALS`.

    Raises KeyError for an unknown signal.
    """
    return _FIRST_PLACES[name]


_FIRST_PLACES = {signal.name: signal.places[0] for signal in ALL_SIGNALS if signal.places}


class Table:
    """The signals of a kind of vehicle; made by `table`.

    kind : the vehicle
    signals : rows with the number of axles that the vehicle has, and with all sub-indices
    by_name : the same rows by their names
    columns : the names of the columns that are recorded, in their order
    kept : int64, the position of each of them in a row of all signals
    reference_speeds : the signals with the reference speeds of the units, the leading one first
    drive_nodes : the node of the drive under each axle
    wsp_nodes : the node of the unit of each group
    rig_nodes : the nodes that the bench always simulates, without its node 127
    """

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.signals = tuple(_of(kind, signal) for signal in ALL_SIGNALS if _has(kind, signal))
        self.by_name: Mapping[str, Signal] = {signal.name: signal for signal in self.signals}
        names: list[str] = []
        kept: list[int] = []
        for signal in self.signals:
            first = column(signal.name)
            names += columns(signal)
            kept += range(first, first + signal.axles)
        self.columns = tuple(names)
        self.kept = np.array(kept, dtype=np.int64)
        self.kept.setflags(write=False)
        self.reference_speeds = tuple(map(reference_speed_name, range(kind.groups)))
        self.drive_nodes = tuple(drive_node(axle) for axle in range(1, kind.axles + 1))
        self.wsp_nodes = self.nodes(WSP_NODE)
        self.rig_nodes = (*self.drive_nodes, *self.nodes(SPEED_NODE), *self.nodes(BRAKE_NODE))

    @property
    def axles(self) -> range:
        """The axles of the vehicle, counted from 1."""
        return range(1, self.kind.axles + 1)

    def span(self, name: str) -> slice:
        """Return the positions of all axles of a signal in a row of all signals.

        Raises KeyError for a signal that the vehicle does not have.
        """
        first = column(name)
        return slice(first, first + self.by_name[name].axles)

    def rows_of_all(self, recorded: np.ndarray) -> np.ndarray:
        """Return rows of all signals, shape (n, WIDTH), from recorded ones (n, columns).

        What the vehicle does not have is NaN.
        """
        rows = np.full((len(recorded), WIDTH), np.nan)
        rows[:, self.kept] = recorded
        return rows

    def nodes(self, leading: int) -> tuple[int, ...]:
        """Return the nodes of all groups for a node of the leading one, such as WSP_NODE."""
        return tuple(in_group(leading, group) for group in range(self.kind.groups))

    def axles_of(self, group: int) -> range:
        """Return the axles of a group, counted through from 1."""
        first = AXLES_OF_GROUP * group + 1
        return range(first, first + self.kind.axles_of_group(group))

    def axles_at(self, signal: Signal, node: int) -> range:
        """Return the axles (from 1) whose values of a signal a node carries.

        They are the axles of its group, or all axles at the bench; 1 for a signal of the vehicle.
        """
        if signal.axles == 1:
            return range(1, 2)
        return self.axles if node == BENCH_NODE else self.axles_of(group_of(node))

    def place(self, name: str, node: int) -> Place:
        """Return the place of a signal at a node of the leading group, or at the bench.

        Raises KeyError for a signal that the vehicle does not have, LookupError when the node does
        not carry it.
        """
        for candidate in self.by_name[name].places:
            if candidate.node == node:
                return candidate
        raise LookupError(f"node {node} carries no '{name}'")


def _has(kind: Kind, signal: Signal) -> bool:
    """Return whether a kind of vehicle has a signal."""
    equipment = {
        "": True,
        DYNAMIC_BRAKE: kind.dynamic_brake,
        MAGNETIC_TRACK_BRAKE: kind.magnetic_track_brake,
    }
    return equipment[signal.equipment] and signal.groups <= kind.groups


def _of(kind: Kind, signal: Signal) -> Signal:
    """Return a row of `ALL_SIGNALS` for a kind of vehicle."""
    places = []
    for place in signal.places:
        sub = 1 + kind.unit_axles if place.sub == BEHIND_OTHERS else place.sub
        places.append(place._replace(sub=sub))
    return signal._replace(axles=min(signal.axles, kind.axles), places=tuple(places))


@functools.cache
def table(kind: Kind) -> Table:
    """Return the signals of a kind of vehicle."""
    return Table(kind)


def bits(place: Place) -> int:
    """Return the number of bits of one count."""
    return int(place.kind[1:])


def columns(signal: Signal) -> tuple[str, ...]:
    """Return the names of a signal's recording columns: axles from 1, the unit as suffix."""
    suffix = f"_{signal.unit}" if signal.unit else ""
    if signal.axles == 1:
        return (signal.name + suffix,)
    return tuple(f"{signal.name}_{axle}{suffix}" for axle in range(1, signal.axles + 1))


def count(value: float, place: Place, parameter: float = 1.0) -> int:
    """Return the integer on the bus for a value in its unit.

    The result is rounded half to even. It saturates at the bounds of the type, or wraps round where
    the place is a counter. A value that is not finite gives the lower bound. `parameter` is the
    value of the parameter that multiplies the scale.
    """
    low, high = KINDS[place.kind]
    if not np.isfinite(value):
        return low
    raw = round(value / (place.scale * parameter))
    if place.wraps:
        return (raw - low) % (high - low + 1) + low
    return min(max(raw, low), high)


def value(raw: int, place: Place, parameter: float = 1.0) -> float:
    """Return the value in the signal's unit for an integer on the bus."""
    return raw * place.scale * parameter
