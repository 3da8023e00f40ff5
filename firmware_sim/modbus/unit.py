"""The registers of one Modbus unit: reads come from live sources, writes go to the owner of the
value.

Nothing is stored here. A request is checked as a whole, with all its registers, before the first
value changes. Two registers that hold one value are read from one sample and written together.
"""

import struct
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from pymodbus.constants import ExcCodes

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, Key, Objects, key
from rollerrig.firmware_sim.modbus.map import BIT, WRITE, Register, drive_registers
from rollerrig.firmware_sim.modbus.pdu import BIT_FUNCTIONS, RefusedError
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Place

REGISTER_BITS = 16
REGISTER_MASK = 0xFFFF
PLANS_KEPT = 256

# returns a raw value
Reader = Callable[[], int]
# receives a raw value and `check_only`; raises RefusedError for a value that is not allowed. With
# `check_only` it changes nothing
Writer = Callable[[int, bool], None]


class Source(NamedTuple):
    """The source of a bit or of a register: a raw value, shifted right."""

    read: Reader
    shift: int


class Step(NamedTuple):
    """One value to read for a request. Each shift of it gives one register."""

    read: Reader
    shifts: list[int]


class Unit:
    """Bits and registers of a unit.

    `readers` and `writers` are for raw values, by name of the row.
    """

    def __init__(
        self, rows: Iterable[Register], readers: Mapping[str, Reader], writers: Mapping[str, Writer]
    ) -> None:
        self._bits: dict[int, Source] = {}
        self._registers: dict[int, Source] = {}
        self._rows: dict[tuple[bool, int], Register] = {}
        self._writers = writers
        for row in rows:
            is_bit = row.kind == BIT
            sources = self._bits if is_bit else self._registers
            self._rows[is_bit, row.address] = row
            for at in range(row.width):
                # the higher register comes first
                shift = REGISTER_BITS * (row.width - 1 - at)
                sources[row.address + at] = Source(readers[row.name], shift)
        # clients read the same registers again and again
        self._plan = lru_cache(PLANS_KEPT)(self._plan_of)

    async def async_getValues(
        self, unit: int, function: int, address: int, count: int
    ) -> list[int]:
        """Return bits or registers, depending on the function code. Raises RefusedError."""
        values = []
        for read, shifts in self._plan(function in BIT_FUNCTIONS, address, count):
            raw = read()
            for shift in shifts:
                values.append(raw >> shift & REGISTER_MASK)
        return values

    def _plan_of(self, is_bit: bool, address: int, count: int) -> list[Step]:
        """Return the steps of a read, which read each value once. Raises RefusedError."""
        sources = self._bits if is_bit else self._registers
        plan: list[Step] = []
        for at in range(address, address + count):
            if at not in sources:
                raise RefusedError(ExcCodes.ILLEGAL_ADDRESS)
            read, shift = sources[at]
            # the next register of the same value; a new value begins with a larger shift
            if plan and plan[-1].read is read and plan[-1].shifts[-1] > shift:
                plan[-1].shifts.append(shift)
            else:
                plan.append(Step(read, [shift]))
        return plan

    async def async_setValues(
        self, unit: int, function: int, address: int, values: list[int]
    ) -> None:
        """Set bits or registers. Raises RefusedError, and then nothing has changed."""
        requested = self._requested(function in BIT_FUNCTIONS, address, values)
        for check_only in (True, False):
            for write, raw in requested:
                write(raw, check_only)

    def _requested(self, is_bit: bool, address: int, values: list[int]) -> list[tuple[Writer, int]]:
        """Return the writers that a request concerns, with their raw values.

        Raises RefusedError.
        """
        requested = []
        at = 0
        while at < len(values):
            row = self._rows.get((is_bit, address + at))
            if row is None or row.access != WRITE or row.width > len(values) - at:
                raise RefusedError(ExcCodes.ILLEGAL_ADDRESS)
            raw = _raw_value(row, values[at : at + row.width])
            requested.append((self._writers[row.name], raw))
            at += row.width
        return requested


def _raw_value(row: Register, values: list[int]) -> int:
    """Return the raw value of a row from its bit or its registers, the higher one first."""
    raw = 0
    for value in values:
        raw = raw << REGISTER_BITS | int(value)
    bits = REGISTER_BITS * row.width
    is_signed = row.kind.startswith("I")
    if is_signed and raw >> bits - 1:
        raw -= 1 << bits
    return raw


def signal_readers(
    rows: Iterable[Register], row: np.ndarray, parameters: Mapping[str, float]
) -> dict[str, Reader]:
    """Return the readers of the registers that carry a signal, by name of the register.

    `row`: the live float64 row of all signals; `parameters`: values by the name that a scale needs.
    """
    readers = {}
    for register in rows:
        if not register.signal:
            continue
        place = Place(
            node=0,
            index=0,
            sub=0,
            kind=register.kind,
            scale=register.scale,
            of=register.of,
            wraps=register.wraps,
        )
        readers[register.name] = process_image.reader(
            row,
            signals.column(register.signal, register.axle),
            place,
            parameters[register.of] if register.of else 1.0,
        )
    return readers


def drive(node: Node) -> Unit:
    """Return the unit of a drive, whose registers are objects of its dictionary."""
    rows = drive_registers(node.dictionary)
    readers: dict[str, Reader] = {}
    writers: dict[str, Writer] = {}
    for row in rows:
        object_key = key(row.od_index, 0)
        readers[row.name] = node.objects.getter(object_key)
        if row.access == WRITE:
            writers[row.name] = partial(_assign, node.objects, object_key)
    return Unit(rows, readers, writers)


_OUT_OF_RANGE = (Abort.TOO_HIGH, Abort.TOO_LOW, Abort.INVALID_VALUE)


def _assign(objects: Objects, object_key: Key, raw: int, check_only: bool) -> None:
    """Write an object by the rules for an SDO client. Raises RefusedError."""
    try:
        if check_only:
            # a register may be wider than its object
            objects.variables[object_key].encode_raw(raw)
            objects.check(object_key, raw)
        else:
            objects.assign(object_key, raw)
    except (ValueError, struct.error):
        raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None
    except AbortError as error:
        out_of_range = error.code in _OUT_OF_RANGE
        code = ExcCodes.ILLEGAL_VALUE if out_of_range else ExcCodes.DEVICE_BUSY
        raise RefusedError(code) from None
