"""Programs that the desk has started: each is a `rollerrig` command line, as anybody could type it.

They have a session of their own and go on when the desk ends. What one says goes to a temporary file, whose lines are
shown; its result is the object that `--json` prints.
"""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

from rollerrig.configs.errors import ConfigError

_PASSING = re.compile(r"compiling: |\d+ of \d+ .*\(\d+ s\)$")
_SHARE = re.compile(r"(\d+) of (\d+) (?:runs|sequences)")


class Program:
    """One command line: `words` after `rollerrig`, run in `folder`. Raises ConfigError where it cannot start."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self.words, self.folder = words, folder
        self.told = False  # whether its end has been noticed
        try:
            self._out, self._said = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 (read till the end)
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rollerrig.realtime.cli", *words, "--json"],
                cwd=folder,
                stdout=self._out,
                stderr=self._said,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            raise ConfigError(
                f"{self.title} cannot be started in {folder}: {error.strerror}; make room, or start the "
                "desk elsewhere with --folder"
            ) from None

    @property
    def title(self) -> str:
        """As it would be typed."""
        return " ".join(["rollerrig", *self.words])

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.poll()

    @property
    def lines(self) -> list[str]:
        """What it has said; of the lines that tell how far it is only the newest."""
        said = [
            line
            for line in _content(self._said).decode(errors="replace").splitlines()
            if line.strip()
        ]
        passing = [at for at, line in enumerate(said) if _PASSING.match(line)]
        return [line for at, line in enumerate(said) if at not in passing[:-1]]

    @property
    def result(self) -> dict[str, Any]:
        """What it has printed; empty as long as it runs, and where it crashed."""
        try:
            return dict(json.loads(_content(self._out)))
        except ValueError:
            return {}

    @property
    def error(self) -> str:
        """Why it failed, in its own words; empty where it did not, or runs."""
        result = self.result
        # sequences count theirs under the same name
        if self.status is None or (result and not isinstance(result.get("error"), str)):
            return ""
        return str(result.get("error") or (self.lines or ["it said nothing"])[-1])

    @property
    def share(self) -> float | None:
        """How much of its work is done, 0 to 1, where it tells."""
        found = next((one for line in reversed(self.lines) if (one := _SHARE.search(line))), None)
        return int(found[1]) / int(found[2]) if found and int(found[2]) else None

    def stop(self) -> None:
        """Ask it to end, as Ctrl-C does."""
        if self.status is None:
            self._process.send_signal(signal.SIGINT)


def _content(file: IO[bytes]) -> bytes:
    """All of a file, whose place is its writer's too: it is not moved."""
    return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0)
