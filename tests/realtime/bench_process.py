"""`rollerrig run` as a process of its own, with free ports, and a simple WSP unit on its bus."""

import functools
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from multiprocessing import connection, forkserver
from pathlib import Path

from rollerrig.configs.processes import ended
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.events import Code

MAGNETS, HEARTBEAT, SYNC, SPEEDS = 0x211, 0x720, 0x080, 0x190
ADDRESS = re.compile(r"socketcand://[\d.]+:\d+/rig0")
PATIENCE_S = 240.0  # a first run compiles, perhaps on a busy machine


def until(condition, what, timeout_s=PATIENCE_S):
    """Wait for a condition and return its value; a test fails where it does not come."""
    end = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {timeout_s} s for {what}"
        time.sleep(0.02)
    return found


@functools.cache
def forking():
    """A process that has loaded what a bench needs, and forks those that are started; it ends with this one."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["loaded_bench"])
    own = os.environ.copy()
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # Python 3.11 has no other way to tell it
    forkserver.ensure_running()
    os.environ.clear()
    os.environ.update(own)
    return context


class Forked:
    """`rollerrig` as a process with a session of its own, forked where `loaded_bench` is loaded; as Popen."""

    def __init__(self, words, stdout, stderr, before=int):
        for one in (stdout, stderr):
            one.write_bytes(b"")
        place = os.getcwd(), dict(os.environ), os.sched_getaffinity(0)
        self._process = forking().Process(
            target=_begin, args=(words, stdout, stderr, before, *place), daemon=True
        )
        self._process.start()
        self.pid, self._stdout, self._lock = self._process.pid, stdout, threading.Lock()

    @property
    def returncode(self):
        with self._lock:  # two threads that read it at a time would take it from one another
            return self._process.exitcode

    poll = returncode.fget

    def wait(self, timeout=None):
        connection.wait([self._process.sentinel], timeout)
        if (status := self.returncode) is None:
            raise subprocess.TimeoutExpired("rollerrig run", timeout)
        return status

    def communicate(self, timeout=None):
        self.wait(timeout)
        return self._stdout.read_text(), None

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


def _begin(words, stdout, stderr, before, folder, environment, cores):
    """Become the process: streams, session, folder, environment and cores of one that is started."""
    os.setsid()
    os.chdir(folder)
    # the process that forks may have been started by a test that is kept to one core
    os.sched_setaffinity(0, cores)
    os.environ.clear()
    os.environ.update(environment)
    for number, path, mode in (
        (0, os.devnull, os.O_RDONLY),
        (1, stdout, os.O_WRONLY),
        (2, stderr, os.O_WRONLY),
    ):
        os.dup2(os.open(path, mode | os.O_CREAT | os.O_TRUNC), number)
    ended.with_parent(os.getppid(), signal.SIGTERM)
    before()
    from rollerrig.realtime import cli

    sys.exit(cli.main(words))


class BenchProcess:
    """A run that has been started. `finish` waits for it and keeps what it said."""

    def __init__(self, out, *arguments, scenario="velim_a1", before=int):
        self.out = Path(out)
        self.said = self.out.parent / f"{self.out.name}.stderr"
        words = [
            "run",
            scenario,
            "--json",
            "--out",
            str(out),
            "--set",
            "bus.interface=hub",
            "--set",
            "bus.socketcand_port=0",
            "--set",
            "modbus.enabled=false",
            *map(str, arguments),
        ]
        self.process = Forked(words, self.out.parent / f"{self.out.name}.stdout", self.said, before)
        self.status = self.told = None

    def finish(self, timeout_s=PATIENCE_S):
        """Wait for the end; returns self."""
        try:
            stdout, _ = self.process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        self.status = self.process.returncode
        self.told = json.loads(stdout) if stdout else None
        return self

    @property
    def stderr(self):
        return self.said.read_text()

    @property
    def record(self):
        """The run's folder, read as anybody would."""
        return records.load(self.out)

    def reported(self, code, **fields):
        """The recorded events of a code with these fields."""
        return [
            event
            for event in records.events(self.out)
            if event.code == code and fields.items() <= event.fields.items()
        ]

    def address(self):
        """Where its bus is, as soon as it says so."""

        def told():
            assert self.process.poll() is None, self.stderr
            places = [event.fields["address"] for event in self.reported(Code.BUS_PLACE)]
            return ADDRESS.search(" ".join([self.stderr, *places]))

        return until(told, "the address of the bus").group()

    def runs_for(self, seconds):
        """Wait until so much simulated time is recorded."""

        def recorded():
            assert self.process.poll() is None, self.stderr
            try:
                time_s = self.record.column("time_s")
            except Exception:
                return False
            return len(time_s) and time_s[-1] >= seconds

        until(recorded, f"{seconds} s of simulated time")

    def child(self, word):
        """The process number of the child whose command line has a word."""

        def found():
            children = Path(f"/proc/{self.process.pid}/task")
            for task in children.glob("*/children"):
                for pid in task.read_text().split():
                    if word in Path(f"/proc/{pid}/cmdline").read_text().split("\0"):
                        return int(pid)
            return None

        return until(found, f"a child process '{word}'")

    def interrupt(self):
        os.kill(self.process.pid, signal.SIGINT)


def run(out, *arguments, **more):
    """A whole run."""
    return BenchProcess(out, *arguments, **more).finish()


class SimpleUnit:
    """Somebody's WSP unit: heartbeats, and answers every SYNC with what `answer(n)` gives.

    `answer` returns messages as (identifier, data), or None to be silent for ever.
    """

    def __init__(self, address, answer):
        self.bus = buses.open_client(address)
        self.answer, self.syncs, self.speeds = answer, 0, []
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        import can

        try:
            self._send(HEARTBEAT, b"\0")
            self._send(HEARTBEAT, b"\5")
            while True:
                message = self.bus.recv(0.1)
                if message is None:
                    self._send(HEARTBEAT, b"\5")
                elif message.arbitration_id == SPEEDS:
                    self.speeds.append(bytes(message.data))
                elif message.arbitration_id == SYNC:
                    self.syncs += 1
                    if self.syncs % 5 == 0:
                        self._send(HEARTBEAT, b"\5")
                    messages = self.answer(self.syncs)
                    if messages is None:
                        return
                    for identifier, data in messages:
                        self._send(identifier, data)
        except can.CanError:
            return

    def _send(self, identifier, data):
        import can

        self.bus.send(
            can.Message(arbitration_id=identifier, data=data, is_extended_id=identifier > 0x7FF)
        )

    def close(self):
        self.bus.shutdown()
        self.thread.join(5.0)
