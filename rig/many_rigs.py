"""The buffer of very many rigs, such as those of a GPU: where each slot of each rig lies.

A slot has the axles of all rigs one after another, as in the buffer of `state`, whose room is for
MOST_LANES axles. A larger buffer has room for a multiple of them, and each slot begins so many
times as far from its beginning. So threads of neighbouring rigs read neighbouring memory. The
surfaces of a rig (`state.SURFACE` values) stay together, behind all other slots.
"""

import functools

import numpy as np

from rollerrig.rig.compiled.state_type import Address, Placed
from rollerrig.rig.state import MOST_LANES, PLACES, SIZE, SURFACE, slots

_BYTES_OF_A_FLOAT = 8
# where the surfaces begin in the buffer of `state`
_SURFACES = SIZE - SURFACE
# the type of the state of a rig in such a buffer: a planar vehicle
KIND = Address(PLACES | {"coach": None}, has_multiple=True)


def multiple(rigs: int, axles: int) -> int:
    """Return how many times MOST_LANES a buffer of so many rigs with so many axles has."""
    return -(-rigs * axles // MOST_LANES)


def size_of(rigs: int, axles: int) -> int:
    """Return the number of values of so many rigs with so many axles each."""
    return _SURFACES * multiple(rigs, axles) + rigs * SURFACE


def placed(address: int, rig: int, rigs: int, axles: int) -> Placed:
    """Return the state of a rig, counted from 0, in the buffer of so many rigs at an address."""
    times = multiple(rigs, axles)
    bases = []
    for next_rig in KIND.bases:
        values = rig * next_rig.of(axles)
        if not _is_interleaved(next_rig):
            values += _SURFACES * (times - 1)
        bases.append(address + _BYTES_OF_A_FLOAT * values)
    return Placed(KIND, (*bases, axles, times))


def _is_interleaved(next_rig: object) -> bool:
    """Return whether the fields with this distance from rig to rig have a place for each rig."""
    return any(
        place.next_rig == next_rig and place.is_interleaved
        for place in KIND.places.values()
        if place is not None
    )


@functools.cache
def numbers(axles: int, rigs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (alone, first, next_rig): where the values of a rig lie, int64 (n,) each.

    alone: in the buffer of `state` for one rig. first: of rig 0 in the buffer of so many rigs.
    next_rig: how far from one rig to the next.
    """
    times = multiple(rigs, axles)
    alone: list[int] = []
    first: list[int] = []
    next_rig: list[int] = []
    for name, slot in slots(axles).items():
        place = PLACES[name]
        begin = place.begin * times
        if not place.is_interleaved:
            begin = place.begin + _SURFACES * (times - 1)
        width = slot.stop - slot.start
        alone += range(slot.start, slot.stop)
        first += range(begin, begin + width)
        next_rig += [place.next_rig.of(axles)] * width
    return np.array(alone), np.array(first), np.array(next_rig)


def copy(alone: np.ndarray, many: np.ndarray, rig: int, rigs: int, axles: int) -> None:
    """Copy the state of one rig, in a buffer of `state`, to the place of a rig among many."""
    source, first, next_rig = numbers(axles, rigs)
    many[first + rig * next_rig] = alone[source]


def found(places: np.ndarray, rig: int, rigs: int, axles: int) -> np.ndarray:
    """Return where values, int64 (n,) in the buffer of one rig, lie for a rig among many."""
    source, first, next_rig = numbers(axles, rigs)
    order = np.argsort(source)
    at = order[np.searchsorted(source[order], places)]
    return first[at] + rig * next_rig[at]
