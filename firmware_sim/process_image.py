"""The signals of the rig as objects of a node: what stands where on the bus comes from one table.

Objects that carry a signal hold no value of their own; each read converts the live row into the integer of the bus, as
`signals.count` does. The conversion is prepared once for each object, because it runs for every signal at every SYNC.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from rollerrig.firmware_sim.cia301 import communication, dictionary
from rollerrig.firmware_sim.cia301.communication import Profile
from rollerrig.firmware_sim.cia301.dictionary import Identity, Row
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Place, Signal

# no identifier of a vendor is registered with CAN in Automation
_VENDOR, _VENDOR_ID, _REVISION = "rollerrig", 0, 0x00010000


def build(
    node_id: int,
    profile: Profile,
    product: tuple[str, int],
    own: list[Row],
    row: np.ndarray,
    parameters: Mapping[str, float],
    axle: int = 0,
    storage: Path | None = None,
) -> Node:
    """A node of the rig, whose objects read the live row (float64, one item a column of the table).

    `product`: its name and code; `own`: the rows beyond CiA 301; `axle`: that of a drive, else 0. The node
    number is the serial number.
    """
    who = Identity(_VENDOR, product[0], _VENDOR_ID, product[1], _REVISION, node_id)
    node = Node(dictionary.build(communication.rows(profile, who) + own, node_id, who), storage)
    for signal, place, its_axle, sub, parameter in carried(
        0 if axle else node_id, axle, parameters
    ):
        if signal.direction == signals.OUT and key(place.index, sub) in node.objects.variables:
            column = signals.column(signal.name, its_axle)
            node.objects.own(place.index, sub, read=reader(row, column, place, parameter))
    return node


def carried(
    node_number: int, axle: int, parameters: Mapping[str, float]
) -> Iterator[tuple[Signal, Place, int, int, float]]:
    """What a node carries: signal, place, axle, sub-index, and the parameter that multiplies the place's scale.

    `node_number` 0 with an axle is the drive under that axle. KeyError if a scale needs a parameter that is not given.
    """
    for signal in signals.SIGNALS:
        for place in signal.places:
            if place.node == node_number:
                parameter = parameters[place.of] if place.of else 1.0
                for at in range(signal.axles if node_number else 1):
                    yield signal, place, at + 1 if node_number else axle, place.sub + at, parameter


def rows(
    node_number: int, axle: int, parameters: Mapping[str, float], titles: Mapping[int, str]
) -> list[Row]:
    """Rows of the objects that carry measured signals; `titles` names the objects."""
    found: dict[tuple[int, int], Row] = {}
    for signal, place, at, sub, parameter in carried(node_number, axle, parameters):
        if signal.direction != signals.OUT or place.index not in titles:
            continue
        name = title = titles[place.index]
        if sub:
            name = f"{title}/{title} axle {at}"
            found[place.index, 0] = Row(
                place.index,
                0,
                f"{title}/Highest sub-index supported",
                "U8",
                "const",
                place.sub + signal.axles - 1,
            )
        found[place.index, sub] = Row(
            index=place.index,
            sub=sub,
            name=name,
            kind=place.kind,
            access="ro",
            default=0,
            mappable=True,
            unit=signal.unit.replace("_", "/"),
            factor=place.scale * parameter,
            text=signal.text,
        )
    return list(found.values())


def reader(row: np.ndarray, column: int, place: Place, parameter: float = 1.0) -> Callable[[], int]:
    """A call that gives `signals.count(row[column], place, parameter)`, prepared for speed."""
    item, unit = row.item, place.scale * parameter
    low, high = signals.KINDS[place.kind]

    def read() -> int:
        value = item(column)
        # a value that is not finite differs from itself here
        if value - value != 0.0:
            return low
        raw = round(value / unit)
        if low <= raw <= high:
            return raw
        return (raw - low) % (high - low + 1) + low if place.wraps else low if raw < low else high

    return read
