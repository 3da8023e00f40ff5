"""Mechanisms of the brake torque C: a course is its change, or a share of it, by one unit.

Shares act one after another: C = C_0 (1 + gain) (1 - fade ...).
"""

import math

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.mechanisms.mechanism import AXLE, TORQUE, WIDE, number, row_of, saturating


@kernel
def brake_gain():
    """C = (1 + gain) C_0"""
    return 1.0


@kernel
def pad_fade(heat_MJ, scale_MJ):
    """C = C_0 (1 - fade heat (1 - exp(-H / heat))), H: brake work of the wheelset so far"""
    return -saturating(heat_MJ, scale_MJ)


@kernel
def wet_pads(braked_rad, turns):
    """C = C_0 (1 - loss exp(-phi / turns)), phi: turns of the wheel so far with the brake
    applied"""
    return -math.exp(-braked_rad / (2.0 * math.pi * turns))


@kernel
def torque_offset(brake_Nm, from_Nm):
    """C = C_0 + offset where C_0 > from"""
    return 1.0 if brake_Nm > from_Nm else 0.0


ROWS = (
    row_of(
        TORQUE,
        brake_gain,
        (number("gain", -0.3, 0.3, "-"), AXLE),
        "the brake torque differs from the stated one",
        "assumption",
        share=True,
    ),
    row_of(
        TORQUE,
        pad_fade,
        (number("fade_1_MJ", 0.0, 0.2, "1/MJ"), number("heat_MJ", 0.1, WIDE, "MJ", WIDE)),
        "torque falls with the heat of the discs",
        "assumption",
        share=True,
    ),
    row_of(
        TORQUE,
        wet_pads,
        (number("loss", 0.0, 0.9, "-"), number("turns", 0.1, 500.0, "turns", 10.0)),
        "wet brake pads give less torque until they have run dry",
        "UIC 541-3 has pads tested under water; form: assumption",
        share=True,
    ),
    row_of(
        TORQUE,
        torque_offset,
        (
            number("offset_Nm", -1500.0, 1500.0, "N m"),
            number("from_Nm", -WIDE, WIDE, "N m", -WIDE),
            AXLE,
        ),
        "the torque has an offset",
        "assumption",
    ),
)
