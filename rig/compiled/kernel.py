"""The decorators that mark a numerical kernel, and how each is compiled.

All kernels run without the GIL and with IEEE arithmetic: a division by zero gives infinity or NaN
and no exception. There is no fastmath, so a run repeats bit for bit. No kernel takes a function as
an argument, because numba's cache never finds such a kernel again.
"""

from typing import Any

from rollerrig.rig.compiled import (  # noqa: F401  they register
    compile_progress,
    kernel_cache,
    known_answers,
)
from rollerrig.rig.compiled.lazy_cache import LazyCache
from rollerrig.rig.compiled.numba_import import settings
from rollerrig.rig.compiled.part import Compiler, KernelDispatcher, KernelPipeline

_OPTIONS: dict[str, Any] = {
    "nopython": True,
    "boundscheck": None,
    "nogil": True,
    "error_model": "numpy",
    # no kernel is passed to C code as a function, so none needs a wrapper for C
    "no_cfunc_wrapper": True,
}
# A step allocates nothing, so numba need not count references to arrays. With the fifty arrays of
# the state the counting would take longer than the physics.
_WITHOUT_COUNTING: dict[str, Any] = {**_OPTIONS, "_nrt": False}


def _compiled(**options: Any) -> Any:
    """Return a decorator that compiles a function when it is first called."""

    def decorate(function: Any) -> Any:
        if settings.DISABLE_JIT:
            return function
        # array expressions of batch work need all steps of numba
        pipeline = Compiler if options.get("_nrt", True) else KernelPipeline
        return KernelDispatcher(function, targetoptions=options, pipeline_class=pipeline)

    return decorate


def _cached(**options: Any) -> Any:
    """Return a decorator that compiles a function and keeps the compiled code on disk."""
    compiled = _compiled(**options)

    def decorate(function: Any) -> Any:
        dispatcher = compiled(function)
        # with NUMBA_DISABLE_JIT there is none
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
inlined_without_cache = _compiled(**_WITHOUT_COUNTING, forceinline=True)
inlined_without_cache_counted = _compiled(**_OPTIONS, _nrt=True, forceinline=True)


def uncompiled(compiled: Any) -> Any:
    """Return a kernel as a Python function, for a few calls: they take less time than compiling.

    The kernels that it calls are compiled, as they are wherever Python calls them.
    """
    # with NUMBA_DISABLE_JIT a kernel is a plain function already
    return getattr(compiled, "py_func", compiled)
