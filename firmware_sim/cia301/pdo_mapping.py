"""What may be mapped into a PDO, and in which order its parameters may be changed.

A mapping is changed while it is switched off (number of mapped objects 0); each entry names an
object that exists, may be mapped in this direction and has that length; all together fit into eight
bytes. Source: CiA 301, PDO communication and mapping parameter records.
"""

from collections.abc import Callable

from canopen.objectdictionary import ODVariable, datatypes

from rollerrig.firmware_sim.cia301.communication import MAPPED, check_change, valid
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Objects, key

PDO_BITS = 64
_FIRST_RESERVED, _LAST_RESERVED = 241, 251


def _dummy(kind: int) -> ODVariable:
    variable = ODVariable(f"Dummy{kind:04X}", kind, 0)
    variable.data_type = kind
    return variable


# data types stand in the dictionary as fillers of receive PDOs: byte-sized ones only
DUMMIES = {key(kind, 0): _dummy(kind)
           for kind in (datatypes.INTEGER8, datatypes.INTEGER16, datatypes.INTEGER32,
                        datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32)}


def mapped(objects: Objects, index: int) -> list[int]:
    """The keys that a mapping record lists."""
    count = objects.values[key(index, 0)]
    entries = (objects.values[key(index, sub)] >> 8 for sub in range(1, count + 1))
    return [at for at in entries if at in objects.variables or at in DUMMIES]


def check_entry(objects: Objects, entry: int, transmits: bool) -> None:
    """AbortError unless an object may be mapped: it exists, in this direction, with this length."""
    at, bits = entry >> 8, entry & 0xFF
    if not transmits and at in DUMMIES:
        variable = DUMMIES[at]
    else:
        # NO_OBJECT or NO_SUB_INDEX, both told as "does not exist"
        if at not in objects.variables:
            raise AbortError(Abort.NO_OBJECT)
        variable = objects.variables[at]
        if not variable.pdo_mappable or not _direction(variable, transmits):
            raise AbortError(Abort.NOT_MAPPABLE)
    if bits != len(variable):
        raise AbortError(Abort.NOT_MAPPABLE)


def _direction(variable: ODVariable, transmits: bool) -> bool:
    if variable.access_type in ("rwr", "rww"):
        return variable.access_type == ("rwr" if transmits else "rww")
    return variable.readable if transmits else variable.writable


def govern(node: Host, index: int, configure: Callable[[bool], None], transmits: bool) -> None:
    """Hang the rules of the standard on the records of the PDO at `index`, which `configure` compiles anew."""
    objects = node.objects
    values, mapping = objects.values, index + 0x200

    def exists() -> bool:
        return valid(values[key(index, 1)])

    def check_cob_id(wanted: int) -> None:
        check_change(values[key(index, 1)], wanted)

    def check_kind(kind: int) -> None:
        rtr = kind in (252, 253)
        if _FIRST_RESERVED <= kind <= _LAST_RESERVED or (rtr and not transmits):
            raise AbortError(Abort.INVALID_VALUE)

    def check_frozen(sub: int, value: int) -> None:
        if exists() and value != values[key(index, sub)]:
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

    objects.checks[key(index, 1)] = check_cob_id
    objects.checks[key(index, 2)] = check_kind
    objects.checks[key(index, 3)] = lambda value: check_frozen(3, value)
    if transmits:
        objects.checks[key(index, 6)] = lambda value: check_frozen(6, value)
    objects.checks[key(mapping, 0)] = check_count
    for sub in range(1, MAPPED + 1):
        objects.checks[key(mapping, sub)] = check_mapped
    for at in [key(index, sub) for sub in (1, 2, 3, 5)] + [key(mapping, 0)]:
        objects.effects[at] = take_over
    if transmits:
        objects.effects[key(index, 6)] = take_over
