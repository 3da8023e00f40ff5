"""Programs that the desk has started: each is a `rollerrig` command line that a user could type.

A program has a separate session, so it continues when the desk exits. Its messages go to a
temporary file, whose lines the page shows. Its result is the JSON object that `--json` prints.
"""

import json
import os
import re
import shlex
import signal
import subprocess
import tempfile
from pathlib import Path
from typing import IO, Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children

# lines of progress, which the next line of progress replaces
_PROGRESS_LINE = re.compile(r"compiling: |\d+ of \d+ .*\(\d+ s\)$")
_DONE_OF_ALL = re.compile(r"(\d+) of (\d+) (?:runs|sequences)")


class Program:
    """One command line: `words` after `rollerrig`, started in `folder`.

    Raises ConfigError if it cannot start.
    """

    def __init__(self, words: list[str], folder: Path) -> None:
        self.words = words
        self.folder = folder
        self.end_noticed = False  # whether the desk has noticed that it exited
        verb, *rest = words
        try:
            # both files stay open as long as the page shows the program
            self._result_file = tempfile.TemporaryFile()  # noqa: SIM115
            self._message_file = tempfile.TemporaryFile()  # noqa: SIM115
            self._process = subprocess.Popen(
                children.module("rollerrig.realtime.cli", verb, "--json", *rest),
                cwd=folder,
                stdout=self._result_file,
                stderr=self._message_file,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            raise ConfigError(
                f"{self.title} cannot be started in {folder}: {error.strerror}; make room, or "
                "start the desk in another folder with --folder"
            ) from None

    @property
    def title(self) -> str:
        """The command line as it would be typed."""
        return shlex.join(["rollerrig", *self.words])

    @property
    def is_bench(self) -> bool:
        """Whether it is a bench that the manual mode has prepared."""
        return self.words[0] == "run" and "--start" in self.words

    @property
    def pid(self) -> int:
        """The number of its process."""
        return self._process.pid

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.poll()

    @property
    def lines(self) -> list[str]:
        """The messages so far. Of the lines of progress only the newest is left."""
        text = _content(self._message_file).decode(errors="replace")
        messages = [line for line in text.splitlines() if line.strip()]
        progress = [at for at, line in enumerate(messages) if _PROGRESS_LINE.match(line)]
        replaced = set(progress[:-1])
        return [line for at, line in enumerate(messages) if at not in replaced]

    @property
    def result(self) -> dict[str, Any]:
        """The object that it printed; empty while it runs, and if it crashed."""
        try:
            return dict(json.loads(_content(self._result_file)))
        except ValueError:
            return {}

    @property
    def error(self) -> str:
        """The message with which it failed; empty if it did not fail, or still runs."""
        if self.status is None:
            return ""
        result = self.result
        # the result of `sequence` has a number under this name: how many could not be played
        error = result.get("error")
        if result and not isinstance(error, str):
            return ""
        if error:
            return str(error)
        return self.lines[-1] if self.lines else "it printed nothing"

    @property
    def share(self) -> float | None:
        """The share of its work that is done, 0 to 1; None if it has not reported any."""
        for line in reversed(self.lines):
            progress = _DONE_OF_ALL.search(line)
            if progress:
                done = int(progress[1])
                total = int(progress[2])
                return done / total if total else None
        return None

    def stop(self) -> None:
        """Interrupt it, as Ctrl-C does."""
        if self.status is None:
            self._process.send_signal(signal.SIGINT)


def _content(file: IO[bytes]) -> bytes:
    """All bytes of a file. The position is left alone, because the writing process shares it."""
    return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0)
