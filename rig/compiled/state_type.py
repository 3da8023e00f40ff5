"""How compiled code sees a state: as the address of one buffer, which holds all its fields.

In Python a state is a named tuple of forty arrays, which are views of this buffer. Numba would pass
it from kernel to kernel as three hundred values, which costs more to compile than the physics does.
Therefore this module registers another type for it. A kernel receives only the address and the
number of axles. Where it reads a field, numba makes the view from both and from the place of the
field in the buffer. So the same compiled code serves vehicles with any number of axles. The places
are constants, with room for the most axles: the compiler knows that two fields never overlap.

Source: numba's documentation, "Extending Numba", low-level interface.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, NamedTuple

from rollerrig.rig.compiled import numba_import  # noqa: F401  the first import of numba

# isort: split
from numba.core import cgutils, imputils, types
from numba.core.typing import templates
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_VIEW = types.Array(types.float64, 1, "C")
_BYTES_OF_A_FLOAT = 8
_DIGITS = 12
# the attribute of a state with the number of axles
_AXLES = "axles"


class Width(NamedTuple):
    """The number of values of a field: so many for each axle, and so many more."""

    per_axle: int
    more: int = 0

    def of(self, axles: int) -> int:
        """Return the number of values for so many axles."""
        return self.per_axle * axles + self.more


class Place(NamedTuple):
    """The place of a field in the buffer: where it begins, and how many values it has."""

    begin: int
    width: Width

    def of(self, axles: int) -> slice:
        """Return the place for so many axles."""
        return slice(self.begin, self.begin + self.width.of(axles))


def one_after_another(widths: Mapping[str, Width], most_axles: int) -> dict[str, Place]:
    """Return the places of fields one after another, with room for so many axles."""
    places: dict[str, Place] = {}
    begin = 0
    for field, width in widths.items():
        places[field] = Place(begin, width)
        begin += width.of(most_axles)
    return places


class Address(types.Type):
    """The type of a state.

    places: the place of each field in the buffer; None for a field that is None.
    """

    def __init__(self, places: Mapping[str, Place | None]) -> None:
        self.places = dict(places)
        # Numba takes two types with the same name as the same type. It writes the name into each
        # function that takes the type, so a digest of all places is better than their list.
        described = " ".join(f"{field}:{place}" for field, place in places.items())
        digest = hashlib.sha256(described.encode()).hexdigest()[:_DIGITS]
        super().__init__(name=f"State_{digest}")


@register_model(Address)
class _Model(models.StructModel):
    """In compiled code a state is the address of its buffer, and the number of axles."""

    def __init__(self, manager: Any, kind: Address) -> None:
        members = [("address", types.CPointer(types.float64)), (_AXLES, types.intp)]
        super().__init__(manager, kind, members)


def register(named_tuple: type, places: Mapping[str, Place], counted: str) -> None:
    """Make numba pass a named tuple to kernels as the address of its buffer.

    named_tuple: the class. Each field of an instance is a float64 view of one buffer, or None.
    places: the place of each field in the buffer. The first field is never None and is at the
    beginning of the buffer.
    counted: a field with one value for each axle.

    Call this before the first call of a kernel with such a tuple.
    """
    fields: tuple[str, ...] = named_tuple._fields  # type: ignore[attr-defined]
    _COUNTED[fields] = fields.index(counted)

    @typeof_impl.register(named_tuple)
    def type_of_state(state: Any, context: Any) -> Address:
        present: dict[str, Place | None] = {}
        for field, view in zip(fields, state, strict=True):
            present[field] = None if view is None else places[field]
        return Address(present)


# the number of the field with one value for each axle, by the names of all fields
_COUNTED: dict[tuple[str, ...], int] = {}


def state_in(places: Mapping[str, Place | None]) -> Any:
    """Return what makes a state from its buffer, float64 of shape (n,), and the number of axles.

    places: the place of each field in the buffer; None for a field that is None.
    """
    kind = Address(places)

    def state_at(typing_context: Any, buffer: Any, axles: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            from numba.np import arrayobj

            value = cgutils.create_struct_proxy(kind)(context, builder)
            view = arrayobj.make_array(signature.args[0])(context, builder, arguments[0])
            value.address = view.data
            value.axles = arguments[1]
            return value._getvalue()

        return kind(buffer, types.intp), generate

    return intrinsic(state_at)


@unbox(Address)
def _from_python(kind: Address, state: Any, c: Any) -> NativeValue:
    """Generate the code that gets address and number of axles from a Python object.

    They are the address of the first field's data, and the size of the counted field.
    """
    from numba.np import arrayobj  # a lazy import: only compiling needs it

    value = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    failed = cgutils.false_bit
    for number in (0, _COUNTED[tuple(kind.places)]):
        view = c.unbox(_VIEW, c.pyapi.tuple_getitem(state, number))
        array = arrayobj.make_array(_VIEW)(c.context, c.builder, view.value)
        if number == 0:
            value.address = array.data
        else:
            value.axles = array.nitems
        failed = c.builder.or_(failed, view.is_error)
        # `unbox` has counted a reference to the view, which nothing needs: the caller keeps the
        # buffer alive as long as the kernel runs
        if c.context.enable_nrt:
            c.context.nrt.decref(c.builder, _VIEW, view.value)
    return NativeValue(value._getvalue(), is_error=failed)


@templates.infer_getattr
class _Fields(templates.AttributeTemplate):
    """The type of each field: a view, or None."""

    key = Address

    # numba's base class has the value NotImplemented in place of this method
    def generic_resolve(self, kind: Address, field: str) -> Any:  # type: ignore[override]
        if field == _AXLES:
            return types.intp
        if field not in kind.places:
            return None  # numba then reports an unknown attribute
        if kind.places[field] is None:
            return types.none
        return _VIEW


@imputils.lower_getattr_generic(Address)
def _field(context: Any, builder: Any, kind: Address, state: Any, field: str) -> Any:
    """Generate the code that makes the view of a field, or that reads the number of axles."""
    from numba.np import arrayobj

    value = cgutils.create_struct_proxy(kind)(context, builder, state)
    if field == _AXLES:
        return value.axles
    place = kind.places[field]
    if place is None:
        return context.get_dummy_value()  # numba's representation of None

    size = context.get_constant(types.intp, place.width.more)
    if place.width.per_axle:
        per_axle = context.get_constant(types.intp, place.width.per_axle)
        size = builder.add(builder.mul(per_axle, value.axles), size)
    view = arrayobj.make_array(_VIEW)(context, builder)
    arrayobj.populate_array(
        view,
        data=builder.gep(value.address, [context.get_constant(types.intp, place.begin)]),
        shape=[size],
        strides=[context.get_constant(types.intp, _BYTES_OF_A_FLOAT)],
        itemsize=context.get_constant(types.intp, _BYTES_OF_A_FLOAT),
        meminfo=None,
    )
    return view._getvalue()
