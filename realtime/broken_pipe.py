"""Output that nobody reads changes nothing: neither the run nor its exit status.

A reader may go away (`rollerrig run ... | head`), a terminal may vanish, a standard stream may be
closed from the start (`2>&-`). What is written then goes nowhere.
"""

import errno
import os
import sys
from typing import Any

_NOBODY_READS = (errno.EPIPE, errno.EIO)


class Stream:
    """A standard stream that drops what nobody reads; all else is the stream's own."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write; returns the number of characters taken."""
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write out what is buffered."""
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, write: Any) -> None:
        try:
            write()
        except OSError as error:
            if error.errno not in _NOBODY_READS:
                raise
            # what is still buffered must go somewhere, at the latest when the program ends
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


def make_harmless() -> None:
    """Let the standard streams of this process drop what nobody reads; open those that are closed."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            # the lowest number that is free is this stream's own
            os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115
    for name in ("stdout", "stderr"):
        if not isinstance(getattr(sys, name), Stream):
            setattr(sys, name, Stream(getattr(sys, name)))
