"""Lets one of several processes compile, while the others wait and then load what it has compiled.

Processes that do the same work at the same time, such as the workers of a campaign, need the same
kernels. Without a lock each of them compiles all of them: with two workers on two cores that takes
twice the processor time, and more than twice the time of one process that has a core for itself.

A process takes part after `take_turns`. It takes the lock when a kernel is not in the cache, looks
into the cache once more, and keeps the lock until it has compiled nothing for a second. The lock is
a file in the folder of the kernels, and the system removes it from a process that dies. A process
waits only for processes that compile, and these wait for nobody: there is no deadlock.
"""

import contextlib
import fcntl
import os

from rollerrig.rig.compiled import kernel_cache

LOCK_FILE = "compiling.lock"
_ONLY_FOR_USER = 0o600


class _CompileLock:
    """The lock of this process; `descriptor` is None while the process does not hold it."""

    def __init__(self) -> None:
        self.takes_turns = False
        self.descriptor: int | None = None

    def take(self) -> bool:
        """Wait for the lock; return whether this call has taken it."""
        folder = kernel_cache.folder()
        if not self.takes_turns or self.descriptor is not None or folder is None:
            return False
        # where the folder cannot be written, nothing is kept and nobody can load it
        with contextlib.suppress(OSError):
            kernel_cache.make_private(folder)
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            descriptor = os.open(folder / LOCK_FILE, flags, _ONLY_FOR_USER)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            except BaseException:
                os.close(descriptor)
                raise
            self.descriptor = descriptor
            return True
        return False

    def release(self) -> None:
        """Let the next process compile, if this one holds the lock."""
        descriptor = self.descriptor
        self.descriptor = None
        if descriptor is not None:
            os.close(descriptor)


_lock = _CompileLock()
take = _lock.take
release = _lock.release


def take_turns() -> None:
    """Let this process take part from now on."""
    _lock.takes_turns = True
