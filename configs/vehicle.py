"""Constants and formulas of the vehicle that all parts of the product share.

[1] T = A i eta 2 mu r n (p - p_spring): two pads press on each disc.
[2] R = A + B v + C v^2. A changed resistance changes one of the coefficients, a gradient changes A.
"""

import os
from collections.abc import Mapping
from typing import Any

from rollerrig.configs.errors import ConfigError, OtherAxlesError, OtherEquipmentError

# Numbers of axles that a vehicle may have, and the one of the coach, which is the default.
ALLOWED_AXLES = (2, 4, 6, 8, 10, 12)
_ALLOWED_TEXT = ", ".join(map(str, ALLOWED_AXLES))
COACH_AXLES = 4
AXLES_OF_BOGIE = 2
# Axles of one group: a group has its drives, its speed unit, its brake I/O and its WSP unit.
AXLES_OF_GROUP = 4
# The environment variable with the number of axles that a process simulates.
AXLES_VARIABLE = "ROLLERRIG_AXLES"


def _axles_of_process() -> int:
    """Return the number of axles for which this process was started. Raises ConfigError."""
    text = os.environ.get(AXLES_VARIABLE, str(COACH_AXLES))
    if text not in map(str, ALLOWED_AXLES):
        raise ConfigError(
            f"environment variable {AXLES_VARIABLE} = {text!r}; it must be one of {_ALLOWED_TEXT}; "
            "or unset it, for vehicles with four axles"
        )
    return int(text)


# The axles of the vehicles that this process simulates. Compiled code has a fixed number of axles,
# as its arrays have fixed sizes, so that a vehicle with four axles costs what it always did. The
# command line starts itself again for a vehicle with another number (`check_axles`).
AXLES = _axles_of_process()
GROUPS = -(-AXLES // AXLES_OF_GROUP)

# The environment variable with the equipment that the vehicles of a process have: words with commas
# between them. Equipment adds channels, a node and compiled code, and a process without it stays as
# it is. The command line starts itself again for a vehicle with other equipment.
EQUIPMENT_VARIABLE = "ROLLERRIG_EQUIPMENT"
DYNAMIC_BRAKE = "dynamic_brake"
MAGNETIC_TRACK_BRAKE = "magnetic_track_brake"
# the section of a scenario with each equipment, and the key that lists where the vehicle has it
EQUIPMENT_KEYS = {DYNAMIC_BRAKE: "axles", MAGNETIC_TRACK_BRAKE: "bogies"}
ALLOWED_EQUIPMENT = tuple(EQUIPMENT_KEYS)


def _equipment_of_process() -> frozenset[str]:
    """Return the equipment for which this process was started. Raises ConfigError."""
    text = os.environ.get(EQUIPMENT_VARIABLE, "")
    found = frozenset(word for word in text.split(",") if word)
    if not found <= frozenset(ALLOWED_EQUIPMENT):
        raise ConfigError(
            f"environment variable {EQUIPMENT_VARIABLE} = {text!r}; allowed are the words "
            f"{', '.join(ALLOWED_EQUIPMENT)}; or unset it, for vehicles with friction brakes only"
        )
    return found


EQUIPMENT = _equipment_of_process()
HAS_DYNAMIC_BRAKE = DYNAMIC_BRAKE in EQUIPMENT
HAS_MAGNETIC_TRACK_BRAKE = MAGNETIC_TRACK_BRAKE in EQUIPMENT
# the axles of a group with the most axles
UNIT_AXLES = min(AXLES, AXLES_OF_GROUP)


def axles_of_group(group: int) -> int:
    """Return the number of axles of a group; 0 is the leading one. Only the last may have two."""
    return min(AXLES - AXLES_OF_GROUP * group, AXLES_OF_GROUP)


def wheelsets_of(place: int) -> range:
    """Return the wheelsets, counted from 1, of a place: n wheelset n, -n bogie n, 0 all."""
    if place > 0:
        return range(place, place + 1)
    if place < 0:
        last = -place * AXLES_OF_BOGIE
        return range(last - AXLES_OF_BOGIE + 1, last + 1)
    return range(1, AXLES + 1)


def check_axles(axles: Any, where: str, equipment: frozenset[str] = EQUIPMENT) -> None:
    """Check the number of axles of a vehicle.

    Raises ConfigError for a number that is not allowed, OtherAxlesError for one that this process
    does not simulate. `where` names the file and the key; `equipment` is that of the vehicle.
    """
    if type(axles) is not int or axles not in ALLOWED_AXLES:
        raise ConfigError(f"{where} = {axles!r}; it must be one of {_ALLOWED_TEXT}")
    if axles != AXLES:
        environment = {AXLES_VARIABLE: str(axles)}
        if equipment != EQUIPMENT:
            environment[EQUIPMENT_VARIABLE] = ",".join(sorted(equipment))
        raise OtherAxlesError(where, axles, AXLES, environment)


def check_equipment(equipment: frozenset[str], where: str) -> None:
    """Raise OtherEquipmentError unless this process simulates vehicles with this equipment.

    `where` names the file and the table.
    """
    if equipment != EQUIPMENT:
        environment = {EQUIPMENT_VARIABLE: ",".join(sorted(equipment))}
        if AXLES != COACH_AXLES:
            environment[AXLES_VARIABLE] = str(AXLES)
        raise OtherEquipmentError(where, sorted(equipment), sorted(EQUIPMENT), environment)


# the two magnets of the dump valve of an axle, as bits; without energised magnets the cylinder
# fills
HOLD_MAGNET = 1
VENT_MAGNET = 2
GRAVITY_M_S2 = 9.80665  # standard gravity, ISO 80000-3
# at this speed a power of the relative speed is 1, so a coefficient has its value there
MIDDLE_SPEED_M_S = 20.0
# the coefficient of the running resistance [2] for each power of the speed
RESISTANCE = {0.0: "resistance_A_N", 1.0: "resistance_B_N_s_m", 2.0: "resistance_C_N_s2_m2"}


def check_axles_of(sections: Mapping[str, Any], where: str) -> None:
    """Check the number of axles in the section [vehicle], as `check_axles` does."""
    vehicle = sections.get("vehicle")
    if isinstance(vehicle, Mapping):
        check_axles(vehicle.get("axles", COACH_AXLES), f"{where} [vehicle] axles")


def equipment_of(sections: Mapping[str, Any]) -> frozenset[str]:
    """Return the equipment of the vehicle of a resolved scenario."""
    found = []
    for name, key in EQUIPMENT_KEYS.items():
        section = sections.get(name)
        if isinstance(section, Mapping) and section.get(key):
            found.append(name)
    return frozenset(found)


def check_vehicle_of(resolved: Mapping[str, Any], where: str) -> None:
    """Check that this process simulates the vehicle of a resolved scenario.

    Raises ConfigError, OtherVehicleError.
    """
    vehicle = resolved.get("vehicle")
    equipment = equipment_of(resolved)
    if isinstance(vehicle, Mapping):
        check_axles(vehicle.get("axles", COACH_AXLES), f"{where} [vehicle] axles", equipment)
    check_equipment(equipment, where)


def bodies(bogies_per_body: int) -> int:
    """Return the number of bodies. Raises ConfigError where they cannot share the bogies."""
    bogies = AXLES // AXLES_OF_BOGIE
    number, remainder = divmod(bogies, bogies_per_body)
    if remainder or number == 0:
        raise ConfigError(
            f"[vehicle] axles = {AXLES} are {bogies} bogies, which bogies_per_body = "
            f"{bogies_per_body} does not divide; change one of them"
        )
    return number


def axle_positions_m(vehicle: Mapping[str, Any]) -> list[float]:
    """Return the distance of each wheelset behind the first. Raises ConfigError as `bodies`."""
    base_m = vehicle["bogie_wheelbase_m"]
    found: list[float] = []
    for body in range(bodies(vehicle["bogies_per_body"])):
        for bogie in range(vehicle["bogies_per_body"]):
            first_m = body * vehicle["body_distance_m"] + bogie * vehicle["bogie_distance_m"]
            found += [first_m, first_m + base_m]
    return found


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
