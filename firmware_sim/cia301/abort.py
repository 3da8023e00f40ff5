"""SDO abort codes: why a transfer was refused.

The numbers are those of CiA 301 (table of SDO abort codes); the names say what a server means.
"""

from enum import IntEnum


class Abort(IntEnum):
    """Codes that the server sends."""

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
