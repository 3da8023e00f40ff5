"""Programs in separate processes, forked where rollerrig is loaded already (`fork_server.py`).

Nearly all tests that need a process start it here, because a start by hand costs seconds of
processor time. `test_program.py` shows that both are the same.
"""

import functools
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

# s. The program compiles its kernels where nothing has used them before.
LONGEST_S = 900
POLL_S = 0.01
CLI = ("-m", "rollerrig.realtime.cli")
SERVER = Path(__file__).with_name("fork_server.py")
# a tram with motors and magnets
BOTH_BRAKES = str(Path(__file__).with_name("data") / "both_brakes.toml")


class Program:
    """A Python program in a new session; used like Popen.

    `words` follow `python`: a module ("-m", "rollerrig.realtime.cli", ...) or a text ("-c", ...).
    `variables` are added to the environment. `streams` are standard input, output and error.
    `ignored` are signals that the program ignores.
    """

    def __init__(self, words, streams, variables=None, folder=None, ignored=(), cores=None):
        environment = os.environ | (variables or {})
        request = {
            "words": list(map(str, words)),
            "environment": environment,
            "folder": str(folder or os.getcwd()),
            "ignored": list(ignored),
            "cores": sorted(cores or os.sched_getaffinity(0)),
        }
        replies, reply = os.pipe()
        descriptors = [*(stream.fileno() for stream in streams), reply]
        socket.send_fds(server(), [json.dumps(request).encode()], descriptors)
        os.close(reply)
        self._replies = open(replies)  # noqa: SIM115
        number = self._replies.readline()
        assert number, "the fork server has exited"
        self.pid = int(number)
        self._status = None
        # if two threads read the status simultaneously, only one of them would receive it
        self._lock = threading.Lock()

    def poll(self):
        with self._lock, selectors.DefaultSelector() as selector:
            if self._status is None:
                selector.register(self._replies, selectors.EVENT_READ)
                if selector.select(0.0):
                    # no status comes from a server that was killed, and its programs with it
                    self._status = int(self._replies.readline() or -signal.SIGKILL)
                    self._replies.close()
            return self._status

    returncode = property(poll)

    def wait(self, timeout=None):
        """Wait for the end; meanwhile other threads may poll."""
        begin_s = time.monotonic()
        while self.poll() is None:
            if timeout is not None and time.monotonic() - begin_s > timeout:
                raise subprocess.TimeoutExpired("the program", timeout)
            time.sleep(POLL_S)
        return self._status

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)


@functools.cache
def server():
    """The socket of the server, which is started when it is needed."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        subprocess.Popen(
            # the programs that benches fork write their command lines over this one
            [sys.executable, SERVER, str(theirs.fileno()), "forks the programs of tests"],
            pass_fds=(theirs.fileno(),),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    return ours


class Done(NamedTuple):
    """The result of a program: its exit status, what it has printed, and its messages."""

    status: int
    printed: str
    messages: str


def python(*words, folder=None, timeout_s=LONGEST_S, **variables):
    """Return the result of a Python program; `words` follow `python`."""
    with (
        open(os.devnull) as nothing,
        tempfile.TemporaryFile("w+") as printed,
        tempfile.TemporaryFile("w+") as messages,
    ):
        program = Program(words, (nothing, printed, messages), variables, folder)
        try:
            program.wait(timeout_s)
        finally:
            program.kill()
        printed.seek(0)
        messages.seek(0)
        return Done(program.returncode, printed.read(), messages.read())


def rollerrig(*words, **more):
    """Return the result of the command line `rollerrig`."""
    return python(*CLI, *words, **more)


def start(words, stdout, stderr, **more):
    """Start the command line `rollerrig` with its output in two files; return the program."""
    with open(os.devnull) as nothing, stdout.open("wb") as printed, stderr.open("wb") as messages:
        streams = (nothing, printed, messages)
        return Program((*CLI, *words), streams, **more)
