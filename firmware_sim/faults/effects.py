"""What faults do in the tick: magnets, cylinders, motors, and what speed sensors tell.

The faults that act are a flat array of numbers which travels with the commands; all zero is a rig without faults, and
then not one bit is touched. Each effect stands between the stage that makes a quantity and the one that uses it:
magnets before the valves [F1], leaks before the pneumatics [F2], ripple between drive control and motor [F3], and
sensors between wheel or winding and the published row [F4].

    [F1] magnets = (asked or stuck) and not dead
    [F2] dp/dt = -p / T
    [F3] u = u_demand + a sin(n phi), phi the angle of the roller
    [F5] sand: rate (1 + flaw), lag + late, or no sand in the box
    [F4] T = max(T, T_air + load dT_rated), the temperature at which a motor has this thermal load

What a leak lets out counts as no air used; the cylinders that fill again do.
"""

import numpy as np

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.wsp_interface.signals import AXLES

# slots of the faults array: ANY is 1 while one of these faults acts; then a value for each axle
ANY = 0
(
    STUCK,
    DROPOUT,
    MISSING_TEETH,
    SOURCE,
    NOISE_rad_s,
    LARGER,
    MAGNETS_ON,
    MAGNETS_OFF,
    LEAK_per_s,
    RIPPLE_Nm,
    RIPPLE_ORDER,
    MOTOR_LOAD,
    SAND_FLAW,
    SAND_LATE_s,
    SAND_EMPTY,
    _KINDS,
) = range(16)
SIZE = 1 + _KINDS * AXLES


def slot(kind: int, axle: int) -> int:
    """Where the value of a kind for an axle (from 1) stands in the array."""
    return 1 + kind * AXLES + axle - 1


@kernel
def value(faults, kind, j):
    """The value of a kind for axle j (from 0)."""
    return faults[1 + kind * AXLES + j]


@kernel
def energise(magnets, faults):
    """Let stuck and dead magnets change the pattern of each axle, shape (4,) [F1]."""
    for j in range(AXLES):
        on, off = int(value(faults, MAGNETS_ON, j)), int(value(faults, MAGNETS_OFF, j))
        magnets[j] = float((int(magnets[j]) | on) & ~off)


@kernel
def leak(state, faults, tick_s):
    """Let air out of leaking cylinders for a tick [F2]."""
    for j in range(AXLES):
        rate = value(faults, LEAK_per_s, j)
        if rate != 0.0:
            state.cylinder_pressure[j] *= np.exp(-rate * tick_s)


@kernel
def spill(state, faults):
    """Let the boxes of sanders be empty [F5]."""
    for j in range(AXLES):
        if value(faults, SAND_EMPTY, j) != 0.0:
            state.sand_box[j] = 0.0


@kernel
def ripple(state, faults):
    """Let torque demands ripple with the angle of their rollers [F3]."""
    for j in range(AXLES):
        amplitude_Nm = value(faults, RIPPLE_Nm, j)
        if amplitude_Nm != 0.0:
            angle = value(faults, RIPPLE_ORDER, j) * state.roller_angle[j]
            state.motor_torque_demand[j] += amplitude_Nm * np.sin(angle)


@kernel
def heat(temperatures_K, faults, air_K, rise_K):
    """Let hot motors tell their temperature, shape (4,) [F4]."""
    for j in range(AXLES):
        load = value(faults, MOTOR_LOAD, j)
        if load != 0.0:
            temperatures_K[j] = max(temperatures_K[j], air_K + load * rise_K)
