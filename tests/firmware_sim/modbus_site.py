"""A Modbus server in a thread of its own, with a rig's units behind it, and a client of raw
bytes.
"""

import asyncio
import socket
import struct
import threading
import time

import numpy as np
from pymodbus.constants import ExcCodes

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.drive402 import drive
from rollerrig.firmware_sim.modbus import map
from rollerrig.firmware_sim.modbus import unit as modbus_unit
from rollerrig.firmware_sim.modbus.map import BITS
from rollerrig.firmware_sim.modbus.pdu import RefusedError
from rollerrig.firmware_sim.modbus.rtu import SerialLine
from rollerrig.firmware_sim.modbus.server import Server
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
WORDS = map.words(TABLE)
RATED_Nm = 15000.0
HIGHEST_SPEED = 10000
# the signal that a speed sensor tells stands in register 208
MEASURED_SPEED = next(row.signal for row in WORDS if row.address == 208)


def until(condition):
    """Wait for a condition; a test fails where it does not come within a minute."""
    end_s = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.01)


class Site:
    """Unit 1 with values that are stored, units 11 to 14 with real drives; `written` in order."""

    def __init__(self, **server_options):
        self.row = np.zeros(signals.WIDTH)
        self.row[signals.column("vehicle_speed")] = 12.34
        self.row[TABLE.span(MEASURED_SPEED)] = [1.0, 2.0, 3.0, -4.0]
        self.row[TABLE.span("pulse_count")] = [70000.0, 1.0, 2.0, 2.0**32 + 5]
        self.values = {row.name: 0 for row in (*BITS, *WORDS) if not row.signal}
        self.written = []
        self.drives = [
            drive.build(node, node, self.row, {"rated_torque_Nm": RATED_Nm}, control="bus")
            for node in TABLE.drive_nodes
        ]
        for node in self.drives:
            node.start(lambda frame: None, 0)
        numbers = map.drive_units(TABLE)
        self.units = {1: self._plc()}
        for node in self.drives:
            self.units[numbers[node.node_id]] = modbus_unit.drive(node)
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, name="modbus site")
        self.thread.start()
        self.server = self.call(self._server(server_options))
        self.lines, self.clients = [], []

    def _plc(self):
        readers = {name: lambda name=name: self.values[name] for name in self.values}
        readers |= modbus_unit.signal_readers(WORDS, self.row, {"rated_torque_Nm": RATED_Nm})
        writers = {
            row.name: lambda raw, check_only, name=row.name: self._take(name, raw, check_only)
            for row in (*BITS, *WORDS)
            if row.access == "rw"
        }
        return modbus_unit.Unit((*BITS, *WORDS), readers, writers)

    def _take(self, name, raw, check_only):
        if name == "scenario" and raw == 666:
            raise RuntimeError("a writer that fails")
        if name == "speed_set_point" and raw > HIGHEST_SPEED:
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if not check_only:
            self.values[name] = raw
            self.written.append((name, raw))

    async def _server(self, options):
        return Server(self.units, **options)

    def call(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(60.0)

    def listen(self, context=None):
        self.port = self.call(self.server.listen("127.0.0.1", 0, context))
        return self.port

    def serial(self, port="pty", **more):
        async def open_line():
            line = SerialLine(self.server, port, **more)
            self.lines.append(line)
            return await line.open()

        return self.call(open_line())

    def connect(self):
        client = Client(self.port)
        self.clients.append(client)
        return client

    def close(self):
        for client in self.clients:
            client.socket.close()

        async def end():
            for line in self.lines:
                line.close()
            await self.server.close()

        self.call(end())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(60.0)
        self.loop.close()


def adu(request, unit=1, number=1, protocol=0, length=None):
    """A request with its header."""
    size = len(request) + 1 if length is None else length
    return struct.pack(">HHHB", number, protocol, size, unit) + request


class Client:
    """A blocking client that sends what it is told, right or wrong."""

    def __init__(self, port, sock=None):
        self.socket = sock or socket.create_connection(("127.0.0.1", port))
        self.socket.settimeout(60.0)

    def send(self, data):
        self.socket.sendall(data)

    def receive(self):
        """One answer: its transaction number, unit and content; None when the server has closed."""
        head = self._exactly(7)
        if head is None:
            return None
        number, protocol, length, unit = struct.unpack(">HHHB", head)
        assert protocol == 0
        return number, unit, self._exactly(length - 1)

    def ask(self, request, unit=1):
        """The content of the answer to a request."""
        self.send(adu(request, unit, 77))
        number, from_unit, reply = self.receive()
        assert (number, from_unit) == (77, unit)
        return reply

    def words(self, at, count, unit=1, function=3):
        reply = self.ask(struct.pack(">BHH", function, at, count), unit)
        assert reply[:2] == bytes((function, 2 * count)), reply.hex()
        return list(struct.unpack(f">{count}H", reply[2:]))

    def _exactly(self, size):
        data = b""
        while len(data) < size:
            try:
                part = self.socket.recv(size - len(data))
            except ConnectionResetError:
                return None
            if not part:
                return None
            data += part
        return data
