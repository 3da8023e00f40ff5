"""Opening a bus from its address, the same way for a program outside and for the bench.

An address is `socketcand://HOST:PORT/BUS` (the bench's own hub), `socketcan:vcan0` (a CAN interface
of the kernel) or `INTERFACE:CHANNEL` of any other python-can interface. A program outside gets a
python-can bus; the bench always gets a hub, which either listens for programs or has one of its
ports on the python-can bus, so the nodes, the log and the counters are the same on both.

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

BATCH = 64  # frames read in one go, so that a full bus leaves the loop some air
# frames that wait while the interface's own queue is full, and how long until it is asked again
QUEUE, RETRY_S = 4096, 0.001
OLDEST_S = 1.0  # a stamp of the kernel's that is older than this comes from a clock that was set
DEFAULT_ADDRESS = f"socketcand://{plugin.DEFAULT_CHANNEL}"
_INSTEAD = f"or use the bench's own hub, {DEFAULT_ADDRESS}"


def open_client(
    address: str,
    connect_timeout_s: float = 3.0,
    errors: bool = False,
    ahead: bool = False,
    **more: Any,
) -> can.BusABC:
    """Return the python-can bus at an address, for a program outside; waits for a hub. Raises BusError.

    `errors`: a hub shall tell error frames too; a CAN interface of the kernel does so anyway. `ahead`: as
    `plugin.RollerrigBus` has it, where there is a hub.
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
            f"mend the channel or use {DEFAULT_ADDRESS}"
        ) from error


async def open_hub(
    address: str,
    clock_ns: Callable[[], int],
    bitrate: int = 500_000,
    on_lost: Callable[[BusError], None] | None = None,
    on_event: OnEvent = log_event,
    kernel_time: bool = False,
) -> Hub:
    """Return a hub for the bench's nodes that serves, or sits on, the bus at an address.

    bitrate in bit/s is what the load is counted against. on_lost is told when the python-can bus
    fails later, without it the event loop's exception handler is; on_event(code, **fields) is told of
    errors that a controller reports. kernel_time: clock_ns goes as the wall clock does, so that a
    frame gets the time at which the kernel took it. Raises BusError.
    """
    if not address.startswith("socketcand:"):
        # the handshake blocks, perhaps with a hub in this very event loop
        # CAN FD frames are no use here, but shall be told and counted
        more = {"fd": True} if address.startswith("socketcan:") else {}
        bus = await asyncio.to_thread(open_client, address, **more)
        hub = Hub(
            clock_ns,
            bitrate,
            on_event=on_event,
            name=address.partition(":")[2].rpartition("/")[2],
        )
        try:
            BusPort(hub, bus, on_lost, on_event, clock_ns if kernel_time else None)
        except BusError:
            bus.shutdown()
            raise
        return hub
    try:
        host, port, name = plugin.parse_address(address)
    except ValueError as error:
        raise BusError(str(error)) from error
    hub = Hub(clock_ns, bitrate, name, on_event=on_event)
    await hub.listen("socketcand", host, port)
    return hub


class BusPort(can.Listener):
    """Joins a hub and a python-can bus: frames of each go to the other, until either closes."""

    def __init__(
        self,
        hub: Hub,
        bus: can.BusABC,
        on_lost: Callable[[BusError], None] | None,
        on_event: OnEvent,
        clock_ns: Callable[[], int] | None,
    ) -> None:
        """Start reading; to be called in the hub's event loop. Owns the bus from now on.

        Raises BusError where another bench is on the interface.
        """
        self.error: BusError | None = None
        self._hub, self._bus, self._on_lost, self._on_event = hub, bus, on_lost, on_event
        self._clock_ns = clock_ns
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[Frame] = deque()
        self._told: set[tuple[Code, str]] = set()
        self._interface = (
            kernel.Interface(bus, str(bus.channel)) if isinstance(bus, SocketcanBus) else None
        )
        self._fileno = _fileno(bus)
        self._port = hub.attach(self._transmit, str(bus.channel_info), self._stop)
        if clock_ns is not None:
            hub.stamped_by = self._port
        self._notifier: can.Notifier | None = None
        if self._fileno is not None:
            self._loop.add_reader(self._fileno, self._readable)
        else:
            # its thread reads, and calls in this event loop
            self._notifier = can.Notifier(bus, [self], timeout=0.1, loop=self._loop)
        if self._interface:
            self._loop.add_reader(self._interface.link, self._look_at_link)

    def _transmit(self, frame: Frame) -> None:
        if self._waiting or not self._sent(frame):
            self._waiting.append(frame)
            if len(self._waiting) == 1:
                self._loop.call_later(RETRY_S, self._retry)
            elif len(self._waiting) > QUEUE:
                self._waiting.popleft()
                self._drop(1, "its transmit queue does not empty")

    def _sent(self, frame: Frame) -> bool:
        """Whether the bus took a frame, or never will; False: later."""
        try:
            self._bus.send(plugin.message_of(frame), timeout=0)
        except can.CanError as error:  # full queue, bus off, or gone
            if self._interface and error.error_code in (None, errno.ENOBUFS):
                return False
            self._drop(1, str(error))
        return True

    def _retry(self) -> None:
        while self._waiting and self._sent(self._waiting[0]):
            self._waiting.popleft()
        if self._waiting:
            self._loop.call_later(RETRY_S, self._retry)

    def _drop(self, frames: int, why: str) -> None:
        self._port.dropped += frames
        if self._is_new(Code.BUS_FRAMES_LOST, why):
            self._on_event(Code.BUS_FRAMES_LOST, bus=self._port.name, reason=why)

    def _is_new(self, code: Code, about: str) -> bool:
        """Return True the first time: the trouble of a bus comes with every frame."""
        if (code, about) in self._told:
            return False
        self._told.add((code, about))
        return True

    def _readable(self) -> None:
        try:
            for _ in range(BATCH):
                if (message := self._bus.recv(0)) is None:
                    break
                self.on_message_received(message)
        except can.CanError as error:
            self.on_error(error)
        if self._interface and self.error is None and (lost := self._interface.newly_dropped()):
            self._drop(lost, "they came faster than they were read")

    def on_message_received(self, msg: can.Message) -> None:
        """Put a message of the python-can bus on the hub."""
        frame = plugin.frame_of(msg)
        if frame is not None:
            self._port.send(frame._replace(time_ns=self._time_ns(msg)) if self._clock_ns else frame)
        elif msg.is_error_frame:
            self._hub.tell_error(msg.arbitration_id, bytes(msg.data))
            for condition in kernel.error_texts(msg):
                if self._is_new(Code.BUS_CONTROLLER, condition):
                    self._on_event(Code.BUS_CONTROLLER, bus=self._port.name, condition=condition)
            if msg.arbitration_id & kernel.BUS_OFF:
                self.on_error(BusError("the controller is bus-off"))
        else:
            self._drop(1, "they are CAN FD frames, which nobody here can read")

    def _time_ns(self, message: can.Message) -> int:
        """The time of a message by the hub's clock."""
        assert self._clock_ns is not None
        age_s = time.time() - message.timestamp
        return self._clock_ns() - (int(age_s * 1e9) if 0.0 < age_s < OLDEST_S else 0)

    def _look_at_link(self) -> None:
        if self._interface and self._interface.is_down():
            self.on_error(BusError("the interface was set down or removed"))

    def on_error(self, exc: Exception) -> None:
        """Close after a failure of the bus, and say so: silence would look like a quiet bus."""
        if self.error is None:
            self.error = BusError(
                f"CAN bus {self._port.name} failed: {exc}; check the interface and start again"
            )
            self._port.dropped += len(self._waiting)
            self._port.close()
            if self._on_lost:
                self._on_lost(self.error)
            else:
                self._loop.call_exception_handler(
                    {"message": str(self.error), "exception": self.error}
                )

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
    try:
        number = bus.fileno()
    except NotImplementedError:
        return None
    return number if number >= 0 else None
