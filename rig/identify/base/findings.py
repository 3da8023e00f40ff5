"""Defines the mistakes in data that make every conclusion worthless, each with a code.

A finding holds a code and fields. Its sentence is made in `sentences`.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

from rollerrig.rig.identify.base.shared import Shared


class Code(StrEnum):
    """What is wrong with the data."""

    # all rolling wheels turn at another speed than the vehicle runs, by the same factor
    RADIUS = "base.radius"
    # one wheelset rolls so much faster or slower than the others that no wear explains it
    WHEEL_SPEED_SCALE = "base.wheel_speed_scale"
    # the loads do not carry the weight, and the torques say that the mass is wrong
    MASS = "base.mass"
    # the loads do not carry the weight, and the torques say that the mass is right
    LOADS = "base.loads"
    # the torques take a share of the momentum that another unit would give
    TORQUE_UNIT = "base.torque_unit"
    # the torques take far more or less momentum than the vehicle loses
    TORQUE_SHARE = "base.torque_share"
    # the torques take another share of the momentum in each run
    TORQUE_NOT_ACTING = "base.torque_not_acting"
    # a wheel speed answers to the torque of another wheelset
    CHANNELS_EXCHANGED = "base.channels_exchanged"
    # two columns hold the same samples
    CHANNELS_EQUAL = "base.channels_equal"
    # braking moves load to the rear
    AXLES_REVERSED = "base.axles_reversed"
    # a channel has fewer independent samples than rows
    INTERPOLATED = "base.interpolated"
    # a channel has less noise than it is declared to have, at high frequencies
    SMOOTHED = "base.smoothed"
    # the steps of a rounded channel are larger than its noise
    RESOLUTION = "base.resolution"
    # the position advances at another rate than the speed says
    CLOCK = "base.clock"
    # the vehicle's speed is made of wheel speeds
    REFERENCE = "base.reference"
    # a braked wheel runs ahead of the vehicle
    REFERENCE_SLOW = "base.reference_slow"


class Finding(NamedTuple):
    """A mistake that the data show."""

    code: Code
    measured: float  # in the unit that the sentence of the code names
    allowed: float  # the largest deviation that is accepted, in the same unit
    runs: tuple[str, ...] = ()  # that show it; empty: all
    channels: tuple[str, ...] = ()  # names of columns
    axles: tuple[int, ...] = ()  # numbers of wheelsets, from 1
    detail: str = ""  # a name that the code needs, such as that of a unit
    # what its runs share, and no other run has
    shared: Mapping[Shared, str] = {}
