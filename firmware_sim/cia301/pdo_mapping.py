"""The objects that may be mapped into a PDO, and the order in which its parameters may be changed.

A mapping can be changed only while it is switched off (number of mapped objects 0). Each entry must
name an object that exists, may be mapped in this direction and has the given length. All entries
together must fit into eight bytes.

An entry has 32 bits: index (16), sub-index (8) and length in bits (8). Without the length it is the
key of the object, as `objects.key` makes it.

Source: CiA 301, PDO communication and mapping parameter records.
"""

from collections.abc import Callable
from functools import partial

from canopen.objectdictionary import ODVariable, datatypes

from rollerrig.firmware_sim.cia301.communication import MOST_MAPPED, attach_cob_id, valid
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Objects, key

# sub-indices of the communication parameters of a PDO
COB_ID = 1
TRANSMISSION_TYPE = 2
INHIBIT_TIME = 3
EVENT_TIMER = 5
SYNC_START_VALUE = 6  # only of a TPDO

# from the index of the communication parameters of a PDO to that of its mapping parameters
TO_MAPPING = 0x200

PDO_BITS = 64

# transmission types
_RESERVED = range(241, 252)
_ON_REQUEST = (252, 253)  # only a TPDO can answer a remote request


def _dummy(kind: int) -> ODVariable:
    """Return the placeholder of a data type."""
    variable = ODVariable(f"Dummy{kind:04X}", kind, 0)
    variable.data_type = kind
    return variable


# Placeholders by key. An RPDO may map the index of a data type instead of an object: the node skips
# this part of the message. Only data types of whole bytes are allowed.
DUMMIES = {
    key(kind, 0): _dummy(kind)
    for kind in (
        datatypes.INTEGER8,
        datatypes.INTEGER16,
        datatypes.INTEGER32,
        datatypes.UNSIGNED8,
        datatypes.UNSIGNED16,
        datatypes.UNSIGNED32,
    )
}


def mapped_keys(objects: Objects, index: int) -> list[int]:
    """Return the keys of the objects and placeholders in the mapping record at `index`.

    Entries of objects that do not exist are left out.
    """
    count = objects.values[key(index, 0)]
    keys = []
    for sub in range(1, count + 1):
        at = objects.values[key(index, sub)] >> 8
        if at in objects.variables or at in DUMMIES:
            keys.append(at)
    return keys


def check_entry(objects: Objects, entry: int, transmits: bool) -> None:
    """Raise AbortError unless an entry is allowed in a mapping.

    Its object must exist, be mappable in this direction and have the length of the entry.
    """
    at = entry >> 8
    bits = entry & 0xFF
    variable = None
    if not transmits:
        variable = DUMMIES.get(at)
    if variable is None:
        # a missing sub-index gives NO_OBJECT too: NO_SUB_INDEX would be about the mapping record
        if at not in objects.variables:
            raise AbortError(Abort.NO_OBJECT)
        variable = objects.variables[at]
        if not variable.pdo_mappable or not _direction_allowed(variable, transmits):
            raise AbortError(Abort.NOT_MAPPABLE)
    if bits != len(variable):
        raise AbortError(Abort.NOT_MAPPABLE)


def _direction_allowed(variable: ODVariable, transmits: bool) -> bool:
    """Return whether the access of an object allows PDOs of this direction.

    Objects with the access "rwr" or "rww" can be read and written by SDO, but "rwr" allows only
    TPDOs, and "rww" only RPDOs.
    """
    if variable.access_type == "rwr":
        return transmits
    if variable.access_type == "rww":
        return not transmits
    return variable.readable if transmits else variable.writable


def attach_rules(
    node: Host, index: int, configure: Callable[[bool], None], transmits: bool
) -> None:
    """Attach the rules of the standard to the communication and mapping parameters of a PDO.

    `index` is that of the communication parameters. `configure(operational)` compiles the PDO again
    after a change.
    """
    objects = node.objects
    mapping = index + TO_MAPPING
    values = objects.values

    def check_transmission_type(kind: int) -> None:
        if kind in _RESERVED or (kind in _ON_REQUEST and not transmits):
            raise AbortError(Abort.INVALID_VALUE)

    def check_unchanged_while_valid(sub: int, value: int) -> None:
        if valid(values[key(index, COB_ID)]) and value != values[key(index, sub)]:
            raise AbortError(Abort.DEVICE_STATE)

    def check_count(count: int) -> None:
        """Check a new number of mapped objects, which switches the mapping on (0: off)."""
        if count > MOST_MAPPED:
            raise AbortError(Abort.PDO_LENGTH)
        entries = [values[key(mapping, sub)] for sub in range(1, count + 1)]
        for entry in entries:
            check_entry(objects, entry, transmits)
        if sum(entry & 0xFF for entry in entries) > PDO_BITS:
            raise AbortError(Abort.PDO_LENGTH)

    def check_new_entry(entry: int) -> None:
        """Check an entry that is written while the mapping is off; 0 is an empty entry."""
        if values[key(mapping, 0)] != 0:
            raise AbortError(Abort.DEVICE_STATE)
        if entry:
            check_entry(objects, entry, transmits)

    def apply(_: int) -> None:
        configure(node.state is State.OPERATIONAL)
        node.rewire()

    attach_cob_id(objects, index, COB_ID, apply)
    objects.attach(index, TRANSMISSION_TYPE, check=check_transmission_type, effect=apply)
    objects.attach(
        index,
        INHIBIT_TIME,
        check=partial(check_unchanged_while_valid, INHIBIT_TIME),
        effect=apply,
    )
    objects.attach(index, EVENT_TIMER, effect=apply)
    if transmits:
        objects.attach(
            index,
            SYNC_START_VALUE,
            check=partial(check_unchanged_while_valid, SYNC_START_VALUE),
            effect=apply,
        )

    objects.attach(mapping, check=check_count, effect=apply)
    # entries need no effect: they count only when the mapping is switched on
    for sub in range(1, MOST_MAPPED + 1):
        objects.attach(mapping, sub, check=check_new_entry)
