"""How compiled code sees a state: as one address, whose fields are views at fixed places.

A named tuple of forty arrays would be passed from kernel to kernel as three hundred values, which
costs more to compile than the physics does. In Python the state remains the named tuple that it is.
Only its type is registered with numba here, and reading a field gives the same view.

Source: numba's documentation, "Extending Numba", low-level interface.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.rig.compiled import numba_import  # noqa: F401  the first import of numba

# isort: split
from numba.core import cgutils, imputils, types
from numba.core.typing import templates
from numba.extending import NativeValue, models, register_model, typeof_impl, unbox

_VIEW = types.Array(types.float64, 1, "C")
_BYTES_OF_A_FLOAT = 8


class Address(types.Type):
    """The type of a state: the place of each field in its buffer; None for a field that is None."""

    def __init__(self, places: Mapping[str, slice | None]) -> None:
        self.places = dict(places)
        # numba takes two types with one name as the same type
        ends = [f"{name}:{place.stop}" if place else name for name, place in places.items()]
        super().__init__(name=f"State({' '.join(ends)})")


@register_model(Address)
class _Model(models.StructModel):
    """In compiled code a state is a structure with one member: the address of its buffer."""

    def __init__(self, manager: Any, kind: Address) -> None:
        super().__init__(manager, kind, [("first", types.CPointer(types.float64))])


def register(named_tuple: type, places: Mapping[str, slice]) -> None:
    """Makes numba take a named tuple of float64 views, or None, as the address of their buffer.

    The first field must be at the beginning of the buffer. This must precede the first call of a
    kernel with such a tuple.
    """
    fields: tuple[str, ...] = named_tuple._fields  # type: ignore[attr-defined]

    @typeof_impl.register(named_tuple)
    def type_of_state(state: Any, context: Any) -> Address:
        return Address(
            {
                name: None if view is None else places[name]
                for name, view in zip(fields, state, strict=True)
            }
        )


@unbox(Address)
def _from_python(kind: Address, state: Any, c: Any) -> NativeValue:
    """Generates the code that takes the address out of a Python object."""
    from numba.np import arrayobj  # a lazy import: only compiling needs it

    # the caller keeps the buffer alive as long as the kernel runs
    view = c.unbox(_VIEW, c.pyapi.tuple_getitem(state, 0))
    value = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    value.first = arrayobj.make_array(_VIEW)(c.context, c.builder, view.value).data
    if c.context.enable_nrt:
        c.context.nrt.decref(c.builder, _VIEW, view.value)
    return NativeValue(value._getvalue(), is_error=view.is_error)


@templates.infer_getattr
class _Fields(templates.AttributeTemplate):
    """The type of each field: a view, or None."""

    key = Address

    # numba declares it as a value, NotImplemented
    def generic_resolve(self, kind: Address, field: str) -> Any:  # type: ignore[override]
        if field not in kind.places:
            return None
        return _VIEW if kind.places[field] else types.none


@imputils.lower_getattr_generic(Address)
def _field(context: Any, builder: Any, kind: Address, state: Any, field: str) -> Any:
    """Generates the code that makes the view of a field."""
    from numba.np import arrayobj

    place = kind.places[field]
    if place is None:
        return context.get_dummy_value()
    first = cgutils.create_struct_proxy(kind)(context, builder, state).first
    item_bytes = context.get_constant(types.intp, _BYTES_OF_A_FLOAT)
    view = arrayobj.make_array(_VIEW)(context, builder)
    arrayobj.populate_array(
        view,
        data=builder.gep(first, [context.get_constant(types.intp, place.start)]),
        shape=[context.get_constant(types.intp, place.stop - place.start)],
        strides=[item_bytes],
        itemsize=item_bytes,
        meminfo=None,
    )
    return view._getvalue()
