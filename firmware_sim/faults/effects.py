"""The effects of faults in the tick: on magnets, cylinders, motors, sanders and sensors.

The active faults are a flat array of numbers that travels with the commands. All zeros is a rig
without faults; then no bit changes. Each effect acts between the stage that computes a quantity and
the stage that uses it: magnets before the valves [F1], leaks before the pneumatics [F2], ripple
between drive control and motor [F3], sensors between wheel or winding and the published row [F4].

    [F1] magnets = (commanded or stuck) and not dead
    [F2] dp/dt = -p / T
    [F3] u = u_demand + a sin(n phi), phi the angle of the roller
    [F4] T = max(T, T_air + load dT_rated), the temperature at which a motor has this thermal load
    [F5] sand: rate (1 + flaw), lag + late, or no sand in the box

The air that a leak lets out does not count as used; the air that fills the cylinders again does.
"""

import numpy as np

from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.rig.compiled.kernel import kernel

ANY = 0  # slot of the array that is 1 while one of these faults acts

# kinds of values; the array has one value of each kind for each of the most axles
STUCK = 0  # 1: the measured speed stays
DROPOUT = 1  # 1: no pulses
MISSING_TEETH = 2  # number of teeth
SOURCE = 3  # the axle (from 1) whose sensor is connected; 0: its own
NOISE_rad_s = 4  # standard deviation
LARGER = 5  # real over nominal wheel diameter, less 1
MAGNETS_ON = 6  # magnets that stay energised, as bits
MAGNETS_OFF = 7  # magnets that are never energised, as bits
LEAK_per_s = 8  # 1 / T
RIPPLE_Nm = 9  # amplitude
RIPPLE_ORDER = 10  # periods a turn
MOTOR_LOAD = 11  # thermal load
SAND_FLAW = 12  # change of the rate as a fraction
SAND_LATE_s = 13  # additional lag of the hose
SAND_EMPTY = 14  # 1: the box is empty
MOTOR_LOST = 15  # 1: the traction motor gives no torque
TRACK_BRAKE_DEAD = 16  # 1: the magnets of the bogie of the axle do not drop
STEP = 17  # measured speed over true speed, less 1
DRIFT_per_s = 18  # growth of this error
_KINDS = 19
SIZE = 1 + _KINDS * MOST_AXLES


def slot(kind: int, axle: int) -> int:
    """The place in the array of the value of a kind for an axle (from 1)."""
    return 1 + kind * MOST_AXLES + axle - 1


@kernel
def value(faults, kind, j):
    """The value of a kind for axle j (from 0)."""
    return faults[1 + kind * MOST_AXLES + j]


@kernel
def energise(magnets, faults):
    """Apply stuck and dead magnets to the pattern of each axle, shape (axles,) or more [F1]."""
    for j in range(magnets.size):
        on = int(value(faults, MAGNETS_ON, j))
        off = int(value(faults, MAGNETS_OFF, j))
        magnets[j] = float((int(magnets[j]) | on) & ~off)


@kernel
def leak(state, faults, tick_s):
    """Let air out of leaking cylinders for a tick [F2]."""
    for j in range(state.axles):
        rate = value(faults, LEAK_per_s, j)
        if rate != 0.0:
            state.cylinder_pressure[j] *= np.exp(-rate * tick_s)


@kernel
def spill(state, faults):
    """Empty the boxes of sanders [F5]."""
    for j in range(state.axles):
        if value(faults, SAND_EMPTY, j) != 0.0:
            state.sand_box[j] = 0.0


@kernel
def ripple(state, faults):
    """Add a ripple to torque demands, by the angle of their rollers [F3]."""
    for j in range(state.axles):
        amplitude_Nm = value(faults, RIPPLE_Nm, j)
        if amplitude_Nm != 0.0:
            angle = value(faults, RIPPLE_ORDER, j) * state.roller_angle[j]
            state.motor_torque_demand[j] += amplitude_Nm * np.sin(angle)


@kernel
def heat(temperatures_K, faults, air_K, rise_K):
    """Raise the measured temperatures of hot motors, shape (axles,) [F4]."""
    for j in range(temperatures_K.size):
        load = value(faults, MOTOR_LOAD, j)
        if load != 0.0:
            temperatures_K[j] = max(temperatures_K[j], air_K + load * rise_K)
