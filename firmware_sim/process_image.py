"""The signals of the rig as objects of a node.

The table of signals decides their places on the bus.
An object that carries a signal holds no value. Each read converts the live row into the integer of
the bus, as `signals.count` does. The conversion is prepared once for each object, because it runs
for every signal at every SYNC.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim.cia301 import communication, dictionary
from rollerrig.firmware_sim.cia301.communication import Profile
from rollerrig.firmware_sim.cia301.dictionary import Identity, Row
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Place, Signal, Table

_VENDOR = "rollerrig"
_VENDOR_ID = 0  # none is registered with CAN in Automation
_REVISION = 0x00010000


class Product(NamedTuple):
    """Name and product code of a device."""

    name: str
    code: int


class Carried(NamedTuple):
    """A signal of one axle that a node carries. `parameter` multiplies the scale of the place."""

    signal: Signal
    place: Place
    axle: int
    sub: int
    parameter: float


def build(
    node_id: int,
    profile: Profile,
    product: Product,
    device_rows: list[Row],
    row: np.ndarray,
    signals_carried: Iterable[Carried],
    storage: Path | None = None,
) -> Node:
    """Return a node of the rig, whose objects read the live row.

    `row`: float64, the row of all signals. `device_rows`: the rows beyond CiA 301. The node number
    is also the serial number.
    """
    identity = Identity(
        vendor=_VENDOR,
        product=product.name,
        vendor_id=_VENDOR_ID,
        product_code=product.code,
        revision=_REVISION,
        serial=node_id,
    )
    all_rows = communication.rows(profile, identity) + device_rows
    node = Node(dictionary.build(all_rows, node_id, identity), storage)

    for signal, place, signal_axle, sub, parameter in signals_carried:
        in_dictionary = key(place.index, sub) in node.objects.variables
        if signal.direction == signals.OUT and in_dictionary:
            column = signals.column(signal.name, signal_axle)
            node.objects.attach(place.index, sub, read=reader(row, column, place, parameter))
    return node


def carried(table: Table, node_number: int, parameters: Mapping[str, float]) -> Iterator[Carried]:
    """Yield the signals that a node carries, axle by axle: of its group, or the bench of all.

    Raises KeyError if a scale needs a parameter that is not in `parameters`.
    """
    leading = signals.in_leading_group(node_number)
    for signal in table.signals:
        for place in signal.places:
            if place.node != leading:
                continue
            parameter = parameters[place.of] if place.of else 1.0
            for at, axle in enumerate(table.axles_at(signal, node_number)):
                yield Carried(signal, place, axle, place.sub + at, parameter)


def carried_by_drive(axle: int, parameters: Mapping[str, float]) -> Iterator[Carried]:
    """Yield the signals that the drive under an axle carries, as `carried` does."""
    for signal in signals.ALL_SIGNALS:
        for place in signal.places:
            if place.node == signals.DRIVE_UNDER_AXLE:
                parameter = parameters[place.of] if place.of else 1.0
                yield Carried(signal, place, axle, place.sub, parameter)


def rows(signals_carried: Iterable[Carried], titles: Mapping[int, str]) -> list[Row]:
    """Return the rows of the objects that carry measured signals.

    `titles`: the names of the objects by index.
    """
    rows_by_place: dict[tuple[int, int], Row] = {}
    for signal, place, axle, sub, parameter in signals_carried:
        if signal.direction != signals.OUT or place.index not in titles:
            continue
        title = titles[place.index]
        name = title
        if sub:
            name = f"{title}/{title} axle {axle}"
            rows_by_place[place.index, 0] = Row(
                index=place.index,
                sub=0,
                name=f"{title}/Highest sub-index supported",
                kind="U8",
                access="const",
                default=sub,  # the last one stays
            )
        rows_by_place[place.index, sub] = Row(
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
    return list(rows_by_place.values())


def reader(row: np.ndarray, column: int, place: Place, parameter: float = 1.0) -> Callable[[], int]:
    """Return a fast function for `signals.count(row[column], place, parameter)`."""
    item = row.item
    unit = place.scale * parameter
    low, high = signals.KINDS[place.kind]

    def read() -> int:
        value = item(column)
        if not isfinite(value):
            return low
        raw = round(value / unit)
        if low <= raw <= high:
            return raw
        if place.wraps:
            return (raw - low) % (high - low + 1) + low
        return low if raw < low else high

    return read
