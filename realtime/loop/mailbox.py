"""A mailbox: the latest row of values.

It has one writer and any number of readers, and none waits long.

The writer makes the sequence odd, copies, and makes it even again. A reader copies until it has
seen the same even sequence before and after (a sequence lock). The row is there twice, and the
writer changes one after the other. So a reader always finds a whole row, even if it has taken the
core from a writer that is half done, and has to go on before it.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled.c_function import memory_barrier
from rollerrig.rig.compiled.kernel import kernel


class Mailbox(NamedTuple):
    """`sequence` int64 (2,): one number each for the rows `values` and `second`, float64 (n,)."""

    sequence: np.ndarray
    values: np.ndarray
    second: np.ndarray


def mailbox(size: int) -> Mailbox:
    """Return an empty mailbox for rows of `size` values."""
    return Mailbox(np.zeros(2, dtype=np.int64), np.zeros(size), np.zeros(size))


@kernel
def post(box, values):
    """Put a row of shape (n,) into the box."""
    _write(box.sequence[:1], box.values, values)
    _write(box.sequence[1:], box.second, values)


@kernel
def _write(sequence, row, values):
    sequence[0] += 1
    memory_barrier()
    for i in range(row.size):
        row[i] = values[i]
    memory_barrier()
    sequence[0] += 1


@kernel
def fetch(box, into):
    """Copy the latest row into `into`, shape (n,); return its sequence number."""
    while True:
        number = _read(box.sequence[:1], box.values, into)
        if number < 0:
            number = _read(box.sequence[1:], box.second, into)
        if number >= 0:
            return number


@kernel
def _read(sequence, row, into):
    """Copy a row; return its sequence number, or -1 if it was changed meanwhile."""
    before = sequence[0]
    memory_barrier()
    for i in range(into.size):
        into[i] = row[i]
    memory_barrier()
    if before % 2 == 0 and sequence[0] == before:
        return before
    return -1
