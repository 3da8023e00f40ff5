"""How compiled code sees a large named tuple: as the address of its fields.

Numba passes a named tuple from kernel to kernel as all its fields, one by one. The parameters of
the plant and the memory of a tick are 180 values. To pass them on costs more to compile than the
physics does. Therefore this module registers another type for such a tuple. A kernel receives only
the address of a structure. Where it reads a field, numba loads the field from the structure.

The wrapper that Python calls makes the structure, and keeps it until the kernel returns.

Source: numba's documentation, "Extending Numba", low-level interface.
"""

import hashlib
from typing import Any

from rollerrig.rig.compiled import numba_import  # noqa: F401  the first import of numba

# isort: split
from llvmlite import ir
from numba.core import cgutils, imputils, types
from numba.core.pythonapi import _UnboxContext
from numba.core.typing import templates
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

    def set_member(self, builder: Any, value: Any, place: int, field: Any) -> None:
        """Write the field at a place of the record at the address `value`."""
        address = cgutils.gep_inbounds(builder, value, 0, place)
        builder.store(self.members[place].as_data(builder, field), address)


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


def _as_record(typing_context: Any, values: Any) -> Any:
    kind = Record(values.instance_class.__name__, dict(zip(values.fields, values, strict=True)))

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        model = context.data_model_manager[kind]
        place = cgutils.alloca_once(builder, model.structure)
        for number in range(len(kind.fields)):
            field = builder.extract_value(arguments[0], number)
            model.set_member(builder, place, number, field)
        return place

    return kind(values), generate


# as_record(values): the record with the fields of a named tuple that compiled code has made
as_record: Any = intrinsic(_as_record)
