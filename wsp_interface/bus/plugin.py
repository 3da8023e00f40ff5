"""The hub as a python-can interface: `can.Bus("127.0.0.1:29536/rig0", interface="rollerrig")`.

It speaks socketcand, so a genuine socketcand server works as well. Unlike python-can's own client it notices when the
server goes: `recv` and `send` then raise `can.CanOperationError`, and nothing spins. Remote frames go as `sendrtr` and
come as `rtr`, which socketcand's protocol has; an older server answers `sendrtr` with an error, which is logged.

Frames that arrived stay in the kernel until they are asked for, one at a time: the descriptor is readable as long as a
whole frame is there, so an event loop that reads one frame a call gets all. Who needs no descriptor reads `ahead`.
"""

import contextlib
import logging
import os
import select
import socket
import threading
import time
from collections import deque
from typing import Any, NoReturn

import can

from rollerrig.wsp_interface.bus import socketcand
from rollerrig.wsp_interface.bus.frames import S_NS, Frame, length

log = logging.getLogger(__name__)

DEFAULT_CHANNEL = "127.0.0.1:29536/rig0"
PEEK_BYTES = 512  # about ten frames
AHEAD_BYTES = 1 << 14
TEXT_MAX = 4096  # bytes without a ">" that are no socketcand
SEND_TIMEOUT_S = 5.0
RETRY_S = 0.1


def parse_address(text: str) -> tuple[str, int, str]:
    """Return host, port and bus of `[socketcand://]HOST:PORT/BUS`; ValueError says what is allowed."""
    place, slash, bus = text.removeprefix("socketcand://").partition("/")
    host, colon, port = place.rpartition(":")
    if not (slash and bus and colon and host and port.isdecimal() and int(port) <= 65535):
        raise ValueError(
            f"bus address {text!r}: allowed is socketcand://HOST:PORT/BUS, "
            f"for example socketcand://{DEFAULT_CHANNEL}"
        )
    return host.strip("[]"), int(port), bus


def message_of(frame: Frame, channel: str | None = None) -> can.Message:
    """Return a frame as a python-can message, its time stamp in s."""
    return can.Message(
        timestamp=frame.time_ns / S_NS,
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        dlc=length(frame),
        data=frame.data,
        channel=channel,
        is_error_frame=frame.error,
    )


def frame_of(message: can.Message) -> Frame | None:
    """Return a python-can message as a frame, None for error and CAN FD frames."""
    if message.is_error_frame or message.is_fd:
        return None
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        message.is_extended_id,
        message.is_remote_frame,
        message.dlc if message.is_remote_frame else 0,
    )


class RollerrigBus(can.BusABC):
    """A client of the hub. `connect_timeout` [s]: how long to wait for a hub; `errors`: ask it for error frames.

    `ahead`: for one thread that receives and sends in turns. All that has come is taken at once, so the descriptor says
    nothing of it, and what is sent goes out at once with the next `recv`, or at the end.
    """

    def __init__(
        self,
        channel: str = DEFAULT_CHANNEL,
        can_filters: Any = None,
        connect_timeout: float = 3.0,
        errors: bool = False,
        ahead: bool = False,
        **kwargs: Any,
    ) -> None:
        """Connect and shake hands; raises can.CanInitializationError."""
        self._ahead = ahead
        self._texts: deque[bytes] = (
            deque()
        )  # messages that were read and not asked for yet, without their ">"
        self._outgoing: list[bytes] = []
        self._refused: set[bytes] = (
            set()
        )  # identifiers, as the hub writes them, that the filters let not through
        self._gone, self._gone_told = (
            "",
            False,
        )  # why there is no connection any more; whether a reader knows
        self._closing = threading.Event()
        self._sending = threading.Lock()  # periodic tasks send from their own threads
        self._ending = threading.Lock()  # one thread quietens the descriptor or closes it
        self._text = self._unsent = (
            b""  # the beginning of a message whose end has not come; what is still to go
        )
        try:
            self._host, self._port, self.channel = parse_address(str(channel))
        except ValueError as error:
            raise can.CanInitializationError(str(error)) from error
        until_s = time.monotonic() + connect_timeout
        self._socket = _connect(self._host, self._port, until_s)
        try:
            self._shake_hands(max(until_s, time.monotonic() + 1.0), errors)
        except can.CanError as error:
            self._socket.close()
            raise can.CanInitializationError(
                f"{self._where()}: {error}; is it a CAN hub that carries bus {self.channel!r}?"
            ) from error
        self.channel_info = self._where()
        super().__init__(channel=self.channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; waits up to timeout [s] (default 5 s) while the connection is full."""
        frame = frame_of(msg)
        if frame is None:
            raise can.CanOperationError(
                f"{self._where()}: error and CAN FD frames "
                "cannot be sent, only classical CAN frames"
            )
        wire = socketcand.encode_command(frame)
        if self._ahead and not self._gone:
            self._outgoing.append(wire)
            return
        with self._sending:
            self._write(wire, timeout)

    def fileno(self) -> int:
        """Return the descriptor, readable while a whole frame is there."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Stop periodic tasks and close; a `recv` that waits in another thread raises."""
        super().shutdown()
        with contextlib.suppress(can.CanError):
            self._send_what_waits()
        self._closing.set()
        self._gone = self._gone or f"{self._where()}: the bus is shut down"
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes whoever waits
        with self._ending:
            self._socket.close()

    def _apply_filters(self, filters: Any) -> None:
        self._refused.clear()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        until_s = None if timeout is None else time.monotonic() + timeout
        if self._gone:
            self._say_gone(timeout)
        try:
            self._send_what_waits()
            while (text := self._read(until_s)) is not None:
                body = text.rpartition(b"<")[2].rstrip(b">")
                written = body.split(None, 2)[1:2]
                if self._refused.isdisjoint(written):
                    frame = socketcand.parse_event(body)
                    if frame is None:
                        log.warning("%s says <%s>", self._where(), body.decode("ascii", "replace"))
                        continue
                    message = message_of(frame, self.channel)
                    if self._matches_filters(message):
                        return message, True
                    self._refused.update(written)
                if until_s is not None and time.monotonic() >= until_s:
                    break
        except can.CanOperationError:
            self._say_gone(None)
        return None, False

    def _read(self, until_s: float | None) -> bytes | None:
        """Return the next text up to its ">", or None when none is complete in time [s]."""
        while not self._texts:
            try:
                chunk = self._socket.recv(
                    *((AHEAD_BYTES,) if self._ahead else (PEEK_BYTES, socket.MSG_PEEK))
                )
                if not self._ahead and chunk:
                    # without an end all is taken, so that the descriptor is not readable for nothing
                    chunk = self._socket.recv(chunk.find(b">") + 1 or len(chunk))
            except BlockingIOError:
                if not self._wait(until_s, reading=True):
                    return None
                continue
            except OSError as error:
                self._lose(str(error))
            if not chunk:
                self._lose("the hub closed the connection")
            *texts, self._text = (self._text + chunk).split(b">")
            self._texts.extend(texts)
            if len(self._text) > TEXT_MAX:
                self._lose("this is no socketcand server")
        return self._texts.popleft() + b">"

    def _send_what_waits(self) -> None:
        if self._outgoing:
            wire, self._outgoing = b"".join(self._outgoing), []
            self._write(wire, None)

    def _write(self, wire: bytes, timeout: float | None) -> None:
        """Send all of it or, when time runs out before it was begun, raise."""
        if self._gone:
            raise can.CanOperationError(self._gone)
        until_s = time.monotonic() + (SEND_TIMEOUT_S if timeout is None else timeout)
        rest = self._unsent + wire
        while rest:
            try:
                rest = rest[self._socket.send(rest) :]
            except BlockingIOError:
                if self._wait(until_s, reading=False):
                    continue
                begun = len(rest) < len(wire)
                self._unsent = rest if begun else rest[: len(rest) - len(wire)]
                if begun:  # half a frame is out: its end goes before the next
                    return
                raise can.CanTimeoutError(
                    f"{self._where()}: the hub does not read, frame not sent"
                ) from None
            except OSError as error:
                self._lose(str(error))
        self._unsent = b""

    def _wait(self, until_s: float | None, reading: bool) -> bool:
        """Return whether the socket is ready before until_s [s, monotonic]."""
        rest_s = None if until_s is None else until_s - time.monotonic()
        if rest_s is not None and rest_s <= 0.0:
            return False
        try:
            return any(
                select.select([self._socket] * reading, [self._socket] * (not reading), [], rest_s)
            )
        except (OSError, ValueError) as error:  # closed by another thread meanwhile
            self._lose(str(error))

    def _shake_hands(self, until_s: float, errors: bool) -> None:
        # another server than ours does not know of errors, and may say so
        asking = [("< errors >", "")] if errors else []
        for command, answer in (
            ("", "hi"),
            (f"< open {self.channel} >", "ok"),
            *asking,
            ("< rawmode >", "ok"),
        ):
            self._write(command.encode(), until_s - time.monotonic())
            text = (self._read(until_s) or b"nothing in time").decode("ascii", "replace").strip()
            if answer and text.strip("<> ") != answer:
                raise can.CanOperationError(f"expected '< {answer} >', got '{text}'")

    def _lose(self, why: str) -> NoReturn:
        self._gone = self._gone or f"{self._where()}: {why}"
        raise can.CanOperationError(self._gone)

    def _say_gone(self, timeout: float | None) -> NoReturn:
        """Tell a reader, again only after its time-out [s]: one that calls at once must not use up the processor."""
        if self._gone_told and timeout:
            self._closing.wait(timeout)
        elif not self._gone_told:
            self._gone_told = True
            with self._ending:
                if os.name == "posix" and not self._closing.is_set():
                    # an event loop would spin on a socket at its end: the same number becomes one at
                    # which nothing ever arrives
                    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as quiet:
                        os.dup2(quiet.fileno(), self._socket.fileno(), inheritable=False)
        raise can.CanOperationError(self._gone)

    def _where(self) -> str:
        return f"CAN hub socketcand://{self._host}:{self._port}/{self.channel}"


def _connect(host: str, port: int, until_s: float) -> socket.socket:
    """Return a connected non-blocking socket; tries again until until_s [s, monotonic]."""
    while True:
        try:
            rest_s = max(until_s - time.monotonic(), RETRY_S)
            connection = socket.create_connection((host, port), rest_s)
            break
        except OSError as error:
            if time.monotonic() + RETRY_S > until_s:
                raise can.CanInitializationError(
                    f"no CAN hub at {host}:{port} ({error}): start the bench (rollerrig run) or mend the address; "
                    f"ss -ltn 'sport = :{port}' shows whether anybody listens"
                ) from error
        time.sleep(RETRY_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)
    return connection
