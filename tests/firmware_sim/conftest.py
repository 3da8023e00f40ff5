"""A bus in the process: the hub, nodes on its ports, a simulated clock, a real canopen master."""

import canopen
import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import encoder406, io401
from rollerrig.firmware_sim.drive402 import drive as drive402
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

MS = 1_000_000  # ns
SDO_ABORT = 0x80  # first byte of the message
TABLE = signals.table(COACH)


class MasterOnHub(canopen.Network):
    """The network of canopen, with a port of a hub instead of a python-can bus."""

    def __init__(self, hub):
        super().__init__()
        self.port = hub.attach(self.take, "master")

    def take(self, frame):
        if not frame.remote:
            self.notify(frame.can_id, bytearray(frame.data), frame.time_ns / 1e9)

    def send_message(self, can_id, data, remote=False):
        self.port.send(Frame(can_id, b"" if remote else bytes(data), remote=remote))


class Wire:
    """The bus with all nodes on it.

    `frames`: the frames that were sent since the last `take`. `row`: the live row of signals.
    `commands`: the array that the brake I/O writes. `commands_taken`: a copy of it at each call of
    `on_command`.
    """

    def __init__(self):
        self.now_ns = 0
        self.hub = Hub(lambda: self.now_ns)
        self.hub.tap(lambda frame: self.frames.append(frame))
        self.frames = []
        self.events = []
        self.nodes = []
        self.row = np.zeros(signals.WIDTH)
        self.commands = np.zeros(io401.COMMANDS)
        self.commands_taken = []
        self.port = self.hub.attach(lambda frame: None, "tester")
        self.master = MasterOnHub(self.hub)

    def plug(self, node, start=True):
        """Put a node on the bus and switch it on; return it."""
        node.on_event = self.on_event
        port = self.hub.attach(node.on_frame, f"node {node.node_id}")
        self.nodes.append(node)
        if start:
            node.start(port.send, self.now_ns)
        return node

    def drive(self, axle=1, **more):
        return self.plug(drive402.build(axle, axle, self.row, **more))

    def encoder(self, **more):
        return self.plug(encoder406.build(TABLE, self.row, **more))

    def brake(self, **more):
        more.setdefault("on_command", lambda: self.commands_taken.append(self.commands.copy()))
        return self.plug(io401.build(TABLE, self.row, self.commands, **more))

    def send(self, can_id, data=b"", **more):
        """Send a frame from another node."""
        self.port.send(Frame(can_id, bytes(data), **more))

    def nmt(self, command, node=0):
        self.send(0, [command, node])

    def sync(self, counter=None):
        self.send(0x80, b"" if counter is None else bytes([counter]))

    def run(self, milliseconds):
        """Let simulated time pass, with a poll of every node each millisecond."""
        for _ in range(milliseconds):
            self.now_ns += MS
            for node in self.nodes:
                node.poll(self.now_ns)

    def take(self, can_id=None):
        """Return the data of the frames since the last call, of one identifier or of all."""
        taken = []
        for frame in self.frames:
            if can_id is None or frame.can_id == can_id:
                taken.append(frame.data)
        self.frames.clear()
        return taken

    def request(self, node, request):
        """Send a raw SDO request, padded to eight bytes; return the data of the answers."""
        self.frames.clear()
        self.send(0x600 + node, bytes(request).ljust(8, b"\0"))
        return self.take(0x580 + node)

    def abort_of(self, node, request):
        """Return the abort code that answers a raw SDO request."""
        (answer,) = self.request(node, request)
        assert answer[0] == SDO_ABORT, answer.hex()
        return int.from_bytes(answer[4:], "little")

    def write(self, node, index, sub, value, size):
        """Write an object by an expedited download of `size` bytes; return 0 or the abort code."""
        command = 0x23 | (4 - size) << 2
        request = bytes([command]) + index.to_bytes(2, "little") + bytes([sub])
        unsigned = value & (1 << 8 * size) - 1
        (answer,) = self.request(node, request + unsigned.to_bytes(size, "little"))
        if answer[0] == SDO_ABORT:
            return int.from_bytes(answer[4:], "little")
        return 0

    def read(self, node, index, sub=0):
        """Read an object by an expedited upload; return its bytes, or an abort code (int)."""
        request = b"\x40" + index.to_bytes(2, "little") + bytes([sub])
        (answer,) = self.request(node, request)
        if answer[0] == SDO_ABORT:
            return int.from_bytes(answer[4:], "little")
        unused = answer[0] >> 2 & 3
        return answer[4 : 8 - unused]

    def on_event(self, code, /, **fields):
        self.events.append(events.make(self.now_ns / 1e9, code, **fields))

    def reported(self, code, **fields):
        """Return the events of a code with these fields."""
        matching = []
        for event in self.events:
            if event.code == code and fields.items() <= event.fields.items():
                matching.append(event)
        return matching


@pytest.fixture
def wire():
    return Wire()
