"""The processes that a process has started, and theirs. It imports little: a plugin of pytest uses
it.
"""

import contextlib
from pathlib import Path


def descendants(pid: int) -> dict[int, str]:
    """Return the command lines of all processes that a process has started, by their number."""
    found: dict[int, str] = {}
    # a process may exit while its files are read
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in map(int, task.read_text(encoding="ascii").split()):
                line = Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8")
                found[child] = line.replace("\0", " ")
                found |= descendants(child)
    return found


def is_running(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    with contextlib.suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
        return "\nState:\tZ" not in status
    return False
