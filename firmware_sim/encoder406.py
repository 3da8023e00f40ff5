"""The axle speed unit, node 16: four pole wheels read by a CiA 406 encoder for several sensors.

TPDO1 carries the speeds as 16-bit values. Other objects have finer speeds, the tooth frequency and
pulse counters. A position is the pulse counter of its axle plus an offset that the preset sets. In
a car of a train, TPDO4 carries the deceleration of the train. Source: CiA 406 (objects 6000h to
65xxh, multi-sensor objects). 2100h to 2103h are specific to this rig.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.communication import SYNCHRONOUS, Pdo, Profile
from rollerrig.firmware_sim.cia301.dictionary import Row, array
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import key
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.rig_objects import TRAIN_DECELERATION
from rollerrig.wsp_interface.signals import SPEED_NODE, Place, Table

DEVICE_TYPE = 0x000A0196  # encoder, multi-sensor
PRODUCT = process_image.Product("axle speed unit", 0x406)
# names of the objects that carry signals, by index
TITLES = {
    0x6030: "Speed value",
    0x2100: "Tooth frequency",
    0x2101: "Pulse counter",
    0x2102: "Speed value fine",
}
# The acceleration is no signal, but it is converted like one: a count is 0.01 rad/s2.
ACCELERATION = Place(SPEED_NODE, 0x6040, 1, "I16", 0.01)
DEFAULTS = {"teeth": 80.0}
# the TPDO of the deceleration of a train, counted from 1, and its object
_TRAIN_TPDO = 4
_TRAIN_ROW = Row(
    TRAIN_DECELERATION.index,
    TRAIN_DECELERATION.sub,
    "Deceleration of the train",
    TRAIN_DECELERATION.kind,
    "ro",
    0,
    mappable=True,
    unit="m/s2",
    factor=TRAIN_DECELERATION.scale,
    text="of its centre of mass, positive in braking",
)


def tpdos(axles: int, in_train: bool = False) -> tuple[Pdo, ...]:
    """Return the TPDOs of a unit for so many axles."""
    speeds = Pdo(SYNCHRONOUS, tuple((0x6030, axle, 16) for axle in range(1, axles + 1)))
    # the tooth frequencies of two axles in each
    frequencies = [
        Pdo(SYNCHRONOUS, ((0x2100, axle, 32), (0x2100, axle + 1, 32)))
        for axle in range(1, axles + 1, 2)
    ]
    if not in_train:
        return (speeds, *frequencies)
    unused = [Pdo(SYNCHRONOUS, ())] * (_TRAIN_TPDO - len(frequencies) - 2)
    place = TRAIN_DECELERATION
    train = Pdo(SYNCHRONOUS, ((place.index, place.sub, signals.bits(place)),))
    return (speeds, *frequencies, *unused, train)


def rows(
    table: Table, parameters: Mapping[str, float], group: int = 0, in_train: bool = False
) -> list[Row]:
    """Return the objects of the device profile. `parameters`: `teeth` of each pole wheel."""
    node_number = signals.in_group(SPEED_NODE, group)
    teeth = round(parameters["teeth"])
    # as many revolutions as the 32-bit pulse counter can distinguish, within the 16 bits of 6502h
    revolutions = min(0xFFFF, 0xFFFFFFFF // max(teeth, 1))
    axles = table.axles_of(group)
    zeros = [0] * len(axles)
    by_axle = [f"Axle {axle}" for axle in axles]
    return [
        *process_image.rows(process_image.carried(table, node_number, parameters), TITLES),
        *([_TRAIN_ROW] if in_train else []),
        Row(0x6000, 0, "Operating parameters", "U16", "rw", 0),
        Row(0x6001, 0, "Measuring units per revolution", "U32", "const", teeth),
        Row(0x6002, 0, "Total measuring range in measuring units", "U32", "const", 0xFFFFFFFF),
        Row(0x6003, 0, "Preset value", "U32", "rw", 0),
        Row(
            0x6004,
            0,
            "Position value",
            "U32",
            "ro",
            0,
            mappable=True,
            text=f"teeth, axle {axles[0]}",
        ),
        *array(0x6010, "Preset values for multi-sensor devices", "U32", "rw", zeros, by_axle),
        *array(
            0x6020,
            "Position value for multi-sensor devices",
            "U32",
            "ro",
            zeros,
            by_axle,
            mappable=True,
            text="teeth",
        ),
        *array(
            0x6040,
            "Acceleration value",
            "I16",
            "ro",
            zeros,
            by_axle,
            mappable=True,
            unit="rad/s2",
            factor=ACCELERATION.scale,
        ),
        Row(0x6200, 0, "Cyclic timer", "U16", "rw", 0, unit="ms"),
        Row(0x6500, 0, "Operating status", "U16", "ro", 0, mappable=True),
        Row(0x6501, 0, "Single-turn resolution", "U32", "const", teeth),
        Row(
            0x6502,
            0,
            "Number of distinguishable revolutions",
            "U16",
            "const",
            revolutions,
        ),
        Row(0x6503, 0, "Alarms", "U16", "ro", 0, mappable=True),
        Row(0x6504, 0, "Supported alarms", "U16", "const", 0x1000),
        Row(0x6505, 0, "Warnings", "U16", "ro", 0, mappable=True),
        Row(0x6506, 0, "Supported warnings", "U16", "const", 0),
        Row(0x6507, 0, "Profile and software version", "U32", "const", 0x00010302),
        Row(0x6508, 0, "Operating time", "U32", "ro", 0, unit="h", factor=0.1),
        *array(0x6509, "Offset value", "I32", "ro", zeros, by_axle),
        Row(0x650B, 0, "Serial number", "U32", "const", node_number),
    ]


def build(
    table: Table,
    row: np.ndarray,
    parameters: Mapping[str, float] | None = None,
    storage: Path | None = None,
    group: int = 0,
    train_deceleration_m_s2: np.ndarray | None = None,
) -> Node:
    """Build the node of a group of axles (0: the leading one).

    `table`: the signals of the vehicle. `row`: live float64 array of all signals. `storage`: the
    file of stored parameters (1010h). `train_deceleration_m_s2`: live float64 (1,) in the car of a
    train, None in a vehicle alone, which has no such object.
    """
    in_train = train_deceleration_m_s2 is not None
    parameters = DEFAULTS | dict(parameters or {})
    axles = table.axles_of(group)
    profile = Profile(DEVICE_TYPE, PRODUCT.name, tpdos=tpdos(len(axles), in_train))
    number = signals.in_group(SPEED_NODE, group)
    node = process_image.build(
        number,
        profile,
        PRODUCT,
        rows(table, parameters, group, in_train),
        row,
        process_image.carried(table, number, parameters),
        storage,
    )
    node.device = SpeedUnit(node, row, axles)
    if train_deceleration_m_s2 is not None:
        place = TRAIN_DECELERATION
        read = process_image.reader(train_deceleration_m_s2, 0, place)
        node.objects.attach(place.index, place.sub, read=read)
    return node


class SpeedUnit:
    """The objects that carry no signal: positions, presets, accelerations and times.

    Their values are computed here from the signals.
    """

    def __init__(self, node: Node, row: np.ndarray, axles: range) -> None:
        self.node = node
        self._row = row
        self._time = signals.column("time")
        first = signals.column("measured_speed", axles[0])
        self._speeds = slice(first, first + len(axles))
        # samples of the last two SYNCs
        self._newest = self._sample()
        self._before = self._newest
        node.on_sync.append(self._take_sample)
        objects = node.objects
        # sub-indices count from the first axle of the group
        for axle in range(1, len(axles) + 1):
            objects.attach(0x6020, axle, read=partial(self.position, axle))
            objects.attach(0x6040, axle, read=partial(self.acceleration, axle))
            objects.attach(0x6010, axle, effect=partial(self._preset, axle))
        objects.attach(0x6004, read=partial(self.position, 1))
        objects.attach(0x6003, effect=partial(self._preset, 1))
        objects.attach(0x6508, read=self._operating_time)
        # the cyclic timer is another name of the event timer of TPDO1
        objects.attach(
            0x6200,
            read=lambda: objects.values[key(0x1800, 5)],
            effect=lambda value: objects.assign(key(0x1800, 5), value),
        )

    def position(self, axle: int) -> int:
        """Return the teeth counted on an axle of the group (from 1) plus the offset, in 32 bits."""
        objects = self.node.objects
        return (objects.get(0x2101, axle) + objects.values[key(0x6509, axle)]) & 0xFFFFFFFF

    def acceleration(self, axle: int) -> int:
        """Return the change of an axle's speed between the last two SYNCs, in 0.01 rad/s2."""
        before_s, speeds_before = self._before
        newest_s, newest_speeds = self._newest
        if newest_s <= before_s:
            return 0
        change_rad_s = newest_speeds[axle - 1] - speeds_before[axle - 1]
        return signals.count(change_rad_s / (newest_s - before_s), ACCELERATION)

    def _operating_time(self) -> int:
        """Return the simulated time in 0.1 h, which is 360 s."""
        return int(self._row.item(self._time) / 360.0) & 0xFFFFFFFF

    def _sample(self) -> tuple[float, list[float]]:
        """Return the time in s and the speeds of the axles in rad/s."""
        return self._row.item(self._time), self._row[self._speeds].tolist()

    def _take_sample(self) -> None:
        self._before = self._newest
        self._newest = self._sample()

    def _preset(self, axle: int, position: int) -> None:
        """Set the offset so that the position of an axle becomes `position`."""
        offset = (position - self.node.objects.get(0x2101, axle)) & 0xFFFFFFFF
        if offset >= 1 << 31:  # the object is a signed number
            offset -= 1 << 32
        self.node.objects.values[key(0x6509, axle)] = offset
