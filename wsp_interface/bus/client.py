"""One TCP client of the hub: bytes in through its protocol's session, frames out in one write.

Frames wait in a list until the hub flushes, or longer while the socket is full. When the buffer is
full, the newest frames are dropped and counted. The client reads small portions of bytes, so one
that floods the bus does not delay the others.
"""

import asyncio
import socket
from typing import Any, Protocol, cast

from rollerrig.wsp_interface.bus.codecs import Codec
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.session import Event, Mode
from rollerrig.wsp_interface.events import Code

PORTION_BYTES = 4096  # read in one callback: about 100 frames, one millisecond of work
SOCKET_BYTES = 1 << 18  # send buffer in the kernel; a small one shows dropped frames sooner
HIGH_WATER_BYTES = 1 << 16  # the transport reports a full socket above this
ANSWERS_MAX = 64  # answers that wait for a separate segment


class Bus(Protocol):
    """The part of the hub that a client uses."""

    name: str
    buffer_bytes: int

    def join(self, client: "Client") -> bool: ...
    def warn(self, code: Code, protocol: str, **fields: Any) -> None: ...
    def leave(self, member: "Client") -> None: ...
    def submit(self, frame: Frame, sender: "Client") -> None: ...
    def flush(self) -> None: ...


class Client(asyncio.BufferedProtocol):
    """A connected program.

    codec: the name of its protocol.
    name: the protocol with the address of the program.
    listening: whether it receives frames.
    errors: whether it receives error frames as well.
    dropped: frames and answers that it has lost.
    lost: done when the connection is closed.
    """

    def __init__(self, bus: Bus, codec: str, row: Codec) -> None:
        self.codec = codec
        self.name = codec
        self.encode = row.encode
        self.listening = False
        self.errors = False
        self.dropped = 0
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._bus = bus
        self._row = row
        self._session = row.session(bus.name)
        self._portion = bytearray(PORTION_BYTES)
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0
        self._answers_waiting = 0
        self._answer_free_s = 0.0  # when the next answer may go out, by the event loop's clock
        self._hold_until_s = 0.0  # no frames before
        self._full = False  # the socket accepts no more for now
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set the options of the socket, join the bus, greet the client."""
        self._loop = asyncio.get_running_loop()
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=HIGH_WATER_BYTES)
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)
        peer = transport.get_extra_info("peername")
        if peer:
            self.name = f"{self.codec} {peer[0]}:{peer[1]}"
        if not self._bus.join(self):
            self._transport.abort()
            return
        for event in self._session.greeting:
            self._execute(event)
        self.flush()

    def get_buffer(self, sizehint: int) -> bytearray:
        """Return the buffer for the next portion; the event loop calls this."""
        return self._portion

    def buffer_updated(self, nbytes: int) -> None:
        """Execute the received portion, then write the frames of all clients."""
        for event in self._session.feed(bytes(self._portion[:nbytes])):
            self._execute(event)
        self._bus.flush()

    def pause_writing(self) -> None:
        """Keep frames in the list: the socket is full."""
        self._full = True

    def resume_writing(self) -> None:
        """Write again: the socket has room."""
        self._full = False
        self.flush()

    def connection_lost(self, error: Exception | None) -> None:
        """Leave the bus."""
        self.listening = False
        self._bus.leave(self)
        if not self.lost.done():
            self.lost.set_result(None)

    def put(self, wire: bytes) -> None:
        """Queue encoded bytes, or count them as one drop when the buffer is full."""
        if self._waiting_bytes + len(wire) > self._bus.buffer_bytes:
            self.dropped += 1
            return
        self._waiting.append(wire)
        self._waiting_bytes += len(wire)

    def flush(self) -> None:
        """Write everything that waits in one piece."""
        if not self._waiting or self._full or self._loop.time() < self._hold_until_s:
            return
        wire = b"".join(self._waiting)
        self._waiting = []
        self._waiting_bytes = 0
        self._write(wire)

    def finish(self) -> None:
        """Send what waits, then close the connection."""
        self._hold_until_s = 0.0
        self._full = False
        self.flush()
        self.listening = False
        self._transport.close()

    def abort(self) -> None:
        """Close the connection immediately."""
        self._transport.abort()

    def _execute(self, event: Event) -> None:
        """Do what an event of the session requires."""
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
            # the answer that explains the refusal may still wait
            self._loop.call_later(2 * self._row.answer_gap_s, self.finish)
        else:
            self.listening = event is Mode.LISTEN
            if self.listening and self._row.hold_s:
                # the first frame comes only after the client has read the last answer
                self._hold_until_s = max(self._loop.time(), self._answer_free_s) + self._row.hold_s
                # slightly late, so that the clock has certainly passed it
                self._loop.call_at(self._hold_until_s + 1e-4, self.flush)

    def _answer(self, wire: bytes) -> None:
        """Send an answer.

        Clients compare the result of a whole `recv` with an answer of the handshake. So each answer
        goes out in a separate segment until frames flow; after that, answers go among the frames.
        """
        if self.listening or not self._row.answer_gap_s:
            self.put(wire)
            return
        now_s = self._loop.time()
        at_s = max(now_s, self._answer_free_s)
        if at_s <= now_s:
            self._write(wire)
        elif self._answers_waiting < ANSWERS_MAX:
            self._answers_waiting += 1
            self._loop.call_at(at_s, self._send_late_answer, wire)
        else:
            self.dropped += 1
            return
        self._answer_free_s = at_s + self._row.answer_gap_s

    def _send_late_answer(self, wire: bytes) -> None:
        self._answers_waiting -= 1
        self._write(wire)

    def _write(self, wire: bytes) -> None:
        if not self._transport.is_closing():
            self._transport.write(wire)
