"""Opening a bus from its address, the same way for a program outside and for the bench.

An address is `socketcand://HOST:PORT/BUS` (the bench's own hub), `socketcan:vcan0` (a CAN interface
of the kernel) or `INTERFACE:CHANNEL` of any other python-can interface. A program outside gets a
python-can bus; the bench always gets a hub, which either listens for programs or has one of its
ports on the python-can bus, so the nodes, the log and the counters are the same on both.

Source: Linux `net/can` (interfaces of hardware type 280); python-can 4.6.
"""

import asyncio
import logging
import socket
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import can

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

log = logging.getLogger(__name__)

SYSFS = Path("/sys/class/net")
ARPHRD_CAN = "280"  # linux/if_arp.h
IFF_UP = 1
BATCH = 64  # frames read in one go, so that a full bus leaves the loop some air
DEFAULT_ADDRESS = f"socketcand://{plugin.DEFAULT_CHANNEL}"

ENABLE_VCAN = ("sudo modprobe vcan && sudo ip link add vcan0 type vcan "
               "&& sudo ip link set vcan0 up")
ENABLE_AF_CAN = "this kernel has no SocketCAN: sudo modprobe can_raw, or a kernel with CONFIG_CAN"


class KernelCan(NamedTuple):
    """What this machine offers of SocketCAN."""

    af_can: bool  # raw CAN sockets can be made
    up: tuple[str, ...]  # CAN interfaces that are up
    down: tuple[str, ...]
    hints: tuple[str, ...]  # how to enable what is missing


def available(sysfs: Path = SYSFS) -> KernelCan:
    """Return which CAN sockets and interfaces this machine has, and how to get the others."""
    af_can = _has_af_can()
    states: dict[bool, list[str]] = {True: [], False: []}
    for entry in sorted(sysfs.glob("*/type")):
        if entry.read_text().strip() == ARPHRD_CAN:
            flags = int((entry.parent / "flags").read_text(), 16)
            states[bool(flags & IFF_UP)].append(entry.parent.name)
    hints = [] if af_can else [ENABLE_AF_CAN]
    if af_can and not (states[True] or states[False]):
        hints.append(f"no CAN interface: {ENABLE_VCAN}")
    hints += [f"{name} is down: sudo ip link set {name} up"
              + ("" if name.startswith("vcan") else " type can bitrate 500000")
              for name in states[False]]
    return KernelCan(af_can, tuple(states[True]), tuple(states[False]), tuple(hints))


def _has_af_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def open_client(address: str, connect_timeout_s: float = 3.0) -> can.BusABC:
    """Return the python-can bus at an address, for a program outside the bench.

    Waits connect_timeout_s [s] for a hub to appear. Raises BusError with what is allowed.
    """
    interface, colon, channel = address.partition(":")
    if not colon or not channel:
        raise BusError(f"bus address {address!r}: allowed are {DEFAULT_ADDRESS}, "
                       "socketcan:vcan0, or INTERFACE:CHANNEL of python-can")
    if interface in ("socketcand", "rollerrig"):
        try:
            return plugin.RollerrigBus(channel.lstrip("/"), connect_timeout=connect_timeout_s)
        except can.CanError as error:
            raise BusError(f"bus address {address!r}: {error}") from error
    if interface not in can.VALID_INTERFACES:
        raise BusError(f"bus address {address!r}: unknown interface {interface!r}; allowed: "
                       + ", ".join(sorted(can.VALID_INTERFACES)))
    if interface == "socketcan":
        _require_kernel_can(address, channel, available())
    try:
        return can.Bus(interface=interface, channel=channel)
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise BusError(f"bus address {address!r}: python-can cannot open it: {error}; "
                       f"mend the channel or use {DEFAULT_ADDRESS}") from error


def _require_kernel_can(address: str, channel: str, kernel: KernelCan) -> None:
    """Raise BusError unless the CAN interface is there and up."""
    if kernel.af_can and channel in kernel.up:
        return
    where = f"bus address {address!r}"
    instead = f"or use the bench's own hub, {DEFAULT_ADDRESS}"
    if not kernel.af_can:
        raise BusError(f"{where}: {ENABLE_AF_CAN}; {instead}")
    what = f"CAN interface {channel} is " + ("down" if channel in kernel.down else "absent")
    mend = next((hint for hint in kernel.hints if hint.startswith(f"{channel} ")), ENABLE_VCAN)
    raise BusError(f"{where}: {what}; allowed here: {', '.join(kernel.up) or 'none'}; "
                   f"to mend: {mend}; {instead}")


async def open_hub(address: str, clock_ns: Callable[[], int], bitrate: int = 500_000,
                   on_lost: Callable[[BusError], None] | None = None) -> Hub:
    """Return a hub for the bench's nodes that serves, or sits on, the bus at an address.

    bitrate in bit/s is what the load is counted against. on_lost is told when the python-can bus
    fails later; without it the event loop's exception handler is. Raises BusError.
    """
    if not address.startswith("socketcand:"):
        # the handshake blocks, perhaps with a hub in this very event loop
        bus = await asyncio.to_thread(open_client, address)
        hub = Hub(clock_ns, bitrate, name=address.partition(":")[2].rpartition("/")[2])
        KernelPort(hub, bus, on_lost)
        return hub
    try:
        host, port, name = plugin.parse_address(address)
    except ValueError as error:
        raise BusError(str(error)) from error
    hub = Hub(clock_ns, bitrate, name)
    await hub.listen("socketcand", host, port)
    return hub


class KernelPort:
    """Joins a hub and a python-can bus: frames of each go to the other, until either closes."""

    def __init__(self, hub: Hub, bus: can.BusABC,
                 on_lost: Callable[[BusError], None] | None = None) -> None:
        """Start reading; to be called in the hub's event loop. Owns the bus from now on."""
        self.ignored = 0  # error and CAN FD frames
        self.error: BusError | None = None
        self._bus = bus
        self._on_lost = on_lost
        self._loop = asyncio.get_running_loop()
        self._fileno = _fileno(bus)
        self._port = hub.attach(self._transmit, str(bus.channel_info), self._stop)
        self._notifier: can.Notifier | None = None
        if self._fileno is not None:
            self._loop.add_reader(self._fileno, self._readable)
        else:
            self._notifier = can.Notifier(bus, [_Listener(self)], timeout=0.1, loop=self._loop)

    @property
    def dropped(self) -> int:
        """Frames of the nodes that the python-can bus did not take."""
        return self._port.dropped

    def close(self) -> None:
        """Leave the hub and shut the python-can bus down."""
        self._port.close()

    def _transmit(self, frame: Frame) -> None:
        try:
            self._bus.send(plugin.message_of(frame), timeout=0)
        except can.CanError as error:  # full queue, bus off, or gone
            if self._port.dropped == 0:
                log.warning("%s: frames are lost: %s", self._port.name, error)
            self._port.dropped += 1

    def _readable(self) -> None:
        try:
            for _ in range(BATCH):
                message = self._bus.recv(0)
                if message is None:
                    break
                self.take(message)
        except can.CanError as error:
            self.lose(error)

    def take(self, message: can.Message) -> None:
        """Put a message of the python-can bus on the hub."""
        frame = plugin.frame_of(message)
        if frame is None:
            self.ignored += 1
        else:
            self._port.send(frame)

    def lose(self, cause: Exception) -> None:
        """Close after a failure of the bus, and say so: silence would look like a quiet bus."""
        if self.error is None:
            self.error = BusError(f"CAN bus {self._port.name} failed: {cause}; "
                                  "check the interface and start again")
            self.close()
            if self._on_lost:
                self._on_lost(self.error)
            else:
                self._loop.call_exception_handler(
                    {"message": str(self.error), "exception": self.error})

    def _stop(self) -> None:
        if self._fileno is not None:
            self._loop.remove_reader(self._fileno)
        if self._notifier:
            self._notifier.stop(timeout=0.5)
        self._bus.shutdown()


class _Listener(can.Listener):
    """Hands on what a Notifier's thread reads; it is called in the event loop."""

    def __init__(self, port: KernelPort) -> None:
        self._port = port

    def on_message_received(self, msg: can.Message) -> None:
        self._port.take(msg)

    def on_error(self, exc: Exception) -> None:
        self._port.lose(exc)


def _fileno(bus: can.BusABC) -> int | None:
    """Return the descriptor to wait on, None when the interface has none."""
    try:
        number = bus.fileno()
    except NotImplementedError:
        return None
    return number if number >= 0 else None
