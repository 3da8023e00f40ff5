"""One TCP client of the hub.

The session of its protocol turns received bytes into frames for the bus. Frames of the bus wait in
a list, as encoded bytes, until the hub flushes; then they go out in one write. They wait longer
while the socket is full. When the list has reached the hub's limit, the newest frames are dropped
and counted. Bytes are read in small portions, so a client that floods the bus does not delay the
others.
"""

import asyncio
import socket
import time
from typing import Any, Protocol, cast

from rollerrig.wsp_interface.bus.codecs import Codec
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.session import Event, Mode
from rollerrig.wsp_interface.events import Code

PORTION_BYTES = 4096  # read in one callback: about 100 frames, one millisecond of work
# Send buffer in the kernel. With a small one the hub notices sooner that a client does not read.
SOCKET_BYTES = 1 << 18
HIGH_WATER_BYTES = 1 << 16  # the transport reports a full socket above this
ANSWERS_MAX = 64  # answers of a handshake that may wait; further ones are dropped
# A timer may fire slightly before its time, and `flush` would then do nothing.
TIMER_MARGIN_S = 1e-4


class Bus(Protocol):
    """The part of the hub that a client uses."""

    name: str
    names: tuple[str, ...]
    buffer_bytes: int

    def join(self, client: "Client") -> bool: ...
    def warn(self, code: Code, protocol: str, **fields: Any) -> None: ...
    def leave(self, member: "Client") -> None: ...
    def submit(self, frame: Frame, sender: "Client") -> None: ...
    def flush(self) -> None: ...


class Client(asyncio.BufferedProtocol):
    """A connected program.

    protocol: the name of its protocol.
    name: the protocol with the address of the program.
    encode: the encoder of its protocol.
    listening: whether it receives frames.
    errors: whether it receives error frames as well.
    dropped: frames and answers that it has lost.
    lost: done when the connection is closed.
    address: of the program's machine.
    last_used_s: when it connected, by time.monotonic().
    """

    def __init__(self, bus: Bus, protocol: str, codec: Codec) -> None:
        self.protocol = protocol
        self.name = protocol
        self.encode = codec.encode
        self.listening = False
        self.errors = False
        self.dropped = 0
        self.address = ""
        self.last_used_s = time.monotonic()
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._bus = bus
        self._codec = codec
        self._session = codec.session(*bus.names)
        self._portion = bytearray(PORTION_BYTES)
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0
        self._answers_waiting = 0
        self._answer_free_s = 0.0  # when the next answer may go out, by the event loop's clock
        self._hold_until_s = 0.0  # no frames go out before this time
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
            self.address = peer[0]
            self.name = f"{self.protocol} {peer[0]}:{peer[1]}"
        if not self._bus.join(self):
            self._transport.abort()
            return
        for event in self._session.greeting:
            self._execute(event)
        self.flush()

    @property
    def silent(self) -> bool:
        """Whether the client has not sent a valid message yet."""
        return not self._session.has_spoken

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
            self._bus.warn(Code.HUB_FOREIGN_CLIENT, self.protocol)
            self.finish()
        elif event is Mode.CLOSE:
            # the answer that explains the refusal may still wait for its gap, so close later
            self._loop.call_later(2 * self._codec.answer_gap_s, self.finish)
        elif event is Mode.MUTE:
            self.listening = False
        elif event is Mode.LISTEN:
            self.listening = True
            self._hold_frames()

    def _hold_frames(self) -> None:
        """Hold frames until the client has read the last answer of the handshake."""
        hold_s = self._codec.hold_s
        if hold_s:
            self._hold_until_s = max(self._loop.time(), self._answer_free_s) + hold_s
            self._loop.call_at(self._hold_until_s + TIMER_MARGIN_S, self.flush)

    def _answer(self, wire: bytes) -> None:
        """Send an answer.

        Clients of a protocol with an `answer_gap_s` compare the result of a whole `recv` with one
        answer of the handshake. So each answer goes out alone, a gap after the one before, until
        the client receives frames. From then on answers wait in the list among the frames.
        """
        gap_s = self._codec.answer_gap_s
        if self.listening or not gap_s:
            self.put(wire)
            return

        now_s = self._loop.time()
        if self._answer_free_s <= now_s:
            self._write(wire)
            self._answer_free_s = now_s + gap_s
            return

        if self._answers_waiting >= ANSWERS_MAX:
            self.dropped += 1
            return
        self._answers_waiting += 1
        self._loop.call_at(self._answer_free_s, self._send_late_answer, wire)
        self._answer_free_s += gap_s

    def _send_late_answer(self, wire: bytes) -> None:
        self._answers_waiting -= 1
        self._write(wire)

    def _write(self, wire: bytes) -> None:
        if not self._transport.is_closing():
            self._transport.write(wire)
