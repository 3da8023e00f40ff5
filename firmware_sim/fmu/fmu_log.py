"""The log messages of an FMU: printed into the log of the unit, and quoted when a call fails.

Warnings and errors are printed as they come. The last of them are part of the error, because they
are the reason in the words of the FMU. Source: FMI 2.0.4, logger; FMI 3.0.2, fmi3LogMessage.
"""

import contextlib
from collections import deque
from typing import Any

_KEPT = 3  # messages
_LONGEST = 400  # characters of a message
_OK = 0
_LABELS = ("ok", "warning", "discard", "error", "fatal", "pending")
# the categories of the standards that are worth their time in every step
_WANTED = ("Warning", "Discard", "Error", "Fatal")


class FmuLog:
    """Receives the messages of one FMU."""

    def __init__(self) -> None:
        self._last: deque[str] = deque(maxlen=_KEPT)
        self._callbacks: Any = None  # of FMI 2; kept because the FMU uses them

    def instantiate(self, fmu: Any, description: Any, **options: Any) -> None:
        """Instantiate an FMU of FMPy with its logging on; `options` as for FMPy."""
        if description.fmiMajorVersion == 2:
            self._callbacks = _callbacks(self._take_of_fmi2)
            fmu.instantiate(callbacks=self._callbacks, loggingOn=True, **options)
        else:
            fmu.instantiate(loggingOn=True, logMessage=self._take_of_fmi3, **options)
        names = [category.name for category in description.logCategories]
        wanted = [name for name in names if any(word in name for word in _WANTED)]
        if wanted:
            # an FMU that cannot do this logs everything
            with contextlib.suppress(Exception):
                fmu.setDebugLogging(True, wanted)

    def text(self) -> str:
        """Return the last warnings and errors as the end of a sentence; empty without any."""
        return f"; its log: {' | '.join(self._last)}" if self._last else ""

    def _take_of_fmi2(
        self, component: Any, name: bytes, status: int, category: bytes, message: bytes
    ) -> None:
        self._take(status, message)

    def _take_of_fmi3(self, environment: Any, status: int, category: bytes, message: bytes) -> None:
        self._take(status, message)

    def _take(self, status: int, message: bytes | None) -> None:
        text = " ".join((message or b"").decode(errors="replace").split())[:_LONGEST]
        label = _LABELS[status] if 0 <= status < len(_LABELS) else str(status)
        print(f"[{label.upper()}] {text}")
        if status != _OK and text:
            self._last.append(text)


def _callbacks(take: Any) -> Any:
    """Return the callbacks of FMI 2 with a logger."""
    from ctypes import byref

    from fmpy import calloc, fmi2, free
    from fmpy.logging import addLoggerProxy

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(take)
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    # it formats the values of a message, which Python cannot
    addLoggerProxy(byref(callbacks))
    return callbacks
