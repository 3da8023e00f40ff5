"""Modbus RTU on a serial port or a pseudo-terminal: framing by length and checksum, and by silence.

Checksums are pymodbus'. Its framer drops what follows a frame and its transport needs pyserial; here
a frame is whole when its function tells its length and the checksum fits, and the line is an asyncio
pipe. Whatever else comes is thrown away at the next silence, unless it is a sound frame of a function
that this device has not: that is answered. Other units on the line are let be, and unit 0 is
everybody: it is obeyed and not answered. Source: MODBUS over Serial Line V1.02, section 2.
"""

import asyncio
import contextlib
import os
import termios
import tty

from pymodbus.framer import FramerRTU

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.modbus import pdu
from rollerrig.firmware_sim.modbus.server import Server
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import Code, OnEvent

BROADCAST = 0
LARGEST_FRAME = 256
PSEUDO = "pty"
# silence that ends a frame: 3.5 characters, but no less than serial adapters pause inside a frame
CHARACTERS, SILENCE_MIN_S = 3.5, 0.02
_BITS_PER_CHARACTER = 11
_UNSENT_BYTES = 1024
_REOPEN_S = 1.0


class Frame(FramerRTU):
    """A frame with its checksum, and not a byte of what follows it."""

    def decode(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Bytes used (0: no whole sound request), unit, 0 and request."""
        kind = self.decoder.lookupPduClass(data) if len(data) >= self.MIN_SIZE else None
        size = kind.calculateRtuFrameSize(data) if kind else 0
        return self.sound(data[:size]) if size <= len(data) else (0, 0, 0, b"")

    def sound(self, frame: bytes) -> tuple[int, int, int, bytes]:
        """As `decode`, of bytes that the silence has ended."""
        whole = self.MIN_SIZE <= len(frame) <= LARGEST_FRAME and self.check_CRC(
            frame[:-2], int.from_bytes(frame[-2:], "big")
        )
        return (len(frame), frame[0], 0, frame[1:-2]) if whole else (0, 0, 0, b"")


class SerialLine(asyncio.Protocol):
    """A server's units on a serial line; all in the running loop.

    `port` is a device, or "pty" for a new pseudo-terminal; `on_event(code, **fields)` hears when the
    line is lost and when it is back.
    """

    def __init__(
        self,
        server: Server,
        port: str,
        baud_rate: int = 19200,
        parity: str = "even",
        on_event: OnEvent = events.ignore,
    ) -> None:
        self.server, self.port, self.on_event = server, port, on_event
        self.baud_rate, self.parity = baud_rate, parity
        self.silence_s = max(CHARACTERS * _BITS_PER_CHARACTER / baud_rate, SILENCE_MIN_S)
        self._frame = Frame(pdu.DECODER)
        self._received = b""
        self._ends: tuple[asyncio.ReadTransport, asyncio.WriteTransport] | None = None
        self._other = -1
        self._quiet: asyncio.TimerHandle | None = None
        self._reopening: asyncio.Task[None] | None = None

    async def open(self) -> str:
        """Open the line; returns the device that a client opens. Raises BusError."""
        running = asyncio.get_running_loop()
        try:
            name, line = self._open()
            reading, _ = await running.connect_read_pipe(lambda: self, os.fdopen(line, "rb", 0))
            writing, _ = await running.connect_write_pipe(
                asyncio.Protocol, os.fdopen(os.dup(line), "wb", 0)
            )
        except (OSError, termios.error) as error:
            reason = error.args[-1] if error.args else error
            raise BusError(
                f"[modbus] serial = '{self.port}' at {self.baud_rate} baud: {reason}; "
                'give a serial device, "pty", or "" for none'
            ) from None
        self._ends = reading, writing
        return name

    def _open(self) -> tuple[str, int]:
        if self.port == PSEUDO:
            line, self._other = os.openpty()
            # the other side stays open here, else the line would hang up between two clients
            tty.setraw(self._other)
            return os.ttyname(self._other), line
        line = os.open(self.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            _set_up(line, self.baud_rate, self.parity)
        except BaseException:
            os.close(line)
            raise
        return self.port, line

    def close(self) -> None:
        """Let the line go."""
        for waiting in (self._quiet, self._reopening):
            if waiting:
                waiting.cancel()
        if self._ends:
            self._ends[0].close()
            self._ends[1].abort()
            self._ends = None
        if self._other >= 0:
            os.close(self._other)
            self._other = -1

    def data_received(self, data: bytes) -> None:
        if self._quiet:
            self._quiet.cancel()
        self._received += data
        while self._obey(*self._frame.decode(self._received)):
            pass
        if self._received:
            self._quiet = asyncio.get_running_loop().call_later(self.silence_s, self._on_silence)
            # more than any frame: only its end is still of interest
            self._received = self._received[-LARGEST_FRAME - 1 :]

    def _on_silence(self) -> None:
        self.server.counters.malformed += not self._obey(*self._frame.sound(self._received))
        self._received = b""

    def _obey(self, used: int, unit: int, _: int, request: bytes) -> bool:
        """Take a frame from what has come, and answer it; False if there is none."""
        self._received = self._received[used:]
        if used and unit == BROADCAST:
            for one in self.server.units if request[0] in pdu.WRITES else ():
                self.server.answer(one, request)
        elif used and unit in self.server.units and request[0] < pdu.EXCEPTION and self._ends:
            reply = self._frame.encode(self.server.answer(unit, request), unit, 0)
            # what a client does not read is lost, as on a wire
            if self._ends[1].get_write_buffer_size() + len(reply) <= _UNSENT_BYTES:
                self._ends[1].write(reply)
        return bool(used)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._ends:
            self.close()
            self.on_event(Code.MODBUS_SERIAL_LOST, device=self.port)
            self._reopening = asyncio.get_running_loop().create_task(self._reopen())

    async def _reopen(self) -> None:
        while self._ends is None:
            await asyncio.sleep(_REOPEN_S)
            with contextlib.suppress(BusError):
                await self.open()
        self.on_event(Code.MODBUS_SERIAL_BACK, device=self.port)


def _set_up(line: int, baud_rate: int, parity: str) -> None:
    """Raw bytes, eight data bits; two stop bits where there is no parity, as the standard wants."""
    speed = getattr(termios, f"B{baud_rate}", None)
    if speed is None:
        raise OSError(f"no such baud rate: {baud_rate}")
    tty.setraw(line)
    mode = termios.tcgetattr(line)
    mode[2] &= ~(termios.PARENB | termios.PARODD | termios.CSTOPB | termios.CRTSCTS)
    mode[2] |= termios.CLOCAL | termios.CREAD
    mode[2] |= {
        "none": termios.CSTOPB,
        "even": termios.PARENB,
        "odd": termios.PARENB | termios.PARODD,
    }[parity]
    mode[4] = mode[5] = speed
    termios.tcsetattr(line, termios.TCSANOW, mode)
