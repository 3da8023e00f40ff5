"""Log messages while numba compiles: the first start of an installation takes half a minute.

Kernels that only some commands use, such as those of campaigns, are compiled by the first of them.

A command that knows how many kernels it needs states it (`expect`). Then the messages have a total
and the time that is left.

Numba must compile for a second before the first message appears, so that a few small kernels are
not announced. The next messages appear every few seconds, and the last one soon after the last
kernel.
"""

import contextlib
import gc
import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

from rollerrig.rig.compiled import numba_import

# isort: split
from numba.core import event

log = logging.getLogger(__name__)
# s: of compiling before it is announced; between messages; without a kernel until it has ended
ANNOUNCED_AFTER_S = 1.0
PERIOD_S = 5.0
ENDED_AFTER_S = 1.0
_POLL_S = 0.1


class _CompileListener(event.Listener):
    """Counts what numba compiles; a thread logs the progress as long as it compiles."""

    def __init__(self) -> None:
        self.compiled = 0
        self._compiling_now = 0
        # of time.monotonic
        self._last_end_s = 0.0
        self._thread: threading.Thread | None = None
        # how many kernels the command compiles at its first start; 0: not known
        self.expected = 0
        self._collects_garbage = True

    def on_start(self, event: Any) -> None:
        """Numba begins to compile a function; it calls this, also for functions inside it."""
        if self._compiling_now == 0:
            # the collector would visit numba's millions of objects again and again
            self._collects_garbage = gc.isenabled()
            gc.disable()
        self._compiling_now += 1
        numba_import.load_array_functions()
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._log_progress, name="compiling", daemon=True
            )
            self._thread.start()

    def on_end(self, event: Any) -> None:
        """Numba has compiled a function."""
        self._compiling_now -= 1
        self.compiled += 1
        self._last_end_s = time.monotonic()
        if self._compiling_now == 0 and self._collects_garbage:
            gc.enable()

    @contextlib.contextmanager
    def saving(self) -> Iterator[None]:
        """Count the time of the block as compiling."""
        self._compiling_now += 1
        try:
            yield
        finally:
            self._compiling_now -= 1
            self._last_end_s = time.monotonic()

    def _log_progress(self) -> None:
        """Log one stretch of compiling, until no kernel has been compiled for ENDED_AFTER_S."""
        begin_s = time.monotonic()
        compiled_before = self.compiled
        next_message_s = begin_s + ANNOUNCED_AFTER_S
        is_announced = False
        while self._compiling_now or time.monotonic() - self._last_end_s < ENDED_AFTER_S:
            time.sleep(_POLL_S)
            now_s = time.monotonic()
            if not self._compiling_now or now_s < next_message_s:
                continue
            next_message_s = now_s + PERIOD_S
            if not is_announced:
                is_announced = True
                log.warning(
                    "compiling the kernels that no command here has used since the installation "
                    "or a change of them; they are kept for later commands ..."
                )
            else:
                log.warning(
                    "compiling: %s",
                    self._progress(now_s - begin_s, self.compiled - compiled_before),
                )
        self._thread = None
        if is_announced:
            log.warning(
                "compiled %d kernels in %.0f s",
                self.compiled - compiled_before,
                self._last_end_s - begin_s,
            )

    def _progress(self, so_far_s: float, compiled: int) -> str:
        """Return the words on a stretch of compiling, with the time left if it is known."""
        left = self.expected - self.compiled
        if left <= 0 or compiled == 0:
            return f"{so_far_s:.0f} s so far, {compiled} kernels done"
        left_s = so_far_s / compiled * left
        return f"kernel {self.compiled} of about {self.expected}, about {left_s:.0f} s left"


_listener = _CompileListener()
event.register("numba:compile", _listener)
saving = _listener.saving


def expect(kernels: int) -> None:
    """State how many kernels this process compiles if none is in the cache."""
    _listener.expected = kernels


def has_compiled() -> bool:
    """Return whether this process has compiled a kernel."""
    return _listener.compiled > 0
