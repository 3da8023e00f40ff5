"""Lets one of several processes compile a kernel, while the others wait and then load it.

Processes that do the same work at the same time, such as the workers of a campaign or two first
starts, need the same kernels. Without a lock each of them compiles all of them: with two workers on
two cores that takes twice the processor time, and more than twice the time of one process that has
a core for itself.

A process takes the lock of a kernel that is not in the cache, looks into the cache once more, and
keeps the lock until it has compiled the kernel. The locks are record locks on a file in the folder
of the kernels, a byte for each kernel. The system removes them from a process that dies, and a
forked process does not have them. A process that waits for too long compiles the kernel itself,
because the other one may be suspended.
"""

import contextlib
import fcntl
import logging
import os
import time
import zlib
from pathlib import Path

from rollerrig.rig.compiled import kernel_cache

log = logging.getLogger(__name__)
LOCK_FILE = "compiling.lock"
_ONLY_FOR_USER = 0o600
# s: between two attempts; until the wait is announced; until it is given up
_PERIOD_S = 0.05
_ANNOUNCED_AFTER_S = 2.0
LONGEST_S = 300.0


class CompileLock:
    """The locks of this process, in the lock file of a folder."""

    def __init__(self, folder: Path) -> None:
        """Open the lock file; it stays open. Raises OSError where that is not possible."""
        kernel_cache.make_private(folder)
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        self._file = os.open(folder / LOCK_FILE, flags, _ONLY_FOR_USER)
        self._is_announced = False

    def take(self, kernel: str) -> None:
        """Wait for the lock of a kernel, and take it if that does not last too long."""
        begin_s = time.monotonic()
        while not self._try(kernel):
            waited_s = time.monotonic() - begin_s
            if waited_s > LONGEST_S:
                return
            if waited_s > _ANNOUNCED_AFTER_S and not self._is_announced:
                self._is_announced = True
                log.warning("another process compiles the same kernels; this one waits for it ...")
            time.sleep(_PERIOD_S)

    def _try(self, kernel: str) -> bool:
        """Take the lock of a kernel; return False if another process has it."""
        with contextlib.suppress(BlockingIOError, PermissionError):
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _place(kernel))
            return True
        return False

    def release(self, kernel: str) -> None:
        """Give the lock of a kernel back; nothing if this process does not have it."""
        fcntl.lockf(self._file, fcntl.LOCK_UN, 1, _place(kernel))


def _place(kernel: str) -> int:
    """Return the byte of a kernel in the lock file; the file does not get longer."""
    return zlib.crc32(kernel.encode())


_opened: dict[Path, CompileLock] = {}


def opened() -> CompileLock | None:
    """Return the locks of this process; None where kernels are not kept."""
    folder = kernel_cache.folder()
    if folder is None:
        return None
    if folder not in _opened:
        # a folder that cannot be written keeps nothing, and nobody can load from it
        with contextlib.suppress(OSError):
            _opened[folder] = CompileLock(folder)
    return _opened.get(folder)
