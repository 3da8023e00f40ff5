"""The brake I/O, node 17: dump-valve magnets out, brake cylinder pressures in, as a CiA 401 module.

The magnets follow a command immediately. When the heartbeat of the WSP unit is lost, or the node is
stopped or reset, the magnets fall to the fail-safe value (all off: the brakes apply). They stay
there until the heartbeat is back. A vent magnet without its hold magnet is reported and treated as
vent. Source: CiA 401 (6200h outputs, 6206h and 6207h error mode and value, 6401h and 6411h
analogue).
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES_OF_BOGIE, MOST_AXLES
from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.communication import (
    ACYCLIC,
    EVENT_DRIVEN,
    SYNCHRONOUS,
    Pdo,
    Profile,
)
from rollerrig.firmware_sim.cia301.dictionary import Row, array
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.wsp_interface import magnets, signals
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.magnets import BITS_PER_AXLE
from rollerrig.wsp_interface.rig_objects import UNIT_LOST_AFTER_MS
from rollerrig.wsp_interface.signals import (
    BRAKE_NODE,
    TRACK_BRAKE_OBJECT,
    TRACK_BRAKE_SUB,
    Table,
)

# the array of commands: the energised magnets of each axle (bit 0 hold, bit 1 vent), with room for
# the most axles, then the brake cylinder pressure in Pa that the bus commands (NaN: none)
MAGNETS = slice(0, MOST_AXLES)
BRAKE_DEMAND = MOST_AXLES
COMMANDS = MOST_AXLES + 1

DEVICE_TYPE = 0x000F0191
PRODUCT = process_image.Product("brake I/O", 0x401)
TITLES = {0x6401: "Read analogue input 16-bit"}
DEMAND = signals.first_place("brake_demand")
HIGHEST_DEMAND_mbar = 10_000
# the bits of 6200h:2 that command the magnets of the leading bogie of the group
MASK_OF_BOGIE = 0b0101


class Outputs(NamedTuple):
    """The outputs of 8 bits, by their sub-index of 6200h: their names, and the RPDO of each."""

    names: tuple[str, ...]
    text: str
    rpdos: tuple[Pdo, ...]


_MAGNETS = Outputs(
    ("Magnets",),
    "bit 2j hold magnet, bit 2j+1 vent magnet of axle j+1",
    (Pdo(EVENT_DRIVEN, ((0x6200, 1, 8),)),),
)
_MAGNETS_AND_TRACK_BRAKE = Outputs(
    (*_MAGNETS.names, "Magnetic track brake"),
    f"{_MAGNETS.text}; track brake: bit 2j for the bogie of axle j+1",
    (*_MAGNETS.rpdos, Pdo(EVENT_DRIVEN, ((TRACK_BRAKE_OBJECT, TRACK_BRAKE_SUB, 8),))),
)


def outputs(table: Table) -> Outputs:
    """Return the outputs of a module; the second one only where the vehicle has such a brake."""
    return _MAGNETS_AND_TRACK_BRAKE if table.kind.magnetic_track_brake else _MAGNETS


def tpdos(axles: int) -> tuple[Pdo, ...]:
    """Return the TPDOs of a module for so many axles."""
    return (
        Pdo(SYNCHRONOUS, tuple((0x6401, axle, 16) for axle in range(1, axles + 1))),
        # the brake demand, with the SYNC after a change
        Pdo(ACYCLIC, ((0x6411, 1, 16),)),
    )


def rows(table: Table, parameters: Mapping[str, float], group: int = 0) -> list[Row]:
    """Return the objects of the device profile."""
    number = signals.in_group(BRAKE_NODE, group)
    names = outputs(table).names
    return [
        *process_image.rows(process_image.carried(table, number, parameters), TITLES),
        *array(0x6000, "Read input 8-bit", "U8", "ro", [0], ("Magnets energised",), mappable=True),
        Row(0x6005, 0, "Global interrupt enable digital", "BOOL", "rw", True),
        *array(
            0x6200,
            "Write output 8-bit",
            "U8",
            "rw",
            [0] * len(names),
            names,
            mappable=True,
            text=outputs(table).text,
        ),
        *array(0x6206, "Error mode output 8-bit", "U8", "rw", [0xFF] * len(names), names),
        *array(0x6207, "Error value output 8-bit", "U8", "rw", [0] * len(names), names),
        *array(
            0x6411,
            "Write analogue output 16-bit",
            "I16",
            "rw",
            [0],
            ("Brake demand",),
            mappable=True,
            low=0,
            high=HIGHEST_DEMAND_mbar,
            unit="Pa",
            factor=DEMAND.scale,
            text=table.by_name["brake_demand"].text,
        ),
        Row(0x6423, 0, "Analogue input global interrupt enable", "BOOL", "rw", False),
        *array(0x6443, "Analogue output error mode", "U8", "rw", [0], ("Brake demand",), high=1),
        *array(
            0x6444,
            "Analogue output error value integer",
            "I32",
            "rw",
            [0],
            ("Brake demand",),
            low=0,
            high=HIGHEST_DEMAND_mbar,
        ),
    ]


def build(
    table: Table,
    row: np.ndarray,
    commands: np.ndarray,
    parameters: Mapping[str, float] | None = None,
    on_command: Callable[[], None] = lambda: None,
    storage: Path | None = None,
    group: int = 0,
    track_brake: np.ndarray | None = None,
) -> Node:
    """Build the node of a group of axles (0: the leading one).

    `table`: the signals of the vehicle. `row`: live float64 array of all signals. `commands`:
    float64 array of shape (COMMANDS,), of which the node writes the magnets of its axles and the
    demand before it calls `on_command()`. `storage`: the file of 1010h. `track_brake`: float64
    array of shape (MOST_AXLES,), of which the node writes its axles: 1 where the magnetic track
    brake is on. A vehicle without one needs no such array.
    """
    parameters = dict(parameters or {})
    lost_after_ms = int(parameters.get("unit_lost_after_ms", UNIT_LOST_AFTER_MS))
    axles = table.axles_of(group)
    profile = Profile(
        DEVICE_TYPE,
        PRODUCT.name,
        outputs(table).rpdos,
        tpdos(len(axles)),
        consumed=((table.wsp_nodes[group], lost_after_ms),),
    )
    number = signals.in_group(BRAKE_NODE, group)
    node = process_image.build(
        number,
        profile,
        PRODUCT,
        rows(table, parameters, group),
        row,
        process_image.carried(table, number, parameters),
        storage,
    )
    node.commands = frozenset({0x6200, 0x6411})
    node.event_enablers = {0x6000: key(0x6005, 0), 0x6401: key(0x6423, 0)}
    if not table.kind.magnetic_track_brake:
        track_brake = None
    node.device = BrakeIo(node, row, commands, on_command, axles, track_brake)
    return node


class BrakeIo:
    """The outputs of the node.

    `locked`: a partner is lost, so the magnets stay at the fail-safe value and commands are
    refused.
    """

    def __init__(
        self,
        node: Node,
        row: np.ndarray,
        commands: np.ndarray,
        on_command: Callable[[], None],
        axles: range,
        track_brake: np.ndarray | None = None,
    ) -> None:
        self.node = node
        self.commands = commands
        # the magnets of this node's axles, a part of the same memory
        self._magnets = commands[axles[0] - 1 : axles[-1]]
        self._first_axle = axles[0]
        self._track_brake = np.zeros(0)
        if track_brake is not None:
            self._track_brake = track_brake[axles[0] - 1 : axles[-1]]
        self.on_command = on_command
        self.locked = False
        # a vent magnet is energised without its hold magnet
        self._venting_alone = [False] * len(axles)
        objects = node.objects
        read_demand = process_image.reader(row, signals.column("brake_demand"), DEMAND)
        objects.attach(0x6000, 1, read=lambda: objects.values[key(0x6200, 1)])
        objects.attach(0x6200, 1, check=self._check_unlocked, effect=self._energise)
        if track_brake is not None:
            objects.attach(TRACK_BRAKE_OBJECT, TRACK_BRAKE_SUB, effect=self._switch_track_brake)
        objects.attach(0x6411, 1, read=read_demand, effect=self._demand)
        node.on_partner.append(self._on_partner)
        node.on_state.append(self._on_state)
        node.on_reset.append(self._forget_demand)
        node.on_power_off.append(lambda: self._switch_track_brake(0))
        # without power no magnet is energised, whatever 6207h is
        node.on_power_off += [self._forget_demand, lambda: self._energise(magnets.ALL_OFF)]
        self._magnets[:] = 0.0
        commands[BRAKE_DEMAND] = np.nan

    def fail_safe(self, why: str) -> None:
        """Give magnets and demand the values of 6206h, 6207h, 6443h and 6444h."""
        values = self.node.objects.values
        mask = values[key(0x6206, 1)]  # the bits that take the error value
        error_value = values[key(0x6207, 1)]
        byte = values[key(0x6200, 1)] & ~mask | error_value & mask
        self.node.event(Code.MAGNETS_FAIL_SAFE, magnets=byte, reason=why)
        values[key(0x6200, 1)] = byte
        self._energise(byte)
        if self._track_brake.size:
            self._fail_track_brake()
        if values[key(0x6443, 1)]:
            self._demand(values[key(0x6444, 1)])

    def _check_unlocked(self, _: int) -> None:
        if self.locked:
            raise AbortError(Abort.DEVICE_STATE)

    def _energise(self, byte: int) -> None:
        for at, pair in enumerate(magnets.unpack(byte, len(self._magnets))):
            alone = pair == magnets.VENT_MAGNET
            if alone and not self._venting_alone[at]:
                self.node.event(Code.MAGNETS_VENT_ALONE, axle=self._first_axle + at)
            self._venting_alone[at] = alone
            self._magnets[at] = magnets.VENTING if alone else pair
        self.on_command()

    def _switch_track_brake(self, byte: int) -> None:
        """Switch the magnets of bogies: bit 2j is for the bogie of axle j+1."""
        for first in range(0, self._track_brake.size, AXLES_OF_BOGIE):
            bits_of_bogie = byte >> BITS_PER_AXLE * first & MASK_OF_BOGIE
            self._track_brake[first : first + AXLES_OF_BOGIE] = bits_of_bogie != 0
        self.on_command()

    def _fail_track_brake(self) -> None:
        """Give the magnetic track brake the value of 6206h:2 and 6207h:2."""
        values = self.node.objects.values
        command = key(TRACK_BRAKE_OBJECT, TRACK_BRAKE_SUB)
        mask = values[key(0x6206, TRACK_BRAKE_SUB)]
        error_value = values[key(0x6207, TRACK_BRAKE_SUB)]
        values[command] = values[command] & ~mask | error_value & mask
        self._switch_track_brake(values[command])

    def _demand(self, raw: int) -> None:
        self.commands[BRAKE_DEMAND] = raw * DEMAND.scale
        self.on_command()

    def _forget_demand(self) -> None:
        self.commands[BRAKE_DEMAND] = np.nan

    def _on_partner(self, partner: int, alive: bool) -> None:
        self.locked = bool(self.node.consumer.lost)
        if alive:
            return
        who = f"node {partner}" if partner else "the guarding master"
        self.fail_safe(f"{who} is lost")

    def _on_state(self, old: State, new: State) -> None:
        if new is State.STOPPED:
            self.fail_safe("NMT stopped")
        elif new is State.INITIALISING and old is not new:
            self.locked = False
            self.fail_safe("reset")
        elif new is State.PRE_OPERATIONAL:
            # after a reset the outputs may have another power-on value
            self._energise(self.node.objects.values[key(0x6200, 1)])
