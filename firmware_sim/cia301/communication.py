"""The rows of the communication profile: objects 1000h to 1FFFh of every node of the rig.

A device defines its type, its PDOs and a few defaults; the rest is the same for all devices. There
are four PDOs in each direction. Those that a device does not use are not valid, and an outside
master may map them. A device may have further TPDOs. The predefined connection set has no
identifiers for these, so a master gives them one.

A COB-ID entry has 29 bits for the identifier and three flags. Bit 31: the message does not exist.
Bit 30: its meaning depends on the object. Bit 29: the identifier has 29 bits. Source: CiA 301,
section on the communication profile objects, description of COB-ID entries, table of restricted
CAN-IDs.
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

PDOS = 4  # in each direction: the predefined connection set has identifiers for so many
MOST_MAPPED = 8  # objects in a PDO
SDO_SERVERS = 3
HISTORY = 8  # errors in 1003h
# transmission types of PDOs
ACYCLIC = 0  # with the SYNC after a change
SYNCHRONOUS = 1  # with every SYNC
EVENT_DRIVEN = 255  # received data take effect immediately
NO_IDENTIFIER = 0  # of a PDO that has none in the predefined connection set
# flags of a COB-ID entry
INVALID = 1 << 31
FLAG = 1 << 30
EXTENDED = 1 << 29
STANDARD_MASK = 0x7FF
EXTENDED_MASK = 0x1FFFFFFF
# ranges of identifiers that belong to fixed services
RESTRICTED = (
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)
_CONSUMERS = 4  # entries of 1016h
_STORED = ("All", "Communication", "Application")
_IDENTITY = ("Vendor-ID", "Product code", "Revision number", "Serial number")


class Pdo(NamedTuple):
    """A PDO of a device: its transmission type, and the objects in it as (index, sub, bits)."""

    kind: int
    mapped: tuple[tuple[int, int, int], ...]
    event_ms: int = 0
    inhibit_100us: int = 0


class Profile(NamedTuple):
    """The differences between the communication profiles of devices.

    `consumed`: (node, time in ms) for 1016h. `on_error`: 1029h:1, the NMT state after a lost
    heartbeat (0 pre-operational, 1 unchanged, 2 stopped). `further_tpdos`: how many TPDOs there are
    after the fourth.
    """

    device_type: int
    name: str
    rpdos: Sequence[Pdo] = ()
    tpdos: Sequence[Pdo] = ()
    consumed: Sequence[tuple[int, int]] = ()
    heartbeat_ms: int = 100
    on_error: int = 1
    further_tpdos: int = 0


def rows(profile: Profile, identity: Identity) -> list[Row]:
    """Return all rows of 1000h..1FFFh for a profile."""
    consumed = [node << 16 | time_ms for node, time_ms in profile.consumed]
    consumed += [0] * (_CONSUMERS - len(consumed))
    numbers = (identity.vendor_id, identity.product_code, identity.revision, identity.serial)

    sdo_servers: list[Row] = []
    for server in range(SDO_SERVERS):
        sdo_servers += _sdo_server(server)
    rpdos: list[Row] = []
    tpdos: list[Row] = []
    for at in range(PDOS):
        rpdos += _pdo(0x1400 + at, f"RPDO {at + 1}", RPDO[at], profile.rpdos[at : at + 1])
        tpdos += _pdo(0x1800 + at, f"TPDO {at + 1}", TPDO[at], profile.tpdos[at : at + 1])
    for at in range(PDOS, PDOS + profile.further_tpdos):
        tpdos += _pdo(0x1800 + at, f"TPDO {at + 1}", NO_IDENTIFIER, ())
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
        *array(0x1018, "Identity object", "U32", "const", numbers, _IDENTITY),
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
        *sdo_servers,
        *rpdos,
        *tpdos,
    ]


def _list(
    index: int, name: str, number: str, used: int, entry: str, access: str, entries: Sequence[int]
) -> list[Row]:
    """Return the rows of an array whose sub-index 0 is the number of its entries in use."""
    return [
        Row(index, 0, f"{name}/{number}", "U8", "rw", used),
        *(
            Row(index, at, f"{name}/{entry} {at}", "U32", access, value)
            for at, value in enumerate(entries, 1)
        ),
    ]


def _sdo_server(server: int) -> list[Row]:
    """Return the parameters of an SDO server. The first one has fixed identifiers and no client."""
    index = 0x1200 + server
    name = f"SDO server parameter {server}"
    subs = ("COB-ID client to server", "COB-ID server to client")
    if server == 0:
        identifiers = (SDO_REQUEST, SDO_REPLY)
        return array(index, name, "U32", "ro", identifiers, subs, relative=True)
    highest_sub, *identifier_rows = array(index, name, "U32", "rw", (INVALID, INVALID), subs)
    client = Row(index, 3, f"{name}/Node-ID of the client", "U8", "rw", 0, high=127)
    return [highest_sub._replace(default=3), *identifier_rows, client]


def _pdo(index: int, name: str, cob_id: int, used: Sequence[Pdo]) -> list[Row]:
    """Return the communication and mapping parameters of a PDO.

    `used` holds the PDO of the device; if it is empty, or maps nothing, it is not valid.
    """
    if used and used[0].mapped:
        pdo = used[0]
    else:
        pdo = Pdo(254, ())
        cob_id |= INVALID
    entries = [at << 16 | sub << 8 | bits for at, sub, bits in pdo.mapped]
    about = f"{name} communication parameter"
    from_node_number = cob_id & STANDARD_MASK != NO_IDENTIFIER
    highest_sub = 5 if name.startswith("RPDO") else 6  # only a TPDO has a SYNC start value
    parameters = [
        Row(index, 0, f"{about}/Highest sub-index supported", "U8", "const", highest_sub),
        Row(index, 1, f"{about}/COB-ID", "U32", "rw", cob_id, relative=from_node_number),
        Row(index, 2, f"{about}/Transmission type", "U8", "rw", pdo.kind),
        Row(index, 3, f"{about}/Inhibit time", "U16", "rw", pdo.inhibit_100us, unit="100us"),
        Row(index, 5, f"{about}/Event timer", "U16", "rw", pdo.event_ms, unit="ms"),
        Row(index, 6, f"{about}/SYNC start value", "U8", "rw", 0, high=240),
    ]
    parameters = [row for row in parameters if row.sub <= highest_sub]
    return parameters + _list(
        index + 0x200,
        f"{name} mapping parameter",
        "Number of mapped objects",
        len(pdo.mapped),
        "Mapped object",
        "rw",
        entries + [0] * (MOST_MAPPED - len(entries)),
    )


def valid(cob_id: int) -> bool:
    """Return whether the message exists."""
    return not cob_id & INVALID


def split(cob_id: int) -> tuple[int, bool]:
    """Return the identifier, and whether it has 29 bits."""
    extended = bool(cob_id & EXTENDED)
    return cob_id & (EXTENDED_MASK if extended else STANDARD_MASK), extended


def dispatch_key(can_id: int, extended: bool) -> int:
    """Return identifier and format as one number."""
    return can_id | EXTENDED if extended else can_id


def check_identifier(cob_id: int) -> None:
    """Raise AbortError unless a configurable message may have the identifier."""
    can_id, extended = split(cob_id)
    if extended:
        return
    too_long = cob_id & EXTENDED_MASK != can_id
    restricted = any(low <= can_id <= high for low, high in RESTRICTED)
    if too_long or restricted:
        raise AbortError(Abort.INVALID_VALUE)


def attach_cob_id(
    objects: Objects, index: int, sub: int = 0, effect: Callable[[Any], None] | None = None
) -> None:
    """Make an object the COB-ID of a message, with the checks of the standard.

    `effect` is called after a change. The identifier of a message can be changed only while the
    message is switched off.
    """

    def check(new: int) -> None:
        current = objects.values[key(index, sub)]
        if not valid(new):
            return
        check_identifier(new)
        changed = (current ^ new) & (EXTENDED | EXTENDED_MASK)
        if valid(current) and changed:
            raise AbortError(Abort.DEVICE_STATE)

    objects.attach(index, sub, check=check, effect=effect)
