"""The values behind an object dictionary, and every rule of access to them.

A download is checked in this order: existence, access, length, range, and the check of the service
that owns the object. Only then is it stored and its effect called. An object may instead be read
from a live source; then no value is stored. Source: CiA 301, SDO abort codes and object access.
"""

import struct
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import Any

from canopen.objectdictionary import ObjectDictionary, ODVariable

LARGEST_BYTES = 1 << 16
Key = int


class Abort(IntEnum):
    """SDO abort codes that the server sends, with their numbers in the table of CiA 301."""

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
    """Access to an object is refused; the client receives `code`."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"SDO abort {code:08X}h ({code.name})")
        self.code = code


def key(index: int, sub: int) -> Key:
    """Return index and sub-index as one number."""
    return index << 8 | sub


class Objects:
    """The values of a dictionary, by key. Relative defaults are relative to `node_id`.

    By key: `readers` are live sources, `checks` may refuse a value with AbortError, and `effects`
    are called when a value has been stored.
    """

    def __init__(self, dictionary: ObjectDictionary, node_id: int) -> None:
        self.dictionary = dictionary
        self.node_id = node_id
        self.variables: dict[Key, ODVariable] = {}
        for index, entry in dictionary.items():
            members = {0: entry} if isinstance(entry, ODVariable) else entry.subindices
            for sub, variable in sorted(members.items()):
                self.variables[key(index, sub)] = variable
        self.readers: dict[Key, Callable[..., Any]] = {}
        self.checks: dict[Key, Callable[..., Any]] = {}
        self.effects: dict[Key, Callable[..., Any]] = {}
        self.values: dict[Key, Any] = {}
        self.power_on(0, 0xFFFF, {})

    def attach(
        self,
        index: int,
        sub: int = 0,
        *,
        read: Callable[[], Any] | None = None,
        check: Callable[[Any], Any] | None = None,
        effect: Callable[[Any], Any] | None = None,
    ) -> None:
        """Attach calls to an object: its live source, the check and the effect of a new value."""
        for calls, call in ((self.readers, read), (self.checks, check), (self.effects, effect)):
            if call is not None:
                calls[key(index, sub)] = call

    def power_on(self, first: int, last: int, stored: dict[Key, Any]) -> None:
        """Give the objects from index first to last their defaults, or their stored values."""
        shift = self.node_id - (self.dictionary.node_id or 0)
        for at, variable in self.variables.items():
            if not first <= at >> 8 <= last:
                continue
            default: Any = variable.default
            if variable.relative:
                default += shift
            self.values[at] = stored.get(at, default)

    def getter(self, at: Key) -> Callable[[], Any]:
        """Return a function that reads the present value of an object, live or stored."""
        return self.readers.get(at) or partial(self.values.__getitem__, at)

    def get(self, index: int, sub: int = 0) -> Any:
        """Return the present value of an object. Raises KeyError if there is no such object."""
        return self.getter(key(index, sub))()

    def find(self, index: int, sub: int) -> ODVariable:
        """Return the variable of an object. Raises AbortError if there is no such object."""
        variable = self.variables.get(key(index, sub))
        if variable is not None:
            return variable
        if index in self.dictionary.indices:
            raise AbortError(Abort.NO_SUB_INDEX)
        raise AbortError(Abort.NO_OBJECT)

    def upload(self, index: int, sub: int) -> bytes:
        """Return an object's value as bytes, for an SDO client. Raises AbortError."""
        variable = self.find(index, sub)
        if not variable.readable:
            raise AbortError(Abort.WRITE_ONLY)
        return variable.encode_raw(self.get(index, sub))

    def announce(self, index: int, sub: int, size: int | None) -> ODVariable:
        """Check a download before its data are there; `size` in bytes, None if unknown.

        Raises AbortError.
        """
        variable = self.find(index, sub)
        if not variable.writable:
            raise AbortError(Abort.READ_ONLY)
        if size is None:
            return variable
        expected = len(variable) // 8
        if variable.fixed_size and size != expected:
            raise AbortError(Abort.TOO_LONG if size > expected else Abort.TOO_SHORT)
        if size > LARGEST_BYTES:
            raise AbortError(Abort.OUT_OF_MEMORY)
        return variable

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Store the data of an SDO client. Raises AbortError; then nothing has changed."""
        variable = self.announce(index, sub, len(data))
        self.assign(key(index, sub), variable.decode_raw(data))

    def assign(self, at: Key, value: Any) -> None:
        """Store a value. Raises AbortError if the range or the check of the object refuses it."""
        self.check(at, value)
        self.values[at] = value
        effect = self.effects.get(at)
        if effect is not None:
            effect(value)

    def check(self, at: Key, value: Any) -> None:
        """Raise AbortError unless the object may have a value: by its range, then by its check."""
        variable = self.variables[at]
        if variable.max is not None and value > variable.max:
            raise AbortError(Abort.TOO_HIGH)
        if variable.min is not None and value < variable.min:
            raise AbortError(Abort.TOO_LOW)
        check = self.checks.get(at)
        if check is not None:
            check(value)


def packer(variables: list[ODVariable]) -> struct.Struct:
    """Return the layout of a PDO that carries these variables, little-endian and packed."""
    formats = [variable.STRUCT_TYPES[variable.data_type or 0].format[-1] for variable in variables]
    return struct.Struct("<" + "".join(formats))
