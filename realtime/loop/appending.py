"""Appends a row to a ring: in a separate file, because readers of `ring` need no compiler."""

from rollerrig.rig.compiled.c_function import memory_barrier
from rollerrig.rig.compiled.kernel import kernel

_WRITTEN = 0  # the slot WRITTEN of the header in `ring`


@kernel
def push(header, rows, row):
    """Append one row: shapes (16,) int64, (capacity, width), (width,). Never waits."""
    at = header[_WRITTEN]
    slot = at % rows.shape[0]
    for i in range(row.size):
        rows[slot, i] = row[i]
    memory_barrier()
    header[_WRITTEN] = at + 1


@kernel
def push_part(header, rows, row, kept):
    """Append the values of a row at the places `kept`, int64 (width,). Never waits.

    Shapes of header and rows as for `push`.
    """
    at = header[_WRITTEN]
    slot = at % rows.shape[0]
    for i in range(kept.size):
        rows[slot, i] = row[kept[i]]
    memory_barrier()
    header[_WRITTEN] = at + 1
