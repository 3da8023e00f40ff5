"""Standard streams that do no harm: not without a reader, and not to a terminal.

A reader may go away (`rollerrig run ... | head`), a terminal may vanish, and a standard stream may
be closed from the start (`2>&-`). Output that has no reader is dropped, so that it changes neither
a run nor its exit status. Output that a full disk has not taken is an error; where that was
standard error, nobody can be told.

A name of a user may contain characters that act on a terminal. Everything that is printed passes
`printable`, also logs, usage errors and tracebacks. Only a library that draws on a terminal writes
its own sequences, through `drawing`.
"""

import errno
import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.printable import printable, printable_drawing

# errors of a write without a reader: of a pipe, and of a terminal that has vanished
_NO_READER = (errno.EPIPE, errno.EIO)


class _Standard(NamedTuple):
    """A standard stream: its file descriptor, its name in `sys`, and the mode of `open`."""

    descriptor: int
    name: str
    mode: str


# in the order of their descriptors, see make_harmless
_STANDARD_STREAMS = (
    _Standard(0, "stdin", "r"),
    _Standard(1, "stdout", "w"),
    _Standard(2, "stderr", "w"),
)


class Stream:
    """A standard stream that drops output without a reader, and makes hidden characters visible.

    All other attributes are those of the wrapped stream.
    """

    def __init__(
        self, stream: Any, clean: Callable[[str], str] = printable, is_needed: bool = False
    ) -> None:
        self._stream = stream
        self._clean = clean
        self._is_needed = is_needed  # whether output that cannot be written is an error

    def write(self, text: str) -> int:
        """Write a text and return its number of characters."""
        shown = self._clean(text)
        self._attempt(lambda: self._stream.write(shown))
        return len(text)

    def for_drawing(self) -> "Stream":
        """Return this stream for a library that draws: its own sequences pass."""
        return Stream(self._stream, printable_drawing, self._is_needed)

    def flush(self) -> None:
        """Write the buffered output to the file."""
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, write: Callable[[], Any]) -> None:
        """Write. If that is not possible, connect the stream to /dev/null.

        Raises RollerrigError if the output is needed and has a reader.
        """
        try:
            write()
        except OSError as error:
            # The stream still buffers its output, and Python writes it when the program exits.
            # That write must not fail, because it would change the exit status.
            null_device = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null_device, self._stream.fileno())
            os.close(null_device)
            if self._is_needed and error.errno not in _NO_READER:
                raise RollerrigError(
                    f"the output cannot be written: {error.strerror}; make room, or write it to "
                    "another place"
                ) from None


def drawing(stream: Any) -> Any:
    """Return a stream for a library that draws on terminals; other streams stay as they are."""
    return stream.for_drawing() if isinstance(stream, Stream) else stream


def make_harmless() -> None:
    """Let the standard streams of this process drop output without a reader, and filter it.

    Streams that are closed are connected to /dev/null.
    """
    for standard in _STANDARD_STREAMS:
        if getattr(sys, standard.name) is None:
            # the system assigns the lowest free descriptor, which is the one of this stream
            os.open(os.devnull, os.O_RDONLY if standard.mode == "r" else os.O_WRONLY)
            stream = open(standard.descriptor, standard.mode, closefd=False)  # noqa: SIM115
            setattr(sys, standard.name, stream)

    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        # main() may be called several times in a process, and wraps a stream only once
        if not isinstance(stream, Stream):
            setattr(sys, name, Stream(stream, is_needed=name == "stdout"))
