"""The objects of a roller drive (6000h area), with the units of one count.

One count of a speed is 0.0001 rad/s, one of a torque is a thousandth of the rated torque, as in the
table of signals for 606Ch and 6077h. Source: CiA 402-2 / IEC 61800-7-201, object descriptions.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.communication import SYNCHRONOUS, Pdo
from rollerrig.firmware_sim.cia301.dictionary import Row, array
from rollerrig.wsp_interface import signals

DEVICE_TYPE = 0x00020192
PRODUCT = process_image.Product("roller drive", 0x402)
# bits of 6502h: profile velocity, torque, cyclic synchronous velocity and torque
SUPPORTED_MODES = 0x0000030C
TITLES = {
    0x606C: "Velocity actual value",
    0x6064: "Position actual value",
    0x6077: "Torque actual value",
}
SPEED = signals.first_place("roller_speed")
TORQUE = signals.first_place("motor_torque")
DEFAULTS = {
    "rated_torque_Nm": 4000.0,
    "rated_current_A": 400.0,
    "max_torque_fraction": 3.0,
    "max_speed_rad_s": 200.0,
    "acceleration_rad_s2": 20.0,
    "quick_stop_rad_s2": 60.0,
    "dc_link_V": 750.0,
    "dc_link_min_V": 400.0,
    "torque_slope_per_s": 10.0,
}
# controlword, mode, set-points, offsets and outputs: what a master commands in each cycle
COMMANDS = frozenset({0x6040, 0x6060, 0x6071, 0x60B1, 0x60B2, 0x60FE, 0x60FF})
RPM_PER_RAD_S = 60.0 / 6.283185307179586
RPDOS = (
    Pdo(SYNCHRONOUS, ((0x6040, 0, 16), (0x6060, 0, 8), (0x6071, 0, 16))),
    Pdo(SYNCHRONOUS, ((0x60FF, 0, 32),)),
)
TPDOS = (
    Pdo(SYNCHRONOUS, ((0x6041, 0, 16), (0x6061, 0, 8), (0x6077, 0, 16))),
    Pdo(SYNCHRONOUS, ((0x606C, 0, 32), (0x6064, 0, 32))),
)


def rows(axle: int, parameters: Mapping[str, float]) -> list[Row]:
    """Return the objects of the device profile for the drive under `axle`."""
    rated_Nm = parameters["rated_torque_Nm"]
    rated_A = parameters["rated_current_A"]
    fastest_rad_s = parameters["max_speed_rad_s"]
    speed: dict[str, Any] = {"unit": "rad/s", "factor": SPEED.scale}
    ramp: dict[str, Any] = {"unit": "rad/s2", "factor": SPEED.scale, "low": 1}
    torque: dict[str, Any] = {"unit": "Nm", "factor": TORQUE.scale * rated_Nm}
    slow = round(parameters["acceleration_rad_s2"] / SPEED.scale)
    quick = round(parameters["quick_stop_rad_s2"] / SPEED.scale)
    interpolation = "Interpolation time period"
    return [
        *process_image.rows(process_image.carried_by_drive(axle, parameters), TITLES),
        Row(
            0x2000,
            0,
            "Control source",
            "U8",
            "rw",
            0,
            low=0,
            high=1,
            text="0 the bench's rig control, 1 a master on the bus",
        ),
        Row(0x6007, 0, "Abort connection option code", "I16", "rw", 1, low=0, high=3),
        Row(0x603F, 0, "Error code", "U16", "ro", 0, True),
        Row(0x6040, 0, "Controlword", "U16", "rw", 0, True),  # 6040h
        Row(0x6041, 0, "Statusword", "U16", "ro", 0, True),  # 6041h
        Row(0x605A, 0, "Quick stop option code", "I16", "rw", 2, low=0, high=7),
        Row(0x605B, 0, "Shutdown option code", "I16", "rw", 0, low=0, high=1),
        Row(0x605C, 0, "Disable operation option code", "I16", "rw", 1, low=0, high=1),
        Row(0x605D, 0, "Halt option code", "I16", "rw", 1, low=1, high=3),
        Row(0x605E, 0, "Fault reaction option code", "I16", "rw", 2, low=0, high=3),
        Row(0x6060, 0, "Modes of operation", "I8", "rw", 10, True),
        Row(0x6061, 0, "Modes of operation display", "I8", "ro", 10, True),
        Row(0x606B, 0, "Velocity demand value", "I32", "ro", 0, True, **speed),
        Row(0x606D, 0, "Velocity window", "U16", "rw", 1000, **speed),
        Row(0x606E, 0, "Velocity window time", "U16", "rw", 10, unit="ms"),
        Row(0x606F, 0, "Velocity threshold", "U16", "rw", 1000, **speed),
        Row(0x6070, 0, "Velocity threshold time", "U16", "rw", 10, unit="ms"),
        Row(0x6071, 0, "Target torque", "I16", "rw", 0, True, **torque),
        Row(
            0x6072,
            0,
            "Max torque",
            "U16",
            "rw",
            round(1000 * parameters["max_torque_fraction"]),
            True,
            **torque,
        ),
        Row(0x6074, 0, "Torque demand", "I16", "ro", 0, True, **torque),
        Row(
            0x6075,
            0,
            "Motor rated current",
            "U32",
            "rw",
            round(1000 * rated_A),
            unit="A",
            factor=1e-3,
        ),
        Row(
            0x6076,
            0,
            "Motor rated torque",
            "U32",
            "const",
            round(1000 * rated_Nm),
            unit="Nm",
            factor=1e-3,
        ),
        Row(
            0x6078, 0, "Current actual value", "I16", "ro", 0, True, unit="A", factor=1e-3 * rated_A
        ),
        Row(
            0x6079,
            0,
            "DC link circuit voltage",
            "U32",
            "ro",
            round(1000 * parameters["dc_link_V"]),
            True,
            unit="V",
            factor=1e-3,
        ),
        Row(
            0x6080,
            0,
            "Max motor speed",
            "U32",
            "rw",
            round(fastest_rad_s * RPM_PER_RAD_S),
            unit="1/min",
        ),
        Row(
            0x6081, 0, "Profile velocity", "U32", "rw", round(fastest_rad_s / SPEED.scale), **speed
        ),
        Row(0x6083, 0, "Profile acceleration", "U32", "rw", slow, True, **ramp),
        Row(0x6084, 0, "Profile deceleration", "U32", "rw", slow, True, **ramp),
        Row(0x6085, 0, "Quick stop deceleration", "U32", "rw", quick, True, **ramp),
        Row(
            0x6087,
            0,
            "Torque slope",
            "U32",
            "rw",
            round(1000 * parameters["torque_slope_per_s"]),
            True,
            low=1,
            unit="Nm/s",
            factor=TORQUE.scale * rated_Nm,
        ),
        Row(0x6088, 0, "Torque profile type", "I16", "rw", 0, low=0, high=0),
        Row(0x60B1, 0, "Velocity offset", "I32", "rw", 0, True, **speed),
        Row(0x60B2, 0, "Torque offset", "I16", "rw", 0, True, **torque),
        Row(0x60C2, 0, f"{interpolation}/Highest sub-index supported", "U8", "const", 2),
        Row(0x60C2, 1, f"{interpolation}/Interpolation time period value", "U8", "rw", 10),
        Row(
            0x60C2,
            2,
            f"{interpolation}/Interpolation time index",
            "I8",
            "rw",
            -3,
            low=-128,
            high=63,
        ),
        Row(0x60F8, 0, "Max slippage", "I32", "rw", 0, low=0, **speed),
        Row(0x60FD, 0, "Digital inputs", "U32", "ro", 0, True),
        *array(
            0x60FE,
            "Digital outputs",
            "U32",
            "rw",
            [0, 0],
            ("Physical outputs", "Bit mask"),
            mappable=True,
        ),
        Row(0x60FF, 0, "Target velocity", "I32", "rw", 0, True, **speed),
        Row(0x6502, 0, "Supported drive modes", "U32", "const", SUPPORTED_MODES),
        Row(0x67FE, 0, "Version number", "U32", "const", 0x00040000),
        Row(0x67FF, 0, "Single device type", "U32", "const", DEVICE_TYPE),
    ]
