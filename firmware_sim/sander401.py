"""The sander I/O, node 18: a CiA 401 module.

It switches sanders, and measures the flow of sand and the sand that remains.
The WSP unit, a driver's desk or a harness switches the sanders with 6200h, by RPDO1 (212h) or SDO.
The sanders stop when the partner is lost, and when the node is stopped or reset.
Source: CiA 401 (6200h outputs, 6401h analogue inputs).
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.communication import EVENT_DRIVEN, SYNCHRONOUS, Pdo, Profile
from rollerrig.firmware_sim.cia301.dictionary import Row, array
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import UNIT_LOST_AFTER_MS
from rollerrig.wsp_interface.signals import SANDER_NODE, Table

DEVICE_TYPE = 0x00060191
PRODUCT = process_image.Product("sander I/O", 0x402)
TITLES = {0x6401: "Read analogue input 16-bit"}
RPDOS = (Pdo(EVENT_DRIVEN, ((0x6200, 1, 8),)),)


# 6401h: the flow of sand of each axle, then the remaining sand of each axle
def tpdos(axles: int, unit_axles: int) -> tuple[Pdo, ...]:
    """Return the TPDOs of a module for so many axles; a group has `unit_axles` at most."""
    flows = tuple((0x6401, axle, 16) for axle in range(1, axles + 1))
    boxes = tuple((0x6401, unit_axles + axle, 16) for axle in range(1, axles + 1))
    return Pdo(SYNCHRONOUS, flows), Pdo(SYNCHRONOUS, boxes)


def build(
    table: Table,
    row: np.ndarray,
    commands: np.ndarray,
    on_command: Callable[[], None] = lambda: None,
    storage: Path | None = None,
    parameters: Mapping[str, float] | None = None,
    group: int = 0,
) -> Node:
    """Build the node of a group of axles (0: the leading one).

    `table`: the signals of the vehicle. `row`: live float64 array of all signals. `commands`: array
    of shape (axles,) or more, of which the node writes its axles before it calls `on_command()`: 1
    where the sander of an axle is on. `storage`: the file of 1010h.
    """
    number = signals.in_group(SANDER_NODE, group)
    axles = table.axles_of(group)
    parameters = dict(parameters or {})
    lost_after_ms = int(parameters.get("unit_lost_after_ms", UNIT_LOST_AFTER_MS))
    profile = Profile(
        DEVICE_TYPE,
        PRODUCT.name,
        RPDOS,
        tpdos(len(axles), table.kind.unit_axles),
        consumed=((table.wsp_nodes[group], lost_after_ms),),
    )
    device_rows = [
        *process_image.rows(process_image.carried(table, number, {}), TITLES),
        *array(
            0x6200,
            "Write output 8-bit",
            "U8",
            "rw",
            [0],
            ("Sanders",),
            mappable=True,
            text="bit 2j: sander of axle j+1",
        ),
        Row(0x6423, 0, "Analogue input global interrupt enable", "BOOL", "rw", False),
    ]
    carried = process_image.carried(table, number, {})
    node = process_image.build(number, profile, PRODUCT, device_rows, row, carried, storage)
    node.commands = frozenset({0x6200})
    node.event_enablers = {0x6401: key(0x6423, 0)}

    def switch(bits: int) -> None:
        """Switch the sanders: bit 2j is the sander of axle j+1."""
        for at, axle in enumerate(axles):
            commands[axle - 1] = bits >> 2 * at & 1
        on_command()

    def stop(why: str) -> None:
        """Stop all sanders, with an event if one was on."""
        if node.objects.values[key(0x6200, 1)]:
            node.event(Code.SANDERS_STOPPED, reason=why)
        node.objects.values[key(0x6200, 1)] = 0
        switch(0)

    def on_partner(partner: int, alive: bool) -> None:
        if not alive:
            stop(f"node {partner} is lost")

    def on_state(old: State, new: State) -> None:
        if new in (State.STOPPED, State.INITIALISING):
            stop("NMT")

    node.objects.attach(0x6200, 1, effect=switch)
    node.on_partner.append(on_partner)
    node.on_state.append(on_state)
    node.on_power_off.append(lambda: switch(0))
    return node
