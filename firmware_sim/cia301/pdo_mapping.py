"""What may be mapped into a PDO, and in which order its parameters may be changed.

A mapping is changed while it is switched off (number of mapped objects 0); each entry names an
object that exists, may be mapped in this direction and has that length; all together fit into eight
bytes. Source: CiA 301, PDO communication and mapping parameter records.
"""

from collections.abc import Callable

from canopen.objectdictionary import ODVariable, datatypes

from rollerrig.firmware_sim.cia301.communication import MAPPED, own_cob_id, valid
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Objects, key

PDO_BITS = 64
_RESERVED, _ON_REQUEST = range(241, 252), (252, 253)


def _dummy(kind: int) -> ODVariable:
    variable = ODVariable(f"Dummy{kind:04X}", kind, 0)
    variable.data_type = kind
    return variable


# data types stand in the dictionary as fillers of receive PDOs: byte-sized ones only
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
    """The keys that a mapping record lists."""
    count = objects.values[key(index, 0)]
    entries = (objects.values[key(index, sub)] >> 8 for sub in range(1, count + 1))
    return [at for at in entries if at in objects.variables or at in DUMMIES]


def check_entry(objects: Objects, entry: int, transmits: bool) -> None:
    """AbortError unless an object may be mapped: it exists, in this direction, with this length."""
    at, bits = entry >> 8, entry & 0xFF
    variable = None if transmits else DUMMIES.get(at)
    if variable is None:
        # NO_OBJECT or NO_SUB_INDEX, both told as "does not exist"
        if at not in objects.variables:
            raise AbortError(Abort.NO_OBJECT)
        variable = objects.variables[at]
        one_way = {"rwr": transmits, "rww": not transmits}
        either = variable.readable if transmits else variable.writable
        if not variable.pdo_mappable or not one_way.get(variable.access_type, either):
            raise AbortError(Abort.NOT_MAPPABLE)
    if bits != len(variable):
        raise AbortError(Abort.NOT_MAPPABLE)


def govern(node: Host, index: int, configure: Callable[[bool], None], transmits: bool) -> None:
    """Hang the rules of the standard on the records of the PDO at `index`, which `configure` compiles anew."""
    objects, mapping = node.objects, index + 0x200
    values = objects.values

    def check_kind(kind: int) -> None:
        if kind in _RESERVED or (kind in _ON_REQUEST and not transmits):
            raise AbortError(Abort.INVALID_VALUE)

    def check_frozen(sub: int, value: int) -> None:
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

    def take_over(_: int) -> None:
        configure(node.state is State.OPERATIONAL)
        node.rewire()

    own_cob_id(objects, index, 1, take_over)
    objects.own(index, 2, check=check_kind, effect=take_over)
    objects.own(index, 3, check=lambda value: check_frozen(3, value), effect=take_over)
    objects.own(index, 5, effect=take_over)
    if transmits:
        objects.own(index, 6, check=lambda value: check_frozen(6, value), effect=take_over)
    objects.own(mapping, check=check_count, effect=take_over)
    for sub in range(1, MAPPED + 1):
        objects.own(mapping, sub, check=check_mapped)
