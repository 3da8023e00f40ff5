"""The cache of one kernel, which is opened only when Python calls the kernel.

Numba opens the cache of every kernel when it is defined, and prepares for compiling before it loads
compiled code. Most kernels are called by other kernels only, and compiled code needs no compiler,
so a program starts earlier without both; docs/compiled_kernels.md has the measured time.
"""

from typing import Any

from rollerrig.rig.compiled import compile_lock, compile_progress, numba_import
from rollerrig.rig.compiled.kernel_files import KernelFiles

# isort: split
from numba.core.runtime.nrt import rtsys


class LazyCache:
    """Replaces the cache of a kernel (`Dispatcher._cache`); opens numba's cache on first use."""

    def __init__(self, function: Any, counts_references: bool) -> None:
        """`counts_references` is true for a kernel that allocates memory."""
        self._function = function
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._counts_references = counts_references
        self._opened: Any = None

    def _open(self) -> Any:
        if self._opened is None:
            self._opened = KernelFiles(self._function)
        return self._opened

    def __getattr__(self, name: str) -> Any:
        return getattr(self._open(), name)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled code for a signature, None if there is none.

        Numba's method also calls `context.refresh()`, which loads everything that compiling needs.
        """
        if self._counts_references:
            rtsys.initialize(context)
        with numba_import.without_linear_algebra():
            loaded = self._open()._load_overload(signature, context)
            locks = compile_lock.opened()
            if loaded is None and locks:
                locks.take(self._name)
                # another process may have compiled it while this one waited
                loaded = self._open()._load_overload(signature, context)
            return loaded

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep the compiled code for a signature; it belongs to the time of compiling."""
        with compile_progress.saving():
            self._open().save_overload(signature, compiled)

    def end_compiling(self) -> None:
        """Let other processes load or compile the kernel, also if this one has failed."""
        locks = compile_lock.opened()
        if locks:
            locks.release(self._name)
