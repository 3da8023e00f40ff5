"""The protocols in which programs outside join the bus, one row of `CODECS` each.

A session turns the bytes of one TCP client into frames, answers and changes of mode, however the
bytes were cut into segments; an encoder turns a frame of the bus into bytes, once for all clients.
Neither touches a socket or the hub, so a further protocol is a further row. Whatever cannot be
understood is answered with an error or skipped; a binary stream out of step closes its client.

Sources: socketcand `doc/protocol.md` and `state_raw.c` (`sendrtr` and `rtr` are official there,
older clients know only `send` and `frame`); LAWICEL CAN232 manual (slcan); virtualcan's
`can_message.py` and gocanopen's virtual bus; cannelloni `doc/tcp_protocol.md`.
"""

import re
import struct
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import NamedTuple, Protocol, TypeAlias

from rollerrig.wsp_interface.bus.frames import BASE_ID_MAX, DATA_MAX, EXTENDED_ID_MAX, S_NS, Frame

COMMAND_MAX = 256  # the longest legal text command has about 60 characters
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x8000_0000, 0x4000_0000, 0x2000_0000  # linux/can.h


class Mode(IntEnum):
    """What the hub has to do with a client from here on."""

    LISTEN = 1  # gets the frames of the bus
    MUTE = 2  # gets none any more
    CLOSE = 3  # is sent what it still has to get, then closed


# a frame for the bus, an answer for the client, a change of mode
Event: TypeAlias = Frame | bytes | Mode


class Session(Protocol):
    """The state of one client's protocol."""

    def __init__(self, bus_name: str) -> None: ...

    def begin(self) -> Iterator[Event]:
        """Yield what a client gets when it connects."""

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield what follows from the next bytes, cut anywhere."""


# --- socketcand -----------------------------------------------------------------------------

_hex = re.compile(rb"[0-9A-Fa-f]{1,16}").fullmatch
# the tokens that occur, looked up instead of parsed
_BYTES = {f % n: n for f in (b"%x", b"%X", b"%02x", b"%02X") for n in range(256)}


class SocketcandState(IntEnum):
    """Which commands are understood."""

    NO_BUS = 0
    BUS = 1  # opened; frames may be sent, none come
    RAW = 2


class SocketcandSession:
    """`< hi >`, open, rawmode, then frames both ways."""

    def __init__(self, bus_name: str) -> None:
        self._bus = bus_name
        self._state = SocketcandState.NO_BUS
        self._rest = b""

    def begin(self) -> Iterator[Event]:
        """Yield the greeting."""
        yield b"< hi >"

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield what the commands in the chunk ask for."""
        *commands, self._rest = (self._rest + chunk).split(b">")
        for command in commands:
            # what stands before the last "<" is the rubble of a broken command
            _, bracket, body = command.rpartition(b"<")
            if bracket:
                yield from self._obey(body.split() if len(body) <= COMMAND_MAX else [])
        self._rest = self._rest[self._rest.rfind(b"<"):] if b"<" in self._rest else b""
        if len(self._rest) > COMMAND_MAX:
            self._rest = b""
            yield b"< error command too long >"

    def _obey(self, words: list[bytes]) -> Iterator[Event]:
        verb = words[0] if words else b""
        if verb == b"echo":
            yield b"< echo >"
        elif self._state is SocketcandState.NO_BUS:
            yield from self._open(words)
        elif verb in (b"send", b"sendrtr"):
            yield _parse_send(words) or b"< error malformed %b >" % verb
        elif verb == b"rawmode":
            self._state = SocketcandState.RAW
            yield b"< ok >"
            yield Mode.LISTEN
        elif verb == b"bcmmode" and self._state is SocketcandState.RAW:
            self._state = SocketcandState.BUS
            yield Mode.MUTE
            yield b"< ok >"
        else:
            yield b"< error unknown command >"

    def _open(self, words: list[bytes]) -> Iterator[Event]:
        if len(words) != 2 or words[0] != b"open":
            yield b"< error unknown command >"
        elif words[1] == self._bus.encode():
            self._state = SocketcandState.BUS
            yield b"< ok >"
        else:
            yield b"< error could not open bus, this hub carries %b >" % self._bus.encode()
            yield Mode.CLOSE


def _socketcand_id(word: bytes) -> tuple[int, bool]:
    """Return identifier and whether it is of 29 bits: 8 digits, bit 31, or more than 7FFh."""
    value = int(word, 16) & 0xFFFF_FFFF
    return value & EXTENDED_ID_MAX, len(word) >= 8 or value > BASE_ID_MAX


def _parse_send(words: list[bytes]) -> Frame | None:
    """Return the frame of `send ID DLC b b b` or `sendrtr ID DLC`, None when it is malformed."""
    if len(words) < 3 or not _hex(words[1]) or words[2] not in b"012345678" or len(words[2]) != 1:
        return None
    can_id, extended = _socketcand_id(words[1])
    dlc = int(words[2])
    if words[0] == b"sendrtr":
        return Frame(can_id, b"", extended, True, dlc) if len(words) == 3 else None
    if len(words) != 3 + dlc:
        return None
    try:
        return Frame(can_id, bytes([_BYTES[word] for word in words[3:]]), extended)
    except KeyError:  # a sign-extended byte such as ffffff80, or no number
        if all(_hex(word) for word in words[3:]):
            return Frame(can_id, bytes([int(word, 16) & 0xFF for word in words[3:]]), extended)
        return None


def socketcand_event(frame: Frame) -> bytes:
    """Return the frame as the server says it: `< frame ID sec.usec HEX >` or `< rtr .. DLC >`."""
    seconds, rest_ns = divmod(frame.time_ns, S_NS)
    can_id = (b"%08X" if frame.extended else b"%03X") % frame.can_id
    if frame.remote:
        return b"< rtr %b %d.%06d %d >" % (can_id, seconds, rest_ns // 1000, frame.dlc)
    data = frame.data.hex().upper().encode()
    return b"< frame %b %d.%06d %b >" % (can_id, seconds, rest_ns // 1000, data)


def socketcand_command(frame: Frame) -> bytes:
    """Return the frame as a client says it: `< send ID DLC b b b >` or `< sendrtr ID DLC >`."""
    can_id = (b"%08X" if frame.extended else b"%03X") % frame.can_id
    if frame.remote:
        return b"< sendrtr %b %d >" % (can_id, frame.dlc)
    data = frame.data.hex(" ").encode()
    return b"< send %b %d %b >" % (can_id, len(frame.data), data)


def parse_socketcand_event(body: bytes) -> Frame | None:
    """Return the frame of a server's message without its brackets, None when it is no frame."""
    words = body.split()
    try:
        seconds, _, micros = words[2].partition(b".")
        time_ns = int(seconds) * S_NS + int(micros.ljust(9, b"0")[:9])
        can_id, extended = int(words[1], 16) & EXTENDED_ID_MAX, len(words[1]) == 8
        if words[0] == b"rtr":
            return Frame(can_id, b"", extended, True, min(int(words[3]), DATA_MAX), time_ns)
        if words[0] != b"frame":
            return None
        # data may come in one piece (socketcand) or, from other servers, byte by byte
        return Frame(can_id, bytes.fromhex(b"".join(words[3:]).decode()), extended, time_ns=time_ns)
    except (IndexError, ValueError):
        return None


# --- slcan ----------------------------------------------------------------------------------

_slcan_frame = re.compile(
    rb"(?:([tr])([0-7][0-9A-Fa-f]{2})|([TR])([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2})*)"
).fullmatch
_SLCAN_ANSWERS = {b"V": b"V1013\r", b"v": b"v0100\r", b"N": b"NRIG0\r", b"F": b"F00\r"}
_SLCAN_SETTINGS = re.compile(rb"S[0-8]|s[0-9A-Fa-f]{4,6}|[Mm][0-9A-Fa-f]{8}|[XZW]0|").fullmatch
SLCAN_OK, SLCAN_ERROR = b"\r", b"\a"


class SlcanSession:
    """The LAWICEL serial line over TCP; the bit rate is the hub's, time stamps are off."""

    def __init__(self, bus_name: str) -> None:
        self._rest = b""
        self._may_send = False

    def begin(self) -> Iterator[Event]:
        """Yield nothing: the client speaks first."""
        return iter(())

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield what the lines in the chunk ask for."""
        *lines, self._rest = (self._rest + chunk.replace(b"\n", b"")).split(b"\r")
        for line in lines:
            yield from self._obey(line)
        if len(self._rest) > COMMAND_MAX:
            self._rest = b""
            yield SLCAN_ERROR

    def _obey(self, line: bytes) -> Iterator[Event]:
        if line[:1] in (b"t", b"T", b"r", b"R"):
            frame = _parse_slcan(line) if self._may_send else None
            if frame:
                yield frame
            yield (b"Z\r" if frame.extended else b"z\r") if frame else SLCAN_ERROR
        elif line in (b"O", b"L"):
            self._may_send = line == b"O"  # L is listen only
            yield SLCAN_OK
            yield Mode.LISTEN
        elif line == b"C":
            self._may_send = False
            yield Mode.MUTE
            yield SLCAN_OK
        elif line in _SLCAN_ANSWERS:
            yield _SLCAN_ANSWERS[line]
        else:
            yield SLCAN_OK if _SLCAN_SETTINGS(line) else SLCAN_ERROR


def _parse_slcan(line: bytes) -> Frame | None:
    match = _slcan_frame(line)
    if not match:
        return None
    verb, can_id = match[1] or match[3], int(match[2] or match[4], 16)
    extended, remote, dlc = verb in b"TR", verb in b"rR", int(match[5])
    if len(match[6]) != (0 if remote else 2 * dlc):
        return None
    data = bytes.fromhex(match[6].decode())
    return Frame(can_id, data, extended, remote, dlc if remote else 0)


def slcan_event(frame: Frame) -> bytes:
    """Return `tIIILDD..`, `T`, `r` or `R` with a carriage return."""
    verb = (b"R" if frame.extended else b"r") if frame.remote else b"T" if frame.extended else b"t"
    can_id = (b"%08X" if frame.extended else b"%03X") % frame.can_id
    dlc = frame.dlc if frame.remote else len(frame.data)
    return b"%b%b%d%b\r" % (verb, can_id, dlc, frame.data.hex().upper().encode())


# --- virtualcan -----------------------------------------------------------------------------

_VIRTUALCAN = struct.Struct(">IBB8s")  # identifier, flags (1: extended), length, data
_VIRTUALCAN_MAX = 64


class VirtualcanSession:
    """Frames of 14 bytes, each behind its length; no handshake."""

    def __init__(self, bus_name: str) -> None:
        self._rest = b""

    def begin(self) -> Iterator[Event]:
        """Yield LISTEN: the client gets every frame from the start."""
        yield Mode.LISTEN

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the frames in the chunk; CLOSE when the lengths make no sense."""
        rest = self._rest + chunk
        while len(rest) >= 4:
            size = int.from_bytes(rest[:4], "big")
            if size > _VIRTUALCAN_MAX:
                yield Mode.CLOSE
                return
            if len(rest) < 4 + size:
                break
            packet, rest = rest[4: 4 + size], rest[4 + size:]
            if size == _VIRTUALCAN.size:
                can_id, flags, dlc, data = _VIRTUALCAN.unpack(packet)
                if frame := _flagged_frame(can_id | (EXTENDED_FLAG * (flags & 1)), dlc, data):
                    yield frame
        self._rest = rest


def _flagged_frame(can_id: int, dlc: int, data: bytes) -> Frame | None:
    """Return the frame of an identifier with linux/can.h flags; None for error or long frames."""
    extended, remote = bool(can_id & EXTENDED_FLAG), bool(can_id & REMOTE_FLAG)
    if can_id & ERROR_FLAG or dlc > DATA_MAX:
        return None
    can_id &= EXTENDED_ID_MAX
    if can_id > BASE_ID_MAX and not extended:
        return None
    if remote:
        return Frame(can_id, b"", extended, True, dlc)
    return Frame(can_id, data[:dlc], extended)


def virtualcan_event(frame: Frame) -> bytes:
    """Return length 14 and the frame; a remote frame has bit 30 of the identifier set."""
    dlc = frame.dlc if frame.remote else len(frame.data)
    can_id = frame.can_id | (REMOTE_FLAG if frame.remote else 0)
    return b"\0\0\0\x0e" + _VIRTUALCAN.pack(can_id, frame.extended, dlc, frame.data)


# --- cannelloni -----------------------------------------------------------------------------

CANNELLONI_HELLO = b"CANNELLONIv1"
_CANNELLONI_FD = 0x80


class CannelloniSession:
    """Both sides say CANNELLONIv1, then frames follow one another without a delimiter."""

    def __init__(self, bus_name: str) -> None:
        self._rest = b""
        self._greeted = False

    def begin(self) -> Iterator[Event]:
        """Yield the greeting."""
        yield CANNELLONI_HELLO

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the frames in the chunk; CLOSE when it is another protocol."""
        rest = self._rest + chunk
        if not self._greeted:
            if not CANNELLONI_HELLO.startswith(rest[:12]):
                yield Mode.CLOSE
                return
            if len(rest) >= 12:
                self._greeted, rest = True, rest[12:]
                yield Mode.LISTEN
        while self._greeted and len(rest) >= 5:
            can_id, size = int.from_bytes(rest[:4], "big"), rest[4]
            is_fd, dlc = bool(size & _CANNELLONI_FD), size & ~_CANNELLONI_FD
            if dlc > (64 if is_fd else DATA_MAX):
                yield Mode.CLOSE
                return
            start = 6 if is_fd else 5
            end = start + (0 if can_id & REMOTE_FLAG else dlc)
            if len(rest) < end:
                break
            data, rest = rest[start:end], rest[end:]
            if not is_fd and (frame := _flagged_frame(can_id, dlc, data)):
                yield frame
        self._rest = rest


def cannelloni_event(frame: Frame) -> bytes:
    """Return flagged identifier, length and data; a remote frame ends with its length."""
    flags = (EXTENDED_FLAG if frame.extended else 0) | (REMOTE_FLAG if frame.remote else 0)
    dlc = frame.dlc if frame.remote else len(frame.data)
    return (frame.can_id | flags).to_bytes(4, "big") + bytes((dlc,)) + frame.data


class Codec(NamedTuple):
    """One protocol: a row of the table below."""

    port: int  # usual TCP port
    session: Callable[[str], Session]  # one for each client
    encode: Callable[[Frame], bytes]
    answer_gap_s: float  # between answers of the handshake, so that each is a `recv` of its own
    hold_s: float  # between the last answer and the first frame


CODECS: dict[str, Codec] = {
    "socketcand": Codec(29536, SocketcandSession, socketcand_event, 0.02, 0.05),
    "slcan": Codec(29537, SlcanSession, slcan_event, 0.0, 0.0),
    "virtualcan": Codec(18881, VirtualcanSession, virtualcan_event, 0.0, 0.0),
    "cannelloni": Codec(20000, CannelloniSession, cannelloni_event, 0.0, 0.0),
}
