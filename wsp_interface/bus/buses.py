"""Opens a bus from its address, in the same way for an outside program and for the bench.

An address is `socketcand://HOST:PORT/BUS` (the bench's hub), `socketcan:vcan0` (a CAN interface of
the kernel) or `INTERFACE:CHANNEL` of any other python-can interface. An outside program gets a
python-can bus. The bench always gets a hub: it either listens for programs, or one of its ports is
connected to the python-can bus. So the nodes, the log and the counters are the same for both.

Source: python-can 4.6.
"""

import asyncio
import errno
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface.bus import kernel, plugin
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub, log_event
from rollerrig.wsp_interface.events import Code, OnEvent

BATCH = 64  # frames read in one callback, so that a full bus leaves time for the event loop
QUEUE = 4096  # frames that wait while the queue of the interface is full
RETRY_S = 0.001  # until the next attempt to send them
OLDEST_S = 1.0  # an older time stamp of the kernel shows that the wall clock was set
DEFAULT_ADDRESS = f"socketcand://{plugin.DEFAULT_CHANNEL}"
_INSTEAD = f"or use the bench's own hub, {DEFAULT_ADDRESS}"


def open_client(
    address: str,
    connect_timeout_s: float = 3.0,
    errors: bool = False,
    ahead: bool = False,
    **more: Any,
) -> can.BusABC:
    """Return the python-can bus at an address, for an outside program.

    connect_timeout_s: how long to wait for a hub.
    errors: receive error frames from a hub; a CAN interface of the kernel always delivers them.
    ahead: as in `plugin.RollerrigBus`, for a hub only.
    more: further options of the python-can interface.

    Raises BusError.
    """
    interface, colon, channel = address.partition(":")
    if not colon or not channel:
        raise BusError(
            f"bus address {address!r}: allowed are {DEFAULT_ADDRESS}, "
            "socketcan:vcan0, or INTERFACE:CHANNEL of python-can"
        )
    if interface in ("socketcand", "rollerrig"):
        try:
            return plugin.RollerrigBus(
                channel.lstrip("/"), connect_timeout=connect_timeout_s, errors=errors, ahead=ahead
            )
        except can.CanError as error:
            raise BusError(f"bus address {address!r}: {error}") from error
    if interface not in can.VALID_INTERFACES:
        raise BusError(
            f"bus address {address!r}: unknown interface {interface!r}; allowed: "
            + ", ".join(sorted(can.VALID_INTERFACES))
        )
    if interface == "socketcan":
        kernel.require(address, channel, _INSTEAD, kernel.available())
    try:
        return can.Bus(interface=interface, channel=channel, **more)
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise BusError(
            f"bus address {address!r}: python-can cannot open it: {error}; "
            f"correct the channel or use {DEFAULT_ADDRESS}"
        ) from error


async def open_hub(
    address: str,
    clock_ns: Callable[[], int],
    bitrate: int = 500_000,
    on_lost: Callable[[BusError], None] | None = None,
    on_event: OnEvent = log_event,
    kernel_time: bool = False,
) -> Hub:
    """Return a hub for the bench's nodes: it serves the bus at an address, or is connected to it.

    bitrate: in bit/s, for the load.
    on_lost: called with the error when the python-can bus fails later; by default the event loop's
        exception handler is called.
    on_event: called as on_event(code, **fields) for errors that a controller reports.
    kernel_time: clock_ns follows the wall clock, so a frame gets the time at which the kernel
        received it.

    Raises BusError.
    """
    if address.startswith("socketcand:"):
        try:
            host, port, name = plugin.parse_address(address)
        except ValueError as error:
            raise BusError(str(error)) from error
        hub = Hub(clock_ns, bitrate, name, on_event=on_event)
        await hub.listen("socketcand", host, port)
        return hub

    # CAN FD frames are useless here, but they must be counted and reported
    more = {"fd": True} if address.startswith("socketcan:") else {}
    # the handshake blocks, and the other end may be a hub in this very event loop
    bus = await asyncio.to_thread(open_client, address, **more)
    name = address.partition(":")[2].rpartition("/")[2]
    # programs that join over TCP need not know the name of the interface
    _, _, usual_name = plugin.parse_address(DEFAULT_ADDRESS)
    other_names = () if name == usual_name else (usual_name,)
    hub = Hub(clock_ns, bitrate, name, on_event=on_event, other_names=other_names)
    try:
        BusPort(hub, bus, on_lost, on_event, clock_ns if kernel_time else None)
    except BusError:
        bus.shutdown()
        raise
    return hub


class BusPort(can.Listener):
    """Connects a hub and a python-can bus: frames of each go to the other, until either closes.

    `error` is the failure of the bus, None while it works.
    """

    def __init__(
        self,
        hub: Hub,
        bus: can.BusABC,
        on_lost: Callable[[BusError], None] | None,
        on_event: OnEvent,
        clock_ns: Callable[[], int] | None,
    ) -> None:
        """Start to read. Call it in the hub's event loop; the port owns the bus from now on.

        clock_ns: the hub's clock, if frames shall get the time stamps of the python-can bus.

        Raises BusError when another bench is on the interface.
        """
        self.error: BusError | None = None
        self._hub = hub
        self._bus = bus
        self._on_lost = on_lost
        self._on_event = on_event
        self._clock_ns = clock_ns
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[Frame] = deque()
        self._reported: set[tuple[Code, str]] = set()
        self._interface: kernel.Interface | None = None
        if isinstance(bus, SocketcanBus):
            self._interface = kernel.Interface(bus, str(bus.channel))
        self._fileno = _fileno(bus)
        self._port = hub.attach(self._transmit, str(bus.channel_info), self._stop)
        if clock_ns is not None:
            hub.timestamping_port = self._port
        self._notifier: can.Notifier | None = None
        if self._fileno is not None:
            self._loop.add_reader(self._fileno, self._readable)
        else:
            # the notifier reads in a thread and calls this listener in the event loop
            self._notifier = can.Notifier(bus, [self], timeout=0.1, loop=self._loop)
        if self._interface:
            self._loop.add_reader(self._interface.link, self._look_at_link)

    def _transmit(self, frame: Frame) -> None:
        """Send a frame of the hub; let it wait while the queue of the interface is full."""
        if not self._waiting and self._send(frame):
            return
        self._waiting.append(frame)
        if len(self._waiting) == 1:
            self._loop.call_later(RETRY_S, self._retry)
        elif len(self._waiting) > QUEUE:
            self._waiting.popleft()
            self._drop(1, "its transmit queue does not empty")

    def _send(self, frame: Frame) -> bool:
        """Return False when the frame must wait; True when it is sent, or dropped for good."""
        try:
            self._bus.send(plugin.message_of(frame), timeout=0)
        except can.CanError as error:
            # the queue is full, the controller is bus-off, or the bus is gone
            queue_is_full = error.error_code in (None, errno.ENOBUFS)
            if self._interface and queue_is_full:
                return False
            self._drop(1, str(error))
        return True

    def _retry(self) -> None:
        while self._waiting and self._send(self._waiting[0]):
            self._waiting.popleft()
        if self._waiting:
            self._loop.call_later(RETRY_S, self._retry)

    def _drop(self, frames: int, why: str) -> None:
        self._port.dropped += frames
        if self._is_new(Code.BUS_FRAMES_LOST, why):
            self._on_event(Code.BUS_FRAMES_LOST, bus=self._port.name, reason=why)

    def _is_new(self, code: Code, about: str) -> bool:
        """Return True the first time: a bus in trouble repeats its errors with every frame."""
        if (code, about) in self._reported:
            return False
        self._reported.add((code, about))
        return True

    def _readable(self) -> None:
        try:
            for _ in range(BATCH):
                message = self._bus.recv(0)
                if message is None:
                    break
                self.on_message_received(message)
        except can.CanError as error:
            self.on_error(error)
        if self._interface and self.error is None:
            lost = self._interface.newly_dropped()
            if lost:
                self._drop(lost, "they came faster than they were read")

    def on_message_received(self, msg: can.Message) -> None:
        """Put a message of the python-can bus on the hub."""
        frame = plugin.frame_of(msg)
        if frame is not None:
            if self._clock_ns:
                frame = frame._replace(time_ns=self._time_ns(msg))
            self._port.send(frame)
        elif msg.is_error_frame:
            self._hub.report_error(msg.arbitration_id, bytes(msg.data))
            for condition in kernel.error_texts(msg):
                if self._is_new(Code.BUS_CONTROLLER, condition):
                    self._on_event(Code.BUS_CONTROLLER, bus=self._port.name, condition=condition)
            if msg.arbitration_id & kernel.BUS_OFF:
                self.on_error(BusError("the controller is bus-off"))
        else:
            self._drop(1, "they are CAN FD frames, which no program here reads")

    def _time_ns(self, message: can.Message) -> int:
        """Return the time of a message by the hub's clock."""
        assert self._clock_ns is not None
        now_ns = self._clock_ns()
        age_s = time.time() - message.timestamp
        if 0.0 < age_s < OLDEST_S:
            return now_ns - int(age_s * 1e9)
        return now_ns

    def _look_at_link(self) -> None:
        if self._interface and self._interface.is_down():
            self.on_error(BusError("the interface was set down or removed"))

    def on_error(self, exc: Exception) -> None:
        """Close after a failure of the bus and report it: silence would look like a quiet bus."""
        if self.error is not None:
            return
        self.error = BusError(
            f"CAN bus {self._port.name} failed: {exc}; check the interface and start again"
        )
        self._port.dropped += len(self._waiting)
        self._port.close()
        if self._on_lost:
            self._on_lost(self.error)
        else:
            context = {"message": str(self.error), "exception": self.error}
            self._loop.call_exception_handler(context)

    def _stop(self) -> None:
        self._waiting.clear()
        if self._fileno is not None:
            self._loop.remove_reader(self._fileno)
        if self._notifier:
            self._notifier.stop(timeout=0.5)
        if self._interface:
            self._loop.remove_reader(self._interface.link)
            self._interface.close()
        self._bus.shutdown()


def _fileno(bus: can.BusABC) -> int | None:
    """Return the file descriptor of a bus, None when it has none."""
    try:
        number = bus.fileno()
    except NotImplementedError:
        return None
    return number if number >= 0 else None
