"""CAN interfaces of the Linux kernel (SocketCAN).

This module lists the interfaces of the machine and reserves an interface for one bench. It reports
when the interface goes down and how many frames were lost, and it explains error frames.

Sources: Linux Documentation/networking/can.rst, linux/can/error.h, linux/if_arp.h,
linux/rtnetlink.h and linux/sock_diag.h (SO_MEMINFO).
"""

import contextlib
import errno
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import can

from rollerrig.configs.errors import BusError

SYSFS = Path("/sys/class/net")
ENABLE_AF_CAN = (
    "this kernel has no SocketCAN: sudo modprobe can_raw, or use a kernel with CONFIG_CAN"
)
# Frames that an interface should be able to queue: after a SYNC, 16 nodes may send four PDOs each
# in one burst.
SHORTEST_QUEUE = 64

_ARPHRD_CAN = "280"  # the type of a CAN interface in sysfs, from linux/if_arp.h
_IFF_UP = 1  # flag of an interface that is up

_RECEIVE_BYTES = 1 << 22  # receive buffer of the socket: frames wait here while the bench is busy
# socket options of asm-generic/socket.h that Python's socket module does not name
_SO_RCVBUFFORCE = 33
_SO_MEMINFO = 55
# SO_MEMINFO returns nine numbers (linux/sock_diag.h); the last one counts the dropped frames
_MEMORY = struct.Struct("=9I")
_DROPS = 8  # SK_MEMINFO_DROPS

# netlink: the head of every message (nlmsghdr: length, type, flags, sequence number, port), then
# the head of a message about a link (ifinfomsg: family, type, index, flags, change mask)
_NETLINK = struct.Struct("=IHHII")
_LINK = struct.Struct("=BxHiII")
_NEW_LINK = 16  # RTM_NEWLINK: a link was added or changed
_DEL_LINK = 17  # RTM_DELLINK
_LINK_GROUP = 1  # RTMGRP_LINK
_NETLINK_BYTES = 1 << 16  # largest read: several messages


class ErrorKind(NamedTuple):
    """A condition that error frames report."""

    classes: int  # the identifier of the error frame has one of these bits
    details: int  # and its data byte 1 has one of these bits; 0: whatever the byte is
    text: str


# classes of errors, from linux/can/error.h
_TX_TIMEOUT = 0x01
_CONTROLLER = 0x04
_PROTOCOL = 0x08
_NO_ACKNOWLEDGE = 0x20
BUS_OFF = 0x40
_BUS_ERROR = 0x80
_RESTARTED = 0x100
# details of _CONTROLLER, each for receiving or transmitting
_OVERFLOW = 0x03
_WARNING = 0x0C
_PASSIVE = 0x30
ERRORS = (
    ErrorKind(_TX_TIMEOUT, 0, "a frame could not be sent in time"),
    ErrorKind(_CONTROLLER, _OVERFLOW, "the controller's buffer has overflowed"),
    ErrorKind(_CONTROLLER, _WARNING, "the controller's error counter is above 96 (error warning)"),
    ErrorKind(_CONTROLLER, _PASSIVE, "the controller is error-passive"),
    ErrorKind(
        _NO_ACKNOWLEDGE,
        0,
        "no node acknowledges: no other node is on the bus, or it has another bit rate",
    ),
    ErrorKind(BUS_OFF, 0, "the controller is bus-off"),
    ErrorKind(_RESTARTED, 0, "the controller has been restarted after bus-off"),
    ErrorKind(_BUS_ERROR | _PROTOCOL, 0, "errors on the wire"),
)


class KernelCan(NamedTuple):
    """The SocketCAN sockets and interfaces of this machine."""

    af_can: bool  # raw CAN sockets can be opened
    up: tuple[str, ...]  # CAN interfaces that are up
    down: tuple[str, ...]  # CAN interfaces that are down
    hints: tuple[str, ...]  # how to enable what is missing


def available(sysfs: Path = SYSFS) -> KernelCan:
    """Return the CAN sockets and interfaces of this machine, and how to get the missing ones."""
    af_can = _has_af_can()
    up: list[str] = []
    down: list[str] = []
    hints: list[str] = []
    if not af_can:
        hints.append(ENABLE_AF_CAN)

    for entry in _interfaces(sysfs):
        name = entry.name
        flags = int((entry / "flags").read_text(), 16)
        if not flags & _IFF_UP:
            down.append(name)
            hints.append(f"{name} is down: {_bring_up(name)}")
            continue
        up.append(name)
        queue_file = entry / "tx_queue_len"
        if name.startswith("vcan") or not queue_file.exists():
            continue
        queue_frames = int(queue_file.read_text())
        if queue_frames < SHORTEST_QUEUE:
            hints.append(
                f"{name} queues {queue_frames} frames, and the burst after a SYNC may be longer: "
                f"sudo ip link set {name} txqueuelen 1000"
            )

    if af_can and not (up or down):
        hints.append(f"no CAN interface: {how_to_create('vcan0')}")
    return KernelCan(af_can, tuple(up), tuple(down), tuple(hints))


def _interfaces(sysfs: Path) -> Iterator[Path]:
    """Yield the folders of all CAN interfaces, by name."""
    for file in sorted(sysfs.glob("*/type")):
        if file.read_text().strip() == _ARPHRD_CAN:
            yield file.parent


def how_to_create(name: str) -> str:
    """Return what to do to get a CAN interface that does not exist."""
    if name.startswith("vcan"):
        return f"sudo modprobe vcan && sudo ip link add {name} type vcan && {_bring_up(name)}"
    return (
        "connect the adapter and load its driver ('ip link' lists the interfaces), "
        f"then {_bring_up(name)}"
    )


def _bring_up(name: str) -> str:
    if name.startswith("vcan"):
        return f"sudo ip link set {name} up"
    return f"sudo ip link set {name} up type can bitrate 500000"


def _has_af_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def require(address: str, channel: str, instead: str, kernel: KernelCan) -> None:
    """Raise BusError unless the CAN interface exists and is up.

    `instead` ends the message: what the user can do without the interface.
    """
    if not kernel.af_can:
        raise BusError(f"bus address {address!r}: {ENABLE_AF_CAN}; {instead}")
    if channel in kernel.up:
        return
    if channel in kernel.down:
        state = "down"
        remedy = _bring_up(channel)
    else:
        state = "absent"
        remedy = how_to_create(channel)
    raise BusError(
        f"bus address {address!r}: CAN interface {channel} is {state}; allowed here: "
        f"{', '.join(kernel.up) or 'none'}; to fix this: {remedy}; {instead}"
    )


class Interface:
    """A CAN interface that is up, reserved for this bench until `close`.

    `link` is a socket that becomes readable when the interface may have gone down: then call
    `is_down`. Raises BusError when another bench is on the interface.
    """

    def __init__(self, bus: can.BusABC, channel: str) -> None:
        self._socket: socket.socket = bus.socket  # type: ignore[attr-defined]
        self._channel = channel
        self._mark = _mark(channel)
        self._index = socket.if_nametoindex(channel)
        self.link = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK)
        self.link.bind((0, _LINK_GROUP))
        self._dropped = 0
        self._enlarge_receive_buffer()

    def _enlarge_receive_buffer(self) -> None:
        try:
            # needs CAP_NET_ADMIN
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BYTES)
        except OSError:
            # needs nothing, but the kernel limits the size (net.core.rmem_max)
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)

    def is_down(self) -> bool:
        """Return whether the interface has gone down, or was removed, since the last call."""
        down = False
        while True:
            try:
                messages = self.link.recv(_NETLINK_BYTES)
            except BlockingIOError:
                return down
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
                # so many changes that the kernel has lost some: look at the interface itself
                if self._channel not in available().up:
                    down = True
                continue
            if self._reports_down(messages):
                down = True

    def _reports_down(self, messages: bytes) -> bool:
        """Return whether one of these netlink messages sets the interface down or removes it."""
        down = False
        while len(messages) >= _NETLINK.size + _LINK.size:
            length, kind = _NETLINK.unpack_from(messages)[:2]
            _, _, index, flags, _ = _LINK.unpack_from(messages, _NETLINK.size)
            if index == self._index:
                was_removed = kind == _DEL_LINK
                was_set_down = kind == _NEW_LINK and not flags & _IFF_UP
                down = down or was_removed or was_set_down
            # messages are aligned to four bytes; a wrong length must not stop the loop's progress
            aligned_length = (length + 3) & ~3
            messages = messages[max(aligned_length, _NETLINK.size) :]
        return down

    def newly_dropped(self) -> int:
        """Return how many frames the socket has lost since the last call.

        It loses frames that arrive while its receive buffer is full.
        """
        before = self._dropped
        memory = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMORY.size)
        self._dropped = _MEMORY.unpack(memory)[_DROPS]
        return self._dropped - before

    def close(self) -> None:
        """Release the interface for another bench."""
        self._mark.close()
        self.link.close()


def _mark(channel: str) -> socket.socket:
    """Return a socket that marks the interface as used by a bench.

    Raises BusError when another bench has marked it. The mark is the abstract name of the socket.
    It belongs to the network namespace of the interface, and the kernel removes it when the process
    exits, however it exits.
    """
    mark = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        mark.bind(f"\0rollerrig bench on {channel}")
    except OSError:
        mark.close()
        raise BusError(
            f"bus address 'socketcan:{channel}': another bench is on {channel}; stop it, or give "
            "this bench a separate bus: --set bus.interface=hub"
        ) from None
    return mark


def error_texts(message: can.Message) -> list[str]:
    """Return what an error frame of a controller reports, as sentences."""
    details = message.data[1] if len(message.data) > 1 else 0
    texts = []
    for error in ERRORS:
        if not message.arbitration_id & error.classes:
            continue
        if error.details == 0 or details & error.details:
            texts.append(error.text)
    return texts
