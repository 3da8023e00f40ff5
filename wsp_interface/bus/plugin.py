"""The hub as a python-can interface: `can.Bus("127.0.0.1:29536/rig0", interface="rollerrig")`.

The client uses the socketcand protocol, so it also works with a genuine socketcand server. Unlike
python-can's socketcand client, it notices when the server closes: `recv` and `send` then raise
`can.CanOperationError`, and no loop spins. Remote frames go out as `sendrtr` and come in as `rtr`.
An older server answers `sendrtr` with an error, which is logged.

Frames stay in the kernel until `recv` takes them, one at a time. So the descriptor is readable as
long as a whole frame is there, and an event loop that reads one frame in each callback gets all of
them. A program that needs no descriptor reads faster with `ahead`.
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
TEXT_MAX = 4096  # a longer text without a ">" is not socketcand
SEND_TIMEOUT_S = 5.0
RETRY_S = 0.1


def parse_address(text: str) -> tuple[str, int, str]:
    """Return host, port and bus of `[socketcand://]HOST:PORT/BUS`. Raises ValueError."""
    place, _, bus = text.removeprefix("socketcand://").partition("/")
    host, _, port = place.rpartition(":")
    has_port = port.isdecimal() and int(port) <= 65535
    if not (host and has_port and bus):
        raise ValueError(
            f"bus address {text!r}: allowed is socketcand://HOST:PORT/BUS, "
            f"for example socketcand://{DEFAULT_CHANNEL}"
        )
    return host.strip("[]"), int(port), bus


def message_of(frame: Frame, channel: str | None = None) -> can.Message:
    """Return a frame as a python-can message. Its time stamp is in s."""
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
    """Return a python-can message as a frame; None for error frames and frames of CAN FD."""
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
    """A client of the hub.

    channel: HOST:PORT/BUS.
    can_filters: as in python-can.
    connect_timeout: how long to wait for a hub, in s.
    errors: receive error frames as well.
    ahead: for a single thread that alternates between receiving and sending. `recv` reads ahead
        everything that has arrived, so the descriptor does not show whether frames are there.
        `send` only collects frames: they go out together with the next `recv`, or at the end.

    Raises can.CanInitializationError.
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
        """Connect and complete the handshake."""
        self._ahead = ahead
        self._texts: deque[bytes] = deque()  # messages that were read ahead, without their ">"
        self._text = b""  # the beginning of a message whose end has not arrived
        self._outgoing: list[bytes] = []  # collected frames, with `ahead`
        self._unsent = b""  # the end of a frame that is partly sent
        # identifiers that the filters reject, as the hub writes them
        self._rejected_ids: set[bytes] = set()
        self._gone = ""  # why there is no connection any more
        self._gone_reported = False  # a reader has had the error
        self._closing = threading.Event()
        self._sending = threading.Lock()  # periodic tasks send from separate threads
        self._ending = threading.Lock()  # only one thread replaces the descriptor or closes it
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
        """Send a frame; wait up to timeout (in s, default 5 s) while the connection is full."""
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
        """Stop periodic tasks and close. A `recv` that waits in another thread raises."""
        super().shutdown()
        with contextlib.suppress(can.CanError):
            self._send_collected()
        self._closing.set()
        self._gone = self._gone or f"{self._where()}: the bus is shut down"
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits
        with self._ending:
            self._socket.close()

    def _apply_filters(self, filters: Any) -> None:
        self._rejected_ids.clear()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next message that passes the filters, and True: it is filtered already."""
        until_s = None if timeout is None else time.monotonic() + timeout
        if self._gone:
            self._raise_gone(timeout)
        try:
            self._send_collected()
            while (text := self._read(until_s)) is not None:
                body = text.rpartition(b"<")[2].rstrip(b">")
                written_id = body.split(None, 2)[1:2]
                # known identifiers are rejected without parsing the rest
                if self._rejected_ids.isdisjoint(written_id):
                    frame = socketcand.parse_event(body)
                    if frame is None:
                        answer = body.decode("ascii", "replace")
                        log.warning("%s sends <%s>", self._where(), answer)
                        continue
                    message = message_of(frame, self.channel)
                    if self._matches_filters(message):
                        return message, True
                    self._rejected_ids.update(written_id)
                if until_s is not None and time.monotonic() >= until_s:
                    break
        except can.CanOperationError:
            self._raise_gone(None)
        return None, False

    def _read(self, until_s: float | None) -> bytes | None:
        """Return the next text up to its ">"; None when none is complete before until_s."""
        while not self._texts:
            try:
                chunk = self._receive()
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
                self._lose("this is not a socketcand server")
        return self._texts.popleft() + b">"

    def _receive(self) -> bytes:
        """Return bytes of the connection: with `ahead` all that is there, else at most one text."""
        if self._ahead:
            return self._socket.recv(AHEAD_BYTES)
        chunk = self._socket.recv(PEEK_BYTES, socket.MSG_PEEK)
        if not chunk:
            return chunk
        # without the end of a text take everything, so that the descriptor does not stay readable
        size = chunk.find(b">") + 1 or len(chunk)
        return self._socket.recv(size)

    def _send_collected(self) -> None:
        if self._outgoing:
            wire = b"".join(self._outgoing)
            self._outgoing = []
            self._write(wire, None)

    def _write(self, wire: bytes, timeout: float | None) -> None:
        """Send bytes. Raises can.CanTimeoutError when not even the first byte is sent in time."""
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
                if len(rest) < len(wire):
                    # half a frame is out: its end goes before the next frame
                    self._unsent = rest
                    return
                self._unsent = rest[: len(rest) - len(wire)]
                raise can.CanTimeoutError(
                    f"{self._where()}: the hub does not read, frame not sent"
                ) from None
            except OSError as error:
                self._lose(str(error))
        self._unsent = b""

    def _wait(self, until_s: float | None, reading: bool) -> bool:
        """Return whether the socket is ready before until_s (in s, monotonic)."""
        rest_s = None if until_s is None else until_s - time.monotonic()
        if rest_s is not None and rest_s <= 0.0:
            return False
        readers = [self._socket] if reading else []
        writers = [] if reading else [self._socket]
        try:
            readable, writable, _ = select.select(readers, writers, [], rest_s)
        except (OSError, ValueError) as error:  # another thread has closed the socket
            self._lose(str(error))
        return bool(readable or writable)

    def _shake_hands(self, until_s: float, errors: bool) -> None:
        steps = [("", "hi"), (f"< open {self.channel} >", "ok")]
        if errors:
            # other servers do not know this command, so any answer will do
            steps.append(("< errors >", ""))
        steps.append(("< rawmode >", "ok"))
        for command, expected in steps:
            self._write(command.encode(), until_s - time.monotonic())
            answer = self._read(until_s) or b"nothing in time"
            text = answer.decode("ascii", "replace").strip()
            if expected and text.strip("<> ") != expected:
                raise can.CanOperationError(f"expected '< {expected} >', got '{text}'")

    def _lose(self, why: str) -> NoReturn:
        """Note that the connection is lost, and why; raise it."""
        self._gone = self._gone or f"{self._where()}: {why}"
        raise can.CanOperationError(self._gone)

    def _raise_gone(self, timeout: float | None) -> NoReturn:
        """Raise the reason for the lost connection.

        The second time and later, wait for the time-out first: a reader that calls again
        immediately must not use up the processor.
        """
        if not self._gone_reported:
            self._gone_reported = True
            self._silence_descriptor()
        elif timeout:
            self._closing.wait(timeout)
        raise can.CanOperationError(self._gone)

    def _silence_descriptor(self) -> None:
        """Replace the socket by one at which nothing ever arrives, under the same number.

        An event loop would spin on a socket whose other end is closed: it is always readable.
        """
        with self._ending:
            if os.name != "posix" or self._closing.is_set():
                return
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as quiet:
                os.dup2(quiet.fileno(), self._socket.fileno(), inheritable=False)

    def _where(self) -> str:
        return f"CAN hub socketcand://{self._host}:{self._port}/{self.channel}"


def _connect(host: str, port: int, until_s: float) -> socket.socket:
    """Return a connected non-blocking socket; try again until until_s (in s, monotonic)."""
    while True:
        try:
            rest_s = max(until_s - time.monotonic(), RETRY_S)
            connection = socket.create_connection((host, port), rest_s)
            break
        except OSError as error:
            if time.monotonic() + RETRY_S > until_s:
                raise can.CanInitializationError(
                    f"no CAN hub at {host}:{port} ({error}): start the bench (rollerrig run) or "
                    "correct the address; "
                    f"ss -ltn 'sport = :{port}' shows whether a program listens"
                ) from error
        time.sleep(RETRY_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)
    return connection
