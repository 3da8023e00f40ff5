"""State of the coach: named views into one float64 buffer, so that a snapshot is one copy.

Each field has its shape, its unit and the stage that writes it. The order of q and v is by body
(car, two bogies, four wheelsets), then x, y, z, roll, pitch, yaw (`coordinates`).
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.rig.contact import geometry, profiles
from rollerrig.rig.multibody import eight_contacts
from rollerrig.rig.multibody.coordinates import COORDINATES
from rollerrig.rig.multibody.wheel_rail_forces import WHEEL_COLUMNS, WHEELSET_COLUMNS

WHEELS = 2 * COACH_AXLES
# coarse nodes of a wheel's profile
NODES = (
    round((profiles.FIELD_END_M - profiles.FLANGE_END_M) / (profiles.STRIDE * profiles.SPACING_M))
    + 1
)

# places in `ports`: inputs and outputs of a step, see `compiled_coach`
ACTION, SPEED_M_S, RESISTANCE_N = range(3)
# from here each place is the first of four, one for each wheelset
ROLLER_RAD_S, MOTOR_NM, BRAKE_NM, BRAKE_ACTS_NM, MU_CD, MU_CR, PORTS = range(3, 28, COACH_AXLES)


class Motion(NamedTuple):
    """Views of the buffer; the stages are functions of `motion`, and a caller writes the ports."""

    ports: np.ndarray  # (PORTS,) inputs and outputs of one step; port
    q: np.ndarray  # (42,) m, rad; step
    v: np.ndarray  # (42,) m/s, rad/s; step
    force: np.ndarray  # (42,) N, N m: suspension and weight; step
    contacts: np.ndarray  # (8 MOST, COLUMNS) of `geometry`, MOST rows a wheel; step
    contact_count: np.ndarray  # (8,) contacts and near contacts in use; step
    misfit: np.ndarray  # (8, NODES) m, F at the coarse nodes of each wheel; step
    wheelset_forces: np.ndarray  # (4, WHEELSET_COLUMNS) of `wheel_rail_forces`; step
    lanes: np.ndarray  # (SIZE,) of `eight_contacts`; step
    Gx: np.ndarray  # (4, 4, 4) N s/m ..., of each wheelset; step
    Gy: np.ndarray  # (4, 3, 3), of each wheelset; step
    # (8, WHEEL_COLUMNS) of `wheel_rail_forces`, left then right wheel of each wheelset; step
    wheel_forces: np.ndarray
    searched_at: np.ndarray  # (8, 4) y, z, roll, yaw at the last search for contacts; step
    left: np.ndarray  # (8,) m, place on the track where a wheel left its rail, 0: on the rail; step
    first_wheelset: np.ndarray  # (1,) the wheelset that comes first in the next step; step
    damper_work: np.ndarray  # (1,) J; step
    approach_work: np.ndarray  # (1,) J, dampers of the contacts; step
    sliding_work: np.ndarray  # (4,) J; step
    brake_work: np.ndarray  # (4,) J; step
    resistance_work: np.ndarray  # (1,) J; step


SHAPES: dict[str, tuple[int, ...]] = {
    "ports": (PORTS,),
    "q": (COORDINATES,),
    "v": (COORDINATES,),
    "force": (COORDINATES,),
    "contacts": (WHEELS * geometry.MOST, geometry.COLUMNS),
    "contact_count": (WHEELS,),
    "misfit": (WHEELS, NODES),
    "wheelset_forces": (COACH_AXLES, WHEELSET_COLUMNS),
    "lanes": (eight_contacts.SIZE,),
    "Gx": (COACH_AXLES, 4, 4),
    "Gy": (COACH_AXLES, 3, 3),
    "wheel_forces": (WHEELS, WHEEL_COLUMNS),
    "searched_at": (WHEELS, 4),
    "left": (WHEELS,),
    "first_wheelset": (1,),
    "damper_work": (1,),
    "approach_work": (1,),
    "sliding_work": (COACH_AXLES,),
    "brake_work": (COACH_AXLES,),
    "resistance_work": (1,),
}
# the place of each field in the buffer, and the size of the buffer
BEGIN: dict[str, int] = {}
SIZE = 0
for _name in Motion._fields:
    BEGIN[_name] = SIZE
    SIZE += int(np.prod(SHAPES[_name]))


def views(buffer: np.ndarray) -> Motion:
    """Return the state in a contiguous float64 buffer of shape (SIZE,)."""
    fields = []
    for name in Motion._fields:
        begin = BEGIN[name]
        shape = SHAPES[name]
        fields.append(buffer[begin : begin + int(np.prod(shape))].reshape(shape))
    return Motion(*fields)
