"""A plugin of pytest: a session that gets SIGTERM ends all processes that it has started.

Those are the workers and everything that tests have started, also in other sessions.
"""

import contextlib
import ctypes
import os
import signal
import time

from process_tree import descendants, is_running

PR_SET_CHILD_SUBREAPER = 36  # of prctl(2)
EXIT_WITHIN_S = 10.0


def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        end_all_at_sigterm()


def end_all_at_sigterm():
    """Let SIGTERM end this process and its descendants."""
    signal.signal(signal.SIGTERM, lambda number, frame: end_all())


def end_all():
    """End all descendants of this process, those that do not react by SIGKILL, and then itself."""
    # a process whose parent exits becomes a child of this process
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    asked = set()
    kill_from_s = time.monotonic() + EXIT_WITHIN_S
    while running := set(filter(is_running, descendants(os.getpid()))):
        if time.monotonic() > kill_from_s:
            send(signal.SIGKILL, running)
        send(signal.SIGTERM, running - asked)
        asked |= running
        time.sleep(0.05)
    os._exit(128 + signal.SIGTERM)


def send(number, processes):
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)
