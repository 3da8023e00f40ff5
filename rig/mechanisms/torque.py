"""Mechanisms of the brake torque C: their courses are its change, or a share of it, for one unit.

Those that are shares act one after another: C = C_0 (1 + gain) (1 - fade ...).
"""

from rollerrig.rig.kernel import kernel
from rollerrig.rig.mechanisms.mechanism import AXLE, TORQUE, WIDE, Mechanism, parameter, saturating


@kernel
def brake_gain():
    """1."""
    return 1.0


@kernel
def pad_fade(heat_MJ, scale_MJ):
    """-heat (1 - exp(-H / heat)), a share."""
    return -saturating(heat_MJ, scale_MJ)


@kernel
def torque_offset(brake_Nm, from_Nm):
    """1 where C_0 lies above `from`."""
    return 1.0 if brake_Nm > from_Nm else 0.0


ROWS = (
    Mechanism(
        "brake_gain", TORQUE, (parameter("gain", -0.3, 0.3, "-"), AXLE),
        "C = (1 + gain) C_0", "the brake gives another torque than told",
        "EN 15595: tolerance of the brake, assumption", (brake_gain,), share=True),
    Mechanism(
        "pad_fade", TORQUE,
        (parameter("fade_1_MJ", 0.0, 0.2, "1/MJ"), parameter("heat_MJ", 0.1, WIDE, "MJ", WIDE)),
        "C = C_0 (1 - fade heat (1 - exp(-H / heat))), H: brake work of the wheelset so far",
        "torque falls with the heat of the discs", "assumption", (pad_fade,), share=True),
    Mechanism(
        "torque_offset", TORQUE,
        (parameter("offset_Nm", -1500.0, 1500.0, "N m"), parameter("from_Nm", -WIDE, WIDE, "N m", -WIDE), AXLE),
        "C = C_0 + offset where C_0 > from", "the torque has an offset", "assumption",
        (torque_offset,)),
)
