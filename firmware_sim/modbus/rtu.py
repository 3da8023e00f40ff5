"""Modbus RTU on a serial port or a pseudo-terminal: framing by length and checksum, and by silence.

The checksums are those of pymodbus. Its framer drops what follows a frame, and its transport needs
pyserial. Here a frame is complete when its function gives its length and the checksum is right, and
the line is a pair of asyncio pipes. Other data are dropped at the next silence, except a correct
frame of a function that this device does not have: that is answered with an exception. Frames for
other units on the line are ignored. Unit 0 is a broadcast: all units execute it, and none answers.
Source: MODBUS over Serial Line V1.02, section 2.
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

# silence that ends a frame: 3.5 characters, but at least as long as serial adapters pause in a
# frame
CHARACTERS = 3.5
SILENCE_MIN_S = 0.02
_BITS_PER_CHARACTER = 11

_CRC_BYTES = 2
_UNSENT_BYTES = 1024  # answers beyond this are lost
_REOPEN_S = 1.0  # pause between two attempts to open a lost line

# places in the list of termios.tcgetattr
_CONTROL_FLAGS = 2
_INPUT_SPEED = 4
_OUTPUT_SPEED = 5

# the answer of the framer where there is no frame
_NO_FRAME = (0, 0, 0, b"")


class Frame(FramerRTU):
    """A frame with its checksum, without any byte of what follows it."""

    def decode(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Return the number of bytes used, the unit, 0 and the request at the beginning of `data`.

        The number of bytes is 0 if there is no complete and correct request.
        """
        kind = self.decoder.lookupPduClass(data) if len(data) >= self.MIN_SIZE else None
        size = kind.calculateRtuFrameSize(data) if kind else 0
        if size > len(data):
            return _NO_FRAME
        return self.decode_whole(data[:size])

    def decode_whole(self, frame: bytes) -> tuple[int, int, int, bytes]:
        """As `decode`, if all bytes must be one frame: a silence has ended it, or its length is
        known.
        """
        if not self.MIN_SIZE <= len(frame) <= LARGEST_FRAME:
            return _NO_FRAME
        content = frame[:-_CRC_BYTES]
        checksum = int.from_bytes(frame[-_CRC_BYTES:], "big")
        if not self.check_CRC(content, checksum):
            return _NO_FRAME
        return len(frame), content[0], 0, content[1:]


class SerialLine(asyncio.Protocol):
    """The units of a server on a serial line; everything runs in the running loop.

    `port` is a device, or "pty" for a new pseudo-terminal. `on_event(code, **fields)` is called
    when the line is lost and when it is back.
    """

    def __init__(
        self,
        server: Server,
        port: str,
        baud_rate: int = 19200,
        parity: str = "even",
        on_event: OnEvent = events.ignore,
    ) -> None:
        self.server = server
        self.port = port
        self.baud_rate = baud_rate
        self.parity = parity
        self.on_event = on_event
        self.silence_s = max(CHARACTERS * _BITS_PER_CHARACTER / baud_rate, SILENCE_MIN_S)
        self._frame = Frame(pdu.DECODER)
        self._received = b""
        # both are there while the line is open
        self._reading: asyncio.ReadTransport | None = None
        self._writing: asyncio.WriteTransport | None = None
        self._client_end = -1  # descriptor of the other side of a pseudo-terminal
        self._silence_timer: asyncio.TimerHandle | None = None
        self._reopening: asyncio.Task[None] | None = None

    async def open(self) -> str:
        """Open the line, and return the device that a client opens. Raises BusError."""
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
        self._reading = reading
        self._writing = writing
        return name

    def _open(self) -> tuple[str, int]:
        """Open the device; return the device of a client and the descriptor of the line."""
        if self.port == PSEUDO:
            line, self._client_end = os.openpty()
            # the side of the client stays open here, or the line would hang up between two clients
            tty.setraw(self._client_end)
            return os.ttyname(self._client_end), line
        line = os.open(self.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            _set_up(line, self.baud_rate, self.parity)
        except BaseException:
            os.close(line)
            raise
        return self.port, line

    def close(self) -> None:
        """Close the line."""
        if self._silence_timer:
            self._silence_timer.cancel()
        if self._reopening:
            self._reopening.cancel()
        if self._reading and self._writing:
            self._reading.close()
            self._writing.abort()
        self._reading = None
        self._writing = None
        if self._client_end >= 0:
            os.close(self._client_end)
            self._client_end = -1

    def data_received(self, data: bytes) -> None:
        if self._silence_timer:
            self._silence_timer.cancel()
        self._received += data

        used = True
        while used:
            used = self._execute(*self._frame.decode(self._received))

        if self._received:
            self._silence_timer = asyncio.get_running_loop().call_later(
                self.silence_s, self._on_silence
            )
            # of data longer than any frame, only the end still matters
            self._received = self._received[-LARGEST_FRAME - 1 :]

    def _on_silence(self) -> None:
        """Execute what has been received if it is a frame, and drop it in any case."""
        if not self._execute(*self._frame.decode_whole(self._received)):
            self.server.counters.malformed += 1
        self._received = b""

    def _execute(self, used: int, unit: int, number: int, request: bytes) -> bool:
        """Take a frame from the received bytes, execute and answer it; return False if there is
        none.

        The arguments are what `Frame.decode` returns.
        """
        if not used:
            return False
        self._received = self._received[used:]
        function = request[0]
        if unit == BROADCAST:
            if function in pdu.WRITE_FUNCTIONS:
                for each_unit in self.server.units:
                    self.server.answer(each_unit, request)
        elif unit in self.server.units and function < pdu.EXCEPTION_BIT and self._writing:
            reply = self._frame.encode(self.server.answer(unit, request), unit, 0)
            # answers that a client does not read are lost, as on a wire
            if self._writing.get_write_buffer_size() + len(reply) <= _UNSENT_BYTES:
                self._writing.write(reply)
        return True

    def connection_lost(self, exc: Exception | None) -> None:
        if self._writing:
            self.close()
            self.on_event(Code.MODBUS_SERIAL_LOST, device=self.port)
            self._reopening = asyncio.get_running_loop().create_task(self._reopen())

    async def _reopen(self) -> None:
        while self._writing is None:
            await asyncio.sleep(_REOPEN_S)
            with contextlib.suppress(BusError):
                await self.open()
        self.on_event(Code.MODBUS_SERIAL_BACK, device=self.port)


def _set_up(line: int, baud_rate: int, parity: str) -> None:
    """Set a line to raw bytes with eight data bits. Raises OSError.

    Without parity there are two stop bits, as the standard requires.
    """
    speed = getattr(termios, f"B{baud_rate}", None)
    if speed is None:
        raise OSError(f"no such baud rate: {baud_rate}")
    tty.setraw(line)
    mode = termios.tcgetattr(line)

    flags = mode[_CONTROL_FLAGS]
    flags &= ~(termios.PARENB | termios.PARODD | termios.CSTOPB | termios.CRTSCTS)
    flags |= termios.CLOCAL | termios.CREAD
    parity_flags = {
        "none": termios.CSTOPB,
        "even": termios.PARENB,
        "odd": termios.PARENB | termios.PARODD,
    }
    flags |= parity_flags[parity]

    mode[_CONTROL_FLAGS] = flags
    mode[_INPUT_SPEED] = speed
    mode[_OUTPUT_SPEED] = speed
    termios.tcsetattr(line, termios.TCSANOW, mode)
