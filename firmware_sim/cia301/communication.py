"""The rows of the communication profile: objects 1000h to 1FFFh of every node of the rig.

A device says its type, its PDOs and a few defaults; the rest is the same for all. Four PDOs stand
ready in each direction; those a device does not use are there, not valid, for an outside master to
map as it likes. A COB-ID entry is 29 bits of identifier and three flags: bit 31 says that the
message does not exist, bit 30 means what its object says, bit 29 that the identifier has 29 bits.
Source: CiA 301, section on the communication profile objects, description of COB-ID entries, table
of restricted CAN-IDs.
"""

from collections.abc import Sequence
from typing import NamedTuple

from rollerrig.firmware_sim.cia301.dictionary import Identity, Row, array
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY, RPDO, SDO_REPLY, SDO_REQUEST, SYNC, TIME, TPDO

PDOS = 4
MAPPED = 8
INVALID, FLAG, EXTENDED = 1 << 31, 1 << 30, 1 << 29
STANDARD_MASK, EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
# identifiers that belong to fixed services
RESTRICTED = ((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF),
              (0x701, 0x7FF))
SDO_SERVERS = 3
HISTORY = 8
_STORED = ("All", "Communication", "Application")


class Pdo(NamedTuple):
    """A PDO of a device: its transmission type and what it carries, as (index, sub, bits)."""

    kind: int
    mapped: tuple[tuple[int, int, int], ...]
    event_ms: int = 0
    inhibit_100us: int = 0


class Profile(NamedTuple):
    """What distinguishes one device's communication profile from another's.

    `consumed`: (node, time in ms) for 1016h. `on_error`: 1029h:1, what a lost heartbeat does to the
    NMT state (0 pre-operational, 1 nothing, 2 stopped).
    """

    device_type: int
    name: str
    rpdos: Sequence[Pdo] = ()
    tpdos: Sequence[Pdo] = ()
    consumed: Sequence[tuple[int, int]] = ()
    heartbeat_ms: int = 100
    on_error: int = 1


def rows(profile: Profile, identity: Identity) -> list[Row]:
    """All rows of 1000h..1FFFh for a profile."""
    consumed = [node << 16 | time for node, time in profile.consumed]
    consumed += [0] * (4 - len(consumed))
    return [
        Row(0x1000, 0, "Device type", "U32", "const", profile.device_type),
        Row(0x1001, 0, "Error register", "U8", "ro", 0, True),
        *_history(),
        Row(0x1005, 0, "COB-ID SYNC message", "U32", "rw", SYNC),
        Row(0x1006, 0, "Communication cycle period", "U32", "rw", 0, unit="us"),
        Row(0x1007, 0, "Synchronous window length", "U32", "rw", 0, unit="us"),
        Row(0x1008, 0, "Manufacturer device name", "TEXT", "const", profile.name),
        Row(0x1009, 0, "Manufacturer hardware version", "TEXT", "const", "simulated"),
        Row(0x100A, 0, "Manufacturer software version", "TEXT", "const", "0.1"),
        Row(0x100C, 0, "Guard time", "U16", "rw", 0, unit="ms"),
        Row(0x100D, 0, "Life time factor", "U8", "rw", 0),
        *array(0x1010, "Store parameters", "U32", "rw", [1] * 3, _STORED),
        *array(0x1011, "Restore default parameters", "U32", "rw", [1] * 3, _STORED),
        Row(0x1012, 0, "COB-ID TIME message", "U32", "rw", INVALID | TIME),
        Row(0x1014, 0, "COB-ID EMCY message", "U32", "rw", EMERGENCY, relative=True),
        Row(0x1015, 0, "Inhibit time EMCY", "U16", "rw", 0, unit="100us"),
        *array(0x1016, "Consumer heartbeat time", "U32", "rw", consumed),
        Row(0x1017, 0, "Producer heartbeat time", "U16", "rw", profile.heartbeat_ms, unit="ms"),
        *_identity(identity),
        Row(0x1019, 0, "Synchronous counter overflow value", "U8", "rw", 0, high=240),
        *array(0x1029, "Error behaviour", "U8", "rw", [profile.on_error],
               ("Communication error",), high=2),
        *_sdo_servers(),
        *_pdos(0x1400, "RPDO", RPDO, profile.rpdos),
        *_pdos(0x1800, "TPDO", TPDO, profile.tpdos),
    ]


def _history() -> list[Row]:
    name = "Pre-defined error field"
    return [Row(0x1003, 0, f"{name}/Number of errors", "U8", "rw", 0),
            *(Row(0x1003, at, f"{name}/Standard error field {at}", "U32", "ro", 0)
              for at in range(1, HISTORY + 1))]


def _identity(identity: Identity) -> list[Row]:
    names = ("Vendor-ID", "Product code", "Revision number", "Serial number")
    return array(0x1018, "Identity object", "U32", "const", identity[2:], names)


def _sdo_servers() -> list[Row]:
    found: list[Row] = []
    for server in range(SDO_SERVERS):
        index, access = 0x1200 + server, "ro" if server == 0 else "rw"
        name = f"SDO server parameter {server}"
        first = server == 0
        request, reply = (SDO_REQUEST, SDO_REPLY) if first else (INVALID, INVALID)
        found += [
            Row(index, 0, f"{name}/Highest sub-index supported", "U8", "const", 2 if first else 3),
            Row(index, 1, f"{name}/COB-ID client to server", "U32", access, request,
                relative=first),
            Row(index, 2, f"{name}/COB-ID server to client", "U32", access, reply, relative=first),
        ]
        if server:
            found.append(Row(index, 3, f"{name}/Node-ID of the client", "U8", "rw", 0, high=127))
    return found


def _pdos(first: int, word: str, ids: Sequence[int], used: Sequence[Pdo]) -> list[Row]:
    found: list[Row] = []
    for at in range(PDOS):
        pdo = used[at] if at < len(used) else Pdo(254, ())
        cob_id = ids[at] | (0 if at < len(used) else INVALID)
        found += _parameters(first + at, f"{word} {at + 1} communication parameter", cob_id, pdo,
                             word == "TPDO")
        found += _mapping(first + 0x200 + at, f"{word} {at + 1} mapping parameter", pdo)
    return found


def _parameters(index: int, name: str, cob_id: int, pdo: Pdo, transmits: bool) -> list[Row]:
    found = [
        Row(index, 0, f"{name}/Highest sub-index supported", "U8", "const", 6 if transmits else 5),
        Row(index, 1, f"{name}/COB-ID", "U32", "rw", cob_id, relative=True),
        Row(index, 2, f"{name}/Transmission type", "U8", "rw", pdo.kind),
        Row(index, 3, f"{name}/Inhibit time", "U16", "rw", pdo.inhibit_100us, unit="100us"),
        Row(index, 5, f"{name}/Event timer", "U16", "rw", pdo.event_ms, unit="ms"),
    ]
    if transmits:
        found.append(Row(index, 6, f"{name}/SYNC start value", "U8", "rw", 0, high=240))
    return found


def _mapping(index: int, name: str, pdo: Pdo) -> list[Row]:
    entries = [index << 16 | sub << 8 | bits for index, sub, bits in pdo.mapped]
    entries += [0] * (MAPPED - len(entries))
    return [Row(index, 0, f"{name}/Number of mapped objects", "U8", "rw", len(pdo.mapped)),
            *(Row(index, at, f"{name}/Mapped object {at}", "U32", "rw", entry)
              for at, entry in enumerate(entries, 1))]


def valid(cob_id: int) -> bool:
    """Whether the message exists."""
    return not cob_id & INVALID


def split(cob_id: int) -> tuple[int, bool]:
    """The identifier, and whether it is one of 29 bits."""
    extended = bool(cob_id & EXTENDED)
    return cob_id & (EXTENDED_MASK if extended else STANDARD_MASK), extended


def dispatch_key(can_id: int, extended: bool) -> int:
    """Identifier and format as one number."""
    return can_id | EXTENDED if extended else can_id


def check_identifier(cob_id: int) -> None:
    """AbortError unless the identifier may be given to a configurable message."""
    can_id, extended = split(cob_id)
    if not extended and cob_id & EXTENDED_MASK != can_id:
        raise AbortError(Abort.INVALID_VALUE)
    if not extended and any(low <= can_id <= high for low, high in RESTRICTED):
        raise AbortError(Abort.INVALID_VALUE)


def check_change(current: int, wanted: int) -> None:
    """AbortError if a message that exists would get another identifier without a switch-off."""
    if not valid(wanted):
        return
    check_identifier(wanted)
    if valid(current) and (current ^ wanted) & (EXTENDED | EXTENDED_MASK):
        raise AbortError(Abort.DEVICE_STATE)
