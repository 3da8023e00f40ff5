"""Modbus RTU on a serial port or a pseudo-terminal: framing by length and checksum, and by silence.

A frame is known to be whole when its function tells its length and the checksum fits. Whatever else
comes is thrown away at the next silence, unless it is a sound frame of a function that this device
has not: that is answered. Other units on the line are let be, and unit 0 is everybody: it is obeyed
and not answered. Source: MODBUS over Serial Line V1.02, section 2.
"""

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.modbus import pdu
from rollerrig.firmware_sim.modbus.server import Server

BROADCAST = 0
LARGEST_FRAME = 256
SHORTEST_FRAME = 4
PSEUDO = "pty"
# silence that ends a frame: 3.5 characters, but no less than serial adapters pause inside a frame
CHARACTERS, SILENCE_MIN_S = 3.5, 0.02
_BITS_PER_CHARACTER = 11
_UNSENT_BYTES = 1024
_REOPEN_S = 1.0


def _table() -> tuple[int, ...]:
    found = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
        found.append(crc)
    return tuple(found)


_CRC = _table()


def checksum(data: bytes) -> bytes:
    """The two checksum bytes of a frame, as they are sent."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")


def is_sound(frame: bytes) -> bool:
    """Whether a frame ends with its checksum."""
    return len(frame) >= SHORTEST_FRAME and checksum(frame[:-2]) == frame[-2:]


class SerialLine:
    """A server's units on a serial line; all in the running loop.

    `port` is a device, or "pty" for a new pseudo-terminal; `on_event(level, text)` hears when the
    line is lost and when it is back.
    """

    def __init__(self, server: Server, port: str, baud_rate: int = 19200, parity: str = "even",
                 on_event: Callable[[str, str], None] = lambda level, text: None) -> None:
        self.server, self.port = server, port
        self.baud_rate, self.parity, self.on_event = baud_rate, parity, on_event
        self.silence_s = max(CHARACTERS * _BITS_PER_CHARACTER / baud_rate, SILENCE_MIN_S)
        self._loop = asyncio.get_running_loop()
        self._line, self._other = -1, -1
        self._received, self._unsent = b"", b""
        self._quiet: asyncio.TimerHandle | None = None
        self._later: asyncio.TimerHandle | None = None

    def open(self) -> str:
        """Open the line; returns the device that a client opens. Raises BusError."""
        try:
            name = self._open()
        except (OSError, termios.error) as error:
            self._shut()
            reason = error.args[-1] if error.args else error
            raise BusError(f"[modbus] serial = '{self.port}' at {self.baud_rate} baud: {reason}; "
                           "give a serial device, \"pty\", or \"\" for none") from None
        self._loop.add_reader(self._line, self._on_readable)
        return name

    def _open(self) -> str:
        if self.port == PSEUDO:
            self._line, self._other = os.openpty()
            os.set_blocking(self._line, False)
            # the other side stays open here, else the line would hang up between two clients
            tty.setraw(self._other)
            return os.ttyname(self._other)
        self._line = os.open(self.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        _set_up(self._line, self.baud_rate, self.parity)
        return self.port

    def close(self) -> None:
        """Let the line go."""
        for timer in (self._quiet, self._later):
            if timer:
                timer.cancel()
        self._shut()

    def _shut(self) -> None:
        if self._line >= 0:
            self._loop.remove_reader(self._line)
            self._loop.remove_writer(self._line)
        for descriptor in (self._line, self._other):
            if descriptor >= 0:
                os.close(descriptor)
        self._line = self._other = -1
        self._received = self._unsent = b""

    # -- in

    def _on_readable(self) -> None:
        try:
            data = os.read(self._line, LARGEST_FRAME)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._lose()
            return
        self.on_data(data)

    def on_data(self, data: bytes) -> None:
        """Bytes from the line."""
        self._received += data
        while size := self._whole(self._received):
            frame, self._received = self._received[:size], self._received[size:]
            self._on_frame(frame)
        if self._quiet:
            self._quiet.cancel()
        self._quiet = None
        if self._received:
            self._quiet = self._loop.call_later(self.silence_s, self._on_silence)
            # more than any frame: only its end is still of interest
            self._received = self._received[-LARGEST_FRAME - 1:]

    def _whole(self, data: bytes) -> int:
        """Length of the sound request at the beginning; 0: there is none, or not yet."""
        size = pdu.length(data[1:])
        if not size or len(data) < size + 3:
            return 0
        return size + 3 if is_sound(data[:size + 3]) else 0

    def _on_silence(self) -> None:
        frame, self._received, self._quiet = self._received, b"", None
        if len(frame) <= LARGEST_FRAME and is_sound(frame):
            self._on_frame(frame)
        else:
            self.server.counters.malformed += 1

    def _on_frame(self, frame: bytes) -> None:
        unit, request = frame[0], frame[1:-2]
        if unit == BROADCAST:
            function = pdu.FUNCTIONS.get(request[0])
            for one in self.server.units if function and function.writes else ():
                self.server.answer(one, request)
        elif unit in self.server.units and not pdu.is_exception(request):
            reply = frame[:1] + self.server.answer(unit, request)
            self._send(reply + checksum(reply))

    # -- out

    def _send(self, data: bytes) -> None:
        if len(self._unsent) + len(data) <= _UNSENT_BYTES:
            self._unsent += data
        self._on_writable()

    def _on_writable(self) -> None:
        with contextlib.suppress(OSError):
            self._unsent = self._unsent[os.write(self._line, self._unsent):]
        if self._unsent:
            self._loop.add_writer(self._line, self._on_writable)
        else:
            self._loop.remove_writer(self._line)

    # -- lost and found

    def _lose(self) -> None:
        self._shut()
        self.on_event("warning", f"Modbus: the serial line {self.port} is lost")
        self._later = self._loop.call_later(_REOPEN_S, self._reopen)

    def _reopen(self) -> None:
        try:
            self.open()
        except BusError:
            self._later = self._loop.call_later(_REOPEN_S, self._reopen)
            return
        self.on_event("info", f"Modbus: the serial line {self.port} is back")


def _set_up(line: int, baud_rate: int, parity: str) -> None:
    """Raw bytes, eight data bits; two stop bits where there is no parity, as the standard wants."""
    speed = getattr(termios, f"B{baud_rate}", None)
    if speed is None:
        raise OSError(f"no such baud rate: {baud_rate}")
    tty.setraw(line)
    mode = termios.tcgetattr(line)
    mode[2] &= ~(termios.PARENB | termios.PARODD | termios.CSTOPB | termios.CRTSCTS)
    mode[2] |= termios.CLOCAL | termios.CREAD
    mode[2] |= {"none": termios.CSTOPB, "even": termios.PARENB,
                "odd": termios.PARENB | termios.PARODD}[parity]
    mode[4] = mode[5] = speed
    termios.tcsetattr(line, termios.TCSANOW, mode)
