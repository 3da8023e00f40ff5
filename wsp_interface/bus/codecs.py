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
from functools import lru_cache
from typing import NamedTuple, TypeAlias

from rollerrig.wsp_interface.bus.frames import (
    BASE_ID_MAX,
    DATA_MAX,
    EXTENDED_ID_MAX,
    S_NS,
    Frame,
    length,
)

COMMAND_MAX = 256  # the longest legal text command has about 60 characters
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x8000_0000, 0x4000_0000, 0x2000_0000  # linux/can.h


class Mode(IntEnum):
    """What the hub has to do with a client from here on."""

    LISTEN = 1  # gets the frames of the bus
    MUTE = 2  # gets none any more
    CLOSE = 3  # is sent what it still has to get, then closed
    FOREIGN = 4  # began with another protocol: closed at once, and told
    ERRORS = 5  # gets error frames as well


# a frame for the bus, an answer for the client, a change of mode
Event: TypeAlias = Frame | bytes | Mode


class Session:
    """The state of one client's protocol; `greeting` is what a client gets when it connects."""

    greeting: tuple[Event, ...] = ()

    def __init__(self, bus_name: str) -> None:
        self._bus, self._rest, self._began = bus_name.encode(), b"", False

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield what follows from the next bytes, cut anywhere."""
        raise NotImplementedError


@lru_cache(4096)
def _hex_id(can_id: int, extended: bool) -> bytes:
    return (b"%08X" if extended else b"%03X") % can_id


# --- socketcand -----------------------------------------------------------------------------

_hex = re.compile(rb"[0-9A-Fa-f]{1,16}").fullmatch
# the tokens that occur, looked up instead of parsed
_BYTES = {f % n: n for f in (b"%x", b"%X", b"%02x", b"%02X") for n in range(256)}
_LENGTHS = {b"%d" % n: n for n in range(DATA_MAX + 1)}


class SocketcandSession(Session):
    """`< hi >`, open, rawmode, then frames both ways; frames may be sent as soon as the bus is open.

    `< errors >` before rawmode, our own addition, asks for error frames as well.
    """

    greeting = (b"< hi >",)
    _is_open = _is_raw = False

    def feed(self, chunk: bytes) -> Iterator[Event]:
        if not self._began and (first := chunk.lstrip()[:1]):
            self._began = True
            if first != b"<":
                yield Mode.FOREIGN
                return
        *commands, self._rest = (self._rest + chunk).split(b">")
        for command in commands:
            # what stands before the last "<" is the rubble of a broken command
            _, bracket, body = command.rpartition(b"<")
            if bracket:
                yield from self._obey(body.split() if len(body) <= COMMAND_MAX else [])
        self._rest = self._rest[self._rest.rfind(b"<") :] if b"<" in self._rest else b""
        if len(self._rest) > COMMAND_MAX:
            self._rest = b""
            yield b"< error command too long >"

    def _obey(self, words: list[bytes]) -> Iterator[Event]:
        verb = words[0] if words else b""
        if verb == b"echo":
            yield b"< echo >"
        elif not self._is_open and verb == b"open" and len(words) == 2:
            self._is_open = words[1] == self._bus
            if self._is_open:
                yield b"< ok >"
            else:
                yield b"< error could not open bus, this hub carries %b >" % self._bus
                yield Mode.CLOSE
        elif self._is_open and verb == b"errors":
            yield Mode.ERRORS
            yield b"< ok >"
        elif self._is_open and verb in (b"send", b"sendrtr"):
            yield _parse_send(words) or b"< error malformed %b >" % verb
        elif self._is_open and verb == b"rawmode":
            self._is_raw = True
            yield b"< ok >"
            yield Mode.LISTEN
        elif self._is_raw and verb == b"bcmmode":
            self._is_raw = False
            yield Mode.MUTE
            yield b"< ok >"
        else:
            yield b"< error unknown command >"


def _parse_send(words: list[bytes]) -> Frame | None:
    """Return the frame of `send ID DLC b b b` or `sendrtr ID DLC`, None when it is malformed."""
    if len(words) < 3 or not _hex(words[1]) or words[2] not in _LENGTHS:
        return None
    value, dlc, remote = int(words[1], 16) & 0xFFFF_FFFF, _LENGTHS[words[2]], words[0] == b"sendrtr"
    if len(words) != 3 + (0 if remote else dlc):
        return None
    try:
        data = bytes([_BYTES[word] for word in words[3:]])
    except KeyError:  # a sign-extended byte such as ffffff80, or no number
        if not all(_hex(word) for word in words[3:]):
            return None
        data = bytes([int(word, 16) & 0xFF for word in words[3:]])
    # of 29 bits when it has 8 digits, bit 31, or is more than 7FFh
    extended = len(words[1]) >= 8 or value > BASE_ID_MAX
    return Frame(value & EXTENDED_ID_MAX, data, extended, remote, dlc if remote else 0)


# the frames of a burst in lockstep have one time
@lru_cache(16)
def _seconds(time_ns: int) -> bytes:
    return b"%d.%06d" % (time_ns // S_NS, time_ns % S_NS // 1000)


@lru_cache(16)
def _time_ns(seconds: bytes) -> int:
    whole, _, micros = seconds.partition(b".")
    return int(whole) * S_NS + int(micros.ljust(9, b"0")[:9])


def socketcand_event(frame: Frame) -> bytes:
    """Return the frame as the server says it: `< frame ID sec.usec HEX >`, `< rtr .. DLC >`, `< error ..`."""
    verb, body = (
        (b"rtr", b"%d" % frame.dlc)
        if frame.remote
        else (b"frame", frame.data.hex().upper().encode())
    )
    verb = b"error" if frame.error else verb
    return b"< %b %b %b %b >" % (
        verb,
        _hex_id(frame.can_id, frame.extended),
        _seconds(frame.time_ns),
        body,
    )


def socketcand_command(frame: Frame) -> bytes:
    """Return the frame as a client says it: `< send ID DLC b b b >` or `< sendrtr ID DLC >`."""
    if frame.remote:
        return b"< sendrtr %b %d >" % (_hex_id(frame.can_id, frame.extended), frame.dlc)
    data = frame.data
    return b"< send %b %d %b >" % (
        _hex_id(frame.can_id, frame.extended),
        len(data),
        data.hex(" ").encode(),
    )


def parse_socketcand_event(body: bytes) -> Frame | None:
    """Return the frame of a server's message without its brackets, None when it is no frame."""
    words = body.split()
    try:
        time_ns = _time_ns(words[2])
        can_id, extended = int(words[1], 16) & EXTENDED_ID_MAX, len(words[1]) == 8
        if words[0] == b"rtr":
            return Frame(can_id, b"", extended, True, min(int(words[3]), DATA_MAX), time_ns)
        if words[0] not in (b"frame", b"error"):
            return None
        # data may come in one piece (socketcand) or, from other servers, byte by byte
        return Frame(
            can_id,
            bytes.fromhex(b"".join(words[3:]).decode()),
            extended,
            time_ns=time_ns,
            error=words[0] == b"error",
        )
    except (IndexError, ValueError):
        return None


# --- slcan ----------------------------------------------------------------------------------

_slcan_frame = re.compile(
    rb"(?:([tr])([0-7][0-9A-Fa-f]{2})|([TR])([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2})*)"
).fullmatch
_slcan_line = re.compile(rb"[A-Za-z][0-9A-Fa-f]*").fullmatch
_SLCAN_ANSWERS = {b"V": b"V1013\r", b"v": b"v0100\r", b"N": b"NRIG0\r", b"F": b"F00\r"}
_SLCAN_SETTINGS = re.compile(rb"S[0-8]|s[0-9A-Fa-f]{4,6}|[Mm][0-9A-Fa-f]{8}|[XZW]0|").fullmatch
SLCAN_OK, SLCAN_ERROR = b"\r", b"\a"


class SlcanSession(Session):
    """The LAWICEL serial line over TCP; the bit rate is the hub's, time stamps are off."""

    _may_send = False

    def feed(self, chunk: bytes) -> Iterator[Event]:
        *lines, self._rest = (self._rest + chunk.replace(b"\n", b"")).split(b"\r")
        for line in lines:
            if line and not self._began:
                self._began = True
                if not _slcan_line(line):
                    yield Mode.FOREIGN
                    return
            yield from self._obey(line)
        if len(self._rest) > COMMAND_MAX:
            self._rest = b""
            yield SLCAN_ERROR if self._began else Mode.FOREIGN

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
    body = frame.data.hex().upper().encode()
    return b"%b%b%d%b\r" % (verb, _hex_id(frame.can_id, frame.extended), length(frame), body)


# --- virtualcan -----------------------------------------------------------------------------

_VIRTUALCAN = struct.Struct(">IBB8s")  # identifier, flags (1: extended), length, data
_VIRTUALCAN_MAX = 64


class VirtualcanSession(Session):
    """Frames of 14 bytes, each behind its length; no handshake: the client gets every frame from the start."""

    greeting = (Mode.LISTEN,)

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the frames in the chunk; FOREIGN or CLOSE when the lengths make no sense."""
        rest = self._rest + chunk
        while len(rest) >= 4:
            size = int.from_bytes(rest[:4], "big")
            if size > _VIRTUALCAN_MAX:
                yield Mode.CLOSE if self._began else Mode.FOREIGN
                return
            if len(rest) < 4 + size:
                break
            packet, rest, self._began = rest[4 : 4 + size], rest[4 + size :], True
            if size == _VIRTUALCAN.size:
                can_id, flags, dlc, data = _VIRTUALCAN.unpack(packet)
                if frame := _flagged_frame(can_id | (EXTENDED_FLAG * (flags & 1)), dlc, data):
                    yield frame
        self._rest = rest


def _flagged_frame(can_id: int, dlc: int, data: bytes) -> Frame | None:
    """Return the frame of an identifier with linux/can.h flags; None for error or long frames."""
    extended, remote, plain = (
        bool(can_id & EXTENDED_FLAG),
        bool(can_id & REMOTE_FLAG),
        can_id & EXTENDED_ID_MAX,
    )
    if can_id & ERROR_FLAG or dlc > DATA_MAX or (plain > BASE_ID_MAX and not extended):
        return None
    return Frame(plain, b"" if remote else data[:dlc], extended, remote, dlc if remote else 0)


def virtualcan_event(frame: Frame) -> bytes:
    """Return length 14 and the frame; a remote frame has bit 30 of the identifier set."""
    can_id = frame.can_id | REMOTE_FLAG * frame.remote
    return b"\0\0\0\x0e" + _VIRTUALCAN.pack(can_id, frame.extended, length(frame), frame.data)


# --- cannelloni -----------------------------------------------------------------------------

CANNELLONI_HELLO = b"CANNELLONIv1"
_CANNELLONI_FD = 0x80


class CannelloniSession(Session):
    """Both sides say CANNELLONIv1, then frames follow one another without a delimiter."""

    greeting = (CANNELLONI_HELLO,)

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the frames in the chunk; FOREIGN when it is another protocol, CLOSE when it makes no sense."""
        rest = self._rest + chunk
        if not self._began:
            if not CANNELLONI_HELLO.startswith(rest[:12]):
                yield Mode.FOREIGN
                return
            if len(rest) >= 12:
                self._began, rest = True, rest[12:]
                yield Mode.LISTEN
        while self._began and len(rest) >= 5:
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
    flags = EXTENDED_FLAG * frame.extended | REMOTE_FLAG * frame.remote
    return (frame.can_id | flags).to_bytes(4, "big") + bytes((length(frame),)) + frame.data


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
