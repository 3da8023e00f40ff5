"""The clock of the real-time thread: nanoseconds of CLOCK_MONOTONIC, called without the GIL.

The functions of libc are declared with `external_function`, whose addresses numba resolves when it loads
cached code, so a second start compiles nothing. Linux only: clock_nanosleep on an absolute deadline.
"""

import contextlib
import ctypes
import os
from collections.abc import Iterator

from rollerrig.rig.compiled.c_function import external_function
from rollerrig.rig.compiled.kernel import kernel

MONOTONIC = 1
_ABSOLUTE = 1
SECOND_NS = 1_000_000_000
_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4  # of mlockall(2)
IDLE_LIMIT = "/dev/cpu_dma_latency"

_gettime = external_function("clock_gettime", "int32", "int32", "intp")
_nanosleep = external_function("clock_nanosleep", "int32", "int32", "int32", "intp", "intp")
_write = external_function("write", "int64", "int32", "intp", "int64")


@kernel
def now_ns(spec):
    """The time in ns; `spec` is scratch, int64 of shape (2,)."""
    _gettime(MONOTONIC, spec.ctypes.data)
    return spec[0] * SECOND_NS + spec[1]


@kernel
def sleep_until(deadline_ns, spec):
    """Sleep until an absolute time in ns; returns at once when it has passed."""
    spec[0], spec[1] = deadline_ns // SECOND_NS, deadline_ns % SECOND_NS
    while _nanosleep(MONOTONIC, _ABSOLUTE, spec.ctypes.data, 0) == 4:  # EINTR
        pass


@kernel
def wake(descriptor, one):
    """Wake whoever waits on an eventfd (or pipe); `one` is int64 of shape (1,) holding 1."""
    _write(descriptor, one.ctypes.data, 8)


def eventfd() -> int:
    """A descriptor that `wake` makes readable."""
    return os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)


def lock_memory() -> str:
    """Keep pages in memory when touched; "" or why not. Future ones only without a limit: allocations would fail.

    Without MCL_ONFAULT all that libraries merely reserve would be filled, 1 GB for Arrow, and stay.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    unlimited = os.geteuid() == 0
    if libc.mlockall(_ON_FAULT | _CURRENT | (_FUTURE if unlimited else 0)) == 0:
        return ""
    return os.strerror(ctypes.get_errno())


def unlock_memory() -> None:
    """Let pages go again."""
    ctypes.CDLL(None).munlockall()


@contextlib.contextmanager
def awake(asked: bool = True) -> Iterator[str]:
    """Keep the cores out of deep idle states inside the block; yields "" or why not.

    A core that sleeps takes tens of us to wake. Writing 0 us to the kernel's latency file forbids
    that for as long as the file is open; cyclictest does the same. Source: Linux PM QoS.
    """
    try:
        descriptor = os.open(IDLE_LIMIT, os.O_WRONLY | os.O_CLOEXEC) if asked else -1
    except OSError as error:
        yield os.strerror(error.errno or 0)
        return
    try:
        if asked:
            os.write(descriptor, bytes(4))
        yield ""
    finally:
        if asked:
            os.close(descriptor)
