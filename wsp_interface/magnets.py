"""The magnets of the dump valves: two bits for each axle in one byte.

The byte is object 6200h:1 of node 17 and the data of frame 211h (RPDO1 of node 17). A set bit is an
energised magnet:

    bit 2j      hold magnet of axle j + 1
    bit 2j + 1  vent magnet of axle j + 1

The two bits of an axle are its pair:

    pair  energised      dump valve
    0     none           fills: the brake applies
    1     hold           holds the cylinder pressure
    2     vent           vents; node 17 reports the missing hold magnet and treats the pair as 3
    3     hold and vent  vents

The channel `magnets_1` and those of the other axles carry pairs. What the valve does after its dead
time is the channel `valve_1`; its states are in `rig.state`.
"""

from collections.abc import Iterable

from rollerrig.configs.vehicle import AXLES_OF_GROUP, HOLD_MAGNET, VENT_MAGNET

# the pairs by what the valve does
FILLING = 0
HOLDING = HOLD_MAGNET
VENTING = HOLD_MAGNET | VENT_MAGNET

# layout of the byte; compiled loops shift and mask with these themselves
BITS_PER_AXLE = 2
PAIR_MASK = HOLD_MAGNET | VENT_MAGNET

ALL_OFF = 0  # every valve fills: the fail-safe value


def pair(hold: bool, vent: bool) -> int:
    """Return the pair of an axle from its two magnets."""
    bits = 0
    if hold:
        bits |= HOLD_MAGNET
    if vent:
        bits |= VENT_MAGNET
    return bits


def pack(pairs: Iterable[int]) -> int:
    """Return the byte that carries the pairs of all axles, the leading axle first."""
    byte = ALL_OFF
    for j, bits in enumerate(pairs):
        byte |= bits << (BITS_PER_AXLE * j)
    return byte


def unpack(byte: int, axles: int = AXLES_OF_GROUP) -> list[int]:
    """Return the pairs of so many axles that a byte carries, the leading axle of a group first."""
    return [byte >> (BITS_PER_AXLE * j) & PAIR_MASK for j in range(axles)]
