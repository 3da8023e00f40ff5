"""Processes that we start: they stop with us, even if we are killed.

Linux sends a signal to a process when the thread that has started it is gone (prctl,
PR_SET_PDEATHSIG). On other systems the processes remain. Processes that shall outlive us are
started without this: the recorder, which finishes its files, and a viewer.

A program that has loaded the packages of its children forks them (`Forked`). Otherwise each child
would load the packages again, which takes half a second.

No child imports from the working folder: a file can.py or numpy.py that lies there would run in the
place of the package (`module`, `keep_working_folder_out`).
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
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import connection
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, NamedTuple

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import parent_death

# fields of /proc/self/stat behind the name: the addresses of the beginning and the end of the
# command line
_COMMAND_LINE = slice(45, 47)
# a library with threads, which do not exist in a forked process
_THREADED = "rerun"

# time between two signals to a worker that shall stop
_INTERRUPT_AGAIN_S = 1.0

# exit status of a forked process, and of a worker without its pool
_FAILED = 1
_USER_ERROR = 2

_LONGEST_LINE = 20_000  # bytes of the last line of a log

# Python sets no folder of the program's surroundings as the first place of imports where this
# variable is not empty. The value marks that this file has set it.
_SAFE_PATH = "PYTHONSAFEPATH"
_SET_HERE = "rollerrig"

_STDIN = 0
_STDOUT = 1
_STDERR = 2


def module(name: str, *words: str) -> list[str]:
    """Return the command of a Python module of an installed package, with its arguments.

    `python -m` alone would import from the working folder first; -P prevents that.
    """
    return [sys.executable, "-P", "-m", name, *words]


def interpreter() -> str:
    """Return the path of the Python that runs this program."""
    return sys.executable


def keep_working_folder_out() -> None:
    """Make the Python programs that this process starts import nothing from the working folder.

    A program calls this when it begins. It also holds for the workers of a `pool`, and for programs
    that they start.
    """
    if not os.environ.get(_SAFE_PATH):
        os.environ[_SAFE_PATH] = _SET_HERE


def users_environment() -> dict[str, str]:
    """Return the environment for a program of the user, which may import files next to itself."""
    environment = dict(os.environ)
    if environment.get(_SAFE_PATH) == _SET_HERE:
        del environment[_SAFE_PATH]
    return environment


def command(*words: str, by: int = signal.SIGTERM) -> list[str]:
    """Return a command as a child of this process: it gets the signal `by` when this process is
    gone.
    """
    program = [sys.executable, "-IS", parent_death.__file__]
    return [*program, str(os.getpid()), str(int(by)), *words]


class Pool(ProcessPoolExecutor):
    """Worker processes that stop with this one, and immediately if the `with` block raises."""

    def __init__(self, count: int, first: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._others = set(multiprocessing.active_children())
        super().__init__(
            max_workers=count,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin_worker,
            initargs=(os.getpid(), first, arguments),
        )

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(_work, fn, *args, **kwargs)

    def stop(self) -> None:
        """Cancel the calls that wait, interrupt those that run, and wait for the end of all.

        A running call gets a KeyboardInterrupt. If it catches that, its future has its result.
        """
        workers = set(multiprocessing.active_children()) - self._others
        all_exited = threading.Event()

        def interrupt_workers() -> None:
            # repeated, because a worker that has just started has no handler yet
            while True:
                for worker in workers:
                    if not connection.wait([worker.sentinel], timeout=0.0):
                        worker.terminate()
                if all_exited.wait(_INTERRUPT_AGAIN_S):
                    return

        thread = threading.Thread(target=interrupt_workers, name="interrupt workers")
        thread.start()
        self.shutdown(wait=True, cancel_futures=True)
        all_exited.set()
        thread.join()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind:
            self.stop()
        else:
            self.shutdown(wait=True)


def pool(count: int, first: Callable[..., Any] = int, *arguments: Any) -> Pool:
    """Return worker processes that stop with this one; each calls first(*arguments) at its
    start.
    """
    return Pool(count, first, arguments)


class _Worker:
    """The state of this process as a worker of a pool."""

    parent = 0  # the process that has the pool
    works = False  # a call runs
    stopped = False  # a signal has ended the work


def _begin_worker(parent: int, first: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    _Worker.parent = parent
    # on a terminal, Ctrl-C also reaches the workers
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop_working)
    parent_death.signal_at_parent_death(parent, signal.SIGTERM)
    first(*arguments)


def _stop_working(number: int, frame: FrameType | None) -> None:
    """Interrupt the running call, once. A worker without a call waits for the end of its pool."""
    first_signal = not _Worker.stopped
    _Worker.stopped = True
    if not _Worker.works:
        # Linux sends a signal for each thread of a parent that dies, and only the last one comes
        # when the parent is gone
        _exit_if_orphaned()
    elif first_signal:
        raise KeyboardInterrupt


def _work(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return the result of a call. Raises KeyboardInterrupt if the work has ended."""
    _Worker.works = True
    try:
        if _Worker.stopped:
            raise KeyboardInterrupt
        return function(*arguments, **named)
    finally:
        _Worker.works = False
        if _Worker.stopped:
            _exit_if_orphaned()


def _exit_if_orphaned() -> None:
    """Exit if the process with the pool is gone, because nobody would end this process."""
    if os.getppid() != _Worker.parent:
        os._exit(_FAILED)


def last_line(log: Path) -> str:
    """Return the last line that is not empty in the log of a process, or an empty string."""
    return last_lines(log, 1)


def last_lines(log: Path, most: int) -> str:
    """Return the last lines that are not empty in the log of a process, in one line of text.

    They are separated by " | ". The text is empty if there are none.
    """
    lines = _end_of(log)
    written = [line if most == 1 else line.strip() for line in lines if line.strip()]
    return " | ".join(written[-most:])


def last_message(log: Path, program: str) -> str:
    """Return the last line of a log that begins with the name of a program of this project.

    Libraries that the program has loaded may print more lines after it. Without such a line it is
    the last line.
    """
    messages = [line for line in _end_of(log) if line.startswith(f"{program}: ")]
    return messages[-1] if messages else last_line(log)


def _end_of(log: Path) -> list[str]:
    """Return the lines at the end of a log: it may be long."""
    with open(log, "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _LONGEST_LINE))
        return file.read(_LONGEST_LINE).decode("utf-8", errors="replace").splitlines()


def last_words(log: Path) -> str:
    """Return the last line of a log as the end of a sentence; empty where there is none."""
    line = last_line(log)
    return f"; its last words: {line}" if line else ""


def can_fork() -> bool:
    """Return whether this process may fork: on Linux, with one thread and no library with
    threads.
    """
    return (
        sys.platform == "linux" and threading.active_count() == 1 and _THREADED not in sys.modules
    )


class _Child(NamedTuple):
    """What a forked process needs for its start."""

    words: Sequence[str]
    then: Callable[[], int]
    input_end: int  # file descriptor of the pipe that becomes its standard input
    # the process whose death sends it a signal, and the signal; None: no signal
    parent_signal: tuple[int, int] | None
    quiet: bool
    to_close: Sequence[int]  # file descriptors


class Forked(subprocess.Popen[bytes]):
    """A copy of this process, which calls `then` and exits with its result as the status.

    `words` become the command line of the copy, so that a list of processes shows its purpose. Its
    standard input is a pipe, its output is discarded, with `quiet` its errors too. It is the leader
    of a new session. With `by` it gets this signal when this process is gone. It closes the inputs
    of `others`.
    """

    def __init__(
        self,
        words: Sequence[str],
        then: Callable[[], int],
        by: int = 0,
        quiet: bool = False,
        others: Sequence[subprocess.Popen[bytes]] = (),
    ) -> None:
        # the attributes of a Popen with a running child
        self.args = words
        self.stdout = None
        self.stderr = None
        self.returncode = None
        self._waitpid_lock = threading.Lock()
        self._child_created = True
        self._sigint_wait_secs = 0.25

        input_end, our_end = os.pipe()
        parent = os.getpid()
        # otherwise both processes would write what is in the buffers
        sys.stdout.flush()
        sys.stderr.flush()
        gc.freeze()  # memory that is never collected is not copied
        self.pid = os.fork()
        if not self.pid:
            to_close = [our_end, *(other.stdin.fileno() for other in others if other.stdin)]
            parent_signal = (parent, by) if by else None
            _live(_Child(words, then, input_end, parent_signal, quiet, to_close))
        os.close(input_end)
        self.stdin = open(our_end, "wb")  # noqa: SIM115


def _live(child: _Child) -> None:
    """The life of a forked process; it never returns."""
    status = _FAILED
    try:
        os.setsid()
        if child.parent_signal:
            parent_death.signal_at_parent_death(*child.parent_signal)
        _connect(child)
        _write_command_line(child.words)
        status = child.then()
    except RollerrigError as error:
        print(f"{' '.join(child.words)}: {error}", file=sys.stderr)
        status = _USER_ERROR
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        # without the clean-up of the parent, which this process has inherited
        os._exit(status)


def _connect(child: _Child) -> None:
    """Connect standard input, output and errors of a forked process."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(child.input_end, _STDIN)
    os.dup2(nowhere, _STDOUT)
    if child.quiet:
        os.dup2(nowhere, _STDERR)
    _close((child.input_end, nowhere, *child.to_close))
    sys.stdin = open(_STDIN)  # noqa: SIM115
    sys.stdout = open(_STDOUT, "w")  # noqa: SIM115
    sys.stderr = open(_STDERR, "w", buffering=1)  # noqa: SIM115


def _close(descriptors: Iterable[int]) -> None:
    for descriptor in descriptors:
        os.close(descriptor)


def _write_command_line(words: Sequence[str]) -> None:
    """Write a command line over the one of the parent, as far as there is room."""
    with open("/proc/self/stat", encoding="ascii") as file:
        # the name of the process may contain spaces, so the fields count from its closing bracket
        fields = file.read().rpartition(")")[2].split()
    begin, end = map(int, fields[_COMMAND_LINE])
    text = "\0".join(words).encode()[: end - begin - 1]
    ctypes.memmove(begin, text.ljust(end - begin, b"\0"), end - begin)
