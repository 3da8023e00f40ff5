"""A bus in the process: the hub, nodes on its ports, a simulated clock, a real canopen master."""

import canopen
import numpy as np
import pytest

from rollerrig.firmware_sim import encoder406, io401
from rollerrig.firmware_sim.drive402 import drive as drive402
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

MS = 1_000_000


class MasterOnHub(canopen.Network):
    """canopen's own network, with a hub's port in the place of a python-can bus."""

    def __init__(self, hub):
        super().__init__()
        self.port = hub.attach(self.take, "master")

    def take(self, frame):
        if not frame.remote:
            self.notify(frame.can_id, bytearray(frame.data), frame.time_ns / 1e9)

    def send_message(self, can_id, data, remote=False):
        self.port.send(Frame(can_id, b"" if remote else bytes(data), remote=remote))


class Wire:
    """The bus with everything on it. `frames`: all that was sent since the last `take`."""

    def __init__(self):
        self.now_ns = 0
        self.hub = Hub(lambda: self.now_ns)
        self.hub.tap(lambda frame: self.frames.append(frame))
        self.frames, self.events, self.nodes = [], [], []
        self.row = np.zeros(len(signals.COLUMNS))
        self.commands = np.zeros(io401.COMMANDS)
        self.told = []
        self.port = self.hub.attach(lambda frame: None, "tester")
        self.master = MasterOnHub(self.hub)

    def plug(self, node, start=True):
        node.on_event = self.on_event
        port = self.hub.attach(node.on_frame, f"node {node.node_id}")
        self.nodes.append(node)
        if start:
            node.start(port.send, self.now_ns)
        return node

    def drive(self, axle=1, **more):
        return self.plug(drive402.build(axle, axle, self.row, **more))

    def encoder(self, **more):
        return self.plug(encoder406.build(self.row, **more))

    def brake(self, **more):
        more.setdefault("on_command", lambda: self.told.append(self.commands.copy()))
        return self.plug(io401.build(self.row, self.commands, **more))

    def send(self, can_id, data=b"", **more):
        self.port.send(Frame(can_id, bytes(data), **more))

    def nmt(self, command, node=0):
        self.send(0, [command, node])

    def sync(self, counter=None):
        self.send(0x80, b"" if counter is None else bytes([counter]))

    def run(self, milliseconds):
        for _ in range(milliseconds):
            self.now_ns += MS
            for node in self.nodes:
                node.poll(self.now_ns)

    def take(self, can_id=None):
        """Data of the frames since the last call, of one identifier or all."""
        found = [one.data for one in self.frames if can_id is None or one.can_id == can_id]
        self.frames.clear()
        return found

    def ask(self, node, request):
        """Send a raw SDO request of eight bytes; the answers' data."""
        self.frames.clear()
        self.send(0x600 + node, bytes(request).ljust(8, b"\0"))
        return self.take(0x580 + node)

    def abort_of(self, node, request):
        """The abort code that a raw request gets."""
        (answer,) = self.ask(node, request)
        assert answer[0] == 0x80, answer.hex()
        return int.from_bytes(answer[4:], "little")

    def write(self, node, index, sub, value, size):
        """Expedited download; 0, or the abort code."""
        head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([sub])
        (answer,) = self.ask(node, head + (value & (1 << 8 * size) - 1).to_bytes(size, "little"))
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    def read(self, node, index, sub=0):
        """Expedited upload; bytes, or the abort code as a number."""
        (answer,) = self.ask(node, b"\x40" + index.to_bytes(2, "little") + bytes([sub]))
        if answer[0] == 0x80:
            return int.from_bytes(answer[4:], "little")
        return answer[4 : 8 - (answer[0] >> 2 & 3)]

    def on_event(self, code, /, **fields):
        self.events.append(events.make(self.now_ns / 1e9, code, **fields))

    def reported(self, code, **fields):
        """The events of a code with these fields."""
        return [
            one for one in self.events if one.code == code and fields.items() <= one.fields.items()
        ]


@pytest.fixture
def wire():
    return Wire()
