"""Functions on addresses: C functions of the system, and large kernels that others call by a name.

Numba compiles a kernel again into each kernel that calls it. `compile_named` compiles a large one
only once, as a C function on addresses, and gives it a name; other kernels call it by this name, as
they call a function of the C library.

    call = external_function("clock_gettime", "int32", "int32", "intp")
"""

from collections.abc import Callable
from typing import Any

from rollerrig.rig.compiled.kernel_files import KernelFiles
from rollerrig.rig.compiled.numba_import import numba, settings

# isort: split
from llvmlite import binding
from numba import types
from numba.core.ccallback import CFunc
from numba.extending import intrinsic

# types of addresses
FLOATS = types.CPointer(types.float64)
INTEGERS = types.CPointer(types.int64)

# array_at(address, shape): a view of the memory at an address, in compiled code
array_at: Any = numba.carray


def external_function(name: str, returns: str, *takes: str | types.Type) -> Any:
    """Return what compiled code calls as the C function `name`.

    Types are numba types or their names.

    Numba looks for the address when it loads compiled code, so a cached kernel is not compiled
    again.
    """
    arguments = [getattr(types, kind) if isinstance(kind, str) else kind for kind in takes]
    return types.ExternalFunction(name, getattr(types, returns)(*arguments))


def compile_named(name: str, function: Callable[..., None], *takes: types.Type) -> Any:
    """Compile a function without a result as the C function `name`, or load it from the cache.

    This must precede the first call of a kernel that calls `name`. The caller keeps the returned
    object as long as the function is in use.
    """
    if settings.DISABLE_JIT:
        return None
    compiled: Any = CFunc(
        function, (takes, types.void), locals={}, options={"error_model": "numpy"}
    )
    compiled._cache = KernelFiles(function)
    compiled.compile()
    binding.add_symbol(name, compiled.address)
    return compiled


def _shifted(typing_context: Any, address: Any, count: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.gep(arguments[0], [arguments[1]])

    return address(address, types.intp), generate


# shifted(address, count): the address of the entry `count` places further, in compiled code
shifted: Any = intrinsic(_shifted)


def _memory_barrier(typing_context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # on a GPU the host reads only when all threads have ended
        if context.target_name != "cuda":
            builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.none(), generate


# memory_barrier(): other threads and processes see all writes before it earlier than those after it
memory_barrier: Any = intrinsic(_memory_barrier)
