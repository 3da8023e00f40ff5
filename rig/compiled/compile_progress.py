"""Log messages while numba compiles: the first start of an installation takes a minute or two.

Kernels that only some commands use, such as those of campaigns, are compiled by the first of them.

The first message appears before the first kernel is compiled, the next ones every few seconds, and
the last one when no kernel has been compiled for as long.
"""

import logging
import threading
import time
from typing import Any

from rollerrig.rig.compiled import numba_import

# isort: split
from numba.core import event

log = logging.getLogger(__name__)
PERIOD_S = 5.0


class _CompileListener(event.Listener):
    """Counts what numba compiles; a thread logs the progress as long as it compiles."""

    def __init__(self) -> None:
        self.compiled = 0
        self._compiling_now = 0
        # of time.monotonic; 0: numba has not begun
        self._begin_s = 0.0
        self._last_end_s = 0.0

    def on_start(self, event: Any) -> None:
        """Numba begins to compile a function; it calls this, also for functions inside it."""
        self._compiling_now += 1
        numba_import.load_array_functions()
        if not self._begin_s:
            self._begin_s = time.monotonic()
            log.warning(
                "compiling the kernels that no command here has used since the installation or a "
                "change of them; they are kept for later commands (1 to 2 minutes) ..."
            )
            threading.Thread(target=self._log_progress, name="compiling", daemon=True).start()

    def on_end(self, event: Any) -> None:
        """Numba has compiled a function."""
        self._compiling_now -= 1
        self.compiled += 1
        self._last_end_s = time.monotonic()

    def _log_progress(self) -> None:
        time.sleep(PERIOD_S)
        while self._compiling_now or time.monotonic() - self._last_end_s < PERIOD_S:
            log.warning(
                "compiling: %.0f s so far, %d kernels done",
                time.monotonic() - self._begin_s,
                self.compiled,
            )
            time.sleep(PERIOD_S)
        log.warning(
            "compiled %d kernels in %.0f s", self.compiled, self._last_end_s - self._begin_s
        )
        self._begin_s = 0.0


_listener = _CompileListener()
event.register("numba:compile", _listener)


def has_compiled() -> bool:
    """Return whether this process has compiled a kernel."""
    return _listener.compiled > 0
