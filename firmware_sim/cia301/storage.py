"""Values that survive a power cycle: parameters and the settings of LSS.

1010h stores parameters, 1011h restores their defaults.
The node has one file for both; each service writes its part. The file contains the parameters that
a client may change, mappable or not. It contains no process values and no commands, because a drive
must not start enabled. Restored defaults take effect with the next reset, as the standard requires.
Source: CiA 301, objects 1010h and 1011h with their signatures; CiA 305, store configuration.
"""

import json
from binascii import crc32
from functools import partial
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ODVariable

from rollerrig.configs import output_files, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")
# first and last index of the objects that a sub-index of 1010h and 1011h covers
RANGES = {1: (0x1000, 0xFFFF), 2: (0x1000, 0x1FFF), 3: (0x2000, 0xFFFF)}
_NEVER_STORED = frozenset({0x1003, 0x1010, 0x1011})
# answers of CiA 305 to "store configuration"
STORED = 0
NO_MEMORY = 1
ACCESS_ERROR = 2


class Storage:
    """The file of a node. If `path` is None, the node has no memory and refuses to store."""

    def __init__(self, node: Host, path: Path | None) -> None:
        self.node = node
        self.path = path
        for sub in RANGES:
            # a client reads 1 (can store on command) or 0, whatever was written
            node.objects.attach(0x1010, sub, read=self._can_store, check=partial(self._store, sub))
            node.objects.attach(
                0x1011, sub, read=self._can_store, check=partial(self._restore, sub)
            )

    def _can_store(self) -> int:
        return int(self.path is not None)

    def load(self) -> dict[int, Any]:
        """Return the stored values by key; empty if there is no file or its checksum is wrong."""
        parameters, _ = self._read()
        stored = {}
        for at in self._storable(0x1000, 0xFFFF):
            name = _name(at)
            if name in parameters and _fits(self.node.objects.variables[at], parameters[name]):
                stored[at] = parameters[name]
        return stored

    def stored_settings(self) -> tuple[int, int] | None:
        """Return the node identifier and bit timing that LSS has stored; None if it has not."""
        _, settings = self._read()
        node_id = settings.get("node_id")
        bit_timing = settings.get("bit_timing")
        if type(node_id) is not int or type(bit_timing) is not int:
            return None
        if not (1 <= node_id <= 127 or node_id == 255):
            return None
        return node_id, bit_timing

    def store_settings(self, node_id: int, bit_timing: int) -> int:
        """Store the settings of LSS. Returns STORED, NO_MEMORY or ACCESS_ERROR."""
        if self.path is None:
            return NO_MEMORY
        parameters, _ = self._read()
        try:
            self._write(parameters, {"node_id": node_id, "bit_timing": bit_timing})
        except AbortError:
            return ACCESS_ERROR
        return STORED

    def _read(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return parameters and LSS settings; both are empty if the file is missing or damaged."""
        if self.path is None:
            return {}, {}
        try:
            content = user_files.read_json(self.path)
            parameters = content["values"]
            settings = content["lss"]
            intact = content["checksum"] == _checksum(parameters, settings)
        except (ConfigError, LookupError, TypeError):
            return {}, {}
        if not (intact and isinstance(parameters, dict) and isinstance(settings, dict)):
            return {}, {}
        return parameters, settings

    def _storable(self, first: int, last: int) -> list[int]:
        """Return the keys of objects from index first to last that may be stored."""
        objects = self.node.objects
        not_stored = _NEVER_STORED | self.node.commands
        storable = []
        for at, variable in objects.variables.items():
            index = at >> 8
            in_range = first <= index <= last
            parameter = variable.readable and variable.writable and variable.fixed_size
            live = at in objects.readers
            if in_range and parameter and not live and index not in not_stored:
                storable.append(at)
        return storable

    def _store(self, sub: int, signature: int) -> None:
        """Store the present values, if the client has written the signature to 1010h."""
        self._check(signature, SAVE)
        stored = self.load()
        for at in self._storable(*RANGES[sub]):
            stored[at] = self.node.objects.values[at]
        self._write_parameters(stored)

    def _restore(self, sub: int, signature: int) -> None:
        """Forget stored values, if the client has written the signature to 1011h."""
        self._check(signature, LOAD)
        first, last = RANGES[sub]
        remaining = {}
        for at, value in self.load().items():
            restored = first <= at >> 8 <= last
            if not restored:
                remaining[at] = value
        self._write_parameters(remaining)

    def _check(self, signature: int, expected: int) -> None:
        if signature != expected or self.path is None:
            raise AbortError(Abort.NOT_STORED)

    def _write_parameters(self, stored: dict[int, Any]) -> None:
        """Write these parameters into the file. The settings of LSS do not change."""
        parameters = {_name(at): value for at, value in sorted(stored.items())}
        _, settings = self._read()
        self._write(parameters, settings)

    def _write(self, values: dict[str, Any], settings: dict[str, Any]) -> None:
        assert self.path is not None
        content = {"checksum": _checksum(values, settings), "values": values, "lss": settings}
        try:
            output_files.make_folder(self.path.parent)
            output_files.write_text(self.path, json.dumps(content, indent=1))
        except (OSError, ConfigError):
            raise AbortError(Abort.NOT_STORED) from None


def _name(at: int) -> str:
    """Return the name of an object in the file: index and sub-index as six hexadecimal digits."""
    return f"{at:06X}"


def _checksum(*parts: dict[str, Any]) -> int:
    return crc32(json.dumps(parts, sort_keys=True).encode())


def _fits(variable: ODVariable, value: Any) -> bool:
    """Return whether an object may have a value from the file."""
    try:
        variable.encode_raw(value)
    except (ValueError, TypeError, AttributeError):
        return False
    if variable.min is not None and value < variable.min:
        return False
    return variable.max is None or value <= variable.max
