"""State of the coach: named views into one float64 buffer, so that a snapshot is one copy.

Each field says its shape, unit and which stage writes it; q and v are ordered by body (car, two
bogies, four wheelsets), then x, y, z, roll, pitch, yaw.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.contact import geometry, profiles
from rollerrig.rig.multibody import eight_contacts
from rollerrig.rig.multibody.wheel_rail_forces import GIVEN, SEEN

WHEELS = 8
NODES = (
    round((profiles.FIELD_END_M - profiles.FLANGE_END_M) / (profiles.STRIDE * profiles.SPACING_M))
    + 1
)

# what a caller hands over and takes back in each step: see `compiled_coach`
(ACTION, SPEED_M_S, RESISTANCE_N) = range(3)
ROLLER_RAD_S, MOTOR_NM, BRAKE_NM, BRAKE_ACTS_NM, MU_CD, MU_CR, PORTS = range(3, 28, 4)


class Motion(NamedTuple):
    """Views; stages are functions of `motion`."""

    ports: np.ndarray  # (PORTS,) one step's inputs and outputs; port
    q: np.ndarray  # (42,) m, rad; step
    v: np.ndarray  # (42,) m/s, rad/s; step
    force: np.ndarray  # (42,) N, N m: suspension and weight; step
    contacts: np.ndarray  # (8 MOST, COLUMNS) of `geometry`, MOST rows a wheel; step
    near: np.ndarray  # (8,) contacts and near contacts in use; step
    misfit: np.ndarray  # (8, NODES) m, F at the coarse nodes of each wheel; step
    given: np.ndarray  # (4, GIVEN) of `wheel_rail_forces`; step
    lanes: np.ndarray  # (SIZE,) of `eight_contacts`; step
    Gx: np.ndarray  # (4, 4, 4) N s/m ..., of each wheelset; step
    Gy: np.ndarray  # (4, 3, 3), of each wheelset; step
    seen: (
        np.ndarray
    )  # (8, SEEN) of `wheel_rail_forces`, left then right wheel of each wheelset; step
    searched: np.ndarray  # (8, 4) y, z, roll, yaw where the wheel was last searched; step
    left: np.ndarray  # (8,) m, place on the track where a wheel left its rail, 0: it is on it; step
    turn: np.ndarray  # (1,) which wheelset comes first in the next step; step
    damper_work: np.ndarray  # (1,) J; step
    approach_work: np.ndarray  # (1,) J, dampers of the contacts; step
    sliding_work: np.ndarray  # (4,) J; step
    brake_work: np.ndarray  # (4,) J; step
    resistance_work: np.ndarray  # (1,) J; step


SHAPES: dict[str, tuple[int, ...]] = {
    "ports": (PORTS,),
    "q": (42,),
    "v": (42,),
    "force": (42,),
    "contacts": (WHEELS * geometry.MOST, geometry.COLUMNS),
    "near": (WHEELS,),
    "misfit": (WHEELS, NODES),
    "given": (4, GIVEN),
    "lanes": (eight_contacts.SIZE,),
    "Gx": (4, 4, 4),
    "Gy": (4, 3, 3),
    "seen": (WHEELS, SEEN),
    "searched": (WHEELS, 4),
    "left": (WHEELS,),
    "turn": (1,),
    "damper_work": (1,),
    "approach_work": (1,),
    "sliding_work": (4,),
    "brake_work": (4,),
    "resistance_work": (1,),
}
BEGIN: dict[str, int] = {}
SIZE = 0
for _name in Motion._fields:
    BEGIN[_name] = SIZE
    SIZE += int(np.prod(SHAPES[_name]))


def views(buffer: np.ndarray) -> Motion:
    """The state in a contiguous float64 buffer of shape (SIZE,)."""
    return Motion(
        *(
            buffer[BEGIN[name] : BEGIN[name] + int(np.prod(SHAPES[name]))].reshape(SHAPES[name])
            for name in Motion._fields
        )
    )
