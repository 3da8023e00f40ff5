"""Constants and formulas of the vehicle that all parts of the product share.

[1] T = A i eta 2 mu r n (p - p_spring): two pads press on each disc.
[2] R = A + B v + C v^2. A changed resistance changes one of the coefficients, a gradient changes A.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.configs.errors import ConfigError

AXLES = 4
# the two magnets of the dump valve of an axle, as bits; without energised magnets the cylinder
# fills
HOLD_MAGNET = 1
VENT_MAGNET = 2
GRAVITY_M_S2 = 9.80665  # standard gravity, ISO 80000-3
# at this speed a power of the relative speed is 1, so a coefficient has its value there
MIDDLE_SPEED_M_S = 20.0
# the coefficient of the running resistance [2] for each power of the speed
RESISTANCE = {0.0: "resistance_A_N", 1.0: "resistance_B_N_s_m", 2.0: "resistance_C_N_s2_m2"}


def brake_torque_Nm_Pa(brake: Mapping[str, float]) -> float:
    """Return the brake torque of a wheelset in N m for each Pa above the spring pressure [1]."""
    return (
        brake["cylinder_area_m2"]
        * brake["lever_ratio"]
        * brake["efficiency"]
        * 2.0
        * brake["pad_friction"]
        * brake["disc_radius_m"]
        * brake["discs"]
    )


def weighed_share(air: Mapping[str, float], vehicle: Mapping[str, Any]) -> float:
    """Return the share of the demanded pressure that the weighing valve passes at this vehicle
    mass.
    """
    if air["weighed_mass_kg"] == 0.0:
        return 1.0
    loaded = vehicle["mass_kg"] / air["weighed_mass_kg"]
    return float(min(max(loaded, air["weighed_least"]), 1.0))


def running_resistance(
    vehicle: Mapping[str, Any], force_N: float, speed_power: float
) -> dict[str, Any]:
    """R = R_0 + force (v / 20 m/s)^speed_power.

    Raises ConfigError for a power that is not 0, 1 or 2.
    """
    if speed_power not in RESISTANCE:
        raise ConfigError(
            f"[mechanisms] running_resistance_speed_power = {speed_power:g}; allowed are 0 "
            "(constant), 1 and 2 (with the speed, with its square)"
        )
    key = RESISTANCE[speed_power]
    return {key: vehicle[key] + force_N / MIDDLE_SPEED_M_S**speed_power}


def track_gradient(vehicle: Mapping[str, Any], gradient: float) -> dict[str, Any]:
    """R = R_0 + M g gradient; uphill is positive"""
    return {
        "resistance_A_N": vehicle["resistance_A_N"] + GRAVITY_M_S2 * vehicle["mass_kg"] * gradient
    }
