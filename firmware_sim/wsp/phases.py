"""The phase machine of one axle's dump valve, as tables: wishes, transitions, interrupts, magnets.

Sliding and wheel acceleration, each in five classes, pick a wish. Phase and event (a wish, or something stronger)
pick the next phase, unless the present one must finish its pulse and pause. Source: the usual matrix of slip and
deceleration criteria; its entries are assumptions, tuned on the project's own plant.
"""

from enum import IntEnum

import numpy as np

from rollerrig.wsp_interface.magnets import FILLING, HOLDING, VENTING


class Phase(IntEnum):
    """What the valve of an axle is doing."""

    FILL = 0  # the brake as the driver asks
    STEP_FILL = 1  # a fill pulse, then hold
    HOLD = 2
    STEP_VENT = 3  # a vent pulse, then hold
    VENT = 4
    RUN_UP = 5  # vented until the wheel turns with the vehicle: anchors the reference
    LOCKED_OUT = 6  # a safety timer ran out: the brake applies, whatever the wheel does


class Event(IntEnum):
    """What asks for a change. The first five are wishes; of the others the highest wins."""

    FILL = 0
    STEP_FILL = 1
    HOLD = 2
    STEP_VENT = 3
    VENT = 4
    RUN_UP = 5
    TIMER = 6
    CUT_OFF = 7


F, SF, H, SV, V, R, L = (int(phase) for phase in Phase)

# rows: sliding against the reference; columns: wheel acceleration
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

# events: fill, step fill, hold, step vent, vent, run-up, timer, cut-off
NEXT = np.array(
    [
        [F, F, H, SV, V, R, L, F],  # FILL: has not slid yet, so no steps
        *[[F, SF, H, SV, V, R, L, F]] * 5,  # STEP_FILL to RUN_UP
        [F, F, F, F, F, F, F, F],  # LOCKED_OUT
    ]
)

# 1: the event ends the phase before its pulse and pause are over
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
