"""One TCP client of the hub: bytes in through its protocol's session, frames out in one write.

Frames wait in a list until the hub flushes, or longer while the socket is full; when more wait than
the buffer may hold, the newest are dropped and counted. Received bytes are taken in small portions,
so that a client that floods the bus takes turns with everybody else.
"""

import asyncio
import socket
from typing import Any, Protocol, cast

from rollerrig.wsp_interface.bus.codecs import Codec
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.session import Event, Mode
from rollerrig.wsp_interface.events import Code

PORTION_BYTES = 4096  # about 100 frames, one millisecond of work
SOCKET_BYTES = 1 << 18  # what the kernel may hold: less means drops are seen sooner
HIGH_WATER_BYTES = 1 << 16
ANSWERS_MAX = 64  # that wait for their own segment


class Bus(Protocol):
    """What a client needs of the hub."""

    name: str
    buffer_bytes: int

    def join(self, client: "Client") -> bool: ...
    def warn(self, code: Code, protocol: str, **fields: Any) -> None: ...
    def leave(self, member: "Client") -> None: ...
    def submit(self, frame: Frame, sender: "Client") -> None: ...
    def flush(self) -> None: ...


class Client(asyncio.BufferedProtocol):
    """A connected program; `codec` is the name of its protocol."""

    def __init__(self, bus: Bus, codec: str, row: Codec) -> None:
        self.codec = self.name = codec
        self.encode = row.encode
        self.listening = False  # gets frames
        self.errors = False  # gets error frames as well
        self.dropped = 0
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._bus = bus
        self._row = row
        self._session = row.session(bus.name)
        self._portion = bytearray(PORTION_BYTES)
        self._waiting: list[bytes] = []
        self._waiting_bytes = self._answers_waiting = 0
        self._answer_free_s = self._hold_until_s = 0.0
        self._full = False  # the socket takes no more for now
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Tune the socket, greet the client, join the bus."""
        self._loop = asyncio.get_running_loop()
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=HIGH_WATER_BYTES)
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)
        peer = transport.get_extra_info("peername")
        self.name = f"{self.codec} {peer[0]}:{peer[1]}" if peer else self.codec
        if not self._bus.join(self):
            self._transport.abort()
            return
        for event in self._session.greeting:
            self._follow(event)
        self.flush()

    def get_buffer(self, sizehint: int) -> bytearray:
        """Lend the event loop the buffer for the next portion."""
        return self._portion

    def buffer_updated(self, nbytes: int) -> None:
        """Follow what the portion says, then let everybody's frames out."""
        for event in self._session.feed(bytes(self._portion[:nbytes])):
            self._follow(event)
        self._bus.flush()

    def pause_writing(self) -> None:
        """Keep frames here: the socket is full."""
        self._full = True

    def resume_writing(self) -> None:
        """Write on: the socket has room again."""
        self._full = False
        self.flush()

    def connection_lost(self, error: Exception | None) -> None:
        """Leave the bus."""
        self.listening = False
        self._bus.leave(self)
        if not self.lost.done():
            self.lost.set_result(None)

    def put(self, wire: bytes) -> None:
        """Queue what is encoded, or count it as dropped when too much waits."""
        if self._waiting_bytes + len(wire) > self._bus.buffer_bytes:
            self.dropped += 1
            return
        self._waiting.append(wire)
        self._waiting_bytes += len(wire)

    def flush(self) -> None:
        """Write all that waits in one piece."""
        if self._waiting and not self._full and self._loop.time() >= self._hold_until_s:
            wire = b"".join(self._waiting)
            self._waiting, self._waiting_bytes = [], 0
            self._write(wire)

    def finish(self) -> None:
        """Send what waits, then close."""
        self._hold_until_s, self._full = 0.0, False
        self.flush()
        self.listening = False
        self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        self._transport.abort()

    def _follow(self, event: Event) -> None:
        if isinstance(event, Frame):
            self._bus.submit(event, self)
        elif isinstance(event, bytes):
            self._answer(event)
        elif event is Mode.ERRORS:
            self.errors = True
        elif event is Mode.FOREIGN:
            self._bus.warn(Code.HUB_FOREIGN_CLIENT, self.codec)
            self.finish()
        elif event is Mode.CLOSE:
            # a refusal may still wait for its turn
            self._loop.call_later(2 * self._row.answer_gap_s, self.finish)
        else:
            self.listening = event is Mode.LISTEN
            if self.listening and self._row.hold_s:
                # the first frame comes only after the client has read the last answer
                self._hold_until_s = max(self._loop.time(), self._answer_free_s) + self._row.hold_s
                # a little late, so that the clock has certainly passed
                self._loop.call_at(self._hold_until_s + 1e-4, self.flush)

    def _answer(self, wire: bytes) -> None:
        """Send an answer in a segment of its own, as clients compare a whole `recv`; among frames once they flow."""
        if self.listening or not self._row.answer_gap_s:
            self.put(wire)
            return
        now_s = self._loop.time()
        at_s = max(now_s, self._answer_free_s)
        if at_s <= now_s:
            self._write(wire)
        elif self._answers_waiting < ANSWERS_MAX:
            self._answers_waiting += 1
            self._loop.call_at(at_s, self._late_answer, wire)
        else:
            self.dropped += 1
            return
        self._answer_free_s = at_s + self._row.answer_gap_s

    def _late_answer(self, wire: bytes) -> None:
        self._answers_waiting -= 1
        self._write(wire)

    def _write(self, wire: bytes) -> None:
        if not self._transport.is_closing():
            self._transport.write(wire)
