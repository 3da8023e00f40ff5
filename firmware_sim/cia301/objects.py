"""The values behind an object dictionary, and every rule of access to them.

A download is checked in the order existence, access, length, range, then by whoever owns the
object; only then is it stored and its effect called. An object may instead be read from a live
source: then nothing is stored. Source: CiA 301, SDO abort codes and object access.
"""

import struct
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import Any

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

LARGEST_BYTES = 1 << 16
Key = int


class Abort(IntEnum):
    """SDO abort codes that the server sends: numbers as CiA 301 has them in its table."""

    TOGGLE_BIT = 0x05030000
    TIME_OUT = 0x05040000
    UNKNOWN_COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE_NUMBER = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    LENGTH_MISMATCH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUB_INDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    NOT_STORED = 0x08000020
    DEVICE_STATE = 0x08000022


class AbortError(Exception):
    """Access to an object is refused; `code` is what the client is told."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"SDO abort {code:08X}h ({code.name})")
        self.code = code


def key(index: int, sub: int) -> Key:
    """Index and sub-index as one number."""
    return index << 8 | sub


class Objects:
    """Values of a dictionary, by key. `node_id` is what relative defaults are counted from."""

    def __init__(self, dictionary: ObjectDictionary, node_id: int) -> None:
        self.dictionary, self.node_id = dictionary, node_id
        self.variables: dict[Key, ODVariable] = {
            key(index, sub): variable
            for index in dictionary
            for sub, variable in _members(dictionary[index])
        }
        self.readers: dict[Key, Callable[[], Any]] = {}
        self.checks: dict[Key, Callable[[Any], None]] = {}
        self.effects: dict[Key, Callable[[Any], None]] = {}
        self.values: dict[Key, Any] = {}
        self.power_on(0, 0xFFFF)

    def power_on(self, first: int, last: int, kept: dict[Key, Any] | None = None) -> None:
        """Give the objects first..last their defaults, or the values of `kept` (stored ones)."""
        moved = self.node_id - (self.dictionary.node_id or 0)
        for at, one in self.variables.items():
            if first <= at >> 8 <= last:
                value: Any = one.default
                if one.relative:
                    value += moved
                self.values[at] = (kept or {}).get(at, value)

    def getter(self, at: Key) -> Callable[[], Any]:
        """A call that gives an object's value now: its live source, or what is stored."""
        return self.readers.get(at) or partial(self.values.__getitem__, at)

    def get(self, index: int, sub: int = 0) -> Any:
        """An object's value now. KeyError if there is none."""
        return self.getter(key(index, sub))()

    def find(self, index: int, sub: int) -> ODVariable:
        """The variable, or AbortError: no object, or no such sub-index."""
        variable = self.variables.get(key(index, sub))
        if variable is None:
            known = index in self.dictionary.indices
            raise AbortError(Abort.NO_SUB_INDEX if known else Abort.NO_OBJECT)
        return variable

    def upload(self, index: int, sub: int) -> bytes:
        """An object's value as bytes, for an SDO client. Raises AbortError."""
        variable = self.find(index, sub)
        if not variable.readable:
            raise AbortError(Abort.WRITE_ONLY)
        return variable.encode_raw(self.getter(key(index, sub))())

    def announce(self, index: int, sub: int, size: int | None) -> ODVariable:
        """What can be told before the data of a download is there. Raises AbortError."""
        variable = self.find(index, sub)
        if not variable.writable:
            raise AbortError(Abort.READ_ONLY)
        if size is not None:
            self._check_size(variable, size)
        return variable

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Store what an SDO client sent. Raises AbortError, and then nothing has changed."""
        variable = self.announce(index, sub, len(data))
        self.assign(key(index, sub), variable.decode_raw(data))

    def assign(self, at: Key, value: Any) -> None:
        """Store a value of the object's type; AbortError if its range or its owner refuse it."""
        variable = self.variables[at]
        if variable.max is not None and value > variable.max:
            raise AbortError(Abort.TOO_HIGH)
        if variable.min is not None and value < variable.min:
            raise AbortError(Abort.TOO_LOW)
        check = self.checks.get(at)
        if check is not None:
            check(value)
        self.values[at] = value
        effect = self.effects.get(at)
        if effect is not None:
            effect(value)

    def _check_size(self, variable: ODVariable, size: int) -> None:
        if not variable.fixed_size:
            if size > LARGEST_BYTES:
                raise AbortError(Abort.OUT_OF_MEMORY)
            return
        wanted = len(variable) // 8
        if size > wanted:
            raise AbortError(Abort.TOO_LONG)
        if size < wanted:
            raise AbortError(Abort.TOO_SHORT)


def _members(thing: Any) -> list[tuple[int, ODVariable]]:
    if isinstance(thing, ODVariable):
        return [(0, thing)]
    return sorted(thing.subindices.items())


def packer(variables: list[ODVariable]) -> struct.Struct:
    """The layout of a PDO that carries these integer variables, little-endian and packed."""
    letters: dict[int | None, str] = {
        datatypes.BOOLEAN: "B", datatypes.REAL32: "f", datatypes.REAL64: "d"}
    plain = {True: {1: "b", 2: "h", 4: "i", 8: "q"}, False: {1: "B", 2: "H", 4: "I", 8: "Q"}}
    return struct.Struct("<" + "".join(
        letters.get(one.data_type)
        or plain[one.data_type in datatypes.SIGNED_TYPES][len(one) // 8]
        for one in variables))
