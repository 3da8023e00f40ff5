r"""slcan: the serial line of LAWICEL CAN adapters, here over TCP.

Each command is a line of ASCII that ends with a carriage return:

    tIIIL.. TIIIIIIIIL..   send a data frame: identifier of 3 or 8 digits, length, data
    rIIIL   RIIIIIIIIL     send a remote frame
    O  L  C                open the channel, open it for listening only, close it
    V  v  N  F             version, detailed version, serial number, status flags
    S s M m X Z W          settings

The hub answers OK with a carriage return and an error with a bell. It accepts all settings and
ignores them: the bit rate is the hub's, and time stamps are off. Frames arrive in the same four
forms.

Source: LAWICEL CAN232 manual.
"""

import re
from collections.abc import Iterator

from rollerrig.wsp_interface.bus.frames import Frame, length
from rollerrig.wsp_interface.bus.session import COMMAND_MAX, Event, Mode, Session, hex_id

OK = b"\r"
ERROR = b"\a"

_FRAME_VERBS = (b"t", b"T", b"r", b"R")
_is_frame = re.compile(
    rb"(?:(?P<base_verb>[tr])(?P<base_id>[0-7][0-9A-Fa-f]{2})"
    rb"|(?P<extended_verb>[TR])(?P<extended_id>[01][0-9A-Fa-f]{7}))"
    rb"(?P<dlc>[0-8])"
    rb"(?P<data>(?:[0-9A-Fa-f]{2})*)"
).fullmatch
_is_line = re.compile(rb"[A-Za-z][0-9A-Fa-f]*").fullmatch
_is_setting = re.compile(rb"S[0-8]|s[0-9A-Fa-f]{4,6}|[Mm][0-9A-Fa-f]{8}|[XZW]0|").fullmatch
_ANSWERS = {b"V": b"V1013\r", b"v": b"v0100\r", b"N": b"NRIG0\r", b"F": b"F00\r"}


class SlcanSession(Session):
    """The adapter's side of one client."""

    _may_send = False

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Yield the events of the lines that are now complete."""
        *lines, self._rest = (self._rest + chunk.replace(b"\n", b"")).split(b"\r")
        for line in lines:
            if line and not self._began:
                self._began = True
                if not _is_line(line):
                    yield Mode.FOREIGN
                    return
            answer = ERROR
            for event in self._execute(line):
                if isinstance(event, bytes):
                    answer = event
                yield event
            if line and answer != ERROR:
                self.has_spoken = True
        if len(self._rest) > COMMAND_MAX:
            self._rest = b""
            yield ERROR if self._began else Mode.FOREIGN

    def _execute(self, line: bytes) -> Iterator[Event]:
        if line[:1] in _FRAME_VERBS:
            frame = _parse_frame(line) if self._may_send else None
            if frame is None:
                yield ERROR
                return
            yield frame
            yield b"Z\r" if frame.extended else b"z\r"
        elif line in (b"O", b"L"):
            self._may_send = line == b"O"
            yield OK
            yield Mode.LISTEN
        elif line == b"C":
            self._may_send = False
            yield Mode.MUTE
            yield OK
        elif line in _ANSWERS:
            yield _ANSWERS[line]
        elif _is_setting(line):
            yield OK
        else:
            yield ERROR


def _parse_frame(line: bytes) -> Frame | None:
    """Return the frame of a line, None when it is malformed."""
    match = _is_frame(line)
    if not match:
        return None
    extended = match["extended_verb"] is not None
    verb = match["extended_verb"] or match["base_verb"]
    can_id = int(match["extended_id"] or match["base_id"], 16)
    dlc = int(match["dlc"])
    data = bytes.fromhex(match["data"].decode())
    if verb in b"rR":
        return None if data else Frame(can_id, b"", extended, True, dlc)
    if len(data) != dlc:
        return None
    return Frame(can_id, data, extended)


def encode_event(frame: Frame) -> bytes:
    """Return the line of a frame, with its carriage return."""
    verb = b"r" if frame.remote else b"t"
    if frame.extended:
        verb = verb.upper()
    can_id = hex_id(frame.can_id, frame.extended)
    return b"%b%b%d%b\r" % (verb, can_id, length(frame), frame.data.hex().upper().encode())
