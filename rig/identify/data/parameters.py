"""The parameters of the replay of one wheelset: radius, inertia, adhesion law, noise.

Python code keeps them as rows of an array (wheelsets, PARAMETERS). A kernel takes one row as a
`WheelModel`, whose fields are named. The order of the fields is the order of the columns.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled.generated import tuple_builder
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.patch import Patch, patch_for
from rollerrig.rig.identify.data.runs import Dataset

# What the replay of one wheelset needs to know. The fields of the adhesion law are those of `Law`.
_FIELDS = (
    "wheel_radius_m",
    "wheelset_inertia_kgm2",
    *Law._fields,
    "eps1",  # of the contact patch, `patch.Patch`
    "memory_m",  # length of adhesion memory [A7]; 0: recovery does not lag
    "irregularity_deviation",  # standard deviation of the irregularity m of the rail
    "irregularity_length_m",  # its correlation length
    "speed_noise_rad_s",  # standard deviation of measured wheel speed
    "torque_noise_Nm",  # standard deviation of measured torque
    "memory_speed_power",  # exponent p of adhesion memory [A7]
    "memory_of_work",  # above 0: lambda_0 is that of the work done [A7]
)
WheelModel = NamedTuple("WheelModel", [(name, float) for name in _FIELDS])
PARAMETERS = len(WheelModel._fields)
# makes a WheelModel of one row of an array, in compiled code
wheel_model = tuple_builder(WheelModel, "row", [f"row[{k}]" for k in range(PARAMETERS)])

# columns of an array of parameters
RADIUS = WheelModel._fields.index("wheel_radius_m")
INERTIA = WheelModel._fields.index("wheelset_inertia_kgm2")
MU_CD = WheelModel._fields.index("mu_cd")
MU_CR = WheelModel._fields.index("mu_cr")
TAU = WheelModel._fields.index("tau_m_J")
EPS1 = WheelModel._fields.index("eps1")
MEMORY = WheelModel._fields.index("memory_m")
IRREGULARITY = WheelModel._fields.index("irregularity_deviation")
IRREGULARITY_LENGTH = WheelModel._fields.index("irregularity_length_m")
SPEED_NOISE = WheelModel._fields.index("speed_noise_rad_s")
TORQUE_NOISE = WheelModel._fields.index("torque_noise_Nm")
MEMORY_POWER = WheelModel._fields.index("memory_speed_power")
MEMORY_OF_WORK = WheelModel._fields.index("memory_of_work")

_FIRST_OF_LAW = WheelModel._fields.index(Law._fields[0])
LAW = slice(_FIRST_OF_LAW, _FIRST_OF_LAW + len(Law._fields))
# column of each constant that a mechanism may change
COLUMN = {
    "wheel_radius_m": RADIUS,
    "wheelset_inertia_kgm2": INERTIA,
    "eps1": EPS1,
    **{key: WheelModel._fields.index(key) for key in Law._fields},
}


def patch_of(data: Dataset) -> Patch:
    """Return the contact patch of a wheel of a dataset's base model."""
    contact = data.sections["contact"]
    return patch_for(
        data.sections["vehicle"]["wheel_radius_m"],
        contact["roller_radius_m"],
        contact["lateral_radius_m"],
        contact["young_Pa"],
        contact["shear_Pa"],
        contact["poisson"],
    )


def base_parameters(data: Dataset) -> np.ndarray:
    """Return the parameters of a dataset's base model, shape (PARAMETERS,), without noise."""
    vehicle = data.sections["vehicle"]
    law = data.sections["adhesion"]
    row = np.zeros(PARAMETERS)
    row[RADIUS] = vehicle["wheel_radius_m"]
    row[INERTIA] = vehicle["wheelset_inertia_kgm2"]
    row[LAW] = [law[key] for key in Law._fields]
    row[EPS1] = patch_of(data).eps1
    return row
