"""What outlives a power cycle: parameters, stored by 1010h and given up by 1011h, and LSS settings.

Both stand in one file of the node, each part written by its own service. Written are the parameters
that a client may change, whether or not a PDO may carry them, but no process values and no commands:
a drive must not wake up enabled. Restored defaults take effect with the next reset, as the standard
wants. Source: CiA 301, objects 1010h and 1011h with their signatures; CiA 305, store configuration.
"""

import json
from binascii import crc32
from functools import partial
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ODVariable

from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError

SAVE, LOAD = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
# what each sub-index of 1010h and 1011h covers
RANGES = {1: (0x1000, 0xFFFF), 2: (0x1000, 0x1FFF), 3: (0x2000, 0xFFFF)}
_NEVER = frozenset({0x1003, 0x1010, 0x1011})
# answers of CiA 305 to "store configuration"
STORED, NO_MEMORY, ACCESS_ERROR = 0, 1, 2


class Storage:
    """The file of a node; `path` None: the node has no memory, and storing is refused."""

    def __init__(self, node: Host, path: Path | None) -> None:
        self.node, self.path = node, path
        for index, call in ((0x1010, self._store), (0x1011, self._restore)):
            for sub in RANGES:
                # read as "can be done on command", whatever was written
                node.objects.own(
                    index, sub, read=lambda: int(self.path is not None), check=partial(call, sub)
                )

    def load(self) -> dict[int, Any]:
        """Stored values by key; nothing where there is no file or its checksum is wrong."""
        named = {f"{at:06X}": at for at in self._storable(0x1000, 0xFFFF)}
        return {
            named[name]: value
            for name, value in self._read()[0].items()
            if name in named and _fits(self.node.objects.variables[named[name]], value)
        }

    def kept_settings(self) -> tuple[int, int] | None:
        """Node identifier and bit timing that LSS has stored; None where it has not."""
        settings = self._read()[1]
        node_id, bit_timing = settings.get("node_id"), settings.get("bit_timing")
        if type(node_id) is not int or type(bit_timing) is not int:
            return None
        return (node_id, bit_timing) if 1 <= node_id <= 127 or node_id == 255 else None

    def keep_settings(self, node_id: int, bit_timing: int) -> int:
        """Store what LSS has configured; STORED, NO_MEMORY or ACCESS_ERROR."""
        if self.path is None:
            return NO_MEMORY
        try:
            self._write(self._read()[0], {"node_id": node_id, "bit_timing": bit_timing})
        except AbortError:
            return ACCESS_ERROR
        return STORED

    def _read(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Parameters and LSS settings of the file, both empty where it cannot be understood."""
        try:
            kept = json.loads(self.path.read_text(encoding="utf-8")) if self.path else {}
            values, settings = kept["values"], kept["lss"]
            sound = (
                isinstance(values, dict)
                and isinstance(settings, dict)
                and kept["checksum"] == _checksum(values, settings)
            )
        except (OSError, ValueError, LookupError, TypeError):
            sound = False
        return (values, settings) if sound else ({}, {})

    def _storable(self, first: int, last: int) -> list[int]:
        objects = self.node.objects
        return [
            at
            for at, one in objects.variables.items()
            if first <= at >> 8 <= last
            and one.readable
            and one.writable
            and one.fixed_size
            and at not in objects.readers
            and at >> 8 not in _NEVER | self.node.commands
        ]

    def _store(self, sub: int, signature: int) -> None:
        self._check(signature, SAVE)
        now = self.node.objects.values
        self._keep(self.load() | {at: now[at] for at in self._storable(*RANGES[sub])})

    def _restore(self, sub: int, signature: int) -> None:
        self._check(signature, LOAD)
        first, last = RANGES[sub]
        self._keep({at: value for at, value in self.load().items() if not first <= at >> 8 <= last})

    def _check(self, signature: int, wanted: int) -> None:
        if signature != wanted or self.path is None:
            raise AbortError(Abort.NOT_STORED)

    def _keep(self, kept: dict[int, Any]) -> None:
        self._write({f"{at:06X}": value for at, value in sorted(kept.items())}, self._read()[1])

    def _write(self, values: dict[str, Any], settings: dict[str, Any]) -> None:
        assert self.path is not None
        content = {"checksum": _checksum(values, settings), "values": values, "lss": settings}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.write_text(json.dumps(content, indent=1), encoding="utf-8")
        except OSError:
            raise AbortError(Abort.NOT_STORED) from None


def _checksum(*parts: dict[str, Any]) -> int:
    return crc32(json.dumps(parts, sort_keys=True).encode())


def _fits(one: ODVariable, value: Any) -> bool:
    """Whether a value that came from the file is one the object may have."""
    try:
        one.encode_raw(value)
    except (ValueError, TypeError, AttributeError):
        return False
    return (one.min is None or value >= one.min) and (one.max is None or value <= one.max)
