"""A process that ends when its parent is gone; as a program it becomes a command that does, and imports nearly nothing.

python ended.py PARENT SIGNAL COMMAND ...
"""

import ctypes
import os
import sys

_PR_SET_PDEATHSIG = 1


def with_parent(parent: int, by: int) -> None:
    """Let this process get a signal when the thread that has started it is no more (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, by)
        if os.getppid() != parent:  # gone already
            os.kill(os.getpid(), by)


if __name__ == "__main__":
    with_parent(int(sys.argv[1]), int(sys.argv[2]))
    try:
        os.execvp(sys.argv[3], sys.argv[3:])
    except OSError as why:
        sys.exit(f"{sys.argv[3]}: {why.strerror}")
