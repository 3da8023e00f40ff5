"""The decorators that mark a numerical kernel, and how each is compiled.

All kernels run without the GIL and with IEEE arithmetic: a division by zero gives infinity or NaN
and no exception. There is no fastmath, so a run repeats bit for bit. No kernel takes a function as
an argument, because numba's cache never finds such a kernel again.
"""

from typing import Any

from rollerrig.rig.compiled import compile_progress, kernel_cache  # noqa: F401  they register
from rollerrig.rig.compiled.lazy_cache import LazyCache
from rollerrig.rig.compiled.numba_import import numba

_njit: Any = numba.njit  # its published types do not contain all options

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# A step allocates nothing, so numba need not count references to arrays. With the fifty arrays of
# the state the counting would take longer than the physics.
_WITHOUT_COUNTING: dict[str, Any] = {**_OPTIONS, "_nrt": False}
# no kernel is passed to C code as a function, so none needs a wrapper for C
_WITHOUT_WRAPPER: dict[str, Any] = {"no_cfunc_wrapper": True}


def _cached(**options: Any) -> Any:
    """Return a decorator that compiles a function and keeps the compiled code on disk."""
    compiled = _njit(**options, **_WITHOUT_WRAPPER)

    def decorate(function: Any) -> Any:
        dispatcher = compiled(function)
        # with NUMBA_DISABLE_JIT numba returns the function itself
        if dispatcher is not function:
            dispatcher._cache = LazyCache(function, options.get("_nrt", True))
        return dispatcher

    return decorate


# the usual kernel: it writes to arrays that its caller has allocated
kernel = _cached(**_WITHOUT_COUNTING)
# For functions that each step calls with the whole state: its hundreds of array fields would be
# copied for each call. The arithmetic is the same to the last bit.
kernel_inlined = _cached(**_WITHOUT_COUNTING, forceinline=True)
# for batch work that allocates arrays; a step never calls such a kernel
kernel_with_memory = _cached(**_OPTIONS)

# For generated functions and variants, which are compiled together with their callers. The second
# one counts references, as numba requires for arrays at addresses.
inlined_without_cache = _njit(**_WITHOUT_COUNTING, forceinline=True)
inlined_without_cache_counted = _njit(**_OPTIONS, _nrt=True, forceinline=True)
