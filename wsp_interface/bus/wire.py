"""The wire of a CAN bus: it carries one frame at a time, and the lowest identifier goes first.

Frames that are ready wait until the wire is free. Then all of them begin together, bit by bit; the
frame with the lowest arbitration field wins and occupies the wire for its bits' time [A1]. A frame
that becomes ready meanwhile waits for the next arbitration, however important it is. Each sender
may have a limited number of frames waiting, like the transmit queue of a controller; the wire
refuses further ones.

    [A1] start = max(t_free, earliest ready), end = start + bits / bitrate

Source: ISO 11898-1, bus access and frame formats. Limits: nominal bits, no stuff bits; frames of
one sender compete with each other like those of others; two frames with the same identifier go in
the order in which they were offered, where a real bus would have a bit error.
"""

import ctypes
import heapq
import os
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from rollerrig.wsp_interface.bus.frames import S_NS, Frame, bits

# Frames of one sender. A transmit queue of Linux holds 10 by default; about a hundred are usual on
# a busy bus.
QUEUE_FRAMES = 128

# bits below the first part of the identifier in the arbitration field of an extended frame
_SRR_AND_IDE = 0b11  # both recessive
_LOW_ID_BITS = 18  # of 29

# timerfd_create, from linux/timerfd.h
_CLOCK_MONOTONIC = 1
_NONBLOCK_CLOEXEC = os.O_NONBLOCK | os.O_CLOEXEC


class Waiting(NamedTuple):
    """A frame that waits. `carry(end_ns)` is called when its last bit has left the wire.

    The order of the fields is the order of arbitration: the lowest field wins, then the frame that
    was offered first.
    """

    field: int
    number: int
    ready_ns: int
    bit_time_ns: int
    origin: Hashable
    carry: Callable[[int], None]


def arbitration_field(frame: Frame) -> int:
    """Return the bits that decide the arbitration; the lower number wins.

    With the same first 11 bits, a base frame beats an extended one. With the same identifier, a
    data frame beats a remote one.
    """
    if frame.extended:
        high_id = frame.can_id >> _LOW_ID_BITS
        low_id = frame.can_id & ((1 << _LOW_ID_BITS) - 1)
        return high_id << 21 | _SRR_AND_IDE << 19 | low_id << 1 | frame.remote
    return frame.can_id << 21 | frame.remote << 20


class Wire:
    """Frames that wait for one wire.

    bitrate: in bit/s.
    start_ns: from when on the wire is free.
    queue_frames: how many frames of one sender may wait.

    `longest_wait_ns` is the longest time from ready to the start of transmission so far.
    """

    def __init__(self, bitrate: int, start_ns: int, queue_frames: int = QUEUE_FRAMES) -> None:
        self.bitrate = bitrate
        self.queue_frames = queue_frames
        self.free_ns = start_ns
        self.longest_wait_ns = 0
        # frames that are not ready before the next arbitration: (ready_ns, number, frame)
        self._coming: list[tuple[int, int, Waiting]] = []
        self._contending: list[Waiting] = []  # by arbitration field
        self._begin_ns = start_ns  # of the next arbitration, while a frame contends for it
        self._queued: Counter[Hashable] = Counter()  # frames that wait, of each sender
        self._number = 0

    def __len__(self) -> int:
        return len(self._coming) + len(self._contending)

    def offer(
        self, frame: Frame, ready_ns: int, origin: Hashable, carry: Callable[[int], None]
    ) -> bool:
        """Queue a frame that is ready at `ready_ns`.

        Return False, and do not queue it, when the queue of its origin is full.
        """
        if self._queued[origin] >= self.queue_frames:
            return False
        self._queued[origin] += 1
        self._number += 1
        waiting = Waiting(
            arbitration_field(frame),
            self._number,
            ready_ns,
            bits(frame) * S_NS // self.bitrate,
            origin,
            carry,
        )
        heapq.heappush(self._coming, (ready_ns, self._number, waiting))
        return True

    def occupy(self, frame: Frame, now_ns: int) -> None:
        """Occupy the wire for the time of a frame that an error frame destroys."""
        self.free_ns = max(self.free_ns, now_ns) + bits(frame) * S_NS // self.bitrate

    def end_ns(self) -> int | None:
        """Return when the next frame will have left the wire, as far as known now.

        None when no frame waits.
        """
        winner = self._winner()
        if winner is None:
            return None
        return self._begin_ns + winner.bit_time_ns

    def take(self, now_ns: int) -> tuple[Waiting, int] | None:
        """Remove the next frame that has left the wire by now; return it and the time of its end.

        None when there is no such frame.
        """
        winner = self._winner()
        if winner is None or self._begin_ns + winner.bit_time_ns > now_ns:
            return None
        heapq.heappop(self._contending)
        self._queued[winner.origin] -= 1
        self.free_ns = self._begin_ns + winner.bit_time_ns
        self.longest_wait_ns = max(self.longest_wait_ns, self._begin_ns - winner.ready_ns)
        return winner, self.free_ns

    def _winner(self) -> Waiting | None:
        """Return the frame that wins the next arbitration; None when no frame waits."""
        if not len(self):
            return None
        first_ns = self._begin_ns if self._contending else self._coming[0][0]
        self._begin_ns = max(self.free_ns, first_ns)  # [A1]
        while self._coming and self._coming[0][0] <= self._begin_ns:
            _, _, ready = heapq.heappop(self._coming)
            heapq.heappush(self._contending, ready)
        return self._contending[0]


class Alarm:
    """A file descriptor that becomes readable after a time in ns (timerfd of Linux).

    The timers of an event loop are up to a millisecond late, which is several frames. Raises
    OSError where the kernel has no timerfd.
    """

    def __init__(self) -> None:
        self._libc: Any = ctypes.CDLL(None, use_errno=True)
        self.fileno = int(self._libc.timerfd_create(_CLOCK_MONOTONIC, _NONBLOCK_CLOEXEC))
        if self.fileno < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def set(self, after_ns: int) -> None:
        """Make the descriptor readable once, `after_ns` from now."""
        after_s, rest_ns = divmod(max(after_ns, 1), S_NS)
        # struct itimerspec: the interval (none), then the first expiration
        spec = (ctypes.c_long * 4)(0, 0, after_s, rest_ns)
        self._libc.timerfd_settime(self.fileno, 0, ctypes.byref(spec), None)

    def acknowledge(self) -> None:
        """Make the descriptor unreadable again."""
        try:
            os.read(self.fileno, 8)
        except BlockingIOError:
            return

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self.fileno)
