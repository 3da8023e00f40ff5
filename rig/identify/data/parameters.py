"""The row of numbers that a wheel's replay reads: its radius and inertia, the adhesion law, the noise."""

import numpy as np

from rollerrig.rig.contact.patch import Patch, patch_for
from rollerrig.rig.identify.data.runs import Dataset

LAW_KEYS = (
    "mu_cd",
    "mu_cr",
    "A_d",
    "A_r",
    "gamma_d_s_m",
    "gamma_r_s_m",
    "k_ad",
    "k_sd",
    "k_ar",
    "k_sr",
    "tau_m_J",
)
# columns of a segment's parameters
RADIUS, INERTIA = 0, 1
LAW = slice(2, 13)
(
    EPS1,
    MEMORY,
    SIGMA,
    LENGTH,
    NOISE,
    TORQUE_NOISE,
    CLEANING,
    MEMORY_POWER,
    MEMORY_OF_WORK,
    PARAMETERS,
) = range(13, 23)
MU_CD, TAU = 2, 12
# column of each constant that a mechanism may change
COLUMN = {
    "wheel_radius_m": RADIUS,
    "wheelset_inertia_kgm2": INERTIA,
    "eps1": EPS1,
    **{key: at for at, key in enumerate(LAW_KEYS, start=LAW.start)},
}


def patch_of(data: Dataset) -> Patch:
    """The contact patch of a dataset's wheel."""
    c = data.sections["contact"]
    return patch_for(
        data.sections["vehicle"]["wheel_radius_m"],
        c["roller_radius_m"],
        c["lateral_radius_m"],
        c["young_Pa"],
        c["shear_Pa"],
        c["poisson"],
    )


def base_parameters(data: Dataset) -> np.ndarray:
    """One row of the replay's parameters from the dataset's base model."""
    v, law = data.sections["vehicle"], data.sections["adhesion"]
    row = np.zeros(PARAMETERS)
    row[RADIUS], row[INERTIA] = v["wheel_radius_m"], v["wheelset_inertia_kgm2"]
    row[LAW] = [law[k] for k in LAW_KEYS]
    row[EPS1], row[CLEANING] = patch_of(data).eps1, law["cleaning_creepage"]
    return row
