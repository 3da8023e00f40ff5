"""Processes that we start: they end with us, also when we are killed, and leave their last words.

Linux tells a process that the thread which has started it is no more (prctl, PR_SET_PDEATHSIG); others are left to
themselves. What shall outlive us is started without: the recorder, which finishes its files, and a viewer.

A program that has loaded what its children need forks them (`Forked`): each would load it again, for half a second.
"""

import ctypes
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import ended

# of /proc/self/stat, counted behind the name: where the command line begins and ends
_COMMAND_LINE = slice(45, 47)
# libraries with threads of their own, which a fork would not have
_THREADED = "rerun"


def command(*words: str, by: int = signal.SIGTERM) -> list[str]:
    """A command as a child of this process that gets a signal when this process is gone."""
    return [sys.executable, "-IS", ended.__file__, str(os.getpid()), str(int(by)), *words]


def pool(count: int, first: Callable[..., Any] = int, *arguments: Any) -> ProcessPoolExecutor:
    """Worker processes that end with this one; first(*arguments) is called in each."""
    return ProcessPoolExecutor(
        count, multiprocessing.get_context("spawn"), _begin, (os.getpid(), first, arguments)
    )


def last_line(log: Path) -> str:
    """Return the last line that is not empty in the log of a process, or an empty string."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    written = [line for line in lines if line.strip()]
    return written[-1] if written else ""


def last_words(log: Path) -> str:
    """Return the last line of a log as the end of a sentence; empty where there is none."""
    line = last_line(log)
    return f"; its last words: {line}" if line else ""


def can_fork() -> bool:
    """Whether this process may fork: on Linux, with one thread and no library that has others."""
    return (
        sys.platform == "linux" and threading.active_count() == 1 and _THREADED not in sys.modules
    )


class Forked(subprocess.Popen[bytes]):
    """This process once more: it calls `then`, its result is its status, and `words` stand as its command line.

    Its standard input is a pipe, its output goes nowhere, its errors too where `quiet`. It is in a session of its own;
    with `by` it gets this signal when this process is gone. It closes what `others` are written to.
    """

    def __init__(
        self,
        words: Sequence[str],
        then: Callable[[], int],
        by: int = 0,
        quiet: bool = False,
        others: Sequence[subprocess.Popen[bytes]] = (),
    ) -> None:
        # what a Popen knows of a child that runs
        self.args, self.stdout, self.stderr, self.returncode = words, None, None, None
        self._waitpid_lock, self._child_created, self._sigint_wait_secs = (
            threading.Lock(),
            True,
            0.25,
        )
        heard, told = os.pipe()
        parent = os.getpid()
        sys.stdout.flush()
        sys.stderr.flush()
        gc.freeze()  # what is not collected is not copied
        self.pid = os.fork()
        if not self.pid:
            closed = [told, *(one.stdin.fileno() for one in others if one.stdin)]
            _be(words, then, heard, by and (parent, by), quiet, closed)
        os.close(heard)
        self.stdin = open(told, "wb")  # noqa: SIM115


def _be(
    words: Sequence[str], then: Callable[[], int], heard: int, ends: Any, quiet: bool, closed: Any
) -> None:
    """The life of a forked process; it returns to nobody."""
    status = 1
    try:
        os.setsid()
        if ends:
            ended.with_parent(*ends)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for source, number in ((heard, 0), (nowhere, 1), *([(nowhere, 2)] if quiet else [])):
            os.dup2(source, number)
        for number in (heard, nowhere, *closed):
            os.close(number)
        sys.stdin = open(0)  # noqa: SIM115
        sys.stdout = open(1, "w")  # noqa: SIM115
        sys.stderr = open(2, "w", buffering=1)  # noqa: SIM115
        _be_called(words)
        status = then()
    except RollerrigError as error:
        print(f"{' '.join(words)}: {error}", file=sys.stderr)
        status = 2
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _be_called(words: Sequence[str]) -> None:
    """Write another command line over the one that this process was started with, as far as there is room."""
    with open("/proc/self/stat", encoding="ascii") as file:
        begin, end = map(int, file.read().rpartition(")")[2].split()[_COMMAND_LINE])
    text = "\0".join(words).encode()[: end - begin - 1]
    ctypes.memmove(begin, text.ljust(end - begin, b"\0"), end - begin)


def _begin(parent: int, first: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    ended.with_parent(parent, signal.SIGTERM)
    first(*arguments)
