"""CAN identifiers as objects carry them: 29 bits of identifier and three flags.

Bit 31 says that the message does not exist, bit 30 means what the object says it means, bit 29 that
the identifier has 29 bits. Some identifiers belong to fixed services, and nothing else may have
them. Source: CiA 301, description of COB-ID entries and table of restricted CAN-IDs.
"""

from rollerrig.firmware_sim.cia301.abort import Abort, AbortError

INVALID, FLAG, EXTENDED = 1 << 31, 1 << 30, 1 << 29
STANDARD_MASK, EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
RESTRICTED = ((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF),
              (0x701, 0x7FF))


def valid(cob_id: int) -> bool:
    """Whether the message exists."""
    return not cob_id & INVALID


def split(cob_id: int) -> tuple[int, bool]:
    """The identifier, and whether it is one of 29 bits."""
    extended = bool(cob_id & EXTENDED)
    return cob_id & (EXTENDED_MASK if extended else STANDARD_MASK), extended


def dispatch_key(can_id: int, extended: bool) -> int:
    """Identifier and format as one number."""
    return can_id | EXTENDED if extended else can_id


def check_identifier(cob_id: int) -> None:
    """AbortError unless the identifier may be given to a configurable message."""
    can_id, extended = split(cob_id)
    if not extended and cob_id & EXTENDED_MASK != can_id:
        raise AbortError(Abort.INVALID_VALUE)
    if not extended and any(low <= can_id <= high for low, high in RESTRICTED):
        raise AbortError(Abort.INVALID_VALUE)


def check_change(current: int, wanted: int) -> None:
    """AbortError if a message that exists would get another identifier without a switch-off."""
    if not valid(wanted):
        return
    check_identifier(wanted)
    if valid(current) and (current ^ wanted) & (EXTENDED | EXTENDED_MASK):
        raise AbortError(Abort.DEVICE_STATE)
