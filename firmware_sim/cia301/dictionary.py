"""An object dictionary as rows: one row is one object, or one sub-index of an array or record.

`build` turns the rows into the dictionary classes of canopen. The SDO server, the PDOs and the EDS
file read from these. A device adds nothing but a list of rows to the objects of CiA 301.
"""

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

KINDS = {
    "BOOL": datatypes.BOOLEAN,
    "F32": datatypes.REAL32,
    "TEXT": datatypes.VISIBLE_STRING,
    "DOMAIN": datatypes.DOMAIN,
    "U8": datatypes.UNSIGNED8,
    "I8": datatypes.INTEGER8,
    "U16": datatypes.UNSIGNED16,
    "I16": datatypes.INTEGER16,
    "U32": datatypes.UNSIGNED32,
    "I32": datatypes.INTEGER32,
    "U64": datatypes.UNSIGNED64,
    "I64": datatypes.INTEGER64,
}
# records of CiA 301; any other object with sub-indices of one type is an array
_RECORDS = ((0x1018, 0x1018), (0x1023, 0x1025), (0x1200, 0x12FF), (0x1400, 0x1BFF))


class Row(NamedTuple):
    """One object or sub-index. An `index` with one row is a VAR, with more an ARRAY or RECORD.

    `name` is "object/sub-index" for a row of an array or record. `access`: const, ro, wo, rw, or
    rwr / rww (rw, mappable in that direction only). `low` and `high`: bounds of a written value.
    `relative`: the node identifier is added to the default. `factor` and `unit`: the value of one
    count.
    """

    index: int  # type: ignore[assignment]
    sub: int
    name: str
    kind: str
    access: str
    default: Any
    mappable: bool = False
    low: int | None = None
    high: int | None = None
    relative: bool = False
    unit: str = ""
    factor: float = 1.0
    text: str = ""


class Identity(NamedTuple):
    """Object 1018h, and the entries of the EDS file about the manufacturer and the product."""

    vendor: str
    product: str
    vendor_id: int
    product_code: int
    revision: int
    serial: int


def array(
    index: int,
    name: str,
    kind: str,
    access: str,
    defaults: Iterable[Any],
    subs: Iterable[str] = (),
    **more: Any,
) -> list[Row]:
    """Return the rows of an array: sub-index 0, and one row for each default.

    The rows have the names `subs`, or are numbered.
    """
    defaults = list(defaults)
    names = list(subs) or [f"{name} {at}" for at in range(1, len(defaults) + 1)]
    return [
        Row(index, 0, f"{name}/Highest sub-index supported", "U8", "const", len(defaults)),
        *(
            Row(index, at, f"{name}/{sub}", kind, access, default, **more)
            for at, (sub, default) in enumerate(zip(names, defaults, strict=True), 1)
        ),
    ]


def build(rows: Iterable[Row], node_id: int, identity: Identity) -> ObjectDictionary:
    """Build the dictionary of a node. Raises ValueError if two rows have the same place."""
    dictionary = ObjectDictionary()
    dictionary.node_id = node_id
    in_order = sorted(rows, key=lambda row: (row.index, row.sub))
    for index, group in itertools.groupby(in_order, lambda row: row.index):
        members = list(group)
        if len({row.sub for row in members}) != len(members):
            raise ValueError(f"object {index:04X}h has two rows for one sub-index")
        dictionary.add_object(_object(index, members, node_id))
    _describe(dictionary, identity)
    return dictionary


def _object(index: int, rows: list[Row], node_id: int) -> ODVariable | ODArray | ODRecord:
    if len(rows) == 1 and rows[0].sub == 0:
        return _variable(rows[0], rows[0].name, node_id)
    mixed = len({row.kind for row in rows[1:]}) != 1
    record = mixed or any(first <= index <= last for first, last in _RECORDS)
    object_name, _, _ = rows[0].name.partition("/")
    made = ODRecord(object_name, index) if record else ODArray(object_name, index)
    for row in rows:
        _, _, sub_name = row.name.partition("/")
        made.add_member(_variable(row, sub_name, node_id))
    return made


def _variable(row: Row, name: str, node_id: int) -> ODVariable:
    variable = ODVariable(name, row.index, row.sub)
    variable.data_type = KINDS[row.kind]
    variable.access_type = row.access
    variable.pdo_mappable = row.mappable
    variable.min = row.low
    variable.max = row.high
    variable.unit = row.unit
    variable.factor = row.factor
    variable.description = row.text
    variable.default = row.default
    variable.relative = row.relative
    if row.relative:
        variable.default = row.default + node_id
        # where canopen keeps a default that depends on the node identifier, as an EDS file writes
        # it
        variable.default_raw = f"$NODEID+0x{row.default:X}"  # type: ignore[attr-defined]
    return variable


def _describe(dictionary: ObjectDictionary, identity: Identity) -> None:
    """Fill in the section DeviceInfo of the EDS file."""
    about = dictionary.device_information
    about.vendor_name = identity.vendor
    about.vendor_number = identity.vendor_id
    about.product_name = identity.product
    about.product_number = identity.product_code
    about.revision_number = identity.revision
    about.order_code = identity.product
    about.simple_boot_up_master = False
    about.simple_boot_up_slave = True
    about.dynamic_channels_supported = False
    about.group_messaging = False
    about.LSS_supported = True
    # canopen declares these numbers as bool
    about.granularity = 8  # type: ignore[assignment]
    about.nr_of_RXPDO = sum(0x1400 <= index < 0x1600 for index in dictionary)  # type: ignore[assignment]
    about.nr_of_TXPDO = sum(0x1800 <= index < 0x1A00 for index in dictionary)  # type: ignore[assignment]
    about.allowed_baudrates = {rate * 1000 for rate in (10, 20, 50, 125, 250, 500, 800, 1000)}
