"""CAN interfaces of the Linux kernel: which there are, one bench on each, their errors and losses.

Sources: Linux Documentation/networking/can.rst, linux/can/error.h, linux/if_arp.h, linux/rtnetlink.h
and linux/sock_diag.h (SO_MEMINFO).
"""

import contextlib
import errno
import socket
import struct
from pathlib import Path
from typing import NamedTuple

import can

from rollerrig.configs.errors import BusError

SYSFS = Path("/sys/class/net")
ENABLE_AF_CAN = "this kernel has no SocketCAN: sudo modprobe can_raw, or a kernel with CONFIG_CAN"
# the burst of a SYNC of 16 nodes with four PDOs each
SHORTEST_QUEUE = 64
_ARPHRD_CAN = "280"
_IFF_UP = 1
_RECEIVE_BYTES = 1 << 22
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55
_MEMORY, _DROPS = struct.Struct("=9I"), 8
# a netlink message's head, and what follows in one about a link: RTM_NEWLINK and RTM_DELLINK
_NETLINK, _LINK, _NEW_LINK, _DEL_LINK, _LINK_GROUP = (
    struct.Struct("=IHHII"),
    struct.Struct("=BxHiII"),
    16,
    17,
    1,
)
BUS_OFF = 0x40
# class of an error frame, bits of its second data byte (0: any), what it says
ERRORS = (
    (0x01, 0, "a frame could not be sent in time"),
    (0x04, 0x03, "the controller's buffer has overflowed"),
    (0x04, 0x0C, "the controller's error counter is above 96 (error warning)"),
    (0x04, 0x30, "the controller is error-passive"),
    (0x20, 0, "nobody acknowledges: no other node is on the bus, or it has another bit rate"),
    (BUS_OFF, 0, "the controller is bus-off"),
    (0x100, 0, "the controller has been restarted after bus-off"),
    (0x88, 0, "errors on the wire"),
)


class KernelCan(NamedTuple):
    """What this machine offers of SocketCAN."""

    af_can: bool  # raw CAN sockets can be made
    up: tuple[str, ...]  # CAN interfaces that are up
    down: tuple[str, ...]
    hints: tuple[str, ...]  # how to enable what is missing


def available(sysfs: Path = SYSFS) -> KernelCan:
    """Return which CAN sockets and interfaces this machine has, and how to get the others."""
    af_can = _has_af_can()
    up: list[str] = []
    down: list[str] = []
    hints = [] if af_can else [ENABLE_AF_CAN]
    for entry in sorted(
        one.parent for one in sysfs.glob("*/type") if one.read_text().strip() == _ARPHRD_CAN
    ):
        name = entry.name
        if not int((entry / "flags").read_text(), 16) & _IFF_UP:
            down.append(name)
            hints.append(f"{name} is down: {_bring_up(name)}")
            continue
        up.append(name)
        queue = entry / "tx_queue_len"
        if (
            queue.exists()
            and int(queue.read_text()) < SHORTEST_QUEUE
            and not name.startswith("vcan")
        ):
            hints.append(
                f"{name} queues {queue.read_text().strip()} frames, a SYNC's burst may be longer: "
                f"sudo ip link set {name} txqueuelen 1000"
            )
    if af_can and not (up or down):
        hints.append(f"no CAN interface: {make('vcan0')}")
    return KernelCan(af_can, tuple(up), tuple(down), tuple(hints))


def make(name: str) -> str:
    """How to get an interface that is absent."""
    if name.startswith("vcan"):
        return f"sudo modprobe vcan && sudo ip link add {name} type vcan && {_bring_up(name)}"
    return f"connect the adapter and load its driver ('ip link' lists the interfaces), then {_bring_up(name)}"


def _bring_up(name: str) -> str:
    return f"sudo ip link set {name} up" + (
        "" if name.startswith("vcan") else " type can bitrate 500000"
    )


def _has_af_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def require(address: str, channel: str, instead: str, kernel: KernelCan) -> None:
    """Raise BusError unless the CAN interface is there and up."""
    if not kernel.af_can:
        raise BusError(f"bus address {address!r}: {ENABLE_AF_CAN}; {instead}")
    if channel not in kernel.up:
        what, mend = (
            ("down", _bring_up(channel)) if channel in kernel.down else ("absent", make(channel))
        )
        raise BusError(
            f"bus address {address!r}: CAN interface {channel} is {what}; allowed here: "
            f"{', '.join(kernel.up) or 'none'}; to mend: {mend}; {instead}"
        )


class Interface:
    """A bench's place on a CAN interface that is up, for one bench at a time.

    `link` is a socket that is readable when `is_down` should be asked. Raises BusError where another
    bench is on the interface.
    """

    def __init__(self, bus: can.BusABC, channel: str) -> None:
        self._socket: socket.socket = bus.socket  # type: ignore[attr-defined]
        # a name that the kernel forgets with its holder, in the network that the interface is in
        self._mark = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._mark.bind(f"\0rollerrig bench on {channel}")
        except OSError:
            self._mark.close()
            raise BusError(
                f"bus address 'socketcan:{channel}': another bench is on {channel}; end it, or give "
                "this one its own bus: --set bus.interface=hub"
            ) from None
        self._channel, self._index = channel, socket.if_nametoindex(channel)
        self.link = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK)
        self.link.bind((0, _LINK_GROUP))
        self._dropped = 0
        for option in (_SO_RCVBUFFORCE, socket.SO_RCVBUF):  # the first wants CAP_NET_ADMIN
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, option, _RECEIVE_BYTES)
                break

    def is_down(self) -> bool:
        """Whether the interface has been set down, or removed, since the last time."""
        down = False
        while True:
            try:
                message = self.link.recv(1 << 16)
            except BlockingIOError:
                return down
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
                down |= self._channel not in available().up  # so many changes that some are lost
                continue
            while len(message) >= _NETLINK.size + _LINK.size:
                length, kind = _NETLINK.unpack_from(message)[:2]
                _, _, index, flags, _ = _LINK.unpack_from(message, _NETLINK.size)
                down |= index == self._index and (
                    kind == _DEL_LINK or (kind == _NEW_LINK and not flags & _IFF_UP)
                )
                message = message[max((length + 3) & ~3, _NETLINK.size) :]

    def newly_dropped(self) -> int:
        """Frames that came faster than they were read, and were lost, since the last time."""
        before = self._dropped
        memory = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMORY.size)
        self._dropped = _MEMORY.unpack(memory)[_DROPS]
        return self._dropped - before

    def close(self) -> None:
        """Let another bench have the interface."""
        self._mark.close()
        self.link.close()


def meanings(message: can.Message) -> list[str]:
    """What an error frame of a controller says."""
    detail = message.data[1] if len(message.data) > 1 else 0
    return [
        text
        for kind, bits, text in ERRORS
        if message.arbitration_id & kind and (not bits or detail & bits)
    ]
