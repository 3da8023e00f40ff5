"""Modbus TCP, and Modbus over TLS with client certificates: framing, limits, counters.

Requests that come in one segment are answered one by one, in order, each with its own transaction
number. What cannot be a Modbus header closes the connection. A client that floods takes turns with
everybody else, one that does not read its answers is not read either, and when all places are
taken the connection that has been idle longest gives way. Source: MODBUS Messaging on TCP/IP
Implementation Guide V1.0b, sections 3 and 4; MODBUS/TCP Security v2.1.
"""

import asyncio
import socket
import ssl
import time
from collections.abc import Mapping
from pathlib import Path
from typing import cast

from rollerrig.configs.errors import BusError, ConfigError
from rollerrig.firmware_sim.modbus import pdu
from rollerrig.firmware_sim.modbus.pdu import Image

HEADER_BYTES = 7
# the length in the header counts the unit and the request: at least a function code
SHORTEST, LONGEST = 2, pdu.LARGEST_PDU + 1
CLIENTS_MAX = 32
BURST = 16  # requests answered before others have their turn: less than half a millisecond
_PORTION_BYTES = 4096
_HANDSHAKE_S = 5.0
# a client that has vanished is noticed after about half a minute
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 15), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))


class Counters:
    """What the server has seen."""

    def __init__(self) -> None:
        self.clients = self.requests = self.exceptions = self.malformed = self.displaced = 0


class Server:
    """Units behind sockets, or a serial line; all in the running loop."""

    def __init__(self, units: Mapping[int, Image], counters: Counters | None = None) -> None:
        self.units, self.counters = units, counters or Counters()
        self.connections: set[Connection] = set()
        self._listener: asyncio.Server | None = None

    async def listen(self, host: str, port: int, context: ssl.SSLContext | None = None) -> int:
        """Take clients at an address; returns the port (0 takes a free one). Raises BusError."""
        running = asyncio.get_running_loop()
        try:
            self._listener = await running.create_server(
                lambda: Connection(self), host, port, ssl=context, reuse_address=True,
                ssl_handshake_timeout=_HANDSHAKE_S if context else None)
        except OSError as error:
            raise BusError(
                f"Modbus: cannot listen on {host}:{port} ({error.strerror or error}); another bench "
                "may be running: stop it, take another port with --set modbus.port=N (0: a free "
                "one), or switch Modbus off with --set modbus.enabled=false") from None
        return int(self._listener.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """End all connections and listen no more."""
        if self._listener:
            self._listener.close()
        for connection in tuple(self.connections):
            connection.transport.close()
        await asyncio.sleep(0)
        if self._listener:
            for connection in tuple(self.connections):
                connection.transport.abort()
            await self._listener.wait_closed()

    def join(self, connection: "Connection") -> None:
        """A client has come; the one idle longest leaves when there are too many."""
        if len(self.connections) >= CLIENTS_MAX:
            idle = min(self.connections, key=lambda one: one.used_s)
            self.counters.displaced += 1
            self.leave(idle)
            idle.transport.abort()
        self.connections.add(connection)
        self.counters.clients = len(self.connections)

    def leave(self, connection: "Connection") -> None:
        """A client has gone."""
        self.connections.discard(connection)
        self.counters.clients = len(self.connections)

    def answer(self, unit: int, request: bytes) -> bytes:
        """The answer to a request, counted."""
        reply = pdu.answer(self.units, unit, request)
        self.counters.requests += 1
        self.counters.exceptions += pdu.is_exception(reply)
        return reply


class Connection(asyncio.BufferedProtocol):
    """One client."""

    transport: asyncio.Transport

    def __init__(self, server: Server) -> None:
        self.server = server
        self.used_s = time.monotonic()
        self._portion = bytearray(_PORTION_BYTES)
        self._received = b""
        self._blocked = self._waiting = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        line = self.transport.get_extra_info("socket")
        line.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE:
            line.setsockopt(socket.IPPROTO_TCP, option, value)
        self.server.join(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._received = b""
        self.server.leave(self)

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
        if not self._waiting and not self._blocked:
            self._serve()

    def _serve(self) -> None:
        """Answer what has come in whole, at most a burst, and then let others have their turn."""
        self._waiting = False
        if self.transport.is_closing():
            return
        data, at, answers, sound = self._received, 0, [], True
        for _ in range(BURST):
            size = adu_length(data, at)
            if size is None:
                sound = False
            if not size:
                break
            answers.append(self._answer(data[at:at + size]))
            at += size
        self._received = data[at:]
        if answers:
            self.transport.write(b"".join(answers))
        if not sound:
            self.server.counters.malformed += 1
            self.transport.close()
        elif not self._blocked:
            self._go_on(len(answers) == BURST)

    def _go_on(self, more: bool) -> None:
        if more:
            self._waiting = True
            self.transport.pause_reading()
            asyncio.get_running_loop().call_soon(self._serve)
        else:
            self.transport.resume_reading()

    def _answer(self, adu: bytes) -> bytes:
        reply = self.server.answer(adu[6], adu[HEADER_BYTES:])
        return adu[:4] + (len(reply) + 1).to_bytes(2, "big") + adu[6:7] + reply


def adu_length(data: bytes, at: int) -> int | None:
    """Bytes of the request that begins at `at`; 0: not all there; None: it cannot be one."""
    if len(data) - at >= 4 and (data[at + 2] or data[at + 3]):
        return None
    if len(data) - at < 6:
        return 0
    length = data[at + 4] << 8 | data[at + 5]
    if not SHORTEST <= length <= LONGEST:
        return None
    return 6 + length if len(data) - at >= 6 + length else 0


def tls_context(certificate: Path, key: Path, client_ca: Path) -> ssl.SSLContext:
    """TLS 1.2 or newer; a client needs a certificate that `client_ca` has signed.

    Raises ConfigError naming the file.
    """
    for name, path in (("tls_certificate", certificate), ("tls_key", key),
                       ("tls_client_ca", client_ca)):
        if not path.is_file():
            raise ConfigError(f"[modbus] {name} = '{path}': no such file; all three of "
                              "tls_certificate, tls_key and tls_client_ca are needed (PEM)")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.verify_mode = ssl.CERT_REQUIRED
    try:
        context.load_cert_chain(certificate, key)
        context.load_verify_locations(client_ca)
    except (ssl.SSLError, OSError) as error:
        raise ConfigError(f"[modbus] certificate {certificate}, key {key} or client CA {client_ca} "
                          f"cannot be used: {error}") from None
    return context
