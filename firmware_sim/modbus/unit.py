"""The image of one Modbus unit: reads come from live sources, writes go to whoever owns a value.

Nothing is stored here. A request is checked as a whole, every register of it, before the first
value changes. Two registers that carry one value are read from one sample and written together.
"""

import struct
from collections.abc import Callable, Iterable, Mapping
from functools import partial

import numpy as np

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.firmware_sim.modbus.map import BIT, WRITE, Register, drive_words
from rollerrig.firmware_sim.modbus.pdu import Code, RefusedError
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Place

Reader = Callable[[], int]
# called with a raw value, first with only=True to ask whether it would be taken: RefusedError if not
Writer = Callable[[int, bool], None]
_LAST_ADDRESS = 0xFFFF


class Unit:
    """Bits and registers of a unit. `readers` and `writers` are raw values by name of the row."""

    def __init__(self, rows: Iterable[Register], readers: Mapping[str, Reader],
                 writers: Mapping[str, Writer]) -> None:
        self._bits: dict[int, Reader] = {}
        self._words: dict[int, Callable[[], bytes]] = {}
        self._rows: dict[tuple[bool, int], Register] = {}
        self._writers = writers
        for row in rows:
            read = readers[row.name]
            self._rows[row.kind == BIT, row.at] = row
            if row.kind == BIT:
                self._bits[row.at] = read
            elif row.width == 1:
                self._words[row.at] = partial(_word, read, 0)
            else:
                self._words[row.at] = partial(_word, read, 16)
                self._words[row.at + 1] = partial(_word, read, 0)

    def read_bits(self, at: int, count: int) -> bytes:
        """`count` bits, eight a byte, the first one lowest. Raises RefusedError."""
        _check_span(at, count)
        try:
            packed = sum(1 << i for i in range(count) if self._bits[at + i]())
        except KeyError:
            raise RefusedError(Code.ADDRESS) from None
        return packed.to_bytes((count + 7) // 8, "little")

    def read_words(self, at: int, count: int) -> bytes:
        """`count` registers, two bytes each. Raises RefusedError."""
        words = self._words
        try:
            found = [words[one] for one in range(at, at + count)]
        except KeyError:
            raise RefusedError(Code.ADDRESS) from None
        return b"".join([read() for read in found])

    def write_bits(self, at: int, bits: list[bool]) -> None:
        """Set bits. Raises RefusedError, and then nothing has changed."""
        _check_span(at, len(bits))
        self._write([(self._writable(True, at + i), int(bit)) for i, bit in enumerate(bits)])

    def write_words(self, at: int, words: list[int]) -> None:
        """Set registers. Raises RefusedError, and then nothing has changed."""
        _check_span(at, len(words))
        wanted, i = [], 0
        while i < len(words):
            row = self._writable(False, at + i)
            if row.width > len(words) - i:
                raise RefusedError(Code.ADDRESS)
            raw = words[i] if row.width == 1 else words[i] << 16 | words[i + 1]
            bits = 16 * row.width
            if row.kind.startswith("I") and raw >> bits - 1:
                raw -= 1 << bits
            wanted.append((row, raw))
            i += row.width
        self._write(wanted)

    def _writable(self, bit: bool, at: int) -> Register:
        row = self._rows.get((bit, at))
        if row is None or row.access != WRITE:
            raise RefusedError(Code.ADDRESS)
        return row

    def _write(self, wanted: list[tuple[Register, int]]) -> None:
        for only in (True, False):
            for row, raw in wanted:
                self._writers[row.name](raw, only)


def _word(read: Reader, shift: int) -> bytes:
    return (read() >> shift & 0xFFFF).to_bytes(2, "big")


def _check_span(at: int, count: int) -> None:
    if at + count - 1 > _LAST_ADDRESS:
        raise RefusedError(Code.ADDRESS)


def signal_readers(rows: Iterable[Register], row: np.ndarray, parameters: Mapping[str, float]
                   ) -> dict[str, Reader]:
    """Readers of the rows that carry a signal; `row` is the live float64 row of all signals."""
    found = {}
    for one in rows:
        if one.signal:
            place = Place(0, 0, 0, one.kind, one.scale, one.of, one.wraps)
            found[one.name] = process_image.reader(
                row, signals.column(one.signal, one.axle), place,
                parameters[one.of] if one.of else 1.0)
    return found


def drive(node: Node) -> Unit:
    """The unit of a drive: its registers are objects of its dictionary."""
    rows = drive_words(node.dictionary)
    readers: dict[str, Reader] = {}
    writers: dict[str, Writer] = {}
    for row in rows:
        at = key(row.od_index, row.od_sub)
        readers[row.name] = node.objects.getter(at)
        if row.access == WRITE:
            writers[row.name] = partial(_assign, node, at)
    return Unit(rows, readers, writers)


_OUT_OF_RANGE = (Abort.TOO_HIGH, Abort.TOO_LOW, Abort.INVALID_VALUE)


def _assign(node: Node, at: int, raw: int, only: bool) -> None:
    """Write an object by the rules of an SDO client; `only` asks whether it would be taken."""
    objects = node.objects
    variable = objects.variables[at]
    try:
        if not only:
            objects.assign(at, raw)
            return
        # a register may be wider than its object
        variable.encode_raw(raw)
        low, high = variable.min, variable.max
        if (low is not None and raw < low) or (high is not None and raw > high):
            raise RefusedError(Code.VALUE)
        if at in objects.checks:
            objects.checks[at](raw)
    except (ValueError, struct.error):
        raise RefusedError(Code.VALUE) from None
    except AbortError as error:
        raise RefusedError(Code.VALUE if error.code in _OUT_OF_RANGE else Code.BUSY) from None
