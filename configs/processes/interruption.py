"""The signals that end a program, and work that they interrupt once."""

import signal
from types import FrameType
from typing import Self


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a program in order."""
    found = [signal.SIGINT, signal.SIGTERM]
    # a program under nohup goes on when its terminal closes
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        found.append(signal.SIGHUP)
    return found


class Interruption:
    """Lets the first ending signal raise KeyboardInterrupt in a `with` block.

    `by` is the name of that signal; it is empty as long as none has come. Later signals have no
    effect, so that the program can complete its files. Use it in the main thread.
    """

    def __init__(self) -> None:
        self.by = ""
        self._raises = True
        self._handlers_before = {number: signal.getsignal(number) for number in ending_signals()}

    def __enter__(self) -> Self:
        for number in self._handlers_before:
            signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)

    def ignore(self) -> None:
        """Ignore all signals from now on."""
        self._raises = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._raises:
            self._raises = False
            self.by = signal.Signals(number).name
            raise KeyboardInterrupt(self.by)
