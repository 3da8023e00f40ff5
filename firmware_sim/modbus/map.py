"""The Modbus map: every bit and register of the supervisory PLC and of the drives, one row each.

Unit 1 is the rig as a plant's control room sees it, units 11 to 14 are the roller drives with what stands in their
object dictionaries. A unit has one space of bits and one of registers: coils and discrete inputs read the same bits,
holding and input registers the same registers, and what can be written says so. Rows that carry a signal or an object
take its name, unit, scale and meaning from there; values of two registers have the higher one first.
"""

import csv
import itertools
from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple, cast

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from rollerrig.firmware_sim.faults.catalogue import CATALOGUE
from rollerrig.wsp_interface import signals

PLC_UNIT = 1
FIRST_DRIVE_UNIT = 11
# the unit of the drive at a node
DRIVE_UNITS = {node: FIRST_DRIVE_UNIT + at for at, node in enumerate(signals.DRIVE_NODES)}
BIT = "BIT"
READ, WRITE = "ro", "rw"
# a brake demand that leaves the brakes to node 17 and the scenario's programme
NO_DEMAND = -1
# NMT state of a node that has never been heard
UNHEARD = 0xFFFF


class State(IntEnum):
    """What the rig does, register 100 of the PLC."""

    STARTING = 0
    HELD = 1
    RUNNING = 2
    ENDED = 3


class Register(NamedTuple):
    """One row. `at` counts from 0, as on the wire; `scale` is the unit per count.

    `signal` and `axle` say which column of the live row it is; `od_index` which object of
    the drive; neither: a value of the bench. `wraps`: a counter, which begins again at its bound.
    """

    at: int
    name: str
    kind: str
    text: str
    unit: str = ""
    scale: float = 1.0
    access: str = READ
    wraps: bool = False
    signal: str = ""
    axle: int = 1
    of: str = ""
    od_index: int = 0

    @property
    def width(self) -> int:
        """How many bits or registers it takes."""
        return 2 if self.kind in ("U32", "I32") else 1


BITS: tuple[Register, ...] = (
    Register(0, "run", BIT, "1 while the rig runs; writing 1 starts a held rig", access=WRITE),
    Register(1, "stop", BIT, "1 when the run is ending; writing 1 ends it", access=WRITE),
    Register(
        2,
        "emergency_stop",
        BIT,
        "1 applies the emergency brake, whatever else is asked, and "
        "makes a quick stop of every drive; stays until 0 is written",
        access=WRITE,
    ),
    Register(3, "held", BIT, "the rig rolls at its set speed and waits for run"),
    Register(4, "at_set_speed", BIT, "a held rig rolls at its speed set-point"),
    Register(5, "standing", BIT, "the vehicle stands"),
    Register(6, "wsp_unit_operational", BIT, "the WSP unit's heartbeat says OPERATIONAL"),
    Register(7, "nodes_operational", BIT, "drives, speed unit and brake I/O are OPERATIONAL"),
    Register(
        16,
        "inject_fault",
        BIT,
        "writing 1 injects the fault chosen in registers 20 to 22; 1 while any is active",
        access=WRITE,
    ),
    Register(17, "lift_faults", BIT, "writing 1 lifts every active fault", access=WRITE),
)

# set-points, faults and states, which stand before what is measured
_ASKED = (
    Register(
        0,
        "scenario",
        "U16",
        "number of the packaged scenario, see the list; while the rig is held",
        access=WRITE,
    ),
    Register(
        1,
        "speed_set_point",
        "U16",
        "speed at which a held rig rolls and begins; while the rig is held",
        "m_s",
        0.01,
        WRITE,
    ),
    Register(
        2,
        "brake_demand_set_point",
        "I16",
        "brake cylinder pressure asked for; -1: node 17 or the scenario decides",
        "Pa",
        signals.BY_NAME["brake_demand"].places[0].scale,
        WRITE,
    ),
    Register(
        20,
        "fault",
        "U16",
        "number of a fault, see the list; its other parameters take their defaults",
        access=WRITE,
    ),
    Register(
        21, "fault_target", "U16", "its axle, node or identifier; 0: the default", access=WRITE
    ),
    Register(
        22, "fault_duration", "U16", "how long it holds; 0: until it is lifted", "s", 0.1, WRITE
    ),
    Register(100, "state", "U16", "0 starting, 1 held, 2 running, 3 ended"),
    Register(101, "scenarios", "U16", "how many packaged scenarios there are"),
    Register(
        102,
        "wsp_unit_state",
        "U16",
        "NMT state of node 32: 0 booted, 4 stopped, 5 operational, "
        "127 pre-operational, 65535 never heard",
    ),
    *(
        Register(103 + at, f"node_{node}_state", "U16", f"NMT state of node {node}, as above")
        for at, node in enumerate(signals.RIG_NODES)
    ),
)
_HEALTH = (
    Register(300, "ticks", "U32", "ticks of the run", wraps=True),
    Register(302, "lateness_p50", "U32", "lateness of half of the ticks", "us"),
    Register(304, "lateness_p99", "U32", "lateness of 99 % of the ticks", "us"),
    Register(306, "lateness_max", "U32", "latest tick of the run", "us"),
    Register(308, "events_info", "U32", "events of the run: information", wraps=True),
    Register(310, "events_warning", "U32", "events of the run: warnings", wraps=True),
    Register(312, "events_error", "U32", "events of the run: errors", wraps=True),
    Register(314, "bus_frames", "U32", "frames on the CAN bus", wraps=True),
    Register(316, "bus_frames_dropped", "U32", "frames that a slow client did not get", wraps=True),
    Register(318, "bus_load", "U16", "load of the CAN bus", "percent", 0.1),
    Register(319, "modbus_clients", "U16", "connected Modbus clients"),
    Register(320, "modbus_requests", "U32", "Modbus requests answered", wraps=True),
    Register(322, "modbus_exceptions", "U32", "of these with an exception", wraps=True),
    Register(
        324,
        "modbus_malformed",
        "U32",
        "connections closed, or serial frames ignored, for malformed framing",
        wraps=True,
    ),
    Register(326, "faults_active", "U16", "faults that are active"),
)

# first register, signal, and kind and scale where the CAN bus does not give them
_MEASURED: tuple[tuple[int, str, str, float], ...] = (
    (200, "time", "U32", 1e-3),
    (202, "vehicle_speed", "I16", 0.01),
    (203, "position", "U32", 0.01),
    (205, "vehicle_acceleration", "I16", 1e-3),
    (206, "brake_demand", "", 0.0),
    (207, "wsp_reference_speed", "", 0.0),
    (208, "measured_speed", "", 0.0),
    (212, "wheel_circumferential_speed", "I16", 0.01),
    (216, "sliding", "I16", 0.01),
    (220, "cylinder_pressure", "", 0.0),
    (224, "valve", "U16", 1.0),
    (228, "magnets", "U16", 1.0),
    (232, "roller_speed", "", 0.0),
    (240, "motor_torque", "", 0.0),
    (244, "brake_torque", "I16", 1.0),
    (248, "adhesion", "U16", 1e-4),
    (252, "tooth_frequency", "", 0.0),
    (260, "pulse_count", "", 0.0),
    (268, "vents", "U16", 1.0),
    (272, "wheel_load", "U32", 1.0),
    (280, "longest_lock", "U16", 1e-3),
    (284, "air_consumption", "U32", 0.1),
    (286, "tick_lateness", "U32", 1.0),
    (288, "tick_duration", "U32", 1.0),
    (290, "ticks_missed", "U32", 1.0),
    (400, "disc_temperature", "", 0.0),
    (404, "motor_temperature", "", 0.0),
)


def _measured() -> Iterator[Register]:
    for first, name, kind, scale in _MEASURED:
        signal = signals.BY_NAME[name]
        place = signal.places[0] if signal.places and not kind else None
        kind, scale = (place.kind, place.scale) if place else (kind, scale)
        for axle, column in enumerate(signals.columns(signal), start=1):
            row = Register(
                at=first,
                name=column.removesuffix(f"_{signal.unit}"),
                kind=kind,
                text=signal.text,
                unit=signal.unit,
                scale=scale,
                wraps=bool(place and place.wraps),
                signal=name,
                axle=axle,
                of=place.of if place else "",
            )
            yield row._replace(at=first + (axle - 1) * row.width)


WORDS: tuple[Register, ...] = (*_ASKED, *_measured(), *_HEALTH)

# a drive's registers: (first register, index), written and read, then read only
_COMMANDED = (
    (0, 0x6040),
    (1, 0x6060),
    (2, 0x60FF),
    (4, 0x6071),
    (5, 0x6072),
    (6, 0x6083),
    (8, 0x6084),
    (10, 0x6085),
    (12, 0x6087),
    (14, 0x6081),
    (16, 0x605A),
    (17, 0x605E),
)
_TOLD = (
    (100, 0x6041),
    (101, 0x6061),
    (102, 0x606C),
    (104, 0x6064),
    (106, 0x6077),
    (107, 0x6078),
    (108, 0x6079),
    (110, 0x603F),
    (111, 0x606B),
    (113, 0x6074),
    (114, 0x6076),
    (116, 0x6502),
)
_TYPES = {
    datatypes.UNSIGNED8: "U16",
    datatypes.INTEGER8: "I16",
    datatypes.UNSIGNED16: "U16",
    datatypes.INTEGER16: "I16",
    datatypes.UNSIGNED32: "U32",
    datatypes.INTEGER32: "I32",
}


def drive_words(dictionary: ObjectDictionary) -> tuple[Register, ...]:
    """The registers of a drive, from its object dictionary."""
    found = []
    for access, rows in ((WRITE, _COMMANDED), (READ, _TOLD)):
        for at, index in rows:
            one = cast(ODVariable, dictionary[index])
            name = one.name.lower().replace(" ", "_").replace("-", "_")
            found.append(
                Register(
                    at=at,
                    name=name,
                    kind=_TYPES[cast(int, one.data_type)],
                    text=f"{index:04X}h {one.name}",
                    unit=one.unit.replace("/", "_"),
                    scale=one.factor,
                    access=access,
                    od_index=index,
                )
            )
    return tuple(found)


HEAD = (
    "unit",
    "space",
    "register",
    "reference",
    "name",
    "kind",
    "unit_of_value",
    "scale",
    "access",
    "meaning",
)
_INTRODUCTION = """# Modbus map

Addresses count from 0, as on the wire; the references of other tools count from 1 and are
given beside them. Functions 1 and 2 read the same bits, 3 and 4 the same registers; only
rows marked rw can be written (5, 6, 15, 16, 22, 23). A value of two registers has the
higher one first and is written whole. Value = count x scale; a quantity that is not known
is the lowest count of its kind.
"""


def table(drives: Mapping[int, ObjectDictionary]) -> list[tuple[str, ...]]:
    """All rows as text, in the order of `HEAD`; `drives` are the drives' dictionaries by node."""
    found: list[tuple[str, ...]] = []
    units = (
        (PLC_UNIT, BITS, WORDS),
        *((DRIVE_UNITS[node], (), drive_words(one)) for node, one in drives.items()),
    )
    for unit, bits, words in units:
        # the references of Modicon count from 1 and tell the table in front
        for space, rows, written, read in (
            ("bits", bits, 1, 10001),
            ("registers", words, 40001, 30001),
        ):
            for row in rows:
                last = f"..{row.at + row.width - 1}" if row.width > 1 else ""
                scale = f"{row.scale:.6g}" + (f" x {row.of}" if row.of else "")
                reference = f"{row.at + (written if row.access == WRITE else read):05d}"
                found.append(
                    (
                        str(unit),
                        space,
                        f"{row.at}{last}",
                        reference,
                        row.name,
                        row.kind,
                        row.unit.replace("_", "/"),
                        scale,
                        row.access,
                        row.text,
                    )
                )
    return found


def markdown(drives: Mapping[int, ObjectDictionary], scenarios: tuple[str, ...] = ()) -> str:
    """The map as a document. `scenarios`: their names, in the order of their numbers."""
    lines = [_INTRODUCTION]
    for unit, rows in itertools.groupby(table(drives), key=lambda row: int(row[0])):
        what = "the rig" if unit == PLC_UNIT else f"roller drive {unit - FIRST_DRIVE_UNIT + 1}"
        lines += [f"## Unit {unit}: {what}", "", *_lines(HEAD[1:], (row[1:] for row in rows)), ""]
    if scenarios:
        lines += [
            "## Scenarios, register 0 of unit 1",
            "",
            *_lines(("number", "scenario"), enumerate(scenarios)),
        ]
    faults = ((kind.number, kind.name, kind.text) for kind in CATALOGUE)
    lines += [
        "",
        "## Faults, register 20 of unit 1",
        "",
        *_lines(("number", "fault", "what it does"), faults),
    ]
    return "\n".join(lines) + "\n"


def _lines(heads: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(heads)} |"
    yield "|" + "---|" * len(heads)
    yield from (f"| {' | '.join(map(str, row))} |" for row in rows)


def write(
    folder: Path, drives: Mapping[int, ObjectDictionary], scenarios: tuple[str, ...] = ()
) -> list[Path]:
    """Write `modbus.md` and `modbus.csv` into a folder; what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    document, sheet = folder / "modbus.md", folder / "modbus.csv"
    document.write_text(markdown(drives, scenarios), encoding="utf-8")
    with sheet.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([HEAD, *table(drives)])
    return [document, sheet]
