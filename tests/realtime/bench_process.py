"""`rollerrig run` as a separate process with free ports, and a simple WSP unit on its bus."""

import json
import os
import re
import signal
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import program

from rollerrig.realtime.record import records
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.events import Code

# identifiers of the unit's bus
MAGNETS = 0x211
HEARTBEAT = 0x720
SYNC = 0x080
SPEEDS = 0x190
ADDRESS = re.compile(r"socketcand://[\d.]+:\d+/rig0")
# arguments of a stop on leaves
ON_LEAVES = ("--set", "adhesion=leaf_film", "--set", "initial_speed_m_s=20")
PATIENCE_S = 240.0  # a first run compiles, perhaps on a busy machine


def until(condition, what, timeout_s=PATIENCE_S, pause_s=0.02):
    """Wait until a condition is true and return its value; the test fails after the time-out."""
    end = time.monotonic() + timeout_s
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < end, f"waited {timeout_s} s for {what}"
        time.sleep(pause_s)


class BenchProcess:
    """A run that has been started.

    `finish` waits for it; then `status` is its exit status, and `result` what it printed as JSON.
    """

    def __init__(self, out, *arguments, scenario="velim_a1", **more):
        self.out = Path(out)
        self.stderr_path = self.out.parent / f"{self.out.name}.stderr"
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
        self.stdout_path = self.out.parent / f"{self.out.name}.stdout"
        self.process = program.start(words, self.stdout_path, self.stderr_path, **more)
        self.status = None
        self.result = None
        self._record = None

    def finish(self, timeout_s=PATIENCE_S):
        """Wait for the end of the run; return self."""
        try:
            self.status = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        printed = self.stdout_path.read_text()
        self.result = json.loads(printed) if printed else None
        return self

    @property
    def stderr(self):
        return self.stderr_path.read_text()

    @property
    def record(self):
        """The record in the run's folder; that of a finished run is read once."""
        if self.status is None:
            return records.load(self.out)
        if self._record is None:
            self._record = records.load(self.out)
        return self._record

    def reported(self, code, **fields):
        """The recorded events of a code with these fields."""
        return [
            event
            for event in records.events(self.out)
            if event.code == code and fields.items() <= event.fields.items()
        ]

    def address(self):
        """The address of its bus, as soon as the run reports it."""

        def found():
            assert self.process.poll() is None, self.stderr
            places = [event.fields["address"] for event in self.reported(Code.BUS_PLACE)]
            return ADDRESS.search(" ".join([self.stderr, *places]))

        return until(found, "the address of the bus").group()

    def runs_for(self, seconds):
        """Wait until this simulated time is recorded."""

        def recorded():
            assert self.process.poll() is None, self.stderr
            try:
                time_s = self.record.column("time_s")
            except Exception:
                return False
            return len(time_s) and time_s[-1] >= seconds

        # each look reads the whole record
        until(recorded, f"{seconds} s of simulated time", pause_s=0.1)

    def child(self, word):
        """The process number of the child whose command line has a word."""

        def found():
            tasks = Path(f"/proc/{self.process.pid}/task")
            for children in tasks.glob("*/children"):
                for pid in children.read_text().split():
                    command = Path(f"/proc/{pid}/cmdline").read_text()
                    if word in command.split("\0"):
                        return int(pid)
            return None

        return until(found, f"a child process '{word}'")

    def interrupt(self):
        os.kill(self.process.pid, signal.SIGINT)


def run(out, *arguments, **more):
    """Run the bench from start to end; return it."""
    return BenchProcess(out, *arguments, **more).finish()


def assert_same_channels(run, longer_run):
    """Check that all channels of a run are equal to those of the beginning of a longer one."""
    for name in run.record.table.column_names:
        values = run.record.column(name)
        expected = longer_run.record.column(name)[: len(values)]
        np.testing.assert_array_equal(values, expected, err_msg=name)


class SimpleUnit:
    """An outside WSP unit that sends heartbeats, and answers SYNC number n with `answer(n)`.

    `answer` returns messages as (identifier, data), or None to be silent from then on.
    """

    def __init__(self, address, answer):
        self.bus = buses.open_client(address)
        self.answer = answer
        self.syncs = 0
        self.speeds = []
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        import can

        try:
            self._send(HEARTBEAT, b"\0")  # boot-up
            self._send(HEARTBEAT, b"\5")  # OPERATIONAL
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
