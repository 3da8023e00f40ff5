"""Standard streams without a reader: they change neither a run nor its exit status.

A reader may go away (`rollerrig run ... | head`), a terminal may vanish, and a standard stream may
be closed from the start (`2>&-`). Output that has no reader is dropped.
"""

import errno
import os
import sys
from collections.abc import Callable
from typing import Any

_NO_READER = (errno.EPIPE, errno.EIO)
# the standard streams: descriptor, name in `sys`, mode
_STREAMS = ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w"))


class Stream:
    """A standard stream that drops output without a reader.

    All other attributes are the stream's.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text; return its number of characters."""
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write out what is buffered."""
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, write: Callable[[], Any]) -> None:
        try:
            write()
        except OSError as error:
            if error.errno not in _NO_READER:
                raise
            # buffered output must go somewhere, at the latest when the program exits
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


def make_harmless() -> None:
    """Let the standard streams of this process drop output without a reader.

    Open closed streams.
    """
    for descriptor, name, mode in _STREAMS:
        if getattr(sys, name) is None:
            # the system assigns the lowest free descriptor, which is the one of this stream
            os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            setattr(sys, name, open(descriptor, mode, closefd=False))  # noqa: SIM115
    for name in ("stdout", "stderr"):
        if not isinstance(getattr(sys, name), Stream):
            setattr(sys, name, Stream(getattr(sys, name)))
