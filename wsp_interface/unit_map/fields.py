"""Values of the messages of a unit: limited to their range, counters, checksums and constants.

A value that its signal cannot carry becomes the nearest one that it can. That is the nearest end of
the signal's bits, and of the range that the DBC declares: a value above the declared range often
means an error to a unit. `[0|0]` declares no range.

Besides quantities of the rig a message may carry

- constants, such as a mode or the number of a multiplexed group;
- a counter, which grows by 1 with each message and starts again at 0 after its largest value;
- a checksum over the other bytes, which may begin with bytes that are not sent (a data ID).

Source: cantools (MIT) for the messages, crccheck (MIT) for the checksums. Their parameters are
those of the catalogue of parametrised CRC algorithms.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal
from crccheck import checksum, crc

# the checksums of a mapping; each takes the bytes in the order of the frame
CHECKSUMS: dict[str, Any] = {
    "sum8": checksum.Checksum8,
    "xor8": checksum.ChecksumXor8,
    "crc8_sae_j1850": crc.Crc8SaeJ1850,
    "crc8_autosar": crc.Crc8Autosar,
    "crc8_smbus": crc.Crc8Smbus,
    "crc16_autosar": crc.Crc16Autosar,
    "crc16_arc": crc.Crc16Arc,
    "crc16_modbus": crc.Crc16Modbus,
}
_BYTE = 8  # bits


@dataclass(frozen=True)
class Checksum:
    """A checksum over the bytes of a message that it does not occupy itself.

    prefix: bytes before those of the message, which are not sent.
    """

    signal: str
    kind: str  # a key of CHECKSUMS
    prefix: bytes = b""

    def raw(self, message: DbcMessage, data: bytes) -> int:
        """Return the checksum for the bytes of a message."""
        occupied = occupied_bytes(message, self.signal)
        covered = bytes(byte for at, byte in enumerate(data) if at not in occupied)
        return int(CHECKSUMS[self.kind].calc(self.prefix + covered))


@dataclass(frozen=True)
class Filled:
    """The fields of a message that carry no quantity of the rig.

    constants: values by signal, in the unit of the signal.
    counter: the signal of the alive counter; "" for none.
    """

    constants: Mapping[str, float] = field(default_factory=dict)
    counter: str = ""
    checksum: Checksum | None = None

    def names(self) -> tuple[str, ...]:
        """Return the signals that are filled."""
        names = [*self.constants]
        if self.counter:
            names.append(self.counter)
        if self.checksum:
            names.append(self.checksum.signal)
        return tuple(names)


def signal_of(message: DbcMessage, name: str) -> DbcSignal:
    """Return a signal of a message by its name."""
    return message.get_signal_by_name(name)


def raw_range(signal: DbcSignal) -> tuple[float, float]:
    """Return the smallest and the largest raw value that a signal carries and its DBC allows."""
    if signal.is_float:
        low, high = float("-inf"), float("inf")
    elif signal.is_signed:
        low, high = -(2.0 ** (signal.length - 1)), 2.0 ** (signal.length - 1) - 1.0
    else:
        low, high = 0.0, 2.0**signal.length - 1.0
    if signal.minimum is None or signal.maximum is None or signal.minimum >= signal.maximum:
        return low, high

    # a negative scale turns the ends of the range round
    ends = sorted((_raw(signal, signal.minimum), _raw(signal, signal.maximum)))
    return max(low, ends[0]), min(high, ends[1])


def limited(signal: DbcSignal, value: float) -> tuple[float, bool]:
    """Return the raw value of a signal, and whether the value had to be limited to its range."""
    low, high = raw_range(signal)
    raw = _raw(signal, value)
    within = min(max(raw, low), high)
    return within, within != raw


def _raw(signal: DbcSignal, value: float) -> float:
    """Return the raw value of a scaled one; a whole number if the signal carries these only."""
    raw = (value - signal.offset) / signal.scale
    return float(raw) if signal.is_float else float(round(raw))


def encode(message: DbcMessage, raw_values: Mapping[str, float]) -> bytes:
    """Return the bytes of a message for the raw values of all its signals."""
    content: dict[str, float] = {}
    for name, raw in raw_values.items():
        content[name] = raw if signal_of(message, name).is_float else int(raw)
    return bytes(message.encode(content, scaling=False, strict=False))


def selected_signals(message: DbcMessage, constants: Mapping[str, float]) -> tuple[str, ...]:
    """Return the signals that a message carries, where constants select a multiplexed group.

    Signals of a group that is not selected are left out. Without a constant for a multiplexer all
    its groups count.
    """
    names = []
    for signal in message.signals:
        multiplexer = signal.multiplexer_signal
        if multiplexer is not None and multiplexer in constants and signal.multiplexer_ids:
            group = round(_raw(signal_of(message, multiplexer), constants[multiplexer]))
            if group not in signal.multiplexer_ids:
                continue
        names.append(signal.name)
    return tuple(names)


def occupied_bytes(message: DbcMessage, name: str) -> tuple[int, ...]:
    """Return the places of the bytes that a signal occupies; empty unless it fills them wholly."""
    signal = signal_of(message, name)
    first_bit = signal.start
    if signal.byte_order == "big_endian":
        # it starts with its highest bit, which is bit 7 of its first byte
        first_bit -= _BYTE - 1
    if signal.length % _BYTE or first_bit % _BYTE:
        return ()
    first = first_bit // _BYTE
    return tuple(range(first, first + signal.length // _BYTE))


def checksum_bits(kind: str) -> int:
    """Return how many bits a checksum has."""
    return int(CHECKSUMS[kind].width())
