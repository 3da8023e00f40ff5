"""How compiled code sees a large named tuple: as the address of its fields.

Numba passes a named tuple from kernel to kernel as all its fields, one by one. The parameters of
the plant and the memory of a tick are 180 values. To pass them on costs more to compile than the
physics does. Therefore this module registers another type for such a tuple. A kernel receives only
the address of a structure. Where it reads a field, numba loads the field from the structure.

The wrapper that Python calls makes the structure, and keeps it until the kernel returns. A `Table`
keeps structures one after another, so that a kernel finds each by its number.

Source: numba's documentation, "Extending Numba", low-level interface.
"""

import hashlib
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.numba_import import settings

# isort: split
from llvmlite import ir
from numba import typeof
from numba.core import cgutils, imputils, types
from numba.core.pythonapi import _UnboxContext
from numba.core.typing import templates
from numba.core.typing.templates import infer_global
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_DIGITS = 12


class Record(types.Type):
    """The type of a record. `fields` are the types of the fields by their names, in order."""

    def __init__(self, name: str, fields: dict[str, types.Type]) -> None:
        self.fields = fields
        # Numba takes two types with the same name as the same type. It writes the name into each
        # function that takes the type, so a digest of all fields is better than their list.
        described = " ".join(f"{field}:{kind}" for field, kind in fields.items())
        digest = hashlib.sha256(described.encode()).hexdigest()[:_DIGITS]
        super().__init__(name=f"{name}_{digest}")


@register_model(Record)
class _Model(models.PrimitiveModel):
    """A record is an address. As a part of another record it is the structure itself."""

    def __init__(self, manager: Any, kind: Record) -> None:
        self.members = [manager.lookup(field) for field in kind.fields.values()]
        self.structure = ir.LiteralStructType([member.get_data_type() for member in self.members])
        super().__init__(manager, kind, self.structure.as_pointer())

    def get_data_type(self) -> Any:
        return self.structure

    def get_return_type(self) -> Any:
        return self.structure

    def as_data(self, builder: Any, value: Any) -> Any:
        return builder.load(value)

    def from_data(self, builder: Any, value: Any) -> Any:
        place = cgutils.alloca_once(builder, self.structure)
        builder.store(value, place)
        return place

    as_return = as_data
    from_return = from_data

    def load_from_data_pointer(self, builder: Any, ptr: Any, align: Any = None) -> Any:
        return ptr

    def member(self, builder: Any, value: Any, place: int) -> Any:
        """Return the field at a place of the record at the address `value`."""
        address = cgutils.gep_inbounds(builder, value, 0, place)
        return self.members[place].load_from_data_pointer(builder, address)


def register(named_tuple: type) -> None:
    """Make numba pass this named tuple to kernels as an address.

    Call this before the first call of a kernel with such a tuple.
    """

    @typeof_impl.register(named_tuple)
    def type_of_record(values: Any, context: Any) -> Record:
        fields = {}
        for name, value in zip(values._fields, values, strict=True):
            fields[name] = typeof_impl(value, context)
        return Record(named_tuple.__name__, fields)


@unbox(Record)
def _from_python(kind: Record, values: Any, c: Any) -> NativeValue:
    """Generate the code that makes a record from a Python object."""
    model = c.context.data_model_manager[kind]
    place = cgutils.alloca_once(c.builder, model.structure)
    failed = c.builder.call(_reader(c, kind), [values, place])
    return NativeValue(place, is_error=failed)


def _reader(c: Any, kind: types.Type) -> Any:
    """Return the function that reads a field from a Python object to an address.

    The fields have few types, and each type has one function in the module. It returns 1 if the
    object does not fit.
    """
    model = c.context.data_model_manager[kind]
    name = f"rollerrig_read_{c.context.mangler('', [kind])}"
    existing = c.builder.module.globals.get(name)
    if existing is not None:
        return existing

    takes = [c.pyapi.pyobj, model.get_data_type().as_pointer()]
    function = ir.Function(c.builder.module, ir.FunctionType(ir.IntType(1), takes), name)
    function.linkage = "internal"
    function.attributes.add("noinline")
    values, place = function.args
    builder = ir.IRBuilder(function.append_basic_block())
    inside = _UnboxContext(c.context, builder, c.context.get_python_api(builder))
    failed = cgutils.false_bit
    if isinstance(kind, Record):
        for number, field in enumerate(kind.fields.values()):
            value = inside.pyapi.tuple_getitem(values, number)
            address = cgutils.gep_inbounds(builder, place, 0, number)
            failed_here = builder.call(_reader(inside, field), [value, address])
            failed = builder.or_(failed, failed_here)
    else:
        native = inside.unbox(kind, values)
        builder.store(model.as_data(builder, native.value), place)
        failed = native.is_error
        if native.cleanup is not None:
            native.cleanup()
    builder.ret(failed)
    return function


@templates.infer_getattr
class _Fields(templates.AttributeTemplate):
    """The type of each field."""

    key = Record

    # numba's base class has the value NotImplemented in place of this method
    def generic_resolve(self, kind: Record, field: str) -> Any:  # type: ignore[override]
        return kind.fields.get(field)  # None: numba then reports an unknown attribute


@imputils.lower_getattr_generic(Record)
def _field(context: Any, builder: Any, kind: Record, value: Any, field: str) -> Any:
    """Generate the code that loads a field."""
    model = context.data_model_manager[kind]
    loaded = model.member(builder, value, tuple(kind.fields).index(field))
    return imputils.impl_ret_borrowed(context, builder, kind.fields[field], loaded)


class Table(NamedTuple):
    """Records one after another in memory, which kernels find by their number.

    A kernel takes a table as one address, so Python does not convert the records at each call.
    `memory` has the shape (records, bytes of a record). `records` are the same records in Python:
    they keep the arrays alive that compiled code reads.
    """

    memory: np.ndarray
    records: list[Any]


def table(records: Sequence[Any]) -> Table:
    """Return a table of records of one type. `write` replaces one of them.

    Raises TypeError where the records are not of one type.
    """
    of = typeof(records[0])
    if any(typeof(record) != of for record in records):
        raise TypeError("the records of a table must have the same type")
    made = Table(np.zeros((len(records), _size(records[0])), dtype=np.uint8), list(records))
    for number, record in enumerate(records):
        write(made, number, record)
    return made


def write(table: Table, number: int, record: Any) -> None:
    """Write a record into a table. Raises TypeError where it is of another type."""
    if typeof(record) != typeof(table.records[0]):
        raise TypeError("the records of a table must have the same type")
    table.records[number] = record
    _store(record, table.memory[number])


def first(table: Table, records: int) -> Table:
    """Return the table of the first so many records of a table."""
    return Table(table.memory[:records], table.records[:records])


class TableOf(types.Type):
    """The type of a table in compiled code."""

    def __init__(self, record: Record) -> None:
        self.record = record
        super().__init__(name=f"Table_{record}")


@register_model(TableOf)
class _TableModel(models.StructModel):
    """A table is the address of its first record, the bytes from one to the next, and their number.

    So the same type serves a table of a field of records.
    """

    def __init__(self, manager: Any, kind: TableOf) -> None:
        members = [
            ("address", types.CPointer(types.uint8)),
            ("stride", types.intp),
            ("count", types.intp),
        ]
        super().__init__(manager, kind, members)


@typeof_impl.register(Table)
def _type_of_table(table: Table, context: Any) -> TableOf:
    return TableOf(typeof_impl(table.records[0], context))


@unbox(TableOf)
def _table_from_python(kind: TableOf, table: Any, c: Any) -> NativeValue:
    """Generate the code that gets address and sizes of a table from a Python object."""
    from numba.np import arrayobj

    memory = types.Array(types.uint8, 2, "C")
    view = c.unbox(memory, c.pyapi.tuple_getitem(table, 0))
    array = arrayobj.make_array(memory)(c.context, c.builder, view.value)
    value = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    value.address = array.data
    value.count, value.stride = cgutils.unpack_tuple(c.builder, array.shape, 2)
    if c.context.enable_nrt:
        c.context.nrt.decref(c.builder, memory, view.value)
    return NativeValue(value._getvalue(), is_error=view.is_error)


@infer_global(operator.getitem)
class _TableItem(templates.AbstractTemplate):
    """table[number] is a record."""

    def generic(self, arguments: Any, keywords: Any) -> Any:
        kind, number = arguments
        if isinstance(kind, TableOf) and isinstance(number, types.Integer):
            return templates.signature(kind.record, kind, types.intp)
        return None


@imputils.lower_builtin(operator.getitem, TableOf, types.intp)
def _item(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = signature.args[0]
    value = cgutils.create_struct_proxy(kind)(context, builder, arguments[0])
    address = builder.gep(value.address, [builder.mul(arguments[1], value.stride)])
    return builder.bitcast(address, context.get_value_type(kind.record))


@infer_global(len)
class _TableLength(templates.AbstractTemplate):
    """len(table) is the number of records."""

    def generic(self, arguments: Any, keywords: Any) -> Any:
        (kind,) = arguments
        return templates.signature(types.intp, kind) if isinstance(kind, TableOf) else None


@imputils.lower_builtin(len, TableOf)
def _length(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0]).count


@templates.infer_getattr
class _TableFields(templates.AttributeTemplate):
    """table.field is the table of that field of each record, if it is a record itself."""

    key = TableOf

    def generic_resolve(self, kind: TableOf, field: str) -> Any:  # type: ignore[override]
        found = kind.record.fields.get(field)
        return TableOf(found) if isinstance(found, Record) else None


@imputils.lower_getattr_generic(TableOf)
def _table_field(context: Any, builder: Any, kind: TableOf, table: Any, field: str) -> Any:
    model = context.data_model_manager[kind.record]
    value = cgutils.create_struct_proxy(kind)(context, builder, table)
    first = builder.bitcast(value.address, context.get_value_type(kind.record))
    member = model.member(builder, first, tuple(kind.record.fields).index(field))
    value.address = builder.bitcast(member, value.address.type)
    # a table of a field is another type with the same structure
    return value._getvalue()


def _table_of_one(typing_context: Any, record: Any) -> Any:
    kind = TableOf(record)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value = cgutils.create_struct_proxy(kind)(context, builder)
        value.address = builder.bitcast(arguments[0], value.address.type)
        value.stride = context.get_constant(types.intp, 0)
        value.count = context.get_constant(types.intp, 1)
        return value._getvalue()

    return kind(record), generate


# table_of_one(record): the table with this record alone; a tuple without a compiler
table_of_one: Any = (lambda record: (record,)) if settings.DISABLE_JIT else intrinsic(_table_of_one)


class _At:
    """An object that numpy takes as an array at an address, whose memory it does not read."""

    def __init__(self, interface: dict[str, Any]) -> None:
        self.__array_interface__ = interface


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    """Yield the arrays of a record, and of the records in it."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple) and hasattr(value, "_fields"):
        for field in value:
            yield from arrays_of(field)


def moved(value: Any, address_of: Callable[[np.ndarray], int]) -> Any:
    """Return a record whose arrays are at other addresses, such as those in a GPU.

    address_of: the address of the copy of a contiguous array. Only compiled code there may read
    the record; `write` writes it into a table.
    """
    if isinstance(value, np.ndarray):
        interface = {
            "shape": value.shape,
            "typestr": value.dtype.str,
            "data": (address_of(value), not value.flags.writeable),
            "version": 3,
        }
        return np.asarray(_At(interface))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(moved(field, address_of) for field in value))
    return value


def type_of(record: Any) -> Record:
    """Return the type of a record in compiled code."""
    found: Record = typeof(record)
    return found


def table_at(record: Record) -> Any:
    """Return what makes, in compiled code, the table with one record at an address, an integer."""
    kind = TableOf(record)

    def at(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            value = cgutils.create_struct_proxy(kind)(context, builder)
            value.address = builder.inttoptr(arguments[0], value.address.type)
            value.stride = context.get_constant(types.intp, 0)
            value.count = context.get_constant(types.intp, 1)
            return value._getvalue()

        return kind(types.intp), generate

    return intrinsic(at)


def _part_of(typing_context: Any, table: Any, first: Any, count: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given, first, count = arguments
        value = cgutils.create_struct_proxy(signature.args[0])(context, builder, given)
        value.address = builder.gep(value.address, [builder.mul(first, value.stride)])
        value.count = count
        return value._getvalue()

    return table(table, types.intp, types.intp), generate


# part_of(table, first, count): the table of so many records from one on
part_of: Any = intrinsic(_part_of)


def _structure_size(typing_context: Any, record: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        structure = context.data_model_manager[record].structure
        return context.get_constant(types.intp, context.get_abi_sizeof(structure))

    return types.intp(record), generate


def _copy(typing_context: Any, record: Any, memory: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        from numba.np import arrayobj

        structure = context.data_model_manager[record].structure
        view = arrayobj.make_array(signature.args[1])(context, builder, arguments[1])
        size = context.get_constant(types.intp, context.get_abi_sizeof(structure))
        cgutils.raw_memcpy(builder, view.data, arguments[0], size, 1)
        return context.get_dummy_value()

    return types.none(record, memory), generate


_size_of: Any = intrinsic(_structure_size)
_copy_to: Any = intrinsic(_copy)


@kernel
def _size(record):
    """Return the bytes of a record."""
    return _size_of(record)


@kernel
def _store(record, memory):
    """Copy a record to uint8 memory."""
    _copy_to(record, memory)
