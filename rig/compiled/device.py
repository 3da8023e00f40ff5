"""Kernels on a GPU: the same functions, which numba-cuda compiles for it, and the memory of a GPU.

`numba.cuda` takes a kernel of this product as a function of the GPU, with all that it calls. The
types of states and records are known to it, because they are registered with numba. Three functions
of numpy that kernels use are not known to it, and are those of NVIDIA's libdevice here.

A kernel that Python starts gets integers only: the address of the first record, the distance to the
next one, and their number. One thread works on one record. So nothing is converted at a start, and
the same code runs in numba's simulator of a GPU (NUMBA_ENABLE_CUDASIM=1), in which the threads are
those of Python and call the kernels of a core.

Source: numba-cuda's documentation, "Extending CUDA Python", "Compiling Python functions for use
with other languages".
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.compiled.kernel import inlined_without_cache
from rollerrig.rig.compiled.numba_import import without_linear_algebra

# isort: split
from llvmlite import ir
from numba import types
from numba.core import cgutils

INSTALL = "pip install 'rollerrig[cuda]'"
# threads that a GPU starts together; the experiment found no difference between 64 and 256
THREADS_OF_A_BLOCK = 64

cuda: Any = None  # the module numba.cuda, when it is loaded


def check_installed() -> None:
    """Raise ConfigError where the packages for a GPU are not installed; uses no GPU."""
    try:
        import numba_cuda  # noqa: F401
    except ImportError:
        raise ConfigError(
            f"--device cuda needs numba-cuda, which is not installed: {INSTALL}"
        ) from None


def load() -> Any:
    """Return the module numba.cuda. Raises ConfigError where it cannot be loaded."""
    global cuda
    check_installed()
    if cuda is None:
        try:
            with without_linear_algebra():
                from numba import cuda as loaded
            if not is_simulator(loaded):
                _add_functions()
        except Exception as error:  # of any kind: NVIDIA's libraries, or another version of numba
            reason = str(error).strip().splitlines()[0]
            raise ConfigError(
                f"--device cuda: numba-cuda cannot be loaded ({reason}); install it again with its "
                f"libraries: {INSTALL}"
            ) from None
        cuda = loaded
    return cuda


def is_simulator(loaded: Any) -> bool:
    """Return whether numba simulates a GPU on a core."""
    return bool(loaded.config.ENABLE_CUDASIM)


def name() -> str:
    """Return the name of the GPU of this process. Raises ConfigError where there is none."""
    loaded = load()
    if is_simulator(loaded):
        return "numba's simulator"
    if not loaded.is_available():
        raise ConfigError(
            "--device cuda: no GPU of NVIDIA was found (a driver and a GPU are needed; 'nvidia-smi' "
            "lists them); leave --device out to use the cores of this machine"
        )
    found = loaded.get_current_device().name
    return found.decode() if isinstance(found, bytes) else str(found)


class Memory:
    """Bytes in the memory of the GPU, from an address on."""

    def __init__(self, content: np.ndarray | int) -> None:
        """Return memory with the bytes of an array, or so many bytes of any content."""
        loaded = load()
        if isinstance(content, int):
            self.size = content
            self._bytes = loaded.device_array(max(content, 1), dtype=np.uint8)
        else:
            self.size = content.nbytes
            self._bytes = loaded.to_device(_bytes_of(content))
        # the simulator has arrays of numpy
        interface = getattr(self._bytes, "__cuda_array_interface__", None)
        if interface is None:
            interface = self._bytes.__array_interface__
        self.address: int = interface["data"][0]

    def write(self, content: np.ndarray) -> None:
        """Copy an array to the beginning of the memory."""
        source = _bytes_of(content)
        self._bytes[: source.size].copy_to_device(source)

    def read(self, content: np.ndarray) -> None:
        """Copy the beginning of the memory into a contiguous array."""
        target = _bytes_of(content)
        self._bytes[: target.size].copy_to_host(target)


def _bytes_of(array: np.ndarray) -> np.ndarray:
    """Return the bytes of a contiguous array, as a view."""
    return array.reshape(-1).view(np.uint8)


def threads_of(run_record: Callable[[int, int], None]) -> Any:
    """Return what runs a function in a thread for each record: `start` starts it.

    `run_record` gets the address of its record, and an integer. It is plain Python that calls
    kernels, and is compiled for the GPU with them.
    """
    load()
    run = inlined_without_cache(run_record)

    def threads(first: int, next_record: int, records: int, argument: int) -> None:
        thread = cuda.grid(1)
        if thread < records:
            run(first + thread * next_record, argument)

    return threads


def start(threads: Any, first: int, next_record: int, records: int, argument: int) -> None:
    """Run `threads` for records from an address on, and wait until all have ended."""
    blocks = -(-records // THREADS_OF_A_BLOCK)
    threads[blocks, THREADS_OF_A_BLOCK](first, next_record, records, argument)
    cuda.synchronize()


@functools.cache
def compiled(threads: Any) -> Any:
    """Return `threads` for the GPU of this process, which `start` takes; compiled once."""
    return load().jit(threads)


def ptx(threads: Any, capability: tuple[int, int]) -> str:
    """Return `threads` in PTX, for GPUs of a compute capability; this needs no GPU.

    numba-cuda would ask the GPU for its capability wherever a function calls another one.
    """
    loaded = load()
    from numba.cuda import dispatcher

    before = dispatcher.get_current_device
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=capability)
    try:
        code, _ = loaded.compile_ptx(threads, (types.int64,) * 4, cc=capability)
    finally:
        dispatcher.get_current_device = before
    return str(code)


def _add_functions() -> None:
    """Let numba-cuda know numpy's functions of one float that it lacks, from libdevice."""
    from numba.cuda import ufuncs

    known = ufuncs.ufunc_db()
    for function in (np.floor, np.rint, np.exp):
        known.setdefault(function, {"d->d": _of_libdevice(f"__nv_{function.__name__}")})


def _of_libdevice(function: str) -> Any:
    """Return what generates the call of a function of libdevice."""
    double = ir.DoubleType()

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(double, [double])
        called = cgutils.get_or_insert_function(builder.module, kind, function)
        return builder.call(called, arguments)

    return generate
