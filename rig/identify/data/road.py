"""Two-axle road vehicles: what the table [axles] says of them, their loads, and their brakes.

The two wheels of an axle turn separately, so each wheel takes the place of a wheelset. Loads follow
from the mass and the deceleration a where they were not measured, with the centre of mass at the
height h, the wheelbase L and the fraction b of the weight on the front axle:

    [W1] N_front = (M g b + M h a / L) / 2,  N_rear = (M g (1 - b) - M h a / L) / 2, of a wheel
    [W2] torque of a front wheel over that of a rear wheel at one pressure = p / (1 - p)

    [W3] creep stiffness over load = that at the mean load of all wheels, for each tyre

p is the fraction of the front brakes. Polach's stiffness over the load falls with the load to the
power of 1/3, as a contact of steel grows; that of a tyre hardly changes, so [W3] takes it out.

Source of [W1]: Mitschke and Wallentowitz, Dynamik der
Kraftfahrzeuge (2014), section 6. Lifts and dives of the body, curves and wind are left out.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import integer, number
from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig.identify.data.runs import RoadVehicle

WHEELS_OF_AXLE = 2
POSITIONS_M = (0.0, 2.7)  # of the two axles: an example in messages
WHEELS = WHEELS_OF_AXLE * len(POSITIONS_M)

# the keys of the table [axles] besides positions_m; -1 means "not given"
ROWS = (
    integer("wheels", 1, 1, WHEELS_OF_AXLE, "2: a road vehicle whose columns are those of wheels"),
    number("height_m", -1.0, 0.05, 3.0, "of the centre of mass above the road"),
    number("front_load_fraction", -1.0, 0.1, 0.9, "of the weight on the front axle at standstill"),
    number("front_brake_fraction", -1.0, 0.1, 0.9, "of the brake torque at one pressure"),
)
# standard deviation of the window that smooths the speed, s
SMOOTHING_S = 0.1


def check_positions(given: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError unless the table [axles] of a road vehicle has the places of two axles."""
    positions = given.get("positions_m")
    if not isinstance(positions, list) or len(positions) != len(POSITIONS_M):
        raise ConfigError(
            f"{where}: wheels = 2 is a road vehicle with two axles, and positions_m is {positions}; "
            f"write positions_m = {list(POSITIONS_M)} with the wheelbase in m"
        )


def read(values: Mapping[str, Any], where: str) -> RoadVehicle | None:
    """Return the road vehicle of the values of ROWS; None for a rail vehicle. Raises ConfigError."""
    given = {row.name: values[row.name] for row in ROWS if row.name != "wheels"}
    if values["wheels"] != WHEELS_OF_AXLE:
        for name, value in given.items():
            if value > 0.0:
                raise ConfigError(
                    f"{where}: {name} is of a road vehicle, whose wheels turn separately; write "
                    "wheels = 2, or remove it"
                )
        return None
    return RoadVehicle(**{name: value if value > 0.0 else np.nan for name, value in given.items()})


def loads_N(
    vehicle: RoadVehicle,
    wheelbase_m: float,
    mass_kg: float,
    speed_m_s: np.ndarray,
    sample_time_s: float,
    where: str,
) -> np.ndarray:
    """Return the loads of the wheels (n, 4) from the speed (n,) [W1]. Raises ConfigError."""
    if not (vehicle.height_m > 0.0 and vehicle.front_load_fraction > 0.0):
        raise ConfigError(
            f"{where}: there are no loads; give the columns wheel_load_1_N to wheel_load_4_N, or "
            "height_m and front_load_fraction in [axles]"
        )
    if not np.isfinite(mass_kg):
        raise ConfigError(
            f"{where}: there are no loads, and a run that is `held` has no mass; give the columns "
            "wheel_load_1_N to wheel_load_4_N"
        )
    smooth_m_s = gaussian_filter1d(speed_m_s, SMOOTHING_S / sample_time_s, mode="nearest")
    deceleration_m_s2 = -np.gradient(smooth_m_s, sample_time_s)
    weight_N = mass_kg * GRAVITY_M_S2
    transfer_N = mass_kg * vehicle.height_m * deceleration_m_s2 / wheelbase_m
    front_N = 0.5 * (weight_N * vehicle.front_load_fraction + transfer_N)
    rear_N = 0.5 * (weight_N * (1.0 - vehicle.front_load_fraction) - transfer_N)
    if rear_N.min() <= 0.0:
        raise ConfigError(
            f"{where}: by height_m, positions_m and front_load_fraction in [axles] the rear wheels "
            f"lift at {deceleration_m_s2.max():.3g} m/s2; correct one of them"
        )
    return np.column_stack([front_N, front_N, rear_N, rear_N])


def brake_factors(vehicle: RoadVehicle) -> np.ndarray:
    """Return the factors of the torques of the wheels (4,) at one pressure, with a mean of 1 [W2].

    They are 1 where the fraction of the front brakes is not given.
    """
    front = vehicle.front_brake_fraction
    if not front > 0.0:
        return np.ones(WHEELS)
    return 2.0 * np.array([front, front, 1.0 - front, 1.0 - front])


def tyre_stiffness(load_N: np.ndarray) -> np.ndarray:
    """Return the factor of the stiffness of each wheel (wheels,) of loads (n, wheels) [W3]."""
    loads_N = load_N.mean(axis=0)
    return np.asarray((loads_N / loads_N.mean()) ** (1.0 / 3.0))
