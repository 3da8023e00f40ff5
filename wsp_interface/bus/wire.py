"""The wire of a CAN bus: it carries one frame at a time, of those that wait the lowest identifier.

Frames that are ready wait until the wire is free; then all of them begin together, bit by bit, and
the one with the lowest arbitration field goes on alone and takes its bits' time [A1]. Whatever
becomes ready meanwhile waits for the next turn, however important it is. Each sender may have only
so many frames waiting, as a controller's transmit queue has; more are refused and counted.

    [A1] start = max(t_free, earliest ready), end = start + bits / bitrate

Source: ISO 11898-1, bus access and frame formats. Limits: nominal bits, no stuff bits; a sender's
own frames compete like those of others; two frames with one identifier go in the order in which
they came, where a real bus would see a bit error.
"""

import ctypes
import heapq
import os
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from rollerrig.wsp_interface.bus.frames import S_NS, Frame, bits

# of one sender; a transmit queue of Linux holds 10 by default, a busy one is given a hundred or so
QUEUE_FRAMES = 128
_CLOCK_MONOTONIC, _NONBLOCK_CLOEXEC = 1, os.O_NONBLOCK | os.O_CLOEXEC


class Waiting(NamedTuple):
    """A frame that waits. `carry(end_ns)` is called when its last bit has left the wire."""

    field: int
    number: int
    ready_ns: int
    bit_time_ns: int
    origin: Hashable
    carry: Callable[[int], None]


def arbitration_field(frame: Frame) -> int:
    """The bits that decide, the lower number wins: base before extended with the same 11 bits, data before remote."""
    if frame.extended:
        # SRR and IDE are recessive between the two parts of the identifier
        return frame.can_id >> 18 << 21 | 3 << 19 | (frame.can_id & 0x3FFFF) << 1 | frame.remote
    return frame.can_id << 21 | frame.remote << 20


class Wire:
    """Frames that wait for one wire of `bitrate` bit/s, free from `start_ns` on."""

    def __init__(self, bitrate: int, start_ns: int, queue_frames: int = QUEUE_FRAMES) -> None:
        self.bitrate, self.queue_frames = bitrate, queue_frames
        self.free_ns = start_ns
        self.longest_wait_ns = 0
        self._coming: list[tuple[int, int, Waiting]] = []  # by the time at which they are ready
        self._contending: list[Waiting] = []  # by arbitration field
        self._begin_ns = start_ns  # of the next turn, while anybody contends for it
        self._queued: Counter[Hashable] = Counter()
        self._number = 0

    def __len__(self) -> int:
        return len(self._coming) + len(self._contending)

    def offer(
        self, frame: Frame, ready_ns: int, origin: Hashable, carry: Callable[[int], None]
    ) -> bool:
        """Let a frame wait from `ready_ns` on; False where its origin has too many waiting."""
        if self._queued[origin] >= self.queue_frames:
            return False
        self._queued[origin] += 1
        self._number += 1
        one = Waiting(
            arbitration_field(frame),
            self._number,
            ready_ns,
            bits(frame) * S_NS // self.bitrate,
            origin,
            carry,
        )
        heapq.heappush(self._coming, (ready_ns, self._number, one))
        return True

    def occupy(self, frame: Frame, now_ns: int) -> None:
        """Take the wire for a frame that error frames destroy."""
        self.free_ns = max(self.free_ns, now_ns) + bits(frame) * S_NS // self.bitrate

    def end_ns(self) -> int | None:
        """When the next frame will have left the wire, as far as is known now; None: none waits."""
        one = self._next()
        return None if one is None else self._begin_ns + one.bit_time_ns

    def take(self, now_ns: int) -> tuple[Waiting, int] | None:
        """The next frame that has left the wire by now, and when; None where there is none."""
        one = self._next()
        if one is None or self._begin_ns + one.bit_time_ns > now_ns:
            return None
        heapq.heappop(self._contending)
        self._queued[one.origin] -= 1
        self.free_ns = self._begin_ns + one.bit_time_ns
        self.longest_wait_ns = max(self.longest_wait_ns, self._begin_ns - one.ready_ns)
        return one, self.free_ns

    def _next(self) -> Waiting | None:
        """The frame that wins the next turn, of those which are ready when it begins."""
        if not len(self):
            return None
        first_ns = self._begin_ns if self._contending else self._coming[0][0]
        self._begin_ns = max(self.free_ns, first_ns)  # [A1]
        while self._coming and self._coming[0][0] <= self._begin_ns:
            heapq.heappush(self._contending, heapq.heappop(self._coming)[2])
        return self._contending[0]


class Alarm:
    """A descriptor readable after a time in ns: event loops wake a millisecond late. OSError without timerfd."""

    def __init__(self) -> None:
        self._libc: Any = ctypes.CDLL(None, use_errno=True)
        self.fileno = int(self._libc.timerfd_create(_CLOCK_MONOTONIC, _NONBLOCK_CLOEXEC))
        if self.fileno < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def set(self, after_ns: int) -> None:
        """Ring once, `after_ns` from now."""
        after_s, rest_ns = divmod(max(after_ns, 1), S_NS)
        spec = (ctypes.c_long * 4)(0, 0, after_s, rest_ns)
        self._libc.timerfd_settime(self.fileno, 0, ctypes.byref(spec), None)

    def hear(self) -> None:
        """Take note that it has rung."""
        try:
            os.read(self.fileno, 8)
        except BlockingIOError:
            return

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self.fileno)
