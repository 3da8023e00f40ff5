"""The rows of the communication profile: objects 1000h to 1FFFh of every node of the rig.

A device says its type, its PDOs and a few defaults; the rest is the same for all. Four PDOs stand ready in each
direction; those a device does not use are there, not valid, for an outside master to map as it likes. A COB-ID entry
is 29 bits of identifier and three flags: bit 31 says that the message does not exist, bit 30 means what its object
says, bit 29 that the identifier has 29 bits. Source: CiA 301, section on the communication profile objects,
description of COB-ID entries, table of restricted CAN-IDs.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rollerrig.firmware_sim.cia301.dictionary import Identity, Row, array
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Objects, key
from rollerrig.wsp_interface.bus.connection_set import (
    EMERGENCY,
    RPDO,
    SDO_REPLY,
    SDO_REQUEST,
    SYNC,
    TIME,
    TPDO,
)

PDOS, MAPPED, SDO_SERVERS, HISTORY = 4, 8, 3, 8
# transmission types: with every SYNC; at once
SYNCHRONOUS, AT_ONCE = 1, 255
INVALID, FLAG, EXTENDED = 1 << 31, 1 << 30, 1 << 29
STANDARD_MASK, EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
# identifiers that belong to fixed services
RESTRICTED = (
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)
_STORED = ("All", "Communication", "Application")
_IDENTITY = ("Vendor-ID", "Product code", "Revision number", "Serial number")


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
    consumed = [node << 16 | time for node, time in profile.consumed] + [0] * (
        4 - len(profile.consumed)
    )
    return [
        Row(0x1000, 0, "Device type", "U32", "const", profile.device_type),
        Row(0x1001, 0, "Error register", "U8", "ro", 0, True),
        *_list(
            0x1003,
            "Pre-defined error field",
            "Number of errors",
            0,
            "Standard error field",
            "ro",
            [0] * HISTORY,
        ),
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
        *array(0x1018, "Identity object", "U32", "const", identity[2:], _IDENTITY),
        Row(0x1019, 0, "Synchronous counter overflow value", "U8", "rw", 0, high=240),
        *array(
            0x1029,
            "Error behaviour",
            "U8",
            "rw",
            [profile.on_error],
            ("Communication error",),
            high=2,
        ),
        *(row for server in range(SDO_SERVERS) for row in _sdo_server(server)),
        *(
            row
            for at in range(PDOS)
            for row in _pdo(0x1400 + at, f"RPDO {at + 1}", RPDO[at], profile.rpdos[at : at + 1])
        ),
        *(
            row
            for at in range(PDOS)
            for row in _pdo(0x1800 + at, f"TPDO {at + 1}", TPDO[at], profile.tpdos[at : at + 1])
        ),
    ]


def _list(
    index: int, name: str, number: str, used: int, entry: str, access: str, entries: Sequence[int]
) -> list[Row]:
    """Rows of an array whose sub-index 0 tells how many of its entries are in use."""
    return [
        Row(index, 0, f"{name}/{number}", "U8", "rw", used),
        *(
            Row(index, at, f"{name}/{entry} {at}", "U32", access, value)
            for at, value in enumerate(entries, 1)
        ),
    ]


def _sdo_server(server: int) -> list[Row]:
    first, name = server == 0, f"SDO server parameter {server}"
    found = array(
        0x1200 + server,
        name,
        "U32",
        "ro" if first else "rw",
        (SDO_REQUEST, SDO_REPLY) if first else (INVALID, INVALID),
        ("COB-ID client to server", "COB-ID server to client"),
        relative=first,
    )
    client = Row(0x1200 + server, 3, f"{name}/Node-ID of the client", "U8", "rw", 0, high=127)
    return found if first else [found[0]._replace(default=3), *found[1:], client]


def _pdo(index: int, name: str, cob_id: int, used: Sequence[Pdo]) -> list[Row]:
    """The communication and mapping parameters of a PDO; without one in `used` it is not valid."""
    cob_id, pdo = (cob_id, used[0]) if used else (cob_id | INVALID, Pdo(254, ()))
    entries = [at << 16 | sub << 8 | bits for at, sub, bits in pdo.mapped]
    about, receives = f"{name} communication parameter", name.startswith("RPDO")
    parameters = [
        Row(index, 0, f"{about}/Highest sub-index supported", "U8", "const", 5 if receives else 6),
        Row(index, 1, f"{about}/COB-ID", "U32", "rw", cob_id, relative=True),
        Row(index, 2, f"{about}/Transmission type", "U8", "rw", pdo.kind),
        Row(index, 3, f"{about}/Inhibit time", "U16", "rw", pdo.inhibit_100us, unit="100us"),
        Row(index, 5, f"{about}/Event timer", "U16", "rw", pdo.event_ms, unit="ms"),
        Row(index, 6, f"{about}/SYNC start value", "U8", "rw", 0, high=240),
    ]
    return parameters[: 5 if receives else 6] + _list(
        index + 0x200,
        f"{name} mapping parameter",
        "Number of mapped objects",
        len(pdo.mapped),
        "Mapped object",
        "rw",
        entries + [0] * (MAPPED - len(entries)),
    )


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
    if not extended and (
        cob_id & EXTENDED_MASK != can_id or any(low <= can_id <= high for low, high in RESTRICTED)
    ):
        raise AbortError(Abort.INVALID_VALUE)


def own_cob_id(
    objects: Objects, index: int, sub: int = 0, effect: Callable[[Any], None] | None = None
) -> None:
    """Let an object be the COB-ID of a message, which gets another identifier only after it has been switched off."""

    def check(wanted: int) -> None:
        current = objects.values[key(index, sub)]
        if valid(wanted):
            check_identifier(wanted)
            if valid(current) and (current ^ wanted) & (EXTENDED | EXTENDED_MASK):
                raise AbortError(Abort.DEVICE_STATE)

    objects.own(index, sub, check=check, effect=effect)
