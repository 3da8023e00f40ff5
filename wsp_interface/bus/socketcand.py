"""socketcand: text commands in angle brackets over TCP, the protocol of the hub's usual clients.

    server                       client
    < hi >
                                 < open rig0 >
    < ok >
                                 < rawmode >
    < ok >
    < frame ID SEC.USEC HEX >    < send ID DLC B B B >
    < rtr ID SEC.USEC DLC >      < sendrtr ID DLC >

Identifiers are hexadecimal; eight digits make an extended one. A client may send frames as soon as
the bus is open. `< errors >` before rawmode is an addition of this project: the client then gets
error frames as well, as `< error ID SEC.USEC HEX >`.

Sources: socketcand `doc/protocol.md` and `state_raw.c`. `sendrtr` and `rtr` are official there;
older clients know only `send` and `frame`.
"""

import re
from collections.abc import Iterator
from functools import lru_cache

from rollerrig.wsp_interface.bus.frames import (
    BASE_ID_MAX,
    DATA_MAX,
    EXTENDED_ID_MAX,
    S_NS,
    Frame,
)
from rollerrig.wsp_interface.bus.session import COMMAND_MAX, Event, Mode, Session, hex_id

_EXTENDED_DIGITS = 8  # of an extended identifier as text
_is_hex = re.compile(rb"[0-9A-Fa-f]{1,16}").fullmatch

# the words for bytes and lengths that clients send: looked up, which is faster than parsing
_BYTES = {form % value: value for form in (b"%x", b"%X", b"%02x", b"%02X") for value in range(256)}
_LENGTHS = {b"%d" % value: value for value in range(DATA_MAX + 1)}


class SocketcandSession(Session):
    """The server's side of one client."""

    greeting = (b"< hi >",)
    _is_open = False
    _is_raw = False

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the events of the commands that are now complete."""
        if not self._began:
            first = chunk.lstrip()[:1]
            if first:
                self._began = True
                if first != b"<":
                    yield Mode.FOREIGN
                    return

        *commands, rest = (self._rest + chunk).split(b">")
        for command in commands:
            # anything before the last "<" is the remainder of a broken command
            _, bracket, body = command.rpartition(b"<")
            if not bracket:
                continue
            words = body.split() if len(body) <= COMMAND_MAX else []
            yield from self._execute(words)

        # keep only what can be the beginning of a command
        begin = rest.rfind(b"<")
        self._rest = rest[begin:] if begin >= 0 else b""
        if len(self._rest) > COMMAND_MAX:
            self._rest = b""
            yield b"< error command too long >"

    def _execute(self, words: list[bytes]) -> Iterator[Event]:
        verb = words[0] if words else b""
        if verb == b"echo":
            yield b"< echo >"
        elif not self._is_open and verb == b"open" and len(words) == 2:
            self._is_open = words[1] in self._bus_names
            if self._is_open:
                self.has_spoken = True
                yield b"< ok >"
            else:
                carried = b", ".join(self._bus_names)
                yield b"< error could not open bus, this hub carries %b >" % carried
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
    """Return the frame of `send ID DLC B B B` or `sendrtr ID DLC`, None when it is malformed."""
    if len(words) < 3 or not _is_hex(words[1]) or words[2] not in _LENGTHS:
        return None
    remote = words[0] == b"sendrtr"
    value = int(words[1], 16) & 0xFFFF_FFFF
    dlc = _LENGTHS[words[2]]
    data_words = words[3:]
    if len(data_words) != (0 if remote else dlc):
        return None

    try:
        data = bytes([_BYTES[word] for word in data_words])
    except KeyError:
        # a sign-extended byte such as ffffff80, or not a number
        if not all(_is_hex(word) for word in data_words):
            return None
        data = bytes([int(word, 16) & 0xFF for word in data_words])

    # eight digits, bit 31 or a value above 7FFh make an extended identifier
    extended = len(words[1]) >= _EXTENDED_DIGITS or value > BASE_ID_MAX
    if remote:
        return Frame(value & EXTENDED_ID_MAX, b"", extended, True, dlc)
    return Frame(value & EXTENDED_ID_MAX, data, extended)


# all frames of a burst in lockstep have the same time: a small cache is enough
@lru_cache(16)
def _seconds(time_ns: int) -> bytes:
    return b"%d.%06d" % (time_ns // S_NS, time_ns % S_NS // 1000)


@lru_cache(16)
def _time_ns(seconds: bytes) -> int:
    whole, _, fraction = seconds.partition(b".")
    return int(whole) * S_NS + int(fraction.ljust(9, b"0")[:9])


def encode_event(frame: Frame) -> bytes:
    """Return a frame as the server sends it: `< frame .. >`, `< rtr .. >` or `< error .. >`."""
    can_id = hex_id(frame.can_id, frame.extended)
    time = _seconds(frame.time_ns)
    if frame.error:
        return b"< error %b %b %b >" % (can_id, time, frame.data.hex().upper().encode())
    if frame.remote:
        return b"< rtr %b %b %d >" % (can_id, time, frame.dlc)
    return b"< frame %b %b %b >" % (can_id, time, frame.data.hex().upper().encode())


def encode_command(frame: Frame) -> bytes:
    """Return a frame as a client sends it: `< send ID DLC B B B >` or `< sendrtr ID DLC >`."""
    can_id = hex_id(frame.can_id, frame.extended)
    if frame.remote:
        return b"< sendrtr %b %d >" % (can_id, frame.dlc)
    data = frame.data
    return b"< send %b %d %b >" % (can_id, len(data), data.hex(" ").encode())


def parse_event(body: bytes) -> Frame | None:
    """Return the frame of a server's message without its brackets, None for other messages."""
    words = body.split()
    try:
        verb = words[0]
        can_id = int(words[1], 16) & EXTENDED_ID_MAX
        extended = len(words[1]) == _EXTENDED_DIGITS
        time_ns = _time_ns(words[2])
        if verb == b"rtr":
            return Frame(can_id, b"", extended, True, min(int(words[3]), DATA_MAX), time_ns)
        if verb not in (b"frame", b"error"):
            return None
        # socketcand sends the data in one word, other servers send a word for each byte
        data = bytes.fromhex(b"".join(words[3:]).decode())
        return Frame(can_id, data, extended, time_ns=time_ns, error=verb == b"error")
    except (IndexError, ValueError):
        return None
