"""How compiled code sees a state: as the address of one buffer, which holds all its fields.

In Python a state is a named tuple of well over a hundred arrays, which are views of this buffer.
Numba would pass it from kernel to kernel as many values for each, which costs more to compile than
the physics does.
Therefore this module registers another type for it. A kernel receives only addresses and the number
of axles. Where it reads a field, numba makes the view from these and from the place of the field in
the buffer. So the same compiled code serves vehicles with any number of axles. The places are
constants, with room for the most axles: the compiler knows that two fields never overlap.

A buffer may hold several rigs. Their axles lie one after another in each field, so a kernel that
takes the state of all rigs loops over all axles. `rig_of` gives the state of one of them.

A buffer of very many rigs, for a GPU, has room for a multiple of the most axles. There a kernel
gets the state of its rig (`Placed`) with this multiple, and a field begins so many times as far
from the beginning. All kernels are the same.

Source: numba's documentation, "Extending Numba", low-level interface.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, NamedTuple

from rollerrig.rig.compiled.numba_import import settings  # the first import of numba

# isort: split
from numba.core import cgutils, imputils, types
from numba.core.typing import templates
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_VIEW = types.Array(types.float64, 1, "C")
_BYTES_OF_A_FLOAT = 8
_DIGITS = 12
# the attribute of a state with the number of axles
_AXLES = "axles"
# the member of a state with the multiple of the most axles for which its buffer has room
_MULTIPLE = "multiple"


class Width(NamedTuple):
    """The number of values of a field: so many for each axle, and so many more."""

    per_axle: int
    more: int = 0

    def of(self, axles: int) -> int:
        """Return the number of values for so many axles."""
        return self.per_axle * axles + self.more


# as far as from one rig to the next in a field with one value for each axle
_AXLES_OF_A_RIG = Width(1)


class Place(NamedTuple):
    """The place of a field in the buffer: where it begins, and how many values it has.

    next_rig: how far behind the field of a rig that of the next rig is.
    """

    begin: int
    width: Width
    next_rig: Width = _AXLES_OF_A_RIG

    def of(self, axles: int, rig: int = 0) -> slice:
        """Return the place for a rig, counted from 0, of rigs with so many axles each."""
        begin = self.begin + rig * self.next_rig.of(axles)
        return slice(begin, begin + self.width.of(axles))

    @property
    def is_interleaved(self) -> bool:
        """Whether the rigs of a field follow one another, with no other field between them."""
        return self.next_rig == self.width


def one_after_another(
    widths: Mapping[str, Width],
    most_axles: int,
    begin: int = 0,
    next_rig: Width = _AXLES_OF_A_RIG,
) -> dict[str, Place]:
    """Return the places of fields one after another, with room for so many axles, from `begin`."""
    places: dict[str, Place] = {}
    for field, width in widths.items():
        places[field] = Place(begin, width, next_rig)
        begin += width.of(most_axles)
    return places


class Address(types.Type):
    """The type of a state.

    places: the place of each field in the buffer; None for a field that is None.
    bases: the different `Place.next_rig` of the fields. There is an address for each.
    has_multiple: whether the buffer has room for a multiple of the most axles, see `Placed`.
    """

    def __init__(self, places: Mapping[str, Place | None], has_multiple: bool = False) -> None:
        self.places = dict(places)
        self.has_multiple = has_multiple
        present = [place for place in places.values() if place is not None]
        self.bases = list(dict.fromkeys(place.next_rig for place in present))
        # Numba takes two types with the same name as the same type. It writes the name into each
        # function that takes the type, so a digest of all places is better than their list.
        described = " ".join(f"{field}:{place}" for field, place in places.items())
        digest = hashlib.sha256(described.encode()).hexdigest()[:_DIGITS]
        super().__init__(name=f"{'States' if has_multiple else 'State'}_{digest}")


@register_model(Address)
class _Model(models.StructModel):
    """In compiled code a state is the addresses of its buffer, and the number of axles."""

    def __init__(self, manager: Any, kind: Address) -> None:
        pointer = types.CPointer(types.float64)
        members: list[tuple[str, Any]] = []
        for number in range(len(kind.bases)):
            members.append((_base(number), pointer))
        members.append((_AXLES, types.intp))
        if kind.has_multiple:
            members.append((_MULTIPLE, types.intp))
        super().__init__(manager, kind, members)


def _base(number: int) -> str:
    """Return the name of an address in compiled code."""
    return f"base_{number}"


def register(named_tuple: type, places: Mapping[str, Place], counted: str) -> None:
    """Make numba pass a named tuple to kernels as the addresses of its buffer.

    named_tuple: the class. Each field of an instance is a float64 view of one buffer, or None.
    places: the place of each field in the buffer.
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


class Placed(NamedTuple):
    """The state of one rig in a buffer of very many, as Python gives it to a kernel.

    kind: its type. numbers: the addresses of `Address.bases`, the number of axles, and the multiple
    of the most axles for which the buffer has room.
    """

    kind: Address
    numbers: tuple[int, ...]


@typeof_impl.register(Placed)
def _type_of_placed(state: Placed, context: Any) -> Address:
    return state.kind


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
            for number in range(len(kind.bases)):
                setattr(value, _base(number), view.data)
            value.axles = arguments[1]
            return value._getvalue()

        return kind(buffer, types.intp), generate

    return intrinsic(state_at)


def _rig_of(typing_context: Any, state: Any, rig: Any, axles: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        given, number, axles = arguments
        value = cgutils.create_struct_proxy(kind)(context, builder, given)
        for base, next_rig in enumerate(kind.bases):
            step = _times(context, builder, next_rig, axles)
            address = builder.gep(getattr(value, _base(base)), [builder.mul(number, step)])
            setattr(value, _base(base), address)
        value.axles = axles
        return value._getvalue()

    return state(state, types.intp, types.intp), generate


# rig_of(state, rig, axles): the state of one rig, counted from 0, of several with so many axles.
# Without a compiler there is one rig.
rig_of: Any = (lambda state, rig, axles: state) if settings.DISABLE_JIT else intrinsic(_rig_of)


def _times(context: Any, builder: Any, width: Width, axles: Any) -> Any:
    """Generate the code that computes `width.of(axles)`."""
    number = context.get_constant(types.intp, width.more)
    if width.per_axle:
        per_axle = context.get_constant(types.intp, width.per_axle)
        number = builder.add(builder.mul(per_axle, axles), number)
    return number


@unbox(Address)
def _from_python(kind: Address, state: Any, c: Any) -> NativeValue:
    """Generate the code that gets addresses and number of axles from a Python object.

    An address is that of the data of a field, less the place of the field. The number of axles is
    the size of the counted field.
    """
    from numba.np import arrayobj  # a lazy import: only compiling needs it

    if kind.has_multiple:
        return _from_placed(kind, state, c)
    value = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    failed = cgutils.false_bit
    fields = tuple(kind.places)
    read = {_AXLES: _COUNTED[fields]}
    for number, next_rig in enumerate(kind.bases):
        present = ((field, kind.places[field]) for field in fields)
        read[_base(number)] = next(
            fields.index(field) for field, place in present if place and place.next_rig == next_rig
        )
    for member, number in read.items():
        view = c.unbox(_VIEW, c.pyapi.tuple_getitem(state, number))
        array = arrayobj.make_array(_VIEW)(c.context, c.builder, view.value)
        if member == _AXLES:
            value.axles = array.nitems
        else:
            place = kind.places[fields[number]]
            assert place is not None
            back = c.context.get_constant(types.intp, -place.begin)
            setattr(value, member, c.builder.gep(array.data, [back]))
        failed = c.builder.or_(failed, view.is_error)
        # `unbox` has counted a reference to the view, which nothing needs: the caller keeps the
        # buffer alive as long as the kernel runs
        if c.context.enable_nrt:
            c.context.nrt.decref(c.builder, _VIEW, view.value)
    return NativeValue(value._getvalue(), is_error=failed)


def _from_placed(kind: Address, state: Any, c: Any) -> NativeValue:
    """Generate the code that gets a state from a `Placed`."""
    value = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    failed = cgutils.false_bit
    numbers = c.pyapi.tuple_getitem(state, Placed._fields.index("numbers"))
    members = [*(_base(number) for number in range(len(kind.bases))), _AXLES, _MULTIPLE]
    for place, member in enumerate(members):
        number = c.unbox(types.intp, c.pyapi.tuple_getitem(numbers, place))
        failed = c.builder.or_(failed, number.is_error)
        wanted = getattr(value, member).type
        is_address = member not in (_AXLES, _MULTIPLE)
        found = c.builder.inttoptr(number.value, wanted) if is_address else number.value
        setattr(value, member, found)
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

    base = getattr(value, _base(kind.bases.index(place.next_rig)))
    begin = context.get_constant(types.intp, place.begin)
    if kind.has_multiple and place.is_interleaved:
        begin = builder.mul(begin, value.multiple)
    view = arrayobj.make_array(_VIEW)(context, builder)
    arrayobj.populate_array(
        view,
        data=builder.gep(base, [begin]),
        shape=[_times(context, builder, place.width, value.axles)],
        strides=[context.get_constant(types.intp, _BYTES_OF_A_FLOAT)],
        itemsize=context.get_constant(types.intp, _BYTES_OF_A_FLOAT),
        meminfo=None,
    )
    return view._getvalue()
