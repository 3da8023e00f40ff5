"""Layer setting services: a master finds a node by its identity and gives it a node identifier.

A node waits until a switch command selects it, all nodes at once or one by its four identity numbers; then it takes
an identifier, which becomes active with the next reset of communication. Fastscan finds a node without identifier by
asking for its identity bit by bit. Source: CiA 305; written from its published descriptions. Identifier and bit
timing are kept in the node's file when the master says so; the bit timing is taken note of and changes nothing here.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.firmware_sim.cia301.storage import Storage
from rollerrig.wsp_interface.bus.connection_set import LSS_ANSWER
from rollerrig.wsp_interface.bus.frames import Frame

UNCONFIGURED = 255
_SWITCH_GLOBAL, _NODE_ID, _BIT_TIMING, _STORE = 0x04, 0x11, 0x13, 0x17
_SELECT, _SELECTED = (0x40, 0x41, 0x42, 0x43), 0x44
_IDENTIFY, _IDENTIFIED = (0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B), 0x4F
_NON_CONFIGURED, _IS_NON_CONFIGURED, _FASTSCAN = 0x4C, 0x50, 0x51
# the four identity numbers, then the node identifier
_INQUIRE = (0x5A, 0x5B, 0x5C, 0x5D, 0x5E)
# CiA 305: index 2 of the standard table is 500 kbit/s, index 5 is reserved
_STANDARD_TABLE, _RATES, _DEFAULT_RATE = 0, (0, 1, 2, 3, 4, 6, 7, 8), 2


class LssSlave:
    """The LSS side of a node. `configuring`: selected; `pending`: the identifier to come."""

    def __init__(self, node: Host, storage: Storage) -> None:
        self.node, self.storage, self.configuring, self.pending = node, storage, False, node.node_id
        self._position, self.bit_timing = 0, _DEFAULT_RATE
        # how many numbers of a selection or an identification have matched, one after the other
        self._matched = {_SELECT: 0, _IDENTIFY: 0}
        steps: dict[int, Callable[[bytes], None]] = {
            _SWITCH_GLOBAL: self._switch_global,
            _NODE_ID: self._set_node_id,
            _BIT_TIMING: self._set_bit_timing,
            _STORE: self._store,
            _NON_CONFIGURED: self._identify_non_configured,
            _FASTSCAN: self._fastscan,
        }
        steps |= dict.fromkeys(_SELECT, self._select) | dict.fromkeys(_IDENTIFY, self._identify)
        self._steps = steps | dict.fromkeys(_INQUIRE, self._inquire)

    def power_on(self) -> None:
        """Begin with what has been stored, where anything has."""
        kept = self.storage.kept_settings()
        if kept is not None:
            self.pending, self.bit_timing = kept
        self.configuring = False

    def on_frame(self, frame: Frame) -> None:
        """A message of the LSS master; one that has not eight bytes is not LSS."""
        step = self._steps.get(frame.data[0]) if len(frame.data) == 8 else None
        if step is not None:
            step(frame.data)

    def _identity(self) -> list[int]:
        values = self.node.objects.values
        return [values[key(0x1018, sub)] for sub in range(1, 5)]

    def _answer(self, command: int, rest: bytes = b"") -> None:
        self.node.transmit(LSS_ANSWER, (bytes([command]) + rest).ljust(8, b"\0"))

    def _switch_global(self, data: bytes) -> None:
        if data[1] not in (0, 1):
            return
        self.configuring = data[1] == 1
        if not self.configuring and self.node.node_id == UNCONFIGURED != self.pending:
            # a node that had no identifier starts as soon as it has been given one
            self.node.reset_node(everything=False)

    def _completes(self, commands: tuple[int, ...], data: bytes, matches: bool) -> bool:
        """Whether this command is the last of a series that have all matched, in their order."""
        at = data[0] - commands[0]
        before = self._matched[commands] if at else 0
        self._matched[commands] = (at + 1) % len(commands) if matches and before == at else 0
        return matches and before == at == len(commands) - 1

    def _select(self, data: bytes) -> None:
        matches = _number(data) == self._identity()[data[0] - _SELECT[0]]
        if self._completes(_SELECT, data, matches):
            self.configuring = True
            self._answer(_SELECTED)

    def _identify(self, data: bytes) -> None:
        number, (vendor, product, revision, serial) = _number(data), self._identity()
        matches = (
            number == vendor,
            number == product,
            number <= revision,
            number >= revision,
            number <= serial,
            number >= serial,
        )[data[0] - _IDENTIFY[0]]
        if self._completes(_IDENTIFY, data, matches):
            self._answer(_IDENTIFIED)

    def _set_node_id(self, data: bytes) -> None:
        if self.configuring:
            allowed = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
            self.pending = data[1] if allowed else self.pending
            self._answer(_NODE_ID, bytes([not allowed]))

    def _set_bit_timing(self, data: bytes) -> None:
        if self.configuring:
            known = data[1] == _STANDARD_TABLE and data[2] in _RATES
            self.bit_timing = data[2] if known else self.bit_timing
            self._answer(_BIT_TIMING, bytes([not known]))

    def _store(self, _: bytes) -> None:
        if self.configuring:
            self._answer(_STORE, bytes([self.storage.keep_settings(self.pending, self.bit_timing)]))

    def _inquire(self, data: bytes) -> None:
        if self.configuring:
            numbers = [number.to_bytes(4, "little") for number in self._identity()]
            self._answer(data[0], [*numbers, bytes([self.node.node_id])][data[0] - _INQUIRE[0]])

    def _identify_non_configured(self, _: bytes) -> None:
        if self.node.node_id == UNCONFIGURED:
            self._answer(_IS_NON_CONFIGURED)

    def _fastscan(self, data: bytes) -> None:
        if self.node.node_id != UNCONFIGURED or self.configuring:
            return
        bit, part, following = data[5:8]
        if bit == 0x80:
            self._position = 0
            self._answer(_IDENTIFIED)
        elif bit > 31 or part > 3 or following > 3 or part != self._position:
            return
        elif _number(data) >> bit == self._identity()[part] >> bit:
            self._answer(_IDENTIFIED)
            self._position = following
            self.configuring = self.configuring or (bit == 0 and following < part)


def _number(data: bytes) -> int:
    return int.from_bytes(data[1:5], "little")
