"""Modbus TCP, and Modbus over TLS with client certificates: connections, limits, counters.

The header is pymodbus', the connections are ours: its own server answers one of several requests in a
segment, forgets what is long and hides why it cannot listen. What cannot be a Modbus header closes the
connection. A client that floods takes turns with everybody else, one that does not read its answers is
not read either, and when all places are taken the connection that has been idle longest gives way.
Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, sections 3 and 4; MODBUS/TCP Security v2.1.
"""

import asyncio
import socket
import ssl
import time
from collections.abc import Mapping
from typing import cast

from pymodbus.framer import FramerSocket

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.modbus import pdu
from rollerrig.firmware_sim.modbus.access import Counters
from rollerrig.firmware_sim.modbus.unit import Unit

# the length in the header counts the unit and the request: at least a function code
SHORTEST, LONGEST = 2, 254
CLIENTS_MAX = 32
BURST = 16  # requests answered before others have their turn: less than half a millisecond
_PORTION_BYTES = 4096
_HANDSHAKE_S = 5.0
# a client that has vanished is noticed after about half a minute
_KEEPALIVE = (
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 15),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)


class Header(FramerSocket):
    """The header of Modbus TCP, checked as soon as it can be."""

    def decode(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Bytes used (0: not all there), unit, number and request. Raises ValueError: not Modbus."""
        length = int.from_bytes(data[4:6], "big")
        if any(data[2:4]) or (len(data) >= 6 and not SHORTEST <= length <= LONGEST):
            raise ValueError(data[:6].hex())
        # pymodbus takes a byte behind the shortest request for part of it
        return super().decode(data[: 6 + length])


class Server:
    """Units behind sockets, or a serial line; all in the running loop."""

    def __init__(self, units: Mapping[int, Unit], counters: Counters | None = None) -> None:
        self.units, self.counters = units, counters or Counters()
        self.header = Header(pdu.DECODER)
        self.connections: set[Connection] = set()
        self._listener: asyncio.Server | None = None

    async def listen(self, host: str, port: int, context: ssl.SSLContext | None = None) -> int:
        """Take clients at an address; returns the port (0 takes a free one). Raises BusError."""
        try:
            self._listener = await asyncio.get_running_loop().create_server(
                lambda: Connection(self),
                host,
                port,
                ssl=context,
                reuse_address=True,
                ssl_handshake_timeout=_HANDSHAKE_S if context else None,
            )
        except OSError as error:
            raise BusError(
                f"Modbus: cannot listen on {host}:{port} ({error.strerror or error}); another bench "
                "may be running: stop it, take another port with --set modbus.port=N (0: a free "
                "one), or switch Modbus off with --set modbus.enabled=false"
            ) from None
        return int(self._listener.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """End all connections and listen no more."""
        if self._listener:
            self._listener.close()
            for connection in self.connections:
                connection.transport.abort()
            # they hear of it in the next turn of the loop
            await asyncio.sleep(0)
            await self._listener.wait_closed()

    def answer(self, unit: int, request: bytes) -> bytes:
        """The answer to a request, counted."""
        reply = pdu.answer(self.units, unit, request)
        self.counters.requests += 1
        self.counters.exceptions += reply[0] >= pdu.EXCEPTION
        return reply


class Connection(asyncio.BufferedProtocol):
    """One client. asyncio's streams would take twice the time for a request."""

    transport: asyncio.Transport

    def __init__(self, server: Server) -> None:
        self.server = server
        self.used_s = time.monotonic()
        self._portion, self._received = bytearray(_PORTION_BYTES), b""
        self._blocked = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        for option in _KEEPALIVE:
            transport.get_extra_info("socket").setsockopt(*option)
        others = self.server.connections
        if len(others) >= CLIENTS_MAX:
            idle = min(others, key=lambda one: one.used_s)
            others.discard(idle)
            idle.transport.abort()
        others.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.server.connections.discard(self)

    def pause_writing(self) -> None:
        # its answers are not read: its requests have to wait
        self._blocked = True
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        self._blocked = False
        self._serve()

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._portion

    def buffer_updated(self, nbytes: int) -> None:
        self._received += self._portion[:nbytes]
        self.used_s = time.monotonic()
        self._serve()

    def _serve(self) -> None:
        """Answer what has come in whole, at most a burst, and then let others have their turn."""
        header, answers = self.server.header, 0
        try:
            while self._received and not (self._blocked or self.transport.is_closing()):
                used, unit, number, request = header.decode(self._received)
                if not used:
                    break
                if answers == BURST:
                    self.transport.pause_reading()
                    asyncio.get_running_loop().call_soon(self._serve)
                    return
                self._received = self._received[used:]
                self.transport.write(header.encode(self.server.answer(unit, request), unit, number))
                answers += 1
        except ValueError:
            self.server.counters.malformed += 1
            self.transport.close()
        if not self._blocked:
            self.transport.resume_reading()
