"""A process that is stopped when its parent is gone.

As a program it becomes the command of such a process, and it imports nearly nothing:

    python parent_death.py PARENT SIGNAL COMMAND ...
"""

import ctypes
import os
import sys

_PR_SET_PDEATHSIG = 1  # of prctl(2)


def signal_at_parent_death(parent: int, number: int) -> None:
    """Make Linux send this process a signal when the thread that has started it is gone."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
    # the parent may have died before the call
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


if __name__ == "__main__":
    signal_at_parent_death(int(sys.argv[1]), int(sys.argv[2]))
    try:
        os.execvp(sys.argv[3], sys.argv[3:])
    except OSError as error:
        sys.exit(f"{sys.argv[3]}: {error.strerror}")
