"""The clock of the real-time thread: nanoseconds of CLOCK_MONOTONIC, called without the GIL.

The functions of libc are declared with `external_function`, whose addresses numba resolves when it
loads cached code, so a second start compiles nothing. Linux only: clock_nanosleep on an absolute
deadline.
"""

import contextlib
import os
from collections.abc import Iterator

from rollerrig.rig.compiled.c_function import external_function
from rollerrig.rig.compiled.kernel import kernel

MONOTONIC = 1
_ABSOLUTE = 1
SECOND_NS = 1_000_000_000
_EINTR = 4  # errno(3): a signal interrupted the sleep
IDLE_LIMIT = "/dev/cpu_dma_latency"

_gettime = external_function("clock_gettime", "int32", "int32", "intp")
_nanosleep = external_function("clock_nanosleep", "int32", "int32", "int32", "intp", "intp")
_write = external_function("write", "int64", "int32", "intp", "int64")


@kernel
def now_ns(spec):
    """Return the time in ns; `spec` is scratch, int64 of shape (2,)."""
    _gettime(MONOTONIC, spec.ctypes.data)
    return spec[0] * SECOND_NS + spec[1]


@kernel
def sleep_until(deadline_ns, spec):
    """Sleep until an absolute time in ns; return immediately if it has passed."""
    spec[0] = deadline_ns // SECOND_NS
    spec[1] = deadline_ns % SECOND_NS
    while _nanosleep(MONOTONIC, _ABSOLUTE, spec.ctypes.data, 0) == _EINTR:
        pass


@kernel
def wake(descriptor, one):
    """Wake the reader of an eventfd (or pipe); `one` is int64 of shape (1,) holding 1."""
    _write(descriptor, one.ctypes.data, 8)


def eventfd() -> int:
    """Return a descriptor that `wake` makes readable."""
    return os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)


@contextlib.contextmanager
def awake(required: bool = True) -> Iterator[str]:
    """Keep the cores out of deep idle states inside the block; yield "" or the reason why not.

    A core in a deep idle state takes tens of us to wake. Writing 0 us to the kernel's latency file
    forbids these states for as long as the file is open; cyclictest does the same. With `required`
    False nothing is done. Source: Linux PM QoS.
    """
    if not required:
        yield ""
        return
    try:
        descriptor = os.open(IDLE_LIMIT, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        yield os.strerror(error.errno or 0)
        return
    try:
        os.write(descriptor, bytes(4))
        yield ""
    finally:
        os.close(descriptor)
