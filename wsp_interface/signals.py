"""THE table of signals: every quantity of the rig that is recorded, drawn or carried by a bus.

One row is one signal: name, unit, how many axles, direction as seen from the rig, the group it is
drawn in, where it stands on the bus, and what it means. Recording columns, Rerun paths, PDO maps,
EDS and DBC files and the documentation derive from these rows; nothing else names a signal twice.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES

BUS_CHANNEL = "rig0"
DEFAULT_ADDRESS = "socketcand://127.0.0.1:29536/rig0"

# node identifiers of the default rig
DRIVE_NODES = tuple(range(1, AXLES + 1))
SPEED_NODE = 16
BRAKE_NODE = 17
SANDER_NODE = 18  # where the vehicle has sanders
WSP_NODE = 32
BENCH_NODE = 127
# those that the bench simulates, besides its own
RIG_NODES = (*DRIVE_NODES, SPEED_NODE, BRAKE_NODE)

# bounds of the integer types that objects carry on the bus
KINDS = {
    "U8": (0, 2**8 - 1),
    "I8": (-(2**7), 2**7 - 1),
    "U16": (0, 2**16 - 1),
    "I16": (-(2**15), 2**15 - 1),
    "U32": (0, 2**32 - 1),
    "I32": (-(2**31), 2**31 - 1),
}


class Place(NamedTuple):
    """Where a signal stands in an object dictionary.

    `node` 0 means the drive under the signal's own axle. `sub` is the sub-index of axle 1; the other axles follow
    (drives have one axle each: the same sub-index). `scale` is the unit per count; where `of` names a parameter, the
    scale is multiplied by that parameter's value. A counter wraps round instead of saturating.
    """

    node: int
    index: int  # type: ignore[assignment]
    sub: int
    kind: str
    scale: float
    of: str = ""
    wraps: bool = False


class Signal(NamedTuple):
    """One row of the table. `unit` is the suffix of the name ("" for a pure number)."""

    name: str
    unit: str
    axles: int
    direction: str
    group: str
    text: str
    places: tuple[Place, ...] = ()


OUT, IN = "out", "in"
_DRIVE = 0

SIGNALS: tuple[Signal, ...] = (
    Signal(
        "time",
        "s",
        1,
        OUT,
        "",
        "simulated time since the run began",
        (Place(BENCH_NODE, 0x2100, 0, "U32", 1e-3, wraps=True),),
    ),
    Signal(
        "vehicle_speed",
        "m_s",
        1,
        OUT,
        "speeds",
        "speed of the (virtual) vehicle",
        (Place(BENCH_NODE, 0x2101, 0, "I32", 1e-4),),
    ),
    Signal(
        "position",
        "m",
        1,
        OUT,
        "",
        "distance run by the vehicle",
        (Place(BENCH_NODE, 0x2102, 0, "I32", 1e-3),),
    ),
    Signal(
        "vehicle_acceleration",
        "m_s2",
        1,
        OUT,
        "acceleration",
        "of the vehicle, negative in braking",
        (Place(BENCH_NODE, 0x2103, 0, "I16", 1e-3),),
    ),
    Signal(
        "brake_demand",
        "Pa",
        1,
        OUT,
        "pressures",
        "brake cylinder pressure asked for",
        (Place(BRAKE_NODE, 0x6411, 1, "I16", 100.0), Place(BENCH_NODE, 0x210B, 0, "I16", 100.0)),
    ),
    Signal("wheel_speed", "rad_s", AXLES, OUT, "", "rotation of the wheelset"),
    Signal("wheel_circumferential_speed", "m_s", AXLES, OUT, "speeds", "radius times wheel speed"),
    Signal(
        "measured_speed",
        "rad_s",
        AXLES,
        OUT,
        "",
        "rotation of the wheelset as its speed sensor tells it",
        (Place(SPEED_NODE, 0x6030, 1, "I16", 0.01), Place(SPEED_NODE, 0x2102, 1, "I32", 1e-4)),
    ),
    Signal(
        "wheel_angle", "rad", AXLES, OUT, "", "angle turned by the wheelset since the run began"
    ),
    Signal(
        "tooth_frequency",
        "Hz",
        AXLES,
        OUT,
        "",
        "teeth of the pole wheel passing the sensor",
        (Place(SPEED_NODE, 0x2100, 1, "U32", 1e-3),),
    ),
    Signal(
        "pulse_count",
        "",
        AXLES,
        OUT,
        "",
        "teeth that have passed the sensor",
        (Place(SPEED_NODE, 0x2101, 1, "U32", 1.0, wraps=True),),
    ),
    Signal(
        "roller_speed",
        "rad_s",
        AXLES,
        OUT,
        "",
        "rotation of the roller (0: plain track)",
        (Place(_DRIVE, 0x606C, 0, "I32", 1e-4),),
    ),
    Signal(
        "roller_angle",
        "rad",
        AXLES,
        OUT,
        "",
        "angle turned by the roller since the run began",
        (Place(_DRIVE, 0x6064, 0, "I32", 1e-3, wraps=True),),
    ),
    Signal("sliding", "m_s", AXLES, OUT, "sliding", "surface speed minus radius times wheel speed"),
    Signal("creepage", "", AXLES, OUT, "", "sliding over surface speed"),
    Signal(
        "adhesion",
        "",
        AXLES,
        OUT,
        "adhesion",
        "contact force over wheel load",
        (Place(BENCH_NODE, 0x2104, 1, "I16", 1e-4),),
    ),
    Signal("adhesion_degraded", "", AXLES, OUT, "adhesion", "lower limit f_d at this sliding"),
    Signal("adhesion_recovered", "", AXLES, OUT, "adhesion", "upper limit f_r at this sliding"),
    Signal("transition", "", AXLES, OUT, "transition", "lambda: 0 degraded, 1 recovered"),
    Signal(
        "dissipated_energy",
        "J_m",
        AXLES,
        OUT,
        "energy",
        "W_sp: energy dissipated per metre, one wheel",
    ),
    Signal(
        "sliding_work",
        "J",
        AXLES,
        OUT,
        "",
        "energy dissipated in the contacts of the wheelset so far",
        (Place(BENCH_NODE, 0x2108, 1, "U32", 1.0),),
    ),
    Signal(
        "friction_degraded",
        "",
        AXLES,
        OUT,
        "friction",
        "kinematic friction mu_cd of the contaminant under the axle",
    ),
    Signal(
        "film",
        "",
        AXLES,
        OUT,
        "film",
        "contaminant on the roller under the wheel, of what was prepared",
    ),
    Signal(
        "wheel_load",
        "N",
        AXLES,
        OUT,
        "loads",
        "vertical load of the wheelset (both wheels)",
        (Place(BENCH_NODE, 0x2109, 1, "U32", 1.0),),
    ),
    Signal(
        "brake_torque",
        "Nm",
        AXLES,
        OUT,
        "torques",
        "brake torque on the wheelset, positive when it brakes",
    ),
    Signal(
        "cylinder_pressure",
        "Pa",
        AXLES,
        OUT,
        "pressures",
        "brake cylinder pressure",
        (Place(BRAKE_NODE, 0x6401, 1, "I16", 100.0),),
    ),
    Signal(
        "valve",
        "",
        AXLES,
        OUT,
        "valves",
        "dump valve: 0 fill, 1 hold, 2 vent",
        (Place(BENCH_NODE, 0x2105, 1, "U16", 1.0),),
    ),
    Signal(
        "vents",
        "",
        AXLES,
        OUT,
        "",
        "times the dump valve began to vent",
        (Place(BENCH_NODE, 0x210A, 1, "U32", 1.0),),
    ),
    Signal(
        "longest_lock",
        "s",
        AXLES,
        OUT,
        "",
        "longest lock of the wheelset so far above lock_above_m_s",
        (Place(BENCH_NODE, 0x2107, 1, "U32", 1e-3),),
    ),
    Signal(
        "flat_length",
        "m",
        AXLES,
        OUT,
        "flats",
        "longest flat on the wheels of the wheelset",
        (Place(BENCH_NODE, 0x2110, 1, "U16", 1e-4),),
    ),
    Signal(
        "air_consumption",
        "NL",
        1,
        OUT,
        "air",
        "air used by the brake cylinders so far",
        (Place(BENCH_NODE, 0x2106, 0, "U32", 0.01),),
    ),
    Signal(
        "reservoir_pressure",
        "Pa",
        1,
        OUT,
        "pressures",
        "auxiliary reservoir (0: air never runs out)",
        (Place(BENCH_NODE, 0x210E, 0, "U16", 100.0),),
    ),
    Signal(
        "reservoir_least",
        "Pa",
        1,
        OUT,
        "",
        "least pressure of the auxiliary reservoir so far",
        (Place(BENCH_NODE, 0x210F, 0, "U16", 100.0),),
    ),
    Signal("air_supplied", "NL", 1, OUT, "air", "air that the supply gave the reservoir so far"),
    Signal(
        "sand_rate",
        "kg_s",
        AXLES,
        OUT,
        "sand",
        "sand that leaves the hose of the axle's sander",
        (Place(SANDER_NODE, 0x6401, 1, "I16", 1e-4),),
    ),
    Signal(
        "sand_box",
        "kg",
        AXLES,
        OUT,
        "",
        "sand left in the box of the axle's sander",
        (Place(SANDER_NODE, 0x6401, 5, "I16", 1e-2), Place(BENCH_NODE, 0x2112, 1, "U16", 1e-2)),
    ),
    Signal(
        "sand_taken",
        "kg",
        AXLES,
        OUT,
        "",
        "sand that the axle's sander took from its box",
        (Place(BENCH_NODE, 0x2113, 1, "U16", 1e-2),),
    ),
    Signal(
        "sand_dose",
        "kg_m",
        AXLES,
        OUT,
        "sand_dose",
        "sand that the wheels meet on a metre of track",
    ),
    Signal(
        "sand_demand",
        "",
        AXLES,
        IN,
        "",
        "sanders asked to strew",
        (Place(SANDER_NODE, 0x6200, 1, "U8", 1.0),),
    ),
    Signal("motor_torque_demand", "Nm", AXLES, OUT, "motors", "torque asked of the roller motor"),
    Signal(
        "motor_torque",
        "Nm",
        AXLES,
        OUT,
        "motors",
        "torque of the roller motor on the roller shaft",
        (Place(_DRIVE, 0x6077, 0, "I16", 1e-3, of="rated_torque_Nm"),),
    ),
    Signal(
        "disc_temperature",
        "K",
        AXLES,
        OUT,
        "temperatures",
        "brake discs of the wheelset, one body",
        (Place(BENCH_NODE, 0x210C, 1, "U16", 0.1),),
    ),
    Signal(
        "motor_temperature",
        "K",
        AXLES,
        OUT,
        "temperatures",
        "winding of the roller motor (track: the air's)",
        (Place(BENCH_NODE, 0x210D, 1, "U16", 0.1),),
    ),
    Signal(
        "tracking_error",
        "m_s",
        AXLES,
        OUT,
        "tracking",
        "roller rim minus vehicle, or on a virtual track real minus virtual wheel rim",
    ),
    Signal(
        "wsp_reference_speed",
        "m_s",
        1,
        IN,
        "speeds",
        "reference speed that the WSP unit tells (NaN: it does not)",
        (Place(WSP_NODE, 0x2110, 1, "I16", 0.01),),
    ),
    Signal(
        "magnets",
        "",
        AXLES,
        IN,
        "",
        "energised magnets: bit 0 hold, bit 1 vent",
        (Place(BRAKE_NODE, 0x6200, 1, "U8", 1.0),),
    ),
    Signal("tick_lateness", "us", 1, OUT, "loop", "latest start of a tick since the last sample"),
    Signal("tick_duration", "us", 1, OUT, "loop", "longest tick since the last sample"),
    Signal("ticks_missed", "", 1, OUT, "", "ticks that began after the next one was due, so far"),
)


def place(name: str, node: int) -> Place:
    """Where a signal stands at a node. KeyError if there is no such signal, LookupError if not there."""
    for one in BY_NAME[name].places:
        if one.node == node:
            return one
    raise LookupError(f"node {node} carries no '{name}'")


def bits(place: Place) -> int:
    """How many bits one count takes."""
    return int(place.kind[1:])


def columns(signal: Signal) -> tuple[str, ...]:
    """Names of a signal's recording columns: unit suffix last, axles counted from 1."""
    suffix = f"_{signal.unit}" if signal.unit else ""
    if signal.axles == 1:
        return (signal.name + suffix,)
    return tuple(f"{signal.name}_{axle}{suffix}" for axle in range(1, signal.axles + 1))


COLUMNS: tuple[str, ...] = tuple(name for signal in SIGNALS for name in columns(signal))
BY_NAME: dict[str, Signal] = {signal.name: signal for signal in SIGNALS}

_FIRST: dict[str, int] = {signal.name: COLUMNS.index(columns(signal)[0]) for signal in SIGNALS}


def column(name: str, axle: int = 1) -> int:
    """Position of a signal (of one axle, from 1) in a row of all signals. KeyError if unknown."""
    return _FIRST[name] + axle - 1


def span(name: str) -> slice:
    """Positions of all axles of a signal in a row of all signals. KeyError if unknown."""
    return slice(_FIRST[name], _FIRST[name] + BY_NAME[name].axles)


def count(value: float, place: Place, parameter: float = 1.0) -> int:
    """A value in its unit as the integer that stands on the bus.

    Rounded half to even; saturated at the bounds of the type, or wrapped where the place is a
    counter; a value that is not a number gives the lower bound.
    """
    low, high = KINDS[place.kind]
    if not np.isfinite(value):
        return low
    raw = round(value / (place.scale * parameter))
    if place.wraps:
        return (raw - low) % (high - low + 1) + low
    return min(max(raw, low), high)


def value(raw: int, place: Place, parameter: float = 1.0) -> float:
    """The integer that stands on the bus as a value in the signal's unit."""
    return raw * place.scale * parameter
