"""The Modbus map: every bit and register of the supervisory PLC and of the drives, one row each.

Unit 1 is the rig as the control room of a plant sees it. Units 11 to 14 are the roller drives under
axles 1 to 4, whose registers are objects of their dictionaries; the units of further axles follow.
The registers of a further group of axles have the addresses of the leading group plus
`REGISTERS_OF_GROUP` for each group, so a vehicle with more axles moves no register.

A unit has one space of bits and one of registers: coils and discrete inputs read the same bits,
holding and input registers the same registers, and the row gives whether a client can write it. A
row that carries a signal or an object takes its name, unit, scale and meaning from there. A value
of two registers has the higher one first.
"""

import csv
import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple, cast

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from rollerrig.configs import output_files
from rollerrig.configs.vehicle import AXLES_OF_GROUP
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Table

PLC_UNIT = 1
FIRST_DRIVE_UNIT = 11

BIT = "BIT"
READ = "ro"
WRITE = "rw"

# a brake demand that leaves the brakes to node 17 and to the programme of the scenario
NO_DEMAND = -1
# NMT state of a node that the bench has never heard
UNHEARD = 0xFFFF
# the registers of each further group of axles have addresses that are higher by this
REGISTERS_OF_GROUP = 1000


class State(IntEnum):
    """The state of the rig, register 100 of the PLC."""

    STARTING = 0
    HELD = 1
    RUNNING = 2
    ENDED = 3


class MotorState(IntEnum):
    """The state of the motor of an axle, registers from 512 of the PLC."""

    NONE = 0
    PERMITTED = 1
    REDUCED = 2
    RELEASED = 3
    FAILED = 4


class Register(NamedTuple):
    """One row of the map: a bit, or a value of one or two registers.

    A row has either a signal (a column of the live row), or an object of the drive, or neither:
    then it is a value of the bench.
    """

    address: int  # counts from 0, as on the wire
    name: str
    kind: str  # BIT, or an integer type of one or two registers
    text: str  # meaning
    unit: str = ""
    scale: float = 1.0  # value of one count, in the unit
    access: str = READ
    wraps: bool = False  # a counter wraps round; other values saturate
    signal: str = ""
    axle: int = 1  # the axle of the signal
    of: str = ""  # name of a parameter whose value multiplies the scale
    od_index: int = 0  # index of the object, 0 for none

    @property
    def width(self) -> int:
        """The number of bits or registers of the row."""
        return 2 if self.kind in ("U32", "I32") else 1


BITS: tuple[Register, ...] = (
    Register(0, "run", BIT, "1 while the rig runs; writing 1 starts a held rig", access=WRITE),
    Register(1, "stop", BIT, "1 when the run is ending; writing 1 ends it", access=WRITE),
    Register(
        2,
        "emergency_stop",
        BIT,
        "1 applies the emergency brake, which has priority over every other demand, and makes a "
        "quick stop of every drive; it stays until 0 is written",
        access=WRITE,
    ),
    Register(3, "held", BIT, "1 while the rig rolls at its set speed and waits for run"),
    Register(
        4,
        "at_set_speed",
        BIT,
        "1 when a held rig has rolled at its speed set-point for 2 s, so that a unit has its speed",
    ),
    Register(5, "standing", BIT, "1 while the vehicle stands"),
    Register(6, "wsp_unit_operational", BIT, "1 while the WSP unit reports OPERATIONAL"),
    Register(
        7, "nodes_operational", BIT, "1 while drives, speed unit and brake I/O are OPERATIONAL"
    ),
    Register(
        16,
        "inject_fault",
        BIT,
        "writing 1 injects the fault that registers 20 to 22 select; 1 while a fault is active",
        access=WRITE,
    ),
    Register(17, "lift_faults", BIT, "writing 1 lifts every active fault", access=WRITE),
)

# set-points, faults and states, in front of the measured values
COMMANDS_AND_STATES = (
    Register(
        0,
        "scenario",
        "U16",
        "number of the packaged scenario, see the list; can be written while the rig is held",
        access=WRITE,
    ),
    Register(
        1,
        "speed_set_point",
        "U16",
        "speed at which a held rig rolls and the run begins; can be written while the rig is held",
        unit="m_s",
        scale=0.01,
        access=WRITE,
    ),
    Register(
        2,
        "brake_demand_set_point",
        "I16",
        "demanded brake cylinder pressure; -1: node 17 or the scenario decides",
        unit="Pa",
        scale=signals.first_place("brake_demand").scale,
        access=WRITE,
    ),
    Register(
        20,
        "fault",
        "U16",
        "number of a fault, see the list; parameters without a register have their defaults",
        access=WRITE,
    ),
    Register(
        21,
        "fault_target",
        "U16",
        "axle, bogie, group, node or identifier of the fault; 0: the default",
        access=WRITE,
    ),
    Register(
        22,
        "fault_duration",
        "U16",
        "how long the fault lasts; 0: until it is lifted",
        unit="s",
        scale=0.1,
        access=WRITE,
    ),
    Register(100, "state", "U16", "0 starting, 1 held, 2 running, 3 ended"),
    Register(101, "scenarios", "U16", "number of packaged scenarios"),
)


def unit_state_name(group: int) -> str:
    """Return the name of the register with the NMT state of a group's WSP unit (0: leading)."""
    return "wsp_unit_state" if group == 0 else f"wsp_unit_{group + 1}_state"


# the places of the nodes of a group behind the state of its WSP unit: its drives come first
_FIRST_NODE_STATE = 103
_NODE_STATES = {
    signals.SPEED_NODE: _FIRST_NODE_STATE + AXLES_OF_GROUP,
    signals.BRAKE_NODE: _FIRST_NODE_STATE + AXLES_OF_GROUP + 1,
}


def _node_states(table: Table, group: int) -> Iterator[Register]:
    """Yield the rows of the NMT states of the nodes of a group."""
    offset = REGISTERS_OF_GROUP * group
    yield Register(
        102 + offset,
        unit_state_name(group),
        "U16",
        f"NMT state of node {table.wsp_nodes[group]}: 0 booted, 4 stopped, 5 operational, "
        "127 pre-operational, 65535 never heard",
    )
    for node in table.rig_nodes:
        if signals.group_of(node) == group:
            leading = signals.in_leading_group(node)
            address = _NODE_STATES.get(leading, _FIRST_NODE_STATE + leading - 1)
            yield Register(
                address + offset,
                f"node_{node}_state",
                "U16",
                f"NMT state of node {node}, as above",
            )


# the state of loop, bus and PLC, behind the measured values
_HEALTH = (
    Register(300, "ticks", "U32", "number of ticks of the run", wraps=True),
    Register(302, "lateness_p50", "U32", "median lateness of the ticks", unit="us"),
    Register(304, "lateness_p99", "U32", "99th percentile of the lateness", unit="us"),
    Register(306, "lateness_max", "U32", "largest lateness of the run", unit="us"),
    Register(308, "events_info", "U32", "events of the run: information", wraps=True),
    Register(310, "events_warning", "U32", "events of the run: warnings", wraps=True),
    Register(312, "events_error", "U32", "events of the run: errors", wraps=True),
    Register(314, "bus_frames", "U32", "frames on the CAN bus", wraps=True),
    Register(316, "bus_frames_dropped", "U32", "frames that slow clients missed", wraps=True),
    Register(318, "bus_load", "U16", "load of the CAN bus", unit="percent", scale=0.1),
    Register(319, "modbus_clients", "U16", "number of connected Modbus clients"),
    Register(320, "modbus_requests", "U32", "answered Modbus requests", wraps=True),
    Register(322, "modbus_exceptions", "U32", "requests answered with an exception", wraps=True),
    Register(
        324,
        "modbus_malformed",
        "U32",
        "connections closed, or serial frames ignored, because of wrong framing",
        wraps=True,
    ),
    Register(326, "faults_active", "U16", "number of active faults"),
)


class Measured(NamedTuple):
    """The first register of a signal; the axles of the leading group follow one another.

    A signal without a kind has the kind and the scale of its first place on the CAN bus.
    """

    address: int
    signal: str
    kind: str = ""
    scale: float = 0.0


_MEASURED = (
    Measured(200, "time", "U32", 1e-3),
    Measured(202, "vehicle_speed", "I16", 0.01),
    Measured(203, "position", "U32", 0.01),
    Measured(205, "vehicle_acceleration", "I16", 1e-3),
    Measured(206, "brake_demand"),
    Measured(207, "wsp_reference_speed"),
    Measured(208, "measured_speed"),
    Measured(212, "wheel_circumferential_speed", "I16", 0.01),
    Measured(216, "sliding", "I16", 0.01),
    Measured(220, "cylinder_pressure"),
    Measured(224, "valve", "U16", 1.0),
    Measured(228, "magnets", "U16", 1.0),
    Measured(232, "roller_speed"),
    Measured(240, "motor_torque"),
    Measured(244, "brake_torque", "I16", 1.0),
    Measured(248, "adhesion", "U16", 1e-4),
    Measured(252, "tooth_frequency"),
    Measured(260, "pulse_count"),
    Measured(268, "vents", "U16", 1.0),
    Measured(272, "wheel_load", "U32", 1.0),
    Measured(280, "longest_lock", "U16", 1e-3),
    Measured(284, "air_consumption", "U32", 0.1),
    Measured(286, "tick_lateness", "U32", 1.0),
    Measured(288, "tick_duration", "U32", 1.0),
    Measured(290, "ticks_missed", "U32", 1.0),
    Measured(400, "disc_temperature"),
    Measured(404, "motor_temperature"),
)


# motors and magnets, behind the map of a vehicle that has neither
_OF_MOTORS = (
    Measured(500, "dynamic_torque_demand", "I16", 1.0),
    Measured(504, "dynamic_torque"),
    Measured(508, "dynamic_share"),
    Measured(516, "friction_demand", "I16", 100.0),
    Measured(520, "dynamic_work", "I32", 1.0),
    Measured(528, "traction_demand", "I16", 1e-3),
)
_MOTOR_STATE = 512
_OF_MAGNETS = (
    Measured(540, "track_brake_demand", "U16", 1.0),
    Measured(544, "track_brake_lowered"),
    Measured(548, "track_brake_force"),
    Measured(552, "track_brake_cleaning", "U32", 1.0),
    Measured(560, "track_brake_work", "U32", 1.0),
)


def _reference_speed(group: int) -> Measured:
    """Return the place of the reference speed of the unit of a further group."""
    leading = next(row for row in _MEASURED if row.signal == "wsp_reference_speed")
    place = signals.first_place(leading.signal)
    name = signals.reference_speed_name(group)
    return Measured(leading.address, name, place.kind, place.scale)


def _values(table: Table, measured: Iterable[Measured], group: int) -> Iterator[Register]:
    """Yield the rows of measured values of a group; the leading one has those of the vehicle."""
    for first_address, name, kind, scale in measured:
        signal = table.by_name[name]
        wraps = False
        parameter = ""
        if not kind and signal.places:
            place = signal.places[0]
            kind = place.kind
            scale = place.scale
            wraps = place.wraps
            parameter = place.of
        axles = table.axles_of(group)
        if signal.axles == 1:
            of_group = group == 0 or name == signals.reference_speed_name(group)
            axles = range(1, 2) if of_group else range(0)
        for axle in axles:
            column = signals.columns(signal)[axle - 1]
            row = Register(
                address=first_address + REGISTERS_OF_GROUP * group,
                name=column.removesuffix(f"_{signal.unit}"),
                kind=kind,
                text=signal.text,
                unit=signal.unit,
                scale=scale,
                wraps=wraps,
                signal=name,
                axle=axle,
                of=parameter,
            )
            yield row._replace(address=row.address + (axle - axles[0]) * row.width)


def _motors_and_magnets(table: Table, group: int) -> Iterator[Register]:
    """Yield the rows of the motors and magnets of a group; none where the vehicle has none."""
    if table.kind.dynamic_brake:
        yield from _values(table, _OF_MOTORS, group)
        for place, axle in enumerate(table.axles_of(group)):
            yield Register(
                _MOTOR_STATE + REGISTERS_OF_GROUP * group + place,
                motor_state_name(axle),
                "U16",
                "motor of the axle: 0 none, 1 slide control permits its whole force, 2 a share, "
                "3 it is released, 4 it has failed",
                axle=axle,
            )
    if table.kind.magnetic_track_brake:
        yield from _values(table, _OF_MAGNETS, group)


def motor_state_name(axle: int) -> str:
    """Return the name of the register with the state of an axle's motor."""
    return f"motor_state_{axle}"


@functools.cache
def words(table: Table) -> tuple[Register, ...]:
    """Return all registers of the PLC of a vehicle, the leading group first."""
    found = [
        *COMMANDS_AND_STATES,
        *_node_states(table, 0),
        *_values(table, _MEASURED, 0),
        *_HEALTH,
        *_motors_and_magnets(table, 0),
    ]
    for group in range(1, table.kind.groups):
        found += _node_states(table, group)
        found += _values(table, (_reference_speed(group), *_MEASURED), group)
        found += _motors_and_magnets(table, group)
    return tuple(found)


def drive_units(table: Table) -> dict[int, int]:
    """Return the unit of each drive, by the number of its node."""
    return {node: FIRST_DRIVE_UNIT + at for at, node in enumerate(table.drive_nodes)}


class _DriveObject(NamedTuple):
    """The first register of an object of a drive."""

    address: int
    od_index: int


# the objects that a client writes and reads
_COMMANDED = (
    _DriveObject(0, 0x6040),  # controlword
    _DriveObject(1, 0x6060),  # modes of operation
    _DriveObject(2, 0x60FF),  # target velocity
    _DriveObject(4, 0x6071),  # target torque
    _DriveObject(5, 0x6072),  # max torque
    _DriveObject(6, 0x6083),  # profile acceleration
    _DriveObject(8, 0x6084),  # profile deceleration
    _DriveObject(10, 0x6085),  # quick stop deceleration
    _DriveObject(12, 0x6087),  # torque slope
    _DriveObject(14, 0x6081),  # profile velocity
    _DriveObject(16, 0x605A),  # quick stop option code
    _DriveObject(17, 0x605E),  # fault reaction option code
)
# the objects that a client only reads
_READ_ONLY = (
    _DriveObject(100, 0x6041),  # statusword
    _DriveObject(101, 0x6061),  # modes of operation display
    _DriveObject(102, 0x606C),  # velocity actual value
    _DriveObject(104, 0x6064),  # position actual value
    _DriveObject(106, 0x6077),  # torque actual value
    _DriveObject(107, 0x6078),  # current actual value
    _DriveObject(108, 0x6079),  # DC link circuit voltage
    _DriveObject(110, 0x603F),  # error code
    _DriveObject(111, 0x606B),  # velocity demand value
    _DriveObject(113, 0x6074),  # torque demand
    _DriveObject(114, 0x6076),  # motor rated torque
    _DriveObject(116, 0x6502),  # supported drive modes
)

# a register has at least 16 bits
_KINDS = {
    datatypes.UNSIGNED8: "U16",
    datatypes.INTEGER8: "I16",
    datatypes.UNSIGNED16: "U16",
    datatypes.INTEGER16: "I16",
    datatypes.UNSIGNED32: "U32",
    datatypes.INTEGER32: "I32",
}


def drive_registers(dictionary: ObjectDictionary) -> tuple[Register, ...]:
    """Return the registers of a drive, from its object dictionary."""
    commanded = [_drive_register(dictionary, place, WRITE) for place in _COMMANDED]
    read_only = [_drive_register(dictionary, place, READ) for place in _READ_ONLY]
    return (*commanded, *read_only)


def _drive_register(dictionary: ObjectDictionary, place: _DriveObject, access: str) -> Register:
    variable = cast(ODVariable, dictionary[place.od_index])
    return Register(
        address=place.address,
        name=variable.name.lower().replace(" ", "_").replace("-", "_"),
        kind=_KINDS[cast(int, variable.data_type)],
        text=f"{place.od_index:04X}h {variable.name}",
        unit=variable.unit.replace("/", "_"),
        scale=variable.factor,
        access=access,
        od_index=place.od_index,
    )


# -- the map as documents


class Line(NamedTuple):
    """One row of the map as text; the names of the fields are the heads of the columns."""

    unit: str
    space: str
    register: str
    reference: str
    name: str
    kind: str
    unit_of_value: str
    scale: str
    access: str
    meaning: str


# references of Modicon count from 1, and their leading digit gives the table
_COILS = 1
_DISCRETE_INPUTS = 10001
_HOLDING_REGISTERS = 40001
_INPUT_REGISTERS = 30001

_INTRODUCTION = """# Modbus map

Addresses count from 0, as on the wire. The references of other tools count from 1 and are
given beside them. Functions 1 and 2 read the same bits, 3 and 4 the same registers. Only
rows marked rw can be written (5, 6, 15, 16, 22, 23). A value of two registers has the
higher one first and is written whole. Value = count x scale. If a quantity is not known,
its count is the lowest of its kind.
"""


def lines(table: Table, drives: Mapping[int, ObjectDictionary]) -> list[Line]:
    """Return all rows of all units of a vehicle as text.

    `drives` are the dictionaries of the drives by node.
    """
    found: list[Line] = []
    for row in BITS:
        first_reference = _COILS if row.access == WRITE else _DISCRETE_INPUTS
        found.append(_line(PLC_UNIT, "bits", row, first_reference))
    found += _register_lines(PLC_UNIT, words(table))
    units = drive_units(table)
    for node, dictionary in drives.items():
        found += _register_lines(units[node], drive_registers(dictionary))
    return found


def _register_lines(unit: int, rows: Iterable[Register]) -> Iterator[Line]:
    for row in rows:
        first_reference = _HOLDING_REGISTERS if row.access == WRITE else _INPUT_REGISTERS
        yield _line(unit, "registers", row, first_reference)


def _line(unit: int, space: str, row: Register, first_reference: int) -> Line:
    register = str(row.address)
    if row.width > 1:
        register += f"..{row.address + row.width - 1}"
    scale = f"{row.scale:.6g}"
    if row.of:
        scale += f" x {row.of}"
    return Line(
        unit=str(unit),
        space=space,
        register=register,
        reference=f"{row.address + first_reference:05d}",
        name=row.name,
        kind=row.kind,
        unit_of_value=row.unit.replace("_", "/"),
        scale=scale,
        access=row.access,
        meaning=row.text,
    )


def markdown(
    table: Table, drives: Mapping[int, ObjectDictionary], scenarios: tuple[str, ...] = ()
) -> str:
    """Return the map of a vehicle as a document.

    `scenarios`: names in the order of their numbers.
    """
    parts = [_INTRODUCTION]
    heads = Line._fields[1:]
    all_lines = lines(table, drives)
    for unit, rows in itertools.groupby(all_lines, key=lambda line: int(line.unit)):
        device = "the rig" if unit == PLC_UNIT else f"roller drive {unit - FIRST_DRIVE_UNIT + 1}"
        parts += [f"## Unit {unit}: {device}", ""]
        # the unit is in the heading
        parts += _markdown_table(heads, (line[1:] for line in rows))
        parts.append("")
    if scenarios:
        parts += ["## Scenarios, register 0 of unit 1", ""]
        parts += _markdown_table(("number", "scenario"), enumerate(scenarios))
    parts += ["", "## Faults, register 20 of unit 1", ""]
    kinds = catalogue.of(table.kind).values()
    faults = [(kind.number, kind.name, kind.text) for kind in kinds]
    parts += _markdown_table(("number", "fault", "what it does"), faults)
    return "\n".join(parts) + "\n"


def _markdown_table(heads: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(heads)} |"
    yield "|" + "---|" * len(heads)
    for row in rows:
        yield f"| {' | '.join(map(str, row))} |"


def write(
    folder: Path,
    table: Table,
    drives: Mapping[int, ObjectDictionary],
    scenarios: tuple[str, ...] = (),
) -> list[Path]:
    """Write `modbus.md` and `modbus.csv` of a vehicle into a folder, and return the two files."""
    output_files.make_folder(folder)
    document = folder / "modbus.md"
    sheet = folder / "modbus.csv"
    output_files.write_text(document, markdown(table, drives, scenarios))
    with (
        output_files.replaced(sheet) as new,
        new.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Line._fields)
        writer.writerows(lines(table, drives))
    return [document, sheet]
