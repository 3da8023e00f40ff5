"""The phase machine of one axle's dump valve, as tables: wishes, transitions, interrupts, magnets.

Sliding and wheel acceleration, each in five classes, select a wish. The phase and the event (a wish, or
a stronger event) select the next phase, unless the present phase must finish its pulse and pause.
Source: the usual matrix of slip and deceleration criteria. Its entries are assumptions, tuned on the
plant of this project.
"""

from enum import IntEnum

import numpy as np

from rollerrig.wsp_interface.magnets import FILLING, HOLDING, VENTING


class Phase(IntEnum):
    """What the valve of an axle is doing."""

    FILL = 0  # the brake follows the demand of the driver
    STEP_FILL = 1  # a fill pulse, then hold
    HOLD = 2
    STEP_VENT = 3  # a vent pulse, then hold
    VENT = 4
    RUN_UP = 5  # vents until the wheel turns with the vehicle, as an anchor of the reference
    LOCKED_OUT = 6  # a safety timer has expired: the brake applies, whatever the wheel does


class Event(IntEnum):
    """Events of an axle. The first five are wishes; of the others the highest number wins."""

    FILL = 0
    STEP_FILL = 1
    HOLD = 2
    STEP_VENT = 3
    VENT = 4
    RUN_UP = 5
    TIMER = 6
    CUT_OFF = 7


# short names for the tables below
F, SF, H, SV, V, R, L = (int(phase) for phase in Phase)

# the wish; rows: class of the sliding against the reference; columns: class of the acceleration
WISHES = np.array(
    [
        # falls fast, falls, steady, rises, rises fast
        [F, F, F, F, F],  # no sliding
        [H, SF, SF, F, F],  # below the band
        [V, SV, SF, SF, SF],  # in the band
        [V, V, SV, H, H],  # above it
        [V, V, V, V, H],  # deep
    ]
)

# the next phase; rows: phase; columns: event (fill, step fill, hold, step vent, vent, run-up, timer,
# cut-off)
NEXT = np.array(
    [
        [F, F, H, SV, V, R, L, F],  # FILL: the wheel has not slid yet, so there are no fill steps
        *[[F, SF, H, SV, V, R, L, F]] * 5,  # STEP_FILL to RUN_UP
        [F, F, F, F, F, F, F, F],  # LOCKED_OUT
    ]
)

# 1: the event ends the phase before its pulse and pause are over; rows and columns as in NEXT
INTERRUPTS = np.array(
    [
        [1, 1, 1, 1, 1, 1, 1, 1],  # FILL
        [0, 0, 0, 1, 1, 1, 1, 1],  # STEP_FILL
        [1, 1, 1, 1, 1, 1, 1, 1],  # HOLD
        [1, 0, 0, 0, 1, 1, 1, 1],  # STEP_VENT
        [1, 1, 1, 1, 1, 1, 1, 1],  # VENT
        [1, 1, 1, 1, 1, 1, 1, 1],  # RUN_UP
        [0, 0, 0, 0, 0, 0, 0, 1],  # LOCKED_OUT
    ]
)

# energised magnets during the pulse of a phase, and after it
MAGNETS = np.array(
    [
        [FILLING, FILLING],  # FILL
        [FILLING, HOLDING],  # STEP_FILL
        [HOLDING, HOLDING],  # HOLD
        [VENTING, HOLDING],  # STEP_VENT
        [VENTING, VENTING],  # VENT
        [VENTING, VENTING],  # RUN_UP
        [FILLING, FILLING],  # LOCKED_OUT
    ]
)
