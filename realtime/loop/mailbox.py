"""A mailbox: the latest row of values.

It has one writer and any number of readers, and none waits long.

The writer makes the sequence odd, copies, and makes it even again. A reader copies until it has
seen the same even sequence before and after (a sequence lock).
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled.c_function import memory_barrier
from rollerrig.rig.compiled.kernel import kernel


class Mailbox(NamedTuple):
    """`sequence` int64 of shape (1,), `values` float64 of shape (n,)."""

    sequence: np.ndarray
    values: np.ndarray


def mailbox(size: int) -> Mailbox:
    """Return an empty mailbox for rows of `size` values."""
    return Mailbox(np.zeros(1, dtype=np.int64), np.zeros(size))


@kernel
def post(box, values):
    """Put a row of shape (n,) into the box."""
    box.sequence[0] += 1
    memory_barrier()
    for i in range(box.values.size):
        box.values[i] = values[i]
    memory_barrier()
    box.sequence[0] += 1


@kernel
def fetch(box, into):
    """Copy the latest row into `into`, shape (n,); return its sequence number."""
    while True:
        before = box.sequence[0]
        memory_barrier()
        for i in range(into.size):
            into[i] = box.values[i]
        memory_barrier()
        if before % 2 == 0 and box.sequence[0] == before:
            return before
