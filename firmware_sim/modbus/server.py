"""Modbus TCP, and Modbus over TLS with client certificates: connections, limits, counters.

The header is that of pymodbus. The connections are separate code, because the server of pymodbus
answers only one of several requests in a segment, forgets long data, and hides why it cannot
listen.

- A header that cannot be Modbus closes the connection.
- A client that sends many requests takes turns with the others.
- A client that does not read its answers is not read either.
- A client that sends no request is closed after a minute.
- Units 0 and 255 are the device itself, as clients without a unit address it. The answer carries
  the unit of the request. On a serial line 0 is a broadcast, and 255 is reserved.
- If all places are taken, a connection without a request is closed for a new one; if there is none,
  the connection that has been idle longest.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, sections 3 and 4 (units 0 and 255:
4.4.1.2); MODBUS/TCP Security v2.1.
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
from rollerrig.firmware_sim.modbus.map import PLC_UNIT
from rollerrig.firmware_sim.modbus.unit import Unit
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import OnEvent
from rollerrig.wsp_interface.places import Places

# bytes before the unit: transaction number, protocol and length, two bytes each
_PREFIX_BYTES = 6
# the length in the header counts the unit and the request, which has at least a function code
SHORTEST = 2
LONGEST = 254
# over TCP these units address the device itself, without a gateway behind it
DEVICE_ITSELF = (0, 255)
FIRST_REQUEST_S = 60.0  # some clients connect when they start, and ask when their user wants it
BURST = 16  # requests answered before the other clients have their turn: less than 0.5 ms
_BUFFER_BYTES = 4096
_HANDSHAKE_S = 5.0
# a client that has vanished is noticed after about half a minute
_KEEPALIVE = (
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 15),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)


class Header(FramerSocket):
    """The header of Modbus TCP, checked as soon as its bytes have arrived."""

    def decode(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Return the number of bytes used, the unit, the transaction number and the request.

        The number of bytes is 0 while the request is not complete. Raises ValueError if the data
        cannot be Modbus.
        """
        wrong_protocol = any(data[2:4])
        length = int.from_bytes(data[4:_PREFIX_BYTES], "big")
        length_known = len(data) >= _PREFIX_BYTES
        if wrong_protocol or (length_known and not SHORTEST <= length <= LONGEST):
            raise ValueError(data[:_PREFIX_BYTES].hex())
        # without the limit, pymodbus would add a byte behind the shortest request to that request
        return super().decode(data[: _PREFIX_BYTES + length])


class Server:
    """Units behind sockets or a serial line; everything runs in the running loop.

    on_event: called as on_event(code, **fields) for clients that send nothing.
    first_request_s: how long a client may be connected before its first request.
    """

    def __init__(
        self,
        units: Mapping[int, Unit],
        counters: Counters | None = None,
        on_event: OnEvent = events.ignore,
        first_request_s: float = FIRST_REQUEST_S,
    ) -> None:
        self.units = units
        self.places = Places("Modbus", first_request_s, idle_gives_way=True, on_event=on_event)
        self.counters = counters or Counters()
        self.header = Header(pdu.DECODER)
        self.connections: set[Connection] = set()
        self._listener: asyncio.Server | None = None

    async def listen(self, host: str, port: int, context: ssl.SSLContext | None = None) -> int:
        """Accept clients at an address, and return the port. Raises BusError.

        `port`: 0 takes a free one; `context`: for TLS.
        """
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
                "may be running. Stop it, take another port with --set modbus.port=N (0: a free "
                "one), or switch Modbus off with --set modbus.enabled=false"
            ) from None
        return int(self._listener.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Close all connections and stop listening."""
        if not self._listener:
            return
        self._listener.close()
        for connection in self.connections:
            connection.transport.abort()
        # the connections are notified in the next cycle of the loop
        await asyncio.sleep(0)
        await self._listener.wait_closed()

    def answer(self, unit: int, request: bytes) -> bytes:
        """Return the answer to a request, and count it."""
        reply = pdu.answer(self.units, unit, request)
        self.counters.requests += 1
        if reply[0] >= pdu.EXCEPTION_BIT:
            self.counters.exceptions += 1
        return reply


class Connection(asyncio.BufferedProtocol):
    """One client. The streams of asyncio would take twice the time for a request.

    address: of the client's machine.
    silent: whether it has not sent a valid request yet.
    last_used_s: when it connected or last sent something, by time.monotonic().
    """

    transport: asyncio.Transport

    def __init__(self, server: Server) -> None:
        self.server = server
        self.address = ""
        self.silent = True
        self.last_used_s = time.monotonic()
        self._buffer = bytearray(_BUFFER_BYTES)
        self._received = b""  # not yet answered
        self._blocked = False  # the client does not read its answers

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        for option in _KEEPALIVE:
            transport.get_extra_info("socket").setsockopt(*option)

        peer = transport.get_extra_info("peername")
        if peer:
            self.address = peer[0]
        self.server.connections.add(self)
        self.server.places.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.server.connections.discard(self)
        self.server.places.leave(self)

    def abort(self) -> None:
        """Close the connection immediately."""
        self.transport.abort()

    def pause_writing(self) -> None:
        # the client does not read its answers, so its requests have to wait
        self._blocked = True
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        self._blocked = False
        self._serve()

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self._received += self._buffer[:nbytes]
        self.last_used_s = time.monotonic()
        self._serve()

    def _serve(self) -> None:
        """Answer the complete requests, at most a burst, and then let the other clients go on."""
        header = self.server.header
        answers = 0
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
                self.silent = False
                addressed = PLC_UNIT if unit in DEVICE_ITSELF else unit
                reply = self.server.answer(addressed, request)
                self.transport.write(header.encode(reply, unit, number))
                answers += 1
        except ValueError:
            self.server.counters.malformed += 1
            self.transport.close()
        if not self._blocked:
            self.transport.resume_reading()
