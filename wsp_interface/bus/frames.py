"""A CAN frame, the time that it occupies the wire, and its line in a candump log.

A frame carries an identifier and up to eight data bytes. With the start bit, checksum and pauses
around them, a base data frame of n bytes has 47 + 8 n bits and an extended one has 67 + 8 n bits.
Stuff bits come on top: the rule of five equal bits adds at most 24 of them to a base frame of
eight bytes, so such a frame has 111 bits nominally and 135 bits at most. A bus carries one frame
at a time: t_free = max(t, t_free) + bits / bitrate  [F1].

Source: ISO 11898-1 (frame formats); can-utils `candump -L` (log line).
Limits: classical CAN only. No arbitration here: frames are timed in the order in which they are
sent. `wire` adds arbitration.
"""

from typing import NamedTuple

BASE_ID_MAX = 0x7FF
EXTENDED_ID_MAX = 0x1FFF_FFFF
DATA_MAX = 8
S_NS = 1_000_000_000

# flags of an identifier in 32 bits, as linux/can.h defines them
EXTENDED_FLAG = 0x8000_0000
REMOTE_FLAG = 0x4000_0000
ERROR_FLAG = 0x2000_0000

# bits of a frame around its data, with the pause of three bits to the next frame
_BASE_BITS = 47
_EXTENDED_BITS = 67
# of these, the bits that are subject to stuffing
_BASE_STUFFED = 34
_EXTENDED_STUFFED = 54

# The bus counts as overloaded when it is a tenth of a second behind its senders. No burst of a
# correct sender is that long, so the bus cannot carry the offered load.
OVERLOAD_BACKLOG_NS = 100_000_000


class Frame(NamedTuple):
    """One classical CAN frame."""

    can_id: int  # 11 bits, or 29 when `extended`
    data: bytes  # 0..8 bytes, empty in a remote frame
    extended: bool = False
    remote: bool = False  # remote transmission request (RTR)
    dlc: int = 0  # data length that a remote frame requests; a data frame's is len(data)
    time_ns: int = 0  # the bus stamps the frame when it carries it
    error: bool = False  # an error frame, visible to taps only: can_id is its class


def check(frame: Frame) -> Frame:
    """Return the frame, or raise ValueError when no CAN controller could send it."""
    highest = EXTENDED_ID_MAX if frame.extended else BASE_ID_MAX
    if not 0 <= frame.can_id <= highest:
        raise ValueError(f"CAN frame: identifier {frame.can_id:X}h is not within 0..{highest:X}h")
    if len(frame.data) > DATA_MAX or not 0 <= frame.dlc <= DATA_MAX:
        raise ValueError(f"CAN frame {frame.can_id:X}h: {length(frame)} bytes, allowed 0..8")
    if frame.remote and frame.data:
        raise ValueError(f"CAN frame {frame.can_id:X}h: a remote frame carries no data, use dlc")
    return frame


def length(frame: Frame) -> int:
    """Return the data length code, 0..8."""
    return frame.dlc if frame.remote else len(frame.data)


def bits(frame: Frame, worst: bool = False) -> int:
    """Return the bits on the wire, with the pause to the next frame.

    `worst` adds the largest number of stuff bits that the frame can have; else there are none.
    Source: ISO 11898-1; besides the data, 34 bits (base) or 54 bits (extended) can be stuffed.
    """
    around = _EXTENDED_BITS if frame.extended else _BASE_BITS
    data_bits = 8 * len(frame.data)
    if not worst:
        return data_bits + around
    stuffable = data_bits + (_EXTENDED_STUFFED if frame.extended else _BASE_STUFFED)
    return data_bits + around + (stuffable - 1) // 4


def candump_line(frame: Frame, channel: str = "rig0") -> str:
    """Return the frame as a line of a candump log, without the newline; the time is in s."""
    seconds, rest_ns = divmod(frame.time_ns, S_NS)
    time = f"{seconds:010d}.{rest_ns // 1000:06d}"

    if frame.error:
        can_id = f"{frame.can_id | ERROR_FLAG:08X}"
    elif frame.extended:
        can_id = f"{frame.can_id:08X}"
    else:
        can_id = f"{frame.can_id:03X}"

    body = f"R{frame.dlc or ''}" if frame.remote else frame.data.hex().upper()
    return f"({time}) {channel} {can_id}#{body}"


class BusLoad:
    """Counts how much a bus of one bit rate carries, and whether it falls behind its senders.

    frames, bits: what the bus has carried since `start_ns`.
    free_ns: when the wire is free again.
    overloaded: true as soon as the bus has once been too far behind, and from then on.
    """

    def __init__(self, bitrate: int, start_ns: int) -> None:
        if bitrate <= 0:
            raise ValueError(f"CAN bus: bitrate {bitrate} bit/s, allowed is more than 0")
        self.bitrate = bitrate
        self.start_ns = start_ns
        self.frames = 0
        self.bits = 0
        self.free_ns = start_ns
        self.overloaded = False

    def carry(self, frame: Frame, now_ns: int) -> None:
        """Count one frame that is sent at now_ns [F1]."""
        frame_bits = bits(frame)
        self.frames += 1
        self.bits += frame_bits
        begin_ns = self.free_ns
        if begin_ns - now_ns > OVERLOAD_BACKLOG_NS:
            self.overloaded = True
        if begin_ns <= now_ns:
            begin_ns = now_ns
        self.free_ns = begin_ns + frame_bits * S_NS // self.bitrate  # [F1]

    def run_percent(self, now_ns: int) -> float:
        """Return the load since the start in percent: bits offered over bits that fit."""
        elapsed_ns = now_ns - self.start_ns
        if elapsed_ns <= 0:
            return 0.0
        return 100.0 * self.bits * S_NS / self.bitrate / elapsed_ns
