"""Lets one of several processes compile, while the others wait and then load what it has compiled.

Processes that do the same work at the same time, such as the workers of a campaign or two first
starts, need the same kernels. Without a lock each of them compiles all of them: with two workers on
two cores that takes twice the processor time, and more than twice the time of one process that has
a core for itself.

A process takes the lock when a kernel is not in the cache, looks into the cache once more, and
keeps the lock until it has compiled nothing for a second. The lock is a record lock on a file in
the folder of the kernels: the system removes it from a process that dies, and a forked process does
not have it. A process waits only for processes that compile, and these wait for nobody: there is no
deadlock. A process that waits for too long compiles the kernels itself, because the other one may
be suspended.
"""

import contextlib
import fcntl
import logging
import os
import time

from rollerrig.rig.compiled import kernel_cache

log = logging.getLogger(__name__)
LOCK_FILE = "compiling.lock"
_ONLY_FOR_USER = 0o600
# s: between two attempts; until the wait is announced; until it is given up
_PERIOD_S = 0.05
_ANNOUNCED_AFTER_S = 2.0
LONGEST_S = 300.0


class _CompileLock:
    """The lock of this process; `descriptor` is None while the process does not hold it."""

    def __init__(self) -> None:
        self.descriptor: int | None = None

    def take(self) -> bool:
        """Wait for the lock; return whether this call has taken it."""
        folder = kernel_cache.folder()
        if self.descriptor is not None or folder is None:
            return False
        # where the folder cannot be written, nothing is kept and nobody can load it
        with contextlib.suppress(OSError):
            kernel_cache.make_private(folder)
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            descriptor = os.open(folder / LOCK_FILE, flags, _ONLY_FOR_USER)
            try:
                is_taken = _wait_for(descriptor)
            except BaseException:
                os.close(descriptor)
                raise
            if is_taken:
                self.descriptor = descriptor
                return True
            os.close(descriptor)
        return False

    def release(self) -> None:
        """Let the next process compile, if this one holds the lock."""
        descriptor = self.descriptor
        self.descriptor = None
        if descriptor is not None:
            os.close(descriptor)


def _wait_for(descriptor: int) -> bool:
    """Lock an open file; return False if another process keeps it locked for LONGEST_S."""
    begin_s = time.monotonic()
    is_announced = False
    while True:
        with contextlib.suppress(BlockingIOError, PermissionError):
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        waited_s = time.monotonic() - begin_s
        if waited_s > LONGEST_S:
            return False
        if waited_s > _ANNOUNCED_AFTER_S and not is_announced:
            is_announced = True
            log.warning("another process compiles the same kernels; this one waits for it ...")
        time.sleep(_PERIOD_S)


_lock = _CompileLock()
take = _lock.take
release = _lock.release
