"""How every numerical kernel of the project is compiled: the decorators that mark a kernel.

All kernels are compiled without the GIL and with IEEE arithmetic (a division by zero gives infinity or NaN, no
exception). There is no fastmath: a run repeats bit for bit. No kernel takes a function as an argument, because
numba's cache never finds such a kernel again.
"""

from typing import Any

from rollerrig.rig.compiled import kernel_cache

settings: Any = kernel_cache.settings
_njit: Any = kernel_cache.numba.njit  # its published types do not know all options

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# A step allocates nothing, so numba need not count references to arrays. With the fifty arrays of the state the
# counting took twice the time of the physics, and much of the time to compile.
_WITHOUT_COUNTING: dict[str, Any] = {**_OPTIONS, "_nrt": False}
# no kernel is passed to C code as a function, so none needs a wrapper for C
_WITHOUT_WRAPPER: dict[str, Any] = {"no_cfunc_wrapper": True}


def _cached(**options: Any) -> Any:
    """Returns a decorator that compiles a function with numba and keeps the compiled code on disk."""
    compiled = _njit(**options, **_WITHOUT_WRAPPER)

    def decorate(function: Any) -> Any:
        dispatcher = compiled(function)
        if dispatcher is not function:  # with NUMBA_DISABLE_JIT numba returns the function itself
            dispatcher._cache = kernel_cache.Kept(function, options.get("_nrt", True))
        return dispatcher

    return decorate


kernel = _cached(**_WITHOUT_COUNTING)
# For functions that each step calls with the whole state: its hundreds of array fields would be copied for each call.
# The arithmetic is the same to the last bit.
kernel_inlined = _cached(**_WITHOUT_COUNTING, forceinline=True)
# for batch work that allocates arrays; a step never calls such a kernel
kernel_with_memory = _cached(**_OPTIONS)

# For generated functions and variants, which are compiled together with their callers. The second one counts
# references, as numba requires for arrays at addresses.
inlined_without_cache = _njit(**_WITHOUT_COUNTING, forceinline=True)
inlined_without_cache_counted = _njit(**_OPTIONS, _nrt=True, forceinline=True)
