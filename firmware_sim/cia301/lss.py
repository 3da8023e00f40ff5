"""Layer setting services: a master finds a node by its identity and gives it a node identifier.

A switch command selects all nodes together, or one node by its four identity numbers. A selected
node accepts an identifier, which becomes active with the next reset of communication. Fastscan
finds a node without an identifier: the master tests the identity bit by bit. On command the node
stores identifier and bit timing in its file. The bit timing has no effect here.
Source: CiA 305; written from its published descriptions.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.host import Host
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.firmware_sim.cia301.storage import Storage
from rollerrig.wsp_interface.bus.connection_set import LSS_ANSWER
from rollerrig.wsp_interface.bus.frames import Frame

UNCONFIGURED = 255  # a node without an identifier

# command specifiers of CiA 305
_SWITCH_GLOBAL = 0x04
_NODE_ID = 0x11
_BIT_TIMING = 0x13
_STORE = 0x17
_SELECT = (0x40, 0x41, 0x42, 0x43)  # by vendor, product, revision, serial number
_SELECTED = 0x44
_IDENTIFY = (0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B)  # vendor, product, revision and serial from .. to
_IDENTIFIED = 0x4F
_NON_CONFIGURED = 0x4C
_IS_NON_CONFIGURED = 0x50
_FASTSCAN = 0x51
_INQUIRE = (0x5A, 0x5B, 0x5C, 0x5D, 0x5E)  # the four identity numbers, then the node identifier

# bit timing: table 0 is the standard table; its index 2 is 500 kbit/s, its index 5 is reserved
_STANDARD_TABLE = 0
_RATES = (0, 1, 2, 3, 4, 6, 7, 8)
_DEFAULT_RATE = 2

_FASTSCAN_RESET = 0x80  # bit check: all nodes begin again


class LssSlave:
    """The LSS side of a node.

    `configuring`: the node is selected. `pending`: the identifier after the next reset.
    """

    def __init__(self, node: Host, storage: Storage) -> None:
        self.node = node
        self.storage = storage
        self.configuring = False
        self.pending = node.node_id
        self.bit_timing = _DEFAULT_RATE
        self._position = 0  # of fastscan: the identity number that is tested next
        # the numbers of a selection or an identification that have matched, in sequence
        self._matched = {_SELECT: 0, _IDENTIFY: 0}
        services: dict[int, Callable[[bytes], None]] = {
            _SWITCH_GLOBAL: self._switch_global,
            _NODE_ID: self._set_node_id,
            _BIT_TIMING: self._set_bit_timing,
            _STORE: self._store,
            _NON_CONFIGURED: self._identify_non_configured,
            _FASTSCAN: self._fastscan,
        }
        services |= dict.fromkeys(_SELECT, self._select)
        services |= dict.fromkeys(_IDENTIFY, self._identify)
        services |= dict.fromkeys(_INQUIRE, self._inquire)
        self._services = services

    def power_on(self) -> None:
        """Begin with the stored settings, if there are any."""
        stored = self.storage.stored_settings()
        if stored is not None:
            self.pending, self.bit_timing = stored
        self.configuring = False

    def on_frame(self, frame: Frame) -> None:
        """Take a message of the LSS master. A message without eight bytes is ignored."""
        if len(frame.data) != 8:
            return
        service = self._services.get(frame.data[0])
        if service is not None:
            service(frame.data)

    def _identity(self) -> list[int]:
        values = self.node.objects.values
        return [values[key(0x1018, sub)] for sub in range(1, 5)]

    def _answer(self, command: int, rest: bytes = b"") -> None:
        self.node.transmit(LSS_ANSWER, (bytes([command]) + rest).ljust(8, b"\0"))

    def _switch_global(self, data: bytes) -> None:
        if data[1] not in (0, 1):
            return
        self.configuring = data[1] == 1
        has_new_identifier = self.node.node_id == UNCONFIGURED and self.pending != UNCONFIGURED
        if not self.configuring and has_new_identifier:
            # a node without an identifier starts as soon as it has one
            self.node.reset_node(everything=False)

    def _completes(self, commands: tuple[int, ...], data: bytes, matches: bool) -> bool:
        """Return whether this command completes a series that has matched, in its order."""
        at = data[0] - commands[0]
        matched_before = self._matched[commands] if at else 0
        in_sequence = matches and matched_before == at
        last = at == len(commands) - 1
        self._matched[commands] = at + 1 if in_sequence and not last else 0
        return in_sequence and last

    def _select(self, data: bytes) -> None:
        matches = _number(data) == self._identity()[data[0] - _SELECT[0]]
        if self._completes(_SELECT, data, matches):
            self.configuring = True
            self._answer(_SELECTED)

    def _identify(self, data: bytes) -> None:
        number = _number(data)
        vendor, product, revision, serial = self._identity()
        matches = {
            0x46: number == vendor,
            0x47: number == product,
            0x48: number <= revision,
            0x49: number >= revision,
            0x4A: number <= serial,
            0x4B: number >= serial,
        }
        if self._completes(_IDENTIFY, data, matches[data[0]]):
            self._answer(_IDENTIFIED)

    def _set_node_id(self, data: bytes) -> None:
        if not self.configuring:
            return
        allowed = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
        if allowed:
            self.pending = data[1]
        self._answer(_NODE_ID, bytes([not allowed]))

    def _set_bit_timing(self, data: bytes) -> None:
        if not self.configuring:
            return
        known = data[1] == _STANDARD_TABLE and data[2] in _RATES
        if known:
            self.bit_timing = data[2]
        self._answer(_BIT_TIMING, bytes([not known]))

    def _store(self, _: bytes) -> None:
        if self.configuring:
            result = self.storage.store_settings(self.pending, self.bit_timing)
            self._answer(_STORE, bytes([result]))

    def _inquire(self, data: bytes) -> None:
        if not self.configuring:
            return
        answers = [number.to_bytes(4, "little") for number in self._identity()]
        answers.append(bytes([self.node.node_id]))
        self._answer(data[0], answers[data[0] - _INQUIRE[0]])

    def _identify_non_configured(self, _: bytes) -> None:
        if self.node.node_id == UNCONFIGURED:
            self._answer(_IS_NON_CONFIGURED)

    def _fastscan(self, data: bytes) -> None:
        if self.node.node_id != UNCONFIGURED or self.configuring:
            return
        bit, part, next_part = data[5:8]  # bit to test, and which identity number
        if bit == _FASTSCAN_RESET:
            self._position = 0
            self._answer(_IDENTIFIED)
            return
        if bit > 31 or part > 3 or next_part > 3 or part != self._position:
            return
        if _number(data) >> bit == self._identity()[part] >> bit:
            self._answer(_IDENTIFIED)
            self._position = next_part
            # the last bit of the last number: the node is found, and selected
            if bit == 0 and next_part < part:
                self.configuring = True


def _number(data: bytes) -> int:
    return int.from_bytes(data[1:5], "little")
