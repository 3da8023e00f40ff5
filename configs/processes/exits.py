"""How a process has ended, in words: by itself, by a crash, or by a signal of somebody."""

import signal

# signals with which the system ends a program that has done something impossible
_CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE, signal.SIGABRT)


def exit_text(status: int) -> str:
    """Return how a process has ended, by its exit status, which is below 0 for a signal."""
    if status >= 0:
        return f"exited with status {status}"
    try:
        name = f"signal {-status}, {signal.Signals(-status).name}"
    except ValueError:
        name = f"signal {-status}"
    return f"crashed ({name})" if -status in _CRASHES else f"was killed ({name})"
