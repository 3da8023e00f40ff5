"""Modbus requests and their answers: every supported function is one row of a table.

A request names a function, addresses and values; the answer is the same function with data, or the
function with its highest bit set and an exception code. Checks come in the order that the standard
draws: function, quantity and length, address, and only then execution, so that a refused request
has changed nothing. Source: MODBUS Application Protocol Specification V1.1b3, section 6.
"""

import struct
from collections.abc import Callable, Mapping
from enum import IntEnum
from importlib import metadata
from typing import NamedTuple, Protocol

LARGEST_PDU = 253
_MOST_BITS_READ, _MOST_BITS_WRITTEN = 2000, 1968
_MOST_READ, _MOST_WRITTEN, _MOST_EXCHANGED = 125, 123, 121
_ON, _OFF = 0xFF00, 0x0000
_IDENTIFICATION = 0x0E
_EXCEPTION_BIT = 0x80


class Code(IntEnum):
    """Exception codes."""

    FUNCTION = 0x01
    ADDRESS = 0x02
    VALUE = 0x03
    FAILURE = 0x04
    BUSY = 0x06
    NO_TARGET = 0x0B


class RefusedError(Exception):
    """A request that cannot be served; `code` is what the client is told."""

    def __init__(self, code: Code) -> None:
        super().__init__(code.name)
        self.code = code


class Image(Protocol):
    """What a unit offers. `at` counts from 0; all raise RefusedError, and then nothing changed."""

    def read_bits(self, at: int, count: int) -> bytes:
        """`count` bits, eight a byte, the first one lowest."""

    def read_words(self, at: int, count: int) -> bytes:
        """`count` registers, two bytes each, the higher first."""

    def write_bits(self, at: int, bits: list[bool]) -> None:
        """Set bits."""

    def write_words(self, at: int, words: list[int]) -> None:
        """Set registers."""


def _require(holds: bool, code: Code = Code.VALUE) -> None:
    if not holds:
        raise RefusedError(code)


def _two(body: bytes) -> tuple[int, int]:
    _require(len(body) == 4)
    first, second = struct.unpack(">HH", body)
    return first, second


def _read_bits(image: Image, body: bytes) -> bytes:
    at, count = _two(body)
    _require(1 <= count <= _MOST_BITS_READ)
    data = image.read_bits(at, count)
    return bytes((len(data),)) + data


def _read_words(image: Image, body: bytes) -> bytes:
    at, count = _two(body)
    _require(1 <= count <= _MOST_READ)
    data = image.read_words(at, count)
    return bytes((len(data),)) + data


def _write_bit(image: Image, body: bytes) -> bytes:
    at, value = _two(body)
    _require(value in (_ON, _OFF))
    image.write_bits(at, [value == _ON])
    return body


def _write_word(image: Image, body: bytes) -> bytes:
    at, value = _two(body)
    image.write_words(at, [value])
    return body


def _write_bits(image: Image, body: bytes) -> bytes:
    _require(len(body) >= 5)
    at, count, size = struct.unpack_from(">HHB", body)
    data = body[5:]
    _require(1 <= count <= _MOST_BITS_WRITTEN and size == (count + 7) // 8 == len(data))
    image.write_bits(at, [bool(data[i >> 3] >> (i & 7) & 1) for i in range(count)])
    return body[:4]


def _write_words(image: Image, body: bytes) -> bytes:
    _require(len(body) >= 5)
    at, count, size = struct.unpack_from(">HHB", body)
    _require(1 <= count <= _MOST_WRITTEN and size == 2 * count == len(body) - 5)
    image.write_words(at, list(struct.unpack_from(f">{count}H", body, 5)))
    return body[:4]


def _mask_word(image: Image, body: bytes) -> bytes:
    _require(len(body) == 6)
    at, keep, put = struct.unpack(">HHH", body)
    before = int.from_bytes(image.read_words(at, 1), "big")
    image.write_words(at, [before & keep | put & ~keep & 0xFFFF])
    return body


def _exchange_words(image: Image, body: bytes) -> bytes:
    _require(len(body) >= 9)
    at, count, to, written, size = struct.unpack_from(">HHHHB", body)
    _require(1 <= count <= _MOST_READ and 1 <= written <= _MOST_EXCHANGED
             and size == 2 * written == len(body) - 9)
    # an address that cannot be read must not let the write happen
    image.read_words(at, count)
    image.write_words(to, list(struct.unpack_from(f">{written}H", body, 9)))
    data = image.read_words(at, count)
    return bytes((len(data),)) + data


# device identification: basic objects 0 to 2, regular ones 3 to 6
IDENTITY = {
    0: b"rollerrig", 1: b"roller rig", 2: metadata.version("rollerrig").encode(),
    4: b"rollerrig", 5: b"roller-rig emulator for wheel slide protection",
}
_BASIC, _REGULAR, _EXTENDED, _SPECIFIC = 1, 2, 3, 4
_CONFORMITY = 0x82  # regular identification, stream and individual access


def _identify(_: Image, body: bytes) -> bytes:
    _require(len(body) >= 1)
    _require(body[0] == _IDENTIFICATION, Code.FUNCTION)
    _require(len(body) == 3)
    level, first = body[1], body[2]
    _require(level in (_BASIC, _REGULAR, _EXTENDED, _SPECIFIC))
    if level == _SPECIFIC:
        _require(first in IDENTITY, Code.ADDRESS)
        chosen = [first]
    else:
        last = 2 if level == _BASIC else 6
        # an unknown first object starts at the beginning, says the standard
        start = first if first in IDENTITY and first <= last else 0
        chosen = [one for one in IDENTITY if start <= one <= last]
    objects = b"".join(bytes((one, len(IDENTITY[one]))) + IDENTITY[one] for one in chosen)
    return bytes((_IDENTIFICATION, level, _CONFORMITY, 0, 0, len(chosen))) + objects


class Function(NamedTuple):
    """One function. A request is `fixed` bytes long behind its function code, or, where `counted`
    is not 0, it has a byte there (from the code on) that tells how many more follow it."""

    code: int
    title: str
    fixed: int
    counted: int
    writes: bool
    call: Callable[[Image, bytes], bytes]


FUNCTIONS: dict[int, Function] = {row.code: row for row in (
    Function(0x01, "read coils", 4, 0, False, _read_bits),
    Function(0x02, "read discrete inputs", 4, 0, False, _read_bits),
    Function(0x03, "read holding registers", 4, 0, False, _read_words),
    Function(0x04, "read input registers", 4, 0, False, _read_words),
    Function(0x05, "write single coil", 4, 0, True, _write_bit),
    Function(0x06, "write single register", 4, 0, True, _write_word),
    Function(0x0F, "write multiple coils", 5, 5, True, _write_bits),
    Function(0x10, "write multiple registers", 5, 5, True, _write_words),
    Function(0x16, "mask write register", 6, 0, True, _mask_word),
    Function(0x17, "read/write multiple registers", 9, 9, True, _exchange_words),
    Function(0x2B, "read device identification", 3, 0, False, _identify),
)}


def answer(units: Mapping[int, Image], unit: int, request: bytes) -> bytes:
    """The answer of a unit to a request (function code and data, at least one byte).

    Never raises: what fails inside is exception 04.
    """
    code = request[0]
    function = FUNCTIONS.get(code)
    try:
        if unit not in units:
            raise RefusedError(Code.NO_TARGET)
        if function is None:
            raise RefusedError(Code.FUNCTION)
        return request[:1] + function.call(units[unit], request[1:])
    except RefusedError as refused:
        return bytes((code | _EXCEPTION_BIT, refused.code))
    except Exception:
        # a fault in a reader or a writer must not end the connection, let alone the bench
        return bytes((code | _EXCEPTION_BIT, Code.FAILURE))


def is_exception(reply: bytes) -> bool:
    """Whether an answer is an exception."""
    return bool(reply[0] & _EXCEPTION_BIT)


def length(request: bytes) -> int | None:
    """How long the request is that begins like this; None: unknown function, 0: not yet known."""
    function = FUNCTIONS.get(request[0]) if request else None
    if function is None:
        return None if request else 0
    if not function.counted:
        return 1 + function.fixed
    if len(request) <= function.counted:
        return 0
    return 1 + function.fixed + request[function.counted]
