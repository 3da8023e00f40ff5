"""How compiled code sees a state: as the address of one buffer, which holds all its fields.

In Python a state is a named tuple of forty arrays, which are views of this buffer. Numba would pass
it from kernel to kernel as three hundred values, which costs more to compile than the physics does.
Therefore this module registers another type for it. A kernel receives only the address. Where it
reads a field, numba makes the view from the address and from the place of the field in the buffer.

Source: numba's documentation, "Extending Numba", low-level interface.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

from rollerrig.rig.compiled import numba_import  # noqa: F401  the first import of numba

# isort: split
from numba.core import cgutils, imputils, types
from numba.core.typing import templates
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_VIEW = types.Array(types.float64, 1, "C")
_BYTES_OF_A_FLOAT = 8
_DIGITS = 12


class Address(types.Type):
    """The type of a state.

    places: the place of each field in the buffer, in values; None for a field that is None.
    """

    def __init__(self, places: Mapping[str, slice | None]) -> None:
        self.places = dict(places)
        # Numba takes two types with the same name as the same type. It writes the name into each
        # function that takes the type, so a digest of all places is better than their list.
        described = " ".join(f"{field}:{place}" for field, place in places.items())
        digest = hashlib.sha256(described.encode()).hexdigest()[:_DIGITS]
        super().__init__(name=f"State_{digest}")


@register_model(Address)
class _Model(models.StructModel):
    """In compiled code a state is a structure with one member: the address of its buffer."""

    def __init__(self, manager: Any, kind: Address) -> None:
        super().__init__(manager, kind, [("address", types.CPointer(types.float64))])


def register(named_tuple: type, places: Mapping[str, slice]) -> None:
    """Make numba pass a named tuple to kernels as the address of its buffer.

    named_tuple: the class. Each field of an instance is a float64 view of one buffer, or None.
    places: the place of each field in the buffer, in values. The first field is never None and is
    at the beginning of the buffer. Each field begins where the field before it ends.

    Call this before the first call of a kernel with such a tuple.
    """
    fields: tuple[str, ...] = named_tuple._fields  # type: ignore[attr-defined]

    @typeof_impl.register(named_tuple)
    def type_of_state(state: Any, context: Any) -> Address:
        present: dict[str, slice | None] = {}
        for field, view in zip(fields, state, strict=True):
            present[field] = None if view is None else places[field]
        return Address(present)


def state_in(places: Mapping[str, slice | None]) -> Any:
    """Return what makes a state from its buffer, float64 of shape (n,), in compiled code.

    places: the place of each field in the buffer; None for a field that is None.
    """
    kind = Address(places)

    def state_at(typing_context: Any, buffer: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            from numba.np import arrayobj

            value = cgutils.create_struct_proxy(kind)(context, builder)
            view = arrayobj.make_array(signature.args[0])(context, builder, arguments[0])
            value.address = view.data
            return value._getvalue()

        return kind(buffer), generate

    return intrinsic(state_at)


@unbox(Address)
def _from_python(kind: Address, state: Any, c: Any) -> NativeValue:
    """Generate the code that gets the address from a Python object.

    It is the address of the first field's data.
    """
    from numba.np import arrayobj  # a lazy import: only compiling needs it

    view = c.unbox(_VIEW, c.pyapi.tuple_getitem(state, 0))
    value = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    value.address = arrayobj.make_array(_VIEW)(c.context, c.builder, view.value).data
    # `unbox` has counted a reference to the view, which nothing needs: the caller keeps the buffer
    # alive as long as the kernel runs
    if c.context.enable_nrt:
        c.context.nrt.decref(c.builder, _VIEW, view.value)
    return NativeValue(value._getvalue(), is_error=view.is_error)


@templates.infer_getattr
class _Fields(templates.AttributeTemplate):
    """The type of each field: a view, or None."""

    key = Address

    # numba's base class has the value NotImplemented in place of this method
    def generic_resolve(self, kind: Address, field: str) -> Any:  # type: ignore[override]
        if field not in kind.places:
            return None  # numba then reports an unknown attribute
        if kind.places[field] is None:
            return types.none
        return _VIEW


@imputils.lower_getattr_generic(Address)
def _field(context: Any, builder: Any, kind: Address, state: Any, field: str) -> Any:
    """Generate the code that makes the view of a field."""
    from numba.np import arrayobj

    place = kind.places[field]
    if place is None:
        return context.get_dummy_value()  # numba's representation of None
    address = cgutils.create_struct_proxy(kind)(context, builder, state).address
    item_bytes = context.get_constant(types.intp, _BYTES_OF_A_FLOAT)
    view = arrayobj.make_array(_VIEW)(context, builder)
    arrayobj.populate_array(
        view,
        data=builder.gep(address, [context.get_constant(types.intp, place.start)]),
        shape=[context.get_constant(types.intp, place.stop - place.start)],
        strides=[item_bytes],
        itemsize=item_bytes,
        meminfo=None,
    )
    return view._getvalue()
