"""The vehicle in what every room shares: its wheelsets, and what follows from its tables alone.

[1] T = A i eta 2 mu r n (p - p_spring): two pads press on each disc.
[2] R = A + B v + C v^2, of which a changed resistance changes one coefficient, a gradient A.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.configs.errors import ConfigError

AXLES = 4
# the two magnets of an axle's dump valve, as bits; none energised fills the cylinder
HOLD_MAGNET = 1
VENT_MAGNET = 2
GRAVITY_M_S2 = 9.80665  # standard gravity, ISO 80000-3
# where powers of the speed are 1: a coefficient is what holds at this speed
MIDDLE_SPEED_M_S = 20.0
# coefficient of the running resistance [2] that grows with this power of the speed
RESISTANCE = {0.0: "resistance_A_N", 1.0: "resistance_B_N_s_m", 2.0: "resistance_C_N_s2_m2"}


def brake_torque_Nm_Pa(brake: Mapping[str, float]) -> float:
    """Brake torque of a wheelset for each Pa above the spring's pressure [1], of the table [brake]."""
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
    """Share of the pressure asked for that the weighing valve of [air] lets through at this vehicle's mass."""
    if air["weighed_mass_kg"] == 0.0:
        return 1.0
    return float(min(max(vehicle["mass_kg"] / air["weighed_mass_kg"], air["weighed_least"]), 1.0))


def running_resistance(
    vehicle: Mapping[str, Any], force_N: float, speed_power: float
) -> dict[str, Any]:
    """R = R_0 + force (v / 20 m/s)^speed_power. Raises ConfigError for a power that is not 0, 1 or 2."""
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
