"""The phase machine of one axle's dump valve, as tables: wishes, transitions, interrupts, magnets.

Sliding and wheel acceleration, each in five classes, select a wish: the phase that the wheel needs.
An event is this wish, or a stronger event that replaces it. The phase and the event select the next
phase, unless the present phase must finish its pulse and pause first.

The entries of the tables are plain integers, because compiled code reads them.

Source: the usual matrix of slip and deceleration criteria. Its entries are assumptions, tuned on
the plant of this project.
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
    # vents until the wheel turns with the vehicle; then its speed corrects the reference speed
    RUN_UP = 5
    LOCKED_OUT = 6  # a safety timer has expired: the brake applies, whatever the wheel does


class Event(IntEnum):
    """Events of an axle.

    The first five are wishes; each has the number of the phase that it requests. RUN_UP, TIMER and
    CUT_OFF replace a wish, and a higher number replaces a lower one.
    """

    FILL = 0
    STEP_FILL = 1
    HOLD = 2
    STEP_VENT = 3
    VENT = 4
    RUN_UP = 5  # the axle is chosen to run up
    TIMER = 6  # the valve has vented or held for too long
    CUT_OFF = 7  # the vehicle is too slow for wheel slide protection


# short names of the phases (and of the wishes with the same numbers) for the tables below
F = int(Phase.FILL)
SF = int(Phase.STEP_FILL)
H = int(Phase.HOLD)
SV = int(Phase.STEP_VENT)
V = int(Phase.VENT)
R = int(Phase.RUN_UP)
L = int(Phase.LOCKED_OUT)

# The wish. Rows: class of the sliding, which is the reference speed less the wheel speed. Columns:
# class of the wheel acceleration. The band is the range of sliding that the unit aims for.
WISHES = np.array(
    [
        # columns: the wheel speed falls fast, falls, is steady, rises, rises fast
        [F, F, F, F, F],  # no sliding
        [H, SF, SF, F, F],  # below the band
        [V, SV, SF, SF, SF],  # in the band
        [V, V, SV, H, H],  # above the band
        [V, V, V, V, H],  # far above the band
    ]
)

# the next phase; rows: present phase; columns: event
NEXT = np.array(
    [
        # columns: FILL, STEP_FILL, HOLD, STEP_VENT, VENT, RUN_UP, TIMER, CUT_OFF
        [F, F, H, SV, V, R, L, F],  # FILL: stays full, because the wheel has not slid yet
        [F, SF, H, SV, V, R, L, F],  # STEP_FILL
        [F, SF, H, SV, V, R, L, F],  # HOLD
        [F, SF, H, SV, V, R, L, F],  # STEP_VENT
        [F, SF, H, SV, V, R, L, F],  # VENT
        [F, SF, H, SV, V, R, L, F],  # RUN_UP
        [F, F, F, F, F, F, F, F],  # LOCKED_OUT
    ]
)

# whether an event may end a phase before its pulse and pause are over (1: yes); rows and columns as
# in NEXT
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

# the pair of magnets; rows: phase; columns: during the pulse of the phase, after the pulse
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
