"""The image of one Modbus unit: reads come from live sources, writes go to whoever owns a value.

Nothing is stored here. A request is checked as a whole, every register of it, before the first
value changes. Two registers that carry one value are read from one sample and written together.
"""

import struct
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial

import numpy as np
from pymodbus.constants import ExcCodes

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Objects, key
from rollerrig.firmware_sim.modbus.map import BIT, WRITE, Register, drive_words
from rollerrig.firmware_sim.modbus.pdu import BITS, RefusedError
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Place

Reader = Callable[[], int]
# called with a raw value, first with only=True to ask whether it would be taken: RefusedError if not
Writer = Callable[[int, bool], None]


class Unit:
    """Bits and registers of a unit. `readers` and `writers` are raw values by name of the row."""

    def __init__(
        self, rows: Iterable[Register], readers: Mapping[str, Reader], writers: Mapping[str, Writer]
    ) -> None:
        self._spaces: dict[bool, dict[int, tuple[Reader, int]]] = {True: {}, False: {}}
        self._rows: dict[tuple[bool, int], Register] = {}
        self._writers = writers
        for row in rows:
            is_bit, read = row.kind == BIT, readers[row.name]
            self._rows[is_bit, row.at] = row
            for at in range(row.width):
                self._spaces[is_bit][row.at + at] = read, 16 * (row.width - 1 - at)
        # clients ask for the same registers again and again
        self._plan = lru_cache(256)(self._plan_of)

    async def async_getValues(self, unit: int, function: int, at: int, count: int) -> list[int]:
        """Bits or registers, as `function` wants. Raises RefusedError."""
        return [
            raw >> shift & 0xFFFF
            for read, shifts in self._plan(function in BITS, at, count)
            for raw in (read(),)
            for shift in shifts
        ]

    def _plan_of(self, is_bit: bool, at: int, count: int) -> list[tuple[Reader, list[int]]]:
        """What to read, each value once, and by how much to shift it. Raises RefusedError."""
        plan: list[tuple[Reader, list[int]]] = []
        for one in range(at, at + count):
            if one not in self._spaces[is_bit]:
                raise RefusedError(ExcCodes.ILLEGAL_ADDRESS)
            read, shift = self._spaces[is_bit][one]
            if plan and plan[-1][0] is read and plan[-1][1][-1] > shift:
                plan[-1][1].append(shift)
            else:
                plan.append((read, [shift]))
        return plan

    async def async_setValues(self, unit: int, function: int, at: int, values: list[int]) -> None:
        """Set bits or registers. Raises RefusedError, and then nothing has changed."""
        wanted, i = [], 0
        while i < len(values):
            row = self._rows.get((function in BITS, at + i))
            if row is None or row.access != WRITE or row.width > len(values) - i:
                raise RefusedError(ExcCodes.ILLEGAL_ADDRESS)
            raw = int(values[i]) if row.width == 1 else values[i] << 16 | values[i + 1]
            bits = 16 * row.width
            if row.kind.startswith("I") and raw >> bits - 1:
                raw -= 1 << bits
            wanted.append((self._writers[row.name], raw))
            i += row.width
        for only in (True, False):
            for write, raw in wanted:
                write(raw, only)


def signal_readers(
    rows: Iterable[Register], row: np.ndarray, parameters: Mapping[str, float]
) -> dict[str, Reader]:
    """Readers of the rows that carry a signal; `row` is the live float64 row of all signals."""
    return {
        one.name: process_image.reader(
            row,
            signals.column(one.signal, one.axle),
            Place(0, 0, 0, one.kind, one.scale, one.of, one.wraps),
            parameters[one.of] if one.of else 1.0,
        )
        for one in rows
        if one.signal
    }


def drive(node: Node) -> Unit:
    """The unit of a drive: its registers are objects of its dictionary."""
    rows = drive_words(node.dictionary)
    return Unit(
        rows,
        {row.name: node.objects.getter(key(row.od_index, 0)) for row in rows},
        {
            row.name: partial(_assign, node.objects, key(row.od_index, 0))
            for row in rows
            if row.access == WRITE
        },
    )


_OUT_OF_RANGE = (Abort.TOO_HIGH, Abort.TOO_LOW, Abort.INVALID_VALUE)


def _assign(objects: Objects, at: int, raw: int, only: bool) -> None:
    """Write an object by the rules of an SDO client; `only` asks whether it would be taken."""
    try:
        if only:
            # a register may be wider than its object
            objects.variables[at].encode_raw(raw)
            objects.check(at, raw)
        else:
            objects.assign(at, raw)
    except (ValueError, struct.error):
        raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None
    except AbortError as error:
        code = ExcCodes.ILLEGAL_VALUE if error.code in _OUT_OF_RANGE else ExcCodes.DEVICE_BUSY
        raise RefusedError(code) from None
