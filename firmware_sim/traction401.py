"""The traction and dynamic brake I/O, node 19: a CiA 401 module, where the vehicle has motors.

It passes the torques of the motors and takes the share of its force that slide control permits to
the motor of each axle (6411h, by RPDO1 213h or SDO). The last value of the leading group's 6411h
demands traction (RPDO2 313h); -1 leaves it to the programme of the scenario.
Until a partner writes a share, all force is permitted. When the partner is lost, or the node is
stopped or reset, the motors give no force: the friction brake alone brakes, because nobody would
release a motor that slides.
Source: CiA 401 (6401h analogue inputs, 6411h analogue outputs).
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.communication import EVENT_DRIVEN, SYNCHRONOUS, Pdo, Profile
from rollerrig.firmware_sim.cia301.dictionary import Row, array
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.wsp_interface import rig_objects, signals
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.signals import TRACTION_NODE, Table

DEVICE_TYPE = 0x000C0191
PRODUCT = process_image.Product("traction and dynamic brake I/O", 0x403)
TITLES = {0x6401: "Read analogue input 16-bit"}
NO_TRACTION_DEMAND = -1


def rpdos(axles: int, group: int) -> tuple[Pdo, ...]:
    """Return the RPDOs of a module: shares, and in the leading group the demand of traction."""
    shares = Pdo(EVENT_DRIVEN, tuple((0x6411, axle, 16) for axle in range(1, axles + 1)))
    if group > 0:
        return (shares,)
    return shares, Pdo(EVENT_DRIVEN, ((0x6411, axles + 1, 16),))


def tpdos(axles: int, unit_axles: int) -> tuple[Pdo, ...]:
    """Return the TPDOs of a module: the torques of its axles, then the permitted shares.

    A group has `unit_axles` at most.
    """
    torques = tuple((0x6401, axle, 16) for axle in range(1, axles + 1))
    shares = tuple((0x6401, unit_axles + axle, 16) for axle in range(1, axles + 1))
    return Pdo(SYNCHRONOUS, torques), Pdo(SYNCHRONOUS, shares)


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
    that begins with the permitted shares of the axles and ends with the demand of traction; the
    node writes its own before it calls `on_command()`. `storage`: the file of 1010h.
    """
    number = signals.in_group(TRACTION_NODE, group)
    axles = table.axles_of(group)
    parameters = dict(parameters or {})
    lost_after_ms = int(parameters.get("unit_lost_after_ms", rig_objects.UNIT_LOST_AFTER_MS))
    profile = Profile(
        DEVICE_TYPE,
        PRODUCT.name,
        rpdos(len(axles), group),
        tpdos(len(axles), table.kind.unit_axles),
        consumed=((table.wsp_nodes[group], lost_after_ms),),
    )
    whole = rig_objects.WHOLE_SHARE
    defaults = [whole] * len(axles)
    names = [f"Permitted share axle {axle}" for axle in axles]
    if group == 0:
        defaults.append(NO_TRACTION_DEMAND)
        names.append("Traction demand")
    device_rows = [
        *process_image.rows(process_image.carried(table, number, {}), TITLES),
        *array(
            0x6411,
            "Write analogue output 16-bit",
            "I16",
            "rw",
            defaults,
            names,
            mappable=True,
            low=NO_TRACTION_DEMAND,
            high=whole,
            factor=1.0 / whole,
            text="share of the force; of the traction demand: -1 for none",
        ),
        Row(0x6423, 0, "Analogue input global interrupt enable", "BOOL", "rw", False),
    ]
    carried = process_image.carried(table, number, {})
    node = process_image.build(number, profile, PRODUCT, device_rows, row, carried, storage)
    node.commands = frozenset({0x6411})
    node.event_enablers = {0x6401: key(0x6423, 0)}

    def permit(axle: int, count: int) -> None:
        commands[axle - 1] = max(count, 0) / whole
        on_command()

    def demand_traction(count: int) -> None:
        commands[-1] = count / whole if count >= 0 else NO_TRACTION_DEMAND
        on_command()

    def release(why: str) -> None:
        """Permit no force, with an event if some was permitted, and demand no traction."""
        values = node.objects.values
        if any(values[key(0x6411, at)] for at in range(1, len(axles) + 1)):
            node.event(Code.DYNAMIC_BRAKE_RELEASED, reason=why)
        for at, axle in enumerate(axles, start=1):
            values[key(0x6411, at)] = 0
            permit(axle, 0)
        if group == 0:
            values[key(0x6411, len(axles) + 1)] = NO_TRACTION_DEMAND
            demand_traction(NO_TRACTION_DEMAND)

    def on_partner(partner: int, alive: bool) -> None:
        if not alive:
            release(f"node {partner} is lost")

    def on_state(old: State, new: State) -> None:
        if old is State.OPERATIONAL and new in (State.STOPPED, State.INITIALISING):
            release("NMT")

    for at, axle in enumerate(axles, start=1):
        node.objects.attach(0x6411, at, effect=partial(permit, axle))
    if group == 0:
        node.objects.attach(0x6411, len(axles) + 1, effect=demand_traction)
    node.on_partner.append(on_partner)
    node.on_state.append(on_state)
    node.on_power_off.append(lambda: release("no power"))
    return node
