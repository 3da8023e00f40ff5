"""A CAN frame, how long it occupies the wire, and its line in a candump log.

A frame carries an identifier and up to eight bytes; the start bit, identifier, checksum and pauses
around them make a base data frame of n bytes 47 + 8 n bits, an extended one 67 + 8 n. The bits are
nominal, or with the most stuff bits that the rule of five equal bits can force: 111 and 135 bits
for eight bytes. A bus takes one frame at a time: t_free = max(t, t_free) + bits / bitrate  [F1].

Source: ISO 11898-1 (frame formats); can-utils `candump -L` (log line).
Limits: classical CAN only. No arbitration: frames are timed in the order in which they were sent.
"""

from typing import NamedTuple

BASE_ID_MAX = 0x7FF
EXTENDED_ID_MAX = 0x1FFF_FFFF
DATA_MAX = 8
S_NS = 1_000_000_000
ERROR_FLAG = 0x2000_0000  # of identifiers in logs, as Linux has it

# a tenth of a second behind: no burst of a sane sender, the bus cannot carry what is offered
OVERLOAD_BACKLOG_NS = 100_000_000


class Frame(NamedTuple):
    """One classical CAN frame."""

    can_id: int  # 11 bits, or 29 when `extended`
    data: bytes  # 0..8 bytes, empty in a remote frame
    extended: bool = False
    remote: bool = False  # remote transmission request (RTR)
    dlc: int = 0  # data length that a remote frame asks for; a data frame's is len(data)
    time_ns: int = 0  # stamped by the bus when it carries the frame
    error: bool = False  # an error frame, which only taps see: can_id is its class


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
    """Return the bits on the wire with interframe space: nominal, or with the most stuff bits.

    Source: ISO 11898-1; 34 (base) or 54 (extended) bits besides the data are subject to stuffing.
    """
    payload = 8 * len(frame.data)
    stuffed = (payload + (54 if frame.extended else 34) - 1) // 4 if worst else 0
    return payload + (67 if frame.extended else 47) + stuffed


def candump_line(frame: Frame, channel: str = "rig0") -> str:
    """Return the frame as a line of a candump log, without the newline; [s] with six decimals."""
    seconds, rest_ns = divmod(frame.time_ns, S_NS)
    can_id = (
        f"{frame.can_id | ERROR_FLAG * frame.error:0{8 if frame.extended or frame.error else 3}X}"
    )
    body = f"R{frame.dlc or ''}" if frame.remote else frame.data.hex().upper()
    return f"({seconds:010d}.{rest_ns // 1000:06d}) {channel} {can_id}#{body}"


class BusLoad:
    """How busy a bus of one bit rate is: over the run, and whether it fell behind."""

    def __init__(self, bitrate: int, start_ns: int) -> None:
        if bitrate <= 0:
            raise ValueError(f"CAN bus: bitrate {bitrate} bit/s, allowed is more than 0")
        self.bitrate, self.start_ns = bitrate, start_ns
        self.frames = self.bits = 0
        self.free_ns = start_ns  # when the wire is free again
        self.overloaded = False  # stays set once it was

    def carry(self, frame: Frame, now_ns: int) -> None:
        """Account for one frame at now_ns. [F1]"""
        frame_bits = bits(frame)
        self.frames += 1
        self.bits += frame_bits
        free_ns = self.free_ns
        if free_ns - now_ns > OVERLOAD_BACKLOG_NS:
            self.overloaded = True
        self.free_ns = (
            free_ns if free_ns > now_ns else now_ns
        ) + frame_bits * S_NS // self.bitrate  # [F1]

    def run_percent(self, now_ns: int) -> float:
        """Return the load since the start: bits offered over bits that fit, in percent."""
        elapsed_ns = now_ns - self.start_ns
        return 100.0 * self.bits * S_NS / self.bitrate / elapsed_ns if elapsed_ns > 0 else 0.0
