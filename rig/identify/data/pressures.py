"""Brake torques from cylinder pressures, for data in which no torque was measured.

The torque of a wheelset is that of the brake of the vehicle file times one unknown factor, which
all wheelsets and all runs share:

    [T1] C_i = f c (p_i - p_0), c the torque for each Pa and p_0 the pressure of the spring

The momentum that the vehicle loses in each run ([D1] of `units`) gives f, also while wheels slide.
Its error is that of the mean over the runs. What is proportional to the braking force in all runs,
such as other pads or another mass, is in f and cannot be seen as a cause.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import brake_torque_Nm_Pa
from rollerrig.rig.identify.data import units
from rollerrig.rig.identify.data.runs import Run

# runs whose momentum is needed to know the error of the factor
LEAST_RUNS = 2

# half-width of the 95 % interval, as a share of the factor; beyond it pressures are no torques
LARGEST_ERROR = 0.05

# factor within which the brake of the vehicle file is right; beyond it a unit or a channel is wrong
LARGEST_FACTOR = 4.0

REMEDY = "or give torques: columns brake_torque_1_Nm and so on"


class Gain(NamedTuple):
    """The torque of a wheelset for each Pa, with the half-width of its 95 % interval, N m/Pa."""

    torque_Nm_Pa: float
    half_width_Nm_Pa: float


def with_torques(
    runs: Sequence[Run],
    pressures_Pa: Sequence[np.ndarray],
    sections: Mapping[str, Mapping[str, Any]],
    where: str,
) -> tuple[list[Run], Gain]:
    """Return the runs with the torques of their pressures (n, axles), and the gain between both.

    Raises ConfigError if the runs to fit do not give the factor, or if it is far from 1.
    """
    brake = sections["brake"]
    torque_Nm_Pa = brake_torque_Nm_Pa(brake)
    of_file = []
    for run, pressure_Pa in zip(runs, pressures_Pa, strict=True):
        above_Pa = np.maximum(pressure_Pa - brake["spring_pressure_Pa"], 0.0)
        of_file.append(run._replace(torque_Nm=torque_Nm_Pa * above_Pa))

    factors = []
    for run in of_file:
        if run.group != "tune" or not np.isfinite(run.mass_kg) or not np.any(run.torque_Nm):
            continue
        share = units.torque_share(run, sections["vehicle"])
        if share is not None:
            factors.append(1.0 / share)
    if len(factors) < LEAST_RUNS:
        raise ConfigError(
            f"{where}: there are pressures and no torques; the momentum that the vehicle loses gives "
            f"the torque for each bar, which needs {LEAST_RUNS} braked runs to fit that lose 3 m/s and "
            f"are not `held`, and there are {len(factors)}; give more runs, {REMEDY}"
        )

    factor = float(np.mean(factors))
    error = float(np.std(factors, ddof=1)) / np.sqrt(len(factors))
    half_width = float(student.ppf(0.975, len(factors) - 1)) * error
    if not 1.0 / LARGEST_FACTOR < factor < LARGEST_FACTOR:
        raise ConfigError(
            f"{where}: the vehicle loses {factor:.3g} times the momentum that its brake takes at these "
            f"pressures (allowed: {1.0 / LARGEST_FACTOR:g} to {LARGEST_FACTOR:g}); check the unit of "
            "the pressures and the tables [brake] and [vehicle]"
        )
    if half_width > LARGEST_ERROR * factor:
        raise ConfigError(
            f"{where}: there are pressures and no torques, and the momentum of {len(factors)} runs gives "
            f"the torque for each bar within {100.0 * half_width / factor:.0f} % only (allowed: "
            f"{100.0 * LARGEST_ERROR:.0f} %); give more runs on level track, {REMEDY}"
        )
    found = [run._replace(torque_Nm=factor * run.torque_Nm) for run in of_file]
    return found, Gain(factor * torque_Nm_Pa, half_width * torque_Nm_Pa)
