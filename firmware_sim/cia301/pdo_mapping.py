"""The objects that may be mapped into a PDO, and the order in which its parameters may be changed.

A mapping can be changed only while it is switched off (number of mapped objects 0). Each entry must
name an object that exists, may be mapped in this direction and has the given length. All entries
together must fit into eight bytes. Source: CiA 301, PDO communication and mapping parameter
records.
"""

from collections.abc import Callable
from functools import partial

from canopen.objectdictionary import ODVariable, datatypes

from rollerrig.firmware_sim.cia301.communication import MAPPED, attach_cob_id, valid
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Objects, key

PDO_BITS = 64
# transmission types
_RESERVED = range(241, 252)
_ON_REQUEST = (252, 253)


def _dummy(kind: int) -> ODVariable:
    variable = ODVariable(f"Dummy{kind:04X}", kind, 0)
    variable.data_type = kind
    return variable


# data types whose indices fill gaps in receive PDOs: only those of whole bytes
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


def mapped(objects: Objects, index: int) -> list[int]:
    """Return the keys that a mapping record lists."""
    count = objects.values[key(index, 0)]
    entries = (objects.values[key(index, sub)] >> 8 for sub in range(1, count + 1))
    return [at for at in entries if at in objects.variables or at in DUMMIES]


def check_entry(objects: Objects, entry: int, transmits: bool) -> None:
    """Raise AbortError unless an object may be mapped in this direction with this length."""
    at = entry >> 8
    bits = entry & 0xFF
    variable = None if transmits else DUMMIES.get(at)
    if variable is None:
        # the same code for a missing sub-index: the mapped object does not exist
        if at not in objects.variables:
            raise AbortError(Abort.NO_OBJECT)
        variable = objects.variables[at]
        if not variable.pdo_mappable or not _direction_allowed(variable, transmits):
            raise AbortError(Abort.NOT_MAPPABLE)
    if bits != len(variable):
        raise AbortError(Abort.NOT_MAPPABLE)


def _direction_allowed(variable: ODVariable, transmits: bool) -> bool:
    """Return whether the access of an object allows PDOs of this direction."""
    if variable.access_type == "rwr":
        return transmits
    if variable.access_type == "rww":
        return not transmits
    return variable.readable if transmits else variable.writable


def attach_rules(
    node: Host, index: int, configure: Callable[[bool], None], transmits: bool
) -> None:
    """Attach the rules of the standard to the records of the PDO at `index`.

    `configure(operational)` compiles the PDO again after a change.
    """
    objects = node.objects
    mapping = index + 0x200
    values = objects.values

    def check_kind(kind: int) -> None:
        if kind in _RESERVED or (kind in _ON_REQUEST and not transmits):
            raise AbortError(Abort.INVALID_VALUE)

    def check_unchanged_while_valid(sub: int, value: int) -> None:
        if valid(values[key(index, 1)]) and value != values[key(index, sub)]:
            raise AbortError(Abort.DEVICE_STATE)

    def check_count(count: int) -> None:
        if count > MAPPED:
            raise AbortError(Abort.PDO_LENGTH)
        entries = [values[key(mapping, sub)] for sub in range(1, count + 1)]
        for entry in entries:
            check_entry(objects, entry, transmits)
        if sum(entry & 0xFF for entry in entries) > PDO_BITS:
            raise AbortError(Abort.PDO_LENGTH)

    def check_mapped(entry: int) -> None:
        if values[key(mapping, 0)] != 0:
            raise AbortError(Abort.DEVICE_STATE)
        if entry:
            check_entry(objects, entry, transmits)

    def apply(_: int) -> None:
        configure(node.state is State.OPERATIONAL)
        node.rewire()

    attach_cob_id(objects, index, 1, apply)
    objects.attach(index, 2, check=check_kind, effect=apply)
    objects.attach(index, 3, check=partial(check_unchanged_while_valid, 3), effect=apply)
    objects.attach(index, 5, effect=apply)
    if transmits:
        objects.attach(index, 6, check=partial(check_unchanged_while_valid, 6), effect=apply)
    objects.attach(mapping, check=check_count, effect=apply)
    for sub in range(1, MAPPED + 1):
        objects.attach(mapping, sub, check=check_mapped)
