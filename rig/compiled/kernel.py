"""How every numerical kernel of the project, marked @kernel, is compiled: cached, without the GIL, IEEE arithmetic.

No fastmath: a run repeats bit for bit. No function arguments: they never hit numba's cache, which `kernel_cache` keeps.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import FunctionType
from typing import Any

from rollerrig.rig.compiled import kernel_cache

settings: Any = kernel_cache.settings
_njit: Any = kernel_cache.numba.njit  # its published types do not know all options
# nothing is allocated in a step, so numba need not count references to arrays: with fifty of them
# in the state that took twice the time of the physics, and much of the time to compile
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    # no kernel is handed to another as a function: none needs one for C
    "no_cfunc_wrapper": True,
}


def _kept(**options: Any) -> Any:
    """A decorator that has numba compile a function and keep what it compiled."""
    compiled = _njit(**_OPTIONS, **options)

    def kept(function: Any) -> Any:
        made = compiled(function)
        if made is not function:  # as it is without a compiler
            made._cache = kernel_cache.Kept(function, options.get("_nrt", True))
        return made

    return kept


kernel = _kept(_nrt=False)
# for what every step calls with the whole state: its hundreds of array fields would be copied for
# each call; the arithmetic is the same to the last bit
kernel_inlined = _kept(_nrt=False, forceinline=True)

# for batch work that makes arrays of its own; a step never calls these
kernel_with_memory = _kept()


def written(
    name: str, lines: Sequence[str], file: str, module: str, names: Mapping[str, Any]
) -> Any:
    """The kernel `name` from lines that a table gave; it is cached as if it stood in `file`."""
    space: dict[str, Any] = {"__name__": module, **names}
    exec(compile("\n".join(lines), file, "exec"), space)
    return kernel(space[name])


def constructor(
    structure: Any, arguments: str, fields: Iterable[str], counted: bool = False, **names: Any
) -> Any:
    """A kernel that makes a named tuple, of an expression a field; `counted` as numba wants arrays at an address."""
    space: dict[str, Any] = {"structure": structure, **names}
    exec(f"def made({arguments}):\n    return structure({', '.join(fields)})", space)
    return _njit(nogil=True, _nrt=counted, forceinline=True)(space["made"])


def writer(arguments: str, places: Sequence[str]) -> Any:
    """A kernel that writes a tuple, the last argument, one entry a place."""
    space: dict[str, Any] = {}
    exec(f"def made({arguments}, given):\n    {', '.join(places)} = given", space)
    return _njit(nogil=True, _nrt=False, forceinline=True)(space["made"])


def again(formula: Any, **names: Any) -> Any:
    """The same kernel once more, inlined, with other things under some names that it uses; compiled with its caller."""
    plain = getattr(formula, "py_func", formula)  # itself where numba is told to compile nothing
    made = FunctionType(plain.__code__, plain.__globals__ | names)
    return _njit(nogil=True, error_model="numpy", _nrt=False, forceinline=True)(made)


def seeing(structure: Any, places: Iterable[slice | None]) -> Any:
    """A kernel that views a flat buffer as a named tuple, `views` for compiled code; None stays None."""
    return constructor(
        structure,
        "buffer",
        ("None" if place is None else f"buffer[{place.start}:{place.stop}]" for place in places),
    )
