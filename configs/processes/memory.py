"""Locked memory: pages of a process that the system does not take away, for work in real time."""

import ctypes
import os

# flags of mlockall(2)
_CURRENT = 1
_FUTURE = 2
_ON_FAULT = 4


def lock() -> str:
    """Keep pages in memory once they are touched; return "" or the reason why that is not possible.

    Future pages are locked only where there is no limit: else allocations would fail. Without
    MCL_ONFAULT the memory that libraries merely reserve would be filled and stay, 1 GB for Arrow.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    flags = _ON_FAULT | _CURRENT
    is_unlimited = os.geteuid() == 0
    if is_unlimited:
        flags |= _FUTURE
    if libc.mlockall(flags) == 0:
        return ""
    return os.strerror(ctypes.get_errno())


def unlock() -> None:
    """Allow the system to page out memory again."""
    ctypes.CDLL(None).munlockall()
